"""Wrong input is refused, before anything runs, in one sentence that says what is wrong, where, and what is allowed."""

import os
import re
import shutil
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from pxr import Sdf, Usd

import warpcloth as wc
from support.disks import room_for
from support.stage_texts import CURVES, MOVED, STAGE
from warpcloth.base import limits, warp_internals
from warpcloth.base.quiet import initialise_warp
from warpcloth.cli import main
from warpcloth.cli.terminal import printable
from warpcloth.usd import AnimationWriter, FrameSequence, MeasureWriter, packages, read_scene
from warpcloth.usd.values import value_of

# What stands in place of a part of a text, and the sentence after the path, with * for the prim.
OF_MESHES = [
    ("metersPerUnit = 1", "metersPerUnit = -1", r"metersPerUnit is -1.0, must be a number of 1e-18 to 1e\+18"),
    ("kilogramsPerUnit = 1", "kilogramsPerUnit = nan", "kilogramsPerUnit is nan, must be"),
    ('"Y"', '"X"', 'upAxis is \'X\', must be "Y" or "Z"'),
    ("timeCodesPerSecond = 24", "timeCodesPerSecond = 0", r"timeCodesPerSecond is 0.0, must be a number of 1e-06 to 1e\+06"),
    ("timeCodesPerSecond = 24", "timeCodesPerSecond = -24", "timeCodesPerSecond is -24.0, must be"),
    ("framesPerSecond = 24", "framesPerSecond = inf", "framesPerSecond is inf, must be"),
    ("startTimeCode = 0", "startTimeCode = -1e18", r"startTimeCode is -1e\+18, must be a number of -1e\+09 to 1e\+09"),
    ("endTimeCode = 3", "endTimeCode = inf", "endTimeCode is inf, must be a number of"),
    ("endTimeCode = 3", "endTimeCode = -3", "endTimeCode is -3, must be at least startTimeCode, which is 0"),
    ("y = 0.15", "y.timeSamples = {0: 0.15, 3: 0.3}", "*warpcloth:density changes over time, must have one value"),
    ("3: [(0, 0.1", "1e15: [(0, 0.1", r"*points has a sample at time code 1e\+15, must be at -1e\+09"),
    ("1: [(0, 0, 0), (1", "1e15: [(0, 0, 0), (1", r"*warpcloth:pins:keyframes has a sample at time code 1e\+15"),
    ("(0, 0, 0), (1, 0, 0)]}", "(0, inf, 0), (1, 0, 0)]}", r"keyframes\[0\]\[1\] at time code 1 is inf, must be finite"),
    ("Indices = [0, 2", "Indices = [0, -2", r"*faceVertexIndices\[1\] = -2, must be a vertex, 0 to 3"),
    ("int[] faceVertexCounts = [3, 3]", "float[] faceVertexCounts = [3, 3]", "faceVertexCounts holds float32 of shape"),
    ('"leftHanded"', '"sideways"', "*orientation is 'sideways', must be one of rightHanded, leftHanded"),
    ("indices = [0, 1]", "indices = [0, 99]", r"*GeomSubset pins: indices\[1\] = 99, must be a point, 0 to 3"),
    ("indices = [0, 1]", "indices = [-1, 0]", r"GeomSubset pins: indices\[0\] = -1, must be a point"),
    ("indices = [0, 1]", "indices.timeSamples = {0: [0, 1], 2: [1]}", "1 GeomSubset pins: indices at time code 2, must"),
    ("double warpcloth:density = 0.15", "double warpcloth:density = nan", "warpcloth:density is nan, must be finite"),
    ("(0, -9.81, 0)", "(0, -inf, 0)", r"warpcloth:gravity\[1\] is -inf, must be finite"),
    ("stiffness = 1000", "stiffness = nan", "warpcloth:terms:threads:stiffness is nan, must be a number"),
    ("density = 0.15", "density.timeSamples = {0: None}", "warpcloth:density is blocked at its first time sample, must"),
    ("Counts = [3, 3]", "Counts.timeSamples = {0: [3, 3], 3: [3]}", "*1 faceVertexCounts at time code 3, must stay 2"),
    ("int[] faceVertexCounts", "int[] holeIndices = [2]\n    int[] faceVertexCounts", r"holeIndices\[0\] = 2, must be a face"),
    ("    defaultPrim", "subLayers = [@gone.usda@]\n    defaultPrim", "Could not load sublayer @gone.usda@ .*must be"),
    ('def Mesh "Cloth"\n', 'def Mesh "Cloth" (references = @gone.usda@)\n', "*Could not open asset @gone.usda@"),
]
OF_MOTIONS = [
    ("(1, 0.1, 0), (0, 0, 1)", "(1, 0.1, 0), (0, nan, 1)", r"*points\[2\]\[1\] at time code 1 is nan, must be finite"),
    ("[(0, 0.1, 0), (1, 0.1, 0), (0, 0, 1), (1, 0, 1)]", "None", "*points is blocked at time code 3, must"),
]
OF_CURVES = [
    ("point3f[] points", "int[] points = [1, 2]\n    point3f[] others", "points holds int32 of"),
    ("[5]", "[9]", "*curveVertexCounts add up to 9, must be the number of points, 5"),
    ("[5]", "[2147483647]", "curveVertexCounts add up to 2147483647, must be the number of points, 5"),
    ("[5]", "[6, -1]", r"curveVertexCounts\[1\] is -1, must be at least 2"),
    ("indices = [0]", "indices = [99]", r"GeomSubset pins: indices\[0\] = 99, must be a point, 0 to 4"),
    ('"nonperiodic"', '"round"', "wrap is 'round', must be one of nonperiodic, periodic, pinned"),
    ("int[] primvars:warpcloth:vertex = [0, 1, 2, 3, 4]", 'string[] primvars:warpcloth:vertex = ["a"]', "holds <U1 of shape"),
]
WRONG_STAGES = [(text, *row) for text, rows in ((STAGE, OF_MESHES), (MOVED, OF_MOTIONS), (CURVES, OF_CURVES)) for row in rows]


