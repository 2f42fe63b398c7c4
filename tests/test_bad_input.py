"""Input that is wrong: refused in one sentence that says what, where and what is allowed, before anything runs."""

import numpy as np
import pytest

import warpcloth as wc
from warpcloth import limits
from warpcloth.usd import FrameSequence, MeasureWriter, read_scene

STAGE = """#usda 1.0
(
    defaultPrim = "Cloth"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Y"
    timeCodesPerSecond = 24
    framesPerSecond = 24
    startTimeCode = 0
    endTimeCode = 3
    customLayerData = {
        dictionary warpcloth = {
            string prim = "/Cloth"
        }
    }
)

def Mesh "Cloth"
{
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 2, 1, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
    point3f[] points.timeSamples = {
        0: [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)],
        3: [(0, 0.1, 0), (1, 0.1, 0), (0, 0, 1), (1, 0, 1)],
    }
    uniform token orientation = "leftHanded"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1), (1, 1)] (
        interpolation = "vertex"
    )
    double warpcloth:density = 0.15
    double warpcloth:duration = 0.125
    double3 warpcloth:gravity = (0, -9.81, 0)
    double3[] warpcloth:pins:keyframes.timeSamples = {0: [(0, 0, 0), (1, 0, 0)], 1: [(0, 0, 0), (1, 0, 0)]}
    token warpcloth:terms:threads:type = "Spring"
    token warpcloth:terms:threads:pairs = "edges"
    double warpcloth:terms:threads:stiffness = 1000

    def GeomSubset "pins"
    {
        uniform token elementType = "point"
        uniform token familyName = "pins"
        int[] indices = [0, 1]
    }
}
"""
MOVED = "".join(line for line in STAGE.splitlines(keepends=True) if "keyframes" not in line)  # pins follow the points
CURVES = """#usda 1.0
(
    metersPerUnit = 1
)

def BasisCurves "Cloth"
{
    int[] curveVertexCounts = [5]
    point3f[] points = [(0, -0, 0), (0, -0.25, 0), (0, -0.5, 0), (0, -0.75, 0), (0, -1, 0)]
    int[] primvars:warpcloth:vertex = [0, 1, 2, 3, 4]
    uniform token type = "linear"
    double warpcloth:density = 0.1
    double warpcloth:duration = 1
    token warpcloth:terms:Spring:type = "Spring"
    double warpcloth:terms:Spring:stiffness = 100
    float[] widths = [0.0125]
    uniform token wrap = "nonperiodic"

    def GeomSubset "pins"
    {
        uniform token elementType = "point"
        uniform token familyName = "pins"
        int[] indices = [0]
    }
}
"""

WRONG_STAGES = [  # the text, what stands in place of a part of it, the sentence after the path
    (STAGE, "metersPerUnit = 1", "metersPerUnit = -1", "metersPerUnit is -1.0, must be a finite number above 0"),
    (STAGE, "kilogramsPerUnit = 1", "kilogramsPerUnit = nan", "kilogramsPerUnit is nan, must be"),
    (STAGE, '"Y"', '"X"', 'upAxis is \'X\', must be "Y" or "Z"'),
    (STAGE, "timeCodesPerSecond = 24", "timeCodesPerSecond = 0", "timeCodesPerSecond is 0.0, must be a finite number above 0"),
    (STAGE, "timeCodesPerSecond = 24", "timeCodesPerSecond = -24", "timeCodesPerSecond is -24.0, must be"),
    (STAGE, "framesPerSecond = 24", "framesPerSecond = inf", "framesPerSecond is inf, must be"),
    (STAGE, "startTimeCode = 0", "startTimeCode = -1e18", r"startTimeCode is -1e\+18, must be a number of -1e\+09 to 1e\+09"),
    (STAGE, "endTimeCode = 3", "endTimeCode = inf", "endTimeCode is inf, must be a number of"),
    (STAGE, "3: [(0, 0.1", "1e15: [(0, 0.1", r"prim /Cloth: points has a sample at time code 1e\+15, must be at -1e\+09"),
    (
        STAGE,
        "1: [(0, 0, 0), (1",
        "1e15: [(0, 0, 0), (1",
        r"prim /Cloth: warpcloth:pins:keyframes has a sample at time code 1e\+15",
    ),
    (
        MOVED,
        "(1, 0.1, 0), (0, 0, 1)",
        "(1, 0.1, 0), (0, nan, 1)",
        r"prim /Cloth: points\[2\]\[1\] at time code 1 is nan, must be finite",
    ),
    (MOVED, "[(0, 0.1, 0), (1, 0.1, 0), (0, 0, 1), (1, 0, 1)]", "None", "prim /Cloth: points is blocked at time code 3, must"),
    (STAGE, "(0, 0, 0), (1, 0, 0)]}", "(0, inf, 0), (1, 0, 0)]}", r"keyframes\[0\]\[1\] at time code 1 is inf, must be finite"),
    (STAGE, "Indices = [0, 2", "Indices = [0, -2", r"prim /Cloth: faceVertexIndices\[1\] = -2, must be a vertex, 0 to 3"),
    (STAGE, "int[] faceVertexCounts = [3, 3]", "float[] faceVertexCounts = [3, 3]", "faceVertexCounts holds float32 of shape"),
    (
        CURVES,
        "point3f[] points = [(0, -0, 0), (0, -0.25, 0), (0, -0.5, 0), (0, -0.75, 0), (0, -1, 0)]",
        "int[] points = [1, 2]",
        "points holds int32 of",
    ),
    (STAGE, '"leftHanded"', '"sideways"', "prim /Cloth: orientation is 'sideways', must be one of rightHanded, leftHanded"),
    (
        STAGE,
        "indices = [0, 1]",
        "indices = [0, 99]",
        r"prim /Cloth: GeomSubset pins: indices\[1\] = 99, must be a point, 0 to 3",
    ),
    (STAGE, "indices = [0, 1]", "indices = [-1, 0]", r"GeomSubset pins: indices\[0\] = -1, must be a point"),
    (STAGE, "double warpcloth:density = 0.15", "double warpcloth:density = nan", "warpcloth:density is nan, must be finite"),
    (STAGE, "(0, -9.81, 0)", "(0, -inf, 0)", r"warpcloth:gravity\[1\] is -inf, must be finite"),
    (STAGE, "stiffness = 1000", "stiffness = nan", "warpcloth:terms:threads:stiffness is nan, must be a number"),
    (STAGE, "density = 0.15", "density.timeSamples = {0: None}", "warpcloth:density is blocked at its first time sample, must"),
    (
        STAGE,
        "int[] faceVertexCounts = [3, 3]",
        "int[] faceVertexCounts.timeSamples = {0: [3, 3], 3: [3]}",
        "prim /Cloth: 1 faceVertexCounts at time code 3, must stay 2",
    ),
    (
        STAGE,
        "int[] faceVertexCounts",
        "int[] holeIndices = [2]\n    int[] faceVertexCounts",
        r"holeIndices\[0\] = 2, must be a face",
    ),
    (
        STAGE,
        "(\n    defaultPrim",
        "(\n    subLayers = [@gone.usda@]\n    defaultPrim",
        "Could not load sublayer @gone.usda@ .*must be",
    ),
    (
        STAGE,
        'def Mesh "Cloth"\n',
        'def Mesh "Cloth" (references = @gone.usda@)\n',
        "prim /Cloth: Could not open asset @gone.usda@",
    ),
    (CURVES, "[5]", "[9]", "prim /Cloth: curveVertexCounts add up to 9, must be the number of points, 5"),
    (CURVES, "[5]", "[2147483647]", "curveVertexCounts add up to 2147483647, must be the number of points, 5"),
    (CURVES, "[5]", "[6, -1]", r"curveVertexCounts\[1\] is -1, must be at least 2"),
    (CURVES, "indices = [0]", "indices = [99]", r"GeomSubset pins: indices\[0\] = 99, must be a point, 0 to 4"),
    (CURVES, '"nonperiodic"', '"round"', "wrap is 'round', must be one of nonperiodic, periodic, pinned"),
    (
        CURVES,
        "int[] primvars:warpcloth:vertex = [0, 1, 2, 3, 4]",
        'string[] primvars:warpcloth:vertex = ["a"]',
        "holds <U1 of shape",
    ),
]


