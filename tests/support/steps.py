"""One step of a solver from a state in motion, and what it minimises; a run that is resumed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.scenes import scene
from warpcloth.core.energy import Energy
from warpcloth.core.sums import Sums
from warpcloth.solvers.projective_dynamics import ACCELERATIONS

HANGING_PAIR = wc.Mesh(np.array([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), edges=[[0, 1]])


def hanging_mass(k, m, stretched, fps=60.0):
    return wc.Scene(
        HANGING_PAIR,
        masses=[m, m],
        positions=[[0.0, 0.0, 0.0], [0.0, -1.0 - stretched, 0.0]],
        terms=[wc.Spring(stiffness=k)],
        pins=[0],
        fps=fps,
    )


@cache
def swinging(n):
    """``hanging`` at 0.3 s."""
    declared = scene("hanging", n=n)
    past = wc.simulate(declared, wc.Newton(substeps=16, tolerance=1e-6), dtype="float64", frames=18)
    return replace(declared, positions=past.points[-1], velocities=past.velocities[-1])


METHODS = {
    **{name: wc.ProjectiveDynamics(substeps=1, acceleration=name) for name in ACCELERATIONS},
    "matrix-free": wc.ProjectiveDynamics(substeps=1, acceleration="chebyshev", linear="jacobi"),
    "matrix-free l-bfgs": wc.ProjectiveDynamics(substeps=1, acceleration="l-bfgs", linear="jacobi"),
    "admm": wc.ADMM(substeps=1),
    "admm, light": wc.ADMM(substeps=1, weight=0.1),
}


def after_one_step(declared, solver, device, dtype="float64", **build):
    """x after a step [m], and the stepper."""
    stepper = solver.bind(declared.build(device=device, dtype=dtype, **build))
    stepper.step()
    return stepper.state.x.numpy().astype(np.float64), stepper


def newton_step(declared, device):
    return after_one_step(declared, wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"), device)[0]


def objective(declared, x, device):
    """1/(2h²)‖x − x̃‖²_M + U(x) [J] for a step of a frame."""
    model = declared.build(device=device, dtype="float64")
    U, h = wp.zeros(1, dtype=wp.float64, device=device), 1 / declared.fps
    Energy(model, Sums(model)).add(model.array(x, model.vec3), U)
    predicted = declared.positions + h * declared.velocities + h**2 * declared.gravity
    moved = np.where(model.inverse_mass.numpy()[:, None] > 0.0, x - predicted, 0.0)
    return 0.5 / h**2 * float((declared.vertex_masses[:, None] * moved**2).sum()) + float(U.numpy()[0])


def stopped_and_resumed(frame, declared, solver, **run):
    """The animation of a run with an output that stops at a frame and is resumed."""

    def stop(now, _frames):
        if now == frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wc.simulate(declared, solver, progress=stop, **run)
    return wc.simulate(declared, solver, resume=True, **run)