@pytest.mark.parametrize(("text", "old", "new", "message"), WRONG_STAGES, ids=[row[2][:40] for row in WRONG_STAGES])
def test_wrong_stages(tmp_path, capfd, text, old, new, message):
    assert text.count(old) >= 1
    path = tmp_path / "cloth.usda"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=re.sub(r"^\*", "prim /Cloth: ", message)) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("left", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_crate_that_is_cut(tmp_path, capfd, left):
    path = tmp_path / "cloth.usdc"
    (tmp_path / "cloth.usda").write_text(STAGE)
    Sdf.Layer.FindOrOpen(str(tmp_path / "cloth.usda")).Export(str(path))
    os.truncate(path, int(left * os.path.getsize(path)))
    says = "is no USD stage " if left else "the file is empty$"
    with pytest.raises(ValueError, match=f"^{path}: {says}") as caught:
        read_scene(path)
    assert "\n" not in str(caught.value) and capfd.readouterr().err == ""


def test_a_value_that_python_has_not(tmp_path):
    """A crate may hold a different type than its attribute declares, and pxr then raises errors of any kind."""

    class Broken:
        def GetName(self):
            return "points"

        def Get(self, time):
            print("TypeError: No to_python converter", file=sys.stderr)
            raise TypeError("No to_python converter")

    with pytest.raises(ValueError, match=r"^points cannot be read \(No to_python converter\)$"):
        value_of(Broken())


@pytest.mark.parametrize("text", [STAGE, CURVES], ids=["mesh", "curves"])
def test_the_stages_are_right_before_a_part_is_replaced(tmp_path, text):
    (tmp_path / "cloth.usda").write_text(text)
    scene = read_scene(tmp_path / "cloth.usda")
    assert scene.frames and len(scene.pins.vertices)
    assert scene.pins.keyframes is None or len(scene.pins.keyframes) == 2


@pytest.mark.parametrize("width", ["nan", "inf", "-1"])
def test_widths_of_curves_that_are_none(tmp_path, width):
    (tmp_path / "cloth.usda").write_text(CURVES.replace("[0.0125]", f"[{width}]"))
    scene = read_scene(tmp_path / "cloth.usda")
    with pytest.raises(ValueError, match=rf"prim /Cloth: widths\[0\] is {width}.*, must be finite and 0 or more"):
        wc.simulate(scene, wc.Newton(substeps=1), output=tmp_path / "out.usdc")
    assert not (tmp_path / "out.usdc").exists()


def test_a_missing_layer_elsewhere_is_a_warning_and_pins_may_stand_at_a_time_sample_alone(tmp_path, capfd):
    """The schema has an empty fallback for indices, which is not what the file says."""
    text = STAGE.replace("indices = [0, 1]", "indices.timeSamples = {0: [0, 1], 2: [0, 1]}")
    (tmp_path / "cloth.usda").write_text(text + 'def "Set" (references = @gone.usda@)\n{\n}\n')
    with pytest.warns(UserWarning, match="^[^\n]*cloth.usda: In </Set>: Could not open asset @gone.usda@[^\n]*$"):
        assert read_scene(tmp_path / "cloth.usda").pins.vertices.tolist() == [0, 1]
    assert capfd.readouterr().err == ""


def test_holes_are_no_cloth(tmp_path):
    """holeIndices names faces that are not there: no triangles, no springs, no mass, and no value where faces have one."""
    quad = STAGE.replace("[3, 3]", "[3, 3, 4]").replace("1, 2, 3]", "1, 2, 3, 0, 2, 3, 1]")
    path = tmp_path / "cloth.usda"
    path.write_text(quad.replace("int[] faceVertexCounts", "int[] holeIndices = [2]\n    int[] faceVertexCounts"))
    scene = read_scene(path)
    np.testing.assert_array_equal(scene.mesh.triangles, [[1, 2, 0], [3, 2, 1]])
    options = {"source": scene.stage, "coloured": "strain"}
    with MeasureWriter(tmp_path / "out.usda", scene.mesh, {"strain": "uniform"}, **options) as writer:
        writer.append(0.0, {"strain": [1.0, 2.0]}, np.full((2, 3), 0.5))
    written = FrameSequence(tmp_path / "out.usda", attribute="primvars:strain")
    np.testing.assert_array_equal(written[0], [1.0, 2.0, np.nan])


# --- sizes without end


def run(n=5, solver=wc.Newton, output=None, **options):
    cloth = wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=[wc.Spring(stiffness=10.0)])
    step = {name: options.pop(name) for name in ("dt", "substeps", "iterations") if name in options} or {"substeps": 1}
    return wc.simulate(cloth, solver(**step), output, **options)


