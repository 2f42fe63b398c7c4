"""Reference solutions: the motion of a scene as its mesh has it, without the error of a time step; kept in files."""

import hashlib
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from ..outputs import Output


@dataclass(frozen=True, eq=False)
class Reference:
    """The motion of a scene, as good as ``error`` says.

    Attributes:
        points: (F, n, 3) [m], the start and each frame after it, float64.
        times: (F,) [s].
        error: Estimate of its own distance to the exact motion, see :func:`position_error`.
        strain_error: Estimate of its own, see :func:`strain_error`.
        substeps: Steps a frame of the finest run.
        seconds: What all runs took [s].
        path: The file.
        key: A hash of scene, frames and code.
        scene: :func:`scene_digest` of the scene.
        limit: Seconds that it might take.
    """

    points: np.ndarray
    times: np.ndarray
    error: float
    strain_error: float
    substeps: int
    seconds: float
    path: str
    key: str
    scene: str
    limit: float

    def save(self):
        """Writes the file, whole or not at all."""
        Path(self.path).parent.mkdir(parents=True, exist_ok=True)
        output = Output(self.path, "wb")
        try:
            np.savez(output.file, **{name: value for name, value in vars(self).items() if name != "path"})
            output.close()
        except BaseException:
            output.discard()
            raise

    @classmethod
    def load(cls, path):
        """The reference of a file that :meth:`save` wrote.

        Raises:
            FileNotFoundError: There is none.
            ValueError: It is broken.
        """
        names = [field.name for field in fields(cls) if field.name != "path"]
        try:
            with np.load(path, allow_pickle=False) as file:
                values = {name: file[name] if name in ("points", "times") else file[name].item() for name in names}
        except FileNotFoundError:
            raise
        except Exception as error:  # zip, zlib and NumPy have one each
            raise ValueError(f"{path}: is no reference solution, or broken ({error}); remove it") from None
        return cls(path=str(path), **values)


def cloth_size(mesh):
    """The longest side of the box about the rest shape [m], the unit of :func:`position_error`."""
    return float(np.ptp(mesh.points, axis=0).max())


def position_error(points, others, mesh):
    """Root mean square over vertices and frames of the distance of points (F, n, 3) to others, over the size of the cloth."""
    return float(np.sqrt(((points - others) ** 2).sum(axis=-1).mean()) / cloth_size(mesh))


def strain_error(points, others, mesh):
    """99th percentile over edges of the mesh and frames of the difference of their strain l/L − 1, of points (F, n, 3)."""
    a, b = mesh.edges[mesh.edge_lengths > 0.0].T
    lengths = mesh.edge_lengths[mesh.edge_lengths > 0.0]
    first, other = (np.linalg.norm(x[:, b] - x[:, a], axis=-1) for x in (points, others))
    return float(np.percentile(np.abs(first - other) / lengths, 99))


def scene_digest(scene):
    """A hash of all of a scene that its motion depends on, whatever it is called and how long it goes on.

    Raises:
        ValueError: Something in it is no data.
    """
    digest = hashlib.sha256()
    mesh = scene.mesh
    facts = [mesh.points, mesh.triangles, mesh.edges, mesh.grid_shape, scene.vertex_masses, scene.positions, scene.velocities]
    for fact in (*facts, scene.terms, scene.pins, scene.gravity, float(scene.fps)):
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
