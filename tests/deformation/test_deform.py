"""Deformation by keyframes: the function, the command, and what both write."""

import json
import os

import numpy as np
import pytest
import trimesh
import warp.examples
from pxr import Usd, UsdGeom

import warpcloth as wc
import warpcloth.cli.deform
from support.command_line import refused, run
from support.continuum import turn
from support.mesh_texts import obj
from support.stages import artist_stage
from support.usd_validation import validate
from warpcloth.deformation.deform import rotation_angles
from warpcloth.scenes import bar_twist
from warpcloth.usd import FrameSequence, read_mesh

BUNNY = os.path.join(warp.examples.get_asset_directory(), "bunny.usd")
EPS = np.finfo(np.float32).eps


def bar(angle=60.0, frames=5, cells=2):
    """A small twisted bar: mesh and pins of a few frames."""
    declared = bar_twist.scene(angle=angle, cells=cells, duration=frames / 24)
    return declared.mesh, declared.pins


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.5, np.pi / 2, np.pi - 1e-6, np.pi - 1e-12, np.pi])
def test_angles_of_rotations_are_precise_at_both_ends(angle):
    rotations = np.array([turn(axis, angle) for axis in ([1, 0, 0], [1, -2, 3], [0, 1, 1])])
    np.testing.assert_allclose(rotation_angles(rotations), angle, rtol=0, atol=1e-15 + 4e-16 * angle)


def test_a_turned_whole_is_turned_rigidly(device):
    """Handles that move as one leave no energy, every vertex is turned as they are, and a frame costs one iteration."""
    mesh, pins = bar()
    degrees = np.linspace(0.0, 90.0, 4)
    keyframes = np.array([mesh.points[pins.vertices] @ turn([1, 2, 3], np.radians(angle)).T + [0, 1, 0] for angle in degrees])
    found = wc.deform(mesh, wc.Pins(pins.vertices, keyframes), device=device)
    assert found.converged.all() and found.energies.max() < 1e-26 and found.iterations.tolist() == [1] * 4
    np.testing.assert_allclose(np.degrees(found.angles), np.broadcast_to(degrees[:, None], found.angles.shape), atol=1e-11)
    np.testing.assert_array_equal(found.times, np.arange(4) / 24.0)


def test_a_whole_turn_of_the_end_is_followed(device):
    """Each frame starts from the one before it: the middle is turned by half, beyond half a turn of the end too."""
    mesh, pins = bar(angle=270.0, frames=18)
    found = wc.deform(mesh, pins, device=device, weights="uniform")
    middle = np.abs(mesh.points[:, 0] - 0.5) < 1e-9
    corners = mesh.points[middle][:, 1:] @ [1, 1j]
    turned = np.angle((found.points[:, middle][..., 1:] @ [1, 1j]) / corners)
    np.testing.assert_allclose(np.degrees(turned[-1]), 135.0, atol=5.0)
    # Held and turned ends are where they are asked to be.
    np.testing.assert_allclose(found.points[:, pins.vertices], pins.keyframes, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("ending", "single_file"), [("usdc", False), ("usda", True), ("usdz", True)])
def test_the_file_has_what_memory_has(tmp_path, device, ending, single_file):
    mesh, pins = bar()
    seen, path = [], str(tmp_path / f"out.{ending}")
    kept = wc.deform(mesh, pins, device=device)
    options = {"output": path, "single_file": single_file, "up_axis": "Z", "progress": lambda *at: seen.append(at)}
    written = wc.deform(mesh, pins, fps=12.0, device=device, **options)
    assert seen == [(frame, 5) for frame in range(6)] and written.output == path
    np.testing.assert_allclose(written.points, kept.points, rtol=0, atol=2 * EPS)
    np.testing.assert_allclose(written.angles, kept.angles, rtol=2 * EPS, atol=1e-6)
    moves = np.diff(kept.points, axis=0, prepend=kept.points[:1]) * 12.0
    np.testing.assert_allclose(FrameSequence(path, attribute="velocities"), moves, rtol=2 * EPS, atol=1e-6)
    stage = Usd.Stage.Open(path)
    cloth = stage.GetPrimAtPath("/World/Cloth")
    angles = UsdGeom.PrimvarsAPI(cloth).GetPrimvar("rotationAngle")
    assert (angles.GetInterpolation(), UsdGeom.GetStageUpAxis(stage)) == ("vertex", "Z")
    assert 55.0 < max(angles.Get(5)) < 65.0, "in degrees"
    assert list(UsdGeom.Subset(cloth.GetChild("handles")).GetIndicesAttr().Get()) == sorted(pins.vertices)
    assert validate(path) == []