OF_COPIES = "frames is 1,000,000,000 of 100 copies, which takes {} TB of memory; it must fit in the .* that are free"
TOO_LARGE = [
    (lambda path: run(substeps=10**18), "substeps is 1000000000000000000; it must be 10,000,000 or less"),
    (lambda path: run(solver=wc.PBD, substeps=1, iterations=10**18), "iterations is 10+; it must be 10,000,000 or less"),
    (lambda path: run(dt=1e-308), "dt is 1e-308 s; at fps 60 a frame must be 10,000,000 steps or less"),
    (lambda path: run(dt=5e-324), "dt is 4.94066e-324 s; at fps 60 a frame must be"),
    (lambda path: run(frames=10**12), "frames is 10+; it must be 1,000,000,000 or less"),
    (lambda path: run(frames=10**9, copies=100), OF_COPIES.format(120)),
    (lambda path: run(frames=10**9, copies=100, solver=wc.Explicit), OF_COPIES.format(60)),
    (lambda path: run(frames=10**9, copies=100, dtype="float32"), OF_COPIES.format(60)),
    (
        lambda path: run(300, output=path / "out.usdc", frames=10**9),
        r"frames is 1,000,000,000, which takes 2.16e\+03 TB of the disk of .*; it must fit in the .* that are free there",
    ),
    (lambda path: wc.Mesh.grid(10**6, 10**6), "nx = 1000000, ny = 1000000, which takes 88 TB of memory; it must fit in"),
    (lambda path: wc.Mesh.grid(10**400, 3), "nx is 10+...0+; it must be a whole number of vertices, at least 2 and at most"),
    (lambda path: wc.Mesh.grid(3, 3, size=10**400), "size is 10+...0+; it must be a finite positive length"),
    (lambda path: wc.Mesh.chain(2**31 - 1), "n = 2147483647, which takes 189 GB of memory"),
    (lambda path: run(copies="2"), "copies is '2'; it must be a whole number of 1 or more"),
    (lambda path: run(copies=None), "copies is None; it must be a whole number of 1 or more"),
    (lambda path: run(dtype="double"), "dtype is 'double'; it must be one of 'float32', 'float64'"),
    (lambda path: run(dtype=[1]), r"dtype is \[1\]; it must be one of 'float32', 'float64'"),
    (lambda path: run(device=[]), r"device is \[\]; on this machine there are cpu"),
]


