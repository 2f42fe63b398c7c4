"""Comparisons of animations against closed forms and a search that tries every triangle."""

import csv
import json

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.mesh.distances import surface_distances
from warpcloth.mesh.mesh import Surface
from warpcloth.mesh.sequences import Sequence, as_sequence
from warpcloth.usd import AnimationWriter

UP = np.array([0.0, 1.0, 0.0])
EPS = np.finfo(np.float64).eps
EPS32 = np.finfo(np.float32).eps
GRID = wc.Mesh.grid(9, 7, size=(1.0, 0.8), pattern="alternating")
DISTANCES = ("rms", "largest", "surface_mean", "surface_rms", "surface_largest", "hausdorff", "hausdorff_bound")
STRETCHES = ("stretch_rms", "stretch_largest")


def waves(points, frames=3):
    """A sheet that swells and moves, (frames, n, 3)."""
    time = np.arange(frames)[:, None, None]
    return points + 0.1 * np.sin(5.0 * points[:, [2, 0, 1]] + time) + 0.2 * UP * time


def still(points, mesh=GRID):
    """A sequence of one frame."""
    return as_sequence(mesh, points[None], times=[0.0])


def upright(points, axis):
    """Points of a world that is Y up, as one has them that is Z up, or as they are."""
    return points if axis == "Y" else points[..., [0, 2, 1]] * [1.0, -1.0, 1.0]


@pytest.mark.parametrize(("one", "other"), [("Y", "Z"), ("Z", "Y"), ("Z", "Z"), ("Y", None), (None, "Z")])
def test_stages_of_two_up_axes_are_compared_upright(tmp_path, capsys, one, other):
    frames, sequences = waves(GRID.points), []
    for name, axis in (("a", one), ("b", other)):
        # What does not say its axis is taken as the other.
        own = [upright(points, axis or one or other) for points in (GRID.points, frames)]
        mesh = wc.Mesh(own[0], GRID.triangles, up_axis=axis)
        sequences.append(as_sequence(mesh, own[1], dt=1 / 24))
        if axis is not None:
            writer = AnimationWriter(tmp_path / f"{name}.usda", mesh, fps=24.0)
            for points in own[1]:
                writer.append(points, np.zeros_like(points))
            writer.close()
    found = wc.compare(*sequences)
    assert found.up_axes == (one, other) and not any(getattr(found, name).any() for name in DISTANCES)
    assert found.stretch_largest.max() < 100 * EPS
    if None in (one, other):
        return
    assert main(["compare", str(tmp_path / "a.usda"), str(tmp_path / "b.usda")]) == 0
    out = capsys.readouterr().out
    said = f"A is {one} up and B {other} up; B was turned to {one} up"
    assert (said in out) == (one != other)
    # Taken as they are they are apart where a turn moves them.
    as_they_are = wc.compare(*sequences, up_axis="Y")
    assert (as_they_are.largest.max() > 0.1) == (one != other) and as_they_are.up_axes == ("Y", "Y")
    command = ["compare", str(tmp_path / "a.usda"), str(tmp_path / "b.usda"), "--json"]
    assert main([*command, "--up-axis-a", one, "--up-axis-b", other]) == 0
    assert json.loads(capsys.readouterr().out)["largest"]["value"] == 0.0
    assert main([*command, "--up-axis", "Z"]) == 0
    assert (json.loads(capsys.readouterr().out)["largest"]["value"] > 0.1) == (one != other)


def test_an_axis_that_is_none_is_refused():
    with pytest.raises(ValueError, match="up_axis_b is 'X'; it must be one of 'Y', 'Z'"):
        wc.compare(still(GRID.points), still(GRID.points), up_axis_b="X")
    with pytest.raises(ValueError, match="up_axis is 'X'; it must be one of 'Y', 'Z'"):
        wc.Mesh(GRID.points, GRID.triangles, up_axis="X")


# --- with the same triangles


