"""Comparisons of surfaces whose triangles change, against closed forms; and captures, read from files and memory."""

import csv
import json

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.mesh.distances import Boundary, surface_samples
from warpcloth.mesh.mesh import Surface

UP = np.array([0.0, 1.0, 0.0])
EPS32 = np.finfo(np.float32).eps
NUMBERS = ("mean", "rms", "percentile", "largest")


def compared(a, b, **options):
    """The numbers of the only frame of two meshes, by kind and name, (2,)."""
    found = wc.compare_surfaces([a], [b], fps=1, **options)
    return found, {(kind, name): getattr(getattr(found, kind), name)[0] for kind in ("all", "inner") for name in NUMBERS}


def bent(mesh, radius):
    """A sheet along x ∈ [0, 1] on a cylinder about z, touching the plane y = 0 along x = ½."""
    angle = (mesh.points[:, 0] - 0.5) / radius
    return wc.Mesh(
        np.stack([0.5 + radius * np.sin(angle), radius * (1.0 - np.cos(angle)), mesh.points[:, 2]], axis=1), mesh.triangles
    )


def sphere(radius, n):
    found = trimesh.creation.icosphere(n, radius)
    return wc.Mesh(found.vertices, found.faces)


def test_samples_are_exact_for_quadratic_functions():
    """∫x² and ∫xy over a square, of triangles of very different sizes; no triangle is left out."""
    mesh = wc.Mesh.grid(5, 4, pattern="alternating")
    x = mesh.points**3  # so that cells differ in size by a factor of over 1000
    for count in (1, 50, 5000):
        faces, weights, areas = surface_samples(x, mesh.triangles, count)
        at = np.einsum("kc,kci->ki", weights, x[mesh.triangles[faces]])
        assert count <= len(faces) <= 8 * (count + 3 * len(mesh.triangles)) and len(np.unique(faces)) == len(mesh.triangles)
        assert np.allclose([areas.sum(), areas @ at[:, 0] ** 2, areas @ (at[:, 0] * at[:, 2])], [1, 1 / 3, 1 / 4], rtol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_parallel_planes_are_their_distance_apart(device, turned):
    fine, coarse = wc.Mesh.grid(9, 7), wc.Mesh.grid(4, 3, pattern="alternating")
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] if turned else np.eye(3)
    raised = wc.Mesh((coarse.points + 0.25 * UP) @ rotation, coarse.triangles)
    found, numbers = compared(wc.Mesh(fine.points @ rotation, fine.triangles), raised, device=device)
    assert all(np.allclose(value, 0.25, atol=4 * EPS32) for value in numbers.values())
    assert np.isclose(found.hausdorff[0], 0.25, atol=4 * EPS32) and found.hausdorff_bound[0] > 0.25


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii(device):
    """Triangles lie within the sphere of their vertices, by at most the sagitta R(1 − cos ½α), α the longest side over R."""
    outer, inner = sphere(1.5, 3), sphere(1.0, 3)
    found, numbers = compared(outer, inner, device=device)
    sagitta = max(each.edge_lengths.max() ** 2 / (8 * r) * 4 / 3 for each, r in ((outer, 1.5), (inner, 1.0)))
    for value in numbers.values():
        assert (np.abs(value - 0.5) <= sagitta).all()
    assert found.inner_area.tolist() == [[1.0, 1.0]]  # they have no boundary
    assert found.all.largest[0, 0] >= 0.5 - 4 * EPS32


def test_a_plane_and_an_arc(device):
    """Of the arc the height R(1 − cos φ), its mean and square over the arc; 95 % are within that of 0.95 of the angle."""
    radius, plane = 1.0, wc.Mesh.grid(3, 3)
    arc = bent(wc.Mesh.grid(65, 3), radius)
    _, numbers = compared(arc, plane, device=device)
    half = 0.5 / radius
    mean = radius * (1.0 - np.sin(half) / half)
    square = radius**2 * (1.5 - 2.0 * np.sin(half) / half + np.sin(2.0 * half) / (4.0 * half))
    chord = radius * (half / 64) ** 2  # chords lie above the arc by less
    assert np.isclose(numbers["all", "mean"][0], mean, atol=chord) and np.isclose(
        numbers["all", "rms"][0], np.sqrt(square), atol=chord
    )
    assert np.isclose(numbers["all", "largest"][0], radius * (1.0 - np.cos(half)), atol=4 * EPS32)
    # 0.95 of the area within one column of samples, whose width is at most 1/64.
    heights = [radius * (1.0 - np.cos(half * share)) for share in (0.95 - 1 / 32, 0.95 + 1 / 32)]
    assert heights[0] <= numbers["all", "percentile"][0] <= heights[1]