@pytest.mark.parametrize(("make", "message"), TOO_LARGE, ids=[message[:40] for _, message in TOO_LARGE])
def test_what_no_machine_takes(tmp_path, monkeypatch, make, message):
    monkeypatch.setattr(limits, "available_memory", lambda: 16 * 10**9)
    with pytest.raises(ValueError, match=f"^{message}"):
        make(tmp_path)
    assert not list(tmp_path.iterdir())


# --- at the command line: one sentence, whatever the matter is


def npy(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


BROKEN_ARRAYS = [
    (npy(b"{'descr': '<f4', 'shape': (4, 16, 3), }\n"), "eader"),
    (npy(b"{'descr': '<f4', 'fortran_order': Fals\ne, 'shape': (4, \n"), "header"),
    (npy(b"((((" * 2000 + b"\n"), "header"),
    (npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-4, 4, 3)}\n"), ""),
    (npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999, 4, 3)}\n"), ""),
    (npy(b"{'descr': 'O', 'fortran_order': False, 'shape': (2, 4, 3)}\n"), ""),
    (b"PK\x03\x04 no archive", ""),
    (b"", ""),
]


@pytest.mark.parametrize(("content", "message"), BROKEN_ARRAYS)
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_broken_arrays(tmp_path, content, message, ending):
    path = tmp_path / f"frames.{ending}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"^{path}: .*{message if ending == 'npy' else ''}"):
        wc.open_sequence(path, mesh=wc.Mesh.grid(2, 2))


def test_memory_is_known_where_the_tests_run():
    assert limits.available_memory() > 10**8
    assert limits.shown_bytes(999) == "999 bytes" and limits.shown_bytes(1.5e9) == "1.5 GB"


def test_gaps_without_end(tmp_path):
    """Of three frames some hundred million are missing, or the number of one is none that NumPy holds."""
    for name in ("cloth_0.obj", "cloth_1.obj", "cloth_900000000.obj"):
        (tmp_path / name).write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n")
    with pytest.raises(ValueError, match=f"^{tmp_path}: more than 1,000,000 frames are missing, from 1 to 900000000 and on"):
        _ = wc.open_sequence(tmp_path).missing
    (tmp_path / f"cloth_{10**30}.obj").write_text("")
    with pytest.raises(ValueError, match="has a number of 31 digits in its name, must have 15 at most"):
        wc.open_sequence(tmp_path)


