"""A state is all that a solver carries from step to step: put back it leads to the same bits, and a copy is a value."""

import numpy as np
import pytest

import warpcloth as wc
from support.rows import table
from support.setups import MAIN, RUNS, SOLVERS
from warpcloth.core.state import State
from warpcloth.core.status import Result

MESH = wc.Mesh.grid(5, 5, pattern="alternating")


def moved(offset=0.0):
    """A damped cloth out of balance, two corners led; far from the origin explicit steps keep the position residual."""
    mesh, pins = wc.Mesh(MESH.points + offset, MESH.triangles, grid_shape=MESH.grid_shape), [0, 4]
    keyframes = mesh.points[pins][None] + np.linspace(0.0, 0.2, 5)[:, None, None] * [0.0, 0.3, 1.0]
    start = mesh.points + np.random.default_rng(0).normal(scale=0.02, size=mesh.points.shape)
    start[pins] = mesh.points[pins]
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=100.0, damping=0.0 if offset else 0.05)]
    return wc.Scene(mesh, density=0.1, positions=start, terms=terms, pins=wc.Pins(pins, keyframes), fps=480.0, duration=0.025)


def steps(stepper, number):
    for _ in range(number):
        stepper.step()
    return stepper.state.copy()


CASES = [("explicit", 300.0, "float32"), *((name, 0.0, dtype) for name, dtype in RUNS)]


@table("name, offset, dtype", [("explicit", 300.0, "float32"), *((name, 0.0, "float32") for name in MAIN)], CASES)
def test_from_a_state_on_all_bits_are_the_same(name, offset, dtype, device):
    stepper = SOLVERS[name].bind(moved(offset).build(device=device, dtype=dtype))
    assert ("position residual" in stepper.state.arrays) == bool(offset)
    before = steps(stepper, 2)
    stored, after = before.to_host(), steps(stepper, 3)
    assert isinstance(before, State) and before == before.copy() and before != after
    stepper.state.assign(before)
    assert stepper.state == before and steps(stepper, 3) == after
    another = SOLVERS[name].bind(moved(offset).build(device=device, dtype=dtype))
    another.state.from_host(stored)
    assert another.state == before and steps(another, 3) == after


def test_states_of_a_shared_batch_go_with_the_whole(device):
    if device != "cpu":
        pytest.skip("threads are for the CPU")
    stepper = wc.XPBD(substeps=1, iterations=2, integrator="bdf2").bind(moved().build(copies=3, threads=2))
    before, after = steps(stepper, 2), steps(stepper, 2)
    stepper.state.assign(before)
    assert stepper.state == before and steps(stepper, 2) == after
    stepper.state.from_host(before.to_host())
    assert stepper.state == before and steps(stepper, 2) == after
    before.x.fill_(0.5)
    stepper.state.assign(before)
    assert stepper.state == before and (stepper.state.x.numpy() == 0.5).all()


def test_the_state_of_a_shared_batch_says_how_its_steps_ended(device):
    if device != "cpu":
        pytest.skip("threads are for the CPU")
    solver = wc.Newton(substeps=1, iterations=1, tolerance=1e-12)
    one, two = (solver.bind(moved().build(copies=3, threads=threads)) for threads in (1, 2))
    of_one, of_two = steps(one, 1), steps(two, 1)
    assert of_one.results == of_two.results == two.results == [Result.ITERATIONS_USED_UP] * 3
    assert np.array_equal(of_one.residual, of_two.residual) and np.array_equal(of_two.residual, two.residual)
    assert (of_two.residual > 0.0).all()


def test_another_scene_has_another_state(device):
    one, other = (wc.Newton(substeps=1, integrator=way).bind(moved().build(device=device)) for way in ("euler", "bdf2"))
    with pytest.raises(ValueError, match="another scene or solver"):
        one.state.from_host(other.state.to_host())
