"""Pictures and films: every source and ending, what films hold, and what is refused."""

import importlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import warpcloth as wc
from support.command_line import refused, run
from support.mesh_texts import obj
from support.stage_texts import prim
from warpcloth.cli import check as checking
from warpcloth.cli import render as drawing
from warpcloth.cli.terminal import Counter
from warpcloth.picture import render as rendering
from warpcloth.picture.colour import Scale, to_linear
from warpcloth.picture.films import durations, open_film
from warpcloth.picture.measured import scale_of
from warpcloth.picture.overlay import Overlay, round_numbers, written
from warpcloth.picture.shape import CLOTH
from warpcloth.picture.subjects import SURROUNDINGS, subject_of
from warpcloth.run import recorders
from warpcloth.usd import AnimationWriter

ROOT = Path(__file__).parents[2]

SMALL = {"size": (64, 36), "samples": 1}
SIZE = ("--size", "64x36", "--samples", "1")
FPS, FRAMES = 24.0, 6
MESH = wc.Mesh.grid(4, 4)


def face(*points):
    corners = f"int[] faceVertexCounts = [{len(points)}]\nint[] faceVertexIndices = {[*range(len(points))]}"
    return f"{corners}\npoint3f[] points = {[*points]}"


def square(z):
    return (0, 0, z), (100, 0, z), (100, 100, z), (0, 100, z)


def at(value, *others):
    """Transforms as text, of which the first is a translation."""
    names = ["xformOp:translate", *(text.split()[1] for text in others)]
    order = ", ".join(f'"{name}"' for name in names)
    return "\n".join([f"double3 xformOp:translate{value}", *others, f"uniform token[] xformOpOrder = [{order}]"])


STAGE = '#usda 1.0\n(\nmetersPerUnit = 0.01\nupAxis = "Z"\ntimeCodesPerSecond = 30\n)\n' + "".join(
    [
        prim("Mesh", "Sheet", face(*square(0)), f"point3f[] points.timeSamples = {{1: {[*square(50)]}, 3: {[*square(20)]}}}"),
        prim("Mesh", "Table", face((0, 0, 0), (100, 0, 0), (0, 100, 0)), at(" = (0, 0, -10)")),
        prim(
            "BasisCurves",
            "Rope",
            'uniform token type = "linear"\nint[] curveVertexCounts = [3]\nfloat[] widths = [4]',
            "point3f[] points = [(0, 0, 50), (50, 50, 90), (100, 100, 50)]",
        ),
        prim("Sphere", "Ball", "double radius = 10", at(".timeSamples = {1: (0, 0, 0), 3: (0, 0, 10)}")),
        prim("Cylinder", "Pole", 'double radius = 2\ndouble height = 80\nuniform token axis = "X"'),
        prim("Plane", "Wall", 'double width = 300\ndouble length = 200\nuniform token axis = "Y"', at(" = (0, 200, 0)")),
        prim("Mesh", "Guide", 'uniform token purpose = "guide"', face((0, 0, 0), (1, 0, 0), (0, 1, 0))),
        prim("Mesh", "Hidden", 'token visibility = "invisible"', face((0, 0, 0), (1, 0, 0), (0, 1, 0))),
    ]
)


def moved(frame):
    """A sheet that is lifted, and stretched along x."""
    return MESH.points * [1.0 + 0.05 * frame, 1.0, 1.0] + [0.0, 0.1 * frame, 0.0]


