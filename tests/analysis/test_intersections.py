"""Intersections against linear programs and known answers; vertices inside colliders; limits of stretch."""

import csv
import itertools
import json

import numpy as np
import pytest
from scipy.optimize import linprog

import warpcloth as wc
from support.command_line import refused, run
from warpcloth.analysis import crossings
from warpcloth.analysis.crossings import Crossings, have_area
from warpcloth.usd import AnimationWriter, write_scene
from warpcloth.usd.modules import Usd, UsdGeom, UsdPhysics, Vt

pytest.importorskip("igl")

FACE = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
ONE_MICRON = 1e-6
# The points of two triangles, their vertices, and whether they intersect.
PAIRS = {
    "cross": ([*FACE, [1, 1, -1], [1, 1, 1], [9, 9, 1]], [3, 4, 5], True),
    "miss": ([*FACE, [3, 3, -1], [3, 3, 1], [9, 9, 1]], [3, 4, 5], False),
    "through by a micrometre": ([*FACE, [1, 1, -ONE_MICRON], [1, 2, 1], [2, 1, 1]], [3, 4, 5], True),
    "above by a micrometre": ([*FACE, [1, 1, ONE_MICRON], [1, 2, 1], [2, 1, 1]], [3, 4, 5], False),
    "a vertex on the other": ([*FACE, [1, 1, 0], [1, 2, 1], [2, 1, 1]], [3, 4, 5], True),
    "a vertex in common": ([*FACE, [-1, 0, 1], [0, -1, 1]], [0, 3, 4], False),
    "a vertex at one position": ([*FACE, [0, 0, 0], [-1, 0, 1], [0, -1, 1]], [3, 4, 5], False),
    "through, a vertex in common": ([*FACE, [1, 1, -1], [1, 1, 1]], [0, 3, 4], True),
    "by 1e-12, a vertex in common": ([*FACE, [1, 1, -1e-12], [1, 1, 1]], [0, 3, 4], True),
    "above by 1e-12, a vertex in common": ([*FACE, [1, 1, 1e-12], [1, 1, 1]], [0, 3, 4], False),
    "small, a vertex in common": (1e-6 * np.array([*FACE, [1, 1, -1], [1, 1, 1]]), [0, 3, 4], True),
    "in its plane": ([*FACE, [1, 1, 0], [6, 1, 0], [6, 6, 0]], [3, 4, 5], True),
    "beside it": ([*FACE, [4, 4, 0], [6, 1, 0], [6, 6, 0]], [3, 4, 5], False),
    "in its plane, a vertex in common": ([*FACE, [2, 1, 0], [1, 2, 0]], [0, 3, 4], True),
    "opposite in its plane, a vertex in common": ([*FACE, [-2, -1, 0], [-1, -2, 0]], [0, 3, 4], False),
    "flat, an edge in common": ([*FACE, [4, -1, 0]], [1, 0, 3], False),
    "folded by 180°, an edge in common": ([*FACE, [1, 1, 0]], [1, 0, 3], True),
    "folded, an edge in common": ([*FACE, [1, 1, 1e-12]], [1, 0, 3], False),
    "turned over, an edge in common": ([*FACE, [1, 1, 0]], [0, 1, 3], True),
    "twins": (FACE, [2, 1, 0], True),
}


@pytest.mark.parametrize("name", PAIRS)
def test_two_triangles(name):
    points, second, cross = PAIRS[name]
    for turn in (np.eye(3), np.roll(np.eye(3), 1, axis=0)):
        found = wc.intersections(np.array(points, dtype=float) @ turn, [[0, 1, 2], second])
        assert found.pairs[0].tolist() == ([[0, 1]] if cross else []) and found.clean == (not cross)


def share(points, one, other):
    """Whether two triangles have more in common than their common vertices: the largest weight of the other corners of one
    in a point of both, by a linear program; of whole numbers below 4 it is 0 or far above rounding."""
    a, b = points[one], points[other]
    equal = np.vstack([np.hstack([a.T, -b.T]), [1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1]])
    gain = np.concatenate([-(~np.isin(one, other)).astype(float), np.zeros(3)])
    found = linprog(gain, A_eq=equal, b_eq=[0, 0, 0, 1, 1], bounds=(0, None))
    return found.status == 0 and found.fun < -1e-6