MOVE = "deform cloth.usda --move all --translate 0 0 1"
NO_MEMORY = "there is not enough memory; a smaller mesh or picture, "


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["run", "a\nb.usda"], "'a\\\\nb.usda': a path in USD must be UTF-8 without line breaks"),
        (["run", os.fsdecode(b"\xff.usda")], "'\\\\udcff.usda': a path in USD must be UTF-8"),
        (["run", "hanging", "-o", "a\nb.usdc"], "a\\\\nb.usdc': a path in USD must be UTF-8"),
        (["run", "hanging", "-o", os.fsdecode(b"\xff.usdc")], "\\\\udcff.usdc': a path in USD must be UTF-8"),
        (f"run hanging -o o.usdc --frames {10**12}", "frames is 1000000000000; it must be 1,000,000,000 or less"),
        ("run hanging -o o.usdc -s dt=1e-308", "dt is 1e-308 s; at fps 60 a frame must be 10,000,000 steps or"),
        (f"run hanging -o o.usdc -s substeps={10**18}", "it must be 10,000,000 or less"),
        (f"{MOVE} -o o.usdc --frames {10**10}", "frames is 10000000000; it must be 10,000,000 or less"),
        ("info utf8.usda", "utf8.usda: it holds text that is no valid UTF-8"),
        ("info huge.usda --dtype float32", r"an edge of the mesh is 1e\+38 m long"),
        ("info memory.py", "memory.py, line 2: MemoryError"),
        ("run later.py -o o.usdc", f"{NO_MEMORY}fewer copies or fewer frames take less: 16"),
        ("run device.py -o o.usdc", NO_MEMORY),
        ("run disk.py -o o.usdc", "a file could not be read or written: No space left on device"),
        ("run deep.py -o o.usdc", "the input is nested too deeply to be read"),
    ],
)
def test_one_line_at_the_command_line(tmp_path, monkeypatch, capfd, arguments, line):
    monkeypatch.chdir(tmp_path)
    for name in (b"a\nb.usda", b"\xff.usda", b"cloth.usda"):
        with open(name, "w") as file:
            file.write(STAGE)
    (tmp_path / "utf8.usda").write_bytes(STAGE.encode().replace(b'"Spring"', b'"Spr\xff\xfeing"'))
    (tmp_path / "huge.usda").write_text(STAGE.replace("(1, 0, 0)", "(1e38, 0, 0)").replace("(0, 0, 1)", "(0, 0, -1e38)"))
    (tmp_path / "memory.py").write_text("def scene():\n    raise MemoryError\n")
    raised = {"later": "MemoryError('16 GiB')", "device": "RuntimeError('Failed to allocate 3 bytes on device')"}
    raised |= {"disk": "OSError(28, 'No space left on device')", "deep": "RecursionError"}
    for name, error in raised.items():  # past what is said of a scene file, as in a step
        text = f"import warpcloth as wc\nclass Broken(wc.Scene):\n    def build(self, **_):\n        raise {error}\n"
        make = "def scene():\n    return Broken(wc.Mesh.grid(3, 3), density=1.0, terms=[wc.Spring(stiffness=1.0)])\n"
        (tmp_path / f"{name}.py").write_text(text + make)
    before = set(os.listdir(b"."))
    assert main(arguments.split() if isinstance(arguments, str) else arguments) == 2
    out, err = capfd.readouterr()
    said = [each for each in err.splitlines() if not each.startswith("warpcloth: warning: ")]  # of the size of the cloth
    assert out == "" and len(said) == 1 and said[0].startswith("warpcloth: ") and re.search(line, said[0]), err
    assert set(os.listdir(b".")) == before