MOTION = np.array([moved(frame) for frame in range(FRAMES)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of every kind with the motion."""
    found = tmp_path_factory.mktemp("sources")
    with AnimationWriter(found / "cloth.usdc", MESH, FPS, pins={"pins": [0, 3]}) as writer:
        for points in MOTION:
            writer.append(points, np.zeros_like(points))
    (found / "scene.usda").write_text(STAGE)
    np.savez(found / "cloth.npz", points=MOTION, triangles=MESH.triangles, times=np.arange(FRAMES) / FPS)
    np.save(found / "cloth.npy", MOTION)
    (found / "frames").mkdir()
    for k, points in enumerate(MOTION):
        (found / "frames" / f"cloth_{10 + 2 * k}.obj").write_text(obj(points, MESH.triangles.tolist()))
    shutil.copy(found / "frames" / "cloth_10.obj", found / "one.obj")
    chain = wc.Mesh.chain(4)
    with AnimationWriter(found / "chain.usdc", chain, FPS) as writer:
        for k in range(3):
            writer.append(chain.points + np.array([0.0, 0.1 * k, 0.0]), np.zeros_like(chain.points))
    return found


@pytest.fixture(scope="module")
def animation():
    scene = wc.Scene(MESH, density=0.1, terms=[wc.Spring(stiffness=100.0)], pins=[0, 3], duration=0.1)
    return wc.simulate(scene, wc.PBD(substeps=2), copies=2, dtype="float64")


def picture(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.parametrize(
    ("name", "shapes", "labels", "interval"),
    [
        ("cloth.usdc", 1, list(range(FRAMES)), 1 / 24),
        ("scene.usda", 6, [1, 3], 2 / 30),
        ("chain.usdc", 1, [0, 1, 2], 1 / 24),
        ("cloth.npz", 1, list(range(FRAMES)), 1 / 24),
        ("frames", 1, [10, 12, 14, 16, 18, 20], None),
        ("frames/*.obj", 1, [10, 12, 14, 16, 18, 20], None),
        ("one.obj", 1, [0], None),
    ],
)
def test_every_file_is_drawn(folder, name, shapes, labels, interval, tmp_path):
    source, path = folder / name, tmp_path / "out.png"
    subject = subject_of(source)
    assert len(subject.shapes) == shapes and subject.labels.tolist() == labels
    assert subject.times is None if interval is None else np.diff(subject.times)[0] == pytest.approx(interval)
    assert wc.render(source, path, **SMALL) == str(path)
    image = picture(path)
    assert image.shape == (36, 64, 3)
    blue = image[..., 2] - image[..., 0]
    assert "chain" in name or (blue > 40).mean() > 0.05, "the cloth is blue"


def test_a_stage_shows_its_surroundings_in_metres_and_nothing_hidden(folder):
    subject = subject_of(folder / "scene.usda")
    sheet, table, rope, ball, pole, wall = subject.shapes
    assert subject.up_axis == "Z" and subject.coloured == 0 and len(sheet.triangles) == 2
    assert len(rope.lines) == 2 and rope.radius == pytest.approx(0.02)
    assert len({tuple(shape.colour) for shape in subject.shapes}) == 3
    points = subject.read(1)
    assert points[0][:, 2] == pytest.approx([0.2] * 4) and points[1][:, 2] == pytest.approx([-0.1] * 3)
    assert np.linalg.norm(points[3] - [0.0, 0.0, 0.1], axis=1) == pytest.approx([0.1] * ball.count)
    assert np.ptp(points[4], axis=0) == pytest.approx([0.8, 0.04, 0.04], rel=0.01) and len(pole.triangles)
    assert np.ptp(points[5], axis=0) == pytest.approx([3.0, 0.0, 2.0]) and len(wall.triangles) == 2
    chosen = subject_of(folder / "scene.usda", prim="Table")
    assert chosen.shapes[0].count == table.count and tuple(chosen.shapes[0].colour) == tuple(sheet.colour)
    pinned = subject_of(folder / "cloth.usdc").shapes[0]
    assert pinned.balls.tolist() == [0, 3] and pinned.ball_radius > 0.0


UPRIGHT = (-10, 0, -10), (10, 0, -10), (10, 0, 10), (-10, 0, 10)
SURFACE = 'uniform token info:id = "UsdPreviewSurface"\ncolor3f inputs:diffuseColor = (0.8, 0.1, 0)\ntoken outputs:surface'
LOOKS = '#usda 1.0\n(\nmetersPerUnit = 0.01\nupAxis = "Z"\nstartTimeCode = 0\nendTimeCode = 1\n)\n' + "".join(
    [
        prim(
            "Mesh",
            "Sheet",
            face(*UPRIGHT).rpartition("\n")[0],
            f"point3f[] points.timeSamples = {{0: {[*UPRIGHT]}, 1: {[*UPRIGHT]}}}\nSHOWN",
            meta='(prepend apiSchemas = ["MaterialBindingAPI"])',
        ),
        prim(
            "Material",
            "Red",
            "token outputs:surface.connect = </Red/Surface.outputs:surface>",
            prim("Shader", "Surface", SURFACE),
        ),
        prim(
            "Camera",
            "Eye",
            "float focalLength = 50\nfloat horizontalAperture = 40\nfloat verticalAperture = 20",
            at(".timeSamples = {0: (0, -200, 0), 1: (40, -200, 0)}", "float xformOp:rotateX = 90"),
        ),
        prim(
            "Camera",
            "Shifted",
            "float horizontalApertureOffset = 5\nfloat verticalApertureOffset = 5",
            meta="(references = </Eye>)",
        ),
        prim("Camera", "Blind", "float focalLength = 0", meta="(references = </Eye>)"),
        prim("Camera", "Flat", 'token projection = "orthographic"'),
    ]
)


@pytest.mark.parametrize(
    ("shown", "colour"),
    [
        ("rel material:binding = </Red>", (0.8, 0.1, 0.0)),
        ("color3f[] primvars:displayColor = [(0.2, 0.9, 1.5)]", (0.2, 0.9, 1.0)),
        ("rel material:binding = </Red>\n    color3f[] primvars:displayColor = [(0, 1, 0)]", (0.8, 0.1, 0.0)),
        ("color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)]", CLOTH),  # not of the whole prim
        ("", CLOTH),
    ],
)
def test_a_stage_is_drawn_in_its_base_colours(shown, colour, tmp_path):
    path = tmp_path / "looks.usda"
    path.write_text(LOOKS.replace("SHOWN", shown))
    (shape,) = subject_of(path).shapes
    assert tuple(shape.colour) == pytest.approx(colour)


def test_a_stage_is_seen_from_its_camera(tmp_path, capfd):
    """A sheet of 20 cm, 2 m away, is an eighth of the 160 cm that the aperture shows there; the camera moves by a quarter."""
    path = tmp_path / "looks[1].usda"  # no pattern, because the file exists
    path.write_text(LOOKS.replace("SHOWN", "rel material:binding = </Red>"))
    for name, size, frame, middle, width, row in (
        ("Eye", (160, 80), 0, 80, 20, 40),
        ("/Eye", (160, 80), 1, 40, 20, 40),
        ("Eye", (80, 80), 0, 40, 10, 40),  # all of the aperture is in a narrower picture
        ("Eye", (320, 80), 0, 160, 20, 40),
        ("Shifted", (160, 80), 0, 60, 20, 60),  # the aperture is an eighth to the right and a quarter above
    ):
        wc.render(path, tmp_path / "a.png", camera=name, frame=frame, size=size, samples=16, ground=False)
        image = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
        red = image[..., 0] - image[..., 2] > 60
        columns = np.flatnonzero(red.any(axis=0))
        assert np.argwhere(red)[:, 0].mean() + 0.5 == pytest.approx(row, abs=1)
        assert (columns[0], columns[-1] + 1) == pytest.approx((middle - width / 2, middle + width / 2), abs=1)
    for name, source, message in (
        ("Ear", path, "camera is 'Ear'; it must be one of its cameras, /Eye, /Shifted, /Blind, /Flat"),
        ("Flat", path, "prim /Flat: has no perspective, must have it"),
        ("Blind", path, "prim /Blind: focalLength is 0.0; it must be a number above 0"),
        ("Eye", tmp_path / "one.obj", "camera is 'Eye'; one.obj is not a stage and has none"),
    ):
        (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        refused(capfd, ["render", source, "-o", tmp_path / "b.png", "--camera", name], message)


def test_every_result_of_python_is_drawn(animation, tmp_path, device):
    scene = animation.scene
    deformed = wc.deform(MESH, wc.Pins([0, 3], [MESH.points[[0, 3]]] * 2))
    sequence = wc.as_sequence(MESH, MOTION, dt=1 / FPS)
    for source, options in (
        (scene, {}),
        (MESH, {}),
        (wc.Mesh.chain(5), {}),
        (deformed, {}),
        (sequence, {}),
        (MOTION, {"mesh": MESH}),
        (list(MOTION), {"mesh": MESH}),
        (animation, {"copy": 1}),
        ([MESH, sequence], {}),
    ):
        path = tmp_path / "out.png"
        wc.render(source, path, **SMALL, **options, device=device)
        image = picture(path)
        assert np.ptp(image) > 10
        path.unlink()


def test_cloths_of_a_batch_stand_side_by_side(animation):
    both, one = subject_of(animation, azimuth=0.0), subject_of(animation, copy=0)
    n = len(MESH.points)
    assert both.shapes[0].count == 2 * n and one.shapes[0].count == n and len(both.shapes[0].balls) == 4
    points = both.read(2)[0]
    width = np.ptp(np.asarray(animation.points)[..., 0])
    assert points[n:] - points[:n] == pytest.approx(np.tile([1.12 * width, 0.0, 0.0], (n, 1)), abs=1e-6 + 0.12 * width)
    assert points[n:, 0].min() > points[:n, 0].max()


def test_strings_and_bars_of_a_scene_are_drawn():
    from warpcloth.scenes import mobile

    scene = mobile.scene(n=3)
    subject = subject_of(scene)
    lines = [shape for shape in subject.shapes if len(shape.lines)]
    assert len(lines) == 2 and all(shape.count == len(scene.mesh.points) for shape in subject.shapes)


@pytest.mark.slow
def test_colliders_of_a_run_are_drawn_as_those_of_its_stage(tmp_path):
    ball = wc.Sphere(radius=0.2, position=[[0.5, -0.3, 0.5], [0.6, -0.3, 0.5]], name="ball")
    mesh = wc.MeshCollider([[0.0, -1.0, 0.0], [0.0, -1.0, 1.0], [1.0, -1.0, 0.0]], [[0, 1, 2]], name="sheet")
    box = wc.Box(size=(1, 2, 3), position=(0, -5, 0))
    soft = wc.Contact(distance=1e-3, stiffness=1e4)  # explicit steps of 1/960 s are stable
    scene = wc.Scene(MESH, density=0.1, terms=[], colliders=[ball, mesh, box], contact=soft)
    run = {"dtype": "float64"}  # in which tests of contact have the kernels of the filter, which take long to compile
    animation = wc.simulate(scene, wc.Explicit(substeps=16), tmp_path / "cloth.usdc", **run, frames=2)
    drawn, stage = subject_of(animation), subject_of(tmp_path / "cloth.usdc")
    assert [shape.count for shape in drawn.shapes] == [shape.count for shape in stage.shapes]
    for frame in range(3):
        for ours, theirs in zip(drawn.read(frame), stage.read(frame), strict=True):
            assert ours == pytest.approx(theirs, abs=1e-6)
    assert drawn.read(1)[1] - drawn.read(0)[1] == pytest.approx(np.tile([0.1, 0.0, 0.0], (drawn.shapes[1].count, 1)), abs=1e-12)
    both = subject_of(wc.simulate(scene, wc.Explicit(substeps=16), **run, frames=1, copies=2), azimuth=0.0)
    cloths, balls = both.read(1)[:2]
    apart = (cloths[len(MESH.points) :] - cloths[: len(MESH.points)])[0]
    assert np.linalg.norm(apart) > 1.0
    assert balls[len(balls) // 2 :] - balls[: len(balls) // 2] == pytest.approx(np.tile(apart, (len(balls) // 2, 1)), abs=1e-6)


@pytest.mark.parametrize("ending", [".png", ".gif", ".webp", ".mp4"])
def test_the_same_bytes_come_twice(folder, ending, tmp_path, device):
    if ending == ".mp4":
        pytest.importorskip("av")
    paths = [tmp_path / f"{name}{ending}" for name in ("abcdefgh" if ending == ".mp4" else "ab")]
    for path in paths:
        wc.render(folder / "cloth.usdc", path, **SMALL, time=True, device=device)
    assert len({path.read_bytes() for path in paths}) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [path.name for path in paths]


@pytest.mark.parametrize(
    ("source", "options", "count", "rate"),
    [
        ("cloth.usdc", {}, 6, 24),
        ("cloth.usdc", {"every": 2}, 3, 12),
        ("cloth.usdc", {"frames": (1, 3)}, 3, 24),
        ("cloth.usdc", {"frames": (None, 3), "speed": 0.5}, 4, 12),
        ("scene.usda", {}, 2, 15),
        ("frames", {"fps": 60.0}, 6, 30),
        ("frames", {}, 6, 12),
    ],
)
def test_a_film_plays_in_real_time(folder, source, options, count, rate, tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "out.mp4"
    wc.render(folder / source, path, **SMALL, **options)
    with av.open(path) as film:
        stream = film.streams.video[0]
        assert (stream.width, stream.height, stream.frames, stream.codec_context.pix_fmt) == (64, 36, count, "yuv420p")
        assert stream.average_rate == rate and stream.codec_context.name == "h264"
        found = [frame for frame in film.decode(stream)]
        assert [float(frame.time) for frame in found] == pytest.approx(np.arange(count) / rate, abs=1e-6)
        assert (found[0].colorspace, found[0].color_range) == (1, 1)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser plays it while it loads"


def test_a_film_has_the_colours_of_its_pictures(folder, tmp_path):
    """H.264 keeps 8 bits of luma in 219 steps, and a quarter of the pixels' chroma."""
    av = pytest.importorskip("av")
    for ending in ("mp4", "gif"):
        wc.render(folder / "cloth.usdc", tmp_path / f"a.{ending}", **SMALL)
    with av.open(tmp_path / "a.mp4") as film:
        *_, last = film.decode(film.streams.video[0])
        found = last.reformat(format="rgb24", src_colorspace=1).to_ndarray().astype(int)
    with Image.open(tmp_path / "a.gif") as film:
        *_, wanted = (np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film))
    assert np.abs(found.mean(axis=(0, 1)) - wanted.mean(axis=(0, 1))).max() < 2.0
    assert np.abs(found[2:6, 2:6] - wanted[2:6, 2:6]).max() <= 3


@pytest.mark.parametrize(
    ("rate", "wanted"),
    [(24.0, [40, 40, 50, 40, 40, 40]), (60.0, [30, 40, 30]), (1000.0, [1000])],
    ids=["24", "60, every second frame", "1000, too short for more than one"],
)
def test_a_gif_plays_in_real_time(rate, wanted, tmp_path):
    """Hundredths of a second are spread; no frame is shorter than what browsers show."""
    path = tmp_path / "out.gif"
    wc.render(MOTION, path, mesh=MESH, fps=rate, **SMALL, time=True)
    with Image.open(path) as film:
        assert film.n_frames == len(wanted) and film.info.get("loop", 0) == 0
        assert [frame.info["duration"] for frame in ImageSequence.Iterator(film)] == wanted if len(wanted) > 1 else True
        assert all(not frame.tile or len(frame.tile) == 1 for frame in ImageSequence.Iterator(film))
    assert path.read_bytes()[10] & 0x80, "a global palette of all frames"
    assert sum(durations(np.arange(100) / 30.0)) == 3330


def test_the_range_of_the_bar_is_that_of_analyze(folder, tmp_path, capfd):
    code, out, _ = run(capfd, "analyze", folder / "cloth.usdc", "-o", tmp_path / "measured.usdc", "--json")
    low, high = json.loads(out)["colour_range"]
    analyzer = wc.Analyzer(folder / "cloth.usdc")
    scale = scale_of([analyzer], "stretch_1", analyzer.measures[0])
    assert code == 0 and (scale.low, scale.high) == (low, high)
    assert high == pytest.approx(1.25) and low == pytest.approx(0.75)


def test_colours_are_those_of_the_scale(folder, tmp_path, monkeypatch):
    """Of a single frame, of part of a film and of two films the scale is that of all frames."""
    scales = []
    real = rendering.Overlay

    def overlay(size, scale, *more):
        scales.append((scale.low, scale.high, scale.neutral, scale.map))
        return real(size, scale, *more)

    monkeypatch.setattr(rendering, "Overlay", overlay)
    cloth, path = folder / "cloth.usdc", tmp_path / "out.png"
    for source, options in (
        (cloth, {"frame": 2}),
        (cloth, {"frame": 5}),
        ([cloth, folder / "cloth.npz"], {}),
        (cloth, {"colour_range": (0.9, 1.1), "colormap": "RdBu"}),
    ):
        wc.render(source, path, **SMALL, colour="stretch_1", **options)
    assert scales[0] == scales[1] == scales[2] == pytest.approx(scales[0])
    assert scales[0][2:] == (1.0, "coolwarm") and scales[3] == (pytest.approx(0.9), pytest.approx(1.1), 1.0, "RdBu")
    red = picture(path)
    wc.render(cloth, path, size=(128, 72), samples=1, colour="stretch_1", colour_range=(0.75, 1.25), frame=5, ground=False)
    top, wanted = picture(path)[:, :90], 255 * Scale(0.75, 1.25, 1.0).srgb(1.25)
    coloured = top[np.abs(top - top[0, 0]).max(axis=-1) > 60]
    found, wanted = to_linear(np.median(coloured, axis=0) / 255), to_linear(wanted / 255)
    assert len(coloured) > 100 and 0.75 < found[0] / wanted[0] <= 1.01, "in light that is nearly full"
    assert found / found[0] == pytest.approx(wanted / wanted[0], abs=0.005), "of one hue, but for the rounding to 8 bits"
    assert np.ptp(red) > 0


def test_values_and_colours_of_ones_own(folder, tmp_path):
    """Of triangles: the halves of a sheet in two hues, without a bar; and those of what intersects."""
    path, values = tmp_path / "out.png", np.linspace(0.0, 1.0, len(MESH.points))
    wc.render(MOTION, path, mesh=MESH, colour=np.tile(values, (FRAMES, 1)), **SMALL)
    wc.render(folder / "cloth.usdc", path, colour="rotation_angle", measuring={"neighbourhood": "1-ring"}, **SMALL)
    wc.render(folder / "one.obj", path, mesh=MESH, colour="area_ratio", **SMALL)
    wc.render(folder / "cloth.npy", path, mesh=MESH, colour="stretch_2", **SMALL)
    half = MESH.points[MESH.triangles].mean(axis=1)[:, 0] > MESH.points[:, 0].mean()
    colours = np.where(half[:, None], (0.7, 0.0, 0.0), (0.0, 0.0, 0.7))
    wc.render(MESH, path, colour=colours[None], azimuth=0.0, elevation=60.0, ground=False, **SMALL)
    found = picture(path)
    red, blue = (np.argwhere(found[:, :, k] > 2 * found[:, :, 2 - k] + 40) for k in (0, 2))
    assert min(len(red), len(blue)) > 50 and blue[:, 1].mean() + 8 < red[:, 1].mean()


def test_a_still_of_what_intersects(tmp_path, capfd, monkeypatch):
    """A corner of a sheet is put through it, in an animation or at the start of a scene."""
    pytest.importorskip("igl")
    monkeypatch.setattr(checking, "SIZE", (160, 90))
    points = np.stack([MESH.points, MESH.points])
    points[1, [0, 1, 4]] = 0.2 * points[1, [0, 1, 4]] + 0.8 * MESH.points.mean(axis=0) + 0.02
    points[1, [0, 1, 4], np.argmin(np.ptp(MESH.points, axis=0))] = 0.2, -0.2, -0.2
    np.savez(tmp_path / "a.npz", points=points, triangles=MESH.triangles)
    with AnimationWriter(tmp_path / "a.usdc", MESH, FPS) as writer:
        for each in points:
            writer.append(each, np.zeros_like(each))
    lines = ["import warpcloth as wc", "def scene(frame: int = 0):", "    seen = wc.open_sequence('a.npz')"]
    lines.append("    return wc.Scene(seen.mesh, positions=seen[frame], density=1, terms=[wc.Spring(stiffness=1)])")
    (tmp_path / "a.py").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    assert run(capfd, "check", "a.py")[0] == 0
    for words, frame in (["a.npz"], 1), (["a.usdc"], 1), (["a.py", "-p", "frame=1"], 0):
        code, out, _err = run(capfd, "check", *words, "--still", "out.png")
        found = picture(tmp_path / "out.png")
        assert code == 1 and "out.png" in out and f"most in frame {frame}" in out
        assert (found[:, :, 0] > 2 * found[:, :, 2] + 40).sum() > 20


def test_what_is_not_finite_or_not_drawn_does_not_count_for_the_scale_and_the_camera(tmp_path):
    """Points without triangles, and nothing else, are all that differs in the second part."""
    for values in (np.full(16, np.nan), np.where(np.arange(16) % 2, np.inf, 1.0), np.arange(16) > 3):
        wc.render(MESH, tmp_path / "out.png", colour=values[None], **SMALL)
        assert np.ptp(picture(tmp_path / "out.png")) > 10
    more = wc.Mesh(np.vstack([MESH.points, [[50.0, -20.0, 3.0]]]), MESH.triangles)
    for name, mesh in (("a.png", MESH), ("b.png", more)):
        wc.render(mesh, tmp_path / name, **SMALL)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    broken = MOTION.copy()
    broken[3, 0], broken[4, 0] = np.nan, 1e200
    with pytest.warns(UserWarning, match="are not drawn, in all pictures together: a position is not finite, or too far away"):
        wc.render(broken, tmp_path / "out.gif", mesh=MESH, **SMALL)


def test_what_moves_as_a_whole_is_beside_a_cloth(tmp_path, capfd):
    """The one mesh whose points move is the cloth, also where it is coloured; a solid alone is drawn."""
    path = tmp_path / "both.usda"
    turning = "double3 xformOp:translate.timeSamples = {1: (0, 0, -10), 3: (0, 0, -20)}"
    path.write_text(
        STAGE.replace("double3 xformOp:translate = (0, 0, -10)", turning).replace('type = "linear"', 'type = "cubic"')
    )
    subject = subject_of(path)
    first, *others = [tuple(shape.colour) for shape in subject.shapes]
    assert first == CLOTH and set(others) == {SURROUNDINGS}
    options = ("--colour", "stretch_1", "--range", "-1e-3", "1e-3", *SIZE)
    assert run(capfd, "render", path, "-o", tmp_path / "a.png", *options)[0] == 0
    (tmp_path / "ball.usda").write_text('#usda 1.0\ndef Sphere "Ball"\n{\n}\n')
    wc.render(tmp_path / "ball.usda", tmp_path / "a.png", **SMALL)


def test_the_bar_has_round_numbers_and_fits(folder):
    assert round_numbers(0.93, 1.07, 6).tolist() == pytest.approx([0.95, 1.0, 1.05])
    assert round_numbers(0.0, 1.0, 6).tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert written("énergie [J/m²] 日 12°.usd") == "energie [J/m^2] ? 12°.usd"
    for size in ((64, 36), (320, 180), (1280, 720), (3840, 2160)):
        for low, high in ((0.0, 1.0), (1 - 1e-6, 1 + 1e-6), (-3e7, 2e7), (1e-9, 4e-9)):
            overlay = Overlay(size, Scale(low, high), "velocity_gradient_norm", "1/s")
            texts = [text for _, text in overlay._ticks]
            assert len(set(texts)) == len(texts) > 1 and overlay.beside <= 0.4 * size[0]
            image = np.asarray(overlay.draw([np.full((size[1], size[0], 3), 255, np.uint8)], "1.00 s", True))
            assert image.shape == (size[1], size[0], 3) and (image != 255).any()
    overlay = Overlay((320, 180), Scale(0.0, 1.0), "stretch_1", names=["a", "b" * 99])  # a long name stays beside it
    image = np.asarray(overlay.draw([np.full((180, 160, 3), 255, np.uint8)] * 2))
    assert (image[:17, 160 : 320 - overlay.beside] < 128).any() and (image[:17, 320 - overlay.beside :] == 255).all()


def test_several_go_on_to_the_end_of_the_longest_in_rows(folder, tmp_path):
    """Four cells: the first two sources keep their last frame. The second moves, the fifth would be in a third row."""
    path, cloth = tmp_path / "out.webp", folder / "cloth.usdc"
    still = wc.as_sequence(MESH, MOTION[:2], dt=1 / FPS)
    wc.render([still, still, cloth, still], path, names=["", "", "", "M"], size=(128, 72), samples=1)
    with Image.open(path) as film:
        assert film.n_frames == FRAMES
        frames = np.array([np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)])
    assert frames.shape[1:] == (72, 128, 3)
    cells = frames.reshape(FRAMES, 2, 36, 2, 64, 3).transpose(1, 3, 0, 2, 4, 5)
    spans = np.ptp(cells[:, :, 2:], axis=2).max(axis=(2, 3, 4))
    assert spans[1, 0] > 100 and spans[[0, 0, 1], [0, 1, 1]].max() < 8, "only the third moves after its second frame"
    assert (
        np.abs(cells[0, 0, 0, 16:] - cells[1, 1, 0, 16:]).max() < 40 < np.abs(cells[0, 0, 0, :16] - cells[1, 1, 0, :16]).max()
    )


