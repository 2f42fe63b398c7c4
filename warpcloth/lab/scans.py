"""Synthetic captures: an animation as a scanner sees it, with other triangles in each frame, noise and holes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import number, numeric, whole
from ..base.types import FilePath
from ..mesh.captures import Capture, as_capture
from ..mesh.mesh import Mesh, Surface, areas_of
from ..scene.mesh_collider import nearest_points

_JITTER = 0.35  # of the spacing, to both sides of the middle of a cell
_FLAT = 1e-9  # largest height over the plane of a rest shape, relative to its size


def scan(
    mesh: Mesh,
    frames: ArrayLike,
    dt: float,
    spacing: float,
    noise: float = 0.0,
    holes: float = 0.0,
    hole: float = 0.1,
    seed: int = 0,
) -> Capture:
    """Returns a capture of an animation, with a mesh of its own in each frame.

    The vertices of a frame are the boundary vertices of the mesh, and a random point in each cell of a grid over its flat rest
    shape. A Delaunay triangulation there joins them. They move to the frame on the triangles of the mesh, and then by normal
    noise along each axis. Discs at random positions are cut out.

    Args:
        mesh: The mesh, flat at rest.
        frames: Its positions (F, n, 3) [m].
        dt: Time from each frame to the next [s].
        spacing: Size of a cell of the grid [m].
        noise: Standard deviation along each axis [m].
        holes: Minimum share of the area that is cut out.
        hole: Largest radius of a disc [m].
        seed: Seed of the random numbers.

    Raises:
        ValueError: The mesh is not flat at rest, or a value is not allowed.
    """
    number("spacing", spacing, above=0.0)
    number("noise", noise, least=0.0)
    number("holes", holes, least=0.0)
    if holes > 0.9:
        raise ValueError(f"holes is {holes:g}; it must be a share of the area of at most 0.9")
    number("hole", hole, above=0.0)
    whole("seed", seed, least=0)
    frames = numeric("frames", frames, "have shape (F, n, 3)")
    if frames.ndim != 3 or frames.shape[1:] != mesh.points.shape:
        raise ValueError(f"frames has shape {frames.shape}; it must be (F, {len(mesh.points)}, 3)")
    centred = mesh.points - mesh.points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    flat = centred @ axes.T
    if np.abs(flat[:, 2]).max() > _FLAT * np.abs(flat).max():
        raise ValueError("mesh is not flat at rest; a scan is triangulated in the plane of its rest shape")
    flat[:, 2] = 0.0
    random = np.random.default_rng(seed)
    return as_capture([_frame(mesh, flat, x, spacing, noise, holes, hole, random) for x in frames], dt=dt)


def _frame(mesh, flat, x, spacing, noise, holes, hole, random):
    from scipy.spatial import Delaunay

    low, high = flat.min(axis=0)[:2], flat.max(axis=0)[:2]
    cells = np.maximum(np.rint((high - low) / spacing).astype(int), 1)
    corners = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=2).reshape(-1, 2)
    inner = low + (corners + 0.5 + random.uniform(-_JITTER, _JITTER, corners.shape)) * (high - low) / cells
    inner = np.column_stack([inner, np.zeros(len(inner))])
    faces, weights = nearest_points(inner, flat, mesh.triangles)
    apart = np.einsum("kc,kci->ki", weights, flat[mesh.triangles[faces]]) - inner
    within = np.linalg.norm(apart, axis=1) <= 1e-6 * spacing
    border = mesh.boundary
    points = np.concatenate([flat[border], inner[within]])
    moved = np.einsum("kc,kci->ki", weights[within], x[mesh.triangles[faces[within]]])
    triangles = Delaunay(points[:, :2]).simplices
    middles = points[triangles].mean(axis=1)
    inside = nearest_points(middles, flat, mesh.triangles)
    away = np.einsum("kc,kci->ki", inside[1], flat[mesh.triangles[inside[0]]]) - middles
    areas = areas_of(points, triangles)
    kept = (np.linalg.norm(away, axis=1) <= 1e-6 * spacing) & (areas > 1e-3 * spacing**2)
    whole_area = areas[kept].sum()
    while areas[kept].sum() > (1.0 - holes) * whole_area:
        centre = middles[random.choice(np.flatnonzero(kept))]
        kept &= np.linalg.norm(middles - centre, axis=1) > hole * random.uniform(0.5, 1.0)
    positions = np.concatenate([x[border], moved])
    positions = positions + noise * random.normal(size=positions.shape)
    used, numbers = np.unique(triangles[kept], return_inverse=True)
    return Surface(positions[used], numbers.reshape(-1, 3))


def write_capture(capture: Capture, folder: FilePath, scale: float = 1.0) -> None:
    """Writes a capture as numbered .ply files into a folder, which is made.

    ``scale`` is the length of a unit of the files [m].
    """
    import trimesh

    number("scale", scale, above=0.0)
    Path(folder).mkdir(parents=True, exist_ok=True)
    for k, label in enumerate(capture.labels.tolist()):
        surface = capture[k]
        found = trimesh.Trimesh(surface.points / scale, surface.triangles, process=False)
        found.export(Path(folder) / f"{Path(folder).name}_{label:04d}.ply")
