"""Colliders of stages that artists make: shapes, scales, motion, materials, and what cannot be one."""

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

import warpcloth as wc
from support.layers import falling
from support.shapes import TILTED
from support.usd_validation import validate
from warpcloth.usd import read_scene, read_stage_mesh, write_scene
from warpcloth.usd.drawn import read_drawn

# A square of 1 m at a height of 2 m, in centimetres with z up, at 24 frames a second from time code 101 to 105.
STAGE = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
    startTimeCode = 101
    endTimeCode = 105
    timeCodesPerSecond = 24
    framesPerSecond = 24
)
def Mesh "Cloth"
{
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 3, 2]
    point3f[] points = [(0, 0, 200), (100, 0, 200), (0, 100, 200), (100, 100, 200)]
    double warpcloth:density = 0.15
    token warpcloth:terms:threads:type = "Spring"
    double warpcloth:terms:threads:stiffness = 1000
}
"""
COLLIDES = '(prepend apiSchemas = ["PhysicsCollisionAPI"])'
TETRAHEDRON = """
    int[] faceVertexCounts = [3, 3, 3, 3]
    int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10)]
"""


INWARD = TETRAHEDRON.replace("0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3", "0, 1, 2, 0, 3, 1, 0, 2, 3, 1, 3, 2")


def shape(kind, text="", name="Thing", meta=COLLIDES):
    return f'def {kind} "{name}" {meta}\n{{\n{text}\n}}\n'


def ops(**operations):
    """Transforms in the order given, each a value or time samples as a dictionary."""
    types = {"translate": "double3", "scale": "float3"}
    values = {name: f"{'.timeSamples' if isinstance(x, dict) else ''} = {x}" for name, x in operations.items()}
    lines = [f"{types.get(name, 'float')} xformOp:{name}{text}" for name, text in values.items()]
    order = ", ".join(f'"xformOp:{name}"' for name in operations)
    return "\n".join([*lines, f"uniform token[] xformOpOrder = [{order}]\n"])


def at(x, y, z):
    return ops(translate=(x, y, z))


def scaled(scale):
    return ops(scale=scale)


MOVING = ops(translate={101: (0, 0, 0), 105: (40, 0, 0)}, rotateZ={101: 0, 105: 80})


def scene_with(path, *texts):
    path.write_text(STAGE + "".join(texts))
    return read_scene(path)


def collider_of(path, *texts):
    (found,) = scene_with(path, *texts).colliders
    return found


def turned(collider, frame, points):
    """Where points (p, 3) of the body of a collider are at a frame."""
    pose = collider.poses[frame]
    u, w = pose[3:6], pose[6]
    t = 2.0 * np.cross(u, points)
    return points + w * t + np.cross(u, t) + pose[:3]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "stage.usda"


def test_solids_in_units_of_the_stage(path):
    texts = [
        shape("Sphere", "double radius = 20\n" + at(50, 0, 30)),
        shape("Capsule", 'double radius = 5\ndouble height = 40\nuniform token axis = "X"\n' + at(0, 0, 9), "Rod"),
        shape("Cube", "double size = 2\n" + ops(rotateZ=90, scale=(10, 20, -30)), "Brick"),
        shape("Plane", 'uniform token axis = "X"\n' + ops(translate=(0, -200, 0), rotateZ=90), "Wall"),
    ]
    ball, rod, brick, wall = scene_with(path, *texts).colliders
    assert [each.name for each in (ball, rod, brick, wall)] == ["/Thing", "/Rod", "/Brick", "/Wall"]
    assert (type(ball), ball.radius, ball.position.tolist()) == (wc.Sphere, 0.2, [0.5, 0, 0.3])
    assert (type(rod), rod.radius, rod.length, rod.axis.tolist()) == (wc.Capsule, 0.05, 0.4, [1, 0, 0])
    assert isinstance(brick, wc.Box)
    np.testing.assert_allclose(brick.distances(np.array([[0.4, 0, 0], [0, 0.2, 0], [0, 0, 0.6]])), [0.2, 0.1, 0.3])
    assert isinstance(wall, wc.Plane)
    np.testing.assert_allclose(wall.distances(np.array([[5.0, 0.3, 1], [2, -0.2, 0]])), [2.3, 1.8], atol=1e-12)


@pytest.mark.parametrize(("sign", "height", "side"), [((1, 1, 1), 0, 1), ((-1, 1, 1), 0, 1), ((1, 1, -1), 300, -1)])
def test_a_mirrored_plane_keeps_what_is_behind_it(path, sign, height, side):
    plane = collider_of(path, shape("Plane", 'uniform token axis = "Z"\n' + ops(translate=(0, 0, height), scale=sign)))
    assert isinstance(plane, wc.Plane)
    np.testing.assert_allclose(plane.distances(np.array([[0.3, 0.2, 0.1]])), [(0.1 - 0.01 * height) * side])


ON_A_LINE = TETRAHEDRON.replace("[3, 3, 3, 3]", "[4, 3, 3, 4]").replace("0, 2, 1, 0", "0, 2, 4, 1, 0")
AT_ONE_POSITION = TETRAHEDRON.replace("[3, 3, 3, 3]", "[3, 3, 3, 3, 3]").replace("2, 1, 2, 3", "2, 1, 4, 3, 2, 1, 4")
SOLIDS = {
    "ellipsoid": ("Sphere", "double radius = 10\n" + scaled((1, 2, 3)), 4 / 3 * np.pi * 6e-3),
    "mirrored ellipsoid": ("Sphere", "double radius = 10\n" + scaled((-1, 2, 3)), 4 / 3 * np.pi * 6e-3),
    "cylinder": ("Cylinder", 'double radius = 10\ndouble height = 20\nuniform token axis = "X"', np.pi * 2e-3),
    "cone": ("Cone", 'double radius = 10\ndouble height = 30\nuniform token axis = "Y"', np.pi * 1e-3),
    "mesh": ("Mesh", TETRAHEDRON, 1e-3 / 6),
    "corners on a line": (
        "Mesh",
        ON_A_LINE.replace("2, 1, 2, 3", "2, 1, 4, 2, 3").replace("10)]", "10), (5, 5, 0)]"),
        1e-3 / 6,
    ),
    "corners at one position": ("Mesh", AT_ONE_POSITION.replace("10)]", "10), (0, 10, 0)]"), 1e-3 / 6),
    "left-handed": ("Mesh", 'uniform token orientation = "leftHanded"\n' + INWARD, 1e-3 / 6),
    "mirrored mesh": ("Mesh", scaled((2, -3, 1)) + TETRAHEDRON, 1e-3),
}


@pytest.mark.parametrize(("kind", "size", "volume"), SOLIDS.values(), ids=SOLIDS)
def test_other_solids_are_meshes_with_their_fronts_outside(path, kind, size, volume):
    """The volume by the divergence theorem, which is negative if the front is inside; 1 % for the facets."""
    mesh = collider_of(path, shape(kind, size))
    assert isinstance(mesh, wc.MeshCollider) and mesh.closed
    corners = turned(mesh, 0, mesh.points)[mesh.triangles]
    found = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert found == pytest.approx(volume, rel=1e-2)


@pytest.mark.parametrize("kind", ["Sphere", "Mesh", "Plane"])
def test_colliders_follow_the_transforms_above_them(path, kind):
    """10 cm along x and 20° about z a frame, also of a shape that is turned below them."""
    text = {"Sphere": "double radius = 10", "Mesh": TETRAHEDRON, "Plane": 'uniform token axis = "Z"'}[kind]
    below = ops(translate=(0, -20, 0), rotateX=-90)
    found = collider_of(path, f'def Xform "Parent"\n{{\n{MOVING}\n{shape(kind, below + text)}}}\n')
    assert found.moves and found.poses.shape == (5, 7)
    for frame in range(5):
        angle = np.radians(20.0 * frame)
        at_frame = np.array([0.1 * frame + 0.2 * np.sin(angle), -0.2 * np.cos(angle), 0.0])
        np.testing.assert_allclose(found.poses[frame, :3], at_frame, atol=1e-7)
        if kind == "Plane":  # up is z, which is turned to y
            normal = np.array([-np.sin(angle), np.cos(angle), 0.0])
            np.testing.assert_allclose(found.distances(at_frame + 0.3 * normal, frame), 0.3)
        if kind == "Mesh":
            along = 0.1 * np.array([np.cos(angle), np.sin(angle), 0.0])
            np.testing.assert_allclose(turned(found, frame, found.points[[1]]), [at_frame + along], atol=1e-7)
    if kind == "Mesh":
        assert found.points.shape == (4, 3)  # a body, which is not stored at each frame
    # Motion is read until a frame after the last, so that steps up to the last frame are computed as with all of it.
    text = ops(translate={101: (0, 0, 0), 111: (100, 0, 0)})
    np.testing.assert_allclose(collider_of(path, shape("Sphere", text)).poses[:, 0], 0.1 * np.arange(6))


RISING = TETRAHEDRON.replace("points =", "points.timeSamples = {101:").rstrip()
DEFORMING = {
    "scale": ("Cube", "double size = 20\n" + scaled({101: (1, 1, 1), 105: (1, 1, 3)})),
    "size": ("Cube", "double size.timeSamples = {101: 20, 105: 60}"),
    "points": ("Mesh", RISING + ", 105: [(0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 30)]}"),
}


@pytest.mark.parametrize("case", DEFORMING)
def test_shapes_that_change_are_meshes_that_deform(path, case):
    found = collider_of(path, shape(*DEFORMING[case]))
    assert isinstance(found, wc.MeshCollider) and len(found.frames) == 5 and found.closed
    tops = [turned(found, min(frame, len(found.poses) - 1), found.frames[frame])[:, 2].max() for frame in range(5)]
    np.testing.assert_allclose(tops, 0.1 + 0.05 * np.arange(5), atol=1e-7)


@pytest.mark.parametrize("scale", ((1, 1, 1), (-1, 1, 1)))
def test_a_scale_of_0_hides_a_shape(path, scale):
    """It is a point then, at its position; at other frames its fronts look outwards."""
    samples = {101: (0, 0, 0), 102: (0, 0, 0), 103: scale, 104: scale, 105: (0, 0, 0)}
    found = collider_of(path, shape("Cube", ops(translate=(0, 0, 100), scale=samples)))
    sizes = [0.0, 0.0, 0.02, 0.02, 0.0]
    assert found.closed
    np.testing.assert_allclose(np.ptp(found.frames, axis=1), np.outer(sizes, np.ones(3)), atol=1e-9)
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.03]])
    for frame, size in enumerate(sizes):
        np.testing.assert_allclose(found.distances(points, frame), [-size / 2, 0.03 - size / 2], atol=1e-7)


APPROXIMATED = dict.fromkeys(("none", "convexHull"), wc.MeshCollider) | {"boundingCube": wc.Box, "boundingSphere": wc.Sphere}
APPROXIMATED |= dict.fromkeys(("convexDecomposition", "meshSimplification", "sdf"))  # which are said to be taken as none


@pytest.mark.parametrize("by", ["physics", "own"])
@pytest.mark.parametrize(("approximation", "kind"), APPROXIMATED.items(), ids=APPROXIMATED)
def test_approximations_of_a_mesh(path, approximation, kind, by, recwarn):
    own = f'string warpcloth:collider = "{approximation}"'
    api = f'uniform token physics:approximation = "{approximation}"'
    text, meta = (own, "") if by == "own" else (api, COLLIDES.replace('API"', 'API", "PhysicsMeshCollisionAPI"'))
    found = collider_of(path, shape("Mesh", text + "\n" + at(100, 0, 0) + TETRAHEDRON, meta=meta))
    assert isinstance(found, kind or wc.MeshCollider)
    words = f"{path}, prim /Thing: its approximation {approximation} is taken as none"
    assert [str(each.message).startswith(words) for each in recwarn] == [True] * (kind is None)
    distances = found.distances(np.array([[1.0, 0, 0], [1.1, 0, 0], [1, 0.1, 0], [1, 0, 0.1]]))
    np.testing.assert_allclose(distances, 0.0, atol=1e-7)  # the corners are on each of them


def test_meshes_that_face_inwards_or_are_flat(path):
    """All but its inside is solid then: a cloth in a closed room. A mesh that is a collider is not the cloth."""
    room = ops(translate=(-500, -500, -500), scale=(500, 500, 500)) + INWARD
    with pytest.warns(UserWarning, match="prim /Thing: its triangles face inwards, so that what they enclose is free"):
        assert collider_of(path, shape("Mesh", room)).closed
    flat = TETRAHEDRON.replace("(0, 0, 10)", "(10, 10, 0)")
    ball = collider_of(path, shape("Mesh", 'token warpcloth:collider = "boundingSphere"' + flat))
    np.testing.assert_allclose([ball.radius, *ball.position], [0.1 * np.sqrt(0.5), 0.05, 0.05, 0], atol=1e-6)
    assert read_stage_mesh(path).prim == "/Cloth"


@pytest.mark.parametrize(
    ("sliding", "static", "own", "friction", "said"),
    [
        (None, None, None, 0.0, 0),
        (0.25, None, None, 0.25, 0),
        (None, 0.5, None, 0.5, 0),
        (0.25, 0.5, None, 0.25, 1),
        (0.5, 0.5, None, 0.5, 0),
        (0, 0.5, None, 0.0, 1),
        (0.25, 0.5, 0.3, 0.3, 0),
    ],
)
def test_friction(path, sliding, static, own, friction, said, recwarn):
    """That of sliding, because a collider has one coefficient; ours first."""
    names = {"float physics:dynamicFriction": sliding, "float physics:staticFriction": static}
    text = "\n".join(f"{name} = {value}" for name, value in names.items() if value is not None)
    material = f'def Material "Rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"])\n{{\n{text}\n}}\n'
    text = "rel material:binding:physics = </Rubber>" + (f"\ndouble warpcloth:friction = {own}" if own else "")
    meta = COLLIDES.replace('API"', 'API", "MaterialBindingAPI"')
    assert collider_of(path, material, shape("Sphere", text, meta=meta)).friction == friction
    assert ["its static friction 0.5 is not read" in str(each.message) for each in recwarn] == [True] * said


@pytest.mark.parametrize(("name", "value", "said"), [("kinematic", 1, 0), ("kinematic", 0, 1), ("rigidBody", 0, 0)])
def test_a_rigid_body_that_forces_would_move_is_said(path, name, value, said, recwarn):
    text = f"bool physics:{name}Enabled = {value}\n{MOVING}\n{shape('Sphere')}"
    assert collider_of(path, f'def Xform "Body" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])\n{{\n{text}}}\n').moves
    assert ["prim /Body/Thing: is a rigid body that is not kinematic" in str(each.message) for each in recwarn] == [True] * said


MARKED, BALL = "bool warpcloth:collider = {}", shape("Sphere", meta="")


def marked(*texts):
    """An object that is marked, with what is below it."""
    return shape("Xform", MARKED.format(1) + "\n" + "".join(texts), "Object", "")


INSTANCE = "(instanceable = true\nprepend references = </Proto>)"
CHOSEN = {
    "a shape": (shape("Sphere"), 1),
    "without the mark": (BALL, 0),
    "turned off": (shape("Sphere", "bool physics:collisionEnabled = 0"), 0),
    "a mesh that is turned off": (
        shape("Mesh", MARKED.format(0) + "\ndouble warpcloth:friction = 1" + TETRAHEDRON, meta=""),
        0,
    ),
    "our mark": (shape("Sphere", MARKED.format(1), meta=""), 1),
    "our mark first": (shape("Sphere", MARKED.format(0)), 0),
    "the mark of an object": (marked(BALL), 1),
    "a sample, as of a moving object": (marked(BALL).replace(" = 1", ".timeSamples = {1: 1}"), 1),
    "a shape that is not its object": (marked(shape("Sphere", MARKED.format(0), meta=""), shape("Cube", "", "Other", "")), 1),
    "no child of it": (marked(BALL, shape("Xform", shape("Cube", meta=""), "Child", "")), 1),
    "invisible": (shape("Sphere", 'token visibility = "invisible"\nuniform token purpose = "guide"'), 1),
    "inactive": (shape("Sphere", meta=COLLIDES.replace("(", "(active = false\n")), 0),
    "over": (shape("Sphere").replace("def", "over"), 0),
    "class": (shape("Sphere").replace("def", "class"), 0),
    "instance": (
        shape("Xform", shape("Sphere"), "Proto", "").replace("def", "class", 1)
        + shape("", name="One", meta=INSTANCE)
        + shape("", name="Two", meta=INSTANCE),
        2,
    ),
}


@pytest.mark.parametrize(("text", "count"), CHOSEN.values(), ids=CHOSEN)
def test_which_prims_are_colliders(path, text, count):
    assert len(scene_with(path, text).colliders) == count


REFUSED = [  # kind and text of the shape, message about it
    ("Points", "point3f[] points = [(0, 0, 0)]", "is Points, must be a Mesh or one of Cube, Sphere"),
    ("Xform", "", "is Xform without a shape right below it, must be a shape to be a collider"),
    ("Scope", shape("Sphere", name="Ball", meta=""), "is Scope without a shape right below it, must be"),
    ("Sphere", scaled((1, 0, 1)), "the transform to world space is .*invertible"),
    (
        "Sphere",
        scaled({101: (1, 1, 1), 103: (0, 0, 1)}),
        "time code 103: the transform to world space is .*, must be invertible",
    ),
    (
        "Sphere",
        scaled({101: (0, 0, 0), 105: (0, 0, 0)}),
        "is scaled to 0 at all frames, must be larger at some or be turned off with warpcloth:collider",
    ),
    ("Sphere", "double radius = 0", "radius is 0.0, must be above 0"),
    ("Plane", scaled({101: (1, 1, 1), 105: (2, 1, 1)}), "is a Plane whose scale changes over time, must keep it"),
    ("Mesh", "", "has no points"),
    ("Mesh", "point3f[] points = [(0, 0, 0)]", "has no faces"),
    ("Mesh", TETRAHEDRON.replace("10", "0"), "has no triangle with an area, must have one to be a collider"),
    (
        "Mesh",
        'token warpcloth:collider = "convexHull"' + TETRAHEDRON.replace("(0, 0, 10)", "(10, 10, 0)"),
        "its points are in a plane, must have a volume for a convexHull",
    ),
    (
        "Mesh",
        TETRAHEDRON + "point3f[] points.timeSamples = {101: [(0, 0, 0)], 102: [(0, 0, 0), (1, 1, 1)]}",
        "points has 2 points at time code 102, must keep 1",
    ),
    (
        "Mesh",
        'token warpcloth:collider = "round"' + TETRAHEDRON,
        "warpcloth:collider is 'round', must be true, false or one of none, boundingCube, boundingSph",
    ),
    ("Sphere", 'string warpcloth:collider = "false"', "warpcloth:collider is 'false', must be true, false or"),
    ("Sphere", "double3 warpcloth:collider = (1, 0, 0)", "warpcloth:collider has type double3, must be bool or token"),
    (
        "Sphere",
        "bool physics:collisionEnabled.timeSamples = {101: 0, 103: 1}",
        "physics:collisionEnabled changes over time, must have one value",
    ),
    (
        "Sphere",
        "double warpcloth:fricton = 1",
        "warpcloth:fricton is no attribute of a collider, must be one of warpcloth:collider, .*warpcloth:friction",
    ),
    ("Sphere", "double warpcloth:friction = -1", "/Thing.friction is -1.0; it must be"),
]
INSIDE = shape("Sphere", "double radius = 90\n" + at(0, 0, 200))
REFUSED_TEXTS = [(shape(kind, text), f"prim /Thing: {message}") for kind, text, message in REFUSED]
GONE = COLLIDES.replace(")", "\nprepend payload = @./gone.usda@)")
REFUSED_TEXTS += [
    (shape("PointInstancer", shape("Sphere"), "Many", ""), "prim /Many: has a collider as a prototype, which must be"),
    (INSIDE, "prim /Cloth: vertex 0 starts 0.9 m inside the collider /Thing"),
    (shape("Sphere", meta=GONE), "prim /Thing: .*gone.usda.* must be there"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED_TEXTS, ids=[message[:60] for _, message in REFUSED_TEXTS])
def test_what_cannot_be_a_collider_is_refused_with_its_path(path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        scene_with(path, text)
    assert str(caught.value).count(str(path)) == 1 + ("payload" in text) and "\n" not in str(caught.value)


def test_a_scene_with_colliders_runs_from_its_stage_to_the_same_bits(device, tmp_path):
    colliders = [
        wc.Sphere(radius=0.31, position=[(0.5, -0.35, 0.5), (0.5, -0.33, 0.5)], friction=0.3),
        wc.Plane(normal=(0.1, 1.0, 0.0), position=(0, -0.07, 0)),
    ]
    scene = wc.Scene(wc.Mesh.grid(5, 5), density=0.15, terms=[wc.Spring(stiffness=100.0)], colliders=colliders, duration=1 / 10)
    read = read_scene(write_scene(scene, tmp_path / "scene.usda"))
    one = wc.simulate(scene, wc.Explicit(substeps=64), output=tmp_path / "one.usdc", device=device)
    other = wc.simulate(read, wc.Explicit(substeps=64), output=tmp_path / "other.usdc", device=device)
    np.testing.assert_array_equal(one.points, other.points)
    assert one.points[-1, :, 1].min() < -0.02
    assert validate(tmp_path / "one.usdc") == [] and validate(tmp_path / "other.usdc", read.stage.path) == []


# A bone that rises by 10 cm a frame, and a tetrahedron that is bound to it as a body or point by point.
RIG = """
def SkelRoot "Rig" META
{
    def Skeleton "Bones" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        uniform token[] joints = ["bone"]
        uniform matrix4d[] bindTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
        uniform matrix4d[] restTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
        rel skel:animationSource = </Rig/Bones/Walk>
        def SkelAnimation "Walk"
        {
            uniform token[] joints = ["bone"]
            quatf[] rotations = [(1, 0, 0, 0)]
            half3[] scales = [(1, 1, 1)]
            float3[] translations.timeSamples = {101: [(0, 0, 0)], 105: [(0, 0, 40)]}
        }
    }
    def Mesh "Body" (prepend apiSchemas = ["PhysicsCollisionAPI", "SkelBindingAPI"])
    {
        rel skel:skeleton = </Rig/Bones>
        int[] primvars:skel:jointIndices = INDICES (elementSize = 1
        interpolation = "KIND")
        float[] primvars:skel:jointWeights = WEIGHTS (elementSize = 1
        interpolation = "KIND")
        TETRAHEDRON
    }
}
"""


@pytest.mark.parametrize("instanced", [False, True])
@pytest.mark.parametrize(("kind", "count"), [("constant", 1), ("vertex", 4)])
def test_skinned_characters_are_posed_in_memory(path, kind, count, instanced):
    text = RIG.replace("TETRAHEDRON", TETRAHEDRON).replace("KIND", kind).replace("META", "")
    text = text.replace("INDICES", str([0] * count)).replace("WEIGHTS", str([1] * count))
    if instanced:
        text = text.replace("def SkelRoot", "class SkelRoot")
        text += '\ndef "One" (instanceable = true\nprepend references = </Rig>)\n{\n}\n'
    body = collider_of(path, text)
    before = path.read_text()
    assert before == STAGE + text and body.name == ("/One/Body" if instanced else "/Rig/Body")
    for frame in range(5):
        points = turned(body, min(frame, len(body.poses) - 1), body.frames[min(frame, len(body.frames) - 1)])
        np.testing.assert_allclose(points.min(axis=0), [0, 0, 0.1 * frame], atol=1e-7)
    shown = read_drawn(str(path))
    drawn = next(each for each in shown.prims if each.path == body.name)
    np.testing.assert_allclose(drawn.points(105).min(axis=0), [0, 0, 0.4], atol=1e-7)


def test_a_cloth_of_a_skinned_character_has_pins_that_follow_it(path):
    """And is not skinned again by viewers of the result."""
    text = (
        RIG.replace("INDICES", "[0, 0, 0, 0]").replace("WEIGHTS", "[1, 1, 1, 1]").replace("KIND", "vertex").replace("META", "")
    )
    cloth = STAGE[STAGE.index("    int[] faceVertexCounts") : STAGE.rindex("}")]
    text = text.replace("TETRAHEDRON", cloth + "int[] warpcloth:pins = [0, 1]").replace('"PhysicsCollisionAPI", ', "")
    text = text.replace("rel skel:skeleton", 'uniform token[] skel:blendShapes = ["big"]\nrel skel:skeleton')
    path.write_text(STAGE[: STAGE.index("def Mesh")] + text)
    scene = read_scene(path)
    np.testing.assert_allclose(scene.pins.keyframes[:, 0, 2], 2 + 0.1 * np.arange(5), atol=1e-6)
    result = path.parent / "out.usdc"
    wc.simulate(scene, wc.Explicit(substeps=16), output=result, frames=2)
    stage = Usd.Stage.Open(str(result))
    for name in ("primvars:skel:jointIndices", "primvars:skel:jointWeights", "skel:blendShapes"):
        assert not stage.GetPrimAtPath("/Rig/Body").GetAttribute(name).HasValue()


def test_an_animation_has_colliders_as_primitives(tmp_path):
    """With their sizes, and where they are at each frame."""
    ball = trimesh.creation.icosphere(2, radius=0.1)
    breathing = [ball.vertices * (1.0 + 0.3 * np.sin(180.0 * ball.vertices[:, :1] + k)) for k in range(9)]
    colliders = [
        wc.Sphere(radius=0.1, position=[(0.25, -0.3, 0.1 * k) for k in range(3)], name="ball"),
        wc.Capsule(radius=0.05, length=0.2, axis=(1.0, 0.0, 0.0), position=(0.0, -1.0, 0.0)),
        wc.Box(size=(0.1, 0.2, 0.3), position=(0.0, -2.0, 0.0), rotation=TILTED),
        wc.Plane(position=(0.0, -3.0, 0.0), name="ball"),
        wc.MeshCollider(breathing, ball.faces, position=(0.0, -4.0, 0.0), name="breathing"),
    ]
    path = str(tmp_path / "a.usda")
    wc.simulate(falling(colliders, n=3, fps=60.0, duration=0.1), wc.Newton(substeps=4), output=path, frames=2)
    stage = Usd.Stage.Open(path)
    prims = {prim.GetName(): prim for prim in stage.GetPrimAtPath("/World/Colliders").GetChildren()}
    kinds = {name: prim.GetTypeName() for name, prim in prims.items()}
    assert kinds == {"ball": "Sphere", "Capsule": "Capsule", "Box": "Cube", "ball_2": "Plane", "breathing": "Mesh"}
    points = UsdGeom.Mesh(prims["breathing"]).GetPointsAttr()
    np.testing.assert_allclose([points.Get(frame) for frame in range(9)], breathing, atol=1e-7)
    for (name, prim), collider in zip(list(prims.items())[:4], colliders[:4], strict=True):
        half, radius = collider.core
        high = 0.5 if name == "Box" else half[1] + radius if np.isfinite(half[1]) else 0.0
        for frame in (0, 1, 2):
            to_world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(frame))
            surface = [0.0, high, 0.0, 1.0] @ to_world
            assert collider.distances(surface[:3], frame) == pytest.approx(0.0, abs=1e-6)
