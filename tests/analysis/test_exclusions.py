"""What cannot be measured is NaN and named, never a number; and what is asked for wrongly is refused in a sentence."""

import tracemalloc

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.analysis.measures import MEASURES, scalars
from warpcloth.mesh.mesh import Surface
from warpcloth.mesh.sequences import as_sequence

MATERIAL = wc.NeoHookeanMembrane(stiffness=1e3, poisson_ratio=0.3)
ALL = {
    "triangle": {"measures": "all", "directions": (1, 0, 0.3), "material": MATERIAL},
    "vertex": {"measures": "all", "neighbourhood": "1-ring"},
}
DT = 0.1


def sheet(kind=wc.Mesh):
    """A jittered 6 × 5 grid and vertex 30, which is in no triangle."""
    grid = wc.Mesh.grid(6, 5, pattern="alternating")
    points = grid.points + np.random.default_rng(0).uniform(-0.03, 0.03, grid.points.shape)
    return kind(np.concatenate([points, [[2.0, 0.0, 0.0]]]), grid.triangles)


def strained(mesh, frames=4):
    """Frames that stretch, bend and turn, without equal stretches anywhere."""
    X = mesh.points
    time = np.arange(frames)[:, None]
    angle = 0.1 * time + 0.2 * X[:, 0]
    x = 1.0 + 0.1 * time + 0.3 * X[:, 2]
    return np.stack([x * X[:, 0] * np.cos(angle), x * X[:, 0] * np.sin(angle), X[:, 2] * (0.8 - 0.02 * time)], axis=2)


def lost(values):
    """Elements with NaN in any number; all of their numbers must be NaN then."""
    nan = np.isnan(values.reshape(*values.shape[:2], -1))
    assert np.array_equal(nan.any(axis=2), nan.all(axis=2))
    return nan.any(axis=2)


def named(analysis, frame, kind):
    found = [e.elements for e in analysis.excluded if e.frame == frame and e.kind == kind]
    return set(np.concatenate([np.empty(0, int), *found]).tolist())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("on", ALL)
