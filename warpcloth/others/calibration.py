"""Samples that compare stiffness in warpcloth and another simulator: hanging strips and a cantilever."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..mesh.mesh import Mesh
from ..run.equilibrium import equilibrium
from ..scene.scene import Scene
from ..terms import QuadraticBending, Spring

# Move between two peaks of the kinetic energy, relative to that since the start, below which cloth rests; most frames.
_STILL, _MAX_FRAMES = 1e-4, 3000


class Calibration(NamedTuple):
    """Displacements of the free end in another simulator over those in warpcloth; 1 means equal stiffness.

    Attributes:
        springs: Of the lower half of a hanging strip of springs, along it.
        membrane: Of that strip of a membrane, or None.
        bending: Of a cantilever with Γ = 2, across it.
    """

    springs: float
    membrane: float | None
    bending: float


def calibrated(coarse, fine, membrane, device="cpu"):
    """Measures the :class:`Calibration` of a solver, with settings ``coarse`` that converge to the rest shape of strips, one of
    ``membrane`` or None, and ``fine`` to that of the cantilever.
    """
    return Calibration(
        _ratio(hanging_strip(Spring(pairs=("structural", "shear"), stiffness=50.0)), coarse, device, 2),
        None if membrane is None else _ratio(hanging_strip(membrane), coarse, device, 2),
        _ratio(strip_cantilever(), fine, device, 1),
    )


def hanging_strip(term):
    """Returns a strip of 0.8 × 0.2 m along z that hangs from its first row."""
    return _strip([term], 1, (0.0, 0.0, 9.81), 400.0)


def strip_cantilever():
    """Returns that strip with springs and quadratic bending, clamped at two rows, Γ = ρgL³/D = 2."""
    bending = QuadraticBending(stiffness=0.1 * 9.81 * 0.7**3 / 2.0)
    return _strip([Spring(pairs=("structural", "shear"), stiffness=100.0), bending], 2, (0.0, -9.81, 0.0), 60.0)


def _strip(terms, rows, gravity, fps):
    mesh = Mesh.grid(3, 9, size=(0.2, 0.8), pattern="alternating")
    pins = np.flatnonzero(mesh.points[:, 2] < (rows - 0.5) * 0.1)
    return Scene(mesh, density=0.1, terms=terms, pins=pins, gravity=gravity, fps=fps, name="a strip")


def rest_of(scene, record, device="cpu"):
    """Returns the rest shape of a scene by another simulator, (n, 3) float64 [m].

    Velocities become 0 whenever the kinetic energy falls, until peaks no longer move the cloth; ValueError if it does not rest.
    """
    masses = scene.vertex_masses[:, None]
    with wp.ScopedDevice(device):
        steps = record.bind(scene, device)
        start = peak = steps.points().astype(np.float64)
        energy = 0.0
        for _ in range(_MAX_FRAMES):
            steps.frame()
            before, energy = energy, float((masses * steps.velocities().astype(np.float64) ** 2).sum())
            if not np.isfinite(energy):
                break
            if energy < before:
                last, peak, energy = peak, steps.points().astype(np.float64), 0.0
                steps.stop()
                if np.abs(peak - last).max() <= _STILL * np.abs(peak - start).max():
                    return peak
    raise ValueError(f"{scene.name} does not come to rest by {record} within {_MAX_FRAMES} frames")


def _ratio(scene, record, device, axis):
    """Returns how far the free end moves along an axis, over that in warpcloth; along a strip relative to its middle."""
    rest = equilibrium(scene)
    if not rest.status.ok or not rest.stable:
        raise ValueError(f"{scene.name} has no stable equilibrium: {rest.status.message}")
    start = scene.mesh.points
    longest = int(np.ptp(start, axis=0).argmax())
    along = start[:, longest]
    middle = np.isclose(along, 0.5 * along.max()) if axis == longest else scene.pins.vertices
    moves = [(points - start)[:, axis] for points in (rest_of(scene, record, device), rest.points)]
    other, own = (move[np.isclose(along, along.max())].mean() - move[middle].mean() for move in moves)
    return float(other / own)