@pytest.mark.parametrize("size", [(64, 36), (65, 37)])
def test_a_webp_shows_the_pictures_of_its_film(size, tmp_path):
    """Frames that change in part, or not at all, have their position and their time."""
    pictures = np.full((4, size[1], size[0], 3), 200, np.uint8)
    pictures[1, 10:20, 7:32] = pictures[2:, 10:20, 7:32] = 40
    pictures[3, -1, -1] = 0
    with open_film(tmp_path / "out.webp", size, [0.0, 1 / 24, 2 / 24, 1.0]) as film:
        for each in pictures:
            film.add(Image.fromarray(each))
    with Image.open(tmp_path / "out.webp") as film:
        assert (film.size, film.n_frames, film.info["loop"]) == (size, 4, 0)
        found = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)]
        durations = []
        for k in range(4):
            film.seek(k)
            film.load()
            durations.append(film.info["duration"])
    assert np.abs(np.array(found)[:3] - pictures[:3]).mean() < 1.5 and np.abs(found[3][-1, -1] - 0).max() < 60
    assert durations == [42, 41, 917, 917]


def test_an_interrupt_leaves_the_good_pictures_or_nothing(folder, tmp_path):
    av = pytest.importorskip("av")

    def stop(after):
        def progress(done, total):
            if done == after:
                raise KeyboardInterrupt

        return progress

    path = tmp_path / "out.mp4"
    with pytest.raises(KeyboardInterrupt, match="interrupted before the first picture; no picture was saved"):
        wc.render(folder / "cloth.usdc", path, **SMALL, progress=stop(0))
    assert not list(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt, match="interrupted after 4 of 6 pictures, which are in "):
        wc.render(folder / "cloth.usdc", path, **SMALL, progress=stop(4))
    with av.open(path) as film:
        assert len(list(film.decode(film.streams.video[0]))) == 4
    with pytest.raises(KeyboardInterrupt, match="after 2 of 6"):
        wc.render(folder / "cloth.usdc", tmp_path / "out.gif", **SMALL, progress=stop(2))
    with Image.open(tmp_path / "out.gif") as film:
        assert film.n_frames == 2
    assert sorted(os.listdir(tmp_path)) == ["out.gif", "out.mp4"]