def test_names_do_not_steer_the_terminal(tmp_path, capfd):
    """Escape sequences in the name, an attribute and a type of a stage are printed escaped."""
    named = STAGE.replace(
        "double warpcloth:density", 'string warpcloth:name = "a\\x1b[31mred\\x07\\u202e"\n    double warpcloth:density'
    )
    (tmp_path / "cloth.usda").write_text(named)
    assert main(["info", str(tmp_path / "cloth.usda")]) == 0
    assert capfd.readouterr().out.startswith(r"a\x1b[31mred\x07")
    (tmp_path / "cloth.usda").write_text(STAGE.replace('"Spring"', '"Spr\\x1b[2Jing"'))
    assert main(["info", str(tmp_path / "cloth.usda")]) == 2
    _, err = capfd.readouterr()
    assert "\x1b" not in err and "ing" in err
    assert printable("αβ ä\u2028\u202e\x9b\udcff\t\n") == "αβ ä\\u2028\\u202e\\x9b\\udcff\t\n"


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_a_full_disk_at_the_last_file_loses_nothing(tmp_path, ending):
    """A limit on file size stands in for a full disk: chunks are below it, the merged file is not."""
    mesh = wc.Mesh.grid(8, 8)
    frames = np.random.default_rng(0).normal(size=(40, 64, 3)).astype(np.float32)
    writer = AnimationWriter(tmp_path / f"out.{ending}", mesh, 24, chunk=5)
    for points in frames:
        writer.append(points, points)
    message = rf"^{tmp_path}/out.{ending}: could not be written.*; frames 0 to 39 are "
    with room_for(50_000), pytest.raises(OSError, match=message) as caught:  # of about 30 kB a chunk
        writer.close(single_file=True)
    assert "\n" not in str(caught.value) and f"are in {writer.path}, " in str(caught.value)
    np.testing.assert_array_equal(FrameSequence(writer.path), frames)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        *(("convert cloth.usda", f"a.{ending}") for ending in ("npz", "mdd")),
        *(("render cloth.usda --size 64x48 -o", f"a.{ending}") for ending in ("png", "gif", "webp", "mp4")),
        ("view cloth.usda -o", "a.html"),
        ("analyze cloth.usda --csv", "a.csv"),
        *(("analyze cloth.usda --plot", f"a.{ending}") for ending in ("png", "svg", "pdf")),
        ("check cloth.usda --csv", "a.csv"),
        ("compare cloth.usda cloth.usda --csv", "a.csv"),
    ],
)
def test_a_full_disk_is_said_with_the_name_of_the_file(tmp_path, monkeypatch, capfd, command, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloth.usda").write_text(MOVED)
    assert main([*command.split(), f"before.{name[2:]}"]) in (0, 1)  # compiles kernels, which need room too
    files = set(os.listdir())
    capfd.readouterr()
    with room_for(40):
        assert main([*command.split(), name]) == 2
    assert capfd.readouterr().err == f"warpcloth: {name}: File too large\n" and set(os.listdir()) == files


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("view cloth.usda -o", "a.html"),
        *(("render cloth.usda -o", f"a.{ending}") for ending in ("png", "gif", "mp4")),
        ("convert cloth.usda", "a.npz"),
        ("analyze cloth.usda --csv", "a.csv"),
        ("analyze cloth.usda --plot", "a.png"),
        ("analyze cloth.usda -o", "a.usdc"),
        ("compare cloth.usda cloth.usda --csv", "a.csv"),
        ("check cloth.usda --csv", "a.csv"),
        ("run cloth.usda -o o.usdc --film", "a.gif"),
        ("run cloth.usda -o o.usdc --csv", "a.csv"),
        ("run cloth.usda -o o.usdc --report", "a.json"),
        ("run cloth.usda -o", "a.usdc"),
    ],
)
@pytest.mark.parametrize("there", [True, False], ids=["", "dangling"])
def test_a_link_to_a_file_of_another_kind_is_not_written_through(tmp_path, monkeypatch, capfd, command, name, there):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloth.usda").write_text(MOVED)
    os.symlink("mine.py", name)
    if there:
        (tmp_path / "mine.py").write_text("x = 1")
    before = set(os.listdir())
    assert main([*command.split(), name]) == 2
    assert re.search(r"mine\.py; it must end (as that does|with one of .*)\n$", capfd.readouterr().err)
    assert set(os.listdir()) == before and (not there or (tmp_path / "mine.py").read_text() == "x = 1")