@pytest.mark.parametrize("common", (0, 1, 2))
def test_triangles_of_whole_numbers(common):
    """Which are often in one plane, touch, or have corners on edges."""
    rng, met, apart = np.random.default_rng(common), 0, 0
    one, other = [np.array([0, 1, 2]), np.array([3, 4, 5])] if not common else [np.array([0, 1, 2]), np.array([0, 3, 4])]
    other = np.array([1, 0, 3]) if common == 2 else other
    while met + apart < 300:
        points = rng.integers(0, 4, (6 - common, 3)).astype(float)
        turned = [np.roll(each, rng.integers(3))[:: rng.choice([1, -1])] for each in (one, other)]
        if have_area(points, np.array(turned)).all():
            expected = share(points, *turned)
            assert len(Crossings(np.array(turned)).pairs(points, np.ones(2, bool))) == expected, (points, turned)
            met, apart = met + expected, apart + (not expected)
    assert met > 15 and apart > 100


def test_which_triangles_have_an_area():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3], [0.3, 0.3, np.nextafter(0.3, 1)], [0.1, 0.1, 0.1]])
    found = have_area(points, np.array([[0, 1, 2], [0, 1, 3], [0, 4, 3], [0, 0, 2]]))
    # 0.3 is not three times 0.1 in float64, but all points of the first are on the diagonal.
    assert found.tolist() == [False, True, False, False]


def folded(gap, n=17):
    """A sheet folded in two along x = 0, the halves this far apart, below 0 through one another."""
    mesh = wc.Mesh.grid(n, n, size=2.0)
    x, y, z = (mesh.points - mesh.points.mean(axis=0)).T
    height = z if np.ptp(z) == 0 else y
    height = np.where(x > 0, gap, 0.0) + height.mean()
    height[np.isclose(x, 0.0)] += 0.5 * gap
    across = z if np.ptp(z) else y
    return mesh, np.column_stack([np.abs(x) * (1.0 + 0.01 * (x > 0)), height, across + 0.003 * (x > 0)])


@pytest.mark.parametrize(("gap", "clean"), [(1e-6, True), (0.0, False)])
def test_a_folded_sheet(gap, clean):
    mesh, points = folded(gap)
    found = wc.intersections(points, mesh)
    assert found.clean == clean


def test_a_vertex_pushed_through_a_sheet_by_a_micrometre():
    """It crosses the triangle that it passes, with the six around it, and only those."""
    below, above = wc.Mesh.grid(9, 9), wc.Mesh.grid(9, 9)
    mesh = wc.Mesh.join({"below": below, "above": above})
    lower = below.points.copy()
    normal = int(np.argmin(np.ptp(lower, axis=0)))
    upper = lower * 0.93 + 0.02  # so that the vertex is above the middle of a triangle
    upper[:, 0] += 0.01
    upper[:, normal] = 0.01
    vertex, frames = 40, []
    for height in (ONE_MICRON, -ONE_MICRON):
        moved = upper.copy()
        moved[vertex, normal] = height
        frames.append(np.concatenate([lower, moved]))
    found = wc.intersections(np.array(frames), mesh)
    around = {128 + t for t in np.flatnonzero((above.triangles == vertex).any(axis=1))}
    assert [each.clean for each in found.frames] == [True, False] and len(around) == 6
    assert set(found.pairs[1][:, 1].tolist()) == around and len(set(found.pairs[1][:, 0].tolist())) == 1
    assert [found.cloths.face(t)[0] for t in found.pairs[1][0]] == ["below", "above"]
    assert found.cloths.face(found.pairs[1][0, 1]) == ("above", found.pairs[1][0, 1] - 128)