def test_a_net_is_deformed_with_its_curves(tmp_path, device):
    grid = wc.Mesh.grid(4, 3)
    net, held = wc.Mesh(grid.points, edges=grid.edges), [0, 3, 8, 11]
    keyframes = [net.points[held] * [1.0 - 0.1 * frame, 1, 1] for frame in range(3)]
    found = wc.deform(net, wc.Pins(held, keyframes), weights="uniform", output=str(tmp_path / "net.usdc"), device=device)
    assert found.angles.shape == (3, 12) and np.asarray(found.angles)[2].max() > 0.0
    assert validate(found.output) == []


def test_a_scene_from_a_stage_gives_a_layer_over_it(tmp_path, device):
    """Where a scene starts does not count; its keyframes do."""
    artist_stage(tmp_path / "artist.usda", wc.Mesh.grid(4, 4))
    surroundings = wc.usd.read_stage_mesh(tmp_path / "artist.usda")
    lifted = surroundings.mesh.points + np.array([0.0, 0.5, 0.0])
    keyframes = lifted[:4] + np.array([0.0, 0.1, 0.0]) * np.arange(3)[:, None, None]
    pins = wc.Pins([0, 1, 2, 3], keyframes)
    scene = wc.Scene(surroundings.mesh, density=1.0, positions=lifted, pins=pins, stage=surroundings, duration=0.1)
    path = str(tmp_path / "out.usda")
    found = wc.deform(scene.mesh, scene.pins, fps=scene.fps, stage=scene.stage, output=path, device=device)
    np.testing.assert_allclose(found.points[:, :4], keyframes, atol=1e-6)
    np.testing.assert_allclose(found.points[0], lifted, atol=1e-6)
    assert validate(path, tmp_path / "artist.usda") == [] and "artist.usda" in (tmp_path / "out.usda").read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pins": wc.Pins("x == 0")}, "pins.keyframes is None; a deformation needs positions of its handles"),
        ({"pins": wc.Pins([0, 0], np.zeros((1, 2, 3)))}, "pins.vertices names vertex 0 twice"),
        ({"pins": wc.Pins([0], np.full((2, 1, 3), np.nan))}, "pins.keyframes.* is nan; it must be finite"),
        ({"mesh": "bunny.usd"}, "mesh is 'bunny.usd'; it must be a Mesh, such as Mesh.load"),
        ({"fps": 0.0}, "fps is 0.0; it must be a number above 0"),
        ({"output": "nowhere/out.usdc"}, "nowhere does not exist"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    mesh, pins = bar()
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        wc.deform(**{"mesh": mesh, "pins": pins, **change})


# ------------------------------------------------------------------------------------------------------- the command


def two_bars():
    points, triangles = bar()[0].points, bar()[0].triangles
    return wc.Mesh(np.concatenate([points, points + np.array([0, 0, 2])]), np.concatenate([triangles, triangles + len(points)]))


MESHES = {"bar.obj": bar()[0], "two.obj": two_bars()}
MOVED = "--move x>0.9 --translate 0.1 0 0"

# argv after deform {}/bar.obj -o {}/o.usdc, with {} for a folder of MESHES, and a part of the line that it gives.
OF_BAR = [
    ("", "nothing moves; give --move SELECTION and after it --rotate or --translate"),
    ("--fix x<0.1", "nothing moves; give --move SELECTION"),
    ("--move x>0.9 --fix x<0.1", "--move 'x>0.9' does not say how; --rotate or --translate must follow"),
    ("--rotate 90 x --move x>0.9", "--rotate stands before any --move; it says how the --move before it"),
    ("--translate 0 0 1", "--translate stands before any --move"),
    (f"{MOVED} --translate 0 0 1", "--move 'x>0.9' has --translate twice; each may follow it once"),
    ("--move x>0.9 --rotate 90", "--rotate 90: it takes DEGREES AXIS, or DEGREES AXIS CX CY CZ"),
    ("--move x>0.9 --rotate 90 x 1 2", "--rotate 90 x 1 2: it takes DEGREES AXIS, or"),
    ("--move x>0.9 --rotate 90 w", "the AXIS of --rotate is 'w'; it must be x, y, z or a vector"),
    ("--move x>0.9 --rotate 720 x --frames 4", "turns by 180° a frame, which must be less than 180°; give --frames 5"),
    ("--move x>0.9 --translate 1e39 0 0", "cannot be written: a file holds float32"),
    ("--move x>0.9 --translate 1 0 0 --fps 1e300", "velocities of pins.keyframes[0, "),
    ("--move x>0.9 --translate 1 0 0 --tolerance -1", "tolerance is -1.0; it must be a number of 0 or more"),
    ("--move x>0.9 --rotate 90 0,0,0", "AXIS of --rotate is '0,0,0'; it must be x, y, z or a vector such"),
    ("--move x>0.9 --rotate 90 1,0", "AXIS of --rotate is '1,0'; it must be x, y, z or a vector such as"),
    ("--move x>0.9 --rotate nan x", "DEGREES of --rotate is 'nan'; it must be a number"),
    ("--move x>0.9 --translate 0 -inf 0", "argument --translate: expected 3 arguments"),
    ("--move x>0.9 --translate 0 inf 0", "--translate is 'inf'; it must be finite"),
    ("--move x>0.9 --translate 1 2", "argument --translate: expected 3 arguments"),
    (f"--fix x>5 {MOVED}", "--fix 'x>5' names no vertex; the mesh reaches from (0, -0.1, -0.1) to (1,"),
    ("--move x>5 --translate 1 0 0", "--move 'x>5' names no vertex"),
    (f"--fix x>0.7 {MOVED}", "--move 'x>0.9' and --fix 'x>0.7' both name vertex "),
    (f"{MOVED} --move all --rotate 9 x", "--move 'all' and --move 'x>0.9' both name vertex "),
    (f"--fix x=0 {MOVED}", "selection 'x=0', column 2"),
    (f"--fix boundary {MOVED}", "--fix 'boundary' names no vertex"),
    (f"{MOVED} --frames 0", "frames is 0; it must be a whole number of 1 or more"),
    (f"{MOVED} --fps 0", "fps is 0.0; it must be a number above 0"),
    (f"{MOVED} --fps nan", "fps is nan; it must be a number above 0"),
    (f"{MOVED} --iterations -1", "iterations is -1; it must be a whole number of 0 or more"),
    (f"{MOVED} --tolerance nan", "tolerance is nan; it must be a number of 0 or more"),
    (f"{MOVED} --weights magic", "invalid choice: 'magic'"),
    (f"{MOVED} --energy magic", "invalid choice: 'magic'"),
    (f"{MOVED} --device gpu", "device is 'gpu'; on this machine there are cpu"),
    (f"{MOVED} -p angle=3", "-p is given, and {}/bar.obj is a mesh and has no parameters; leave it out"),
]
# And after deform alone.
WRONG_USES = [
    *((f"{{}}/bar.obj -o {{}}/o.usdc {argv}", fragment) for argv, fragment in OF_BAR),
    ("{}/bar.obj", "the following arguments are required: -o/--output; see warpcloth deform --help"),
    ("{}/none.obj -o {}/o.usdc --move x>0 --translate 1 0 0", "none.obj"),
    ("{}/two.obj -o {}/o.usdc --move z<0.5 --translate 1 0 0", "handles leave 1 of the 2 parts of the mesh without one"),
    (f"{{}}/bar.obj -o {{}}/no/o.usdc {MOVED}", "no does not exist"),
    (f"{{}}/bar.obj -o {{}}/o.obj {MOVED}", "must end with one of .usd, .usda, .usdc, .usdz"),
    (f"{BUNNY} -o {{}}/o.usdc --prim /Ham {MOVED}", "bunny.usd, prim /Ham: there is no such prim, only /root/bunny"),
    ("hanging -o {}/o.usdc", "the pins of hanging do not move; give a scene whose pins have keyframes, or a mesh and --move"),
    ("hangin -o {}/o.usdc --fix x<0", "there is no scene 'hangin'; known by name are "),
    (
        "bar_twist -o {}/o.usdc --fix x<0",
        "--fix is given, and bar_twist is a scene, whose pins and keyframes are taken as they are",
    ),
    (f"bar_twist -o {{}}/o.usdc {MOVED}", "--move is given, and bar_twist is a scene"),
    ("bar_twist -o {}/o.usdc --fps 12", "--fps is given, and bar_twist is a scene"),
    ("bar_twist -o {}/o.usdc -p turn=3", "has no parameter 'turn'; allowed are angle, cells, stiffness, bending, duration"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    for name, mesh in MESHES.items():
        (folder / name).write_text(obj(mesh.points, mesh.triangles))
    return folder


@pytest.mark.parametrize(("argv", "fragment"), WRONG_USES, ids=[argv for argv, _ in WRONG_USES])
def test_wrong_use_gives_one_line_and_exit_code_2(folder, capfd, argv, fragment):
    refused(capfd, ["deform", *argv.replace("{}", str(folder)).split()], fragment.replace("{}", str(folder)))
    assert not list(folder.glob("o*"))


def test_moves_turn_first_and_shift_then(folder, tmp_path, capfd):
    """By angle, along arcs, more than a turn; each move has its own, and numbers may be negative."""
    output = tmp_path / "out.usdc"
    argv = "--fix index(0) --fix x<0.1 --move x>0.9 --translate 0 -1e-1 0.2 --rotate -720 -1,0,0 0 .5 0 --frames 96 --fps 48"
    second = "--move x==0.5 --rotate 1/2 z"
    code, out, err = run(capfd, "deform", folder / "bar.obj", *argv.split(), *second.split(), "--json", "-o", output)
    facts = json.loads(out)
    assert (code, err) == (0, "")
    mesh = wc.Mesh.load(str(folder / "bar.obj"))
    end, middle = mesh.select("x > 0.9"), mesh.select("x == 0.5")
    points = np.asarray(FrameSequence(output))
    assert points.shape == (97, len(mesh.points), 3) and FrameSequence(output).times[-1] == 2.0
    for frame in (0, 1, 12, 50, 96):
        part = frame / 96
        expected = (mesh.points[end] - [0, 0.5, 0]) @ turn([1, 0, 0], 4 * np.pi * part).T + [0, 0.5 - 0.1 * part, 0.2 * part]
        np.testing.assert_allclose(points[frame, end], expected, atol=4 * EPS)
    turned = (mesh.points[middle] - [0.5, 0, 0]) @ turn([0, 0, 1], np.pi / 360).T + [0.5, 0, 0]
    np.testing.assert_allclose(points[-1, middle], turned, atol=4 * EPS)
    held = mesh.select("x < 0.1")
    np.testing.assert_allclose(points[:, held], mesh.points[None, held].repeat(97, 0), atol=EPS)
    assert facts["handles"] == len(end) + len(middle) + len(held) and facts["vertices"] == len(mesh.points)
    assert facts["file"] == str(output) and facts["frames"] == 96 and facts["most_iterations"] >= facts["median_iterations"] > 0
    assert 0.0 <= facts["largest_angle"] <= 180.0 and facts["last_energy"] > 0.0 and validate(output) == []


def test_a_stage_is_deformed_by_a_layer_over_it(tmp_path, capfd):
    output = tmp_path / "out.usdc"
    argv = ["--fix", "y<0.3", "--move", "y>1.4", "--rotate", 20, "x", "--frames", 2, "--iterations", 3, "--single-file"]
    code, out, err = run(capfd, "deform", BUNNY, *argv, "-o", output)
    assert code == 0 and err.startswith("warpcloth: warning: negative weights: 1,") and err.count("\n") == 1
    lines = dict(line.strip().split("  ", 1) for line in out.splitlines()[1:] if "  " in line.strip())
    assert "did not converge, the first is " in out.splitlines()[0] and out.startswith("bunny.usd: ")
    assert lines["frames"].strip().startswith("2, ") and "of 6102 vertices" in lines["handles"]
    assert lines["iterations"].strip() == "3 a frame (median), at most 3" and lines["file"].strip() == str(output)
    assert "largest angle " in out and "° from rest" in out and " m² in the last frame" in lines["energy"]
    stage = Usd.Stage.Open(str(output))
    assert stage.GetPrimAtPath("/root/bunny").GetAttribute("primvars:rotationAngle").GetNumTimeSamples() == 3
    np.testing.assert_array_equal(read_mesh(output).triangles, read_mesh(BUNNY).triangles)
    assert validate(output, BUNNY) == []


@pytest.mark.parametrize("frames", [2, 8])
def test_a_scene_is_deformed_by_its_keyframes(tmp_path, capfd, frames):
    """Fewer frames than it has keyframes are the first of them; more hold the last."""
    output = tmp_path / "out.usdc"
    argv = ["-p", "cells=1", "angle=60", "duration=1/4", "--frames", frames, "--dtype", "float32", "--json", "-o", output]
    code, out, err = run(capfd, "deform", "bar_twist", *argv)
    facts = json.loads(out)
    assert (code, err) == (0, "") and facts["frames"] == frames and facts["parameters"]["cells"] == 1
    keyframes = bar_twist.scene(angle=60.0, cells=1, duration=0.25).pins.keyframes
    points = np.asarray(FrameSequence(output))
    assert len(points) == frames + 1
    ends = bar_twist.scene(cells=1).pins.vertices
    np.testing.assert_allclose(points[-1][ends], keyframes[min(frames, 6)], atol=4 * EPS)


def test_a_refused_command_leaves_an_earlier_result(folder, tmp_path, capfd):
    argv = ["deform", folder / "bar.obj", "--fix", "x<0.1", *MOVED.split(), "-o", tmp_path / "out.usdc"]
    assert run(capfd, *argv)[0] == 0
    refused(capfd, [*argv, "--fps", "1e300"], "cannot be written")
    assert len(FrameSequence(tmp_path / "out.usdc")) == 25


@pytest.mark.parametrize("axis", ["0,0,2", "0,0,1e200", "0,0,1e-200"])
def test_the_length_of_an_axis_does_not_matter(axis, folder, tmp_path, capfd):
    options = "--fix x<0.1 --move x>0.9 --frames 3 --energy spokes_and_rims --json".split()
    common = ["deform", folder / "bar.obj", *options]
    code, out, err = run(capfd, *common, "--rotate", 90, axis, "-o", tmp_path / "one.usdc")
    assert (code, err) == (0, "") and json.loads(out)["energy"] == "spokes_and_rims"
    run(capfd, *common, "--rotate", 90, "z", "-o", tmp_path / "other.usdc")
    one, other = (np.asarray(FrameSequence(tmp_path / f"{name}.usdc")) for name in ("one", "other"))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def test_a_stage_keeps_its_times(tmp_path, capfd):
    """25 frames a second from 1001 on, and a scene from a stage is a layer over it."""
    stage = Usd.Stage.Open(BUNNY)
    stage.SetTimeCodesPerSecond(25)
    stage.SetFramesPerSecond(25)
    stage.SetStartTimeCode(1001)
    stage.SetEndTimeCode(1002)
    stage.Export(str(tmp_path / "bunny.usda"))
    argv = ["--fix", "y<0.1", "--move", "y>1.2", "--translate", 0, 0.1, 0, "--frames", 2, "--iterations", 3]
    assert run(capfd, "deform", tmp_path / "bunny.usda", *argv, "-o", tmp_path / "out.usdc")[0] == 0
    result = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    assert (result.GetStartTimeCode(), result.GetEndTimeCode(), result.GetFramesPerSecond()) == (1001, 1003, 25)
    assert run(capfd, "deform", "bunny", "--frames", 2, "--iterations", 3, "-o", tmp_path / "scene.usdc")[0] == 0
    layered = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    used = {os.path.basename(layer.realPath) for layer in layered.GetUsedLayers()}
    assert "bunny.usd" in used


def test_single_file_and_times(tmp_path):
    mesh, pins = bar()
    found = wc.deform(mesh, pins, fps=10.0, output=str(tmp_path / "one.usdc"), single_file=True)
    assert os.listdir(tmp_path) == ["one.usdc"]
    np.testing.assert_allclose(found.times, np.arange(6) / 10.0)
    np.testing.assert_allclose(found.largest_angles, np.asarray(found.angles).max(axis=1), rtol=1e-6)
    assert (np.diff(found.energies) > 0.0).all()  # more and more twisted


def test_the_bar_is_closed():
    mesh = bar_twist.scene().mesh
    solid = trimesh.Trimesh(mesh.points, mesh.triangles, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume == pytest.approx(0.04)


def test_an_interrupted_deformation_keeps_its_frames(folder, tmp_path, capfd, monkeypatch):
    class Interrupting(warpcloth.cli.deform.Progress):
        def __call__(self, frame, frames):
            super().__call__(frame, frames)
            if frame == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(warpcloth.cli.deform, "Progress", Interrupting)
    output = tmp_path / "out.usdc"
    code, out, err = run(capfd, "deform", folder / "bar.obj", *MOVED.split(), "-o", output)
    assert (code, out) == (130, "")
    assert err == f"warpcloth: interrupted after frame 2 of 24; frames 0 to 2 are in {output}\n"
    assert len(FrameSequence(output)) == len(FrameSequence(output, attribute="primvars:rotationAngle")) == 3