def test_noise_along_the_normal_has_the_rms_over_the_area(device):
    """σ/√2: the mean of Σ wᵢ² over a triangle is ½. Vertices are in six triangles: as of 1600/6 numbers."""
    mesh, sigma = wc.Mesh.grid(41, 41), 1e-3
    noisy = mesh.points + sigma * np.random.default_rng(1).normal(size=(len(mesh.points), 1)) * [0.0, 1.0, 0.0]
    _, numbers = compared(wc.Mesh(noisy, mesh.triangles), wc.Mesh.grid(2, 2, size=1.0), device=device, samples=1)
    assert np.allclose(numbers["all", "rms"][0], sigma / np.sqrt(2.0), rtol=4.0 / np.sqrt(2 * 1600 / 6))


def test_what_faces_a_hole_counts_among_all_points_alone(device):
    """A sheet above one that lacks the middle: of the inner points all are 0.1 away, and their area is that of the rest."""
    mesh = wc.Mesh.grid(9, 9)
    middle = (np.abs(mesh.points - 0.5)[:, [0, 2]] < 0.2).all(axis=1)  # the hole is within 0.25 of the centre
    kept = ~middle[mesh.triangles].any(axis=1)
    holed = Surface(mesh.points + 0.1 * UP, mesh.triangles[kept])
    found, numbers = compared(mesh, holed, device=device)
    assert np.allclose([numbers["inner", name] for name in NUMBERS], 0.1, atol=4 * EPS32)
    assert np.allclose(found.inner_area[0], [mesh.triangle_areas[kept].sum(), 1.0], atol=1e-3)
    assert np.isclose(numbers["all", "largest"][0], np.hypot(0.25, 0.1), atol=4 * EPS32)  # from the centre
    # Not finite is a hole too, and is named.
    points = mesh.points + 0.1 * UP
    points[middle] = np.nan
    same, of_nan = compared(mesh, Surface(points, mesh.triangles), device=device)
    assert all(np.allclose(of_nan[key], numbers[key], atol=4 * EPS32) for key in numbers)
    assert same.excluded[0] == [] and "no finite position, so that the triangles there count as holes" in str(
        same.excluded[1][0]
    )