def strip(frames=16, n=60):
    """A twisted strip whose ends pass one another: x = sin a u, y = u², symmetric in ±u, cross where a u = π for a u ≤ 1.

    Each cross-section is turned about the y axis by its height. a = (f + ½)π/10 at frame f, so that they cross from 10 on.
    """
    mesh = wc.Mesh.grid(2 * n + 1, 4)
    u = np.repeat(np.linspace(-1.0, 1.0, 2 * n + 1)[None], 4, axis=0).ravel()
    w = np.repeat(np.linspace(-0.2, 0.2, 4), 2 * n + 1)
    found, c, s = [], np.cos(2.0 * u**2), np.sin(2.0 * u**2)
    for frame in range(frames):
        x = 0.5 * np.sin((frame + 0.5) * np.pi / 10.0 * u)
        found.append(np.column_stack([c * x + s * w, u**2, c * w - s * x]))
    return mesh, np.array(found)


def test_a_twisted_strip_crosses_itself_from_a_known_frame():
    mesh, frames = strip()
    found = wc.intersections(frames, mesh)
    assert [each.clean for each in found.frames] == [frame < 10 for frame in range(16)]
    every = wc.intersections(frames, mesh, every=5)
    assert [each.frame for each in every.frames] == [0, 5, 10, 15]
    np.testing.assert_array_equal(every.pairs[2], found.pairs[10])


def test_vertices_of_boundaries_at_one_position_are_sewn_while_they_stay_together():
    mesh = wc.Mesh.grid(3, 3)
    second = mesh.points * [-1.0, 1.0, 1.0] + [2.0 * mesh.points[:, 0].min(), 0.0, 0.0]
    both = wc.Mesh.join({"left": wc.Mesh(second, mesh.triangles[:, ::-1]), "right": mesh})
    assert wc.intersections(both.points, both).clean
    apart = both.points.copy()
    apart[9:] += [0.1, 0.0, 0.0]
    found = wc.intersections([both.points, apart], both)  # which are not sewn, as they part
    assert found.frames[1].clean and not found.frames[0].clean
    slid = both.points.copy()
    slid[:9] += [0.0, 0.0, np.ptp(mesh.points[:, 2]) / 2.0]
    found = wc.intersections([both.points, slid], both)  # nor these, which have another partner in each frame
    assert not found.frames[1].clean and not found.frames[0].clean
    inner = both.points.copy()
    inner[4] = inner[13]  # vertices that are on no boundary
    assert not wc.intersections(inner, both).clean


BALL, SPRING = {"radius": 0.35}, wc.Spring(stiffness=1.0)


def count_in_ball(points, centre):
    return int((((points - centre) ** 2).sum(axis=1) < 0.35**2).sum())


def test_vertices_inside_colliders():
    """Of shapes with closed forms, of a mesh, and of one that moves."""
    mesh = wc.Mesh.grid(21, 21)
    points = mesh.points
    centre = points.mean(axis=0) + 0.01
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) - 0.5
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [[a, b, c] for a, *rest in sides for b, c in itertools.pairwise(rest)]
    box = wc.MeshCollider(corners, triangles, position=centre, name="mesh")
    assert box.closed
    moving = wc.Sphere(**BALL, position=[centre, centre + 0.2], name="ball")
    colliders = [moving, wc.Box(size=(1, 1, 1), position=centre, name="box"), box, wc.Sphere(radius=0.1, position=centre + 9)]
    found = wc.intersections([points, points], mesh, colliders=colliders).frames
    for frame, at in enumerate((centre, centre + 0.2)):
        assert len(found[frame].inside["ball"]) == count_in_ball(points, at) > 0
        expected = np.flatnonzero((np.abs(points - centre) < 0.5).all(axis=1)).tolist()
        assert found[frame].inside["box"].tolist() == found[frame].inside["mesh"].tolist() == expected
        assert set(found[frame].inside) == {"ball", "box", "mesh"} and not found[frame].clean


