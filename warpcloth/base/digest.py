"""Hashes of what a run depends on: its scene, and the code of this package."""

import hashlib
import os
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np

from .extensions import extensions
from .warp_internals import hash_of_function


def scene_digest(scene):
    """Hashes everything in a scene that its motion depends on; its duration is left out.

    Raises:
        ValueError: A field cannot be hashed, see :func:`digest_of`.
    """
    mesh = scene.mesh
    facts = [mesh.points, mesh.triangles, mesh.edges, mesh.grid_shape, scene.vertex_masses, scene.positions, scene.velocities]
    if mesh.parts:
        facts += [(name, *part) for name, part in mesh.parts.items()]
    facts += [scene.colliders, scene.contact] if scene.colliders else []
    facts += [each for each in (scene.self_contact, scene.air) if each is not None]
    return digest_of((*facts, scene.terms, scene.pins, scene.free_axes, scene.gravity, float(scene.fps), *scene.loads))


def digest_of(facts):
    """Hashes numbers, strings, lists, arrays, Warp functions with all that their code depends on, and dataclasses of these.

    Raises:
        ValueError: A value is of another type.
    """
    digest = hashlib.sha256()
    for fact in facts:
        _add(digest, fact)
    return digest.hexdigest()[:24]


def _add(digest, value):
    """Adds a value with its type and, for lists, its length, so that different values always add different bytes."""
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
    elif hasattr(value, "adj"):  # a Warp function
        digest.update(b"function" + hash_of_function(value) + b";")
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__};".encode())
        for field in fields(value):
            _add(digest, getattr(value, field.name))
    else:
        raise ValueError(f"a scene has {value!r}, a {type(value).__name__}; a key needs numbers, texts, lists and arrays")


def source_digest():
    """Hashes the code of this package and of extensions, so that measurements of another version are not reused."""
    files = [file for files in extensions().values() for file in files]
    if not files:
        return package_digest()
    digest = hashlib.sha256(package_digest().encode())
    for file in sorted(files, key=lambda file: file.name):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@cache
def package_digest():
    """Hashes the code of this package."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    folders = os.walk(root, followlinks=True)  # in a checkout, kernels/ is a link
    files = [Path(folder) / name for folder, _, names in folders for name in names if name.endswith(".py")]
    for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