def test_clean_input_has_nothing_excluded_but_the_rates_of_the_first_frame(device, on, dtype):
    mesh = sheet()
    found = wc.analyze(strained(mesh), mesh, DT, device=device, dtype=dtype, **ALL[on])
    expected = np.zeros(31, dtype=bool)
    expected[30] = True
    for name, values in found.items():
        skipped = 1 if MEASURES[on][name].rate else 0
        assert lost(values)[:skipped].all()
        assert (lost(values)[skipped:] == (expected if on == "vertex" else False)).all(), name
        assert values.dtype == dtype and values.shape[1:] == (found.mesh.triangles.shape[0] if on == "triangle" else 31,
                                                               *MEASURES[on][name].shape)  # fmt: skip
    rates = [e for e in found.excluded if e.kind == "frame"]
    assert [(e.frame, "none before it" in str(e)) for e in rates] == [(0, True)]
    vertices = [e for e in found.excluded if e.kind != "frame"]
    assert [str(e) for e in vertices] == (
        [] if on == "triangle" else ["rest shape, vertex 30: is in no triangle with area, or its neighbours lie on a line"]
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("on", ALL)
def test_points_that_are_not_finite(device, on, bad):
    """All that touches them is left out in that frame, and its rates to the next; nothing else changes by a bit."""
    mesh = sheet()
    frames = strained(mesh)
    clean = wc.analyze(frames, mesh, DT, device=device, **ALL[on])
    frames[1, 8, 1] = bad
    found = wc.analyze(frames, mesh, DT, device=device, **ALL[on])
    touched = (mesh.triangles == 8).any(axis=1)
    if on == "vertex":
        touched = np.isin(np.arange(31), mesh.triangles[touched])
    for name, values in found.items():
        rows = lost(values) ^ lost(clean[name])
        expected = [1, 2] if MEASURES[on][name].rate else [1]
        assert np.array_equal(rows, np.isin(np.arange(4), expected)[:, None] & touched), name
        assert np.array_equal(values[~lost(values)], clean[name][~lost(values)])
    assert [str(e) for e in found.excluded if e.frame == 1] == ["frame 1, vertex 8: has no finite position"]


@pytest.mark.parametrize("reference", ["rest", 2])
def test_triangles_without_area_in_the_reference(device, reference):
    mesh = sheet(Surface)
    frames = strained(mesh)
    corners = mesh.triangles[7]
    points = mesh.points.copy()
    target = points if reference == "rest" else frames[2]
    target[corners[2]] = 0.3 * target[corners[0]] + 0.7 * target[corners[1]]
    mesh = Surface(points, mesh.triangles)
    found = wc.analyze(frames, mesh, DT, reference=reference, device=device, **ALL["triangle"])
    for values in found.values():
        assert lost(values)[:, 7].all()
    where = "rest shape" if reference == "rest" else "frame 2"
    assert [str(e) for e in found.excluded if "has no area" in str(e)] == [f"{where}, triangle 7: has no area"]


@pytest.mark.parametrize("options", [{"lag": 1}, {"reference": "previous"}, {"pairs": "0:1,0:2,2:3"}])
def test_a_reference_that_was_measured_before_is_named_too(device, options):
    mesh = sheet()
    frames = strained(mesh)
    a, b, c = mesh.triangles[7]
    frames[2, c] = 0.25 * frames[2, a] + 0.75 * frames[2, b]
    found = wc.analyze(frames, mesh, device=device, **options)
    row = found.pairs.index((2, 3))
    assert lost(found["stretch"])[row, 7]
    assert named(found, 2, "triangle") == set(np.flatnonzero(lost(found["stretch"])[row]).tolist())


@pytest.mark.parametrize("rates", ["forward", "logarithm"])
def test_rates_from_nothing_are_not_infinite(device, rates):
    """A triangle that opens from a point has no λ̇/λ."""
    mesh = sheet()
    frames = strained(mesh)
    frames[1, mesh.triangles[7]] = frames[1, mesh.triangles[7, 0]]
    options = {"measures": ("stretch_rate", "length_rate"), "directions": (1, 0, 0.3), "rates": rates}
    found = wc.analyze(frames, mesh, DT, device=device, **options)
    for values in found.values():
        assert not np.isinf(values).any() and lost(values)[2, 7]
        assert set(np.flatnonzero(lost(values)[2]).tolist()) <= named(found, 2, "triangle")


def test_a_triangle_crushed_to_a_line_keeps_what_has_a_meaning(device):
    """F, its stretches and area are exact; normals, and what needs them, are undefined there and named."""
    mesh = sheet()
    frames = strained(mesh)
    a, b, c = mesh.triangles[7]
    frames[2, c] = 0.25 * frames[2, a] + 0.75 * frames[2, b]
    found = wc.analyze(frames, mesh, DT, device=device, **ALL["triangle"])
    assert found["stretch"][2, 7, 1] <= 8 * np.finfo(float).eps * found["stretch"][2, 7, 0]
    assert np.isfinite(found["deformation_gradient"][2, 7]).all()
    assert found["area_ratio"][2, 7] <= 8 * np.finfo(float).eps * found["stretch"][2, 7, 0] ** 2
    for name in ("rotation", "rotation_angle"):  # more than one turns a triangle to a line
        assert np.array_equal(np.argwhere(lost(found[name])), [[2, 7]])
    for name in ("spin", "velocity_gradient", "rate_of_strain"):
        assert np.array_equal(np.argwhere(lost(found[name])[1:]), [[1, 7], [2, 7]])
    assert lost(found["cauchy_stress"])[2, 7] and not lost(found["first_piola_stress"])[2, 7]
    assert 7 in named(found, 2, "triangle") and 7 in named(found, 3, "triangle")


@pytest.mark.parametrize("onto", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], ids=["point", "line"])
def test_what_has_collapsed_has_no_rotation(device, onto):
    """None of it is the identity, and a thread of length 0 has no angle to another."""
    mesh = sheet()
    frames = strained(mesh)
    frames[2] = frames[2] * onto + 0.3
    around = wc.analyze(
        frames, mesh, device=device, measures=("rotation", "rotation_angle", "residual"), neighbourhood="1-ring"
    )
    names = ("rotation", "rotation_angle", "angle", "angle_rate", "stretch")
    found = wc.analyze(frames, mesh, DT, device=device, measures=names, directions=(1, 0, 0.3))
    for one in (around, found):
        for name in ("rotation", "rotation_angle"):
            assert lost(one[name])[2].all() and not lost(one[name])[1, :30].any()
        assert named(one, 2, one.on) | {30} >= set(range(one["rotation"].shape[1]))
    assert not lost(around["residual"])[2, :30].any() and not lost(found["stretch"]).any()
    for name in ("angle", "angle_rate"):
        assert lost(found[name])[2].all() == (onto[0] == 0.0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("size", [1e-12, 1e12])
@pytest.mark.parametrize("on", ALL)
def test_size_does_not_matter(device, on, size, dtype):
    mesh = sheet()
    options = {"neighbourhood": ALL[on].get("neighbourhood"), "dtype": dtype, "device": device}
    expected = wc.analyze(strained(mesh), mesh, measures=("stretch", "rotation_angle"), **options)
    mesh = Surface(size * mesh.points, mesh.triangles)
    found = wc.analyze(size * strained(sheet()), mesh, measures=("stretch", "rotation_angle"), **options)
    for name, values in found.items():
        # Nothing but the rounding of size itself and of sums differs; edges are of 0.1 to 2 in places to 2.
        np.testing.assert_allclose(values, expected[name], atol=200 * np.finfo(dtype).eps, rtol=0.0)


@pytest.mark.parametrize("on", ALL)
def test_areas_made_of_what_the_input_is_rounded_by(device, on):
    """Three points on a line are so in float32 too, though not to its last digit."""
    line = np.array([0.31, 0.47, 0.83])
    points = np.array([0.0 * line, line, 0.37 * line, [1.0, 0.0, 0.0]])
    points = (points + np.array([1.0, 2.0, 3.0])).astype(np.float32)
    mesh = Surface(points, [[0, 1, 2], [0, 1, 3]])
    options = {"triangle": {}, "vertex": {"neighbourhood": [[0, 1, 2], [0, 1, 3], [0, 1, 2], [0, 1, 3]]}}[on]
    found = wc.analyze(np.stack([points, points * np.float32([1, 2, 1])]), mesh, device=device, **options)
    expected = {"triangle": {0}, "vertex": {0, 2}}[on]
    assert np.array_equal(np.flatnonzero(lost(found["stretch"])[1]), sorted(expected))
    assert named(found, None, on) == expected


def test_half_a_turn_a_frame_has_no_rate(device):
    mesh = sheet()
    turned = mesh.points * [-1.0, 1.0, -1.0]
    for rates in ("midpoint", "logarithm"):
        found = wc.analyze(np.stack([mesh.points, turned]), mesh, DT, measures="rate_of_strain", rates=rates, device=device)
        assert lost(found["rate_of_strain"]).all()
        assert named(found, 1, "triangle") == set(range(len(mesh.triangles)))


def test_equal_stretches_have_no_principal_directions(device):
    mesh = sheet()
    names = ("rest_direction_rate", "direction_rate")
    found = wc.analyze(np.stack([mesh.points] * 2), mesh, DT, measures=names, device=device)
    excluded = [str(e) for e in found.excluded if e.frame == 1]
    assert len(excluded) == 1 and all(
        words in excluded[0] for words in (*names, "stretches that are equal", "40 triangles 0, 1")
    )


def test_missing_frames_are_named():
    mesh = sheet()
    sequence = as_sequence(mesh, strained(mesh), times=[0.0, 0.1, 0.3, 0.4])
    object.__setattr__(sequence, "labels", np.array([1, 2, 4, 5]))
    found = wc.analyze(sequence, mesh, reference="previous", measures="stretch_rate")
    assert [str(e) for e in found.excluded] == ["frame 3 is missing"]
    assert found.pairs == [(1, 2), (2, 4), (4, 5)]
    lagged = wc.analyze(sequence, mesh, lag=1)
    assert "frame 2 has no frame 1 later, for 3 is missing" in [str(e) for e in lagged.excluded]
    # The time between them is that of the sequence, not a frame's.
    twice = wc.analyze(sequence.read(slice(None))[[1, 2]], mesh, dt=0.2, reference="previous", measures="stretch_rate")
    np.testing.assert_allclose(found["stretch_rate"][1], twice["stretch_rate"][0], rtol=1e-12)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("on", ALL)
def test_directions_are_not_made_of_what_the_input_is_rounded_by(device, on, precision):
    """A rigid turn far from the origin, as a file of float32 has it too, has no principal directions; a stretched one has."""
    mesh = sheet()
    at = mesh.points + 100.0
    c, s = np.cos(0.3), np.sin(0.3)
    turned = np.array([at, at @ [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]]).astype(precision)
    options = {**ALL[on], "measures": ("rest_direction_rate", "direction_rate"), "device": device}
    options.pop("directions", None), options.pop("material", None)
    rigid = wc.analyze(turned, mesh, DT, **options)
    assert np.isnan(rigid["direction_rate"]).all() and np.isnan(rigid["rest_direction_rate"]).all()
    stretched = wc.analyze((turned * [1.05, 1.0, 1.0]).astype(precision), mesh, DT, **options)
    assert (np.isfinite(stretched["direction_rate"][1]).all(axis=1).mean()) > 0.9


def test_far_from_the_origin_float32_loses_nothing_but_what_the_input_has_lost(device):
    mesh = sheet()
    frames = strained(mesh) + 1000.0
    single, double = (wc.analyze(frames, mesh, device=device, dtype=dtype)["stretch"] for dtype in ("float32", "float64"))
    near = wc.analyze(strained(mesh), mesh, device=device, dtype="float32")["stretch"]
    exact = wc.analyze(strained(mesh), mesh, device=device, dtype="float64")["stretch"]
    assert np.abs(single - double).max() < 2.0 * np.abs(near - exact).max() + 1e-6


@pytest.mark.parametrize("on", ALL)
def test_each_measure_by_itself_is_the_same(device, on):
    """Nothing is computed that nobody asked for, and nobody misses it."""
    mesh = sheet()
    frames = strained(mesh, 3)
    options = {**ALL[on], "device": device}
    together = wc.analyze(frames, mesh, DT, **options)
    for name in MEASURES[on]:
        alone = wc.analyze(frames, mesh, DT, **(options | {"measures": name}))
        assert list(alone) == [name]
        assert np.array_equal(alone[name], together[name], equal_nan=True), name


def test_memory_does_not_grow_with_the_frames():
    mesh = wc.Mesh.grid(60, 60)
    still = mesh.points.astype(np.float32)

    class Frames:
        """Frames that are made when they are asked for."""

        def __init__(self, count):
            self.shape, self.dtype, self.times = (count, *still.shape), still.dtype, np.arange(count) * DT

        def exact(self, frame):
            return still * (1.0 + 0.01 * frame)

    def peak(count):
        analyzer = wc.Analyzer(Frames(count), mesh, measures=("stretch", "rate_of_strain"))
        tracemalloc.start()
        for sample in analyzer:
            assert sample.values["stretch"].shape == (len(mesh.triangles), 2)
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    peak(3)
    assert peak(60) < 1.2 * peak(6)


def test_scalars_have_one_number_an_element():
    rng = np.random.default_rng(0)
    for on in MEASURES.values():
        for measure in on.values():
            values = rng.normal(size=(5, *measure.shape))
            for name, numbers in scalars(measure, values).items():
                assert numbers.shape == (5,) and name.startswith(measure.name)
    matrix = MEASURES["triangle"]["spin"]
    assert np.allclose(scalars(matrix, np.ones((2, 3, 3)))["spin_norm"], 3.0)


EDGES = wc.Mesh.chain(4)
OPTIONS = [
    ({"measures": "strech"}, "measures: 'strech' must be one of deformation_gradient"),
    ({"measures": "residual"}, "it is one of each vertex"),
    ({"measures": "angle", "neighbourhood": "1-ring"}, "it is one of each triangle"),
    ({"measures": ()}, "measures: none"),
    ({"measures": [3]}, "measures: 3"),
    ({"measures": "energy_density"}, "'energy_density' needs material="),
    ({"measures": "length_rate"}, "'length_rate' needs directions="),
    ({"measures": "all", "material": wc.Spring(stiffness=1.0)}, "must be a membrane"),
    ({"measures": 3}, "measures is 3; it must be one or more of"),
    ({"directions": "uv"}, 'must be "st" or a vector'),
    ({"directions": "abc".split()}, 'it must be "st" or a vector'),
    ({"directions": "st"}, "the mesh has no texture coordinates"),
    ({"directions": (0, 0, 0)}, "vector 0"),
    ({"directions": (1, 0)}, "directions has shape"),
    ({"directions": (1, 0, 0), "neighbourhood": "1-ring"}, "directions: is for measures of triangles"),
    ({"material": MATERIAL, "neighbourhood": "1-ring"}, "material: is for measures of triangles"),
    ({"rates": "central"}, "rates is 'central'"),
    ({"dtype": "float16"}, "dtype is 'float16'"),
    ({"neighbourhood": "4-ring"}, "neighbourhood = '4-ring'"),
    ({"reference": 77}, "no frame 77"),
    ({"measures": "spin", "dt": 1e-320}, "dt: 9.99989e-321 s to frame 1, must be from"),
    ({"measures": "spin", "dt": 1e300, "dtype": "float32"}, "of which float32 has the reciprocal"),
]


@pytest.mark.parametrize("options, words", OPTIONS, ids=lambda value: "" if isinstance(value, str) else "-".join(value))
def test_refused(options, words):
    mesh = sheet()
    with pytest.raises(ValueError, match=words):
        wc.analyze(strained(mesh), mesh, **({"dt": DT} | options))


def test_measures_may_come_from_a_generator():
    mesh = sheet()
    assert list(wc.analyze(strained(mesh), mesh, measures=(name for name in ("stretch", "rotation")))) == [
        "stretch",
        "rotation",
    ]


def test_a_sequence_has_its_own_times():
    mesh = sheet()
    with pytest.raises(ValueError, match="dt: is for arrays and files"):
        wc.analyze(as_sequence(mesh, strained(mesh)), mesh, dt=DT, measures="spin")


def test_iterations_do_not_disturb_one_another():
    mesh = sheet()
    analyzer = wc.Analyzer(strained(mesh), mesh, pairs="0:1,0:2,3:1")
    expected = [sample.values["stretch"].copy() for sample in analyzer]
    rows = iter(analyzer)
    for stretch in expected:
        assert np.array_equal(next(rows).values["stretch"], stretch)
        assert len(list(analyzer)) == 3


def test_points_of_a_sample_are_those_of_the_next_rates():
    mesh = sheet()
    for sample in wc.Analyzer(strained(mesh), mesh, DT, measures="spin"):
        with pytest.raises(ValueError, match="read-only"):
            sample.points[:] = 0.0


def test_rates_need_times():
    mesh = sheet()
    with pytest.raises(ValueError, match="'spin' needs dt"):
        wc.analyze(strained(mesh), mesh, measures="spin")
    assert "spin" not in wc.analyze(strained(mesh), mesh, measures="all")


def test_edges_alone_have_no_strain():
    with pytest.raises(ValueError, match="triangles"):
        wc.analyze(EDGES.points[None], EDGES, DT)
