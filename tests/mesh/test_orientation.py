"""Triangles that wind against their neighbours, which pressure must not push the other way."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import warpcloth as wc
from warpcloth.mesh.orientation import turned_over

SPHERE = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)])
STRIP = np.array([(i, i + 1, i + 2) if i % 2 == 0 else (i + 1, i, i + 2) for i in range(8)])
MOEBIUS = np.append(STRIP, [(8, 9, 1), (1, 9, 0)], axis=0)
SURFACES = {
    "sheet": np.array(wc.Mesh.grid(5, 4).triangles),
    "sphere": SPHERE,
    "two pieces": np.concatenate([SPHERE, STRIP + 6]),
    "three leaves": np.concatenate([STRIP, [(0, 1, 10), (11, 1, 0)]]),
}
GIVEN = {"density": 0.15, "terms": [wc.Spring(stiffness=500.0)], "pins": "boundary", "gravity": (0, 0, 0), "duration": 1}


def against(triangles):
    """Pairs of triangles that run along a common edge in the same direction, at edges of two triangles."""
    sides = {}
    for t, corners in enumerate(triangles.tolist()):
        for k in range(3):
            sides.setdefault(frozenset((corners[k], corners[k - 1])), []).append((t, corners[k]))
    return [pair for pair in sides.values() if len(pair) == 2 and pair[0][1] == pair[1][1]]


@settings(deadline=None, derandomize=True, database=None)
@given(st.sampled_from([*SURFACES]), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_neighbours_wind_alike_after_the_fewer_are_turned_over(name, seed, share):
    triangles, random = SURFACES[name], np.random.default_rng(seed)
    mixed = np.where((random.random(len(triangles)) < share)[:, None], triangles[:, ::-1], triangles)
    mixed = random.permutation(mixed)
    turned = turned_over(mixed, np.arange(len(mixed)))
    assert not against(np.where(turned[:, None], mixed[:, ::-1], mixed))
    if name != "two pieces":
        assert turned.sum() <= len(turned) / 2
    some = np.flatnonzero(random.random(len(mixed)) < 0.3)  # these need not be neighbours of each other
    if name != "two pieces":
        assert turned_over(mixed, some).tolist() in (turned[some].tolist(), (~turned[some]).tolist())
        assert turned_over(mixed, some).sum() <= len(some) / 2


def test_pressure_on_parts_of_one_sheet_acts_from_one_side():
    mesh = wc.Mesh.grid(7, 7)
    halves = mesh.points[mesh.triangles].mean(axis=1)[:, 0] > 0.5
    mixed = wc.Mesh(mesh.points, np.where(halves[:, None], mesh.triangles[:, ::-1], mesh.triangles))
    load = wc.Pressure(vertices="x < 0.4 or x > 0.6", pressure=20.0)
    with pytest.warns(UserWarning, match="Pressure: 24 of 48 triangles wind against their neighbours"):
        scene = wc.Scene(mixed, loads=[load], **GIVEN)
        end = wc.simulate(scene, wc.Newton(substeps=2), frames=4).points[-1]
    assert end[:, 1].min() >= 0.0 and end[:, 1].max() > 1e-3


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_pressure_pushes_all_triangles_from_one_side(share):
    mesh = wc.Mesh.grid(5, 5)
    turned = np.arange(len(mesh.triangles)) >= len(mesh.triangles) * (1 - share)
    mixed = wc.Mesh(mesh.points, np.where(turned[:, None], mesh.triangles[:, ::-1], mesh.triangles))
    loads = [wc.Pressure(vertices="all", pressure=20.0)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        scenes = [wc.Scene(each, loads=loads, **GIVEN) for each in (mesh, mixed)]
    message = f"Pressure: {turned.sum()} of 32 triangles wind against their neighbours, the first of them triangle "
    message += str(turned.argmax())
    assert [str(each.message)[: len(message)] for each in caught] == [message] * (share > 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ends = [wc.simulate(scene, wc.Newton(substeps=2), frames=4).points[-1] for scene in scenes]
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-6)
    assert ends[0][:, 1].min() >= 0.0 and ends[0][:, 1].max() > 1e-3


def test_pressure_on_one_side_only_is_refused():
    assert not turned_over(np.concatenate([MOEBIUS, STRIP + 10]), np.arange(10, 18)).any()  # beside such a surface it is taken
    angle = np.pi * np.arange(10) / 5
    outwards = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    half = angle[:, None] / 2  # the edges of the strip turn by half a turn around the circle
    across = outwards * np.cos(half) + [0, 0, 1] * np.sin(half)
    points = outwards + np.where(np.arange(10) % 2, 0.3, -0.3)[:, None] * across
    scene = wc.Scene(wc.Mesh(points, MOEBIUS), **GIVEN | {"pins": None})
    message = "Pressure: triangle 0 belongs to a surface with one side, like a Möbius strip; pressure must act on a surface"
    with pytest.raises(ValueError, match=re.escape(message)):
        replace(scene, loads=[wc.Pressure(vertices="all", pressure=20.0)])
