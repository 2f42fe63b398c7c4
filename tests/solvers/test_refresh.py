"""Made-up terms that are set anew during a run: every solver refreshes them when they ask for it, and knows none of them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import table
from support.setups import MAIN, SOLVERS
from support.steps import after_frames
from warpcloth.terms.refresh import EVALUATION, STEP, Refresh

LIFT = 0.05
# Two vertices, without an edge that carries: one of two masses, and one pinned.
MESH = wc.Mesh(np.array([[0.3, 0.2, -0.1], [1.0, 0.0, 0.0]]), edges=[[0, 1]])


@wp.kernel
def follow(
    stencil: wp.array2d(dtype=wp.int32),
    x: wp.array(dtype=wp.vec3d),
    d: wp.array(dtype=wp.vec3d),
    lift: wp.float64,
    floor: wp.float64,
    # out
    target: wp.array(dtype=wp.vec3d),
):
    e = wp.tid()
    i = stencil[e, 0]
    at = x[i]
    if d:
        at += d[i]
    target[e] = wp.vec3d(at[0], floor * (at[1] + lift), at[2])


def launch(lift, floor, model, elements, moment):
    given = [elements.stencil, moment.x, moment.correction, lift, floor]
    model.launch(follow, elements.count, given, [elements.rest])


@dataclass(frozen=True, kw_only=True)
class Lift(wc.Attachment):
    """A spring to the position LIFT above that where a step begins."""

    def elements(self, mesh, positions):
        refresh = Refresh(STEP, lambda *given: launch(LIFT, 1.0, *given))
        return replace(super().elements(mesh, positions), refresh=refresh)


@dataclass(frozen=True, kw_only=True)
class Floor(wc.Attachment):
    """A spring to the nearest position of the plane y = 0, U = ½ky²: its target moves whenever the vertex does."""

    def elements(self, mesh, positions):
        refresh = Refresh(EVALUATION, lambda *given: launch(0.0, 0.0, *given))
        return replace(super().elements(mesh, positions), refresh=refresh)


def scene(term, positions=MESH.points, velocities=((0.4, 0.1, -0.3), (0.0, 0.0, 0.0))):
    fields = {"terms": [term], "pins": [1], "gravity": (0.0, 0.0, 0.0), "fps": 100.0, "duration": 0.1}
    return wc.Scene(MESH, masses=[2.0, 1.0], positions=positions, velocities=velocities, **fields)


def state_after(steps, solver, scene, device):
    stepper = after_frames(scene, solver, steps=steps, device=device, dtype="float64")
    return stepper.state.x.numpy().copy(), stepper.state.v.numpy().copy()


@table("name", ("explicit", "newton midpoint", "xpbd"), [*MAIN, "newton midpoint"])
def test_a_step_begins_with_what_is_refreshed(name, device):
    """Three steps are those of three scenes whose spring was declared where each begins."""
    solver = SOLVERS[name]
    x, v = state_after(3, solver, scene(Lift(vertices=[0], stiffness=50.0)), device)
    expected = MESH.points, np.array(scene(Lift(vertices=[0], stiffness=50.0)).velocities)
    for _ in range(3):
        target = expected[0][:1] + np.array([0.0, LIFT, 0.0])
        step = scene(wc.Attachment(vertices=[0], targets=target, stiffness=50.0), *expected)
        expected = state_after(1, solver, step, device)
    assert np.abs(x - expected[0]).max() < 1e-14 and np.abs(v - expected[1]).max() < 1e-12
    assert x[0, 1] > MESH.points[0, 1] + 0.03 * 0.1 + 1e-5, "the spring pulls"


@table("name", ("explicit", "newton", "xpbd"), [*MAIN, "newton midpoint", "newton bdf2"])
def test_an_evaluation_has_what_is_refreshed(name, device):
    """A target that follows the vertex sideways pulls it down alone, as far as one that is where it must be from the first."""
    solver, h = SOLVERS[name], 0.01
    x, v = state_after(5, solver, scene(Floor(vertices=[0], stiffness=50.0)), device)
    sideways = MESH.points[0] + 5 * h * np.array([0.4, 0.0, -0.3])
    assert np.abs(x[0, [0, 2]] - sideways[[0, 2]]).max() < 1e-14
    still = scene(
        wc.Attachment(vertices=[0], targets=[[0.3, 0.0, -0.1]], stiffness=50.0), velocities=[[0.0, 0.1, 0.0], [0.0] * 3]
    )
    expected, speed = state_after(5, solver, still, device)
    tolerance = 1e-9 if "constrained" not in name else 1e-4  # whose inner solve has a residual that the sideways motion changes
    assert abs(x[0, 1] - expected[0, 1]) < tolerance and abs(v[0, 1] - speed[0, 1]) < 100.0 * tolerance
    assert speed[0, 1] < 0.0, "the spring pulls"


@pytest.mark.parametrize("term", [Lift, Floor])
def test_what_is_refreshed_is_not_damped(term):
    """Both would set the rest state."""
    with pytest.raises(ValueError, match=f"{term.__name__} changes during a run and cannot be damped; leave its damping out"):
        scene(term(vertices=[0], stiffness=50.0, damping=0.1)).build()