def test_a_full_disk_behind_the_standard_output_is_said():
    command = [sys.executable, "-m", "warpcloth", "fabrics"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "warpcloth: the standard output: No space left on device\n")


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_a_package_that_is_cut_is_not_taken_for_whole(tmp_path, monkeypatch, kept):
    """pxr does not notice that the disk is full while it packs, so the package is read before the frames are removed."""

    def is_whole(package):
        os.truncate(package, int(kept * os.path.getsize(package)))
        return real(package)

    real = packages._is_whole
    monkeypatch.setattr(packages, "_is_whole", is_whole)
    points = wc.Mesh.grid(3, 3).points
    writer = AnimationWriter(tmp_path / "out.usdz", wc.Mesh.grid(3, 3), 24)
    writer.append(points, points)
    with pytest.raises(OSError, match=r"out\.usdz: could not be written; frames 0 to 0 are in "):
        writer.close()
    np.testing.assert_array_equal(FrameSequence(writer.path), np.float32([points]))


def test_a_package_holds_no_file_from_elsewhere(tmp_path):
    """Textures of the stage's folders are packed, of a referenced layer's too; a file from outside keeps its path."""
    textures = ("show/tex/a.png", "show/tex/b.1001.png", "show/tex/b.1002.png", "library/t.png")
    for name in (*textures, "library/set.usda", "secret.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "show/link.png").symlink_to(tmp_path / "secret.txt")
    assets = {"near": "./tex/a.png", "tiles": "./tex/b.<UDIM>.png", "above": "../secret.txt", "root": "/etc/hostname"}
    assets |= {"link": "./link.png", "gone": "./gone.png"}
    given = "".join(f"    asset {name} = @{path}@\n" for name, path in assets.items())
    given += "    asset[] several = [@./tex/a.png@, @../secret.txt@]\n"
    text = STAGE.replace("    uniform token orientation", given + "    uniform token orientation")
    (tmp_path / "show/cloth.usda").write_text(text + 'def "Set" (references = @../library/set.usda@)\n{\n}\n')
    library = '#usda 1.0\n(\n    defaultPrim = "S"\n)\ndef "S"\n{\n    asset shown = @./t.png@\n}\n'
    (tmp_path / "library/set.usda").write_text(library)
    scene = read_scene(tmp_path / "show/cloth.usda")
    with pytest.warns(UserWarning) as warned:
        wc.simulate(scene, wc.Newton(substeps=1), output=tmp_path / "out.usdz")
    said = sorted({str(warning.message).partition(":")[0] for warning in warned})
    assert said == ["../secret.txt", "./link.png", "/etc/hostname", str(tmp_path / "show/gone.png")]
    with zipfile.ZipFile(tmp_path / "out.usdz") as archive:
        packed = {name.partition("/")[2]: archive.read(name).decode() for name in archive.namelist()[1:]}
    assert packed == {name.rpartition("/")[2]: name for name in textures}
    stage = Usd.Stage.Open(str(tmp_path / "out.usdz"))
    found = {name: stage.GetPrimAtPath("/Cloth").GetAttribute(name).Get() for name in (*assets, "several")}
    assert [found[name].path for name in ("above", "root", "link")] == ["../secret.txt", "/etc/hostname", "./link.png"]
    assert found["gone"] is None
    assert found["near"].resolvedPath.endswith("/a.png]") and found["tiles"].path.endswith("/b.<UDIM>.png")
    assert [asset.path.rpartition("/")[2] for asset in found["several"]] == ["a.png", "secret.txt"]
    assert stage.GetPrimAtPath("/Set").GetAttribute("shown").Get().resolvedPath.endswith("/t.png]")
    # Out of a package, too.
    with pytest.warns(UserWarning, match="there is no such file"):  # USD finds no tiles in a package
        again = wc.simulate(read_scene(tmp_path / "out.usdz"), wc.Newton(substeps=1), output=tmp_path / "again.usdz")
    with zipfile.ZipFile(again.output) as archive:
        assert {name.rpartition("/")[2] for name in archive.namelist()[1:]} == {"a.png", "t.png"}


# --- a broken cache of kernels


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Returns a kernel with its own folder of compiled files, and a function that loads them again."""

    @wp.kernel(module="unique", enable_backward=False)
    def double(x: wp.array(dtype=float)):
        i = wp.tid()
        x[i] = 2.0 * x[i]

    initialise_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    def loaded_again():
        double.module.execs.clear()
        double.module.mark_modified()
        x = wp.array([1.0, 2.0], dtype=float, device="cpu")
        wp.launch(double, 2, inputs=[x], device="cpu")
        assert x.numpy().tolist() == [2.0, 4.0]
        (folder,) = tmp_path.glob("*double*")
        return {path.suffix: path for path in folder.iterdir()}

    return loaded_again


DAMAGES = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "garbage": lambda data: bytes(np.random.default_rng(0).integers(0, 256, len(data), np.uint8)),
    "without names": lambda data: data.replace(b"cpu_forward", b"cpu_f\0\0\0\0\0\0"),
}


@pytest.mark.parametrize("ending", [".o", ".meta"])
def test_a_broken_cache_mends_itself(kernel, ending):
    for damage, broken in DAMAGES.items():
        path = kernel()[ending]
        whole = path.read_bytes()
        path.write_bytes(broken(whole))
        kernel()
        assert path.read_bytes() == whole or ending == ".o", damage
        path.unlink()
        kernel()


def test_all_threads_read_headers_parsed_once(tmp_path, kernel, monkeypatch):
    def compiled_again():
        shutil.rmtree(kernel()[".o"].parent)
        thread = threading.Thread(target=kernel)
        thread.start()
        thread.join()
        return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}

    kernel()
    folder = tmp_path / "headers"
    folder.mkdir()
    for path in Path(warp_internals.headers_folder()).glob("*.pch"):
        shutil.copy(path, folder)
    monkeypatch.setattr(warp_internals, "headers_folder", lambda: str(folder))
    copied = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert copied and compiled_again() == copied
    # The compiler says that it cannot read these files, and removes the one that it tried.
    for path in folder.iterdir():
        path.write_bytes(b"cut")
    assert len(compiled_again()) == len(copied) - 1


def test_a_full_cache_is_said(tmp_path, kernel):
    """LLVM would end the process, with the exit code of a run that diverged; once compiled a kernel needs no room."""
    message = r"File too large.*where Warp keeps compiled kernels .WARP_CACHE_PATH names another"
    with room_for(10_000), pytest.raises(OSError, match=message):
        kernel()
    kernel()
    with room_for(10_000):
        kernel()


@pytest.mark.parametrize("cache", ["full", pytest.param("file/cache", marks=pytest.mark.slow)])
def test_a_cache_that_takes_nothing_is_no_divergence(tmp_path, cache):
    (tmp_path / "file").write_text("")
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / cache), "PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = ["run", "hanging", "-p", "n=3", "--frames", "1", "-s", "substeps=1", "-o", str(tmp_path / "o.usdc")]
    code = f"""
import resource, sys
import warpcloth.cli
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
sys.exit(warpcloth.cli.main({arguments}))"""
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 2 and ended.stdout == "", ended
    assert re.fullmatch(rf"warpcloth: {tmp_path}/{cache}[^\n]*, where Warp keeps compiled kernels [^\n]*\n", ended.stderr)
    assert not (tmp_path / "o.usdc").exists()
