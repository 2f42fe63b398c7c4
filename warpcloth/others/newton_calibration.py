"""Stiffness of scenes in warpcloth and in Newton, by a strip under its weight and a cantilever."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..mesh.mesh import Mesh
from ..run.equilibrium import equilibrium
from ..scene.scene import Scene
from ..terms import NeoHookeanMembrane, QuadraticBending, Spring
from .newton_model import TAKES
from .newton_runs import NewtonPhysics, NewtonSteps

# Move between two peaks of the kinetic energy, relative to that since the start, below which cloth rests; most frames.
_STILL, _MOST = 1e-4, 3000


class Calibration(NamedTuple):
    """Displacements of the free end in Newton over those in warpcloth; 1 means equal stiffness.

    Attributes:
        springs: Of the lower half of a hanging strip of springs, along it, where the clamp does not hold its width.
        membrane: Of the same strip of a Neo-Hookean membrane with ν = 0.3; None if the solver has none.
        bending: Of a cantilever with Γ = 2, across it.
    """

    springs: float
    membrane: float | None
    bending: float


# Steps and iterations that converge to the rest shape of these samples, for the strips and for the cantilever.
_SETTINGS = {"semi-implicit": (10, 1), "xpbd": (4, 20), "vbd": (2, 20), "style3d": (2, 10)}
_FINER = {"semi-implicit": 5, "xpbd": 10, "vbd": 2, "style3d": 2}


def calibrate(method, device="cpu"):
    """Measures the :class:`Calibration` of a solver of Newton on three samples.

    Args:
        method: One of :data:`warpcloth.others.newton_model.METHODS`.
        device: A Warp device.
    """
    substeps, iterations = _SETTINGS[method]
    coarse, fine = (NewtonPhysics(method, factor * substeps, iterations) for factor in (1, _FINER[method]))
    springs = Spring(pairs=("structural", "shear"), stiffness=50.0)
    membrane = NeoHookeanMembrane(stiffness=50.0, poisson_ratio=0.3)
    return Calibration(
        _ratio(hanging_strip(springs), coarse, device, 2),
        _ratio(hanging_strip(membrane), coarse, device, 2) if isinstance(membrane, TAKES[method]) else None,
        _ratio(strip_cantilever(), fine, device, 1),
    )


def hanging_strip(term):
    """Returns a strip of 0.8 × 0.2 m along z, with one energy, that hangs from its first row."""
    return _strip([term], 1, (0.0, 0.0, 9.81), 400.0)


def strip_cantilever():
    """Returns the same strip with springs and quadratic bending, that is clamped at two rows and bends, Γ = ρgL³/D = 2."""
    bending = QuadraticBending(stiffness=0.1 * 9.81 * 0.7**3 / 2.0)
    return _strip([Spring(pairs=("structural", "shear"), stiffness=100.0), bending], 2, (0.0, -9.81, 0.0), 60.0)


def _strip(terms, rows, gravity, fps):
    mesh = Mesh.grid(3, 9, size=(0.2, 0.8), pattern="alternating")
    pins = np.flatnonzero(mesh.points[:, 2] < (rows - 0.5) * 0.1)
    return Scene(mesh, density=0.1, terms=terms, pins=pins, gravity=gravity, fps=fps, name="a strip")


def newton_rest(scene, solver, device="cpu"):
    """Returns the shape in which a scene rests by a solver of Newton, (n, 3) [m].

    Velocities are set to 0 whenever the kinetic energy falls from one frame to the next, until peaks no longer move the cloth.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: The :class:`warpcloth.others.newton_runs.NewtonPhysics`.
        device: A Warp device.

    Raises:
        ValueError: It does not come to rest, or the solver does not take the scene.
    """
    masses = scene.vertex_masses[:, None]
    with wp.ScopedDevice(device):
        steps = NewtonSteps(scene, solver, device)
        start = peak = steps.points().astype(np.float64)
        energy = 0.0
        for _ in range(_MOST):
            steps.frame()
            before, energy = energy, float((masses * steps.velocities().astype(np.float64) ** 2).sum())
            if not np.isfinite(energy):
                break
            if energy < before:
                last, peak, energy = peak, steps.points().astype(np.float64), 0.0
                steps.states[0].particle_qd.zero_()
                if np.abs(peak - last).max() <= _STILL * np.abs(peak - start).max():
                    return peak
    raise ValueError(f"{scene.name} does not come to rest by Newton's {solver.method} solver within {_MOST} frames")


def _ratio(scene, solver, device, axis):
    """Returns how far the free end moves along an axis in Newton, over that of the equilibrium in warpcloth.

    Along a strip, moves are relative to its middle.
    """
    rest = equilibrium(scene)
    if not rest.status.ok or not rest.stable:
        raise ValueError(f"{scene.name} has no stable equilibrium: {rest.status.message}")
    start = scene.mesh.points
    longest = int(np.ptp(start, axis=0).argmax())
    along = start[:, longest]
    middle = np.isclose(along, 0.5 * along.max()) if axis == longest else scene.pins.vertices
    moves = [(points - start)[:, axis] for points in (newton_rest(scene, solver, device), rest.points)]
    other, own = (move[np.isclose(along, along.max())].mean() - move[middle].mean() for move in moves)
    return float(other / own)
