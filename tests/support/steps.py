"""One step of a solver from a state in motion, and what it minimises; a run that is resumed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.meshes import PAIR
from support.scenes import scene
from warpcloth.core.energy import Energy
from warpcloth.core.gradient import Gradient
from warpcloth.core.sums import Sums
from warpcloth.solvers.projective_dynamics import ACCELERATIONS

HANGING_PAIR = wc.Mesh(np.array([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), edges=[[0, 1]])


def spring(x=(1.0, 0.0, 0.0), k=100.0, m=1.0, mesh=PAIR, **fields):
    """A spring of length 1 along the x axis from a pin at the origin to a mass at x, by default without gravity."""
    given = {"masses": [m, m], "positions": [(0.0, 0.0, 0.0), x], "pins": [0], "gravity": (0.0, 0.0, 0.0)}
    return wc.Scene(mesh, terms=[wc.Spring(stiffness=k)], **given | fields)


def hanging_mass(k, m, stretched):
    return spring((0.0, -1.0 - stretched, 0.0), k, m, HANGING_PAIR, gravity=(0.0, -9.81, 0.0), fps=60.0)


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


def after_frames(declared, solver, frames=0, steps=0, **build):
    """A stepper after some frames, and steps more."""
    stepper = solver.bind(declared.build(**build))
    for _ in range(frames):
        stepper.frame()
    for _ in range(steps):
        stepper.step()
    return stepper


def after_steps(declared, solver, device, dtype="float64", steps=1, **build):
    """x after some steps [m], and the stepper."""
    stepper = after_frames(declared, solver, steps=steps, device=device, dtype=dtype, **build)
    return stepper.state.x.numpy().astype(np.float64), stepper


def newton_step(declared, device):
    return after_steps(declared, wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"), device)[0]


def objective(declared, x, device):
    """1/(2h²)‖x − x̃‖²_M + U(x) [J] for a step of a frame."""
    model = declared.build(device=device, dtype="float64")
    U, h = wp.zeros(1, dtype=wp.float64, device=device), 1 / declared.fps
    Energy(model, Sums(model)).add(model.array(x, model.vec3), U)
    predicted = declared.positions + h * declared.velocities + h**2 * declared.gravity
    moved = np.where(model.inverse_mass.numpy()[:, None] > 0.0, x - predicted, 0.0)
    return 0.5 / h**2 * float((declared.vertex_masses[:, None] * moved**2).sum()) + float(U.numpy()[0])


def strains(declared, x):
    """Of the springs of a scene."""
    pairs = declared.terms[0].stencil(declared.mesh)
    rest = declared.terms[0].rest(declared.mesh, None, pairs)[:, 0]
    return np.linalg.norm(x[pairs[:, 1]] - x[pairs[:, 0]], axis=1) / rest - 1.0


def unbalanced(declared, x, device):
    """‖(x − x̃)/h² + ∇U/m‖ over g after a step of implicit Euler of a frame, the largest of any vertex that moves."""
    model, h = declared.build(device=device, dtype="float64"), 1.0 / declared.fps
    gradient, w = model.vectors(), model.inverse_mass.numpy()[:, None]
    Gradient(model).add(model.array(x, model.vec3), gradient)
    predicted = declared.positions + h * declared.velocities + h**2 * declared.gravity
    return np.linalg.norm(np.where(w > 0.0, (x - predicted) / h**2 + w * gradient.numpy(), 0.0), axis=1).max() / 9.81


def stopped_and_resumed(frame, declared, solver, **run):
    """The animation of a run with an output that stops at a frame and is resumed."""

    def stop(now, _frames):
        if now == frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wc.simulate(declared, solver, progress=stop, **run)
    return wc.simulate(declared, solver, resume=True, **run)