@pytest.mark.parametrize("permuted", [False, True])
def test_what_is_identical_is_0_apart(device, permuted):
    frames = waves(GRID.points)
    # Triangles in another order are another topology, and the same surface.
    mesh = wc.Mesh(GRID.points, GRID.triangles[::-1]) if permuted else GRID
    found = wc.compare((GRID, frames), (mesh, frames.copy()), fps=24, device=device)
    assert found.same_topology != permuted
    names = DISTANCES[2:6] if permuted else DISTANCES + STRETCHES
    assert all(len(getattr(found, name)) == 3 for name in names)
    largest = max(getattr(found, name).max() for name in names)
    assert largest <= (4 * EPS32 if permuted else 0.0)
    assert found.excluded == ([], []) and not any(map(len, found.unmatched))
    assert np.array_equal(found.times, np.arange(3) / 24) and np.array_equal(found.frames, np.arange(3).repeat(2).reshape(3, 2))


def test_layers_that_float32_cannot_tell_apart_are_0_from_themselves(device):
    mesh, random = wc.Mesh.grid(30, 30), np.random.default_rng(0)
    folded = mesh.points * [2.0, 0.0, 1.0] + 1e-9 * random.normal(size=mesh.points.shape)
    folded[:, 0] = np.abs(folded[:, 0] - 1.0)
    folded = folded @ np.linalg.qr(random.normal(size=(3, 3)))[0]
    assert surface_distances(folded, folded, mesh.triangles, device).any()
    found = wc.compare(still(folded, mesh), still(folded, mesh), device=device)
    assert not any(getattr(found, name).any() for name in DISTANCES)


@pytest.mark.parametrize("origin", [0.0, 1e4])
def test_a_translation_is_its_length_apart(device, origin):
    d = np.array([0.3, -0.4, 1.2])
    a = waves(GRID.points) + origin
    found = wc.compare((GRID, a), (GRID, a + d), fps=24, device=device)
    # Coordinates are rounded, three of each point, in a and in a + d.
    tolerance = 4 * EPS * (origin + 2.0)
    assert np.abs(found.rms - 1.3).max() < tolerance and np.abs(found.largest - 1.3).max() < tolerance
    assert np.array_equal(found.hausdorff_bound, found.largest) and (found.hausdorff <= found.largest).all()
    # Corners of one edge have that rounding, by its length of a tenth.
    assert found.stretch_largest.max() < 20 * tolerance
    assert np.allclose(found.sizes, np.linalg.norm(np.ptp(a, axis=1), axis=1), rtol=EPS)
    assert np.allclose(found.relative_rms, found.rms / found.sizes, rtol=EPS)


def test_a_sheet_off_its_plane_is_that_height_apart_both_ways(device):
    found = wc.compare(still(GRID.points), still(GRID.points + 0.25 * UP), device=device)
    for name in DISTANCES:
        assert np.abs(getattr(found, name) - 0.25).max() <= 2 * EPS, name


def test_a_scaling_moves_each_vertex_by_its_radius(device):
    s, radii = 1.5, np.linalg.norm(GRID.points, axis=1)
    found = wc.compare(still(GRID.points), still(s * GRID.points), device=device)
    assert np.isclose(found.rms[0], (s - 1.0) * np.sqrt(np.mean(radii**2)), rtol=8 * EPS)
    assert np.isclose(found.largest[0], (s - 1.0) * radii.max(), rtol=8 * EPS) and found.largest_vertex[0] == radii.argmax()
    assert np.allclose(found.stretch_rms, s - 1.0, atol=50 * EPS) and np.allclose(found.stretch_largest, s - 1.0, atol=50 * EPS)


def test_each_has_its_own_rest_shape(device):
    larger = wc.Mesh(1.5 * GRID.points, GRID.triangles)
    found = wc.compare(still(GRID.points), still(larger.points, larger), device=device)
    assert found.same_topology and found.rms[0] > 0.1 and found.stretch_largest.max() < 50 * EPS


def test_stretches_of_a_shear(device):
    gamma = 0.7
    sheared = GRID.points + gamma * GRID.points[:, 2:] * [1.0, 0.0, 0.0]
    found = wc.compare(still(GRID.points), still(sheared), device=device)
    root = np.sqrt(1.0 + gamma**2 / 4.0)  # λ = √(1 + γ²/4) ± γ/2
    expected = [root + gamma / 2.0 - 1.0, 1.0 - (root - gamma / 2.0)]
    assert np.allclose(found.stretch_rms, expected, atol=50 * EPS)
    assert np.allclose(found.stretch_largest, expected, atol=50 * EPS)


