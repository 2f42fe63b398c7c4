"""The loop of the methods that iterate: how copies end, each by itself; and the acceleration that residuals are relative to."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpcloth as wc
from warpcloth.core.status import Result
from warpcloth.numerics.iterate import ResidualScale, iterate

NAN, INF = np.nan, np.inf
STUCK = 0.3  # of which the method below says so
# Residuals of a copy, one a call; how it ends, with which of them, and after how many iterations.
COPIES = {
    "converges": ([1.0, 0.5, 0.1, 0.05, 7.0], Result.CONVERGED, 0.1, 2),  # at the tolerance; what comes after is not its own
    "has converged": ([0.1, 7.0], Result.CONVERGED, 0.1, 0),
    "diverges": ([1.0, NAN, 0.0], Result.DIVERGED, NAN, 1),
    "overflows": ([1.0, 2.0, INF, 0.0], Result.DIVERGED, INF, 2),
    "sticks": ([1.0, STUCK, 0.0], Result.STALLED, STUCK, 1),
    "takes too long": ([1.0, 0.9, 0.8, 0.7, 0.6], Result.ITERATIONS_USED_UP, 0.6, 4),
}


class Scripted:
    """A method whose copies have the residuals that are written down."""

    def __init__(self, names):
        self.rows, self.active = [COPIES[name][0] for name in names], []
        self.model, self.calls = SimpleNamespace(copies=len(names)), 0

    def start(self):
        self.calls = 0

    def measure(self):
        now = np.array([row[min(self.calls, len(row) - 1)] for row in self.rows])
        return now, {Result.STALLED: now == STUCK}

    def iterate(self, active):
        self.active.append(active.copy())
        self.calls += 1


@pytest.mark.parametrize("names", [*([name] for name in COPIES), list(COPIES)], ids=lambda names: " and ".join(names)[:20])
def test_each_copy_ends_in_its_own_way(names):
    method = Scripted(names)
    found = iterate(method, 0.1, 4)
    _, results, residuals, counts = zip(*(COPIES[name] for name in names), strict=True)
    assert found.results == list(results)
    np.testing.assert_array_equal(found.residual, residuals)
    assert found.iterations == max(counts) and len(method.active) == found.iterations
    for done, active in enumerate(method.active):
        assert active.tolist() == [count > done for count in counts], "who has ended takes no part"


GRID = wc.Mesh.grid(5, 4, size=(0.8, 0.6))
SPRING = [wc.Spring(stiffness=1e3)]
NONE = (0.0, 0.0, 0.0)
PER_MASS = {"loads": "times loads per mass", "wind": "times wind per mass"}
# What acts on a sheet of 0.8 m × 0.6 m and 0.5 kg/m², the scale in m/s² and its unit. A vertex has 0.5 kg of 1/12 of the area.
DRIVEN = {
    "gravity": ({"gravity": (3.0, 0.0, 4.0), "pins": "corners"}, 5.0, "times gravity"),
    "pressure": ({"loads": [wc.Pressure(vertices="all", pressure=-6.0)]}, 12.0, PER_MASS["loads"]),
    "pressure that stops": (
        {"loads": [wc.Pressure(vertices="all", keyframes=[0.0, 1.5, 3.0, 0.0])]},
        6.0,
        PER_MASS["loads"],
    ),
    "force at a vertex": ({"loads": [wc.Force(vertices=[0], force=(0.0, 0.48, 0.36))]}, 2.5, PER_MASS["loads"]),
    "force at a pin": ({"loads": [wc.Force(vertices=[0], force=(0.0, 9.0, 0.0))], "pins": [0]}, None, None),
    "weight that is carried": (
        {"gravity": (0.0, -4.0, 0.0), "loads": [wc.Pressure(vertices="all", pressure=2.0)]},
        8.0,
        "times gravity + loads per mass",
    ),
    # ½·1.2·1.2·10² = 72 Pa
    "wind": ({"air": wc.Air(wind=(6.0, 0.0, 8.0))}, 144.0, PER_MASS["wind"]),
    "gusts": ({"air": wc.Air(keyframes=[NONE, (0.0, 10.0, 0.0), NONE])}, 144.0, PER_MASS["wind"]),
    "still air": ({"air": wc.Air()}, None, None),
    "nothing": ({}, None, None),
    "a pin that moves": ({"pins": wc.Pins([0], np.array([GRID.points[[0]], GRID.points[[0]] + 1.0]))}, None, None),
}


@pytest.mark.parametrize("name", DRIVEN)
def test_the_scale_of_residuals(name, device):
    """g + (F + W)/M, else R/T²: in both precisions, turned, with other numbers of the vertices, and of each copy."""
    # It has the same bits if lengths grow 4 times with times twice as long, which leaves accelerations, or if masses double.
    fields, expected, unit = DRIVEN[name]
    fields, radius = {"gravity": NONE, "duration": 2.0, **fields}, 0.5
    unit = unit or "times the radius of the cloth over the square of the duration"

    def scale(dtype="float64", copies=1, order=None, mesh=GRID, density=0.5, **changed):
        scene = wc.Scene(mesh, density=density, terms=SPRING, **{**fields, **changed})
        return ResidualScale(scene.build(device=device, dtype=dtype, copies=copies, order=order))

    first = scale()
    # Of the pressure, a vertex of the boundary bears as much of the force as it has of the mass.
    assert first.acceleration[0] == pytest.approx(radius / 2.0**2 if expected is None else expected, rel=1e-12)
    assert first.units == [unit]
    assert scale(dtype="float32").acceleration[0] == pytest.approx(first.acceleration[0], rel=1e-6)
    shuffled = scale(copies=3, order=np.random.default_rng(0).permutation(20))
    np.testing.assert_allclose(shuffled.acceleration, np.repeat(first.acceleration, 3), rtol=1e-14)
    assert shuffled.units == 3 * [unit]
    if "pins" not in fields:
        turned = wc.Mesh(GRID.points @ Rotation.from_rotvec([1.0, 2.0, 3.0]).as_matrix().T, GRID.triangles)
        assert scale(mesh=turned).acceleration[0] == pytest.approx(first.acceleration[0], rel=1e-14)
    if "pins" not in fields and "air" not in fields:
        large, loads = wc.Mesh(4.0 * GRID.points, GRID.triangles), fields.get("loads", [])
        same = {"fps": 30.0, "duration": 4.0, "loads": [scaled(load, lengths=4.0) for load in loads]}
        assert scale(mesh=large, density=0.5 / 16.0, **same).acceleration == first.acceleration
        heavy = {"density": 1.0, "loads": [scaled(load, masses=2.0) for load in loads]}
        assert scale(**heavy).acceleration == first.acceleration


def scaled(load, masses=1.0, lengths=1.0):
    """A load that gives larger masses the same accelerations, on cloth of another size."""
    if isinstance(load, wc.Force):
        return replace(load, force=masses * np.array(load.force))
    field, factor = "pressure" if load.keyframes is None else "keyframes", masses / lengths**2
    return replace(load, **{field: factor * np.array(getattr(load, field))})