@pytest.mark.parametrize(("text", "old", "new", "message"), WRONG_STAGES, ids=[row[2][:40] for row in WRONG_STAGES])
def test_wrong_stages(tmp_path, capfd, text, old, new, message):
    assert text.count(old) >= 1
    path = tmp_path / "cloth.usda"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


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


def test_a_missing_layer_elsewhere_is_a_warning(tmp_path, capfd):
    (tmp_path / "cloth.usda").write_text(STAGE + 'def "Set" (references = @gone.usda@)\n{\n}\n')
    with pytest.warns(UserWarning, match="^[^\n]*cloth.usda: In </Set>: Could not open asset @gone.usda@[^\n]*$"):
        read_scene(tmp_path / "cloth.usda")
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


TOO_LARGE = [
    (lambda path: run(substeps=10**18), "substeps is 1000000000000000000; it must be 10,000,000 or less"),
    (lambda path: run(solver=wc.PBD, substeps=1, iterations=10**18), "iterations is 10+; it must be 10,000,000 or less"),
    (lambda path: run(dt=1e-308), "dt is 1e-308 s; at fps 60 a frame must be 10,000,000 steps or less"),
    (lambda path: run(dt=5e-324), "dt is 4.94066e-324 s; at fps 60 a frame must be"),
    (lambda path: run(frames=10**12), "frames is 10+; it must be 1,000,000,000 or less"),
    (
        lambda path: run(frames=10**9, copies=100),
        "frames is 1,000,000,000, which takes 60 TB of memory; it must fit in the .* that are free",
    ),
    (
        lambda path: run(300, output=path / "out.usdc", frames=10**9),
        r"frames is 1,000,000,000, which takes 2.16e\+03 TB of the disk of .*; it must fit in the .* that are free there",
    ),
    (lambda path: wc.Mesh.grid(10**6, 10**6), "nx = 1000000, ny = 1000000, which takes 88 TB of memory; it must fit in"),
    (lambda path: wc.Mesh.grid(10**400, 3), "nx = 10+...0+: must be a whole number of vertices, at least 2 and at most"),
    (lambda path: wc.Mesh.grid(3, 3, size=10**400), "size = 10+...0+: must be a finite positive length"),
    (lambda path: wc.Mesh.chain(2**31 - 1), "n = 2147483647, which takes 189 GB of memory"),
    (lambda path: run(device=[]), r"device is \[\]; on this machine there are cpu"),
]


@pytest.mark.parametrize(("make", "message"), TOO_LARGE, ids=[message[:40] for _, message in TOO_LARGE])
def test_what_no_machine_takes(tmp_path, monkeypatch, make, message):
    monkeypatch.setattr(limits, "available_memory", lambda: 16 * 10**9)
    with pytest.raises(ValueError, match=f"^{message}"):
        make(tmp_path)
    assert not list(tmp_path.iterdir())


def test_memory_is_known_where_the_tests_run():
    assert limits.available_memory() > 10**8
    assert limits.shown_bytes(999) == "999 bytes" and limits.shown_bytes(1.5e9) == "1.5 GB"