def test_one_triangle_that_differs_is_in_the_mean_and_is_the_largest(device):
    # A corner of a grid with one diagonal belongs to one triangle.
    mesh = wc.Mesh.grid(5, 5, pattern="diagonal")
    corner = np.flatnonzero(np.bincount(mesh.triangles.ravel()) == 1)[0]
    moved = mesh.points.copy()
    moved[corner] += 0.1 * (moved[corner] - [0.5, 0.0, 0.5])
    found = wc.compare(still(mesh.points, mesh), still(moved, mesh), device=device)
    assert np.allclose(found.stretch_rms, found.stretch_largest / np.sqrt(len(mesh.triangles)), rtol=1e-6)
    assert found.largest_vertex[0] == corner
    assert np.isclose(found.rms[0], found.largest[0] / np.sqrt(len(mesh.points)), rtol=8 * EPS)


# --- surfaces


def sagitta(mesh):
    """How far below the sphere that its vertices lie on a triangle goes, at most."""
    a, b, c = (np.asarray(mesh.vertices)[corner] for corner in np.asarray(mesh.faces).T)
    sides = [np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    circumradii = np.prod(sides, axis=0) / (2.0 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    radius = np.linalg.norm(a[0])
    return (radius - np.sqrt(radius**2 - circumradii**2)).max()


@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_concentric_spheres_are_apart_by_their_radii_within_the_sagitta(device, gap):
    outer, inner = trimesh.creation.uv_sphere(1.0 + gap, (20, 30)), trimesh.creation.icosphere(3, 1.0)
    meshes = [wc.Mesh(sphere.vertices, sphere.faces) for sphere in (outer, inner)]
    found = wc.compare(*(still(mesh.points, mesh) for mesh in meshes), device=device)
    assert not found.same_topology and found.rms is None and found.relative_rms is None and found.stretch_rms is None
    # Triangles lie within the sphere of their vertices, by the sagitta: those of the inner one are further from the outer
    # vertices by it at most, those of the outer one nearer to the inner vertices.
    for k, (low, high) in enumerate([(gap, gap + sagitta(inner)), (gap - sagitta(outer), gap)]):
        low, high = (low, high) if gap or not k else (0.0, sagitta(outer))
        rounding = 4 * EPS32
        for name in ("surface_mean", "surface_rms", "surface_largest"):
            assert low - rounding <= getattr(found, name)[0, k] <= high + rounding, (name, k)
    assert found.hausdorff[0] == found.surface_largest[0].max() > 0.0


def test_hausdorff_of_sheets_of_which_one_is_longer(device):
    short, h = wc.Mesh.grid(6, 5), 0.75
    long = wc.Mesh.grid(8, 4, size=(2.0, 1.0))
    found = wc.compare(still(short.points, short), still(long.points + h * UP, long), device=device)
    furthest = np.sqrt(1.0 + h**2)  # from the far side of the long one to the near side of the short one
    assert np.allclose(found.surface_largest, [[h, furthest]], atol=4 * EPS32) and np.isclose(found.hausdorff[0], furthest)
    assert np.allclose([found.surface_mean[0, 0], found.surface_rms[0, 0]], h, atol=4 * EPS32)


def test_means_are_over_the_area(device):
    mesh, floor = wc.Mesh.grid(9, 5), wc.Mesh.grid(3, 3, size=4.0)
    x = mesh.points[:, 0] ** 2  # so that rows are the narrower the nearer they are to 0
    ramp = np.stack([x, x, mesh.points[:, 2]], axis=1)
    found = wc.compare(still(ramp, mesh), still(floor.points - [1.0, 0.0, 1.0], floor), device=device)
    # The height is linear, so its mean is exact; of its square it is by the trapezoidal rule.
    nodes = np.linspace(0.0, 1.0, 9) ** 2
    squares = np.sum(np.diff(nodes) * (nodes[1:] ** 2 + nodes[:-1] ** 2) / 2.0)
    assert np.isclose(found.surface_mean[0, 0], 0.5, atol=4 * 4 * EPS32)
    assert np.isclose(found.surface_rms[0, 0], np.sqrt(squares), atol=4 * 4 * EPS32)


def test_what_vertices_miss_is_within_the_bound(device):
    whole = wc.Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    inner = 1.0 / 3.0 + 0.5 * (whole.points - 1.0 / 3.0) * [1, 1, 0]
    inner[:, 2] = 0.0
    k, after = np.arange(3), np.array([1, 2, 0])
    around = np.concatenate([np.stack([k, after, after + 3], axis=1), np.stack([k, after + 3, k + 3], axis=1)])
    ring = wc.Mesh(np.concatenate([whole.points, inner]), around)
    found = wc.compare(still(whole.points, whole), still(ring.points, ring), device=device)
    # The hole has an inradius of half that of the triangle, (2 − √2)/2.
    assert found.hausdorff[0] < 4 * EPS32 < (2.0 - np.sqrt(2.0)) / 4.0 <= found.hausdorff_bound[0]


def all_distances(points, x, triangles):
    """Of each point to the nearest of all triangles: inside of one its height above it, else that to the sides."""
    best = np.full(len(points), np.inf)
    for a, b, c in x[triangles]:
        corners = a - points, b - points, c - points
        n = np.cross(b - a, c - a)
        inside = np.full(len(points), bool(n.any()))
        for p, q in zip(corners, (*corners[1:], corners[0]), strict=True):
            d = q - p
            length = np.einsum("ki,ki->k", d, d)
            t = np.clip(-np.einsum("ki,ki->k", p, d) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(p + t[:, None] * d, axis=1))
            inside &= np.cross(p, q) @ n >= 0.0
        if n.any():
            best = np.where(inside, np.minimum(best, np.abs(corners[0] @ n) / np.linalg.norm(n)), best)
    return best


@pytest.mark.parametrize("scale", [1.0, 1e-20, 1e6])
@pytest.mark.parametrize(
    ("name", "squash", "shift"),
    [
        ("as it is", (1, 1, 1), (0, 0, 0)),
        ("far off the origin", (1, 1, 1), (1e3, -1e3, 1e3)),
        ("squashed", (1, 1, 2e-3), (0, 0, 0)),
        ("to needles", (1, 1, 1e-5), (0, 0, 0)),
        ("to less than float32 can tell", (1, 1e-12, 1e-12), (0, 0, 0)),
        ("to a line", (1, 0, 0), (0, 0, 0)),
        ("to a point", (0, 0, 0), (0, 0, 0)),
    ],
)
def test_distances_are_those_to_the_nearest_of_all_triangles(device, name, squash, shift, scale):
    random = np.random.default_rng(1)
    crumpled = GRID.points + 0.1 * random.normal(size=GRID.points.shape)
    points = random.random((200, 3)) * [1.0, 0.3, 1.0]
    points[:40] = crumpled[:40] * squash
    points, x = scale * (points + shift), scale * (crumpled * squash + shift)
    found = surface_distances(points, x, GRID.triangles, device)
    size = np.ptp(np.concatenate([points, x]), axis=0).max()
    error = (found - all_distances(points, x, GRID.triangles)) / size
    # The search rounds coordinates and the distance; subtracting the centre loses what an offset has lost already.
    assert error.max() < 4 * EPS32 and error.min() > -16 * EPS * (1.0 + max(shift)), name


# --- times


@pytest.mark.parametrize(
    ("fps", "frames", "pairs", "left"),
    [
        ((24, 24), (4, 6), [(0, 0), (1, 1), (2, 2), (3, 3)], ([], [4, 5])),
        ((24, 12), (5, 3), [(0, 0), (2, 1), (4, 2)], ([1, 3], [])),
        ((24, 30), (9, 11), [(0, 0), (4, 5), (8, 10)], ([1, 2, 3, 5, 6, 7], [1, 2, 3, 4, 6, 7, 8, 9])),
        ((30, 1), (1, 1), [(0, 0)], ([], [])),
    ],
)
def test_frames_belong_together_by_time(device, fps, frames, pairs, left):
    # Each is at height t, so frames of one time are 0 apart.
    inputs = [(GRID, GRID.points + UP * np.arange(n)[:, None, None] / rate) for n, rate in zip(frames, fps, strict=True)]
    found = wc.compare(*inputs, fps_a=fps[0], fps_b=fps[1], device=device)
    assert found.frames.tolist() == found.labels.tolist() == [list(pair) for pair in pairs]
    assert [places.tolist() for places in found.unmatched] == list(left)
    assert np.allclose(found.times, np.array(pairs)[:, 0] / fps[0], rtol=EPS) and found.largest.max() < 4 * EPS
    part = wc.compare(*inputs, fps_a=fps[0], fps_b=fps[1], frames=1, device=device)
    assert part.frames.tolist() == found.frames[:2].tolist()


def test_times_that_differ_by_rounding_are_one_and_others_are_not(device):
    frames = waves(GRID.points)
    times = np.array([0.0, 0.1, 0.2])
    near = wc.compare(as_sequence(GRID, frames, times=times), as_sequence(GRID, frames, times=times + 0.9e-7), device=device)
    assert len(near.times) == 3
    with pytest.raises(ValueError, match=r"no frame of a has .* 3 from 0 to 0\.2 s and 3 from 2e-07 to 0\.2 s"):
        wc.compare(as_sequence(GRID, frames, times=times), as_sequence(GRID, frames, times=times + 2e-7), device=device)


def test_a_frame_is_read_once_and_when_its_turn_comes(device):
    log = []

    def recorded(name, frames):
        def read(frame):
            log.append((name, frame))
            return frames[frame]

        return Sequence(GRID, np.arange(len(frames)), np.arange(len(frames)) / 24, read)

    steps = []
    wc.compare(
        recorded("a", waves(GRID.points)),
        recorded("b", waves(GRID.points)),
        device=device,
        progress=lambda frame, frames: steps.append((frame, frames, len(log))),
    )
    assert log == [(name, frame) for frame in range(3) for name in "ab"]
    assert steps == [(0, 2, 2), (1, 2, 4), (2, 2, 6)]


# --- what cannot be measured


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_frame_that_is_not_finite_is_left_out_and_named(device, bad):
    a, b = waves(GRID.points), waves(GRID.points)
    b[1, [3, 5], 2] = bad
    found = wc.compare((GRID, a), (GRID, b), fps=24, device=device)
    assert found.excluded[0] == [] and len(found.excluded[1]) == 1
    text = str(found.excluded[1][0])
    assert "frame 1" in text and "vertices 3, 5" in text and "not compared" in text
    for name in (*DISTANCES, *STRETCHES, "sizes", "relative_rms"):
        values = getattr(found, name)
        assert np.isnan(values[1]).all() and np.isfinite(values[[0, 2]]).all(), name
    assert found.largest_vertex.tolist() == [0, -1, 0]
    b[:, 7, 0] = bad
    with pytest.raises(ValueError, match=r"none of the 3 frames that a and b both have can be compared: frame 0, vertex 7"):
        wc.compare((GRID, a), (GRID, b), fps=24, device=device)


def test_triangles_without_area_at_rest_are_left_out_of_the_stretches_and_named(device):
    flat = GRID.points.copy()
    corners = GRID.triangles[4]
    flat[corners] = flat[corners[0]]
    rest = Surface(flat, GRID.triangles)
    found = wc.compare(still(GRID.points), still(GRID.points, rest), device=device)
    (excluded,) = found.excluded[1]
    assert found.excluded[0] == [] and excluded.frame is None and np.array_equal(excluded.elements, rest.degenerate)
    assert len(rest.degenerate) >= 4 and np.isfinite(found.stretch_largest).all() and found.largest[0] == 0.0
    collapsed = Surface(0.0 * GRID.points, GRID.triangles)
    none = wc.compare(still(GRID.points), still(GRID.points, collapsed), device=device)
    assert np.isnan(none.stretch_rms).all() and none.rms[0] == 0.0 and len(none.excluded[1][0].elements) == len(GRID.triangles)


def test_a_cloth_that_collapsed_has_distances_and_no_mean(device):
    found = wc.compare(still(GRID.points), still(0.0 * GRID.points), device=device)
    assert np.allclose(found.surface_largest, [[np.linalg.norm([1.0, 0.8]), 0.0]], atol=4 * EPS32)
    assert np.isnan(found.surface_mean[0, 1]) and np.isfinite(found.surface_mean[0, 0])
    assert "no area" in str(found.excluded[1][0]) and np.isclose(found.stretch_rms, 1.0).all()


def test_a_vertex_without_triangles_is_on_no_surface(device):
    mesh = wc.Mesh(np.concatenate([GRID.points, [[0.0, 5.0, 0.0]]]), GRID.triangles)
    moved = mesh.points.copy()
    moved[-1] += 1.0
    found = wc.compare(still(mesh.points, mesh), still(moved, mesh), device=device)
    assert found.largest_vertex[0] == len(GRID.points) and found.rms[0] > 0.0
    assert not any(getattr(found, name).any() for name in DISTANCES[2:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"a": 3}, "a is 3; it must be a path, a Sequence, or (mesh, frames)"),
        ({"b": (GRID, waves(GRID.points)[:, 1:])}, "frames has shape (3, 62, 3)"),
        ({"fps": None}, "a: has no times, by which frames belong together; give fps"),
        ({"fps": 0.0}, "fps is 0.0; it must be a number above 0"),
        ({"frames": -1}, "frames is -1; it must be a whole number of 0 or more"),
        ({"a": (wc.Mesh.chain(3), np.zeros((1, 3, 3)))}, "a sequence must have triangles"),
    ],
)
def test_wrong_use_is_refused(change, message):
    given = {"a": (GRID, waves(GRID.points)), "b": (GRID, waves(GRID.points)), "fps": 24} | change
    with pytest.raises(ValueError) as caught:
        wc.compare(**given)
    assert message in str(caught.value)