def test_limits_of_stretch(tmp_path):
    """A stretch of 1.3 along x and 0.9 along the other axis, of limits that are given, declared, and of a stage."""
    mesh = wc.Mesh.grid(4, 4)
    terms = [
        wc.Spring(stiffness=1.0),
        wc.StrainLimit(least=0.95, most=1.2, stiffness=1.0),
        wc.SpringLimit(pairs="structural", most=1.25, stiffness=1.0),
        wc.StrainLimit(least=0.85, most=1.35, stiffness=1.0, name="wide"),
    ]
    axis = int(np.argmax(np.ptp(mesh.points, axis=0)[1:])) + 1
    scale = np.ones(3)
    scale[0], scale[axis] = 1.3, 0.9
    scene = wc.Scene(mesh, density=1.0, terms=terms, positions=mesh.points * scale)
    stage = tmp_path / "scene.usda"
    write_scene(scene, stage)
    animation = wc.Animation(mesh.points[None] * scale, None, np.zeros(1), None, {}, 0.0, scene=scene)
    with AnimationWriter(tmp_path / "run.usdc", wc.usd.read_mesh(stage), scene.fps, source=stage) as writer:
        writer.append(mesh.points * scale, np.zeros_like(mesh.points))
    for source in (animation, tmp_path / "run.usdc"):
        (found,) = wc.intersections(source, stretch=1.29).frames
        assert set(found.exceeded) == {"StrainLimit", "SpringLimit", "edges"} and not found.clean
        elements, stretches = found.exceeded["StrainLimit"]
        assert len(elements) == len(mesh.triangles)
        np.testing.assert_allclose(stretches, 1.3, rtol=1e-6)
        assert len(found.exceeded["SpringLimit"][0]) == len(found.exceeded["edges"][0]) == 12
        np.testing.assert_allclose(found.exceeded["edges"][1], 1.3, rtol=1e-6)
    single = (mesh.points * 1.1).astype(np.float32)  # rounded upwards, at some
    assert wc.intersections(single[None], mesh, stretch=1.1).clean
    assert not wc.intersections(single[None], mesh, stretch=1.0999).clean
    compressed = wc.Animation(mesh.points[None] * 0.9, None, np.zeros(1), None, {}, 0.0, scene=scene)
    np.testing.assert_allclose(wc.intersections(compressed).frames[0].exceeded["StrainLimit"][1], 0.9, rtol=1e-12)


def test_what_cannot_be_judged_is_named():
    mesh = wc.Mesh.grid(3, 3)
    frames = np.repeat(mesh.points[None], 3, axis=0)
    frames[1, 4] = np.nan
    corner = int(np.argmin(np.bincount(mesh.triangles.ravel())))  # of one triangle, put on its opposite edge
    (triangle,) = np.flatnonzero((mesh.triangles == corner).any(axis=1))
    frames[2, corner] = mesh.points[[v for v in mesh.triangles[triangle] if v != corner]].mean(axis=0)
    found = wc.intersections(frames, mesh)
    assert found.frames[0].clean and not found.clean and found.counts.tolist() == [0, 0, 0]
    said = [[str(one) for one in each.excluded] for each in found.frames]
    assert said[1] == ["frame 1, vertex 4: has no position that is finite, and below 1e+90 m"]
    assert said[2] == [f"frame 2, triangle {triangle}: has no area"]


def test_a_known_crossing_is_found_beside_what_is_not_finite():
    points = np.array([*PAIRS["cross"][0], [np.nan] * 3], dtype=float)
    found = wc.intersections(points, [[0, 1, 2], [3, 4, 5], [0, 1, 6]])
    assert found.pairs[0].tolist() == [[0, 1]] and len(found.frames[0].excluded) == 1