def test_seams_are_no_boundary():
    """Sides that coincide with others are joined, as in files that repeat vertices."""
    mesh = wc.Mesh.grid(3, 3)
    soup = mesh.points[mesh.triangles].reshape(-1, 3)
    boundary = Boundary(soup, np.arange(len(soup)).reshape(-1, 3))
    middle = np.flatnonzero((soup == [0.5, 0.0, 0.5]).all(axis=1))
    faces, corners = np.divmod(middle, 3)
    assert not boundary.has(faces, np.eye(3)[corners]).any()
    border = np.flatnonzero((soup == [0.0, 0.0, 0.0]).all(axis=1))
    assert boundary.has(border // 3, np.eye(3)[border % 3]).all()


# --- captures


def meshes(frames=4):
    """A sheet that rises by 0.1 a frame, with another mesh in each frame."""
    grids = [wc.Mesh.grid(4 + k, 6 - k) for k in range(frames)]
    return [wc.Mesh(grid.points + 0.1 * k * UP, grid.triangles) for k, grid in enumerate(grids)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """These as .ply files in millimetres at 24 frames a second, without frame 2; and the first mesh as rest.obj."""
    folder = tmp_path_factory.mktemp("captures") / "scan"
    folder.mkdir()
    for k, mesh in enumerate(meshes()):
        if k != 2:
            trimesh.Trimesh(1e3 * mesh.points, mesh.triangles, process=False).export(folder / f"scan_{k:03d}.ply")
    trimesh.Trimesh(meshes()[0].points, meshes()[0].triangles, process=False).export(folder.parent / "rest.obj")
    return folder


def test_a_folder_of_meshes_that_change_is_a_capture(folder):
    capture = wc.open_capture(folder, fps=24, scale=1e-3)
    assert capture.labels.tolist() == [0, 1, 3] and capture.missing == [2] and np.allclose(capture.times, capture.labels / 24)
    for k, frame in ((0, 0), (2, 3)):
        assert np.allclose(capture[k].points, meshes()[frame].points, atol=EPS32) and len(capture[k].triangles) == len(
            meshes()[frame].triangles
        )
    of_mesh = wc.as_capture(meshes(), dt=1 / 24)
    found = wc.compare_surfaces(capture, of_mesh)
    assert found.hausdorff.max() < 8 * EPS32 and found.vertices.tolist() == [[24, 24], [25, 25], [21, 21]]
    assert [each.tolist() for each in found.unmatched] == [[], [2]] and "frame 2 is missing" in str(found.excluded[0][0])
    with pytest.raises(
        ValueError, match=r"25 vertices, must be 24 as in .*scan_000.ply; meshes that change from frame to frame are captures"
    ):
        wc.open_sequence(folder)[1]


def test_a_sequence_is_a_capture_of_one_topology():
    mesh = wc.Mesh.grid(3, 3)
    sequence = wc.as_sequence(mesh, [mesh.points, mesh.points + 1.0], dt=0.5)
    capture = wc.as_capture(sequence)
    assert capture.times.tolist() == [0.0, 0.5] and np.array_equal(capture[1].points, mesh.points + 1.0)
    upright = wc.Mesh(mesh.points[:, [0, 2, 1]] * [1.0, -1.0, 1.0], mesh.triangles, up_axis="Z")
    found = wc.compare_surfaces([wc.Mesh(mesh.points, mesh.triangles, up_axis="Y")], [upright], fps=1)
    assert found.up_axes == ("Y", "Z") and found.hausdorff[0] < 4 * EPS32


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda folder: wc.open_capture(folder, fps=0.0), "fps is 0.0; it must be a number above 0"),
        (lambda folder: wc.open_capture(folder, scale=-1.0), "scale is -1.0; it must be a number above 0"),
        (lambda folder: wc.open_capture(folder.parent / "rest.obj"), "rest.obj: is one mesh"),
        (lambda folder: wc.open_capture(folder.parent / "rest.obj", scale=2.0), "scale is 2; it is for folders and patterns"),
        (
            lambda folder: wc.compare_surfaces([wc.Mesh(1e70 * m.points, m.triangles) for m in meshes()], meshes(), fps=1),
            r"none of the 4 frames .* has a coordinate above 1e\+60 m",
        ),
        (lambda folder: wc.as_capture([]), "frames has 0 meshes; it must have at least 1"),
        (lambda folder: wc.as_capture([wc.Mesh.chain(3)]), r"frames\[0\] is Mesh.*; it must be a Mesh with triangles"),
        (lambda folder: wc.as_capture(meshes(), dt=1.0, times=[0, 1, 2, 3]), "dt, times: both are given; give one"),
        (
            lambda folder: wc.as_capture(wc.as_sequence(meshes()[0], [meshes()[0].points]), dt=1.0),
            "dt is given, and a sequence",
        ),
        (lambda folder: wc.compare_surfaces(3, meshes()), "a is 3; it must be a path, a Capture, a Sequence"),
        (lambda folder: wc.compare_surfaces(meshes(), meshes(), fps=24, samples=0), "samples is 0; it must be a whole number"),
        (lambda folder: wc.compare_surfaces(folder, meshes(), fps_b=24), "scan: has no times, by which frames belong together"),
        (
            lambda folder: wc.compare_surfaces([Surface(0.0 * meshes()[0].points, meshes()[0].triangles)], meshes()[:1], fps=1),
            "none of the 1 frames that a and b both have can be compared: frame 0 has no area",
        ),
    ],
    ids=range(13),
)
def test_wrong_use_is_refused(folder, call, message):
    with pytest.raises(ValueError, match=message):
        call(folder)


def test_the_command_compares_by_surface(folder, tmp_path, capsys):
    table, picture = tmp_path / "apart.csv", tmp_path / "apart.png"
    np.savez(tmp_path / "flat.npz", points=meshes()[0].points + np.zeros((4, 1, 1)), triangles=meshes()[0].triangles)
    words = ["compare", str(folder), str(tmp_path / "flat.npz"), "--by", "surface", "--fps", "24", "--scale-a", "0.001"]
    assert main([*words, "--csv", str(table), "--plot", str(picture)]) == 0
    out = capsys.readouterr().out
    assert "3 of 3 common frames compared by their surfaces" in out and "95 % within 0.3 m in frame 3 (0.125 s)" in out
    assert "21 to 25 and 24 vertices" in out and "A: frame 2 is missing" in out and picture.stat().st_size
    with open(table, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert np.allclose([float(row["inner_rms_a"]) for row in rows], [0.0, 0.1, 0.3], atol=4 * EPS32)
    assert main([*words, "--json", "--samples", "100"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["hausdorff"]["frame_a"] == 3 and list(facts["frames"]) == list(rows[0])
    for wrong, sentence in (
        ([*words, "--rest-a", str(folder.parent / "rest.obj")], "--rest-a is for stretches, which --by surface does not"),
        ([word for word in words if word not in ("--by", "surface")], "--scale-a is for --by surface; leave it out"),
        ([*words, "--csv", str(folder / "scan_000.ply")], "must not be changed"),
    ):
        assert main(wrong) == 2 and sentence in capsys.readouterr().err, wrong