# --- files and the command line


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A motion as a stage at 24 frames a second, and as .obj files, off by 0.5 in the third; and one of a finer mesh."""
    folder = tmp_path_factory.mktemp("animations")
    frames = waves(GRID.points, 4)
    for name, mesh in (("cloth", GRID), ("finer", wc.Mesh.grid(12, 9, size=(1.0, 0.8)))):
        writer = AnimationWriter(folder / f"{name}.usdc", mesh, fps=24)
        for points in waves(mesh.points, 4):
            writer.append(points, np.zeros_like(points))
        writer.close()
    (folder / "obj").mkdir()
    for frame, points in enumerate(frames):
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points + 0.5 * UP * (frame == 2)]
        lines += [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in GRID.triangles]
        (folder / "obj" / f"cloth.{frame}.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in GRID.points] + lines[len(GRID.points) :]
    (folder / "rest.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def run(capfd, *argv):
    code = main([str(word) for word in argv])
    out, err = capfd.readouterr()
    return code, out, err


def test_a_stage_is_compared_with_files(files, device):
    rest = wc.Mesh.load(files / "rest.obj")
    found = wc.compare(files / "cloth.usdc", (rest, files / "obj"), fps_b=24, device=device)
    # Stages hold float32.
    assert np.allclose(found.rms, [0.0, 0.0, 0.5, 0.0], atol=4 * EPS32) and found.stretch_largest.max() < 50 * EPS32
    first = wc.compare(files / "cloth.usdc", files / "obj", fps_b=24, device=device)  # which is deformed
    assert first.stretch_largest.max() > 0.05
    with pytest.raises(ValueError, match=r"b: its mesh is Mesh.* has other triangles"):
        wc.compare(files / "cloth.usdc", (wc.Mesh.grid(3, 3), files / "obj"), fps_b=24)


def test_the_command_writes_tables_pictures_and_a_summary(files, tmp_path, capfd):
    table, picture = tmp_path / "apart.csv", tmp_path / "apart.png"
    given = ["compare", files / "cloth.usdc", files / "obj", "--fps-b", 24, "--rest-b", files / "rest.obj"]
    code, out, err = run(capfd, *given, "--csv", table, "--plot", picture)
    assert (code, err) == (0, "") and "4 of 4 common frames compared" in out
    assert "RMS 0.25 m over all frames" in out and "worst RMS 0.5 m in frame 2 (0.08333 s)" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    with open(table, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame_b"] for row in rows] == ["0", "1", "2", "3"]
    assert np.allclose([float(row["rms"]) for row in rows], [0.0, 0.0, 0.5, 0.0], atol=4 * EPS32)
    code, out, err = run(capfd, *given, "--json", "--frames", 2)
    facts = json.loads(out)
    assert (code, err) == (0, "") and facts["worst_rms"]["frame_a"] == 2 and len(facts["frames"]["rms"]) == 3
    assert list(rows[0]) == list(facts["frames"])


def test_the_command_says_what_is_left_out(files, tmp_path, capfd):
    points = waves(GRID.points, 3)
    points[1, 4] = np.nan
    np.savez(tmp_path / "broken.npz", points=points, triangles=GRID.triangles)
    code, out, err = run(capfd, "compare", tmp_path / "broken.npz", files / "cloth.usdc", "--fps-a", 24)
    assert (code, err) == (0, "") and "2 of 3 common frames compared" in out
    assert "excluded      A: frame 1, vertex 4: has no finite position" in out
    assert "not compared  1 of the frames of B, without a partner: 3" in out
    assert "from the first frame of A, where no rest shape is given" in out
    code, out, err = run(capfd, "compare", tmp_path / "broken.npz", files / "cloth.usdc", "--fps-a", 24, "--json")
    assert code == 0 and json.loads(out)["frames"]["rms"][1] == "nan"


def test_the_command_compares_surfaces_of_different_meshes(files, tmp_path, capfd):
    given = ["compare", files / "cloth.usdc", files / "finer.usdc"]
    code, out, err = run(capfd, *given, "--csv", tmp_path / "o.csv", "--plot", tmp_path / "o.svg")
    assert (code, err) == (0, "") and "different triangles, so that surfaces alone are compared" in out
    assert "rms," not in (tmp_path / "o.csv").read_text(encoding="utf-8").split("surface")[0]
    assert "<svg" in (tmp_path / "o.svg").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("argv", "fragment"),
    [
        ("compare {}/cloth.usdc", "the following arguments are required: B; see warpcloth compare --help"),
        ("compare {}/cloth.usdc {}/none.usdc", "none.usdc: there is no such file"),
        ("compare {}/cloth.usdc {}/obj", "obj: has no times, by which frames belong together; give fps (--fps or --fps-b)"),
        ("compare {}/cloth.usdc {}/rest.obj", "rest.obj: is one mesh"),
        ("compare {}/cloth.usdc {}/cloth.usdc --prim-b /None", "None"),
        ("compare {}/cloth.usdc {}/cloth.usdc --fps-a 0", "fps is 0.0; it must be a number above 0"),
        ("compare {}/cloth.usdc {}/cloth.usdc --frames -1", "frames is -1; it must be a whole number"),
        ("compare {}/cloth.usdc {}/cloth.usdc --plot {}/o.txt", "o.txt: the ending is '.txt'; it must be .png or .svg or .pdf"),
        ("compare {}/cloth.usdc {}/cloth.usdc --csv /proc/o.csv", "/proc"),
        *[
            (f"compare {{}}/cloth.usdc {{}}/obj --fps-b 24 --rest-b {{}}/rest.obj --csv {{}}/{name}", "must not be changed")
            for name in ("cloth.usdc", "obj/cloth.2.obj", "rest.obj")
        ],
        ("compare {}/cloth.usdc {}/cloth.usdc --csv {}/o.png --plot {}/o.png", "o.png: is given for two outputs"),
        ("compare {}/cloth.usdc {}/finer.usdc --rest-b {}/rest.obj", "b: its mesh is"),
    ],
)
def test_wrong_use_of_the_command_is_one_line_and_exit_code_2(files, capfd, argv, fragment):
    code, out, err = run(capfd, *(word.replace("{}", str(files)) for word in argv.split()))
    assert code == 2 and out == "" and err.startswith("warpcloth: ") and err.count("\n") == 1 and fragment in err
