"""One stage in Newton, the physics engine, and here: its importer builds the arrays of the scene, and its stages are scenes."""

import warnings

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from warpcloth.others.newton_model import newton_model
from warpcloth.usd import read_scene, write_scene

newton = pytest.importorskip("newton", reason="Newton is not installed: pip install -e '.[newton]'")
pytest.importorskip("newton_usd_schemas", reason="the importer of Newton needs it: pip install newton-usd-schemas")

EPS = float(np.finfo(np.float32).eps)
# On an equilateral mesh |e|/(A₁ + A₂) is the same at each hinge, so that one stiffness of bending is that of the scene.
MESH = wc.Mesh.grid(5, 4, pattern="equilateral")
COLLIDERS = [
    wc.Sphere(radius=0.5, position=(0.0, -3.0, 0.0), friction=0.25),
    wc.Box(size=(1.0, 2.0, 3.0), position=(0.0, -3.0, 4.0), rotation=(0.0, 0.6, 0.0, 0.8), friction=0.25),
    wc.Plane(position=(0.0, -5.0, 0.0), friction=0.25),
]
ARRAYS = ["particle_q", "particle_mass", "particle_radius", "tri_indices", "tri_poses", "tri_areas", "tri_materials", "gravity"]


def imported(path):
    """The model that its importer makes of a stage, without damping, which no attribute has, and with contact of the scene."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.default_tri_kd = builder.default_edge_kd = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        builder.add_usd(str(path))
    builder.color(include_bending=True)
    with wp.ScopedDevice("cpu"):
        return builder.finalize()


def hinges(model):
    """Stiffness and rest angle of each hinge by its two ends, without the edges of one triangle, which do not bend."""
    rows = zip(model.edge_indices.numpy(), model.edge_bending_properties.numpy(), model.edge_rest_angle.numpy(), strict=True)
    return {tuple(sorted(edge[2:])): (*properties, angle) for edge, properties, angle in rows if edge[:2].min() >= 0}


def assert_same(found, expected):
    for name in ARRAYS:
        a, b = (getattr(model, name).numpy() for model in (found, expected))
        np.testing.assert_allclose(a, b, rtol=8 * EPS, atol=8 * EPS * max(1e-30, np.abs(b).max()), err_msg=name)
    found, expected = hinges(found), hinges(expected)
    assert set(found) == set(expected) and len(found) == len(MESH.hinges)
    np.testing.assert_allclose([found[each] for each in expected], list(expected.values()), rtol=8 * EPS, atol=8 * EPS)


def test_the_importer_builds_the_arrays_of_the_scene(tmp_path):
    terms = [wc.NeoHookeanMembrane(stiffness=200.0), wc.QuadraticBending(stiffness=1e-4)]
    scene = wc.Scene(MESH, density=0.15, terms=terms, pins=[0, 4], colliders=COLLIDERS)
    model, expected = imported(write_scene(scene, tmp_path / "both.usda", law="newton")), newton_model(scene, "vbd")
    assert_same(model, expected)
    assert model.attachment_particle_body_particle.numpy().tolist() == [0, 4]
    assert np.isinf(model.attachment_particle_body_stiffness.numpy()).all()
    anchors = model.attachment_particle_body_body_point.numpy()
    np.testing.assert_array_equal(anchors, MESH.points[[0, 4]].astype(np.float32))
    order = [[label.rpartition("/")[2] for label in model.shape_label].index(each.label) for each in COLLIDERS]
    for name in ("shape_type", "shape_transform", "shape_scale", "shape_material_mu"):
        a, b = getattr(model, name).numpy()[order], getattr(expected, name).numpy()
        np.testing.assert_allclose(a, b, atol=4 * EPS, err_msg=name)


BY_HAND = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{{
    def Mesh "Cloth" (prepend apiSchemas = ["PhysicsDeformableBodyAPI", "PhysicsSurfaceDeformableSimAPI", "PhysicsCollisionAPI",
        "MaterialBindingAPI"])
    {{
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = {indices}
        point3f[] points = {points}
        float[] physics:thicknesses = [0.004]
        token physics:thicknesses:elementType = "constant"
        token physics:restBendAnglesDefault = "{angles}"
        rel material:binding:physics = </World/Linen>
    }}
    def Material "Linen" (prepend apiSchemas = ["PhysicsSurfaceDeformableMaterialAPI"])
    {{
        float physics:density = 50
        {material}
    }}
    def Xform "Hand" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
    {{
        bool physics:kinematicEnabled = 1
        def PhysicsAttachment "grip"
        {{
            rel physics:src0 = </World/Cloth>
            rel physics:src1 = </World/Hand>
            token physics:type0 = "point"
            token physics:type1 = "xform"
            int[] physics:indices0 = [0]
            point3f[] physics:coords1 = [(0, 0, 0)]
        }}
    }}
    def PhysicsScene "Physics" {{}}
    def Sphere "Ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {{
        double radius = 0.5
        double3 xformOp:translate = (0, -3, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""


@pytest.mark.parametrize(
    "material",
    [
        "float physics:surfaceStretchStiffness = 300\n        float physics:surfaceBendStiffness = 1e-3",
        "float physics:youngsModulus = 1e5\n        float physics:poissonsRatio = 0.25",
    ],
    ids=["stiffness", "moduli"],
)
@pytest.mark.parametrize("angles", ["flat", "restShape"])
def test_a_stage_for_newton_is_the_same_cloth_here(tmp_path, material, angles):
    """By the law of its importer, of a mesh that is not flat and whose hinges differ."""
    path = tmp_path / "by_hand.usda"
    mesh = wc.Mesh.grid(4, 4, pattern="alternating")
    points = mesh.points + np.outer(np.sin(3.0 * mesh.points[:, 0]) * 0.1, [0.0, 1.0, 0.0])
    texts = {"counts": [3] * len(mesh.triangles), "indices": mesh.triangles.ravel().tolist()}
    texts |= {"points": "[" + ", ".join(str(tuple(each)) for each in points.astype(np.float32).tolist()) + "]"}
    path.write_text(BY_HAND.format(material=material, angles=angles, **texts))
    model, scene = imported(path), read_scene(path, law="newton")
    assert scene.pins.vertices.tolist() == [0] == model.attachment_particle_body_particle.numpy().tolist()
    expected = newton_model(scene, "vbd")
    for name in ARRAYS:
        a, b = (getattr(each, name).numpy() for each in (expected, model))
        np.testing.assert_allclose(a, b, rtol=8 * EPS, atol=8 * EPS * np.abs(b).max(), err_msg=name)
    a, b = hinges(expected), hinges(model)
    assert set(a) == set(b)
    np.testing.assert_allclose([a[each] for each in b], list(b.values()), rtol=8 * EPS, atol=32 * EPS)
