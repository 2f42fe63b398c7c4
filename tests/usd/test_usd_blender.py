"""Stages as Blender 5.0 exports them, cut down by hand: they run without an edit."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warpcloth as wc
from support.usd_validation import validate
from warpcloth.usd import read_scene
from warpcloth.usd.drawn import read_drawn

HEADER = """#usda 1.0
(
    defaultPrim = "root"
    doc = "Blender v5.0.1"
    endTimeCode = 5
    metersPerUnit = 1
    startTimeCode = 1
    timeCodesPerSecond = 24
    upAxis = "Z"
)
"""
# A flag of 4 × 3 vertices, child of a pole that is keyed as an object: it moves by 0.1 m along x, and turns by 40° about z.
# Numbers and texts are custom properties of the object ("Flag") and of its data ("FlagMesh"), of types double, int and string.
FLAG = (
    HEADER
    + """
def Xform "root"
{
    def Xform "Pole"
    {
        float3 xformOp:rotateXYZ.timeSamples = {1: (0, -0, 0), 3: (0, -0, 20), 5: (0, -0, 40)}
        float3 xformOp:scale.timeSamples = {1: (1, 1, 1)}
        double3 xformOp:translate.timeSamples = {1: (0, 0, 1.5), 3: (0.05, 0, 1.5), 5: (0.1, 0, 1.5)}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]

        def Xform "Flag"
        {
            custom string userProperties:blender:object_name = "Flag"
            custom double warpcloth:density = 0.15
            OBJECT
            float3 xformOp:rotateXYZ = (89.99999, -0, 0)
            float3 xformOp:scale = (0.5, 0.5, 0.5)
            double3 xformOp:translate = (0, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]

            def Mesh "FlagMesh" (
                active = true
                prepend apiSchemas = ["MaterialBindingAPI"]
            )
            {
                uniform bool doubleSided = 1
                float3[] extent = [(0, 0, 0), (3, 2, 0)]
                int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
                int[] faceVertexIndices = [0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 4, 5, 9, 8, 5, 6, 10, 9, 6, 7, 11, 10]
                point3f[] points = [
                    (0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0),
                    (0, 1, 0), (1, 1, 0), (2, 1, 0), (3, 1, 0),
                    (0, 2, 0), (1, 2, 0), (2, 2, 0), (3, 2, 0)
                ]
                uniform token subdivisionScheme = "none"
                uniform token subsetFamily:materialBind:familyType = "nonOverlapping"
                custom string userProperties:blender:data_name = "FlagMesh"
                custom int warpcloth:terms:threads:stiffness = 200
                custom string warpcloth:terms:threads:type = "Spring"
                DATA
            }
        }
    }
}
"""
)
PINNED = [0, 4, 8]
SUBSET = 'def GeomSubset "pins"\n{{\n{}\n}}'
# A vertex group, a boolean attribute, the faces of a material or face set (their corners), and a custom property.
PRIMVAR = ' primvars:pins = [{}, 0, 0, 0] (interpolation = "vertex")'
FACES = 'uniform token elementType = "face"\nuniform token familyName = "materialBind"\nint[] indices = [0, 3]'
PINS = {
    "vertex group": "float[]" + PRIMVAR.format("1, 0, 0, 0, 0.5, 0.49, 0, 0, 1"),
    "boolean": "bool[]" + PRIMVAR.format("1, 0, 0, 0, 1, 0, 0, 0, 1"),
    "material": SUBSET.format(FACES).replace('"pins"', '"pins" (prepend apiSchemas = ["MaterialBindingAPI"])'),
    "property of the object": 'custom string warpcloth:pins = "x == 0"',
    "property of the data": 'custom string warpcloth:pins = "index(0, 4, 8)"',
    "indices": "int[] warpcloth:pins = [8, 4, 0]",
    "two of them": 'string warpcloth:pins = "index(4, 8)"\nfloat[]' + PRIMVAR.format("1, 0, 0, 0, 1, 0, 0, 0, 0"),
}


def flag(path, pins="vertex group"):
    where = ("OBJECT", "DATA") if "object" in pins else ("DATA", "OBJECT")
    path.write_text(FLAG.replace(where[0], PINS.get(pins, pins)).replace(where[1], ""))
    return path


def of_pole(local, frame):
    """Points (p, 3) of the flag in world space at a frame: halved, upright, turned by 10° a frame and moved by 25 mm."""
    angle = np.radians(10.0 * frame)
    upright = 0.5 * np.stack([local[:, 0], np.zeros(len(local)), local[:, 1]], axis=1)
    turned = upright @ [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    return turned + np.array([0.025 * frame, 0, 1.5])


@pytest.mark.parametrize("pins", PINS)
def test_pins_of_a_stage_from_blender(tmp_path, pins):
    expected = [0, 1, 4, 5, 8, 9] if pins == "material" else PINNED
    assert read_scene(flag(tmp_path / "flag.usda", pins)).pins.vertices.tolist() == expected


CHANGING = f"float[] primvars:pins.timeSamples = {{1: {[1] * 12}, 2: {[0] * 12}}}"


@pytest.mark.parametrize(
    ("pins", "message"),
    [
        ("float[] primvars:pins = [1, 0]", r"primvars:pins has shape \(2,\), must have a number for each of 12 points"),
        (CHANGING, "primvars:pins changes over time, must have one"),
        (SUBSET.format('token elementType = "edge"'), "GeomSubset pins: elementType is 'edge', must be 'point' or 'face'"),
        (SUBSET.format("int[] indices = [7]"), r"GeomSubset pins: indices\[0\] = 7, must be a face, 0 to 5"),
        ("custom int2 warpcloth:pins = (0, 4)", r"warpcloth:pins has type int2, must be string or int\[\]"),
        ('custom string warpcloth:pins = "left"', "'left'"),
        ("int[] warpcloth:pins = [12]", r"warpcloth:pins\[0\] is 12; it must lie in 0 … 11"),
    ],
)
def test_pins_that_are_refused(tmp_path, pins, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_scene(flag(tmp_path / "flag.usda", pins))
    assert "prim /root/Pole/Flag/FlagMesh: " in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("prim", [None, "Flag", "/root/Pole/Flag", "FlagMesh"])
def test_a_flag_that_is_keyed_as_an_object_follows_its_pole(tmp_path, prim):
    """Pins move with it, and the result is written in its space, where they stand still, with velocities relative to it."""
    source = flag(tmp_path / "flag.usda")
    scene = read_scene(source, prim)
    assert (scene.name, scene.fps, scene.frames, scene.density) == ("FlagMesh", 24, 4, 0.15)
    assert [(term.name, term.stiffness) for term in scene.terms] == [("threads", 200)]
    local = np.array([[x, y, 0.0] for y in range(3) for x in range(4)])
    np.testing.assert_allclose(scene.positions, of_pole(local, 0), atol=1e-6)  # Blender writes 89.99999°
    keyframes = [of_pole(local[PINNED], frame) for frame in range(5)]
    np.testing.assert_allclose(scene.pins.keyframes, keyframes, atol=1e-6)
    before = source.read_bytes()
    animation = wc.simulate(scene, wc.Explicit(substeps=8), output=tmp_path / "out.usdc", dtype="float64")
    assert source.read_bytes() == before and validate(tmp_path / "out.usdc", source) == []
    last = wc.simulate(scene, wc.Explicit(substeps=8), dtype="float64")
    for name in ("points", "velocities"):  # those of the file are rounded to float32 in the space of the flag
        np.testing.assert_allclose(getattr(animation, name), getattr(last, name), atol=1e-6)
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    mesh = UsdGeom.Mesh.Get(stage, "/root/Pole/Flag/FlagMesh")
    for code in range(1, 6):
        points, velocities = (np.array(each.Get(code)) for each in (mesh.GetPointsAttr(), mesh.GetVelocitiesAttr()))
        np.testing.assert_allclose(points[PINNED], local[PINNED], atol=1e-6)
        np.testing.assert_allclose(velocities[PINNED], 0.0, atol=1e-4)  # 24 · 8 steps in a second, of 1e-6 each
    assert np.abs(velocities).max() > 0.1


def test_a_stage_from_blender_is_drawn_with_its_pins_and_shape_keys_keep_attributes(tmp_path):
    """Blender makes a SkelRoot of an object with shape keys."""
    path = flag(tmp_path / "flag.usda")
    (prim,) = read_drawn(str(path)).prims
    assert prim.pins.tolist() == PINNED
    path.write_text(path.read_text().replace('Xform "Flag"', 'SkelRoot "Flag"'))
    assert read_scene(path).density == 0.15


# A ball of 0.4 m, whose mesh is that of an octahedron, keyed from one side of the flag to the other.
BALL = """
    def Xform "Ball"
    {
        custom string userProperties:blender:object_name = "Ball"
        custom string warpcloth:collider
        string warpcloth:collider.timeSamples = {1: "boundingSphere"}
        custom double warpcloth:friction
        double warpcloth:friction.timeSamples = {1: 0.25}
        float3 xformOp:rotateXYZ.timeSamples = {1: (0, -0, 0)}
        float3 xformOp:scale.timeSamples = {1: (2, 2, 2)}
        double3 xformOp:translate.timeSamples = {1: (1, -0.6, 2), 3: (1, -0.2, 2), 5: (1, 0.2, 2)}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]

        def Mesh "Octahedron" (
            active = true
        )
        {
            int[] faceVertexCounts = [3, 3, 3, 3, 3, 3, 3, 3]
            int[] faceVertexIndices = [0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]
            point3f[] points = [(0.2, 0, 0), (-0.2, 0, 0), (0, 0.2, 0), (0, -0.2, 0), (0, 0, 0.2), (0, 0, -0.2)]
            uniform token subdivisionScheme = "none"
        }
    }
"""


def test_an_animated_ball_pushes_the_flag(device, tmp_path):
    path = flag(tmp_path / "flag.usda")
    path.write_text(path.read_text().replace('def Xform "root"\n{', 'def Xform "root"\n{' + BALL))
    scene = read_scene(path)
    (ball,) = scene.colliders
    assert (type(ball), ball.friction, ball.name) == (wc.Sphere, 0.25, "/root/Ball/Octahedron")
    assert ball.radius == pytest.approx(0.4)
    np.testing.assert_allclose(ball.position[:, 1], np.linspace(-0.6, 0.2, 5), atol=1e-7)
    animation = wc.simulate(scene, wc.Newton(substeps=4), output=tmp_path / "out.usdc", device=device)
    distances = [ball.distances(points, frame) for frame, points in enumerate(animation.points)]
    assert np.min(distances) > -1e-6 and np.min(distances[-1]) < 1e-2  # frames are rounded to float32
    assert animation.points[-1, 6, 1] > 0.3  # the vertex that was in its way