@pytest.mark.parametrize(
    ("command", "output"),
    [(("render", *SIZE), "a[1].png"), (("view", "--plain"), "a[1].html"), (("run", "--frames", "1"), "a[1].usdc")],
)
def test_the_default_output_is_named_after_the_file_and_replaces_nothing(folder, command, output, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "in" / ("a[1].obj" if command[0] == "run" else "a[1].npz")
    path.parent.mkdir()
    shutil.copy(folder / "cloth.npz", path)
    if command[0] == "run":
        path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n")
    assert run(capfd, command[0], path, *command[1:])[0] == 0 and Path(output).stat().st_size > 100
    refused(capfd, [command[0], path, *command[1:]], f"{output} exists already, and without -o nothing is")


def test_the_command_draws(folder, tmp_path, capfd):
    path = tmp_path / "out.gif"
    code, out, err = run(capfd, "render", folder / "cloth.usdc", folder / "cloth.npz", "-o", path, *SIZE, "--json", "--time")
    facts = json.loads(out)
    assert (code, err) == (0, "") and facts["pictures"] == FRAMES and facts["bytes"] == path.stat().st_size
    code, out, err = run(capfd, "render", folder / "cloth.npy", "--rest", folder / "one.obj", "-o", tmp_path / "a.png", *SIZE)
    assert code == 0 and "1 picture of 64 x 36 in " in out
    options = ("--colour", "energy_density", "--stiffness", "100", "--range", "0", "2", "--azimuth", "10", "--zoom", "1.5")
    code, _, err = run(capfd, "render", folder / "cloth.usdc", "-o", tmp_path / "a.png", *SIZE, *options, "--no-ground")
    assert (code, err) == (0, "")


@pytest.mark.parametrize(
    ("argv", "fragment"),
    [
        (("none.usdc", "-o", "a.png"), "none.usdc: there is no such file"),
        (("CLOTH", "-o", "a.jpg"), "a.jpg: the ending is '.jpg'; it must be .png, .gif, .webp or .mp4"),
        (("CLOTH", "-o", "nowhere/a.png"), "nowhere"),
        (("CLOTH", "-o", "a.mp4", "--size", "65x36"), "size is 65x36; a film in .mp4 must have even numbers, such as 66x36"),
        (("CLOTH", "-o", "EMPTY.png"), "EMPTY.png: is no regular file; it must be one, or free"),
        (("CLOTH", "-o", "a.png", "--size", "65"), "'65' is no size"),
        (("CLOTH", "-o", "a.png", "--size", "2x2"), "size: width is 2; it must be a whole number of 8 or more"),
        (("CLOTH", "-o", "a.png", "--frame", "99"), "frame is 99; it must be one of the 6 from 0 to 5"),
        (("CLOTH", "-o", "a.gif", "--frame", "1"), "frame is given, and a .gif has many"),
        (("CLOTH", "-o", "a.png", "--frames", "1:2"), "frames is given, and a .png has one picture"),
        (("CLOTH", "-o", "a.gif", "--frames", "9:12"), "frames is 9 to 12, where there are none; they are 6, from 0 to 5"),
        (("CLOTH", "-o", "a.gif", "--frames", "1-2"), "'1-2' is no range"),
        (("CLOTH", "-o", "a.gif", "--every", "0"), "every is 0"),
        (("CLOTH", "-o", "a.gif", "--speed", "0"), "speed is 0.0"),
        (("CLOTH", "-o", "a.gif", "--speed", "1e-5"), "shown for 4.17e+03 s; a .gif can show one for 0.01 to 655 s"),
        (("CLOTH", "-o", "a.mp4", "--speed", "1e9"), "shown for 4.17e-11 s; a .mp4 can show one for 1e-06 to 1000 s"),
        (("ZERO", "-o", "a.png"), "points has shape (0, 16, 3); it must be (frames, vertices, 3), of one frame or more"),
        (("NAN", "-o", "a.png"), "nan.npz: no triangle, line or pin has positions that are finite and below 1e100 m; there is"),
        (("HUGE", "-o", "a.png"), "huge.npz: no triangle, line or pin has positions that are finite and below 1e100 m"),
        (("HUGE", "-o", "a.gif"), "huge.npz: no triangle, line or pin has positions that are finite and below 1e100 m"),
        (("CHANGING", "-o", "a.png"), "faceVertexIndices[1] is 2 at time code 1, must stay 1"),
        (("CLOTH", "-o", "a.png", "--zoom", "-1"), "zoom is -1.0"),
        (("CLOTH", "-o", "a.png", "--zoom", "5", "--camera", "Eye"), "zoom and camera are given; a camera of the stage sets"),
        (("CLOTH", "-o", "a.png", "--samples", "0"), "samples is 0"),
        (("CLOTH", "-o", "a.png", "--colour", "strech_1"), "colour is 'strech_1'; it must be one of"),
        (("CLOTH", "-o", "a.png", "--range", "0", "1"), "--range is given without --colour"),
        (("CLOTH", "-o", "a.png", "--neighbourhood", "1-ring"), "--neighbourhood is given without --colour"),
        (("CLOTH", "-o", "a.png", "--colour", "stretch_1", "--range", "2", "1"), "low must be below high"),
        (("CLOTH", "-o", "a.png", "--colour", "stretch_1", "--colormap", "virdis"), "it must be a colour map"),
        (("CLOTH", "-o", "a.png", "--prim", "Other"), "there is no such prim"),
        (("CLOTH", "-o", "a.png", "--ground", "0", "--no-ground"), "give one of them"),
        (("CLOTH", "-o", "a.png", "--device", "cuda:99"), "device is 'cuda:99'"),
        (("CLOTH", "CLOTH", "none.usdc", "-o", "a.png"), "none.usdc: there is no such file"),
        (("CHAIN", "-o", "a.png", "--colour", "stretch_1"), "must have triangles"),
        (("NPY", "-o", "a.png"), "has no triangles; give a rest mesh that has them (--rest)"),
        (("EMPTY", "-o", "a.png"), "no mesh files there"),
        (("BARE", "-o", "a.png"), "there is nothing to draw"),
        (("PNG", "-o", "b.png"), "must be a folder or pattern of mesh files"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_sentence(argv, fragment, folder, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "EMPTY.png").mkdir()
    (tmp_path / "bare.usda").write_text('#usda 1.0\ndef Xform "World"\n{\n}\n')
    (tmp_path / "text.png").write_text("no picture")
    moving = "int[] faceVertexIndices.timeSamples = {0: [0, 1, 2, 3], 1: [0, 2, 1, 3]}"
    (tmp_path / "changing.usda").write_text(STAGE.replace("int[] faceVertexIndices = [0, 1, 2, 3]", moving))
    np.savez(tmp_path / "zero.npz", points=MOTION[:0], triangles=MESH.triangles)
    np.savez(tmp_path / "huge.npz", points=1e199 * MOTION, triangles=MESH.triangles)
    np.savez(tmp_path / "nan.npz", points=np.full_like(MOTION, np.nan), triangles=MESH.triangles)
    before = sorted(os.listdir(tmp_path))
    files = {"CLOTH": folder / "cloth.usdc", "CHAIN": folder / "chain.usdc", "NPY": folder / "cloth.npy"}
    files |= {"EMPTY": "empty", "BARE": "bare.usda", "PNG": "text.png"}
    files |= {"ZERO": "zero.npz", "NAN": "nan.npz", "HUGE": "huge.npz", "CHANGING": "changing.usda"}
    refused(capfd, ["render", *(files.get(word, word) for word in argv)], fragment)
    assert sorted(os.listdir(tmp_path)) == before


OWN = {"mesh": MESH}


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (
            MOTION,
            OWN | {"colour": np.zeros((2, 3))},
            r"colour has shape \(2, 3\); it must be \(6, 16\) of vertices or \(6, 18\)",
        ),
        (
            MESH,
            {"colour": np.zeros((1, 5, 3))},
            r"colour has shape \(1, 5, 3\); it must be \(1, 16, 3\) of vertices or \(1, 18, 3\)",
        ),
        (MESH, {"copy": 1}, "copy is 1; the source is one cloth"),
        (MOTION[:0], OWN, "frames is empty; there must be one at least"),
        (MOTION, {"mesh": 3}, "mesh is 3; it must be a Mesh"),
        (MESH, {"up_axis": "X"}, "up_axis is 'X'; it must be one of 'Y', 'Z'"),
        (MESH, {"colour": {}}, "colour has 0 entries; it must be one text with its values"),
        ([MESH] * 2, {"colour": [np.zeros((1, 16))]}, "colour has 1 arrays; it must have one for each"),
        (MESH, {"colour": np.full((1, 16), "a")}, "colour has type <U1; it must be real numbers"),
        (3, {}, "source is 3; it must be a path, an Animation"),
        (MOTION, {}, "source is ndarray; arrays need their mesh"),
        (MOTION[:, :3], OWN, r"frames have shape \(3, 3\); they must be \(16, 3\)"),
        (MESH, {"size": 64}, "size is 64; it must be a width and a height"),
        (MESH, {"measuring": {"lag": 1}}, "measuring is given without colour"),
        ([MESH] * 3, {"names": ["a", "b"]}, "names is .*; it must be a text for each of the 3 sources"),
        (MESH, {"ground": "low"}, "ground is 'low'"),
        (MESH, {"output": "a.gif", "frames": "1:2"}, "frames is '1:2'; it must be the numbers of the first and the last"),
    ],
)
def test_wrong_arguments_are_refused(source, options, message, tmp_path):
    output = options.get("output", "a.png")
    with pytest.raises(ValueError, match=message):
        wc.render(source, **{**SMALL, **options, "output": tmp_path / output})
    assert not list(tmp_path.iterdir())


def test_a_source_is_not_written_over_and_what_is_not_installed_is_said(folder, tmp_path, capfd, monkeypatch):
    shutil.copy(folder / "one.obj", tmp_path / "a.obj")
    (tmp_path / "a.png").symlink_to(tmp_path / "a.obj")
    refused(capfd, ["render", tmp_path / "a.obj", "-o", tmp_path / "a.png", *SIZE], "is a link to")
    real = rendering.check_film.__globals__["importlib"].util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name == "av" else real(name, *more))
    refused(capfd, ["render", folder / "cloth.usdc", "-o", tmp_path / "a.mp4"], "films in .mp4 need PyAV: pip install")


@pytest.fixture
def small_films(tmp_path, monkeypatch):
    """Makes the films of runs small, in a folder of their own."""
    real = drawing.draw_film
    monkeypatch.setattr("warpcloth.cli.run.draw_film", lambda *given, **more: real(*given, **more, **SMALL))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_run_draws_its_film(small_films, capfd):
    command = ["run", "hanging", "-p", "n=4", "--frames", "4", "--film", "a.gif"]
    code, out, err = run(capfd, *command, "-o", "a.usdc", "--json")
    assert (code, err, json.loads(out)["film"]) == (0, "", "a.gif")
    wc.render("a.usdc", "b.gif", **SMALL)
    assert (small_films / "a.gif").read_bytes() == (small_films / "b.gif").read_bytes()
    (small_films / "folder.gif").mkdir()
    refusals = {"a.avi": "the ending is '.avi'", "none/a.gif": "none does not exist", "folder.gif": "is no regular file"}
    for film, fragment in refusals.items():
        refused(capfd, ["run", "hanging", "-p", "n=4", "-o", "c.usdc", "--film", film], fragment)
    assert not (small_films / "c.usdc").exists()


def test_a_run_that_diverges_has_a_film_of_its_good_frames(small_films, capfd):
    options = ("--solver", "pbd", "-s", "sweep=jacobi", "relaxation=1.9", "iterations=1")
    code, out, _ = run(capfd, "run", "hanging", "-p", "n=8", *options, "-o", "a.usdc", "--film", "a.gif", "--json")
    good = json.loads(out)["frames"]
    assert code == 1 and good > 0
    with Image.open("a.gif") as film:
        assert film.n_frames == good // 2 + 1, "60 frames a second are more than a GIF shows"


@pytest.mark.parametrize(("pictures", "said"), [(0, "before the first picture; no picture was saved"), (1, "after 1 of 2")])
def test_an_interrupt_while_a_film_is_drawn_says_where_the_frames_are(pictures, said, small_films, capfd, monkeypatch):
    def stop(self, done, total):
        if done == pictures:
            raise KeyboardInterrupt

    monkeypatch.setattr(Counter, "__call__", stop)
    code, out, err = run(capfd, "run", "hanging", "-p", "n=4", "--frames", "2", "-o", "a.usdc", "--film", "a.gif")
    assert (code, out) == (130, "") and said in err and err.endswith("; frames 0 to 2 are in a.usdc\n")
    assert (small_films / "a.gif").exists() == (pictures > 0) and (small_films / "a.usdc").exists()


def test_a_resumed_run_draws_all_of_it(small_films, capfd, monkeypatch):
    """The film of the whole run, though part of it was computed by another process."""
    command = ["run", "hanging", "-p", "n=4", "--frames", "24", "-o", "a.usdc", "--film", "a.gif"]
    append, calls = recorders.File.append, []

    def stop(self, *given, **more):
        calls.append(given)
        if len(calls) == 14:
            raise KeyboardInterrupt
        append(self, *given, **more)

    monkeypatch.setattr(recorders.File, "append", stop)
    code, _, err = run(capfd, *command)
    assert code == 130 and "interrupted after frame 12" in err and not (small_films / "a.gif").exists()
    code, _, err = run(capfd, *command, "--resume")
    assert (code, err) == (0, "")
    with Image.open("a.gif") as film:
        assert film.n_frames == 13


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "scenes").glob("[!_]*.py")))
def test_every_scene_is_drawn(name, tmp_path):
    path = tmp_path / "out.png"
    wc.render(importlib.import_module(f"warpcloth.scenes.{name}").scene(), path, **SMALL)
    assert np.ptp(picture(path)) > 10
