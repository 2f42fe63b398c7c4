"""Names of the AOUSD proposal and of Newton, the physics engine: their laws, attachments, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

import warpcloth as wc
from support.usd_validation import validate
from warpcloth.usd import read_scene, write_scene

EPS = float(np.finfo(np.float32).eps)
MESH = wc.Mesh.grid(4, 3, size=(0.6, 0.4), pattern="alternating")
MEMBRANE = wc.NeoHookeanMembrane(stiffness=200.0)
BENDING = wc.QuadraticBending(stiffness=1e-4)


def declared(**fields):
    given = {"density": 0.15, "terms": [MEMBRANE, BENDING], "pins": [0, 3], "thickness": 2e-3, "duration": 0.1}
    return wc.Scene(MESH, **(given | fields))


def alone(path):
    """Removes everything in the namespace warpcloth from a stage."""
    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        for each in prim.GetAuthoredPropertiesInNamespace("warpcloth"):
            prim.RemoveProperty(each.GetName())
        if prim.GetTypeName() == "GeomSubset":
            prim.SetActive(False)
    stage.Save()
    return path


def edited(path, prim, names):
    """Sets attributes of a prim, (type, value) by name."""
    stage = Usd.Stage.Open(str(path))
    for name, (type_name, value) in names.items():
        stage.GetPrimAtPath(prim).CreateAttribute(name, getattr(Sdf.ValueTypeNames, type_name)).Set(value)
    stage.Save()
    return path


@pytest.mark.parametrize("law", ["proposal", "newton"])
def test_a_scene_is_the_same_with_the_names_and_close_by_the_names_alone(tmp_path, law):
    soft = wc.Attachment(vertices=[11], stiffness=5.0, targets=MESH.points[[11]] + [0.0, 0.25, 0.0], damping=0.5)
    floor = wc.Plane(position=(0.0, -1.0, 0.0), friction=0.25)
    terms = [MEMBRANE, BENDING, soft]
    scene = declared(terms=terms, gravity=(0.5, -2.0, 1.0), colliders=[floor])
    path = write_scene(scene, tmp_path / "both.usda", law=law)
    assert validate(path) == []
    both = read_scene(path)
    assert [(type(each), each.stiffness, each.name) for each in both.terms] == [(type(t), t.stiffness, t.name) for t in terms]
    assert both.density == scene.density and both.thickness == scene.thickness and both.pins.vertices.tolist() == [0, 3]
    stage = Usd.Stage.Open(path)
    assert stage.GetPrimAtPath("/World/Cloth").HasAPI("PhysicsCollisionAPI")
    # Of two cloths, one that is read alone does not touch the other.
    Sdf.CopySpec(stage.GetRootLayer(), "/World/Cloth", stage.GetRootLayer(), "/World/Other")
    stage.Export(str(tmp_path / "two.usda"))
    stage.RemovePrim("/World/Other")
    assert len(read_scene(tmp_path / "two.usda", prim="Cloth").colliders) == 1
    found = read_scene(alone(path), law=law)
    np.testing.assert_allclose(found.vertex_masses, scene.vertex_masses, rtol=8 * EPS)
    np.testing.assert_allclose(found.gravity, scene.gravity, rtol=4 * EPS)
    assert found.pins.vertices.tolist() == [0, 3] and found.pins.keyframes is None and len(found.colliders) == 1
    assert found.contact.distance == pytest.approx(scene.contact.distance, rel=4 * EPS)
    membrane, bending, attachment = found.terms
    assert type(membrane) is wc.NeoHookeanMembrane and type(bending) is wc.QuadraticBending
    assert (membrane.stiffness, membrane.poisson_ratio) == pytest.approx((200.0, 0.0), rel=4 * EPS, abs=4 * EPS)
    assert (attachment.stiffness, attachment.damping) == (5.0, 0.5)
    np.testing.assert_allclose(attachment.targets, MESH.points[[11]] + [0.0, 0.25, 0.0], rtol=EPS)
    if law == "proposal":
        assert bending.stiffness == pytest.approx(1e-4, rel=4 * EPS)
    else:  # another stiffness for each hinge, of the same energy if all have the same curvature, θ ~ (A₁ + A₂)/|e|
        lengths = np.linalg.norm(MESH.points[MESH.hinges[:, 0]] - MESH.points[MESH.hinges[:, 1]], axis=1)
        areas = 2.0 * MESH.triangle_areas[0]
        energies = (lengths * areas / lengths) ** 2 / areas  # |e|²θ²/(A₁ + A₂), per stiffness
        assert float(energies @ bending.stiffness) == pytest.approx(1e-4 * energies.sum(), rel=1e-6)
        np.testing.assert_allclose(bending.stiffness * lengths, bending.stiffness[0] * lengths[0], rtol=4 * EPS)


def physics(**values):
    return {f"physics:{name}": ("Float", value) for name, value in values.items()}


# In cm and g: E = 1000 g/(cm·s²) = 100 Pa, t = 1 cm, so that Et = 1 N/m.
SOLID = {"youngsModulus": 1000.0, "surfaceThickness": 1.0}
SHORT = {"stretch": "surfaceStretchStiffness", "shear": "surfaceShearStiffness", "ratio": "poissonsRatio"}
SHORT |= {"bend": "surfaceBendStiffness"}


@pytest.mark.parametrize(
    ("names", "law", "expected"),
    [
        (SOLID, "proposal", [(1.0, 0.3, None), 1e-4 / 12 / 0.91]),
        (SOLID | {"ratio": 0.0}, "proposal", [(1.0, 0.0, None), 1e-4 / 12]),
        (SOLID | {"ratio": 0.0}, "newton", [(2.0, 0.0, None), None]),
        # K = 1 N/m and G = 0.375 N/m: ν = 1 − 2G/K = 0.25; with another ν, warp and weft and a shear of their own.
        ({"stretch": 1000.0, "shear": 375.0}, "proposal", [(0.9375, 0.25, None)]),
        ({"stretch": 1000.0, "shear": 375.0, "ratio": 0.25}, "proposal", [(0.9375, 0.25, None)]),
        ({"stretch": 1000.0, "shear": 375.0, "ratio": 0.0}, "proposal", [(1.0, 0.0, 0.375)]),
        ({"stretch": 1000.0, "shear": 1500.0}, "proposal", [(0.91, 0.3, 1.5 / 0.91)]),
        ({"stretch": 1000.0, "bend": -np.inf}, "proposal", [(0.91, 0.3, None)]),
        ({"stretch": 1000.0}, "newton", [(2.0, 0.0, None)]),
    ],
)
def test_moduli_of_a_material_become_terms(tmp_path, names, law, expected):
    path = alone(write_scene(declared(), tmp_path / "names.usda", law="proposal"))
    stage = Usd.Stage.Open(path)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.GetPseudoRoot().SetMetadata("kilogramsPerUnit", 0.001)
    material = stage.GetPrimAtPath("/World/Looks/ClothPhysics")
    for name in (*SHORT.values(), "density"):
        material.RemoveProperty(f"physics:{name}")
    stage.GetPrimAtPath("/World/Cloth").RemoveProperty("physics:thicknesses")
    stage.Save()
    given = physics(density=1.0, **{SHORT.get(name, name): value for name, value in names.items()})
    found = read_scene(edited(path, "/World/Looks/ClothPhysics", given), law=law).terms
    assert len(found) == len(expected)
    membrane, (stiffness, ratio, shear) = found[0], expected[0]
    assert (membrane.stiffness, membrane.poisson_ratio) == pytest.approx((stiffness, ratio), rel=4 * EPS, abs=4 * EPS)
    assert getattr(membrane, "shear_ratio", None) == (shear and pytest.approx(shear))
    if len(expected) > 1 and expected[1] is not None:
        assert found[1].stiffness == pytest.approx(expected[1], rel=4 * EPS)


def test_attachments_to_a_prim_that_moves_are_keyframes(tmp_path):
    path = alone(write_scene(declared(), tmp_path / "moved.usda", law="proposal"))
    stage = Usd.Stage.Open(path)
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Pins")).AddTranslateOp()
    for code, z in ((0, 0.0), (2, 0.5)):
        move.Set((0.0, 0.0, z), code)
    stage.Save()
    scene = read_scene(path)
    moved = scene.pins.keyframes - scene.positions[[0, 3]]
    np.testing.assert_allclose(moved, np.array([0.0, 0.25, 0.5])[:, None, None] * [0.0, 0.0, 1.0] * np.ones((1, 2, 1)))
    edited(path, "/World/Pins/hard", {"physics:attachmentEnabled": ("Bool", False)})
    assert len(read_scene(path).pins.vertices) == 0
    path = alone(write_scene(declared(), tmp_path / "off.usda", law="newton"))  # gravity may be switched off as in Newton
    assert not read_scene(edited(path, "/World/Physics", {"newton:gravityEnabled": ("Bool", False)})).gravity.any()


@pytest.mark.parametrize(
    ("prim", "name", "type_name", "value", "words"),
    [
        ("Pins/hard", "physics:type0", "Token", "face", r"the kind of points is 'face', must be 'point'"),
        ("Pins/hard", "physics:coords1", "Point3fArray", [(0, 0, 0)], "coords1 has 1 anchors, must have one for each of 2"),
        ("Pins/hard", "physics:coords1", "Point3fArray", [(0, 0, 0)] * 2, r"an anchor 0\.6 m away from its point"),
        ("Pins/hard", "physics:indices0", "IntArray", [0, 12], r"indices0\[1\] = 12, must be a point, 0 to 11"),
        ("Cloth", "physics:thicknesses", "FloatArray", [1.0, 2.0], "must be one thickness of the whole cloth"),
        ("Cloth", "physics:restBendAngles", "FloatArray", [1.0], "restBendAngles is given, must not be"),
        ("Cloth", "physics:masses", "FloatArray", [1.0], "physics:masses has 1 values, must have 12"),
        ("Looks/ClothPhysics", "physics:surfaceStretchStiffness", "Float", 0.0, "surfaceShearStiffness is given without"),
        ("Cloth", "newton:massModel", "Token", "foo", "newton:massModel is 'foo', must be one of shell, solid"),
        ("Cloth", "physics:restBendAnglesDefault", "Token", "bent", "restBendAnglesDefault is 'bent', must be one of flat"),
        ("Looks/ClothPhysics", "physics:poissonsRatio", "Float", 1.0, "must be above -1 and below 1"),
    ],
)
def test_stages_that_cannot_be_a_scene_are_refused(tmp_path, prim, name, type_name, value, words):
    path = alone(write_scene(declared(), tmp_path / "wrong.usda", law="proposal"))
    kind = {"physics:masses:elementType": ("Token", "point")} if name == "physics:masses" else {}
    with pytest.raises(ValueError, match=words):
        read_scene(edited(path, f"/World/{prim}", {name: (type_name, value)} | kind))


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ({"surfaceStretchStiffness": 0.0, "surfaceShearStiffness": 0.0}, "so the cloth resists bending only"),
        ({"youngsModulus": 1e6}, "StretchStiffness is 200 N/m and is used, but physics:youngsModulus gives 2000 N/m"),
    ],
)
def test_a_doubtful_material_is_read_with_a_warning(tmp_path, names, words):
    path = alone(write_scene(declared(), tmp_path / "doubtful.usda", law="proposal"))
    with pytest.warns(UserWarning, match=f"doubtful.usda, prim /World/Cloth: .*{words}"):
        read_scene(edited(path, "/World/Looks/ClothPhysics", physics(**names)))


@pytest.mark.parametrize(
    ("law", "fields", "words"),
    [
        ("physx", {}, "law is 'physx'; it must be one of proposal, newton"),
        ("newton", {"terms": [replace(MEMBRANE, poisson_ratio=0.3)]}, "no Poisson's ratio other than 0"),
        ("proposal", {"terms": [wc.Spring(stiffness=1.0)]}, "no Spring"),
        ("proposal", {"terms": [replace(BENDING, damping=1.0)]}, "no damping of cloth, as that of QuadraticBending"),
        ("proposal", {"terms": [BENDING, replace(BENDING, name="more")]}, "no second surfaceBendStiffness"),
        ("proposal", {"pins": wc.Pins([0], axes="x")}, "along some axes"),
        ("proposal", {"air": wc.Air()}, "no air"),
        ("proposal", {"density": None, "masses": np.linspace(1.0, 2.0, 12)}, "no masses other than"),
        ("proposal", {"velocities": np.ones((12, 3))}, "no start that differs"),
    ],
)
def test_scenes_without_names_are_refused(tmp_path, law, fields, words):
    with pytest.raises(ValueError, match=words):
        write_scene(declared(**fields), tmp_path / "no.usda", law=law)
