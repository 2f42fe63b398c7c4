"""Mesh sequences: stages of other programs and our own, folders of files, arrays, and everything that is refused."""

import re
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

import warpcloth as wc
from support.mesh_texts import TEXTS
from warpcloth.mesh.frame_names import frames_of_names
from warpcloth.mesh.mesh import Mesh, Surface
from warpcloth.mesh.sequences import as_sequence, open_sequence
from warpcloth.scenes import hanging
from warpcloth.usd import FrameSequence, read_mesh

EPS32, EPS = np.finfo(np.float32).eps, np.finfo(np.float64).eps
FRAMES = 5
MESH = Mesh.grid(3, 3)
NAN = np.nan


def motion(mesh, frame):
    """Points that tell the frame and the vertex, of numbers that float32 has exactly."""
    return mesh.points + np.array([frame, 0.0, 0.125 * frame]) + 0.25 * (np.arange(3 * len(mesh.points)).reshape(-1, 3) % 2)


def frames(mesh=MESH, count=FRAMES):
    return np.array([motion(mesh, frame) for frame in range(count)])


# ---------------------------------------------------------------------------------------------------------- stages


def cache(path, codes=(101, 102, 103, 104), rest=True, moving=True):
    """Two quads in cm, z up, left-handed, under a group that turns and moves: stage, prim, points in the world (F, 6, 3)."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(48)
    stage.SetFramesPerSecond(24)
    group = UsdGeom.Xform.Define(stage, "/Rig")
    move, turn = group.AddTranslateOp(), group.AddRotateZOp(UsdGeom.XformOp.PrecisionDouble)
    group.AddScaleOp().Set(Gf.Vec3f(2, 3, 4))
    sheet = UsdGeom.Mesh.Define(stage, "/Rig/Sheet")
    sheet.CreateOrientationAttr("leftHanded")
    sheet.CreateFaceVertexCountsAttr([4, 4])
    sheet.CreateFaceVertexIndicesAttr([0, 1, 4, 3, 1, 2, 5, 4])
    points = np.array([(x, y, 0) for y in (0, 100) for x in (0, 100, 250)], dtype=np.float32)
    if rest:
        sheet.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    placed = []
    for frame, code in enumerate(codes):
        now = points + np.float32([0, 0, 10 * frame])
        sheet.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(now), code)
        angle = 30.0 + 20.0 * frame if moving else 30.0
        offset = (7.0 * frame, -3.0, 0.5) if moving else (7.0, -3.0, 0.5)
        if moving or frame == 0:
            move.Set(Gf.Vec3d(offset), code)
            turn.Set(angle, code)
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turned = (now.astype(np.float64) * [2, 3, 4]) @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])
        placed.append(0.01 * (turned + offset))
    stage.Save()
    return stage, sheet.GetPrim(), np.array(placed)


# Coordinates up to 5 m, of a few products of numbers whose rounding is EPS each.
PLACED = 5 * 16 * EPS


@pytest.mark.parametrize("ending", ["usda", "usdc"])
@pytest.mark.parametrize("moving", [True, False], ids=["moving", "still"])
def test_cache_of_another_program(tmp_path, ending, moving):
    _stage, _prim, expected = cache(tmp_path / f"cache.{ending}", moving=moving)
    sequence = open_sequence(tmp_path / f"cache.{ending}")
    assert len(sequence) == 4 and sequence.missing == [] and sequence.declared
    for frame, points in enumerate(expected):
        assert sequence[frame].dtype == np.float64
        np.testing.assert_allclose(sequence[frame], points, rtol=0, atol=PLACED)
    held = as_sequence(sequence.mesh, FrameSequence(tmp_path / f"cache.{ending}"))
    np.testing.assert_array_equal(held.times, sequence.times)
    np.testing.assert_array_equal(list(held), list(sequence))
    assert sequence.labels.tolist() == [101, 102, 103, 104] and sequence.labels.dtype == np.int64
    np.testing.assert_allclose(sequence.times, np.arange(4) / 48, rtol=4 * EPS)
    # Quads are cut from their first corner, and turned for the front of a left-handed prim.
    assert isinstance(sequence.mesh, Surface)
    assert sequence.mesh.triangles.tolist() == [[4, 1, 0], [3, 4, 0], [5, 2, 1], [4, 5, 1]]
    np.testing.assert_allclose(sequence.mesh.points, expected[0], rtol=0, atol=PLACED)
    assert sequence.stage.prim == "/Rig/Sheet" and sequence.path == sequence.stage.path == str(tmp_path / f"cache.{ending}")
    assert (sequence.stage.up_axis, sequence.stage.meters_per_unit) == ("Z", 0.01)


def test_a_transform_of_one_sample_counts(tmp_path):
    _stage, _prim, expected = cache(tmp_path / "cache.usda", moving=False)
    np.testing.assert_allclose(read_mesh(tmp_path / "cache.usda").points, expected[0], rtol=0, atol=PLACED)
    np.testing.assert_allclose(FrameSequence(tmp_path / "cache.usda"), expected, rtol=0, atol=5 * EPS32)


def test_velocities_in_a_moving_space_have_those_of_the_space(tmp_path):
    """The points rise along the axis about which the space turns, so both add up to the differences of positions."""
    codes = (101, 102, 103, 104)
    stage, prim, expected = cache(tmp_path / "cache.usda", codes)
    for code in codes:
        UsdGeom.Mesh(prim).CreateVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(np.tile(np.float32([0, 0, 480]), (6, 1))), code)
    stage.Save()
    found = np.asarray(FrameSequence(tmp_path / "cache.usda", attribute="velocities"))
    differences = 48.0 * np.diff(np.array(expected), axis=0)
    np.testing.assert_allclose(found[1:], differences, rtol=0, atol=5 * EPS32 * np.abs(differences).max())


def test_without_a_rest_shape_the_first_frame_is_taken(tmp_path):
    _stage, _prim, expected = cache(tmp_path / "cache.usda", rest=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sequence = open_sequence(tmp_path / "cache.usda")
    assert not sequence.declared
    np.testing.assert_array_equal(sequence.mesh.points, sequence[0])
    np.testing.assert_allclose(sequence[0], expected[0], rtol=0, atol=PLACED)


@pytest.mark.parametrize(
    ("codes", "missing"),
    [
        ((0, 1, 2), []),
        ((3,), []),
        ((1, 2, 4), [3]),
        ((1, 3, 4), [2]),
        ((-2, 0, 2, 8, 10), [4, 6]),
        ((0, 0.5, 1.5, 2), [1.0]),
        ((0, 0.5, 1.5), [1.0]),
        ((1001, 1001.4, 1001.8, 1002.6, 1003), [1002.2]),
        ((1, 2, 4, 6, 8), [3, 5, 7]),
        ((1, 10, 17, 40), []),  # poses, not frames
        ((1, 1.25, 2, 2.25, 3, 3.25), []),  # a shutter of a quarter
    ],
)
def test_time_codes(tmp_path, codes, missing):
    cache(tmp_path / "cache.usda", codes)
    sequence = open_sequence(tmp_path / "cache.usda")
    assert sequence.labels.tolist() == list(codes)
    assert sequence.labels.dtype == (np.float64 if any(code % 1 for code in codes) else np.int64)
    assert sequence.missing == pytest.approx(missing, rel=4 * EPS)
    assert all(isinstance(label, int) for label in sequence.missing) or sequence.labels.dtype == np.float64
    for fps in (None, 30):
        times = (np.array(codes) - codes[0]) / (fps or 48)
        np.testing.assert_allclose(open_sequence(tmp_path / "cache.usda", fps=fps).times, times, rtol=4 * EPS)


def test_result_of_a_run(tmp_path, device):
    scene = hanging.scene(n=4)
    output = str(tmp_path / "out.usdc")
    kept = wc.simulate(scene, wc.Newton(dt=1 / 240), frames=3, device=device)
    written = wc.simulate(scene, wc.Newton(dt=1 / 240), frames=3, device=device, output=output)
    sequence = open_sequence(output)
    assert sequence.declared and sequence.labels.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(sequence.mesh.points, scene.mesh.points, atol=EPS32)
    for other in (as_sequence(scene.mesh, kept), as_sequence(scene.mesh, written), sequence):
        assert len(other) == 4 and other.mesh.triangles.tolist() == scene.mesh.triangles.tolist()
        np.testing.assert_allclose(other.times, kept.times, rtol=4 * EPS)
        for frame, points in enumerate(other):
            assert points.dtype == np.float64
            np.testing.assert_array_equal(np.float32(points), np.float32(kept.points[frame]))  # as files hold them


def test_faces_may_be_sampled(tmp_path):
    stage, prim, expected = cache(tmp_path / "cache.usda")
    for name in ("faceVertexCounts", "faceVertexIndices"):
        attribute = prim.GetAttribute(name)
        value = attribute.Get()
        attribute.Clear()
        for code in (101, 103):
            attribute.Set(value, code)
    stage.Save()
    sequence = open_sequence(tmp_path / "cache.usda")
    np.testing.assert_allclose(sequence[3], expected[3], rtol=0, atol=PLACED)


BROKEN_FRAMES = [  # attribute, its value at time code 103, message
    ("points", Vt.Vec3fArray(5), "5 points at time code 103, must be 6"),
    ("points", Vt.Vec3fArray(7), "7 points at time code 103, must be 6"),
    ("points", Sdf.ValueBlock(), "0 points at time code 103, must be 6"),
    ("faceVertexCounts", [4], "1 faceVertexCounts at time code 103, must stay 2"),
    ("faceVertexCounts", [3, 5], r"faceVertexCounts\[0\] is 3 at time code 103, must stay 4"),
    ("faceVertexIndices", [0, 1, 4, 3], "4 faceVertexIndices at time code 103, must stay 8"),
    ("faceVertexIndices", [0, 1, 4, 3, 1, 2, 4, 5], r"faceVertexIndices\[6\] is 4 at time code 103, must stay 5"),
    ("/Rig.xformOp:rotateZ", NAN, "time code 103: the transform to world space is .*, must be affine and finite"),
]


@pytest.mark.parametrize(("name", "value", "message"), BROKEN_FRAMES)
def test_broken_frame_of_a_stage(tmp_path, name, value, message):
    stage, prim, expected = cache(tmp_path / "cache.usda")
    attribute = stage.GetAttributeAtPath(name) if name[0] == "/" else prim.GetAttribute(name)
    if name.startswith("face"):
        attribute.Set(attribute.Get(), 101)
    attribute.Set(value, 103)
    stage.Save()
    sequence = open_sequence(tmp_path / "cache.usda")
    np.testing.assert_allclose(sequence[1], expected[1], rtol=0, atol=PLACED)
    where = re.escape(str(tmp_path / "cache.usda"))
    with pytest.raises(ValueError, match=f"^{where}, prim /Rig/Sheet[:,] {message}"):
        sequence[2]


@pytest.mark.parametrize(
    ("prim", "kept", "rest", "message"),
    [
        ("Shirt", True, 6, "prim Shirt: there is no such prim"),
        (None, True, 9, "prim /Rig/Sheet: 6 points at time code 101, must be 9 as at rest"),
        (None, False, 6, "prim /Rig/Sheet: points have no time samples.*not animated"),
    ],
)
def test_stages_that_are_refused(tmp_path, prim, kept, rest, message):
    stage, sheet, _ = cache(tmp_path / "cache.usda")
    if not kept:
        sheet.GetAttribute("points").Clear()
    sheet.GetAttribute("points").Set(Vt.Vec3fArray(rest))
    stage.Save()
    with pytest.raises(ValueError, match=f"cache.usda, {message}"):
        open_sequence(tmp_path / "cache.usda", prim=prim)


# ---------------------------------------------------------------------------------------------------------- files


def export(path, points, triangles=MESH.triangles):
    text = TEXTS.get(path.suffix.lower()[1:], TEXTS["off"])
    path.write_text(text(points, np.asarray(triangles).tolist()))


def folder(path, names, ending="obj"):
    """Frame k of the motion under the k-th name."""
    path.mkdir(exist_ok=True)
    for frame, name in enumerate(names):
        export(path / f"{name}.{ending}", motion(MESH, frame))
    return path


NUMBERED = [  # names in the order of their numbers, labels, missing
    (["a_8", "a_9", "a_10", "a_11"], [8, 9, 10, 11], []),
    (["v2_shirt.0998", "v2_shirt.0999", "v2_shirt.1000"], [998, 999, 1000], []),
    (["2m", "4m", "8m", "10m"], [2, 4, 8, 10], [6]),
    (["take7_1", "take3_2", "take5_5"], [1, 2, 5], [3, 4]),
    (["00", "1"], [0, 1], []),
    (["lone3"], [3], []),
    (["c_-4", "c_-3", "c_-2", "c_-1"], [-4, -3, -2, -1], []),
    (["-1", "+0", "1"], [-1, 0, 1], []),
    (["c.-0010", "c.-0008", "c.0000"], [-10, -8, 0], [-6, -4, -2]),
    (["c−2", "c−1", "c0"], [-2, -1, 0], []),
    (["c-1", "c0", "c1"], [-1, 0, 1], []),
    (["cloth-1", "cloth-2", "cloth-3"], [1, 2, 3], []),
    (["2026-07-08", "2026-07-09"], [8, 9], []),
    (["c_-0.5", "c_0.0", "c_0.5", "c_1.0"], [-0.5, 0, 0.5, 1], []),
    (["c_1", "c_1.25", "c_1.5", "c_1.75", "c_2"], [1, 1.25, 1.5, 1.75, 2], []),
    (["c_0,00", "c_0,33", "c_0,67", "c_1,00"], [0, 0.33, 0.67, 1], []),
    (["c_1.00", "c_2.00", "c_3.00"], [1, 2, 3], []),
    (["shirt_v2.0998", "shirt_v2.1008"], [998, 1008], []),
    (["take_2.0998", "take_2.0999", "take_2.1001"], [998, 999, 1001], [1000]),
    (["shot010.0001", "shot010.0011", "shot010.0021"], [1, 11, 21], []),
    (["cloth_2.0100", "cloth_2.0102"], [100, 102], []),
    (["body.1.1001", "body.1.1003"], [1001, 1003], []),
    (["a_1.2.3", "a_1.2.4", "a_1.2.10"], [3, 4, 10], [5, 6, 7, 8, 9]),
    (["c_1.0000", "c_1.5000", "c_2.0000"], [1, 1.5, 2], []),
    (["cloth -1", "cloth -2"], [1, 2], []),
    (["cloth -1", "cloth 0", "cloth 1"], [-1, 0, 1], []),
]


@pytest.mark.parametrize("ending", ["obj", "ply", "off", "OBJ"])
@pytest.mark.parametrize(("names", "labels", "missing"), NUMBERED, ids=[row[0][0] for row in NUMBERED])
def test_files_in_order(tmp_path, ending, names, labels, missing):
    where = folder(tmp_path / "frames", names, ending)
    (where / "cloth.mtl").write_text("newmtl red\n")
    (where / f".hidden_7.{ending}").write_text("")
    (where / f"sub_7.{ending}").mkdir()
    for path in (where, where / f"*.{ending}"):
        sequence = open_sequence(path, fps=25)
        assert sequence.labels.tolist() == labels and sequence.missing == missing
        assert sequence.labels.dtype == (np.float64 if any(label % 1 for label in labels) else np.int64)
        np.testing.assert_allclose(sequence.times, (np.array(labels) - labels[0]) / 25, rtol=4 * EPS)
        assert isinstance(sequence.mesh, Surface) and not sequence.declared and sequence.stage is None
        assert sequence.mesh.triangles.tolist() == MESH.triangles.tolist() and sequence.path == str(path)
        np.testing.assert_array_equal(sequence.mesh.points, motion(MESH, 0))
        for frame, points in enumerate(sequence):
            np.testing.assert_array_equal(points, motion(MESH, frame))


@settings(deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.integers(-40, 400), min_size=2, max_size=9, unique=True),
    st.sampled_from(["c_{}", "c.{}", "{}", "take7_{}_low", "v2.x_{}"]),
    st.sampled_from(["{:d}", "{:04d}", "{:+04d}"]),
    st.sampled_from([1, 2, 4]),
)
def test_numbers_in_names_come_back_in_order_or_are_refused(ticks, pattern, digits, parts):
    frames = {tick / parts: Path("frames", pattern.format(digits.format(tick))) for tick in ticks}
    if parts > 1:
        frames = {frame: Path("frames", pattern.format(f"{frame:.2f}")) for frame in frames}
    files = {frame: path.with_name(f"{path.name}.obj") for frame, path in frames.items()}
    try:
        found = frames_of_names(files.values())
    except ValueError as error:
        assert str(error).startswith("frames/") and len({int(abs(frame)) for frame in files}) < len(files)
    else:
        assert [*found.items()] == sorted(files.items())


def test_a_pattern_or_a_name_chooses(tmp_path):
    folder(tmp_path / "a", ["shirt_1", "shirt_2", "trousers_1"])
    assert len(open_sequence(str(tmp_path / "?" / "shirt_*"), fps=24)) == 2
    folder(tmp_path / "[a]", ["1", "2"])  # a folder that looks like a pattern
    assert len(open_sequence(tmp_path / "[a]", fps=24)) == 2
    for frame in range(3):
        ball = f"o ball\nv 0 0 {frame}\nv 1 0 0\nv 0 1 0\nf 10 11 12\n"
        (tmp_path / f"{frame}.obj").write_text(f"o shirt\n{TEXTS['obj'](motion(MESH, frame), MESH.triangles.tolist())}{ball}")
    assert open_sequence(tmp_path, "shirt", 24)[2].shape == (9, 3)
    assert open_sequence(tmp_path, "ball", 24)[2][0, 2] == 2.0
    with pytest.raises(ValueError, match=r"0.obj: has several geometries, name one of them: 'ball', 'shirt'"):
        open_sequence(tmp_path, fps=24)


ROWS = MESH.triangles.tolist()
BROKEN_FILES = [  # text of frame 3, message
    (TEXTS["obj"](MESH.points[:8], ROWS[:1]), "8 vertices, must be 9 as in .*cloth_1.obj"),
    (TEXTS["obj"](MESH.points, ROWS[:-1]), "7 faces, must be 8 as in .*cloth_1.obj"),
    (
        TEXTS["obj"](MESH.points, [*ROWS[:5], (4, 8, 7), *ROWS[6:]]),
        r"face 5 has vertices \[4, 8, 7\], must be \[.*\] as in .*cloth_1.obj",
    ),
    ("", "the file is empty"),
    ("v 0 0 0\n", "has no triangles"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN_FILES, ids=["vertices", "count", "triangle", "empty", "cloud"])
def test_broken_file(tmp_path, text, message):
    where = folder(tmp_path / "frames", ["cloth_1", "cloth_2", "cloth_3", "cloth_4"])
    (where / "cloth_3.obj").write_text(text)
    sequence = open_sequence(where, fps=24)
    np.testing.assert_array_equal(sequence[3], motion(MESH, 3))
    with pytest.raises(ValueError, match=f"^{re.escape(str(where / 'cloth_3.obj'))}: {message}"):
        sequence[2]


REFUSED_FOLDERS = [  # names of files, what is opened, fps, kind of error, message
    (["1.obj", "2.obj"], "", 0, ValueError, "fps is 0; it must be a number above 0"),
    (["1.obj", "2.ply"], "", 24, ValueError, r'has files of several kinds, .obj .ply; give a pattern of one, such as "\*.obj"'),
    (["1.stl", "2.stl"], "", 24, ValueError, ".stl files repeat vertices, .* must end with .obj .ply .off"),
    (["1.glb", "2.glb"], "*.glb", 24, ValueError, ".glb files repeat vertices"),
    (["1.obj", "cloth.obj"], "", 24, ValueError, "cloth.obj: has no number in its name"),
    (["1.obj", "a_01.obj"], "", 24, ValueError, "a_01.obj: has number 1, the last in its name, as .*1.obj has"),
    (["c_1.00.obj", "c_1.25.obj"], "", 24, ValueError, "c_1.00.obj: may be frame 1.00 or frame 0; rename the files so that"),
    (["c_1.1.obj", "c_1.2.obj"], "", 24, ValueError, "may be frame 1.1 or frame 1; rename"),
    (["c_1.0001.obj", "c_2.0002.obj"], "", 24, ValueError, "may be frame 1.0001 or frame 1; rename"),
    (["c_0.0100.obj", "c_0.0200.obj"], "", 24, ValueError, "may be frame 0.0100 or frame 100; rename"),
    (["c0.obj", "c-1.obj", "c-2.obj"], "", 24, ValueError, "c-1.obj: may be frame -1 or frame 1; rename the files so that"),
    (["c 0.obj", "c -1.obj"], "", 24, ValueError, "c -1.obj: may be frame -1 or frame 1; rename"),
    (["c_0.obj", "c_-0.obj"], "", 24, ValueError, "c_0.obj: has number 0, the last in its name, as .*c_-0.obj has"),
    (["c_" + 16 * "1" + ".obj"], "", 24, ValueError, "has a number of 16 digits in its name, must have 15 at most"),
    (["1.mtl"], "", 24, ValueError, "no mesh files there; they must end with .obj .ply .off"),
    (["1.obj"], "*.ply", 24, ValueError, r"\*.ply: no mesh files there"),
    (["1.obj"], "1.obj", 24, ValueError, r'1.obj: is one mesh; it must be a folder of them, or a pattern such as ".*/\*.obj"'),
    (["1.ply"], "1.ply", 24, ValueError, r'1.ply: is one mesh; .* or a pattern such as ".*/\*.ply"'),
    (["1.mtl"], "1.mtl", 24, ValueError, "1.mtl: must be a folder or pattern of mesh files, or end with .usd .* .npz .npy"),
    (["1.obj"], "none.usdc", 24, FileNotFoundError, "none.usdc: there is no such file"),
    (["1.obj"], "elsewhere", 24, FileNotFoundError, "elsewhere: no such file or folder"),
]


@pytest.mark.parametrize(("names", "opened", "fps", "kind", "message"), REFUSED_FOLDERS)
def test_folders_that_are_refused(tmp_path, names, opened, fps, kind, message):
    for name in names:
        export(tmp_path / name, MESH.points)
    where = "" if fps == 0 else re.escape(str(tmp_path))
    with pytest.raises(kind, match=f"^{where}.*{message}"):
        open_sequence(tmp_path / opened, fps=fps)


# ---------------------------------------------------------------------------------------------------------- arrays


def test_array_files(tmp_path):
    points, times = frames().astype(np.float32), np.array([0.0, 0.1, 0.3, 0.4, 0.5])
    np.savez(tmp_path / "a.npz", points=points, triangles=MESH.triangles)
    np.savez(tmp_path / "timed[1].npz", times=times, triangles=MESH.triangles, points=np.asfortranarray(points))
    np.save(tmp_path / "a.npy", points)
    opened = [
        (open_sequence(tmp_path / "a.npz", fps=10), np.arange(FRAMES) / 10, False),
        (open_sequence(tmp_path / "timed[1].npz"), times, False),
        (open_sequence(tmp_path / "timed[1].npz", fps=10), np.arange(FRAMES) / 10, False),
        (open_sequence(tmp_path / "a.npy", fps=10, mesh=MESH), np.arange(FRAMES) / 10, True),
    ]
    for sequence, expected, declared in opened:
        assert sequence.labels.tolist() == list(range(FRAMES)) and sequence.missing == []
        assert sequence.declared == declared and sequence.mesh.triangles.tolist() == MESH.triangles.tolist()
        np.testing.assert_array_equal(sequence.mesh.points, MESH.points if declared else points[0])
        np.testing.assert_allclose(sequence.times, expected, rtol=4 * EPS)
        np.testing.assert_array_equal(list(sequence), points)


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_array_files_stay_on_disk(tmp_path, ending):
    mesh, count = Mesh.grid(32, 32), 200
    points = np.zeros((count, 1024, 3))
    if ending == "npz":
        np.savez(tmp_path / "a.npz", points=points, triangles=mesh.triangles)
    else:
        np.save(tmp_path / "a.npy", points)
    tracemalloc.start()
    try:
        for frame in open_sequence(tmp_path / f"a.{ending}", fps=24, mesh=mesh):
            assert not frame.any()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # The mesh and its topology take less than 10 frames, and all frames would be 200.
    assert peak < 40 * points[0].nbytes


REFUSED_ARRAYS = [  # ending, what is written, fps, message
    ("npz", {"points": frames()}, 24, "has no array 'triangles', only points"),
    ("npz", {"points": frames()[0], "triangles": MESH.triangles}, 24, r"points has shape \(9, 3\); it must be \(frames, vert"),
    ("npz", {"points": frames()[:, :8], "triangles": MESH.triangles}, 24, "must be indices of the 8 points"),
    ("npz", {"points": frames(), "triangles": MESH.triangles, "times": [0, 1]}, None, r"times has shape \(2,\); .* \(5,\)"),
    (
        "npz",
        {"points": frames(), "triangles": MESH.triangles, "times": [0, 1, 1, 2, 3]},
        None,
        r"times\[2\] is 1.0; it must be la",
    ),
    ("npz", {"points": np.array(["x"]), "triangles": MESH.triangles}, 24, "points.npy has type <U1, must be real numbers"),
    ("npz", b"no archive", 24, "is no .npz file, as np.savez writes it"),
    ("npy", b"no array", 24, "is no .npy file, as np.save writes it"),
    ("npy", b"", 24, "is no .npy file"),
    ("npy", np.array([MESH]), 24, "cannot be read as .npy: .* Python objects"),
    ("npy", frames()[:, :8], 24, r"points has shape \(5, 8, 3\); it must be \(frames, 9, 3\) for the points of the mesh"),
]


@pytest.mark.parametrize(("ending", "content", "fps", "message"), REFUSED_ARRAYS)
def test_array_files_that_are_refused(tmp_path, ending, content, fps, message):
    path = tmp_path / f"a.{ending}"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif ending == "npz":
        np.savez(path, **content)
    else:
        np.save(path, content)
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}: .*{message}"):
        open_sequence(path, fps=fps, mesh=MESH)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.npy", {}, "has no triangles; give a rest mesh .* 'warpcloth convert a.npy a.npz --rest MESH'"),
        ("a.npy", {"prim": "Sheet", "mesh": MESH}, "prim is 'Sheet', and arrays have no prims; leave it out"),
        ("a.npy", {"fps": 1e-100, "mesh": MESH}, r"times are from 0 to 4e\+100 s; they must be within 1e\+15 s"),
        ("a.npz", {}, "points.npy is compressed, .*; write it by np.savez"),
    ],
)
def test_array_files_that_need_more(tmp_path, name, options, message):
    np.save(tmp_path / "a.npy", frames())
    np.savez_compressed(tmp_path / "a.npz", points=frames(), triangles=MESH.triangles)
    with pytest.raises(ValueError, match=f"{name}: {message}"):
        open_sequence(tmp_path / name, **({"fps": 24} | options))


@pytest.mark.parametrize(
    "held",
    [frames(), frames().astype(np.float32), list(frames()), tuple(frames().tolist()), np.asfortranarray(frames())],
    ids=["array", "float32", "list", "tuple", "columns"],
)
def test_what_python_holds(held):
    even = as_sequence(MESH, held, dt=0.1)
    np.testing.assert_allclose(even.times, 0.1 * np.arange(FRAMES), rtol=4 * EPS)
    times = np.array([-1.0, 0.0, 0.5, 2.0, 2.25])
    sequence = as_sequence(MESH, held, times=times)
    np.testing.assert_array_equal(sequence.times, times)
    assert sequence.mesh is MESH and sequence.path is None and sequence.stage is None and sequence.declared
    assert sequence.labels.tolist() == list(range(FRAMES)) and len(sequence) == FRAMES
    np.testing.assert_array_equal(list(sequence), frames())
    assert all(points.dtype == np.float64 for points in sequence)
    np.testing.assert_array_equal(sequence[-1], sequence[np.int32(FRAMES - 1)])
    sequence[0][:] = 7.0
    np.testing.assert_array_equal(sequence[0], frames()[0])
    for wrong, kind in ((FRAMES, IndexError), (-FRAMES - 1, IndexError), (1.0, TypeError), (slice(2), TypeError)):
        with pytest.raises(kind):
            sequence[wrong]


def test_frames_without_times_and_of_several_types(tmp_path):
    """The coarsest numbers say how frames are rounded."""
    one = frames()[0]
    for kinds, precision in (((np.float64, np.float32), np.float32), ((np.float64, np.int64), np.float64)):
        assert as_sequence(MESH, [one.astype(kind) for kind in kinds]).precision is precision
    assert as_sequence(MESH, frames()).times is None
    np.save(tmp_path / "f.npy", frames())
    assert open_sequence(tmp_path / "f.npy", mesh=MESH).times is None
    np.savez(tmp_path / "f.npz", points=frames(), triangles=MESH.triangles)
    assert open_sequence(tmp_path / "f.npz").times is None


REFUSED = [  # mesh, frames, options, message
    (MESH, np.ma.masked_less(frames(), 0.1), {}, "frames is partly masked; it must have all points"),
    (MESH, frames(), {"dt": 0.1, "times": np.arange(5)}, "dt, times: both are given"),
    (MESH, frames(), {"dt": 0.0}, "dt is 0.0; it must be a number above 0"),
    (MESH, frames(), {"times": [0, 1, 2, 3]}, r"times has shape \(4,\); it must be \(5,\)"),
    (MESH, frames(), {"times": [0, 1, 2, NAN, 4]}, r"times\[3\] is nan; it must be finite"),
    (MESH, frames(), {"times": [0, 2, 1, 3, 4]}, r"times\[2\] is 1.0; it must be later than the one before"),
    (MESH, frames()[:, :8], {"dt": 1}, r"frames has shape \(5, 8, 3\); it must be \(frames, 9, 3\)"),
    (MESH, frames()[0], {"dt": 1}, r"frames has shape \(9, 3\); it must be"),
    (MESH, frames()[:0], {"dt": 1}, r"frames has shape \(0, 9, 3\); it must be"),
    (MESH, [], {"dt": 1}, r"frames has shape \(0, 9, 3\); it must be"),
    (MESH, np.stack([frames(), frames()], 1), {"dt": 1}, r"of several copies give one, as in frames\[:, 0\]"),
    (MESH, [*frames()[:3], frames()[3, :8]], {"dt": 1}, r"frames\[3\] has shape \(8, 3\); it must be \(9, 3\)"),
    (MESH, [frames()[0], "curtain"], {"dt": 1}, r"frames\[1\] is 'curtain', which is not numeric"),
    (MESH, frames().astype(complex), {"dt": 1}, "frames has type complex128; it must be real numbers"),
    (MESH, 7, {"dt": 1}, r"frames has shape \(\); it must be"),
    (MESH.points, frames(), {"dt": 1}, "mesh is .*; it must be a Mesh"),
    (Mesh.chain(9), frames(), {"dt": 1}, "mesh: has edges and no triangles"),
]


@pytest.mark.parametrize(("mesh", "held", "options", "message"), REFUSED)
def test_what_python_holds_and_is_refused(mesh, held, options, message):
    with pytest.raises(ValueError, match=message):
        as_sequence(mesh, held, **options)


@pytest.mark.parametrize(
    ("axes", "corners", "message"),
    [
        (3, (0, 1, 9), r"triangles\[0\] is \[0, 1, 9\]; it must be indices of the 9 points"),
        (2, (0, 1, 2), r"points: has shape \(9, 2\)"),
    ],
)
def test_surface_still_refuses_what_is_no_mesh(axes, corners, message):
    with pytest.raises(ValueError, match=message):
        Surface(MESH.points[:, :axes], [corners])


# ---------------------------------------------------------------------------------------------------------- flaws


@pytest.mark.parametrize("kind", ["array", "npz", "obj", "ply", "off", "usda"])
@pytest.mark.parametrize("frame", [0, 2])
def test_points_that_are_not_finite_are_as_they_are(tmp_path, kind, frame):
    points = frames()
    points[frame, 4, 1], points[frame, 7] = NAN, (np.inf, 0.0, -np.inf)
    if kind == "array":
        sequence = as_sequence(MESH, points, dt=1)
    elif kind == "npz":
        np.savez(tmp_path / "a.npz", points=points, triangles=MESH.triangles)
        sequence = open_sequence(tmp_path / "a.npz", fps=24)
    elif kind == "usda":
        samples = {code: [*map(tuple, now.tolist())] for code, now in enumerate(points)}
        text = re.sub(r"points = .*", f"points.timeSamples = {samples}", TEXTS["usda"](MESH.points, MESH.triangles.tolist()))
        (tmp_path / "a.usda").write_text(text)
        sequence = open_sequence(tmp_path / "a.usda")
    else:
        for number, now in enumerate(points):
            export(tmp_path / f"{number}.{kind}", now)
        sequence = open_sequence(tmp_path, fps=24)
    np.testing.assert_array_equal(list(sequence), points)
    around = np.flatnonzero(np.isin(MESH.triangles, (4, 7)).any(axis=1)).tolist()
    if kind != "array":
        assert sequence.mesh.degenerate.tolist() == (around if frame == 0 else [])


@pytest.mark.parametrize("kind", ["arrays", "obj", "usda"])
def test_surface_has_what_a_mesh_refuses(tmp_path, kind):
    """A square of two triangles with some that are none beside it."""
    points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1), (2, 0, 0), (0.5, 1e-9, 0)]
    triangles = [(0, 2, 3), (0, 1, 4), (0, 3, 1), (2, 2, 3), (0, 1, 5), (3, 3, 3)]
    if kind == "arrays":
        surface, mesh = Surface(points, triangles), lambda: Mesh(points, triangles)
    else:
        path = tmp_path / f"flawed.{kind}"
        export(path, points, triangles)
        surface, mesh = Surface.load(path), lambda: Mesh.load(path)
    assert isinstance(surface, Surface) and repr(surface).startswith("Surface(6 points, 6 triangles")
    assert surface.degenerate.tolist() == [1, 3, 4, 5] and surface.degenerate.dtype == np.int32
    assert surface.triangles.tolist() == [list(triangle) for triangle in triangles]
    np.testing.assert_array_equal(surface.triangle_areas[[0, 2, 3, 5]], [0.5, 0.5, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"triangles\[3\] is \[2, 2, 3\]; it must be 3 different vertices"):
        mesh()
    assert len(Surface(MESH.points, MESH.triangles).degenerate) == 0