def write_stage(path, collider=False):
    """Two sheets of quads in centimetres, Z up, the upper of which comes down through the other, and one that stands."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    x, y = np.meshgrid(*[np.linspace(0.0, 100.0, 5)] * 2, indexing="ij")
    flat, rows = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3), np.arange(25).reshape(5, 5)
    quads = np.stack([rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]], axis=-1).reshape(-1)
    heights = {"Shirt": (0.0, 0.0), "Coat": (2.0, -0.2), "Shelf": (2.0,)}
    for name, frames in heights.items():
        mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        mesh.CreateFaceVertexCountsAttr([4] * 16)
        mesh.CreateFaceVertexIndicesAttr(quads.tolist())
        for code, height in enumerate(frames, start=1):
            points = flat + np.array([0.0, 0.0, height])
            if name == "Coat":
                points[:, 2] = np.where((points[:, 0] == 50.0) & (points[:, 1] == 50.0), height, 2.0)
                points[:, :2] += 7.0
            values = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
            mesh.CreatePointsAttr().Set(values, *([code] if len(frames) > 1 else []))
    if collider:
        UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath("/World/Coat"))
    stage.GetRootLayer().Save()
    return path


def test_the_meshes_of_a_stage(tmp_path, capfd):
    """The point of the coat goes through one quad of the shirt; the table, the stage and the JSON say so."""
    path = write_stage(tmp_path / "both.usda")
    found = wc.intersections(path)
    assert found.cloths.names == ("/World/Shirt", "/World/Coat") and found.cloths.others == ("/World/Shelf",)
    assert [each.frame for each in found.frames] == [1, 2] and found.counts[0] == 0 < found.counts[1]
    faces = [[found.cloths.face(t) for t in pair] for pair in found.pairs[1]]
    assert {shirt for shirt, _ in faces} == {("/World/Shirt", 10)}
    assert {coat for _, coat in faces} == {("/World/Coat", face) for face in (5, 6, 9, 10)}
    files = {name: tmp_path / f"out.{name}" for name in ("usda", "csv")}
    code, out, err = run(capfd, "check", path, "-o", files["usda"], "--csv", files["csv"], "--json", "--single-file")
    facts = json.loads(out)
    assert (code, err) == (1, "") and not facts["clean"] and facts["pairs"] == found.counts[1] and facts["worst_frame"] == 2
    assert [each["pairs"] for each in facts["frames"]] == found.counts.tolist()
    with open(files["csv"], newline="") as file:
        rows = list(csv.DictReader(file))
    told = [((row["prim"], int(row["element"])), (row["other"], int(row["other_element"]))) for row in rows]
    assert told == [tuple(pair) for pair in faces] and {row["frame"] for row in rows} == {"2"}
    stage = Usd.Stage.Open(str(files["usda"]))
    for name, marked in (("Shirt", {10}), ("Coat", {5, 6, 9, 10})):
        prim = stage.GetPrimAtPath(f"/World/{name}")
        for frame in (1, 2):
            colours = np.array(prim.GetAttribute("primvars:displayColor").Get(frame))
            red = set(np.flatnonzero(colours[:, 0] > 2.0 * colours[:, 1]).tolist())
            assert red == (marked if frame == 2 else set())
            values = np.array(prim.GetAttribute("primvars:intersections").Get(frame))
            assert set(np.flatnonzero(values).tolist()) == red
    again = wc.intersections(files["usda"])  # of which both are checked too
    assert again.counts.tolist() == found.counts.tolist()
    for names in (["Shirt"], ["Coat", "/World/Shelf"]):
        code, out, _err = run(capfd, "check", path, "--prim", *names)
        assert code == (0 if names == ["Shirt"] else 1) and ("not clean" in out) == (code == 1)
    one = write_stage(tmp_path / "one.usda", collider=True)
    assert wc.intersections(one).cloths.names == ("/World/Shirt",)


def test_sources_agree(tmp_path):
    mesh, frames = strip(12, n=20)
    frames = frames.astype(np.float32)
    expected = wc.intersections(frames, mesh.triangles).pairs
    np.savez(tmp_path / "a.npz", points=frames, triangles=mesh.triangles)
    (tmp_path / "frames").mkdir()
    faces = "".join("f {} {} {}\n".format(*(t + 1)) for t in mesh.triangles)
    for frame, points in enumerate(frames):
        text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
        (tmp_path / "frames" / f"{frame:02d}.obj").write_text(text + faces)
    with AnimationWriter(tmp_path / "a.usdc", mesh, 24.0) as writer:
        for points in frames:
            writer.append(points, np.zeros_like(points))
    sequence = wc.open_sequence(tmp_path / "a.npz")
    stage = wc.open_sequence(tmp_path / "a.usdc")
    animated = wc.usd.FrameSequence(tmp_path / "a.usdc")
    for source, given in (
        (tmp_path / "a.npz", None),
        (tmp_path / "frames", None),
        (tmp_path / "a.usdc", None),
        (sequence, None),
        (stage, mesh),
        (animated, mesh),
        (list(frames), mesh),
        (wc.Animation(frames, None, np.arange(12.0), None, {}, 0.0, scene=wc.Scene(mesh, density=1.0, terms=[SPRING])), None),
    ):
        found = wc.intersections(source, given)
        assert [pairs.tolist() for pairs in found.pairs] == [pairs.tolist() for pairs in expected]
    last = frames[11].astype(float)
    scene = wc.Scene(mesh, density=1.0, terms=[SPRING], positions=last)
    for one in (tmp_path / "frames" / "11.obj", scene, wc.Mesh(last, mesh.triangles)):
        assert wc.intersections(one).pairs[0].tolist() == expected[11].tolist() and len(expected[11])


def test_the_command_and_bad_input(tmp_path, capfd, monkeypatch):
    mesh, frames = strip(2, n=5)
    np.savez(tmp_path / "a.npz", points=frames, triangles=mesh.triangles)
    path, stage = tmp_path / "a.npz", tmp_path / "out.usdc"
    code, out, err = run(capfd, "check", path, "--fps", "24", "-o", stage, "--single-file")
    assert (code, err) == (0, "") and "clean; 60 triangles" in out and "intersections none" in out
    assert len(wc.usd.FrameSequence(stage)) == 2
    code, out, _err = run(capfd, "check", path, "--stretch", "0.5")
    assert code == 1 and "limits of edges: exceeded in 2 frames" in out
    refused(capfd, ["check", tmp_path / "none.usdc"], "no such file")
    refused(capfd, ["check", path, "--prim", "a", "b"], "must be one name")
    refused(capfd, ["check", path, "--stretch", "-1"], "stretch is -1")
    refused(capfd, ["check", path, "-p", "n=4"], "a.npz is no scene; leave it out")
    refused(capfd, ["check", "hangin"], "there is no scene 'hangin'")
    refused(capfd, ["check", path, "--csv", path], "file of the input")
    refused(capfd, ["check", path, "--still", "a.gif"], "must end with .png")
    for call, message in (
        (lambda: wc.intersections(frames), "mesh is not given"),
        (lambda: wc.intersections(frames, mesh, every=0), "every is 0"),
        (lambda: wc.intersections(frames, mesh, prim="a"), "prim is 'a'"),
        (lambda: wc.intersections(path, wc.Mesh.grid(3, 3)), "mesh has 8 triangles"),
        (lambda: wc.intersections(frames[:, :-1], mesh), "frames has shape"),
        (lambda: wc.intersections(None, mesh.triangles), "frames is None"),
        (lambda: wc.intersections(frames, mesh, prim=5), "prim is 5"),
        (lambda: wc.intersections(path, prim=[]), r"prim is \[\]"),
        (lambda: wc.intersections(frames, mesh, colliders=wc.Plane()), "colliders is Plane"),
        (lambda: wc.intersections(frames, mesh, colliders=["a"]), r"colliders\[0\] is 'a'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    pairs, seen = Crossings.pairs, []

    def interrupted(self, *given):
        seen.append(pairs(self, *given))
        if len(seen) > 1:
            raise KeyboardInterrupt
        return seen[-1]

    monkeypatch.setattr(Crossings, "pairs", interrupted)
    code, out, err = run(capfd, "check", path, "-o", tmp_path / "cut.usdc")
    assert (code, out) == (130, "") and "interrupted after 1 of 2 frames; frames 0 to 0 are in" in err
    assert len(wc.usd.FrameSequence(tmp_path / "cut.usdc")) == 1
    monkeypatch.setattr(crossings, "find_spec", lambda name: None)
    refused(capfd, ["check", path], "intersections need libigl: pip install -e '.[check]' in the checkout")
