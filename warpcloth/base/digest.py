"""Keys of what a run depends on: a scene, and the code of this package."""

import hashlib
import os
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np

from .extensions import extensions


def scene_digest(scene):
    """A hash of all of a scene that its motion depends on, whatever it is called and how long it goes on.

    Raises:
        ValueError: Something in it is no data.
    """
    mesh = scene.mesh
    facts = [mesh.points, mesh.triangles, mesh.edges, mesh.grid_shape, scene.vertex_masses, scene.positions, scene.velocities]
    if mesh.parts:
        facts += [(name, *part) for name, part in mesh.parts.items()]
    facts += [scene.colliders, scene.contact] if scene.colliders else []
    facts += [] if scene.self_contact is None else [scene.self_contact]
    return digest_of((*facts, scene.terms, scene.pins, scene.free_axes, scene.gravity, float(scene.fps), *scene.loads))


def digest_of(facts):
    """A hash of numbers, texts, lists, arrays and records of these.

    Raises:
        ValueError: Something is none of these.
    """
    digest = hashlib.sha256()
    for fact in facts:
        _add(digest, fact)
    return digest.hexdigest()[:24]


def _add(digest, value):
    """Adds a value so that other values add other bytes: each with its kind, and of what has parts their number."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        digest.update(f"{type(value).__name__} {value!r};".encode())
    elif isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"array {value.dtype.str} {value.shape};".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, (list, tuple, np.ndarray)):
        digest.update(f"list {len(value)};".encode())
        for part in value:
            _add(digest, part)
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__};".encode())
        for field in fields(value):
            _add(digest, getattr(value, field.name))
    else:
        raise ValueError(f"a scene has {value!r}, a {type(value).__name__}; a key needs numbers, texts, lists and arrays")


def source_digest():
    """A hash of the code of this package and of extensions: what another version measured is measured again."""
    files = [file for files in extensions().values() for file in files]
    if not files:
        return package_digest()
    digest = hashlib.sha256(package_digest().encode())
    for file in sorted(files, key=lambda file: file.name):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@cache
def package_digest():
    """A hash of the code of this package."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    folders = os.walk(root, followlinks=True)  # in a checkout the folder of kernels is a link
    files = [Path(folder) / name for folder, _, names in folders for name in names if name.endswith(".py")]
    for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
