"""Scenes as USD stages: what is written comes back, standard names are read in their units, wrong stages are refused."""

import math
import sys
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

import warpcloth as wc
from support.energies import DECLARED
from support.outside import Plane
from support.rows import slow_but
from support.usd_validation import validate
from warpcloth.terms import TERMS
from warpcloth.terms.loads import LOADS
from warpcloth.usd import read_scene, read_stage_mesh, write_scene
from warpcloth.usd.attributes import attributes

EPS = np.finfo(np.float32).eps
SPRING = wc.Spring(stiffness=1000.0)
# Where the sheet of `artist` lies in world space [m].
SHEET = wc.Mesh.grid(3, 3).points + np.array([0, 0, 2])


def mesh():
    """Points and lengths that float32 cannot hold."""
    return wc.Mesh.grid(4, 5, size=(0.7, 1.1), pattern="alternating")


def of(sheet=None, **fields):
    return wc.Scene(mesh() if sheet is None else sheet, **({"density": 0.1, "terms": [SPRING]} | fields))


def every_term():
    sheet = mesh()
    pairs = sheet.springs("shear")

    def each(first, last):
        return np.linspace(first, last, len(sheet.triangles))

    terms = [
        wc.Spring(name="warp", pairs=("structural", "shear"), stiffness=1e3 / 3),
        wc.Spring(name="weft", pairs=pairs[::-1], stiffness=np.linspace(1, 2, len(pairs)), rest_lengths=0.1),
        wc.CorotatedMembrane(stiffness=1e3 / 7),
        wc.StVKMembrane(stiffness=each(1, 2), poisson_ratio=1 / 3, damping=0.1),
        wc.NeoHookeanMembrane(stiffness=100.0, poisson_ratio=each(-0.5, 0.9), name="rubber", damping=each(0, 1)),
        wc.OrthotropicMembrane(stiffness=100.0, weft_ratio=each(1, 2), shear_ratio=0.1, warp_angle=1 / 3),
        wc.QuadraticBending(stiffness=1e-5),
        wc.DihedralBending(stiffness=np.full(len(sheet.hinges), 1e-6)),
        wc.Attachment(vertices="corners", stiffness=[1.0, 2.0, 3.0, 4.0], name="by selection"),
        wc.Attachment(vertices=[7, 3], stiffness=5.0, targets=sheet.points[[7, 3]] + 0.1),
        wc.SpringLimit(pairs="structural", most=1.1),
        wc.RigidCluster(vertices=[[0, 1, 2], [2, 7]], stiffness=[1e3, 2e4]),
        wc.RigidCluster(vertices=[3, 4, 5], name="hard"),
        wc.RigidCluster(vertices="corners", stiffness=1e3, name="one body"),
        wc.RigidCluster(vertices=["x == 0", "corners"], stiffness=[1e3, 2e3], name="by selections"),
        wc.StrainLimit(least=each(0.8, 0.9), most=1 + 1 / 30, stiffness=1e4),
    ]
    return of(sheet, terms=terms, name="every term")


def hard_springs():
    terms = [wc.Spring(stiffness=math.inf, rest_lengths=mesh().edge_lengths * 1.01)]
    return of(density=0.2, terms=terms, fps=24.0, duration=7 / 24)


def states():
    sheet, random = mesh(), np.random.default_rng(1)
    given = {"masses": random.uniform(0.1, 0.2, len(sheet.points))}
    given |= {"positions": sheet.points @ [[0, 1, 0], [1, 0, 0], [0, 0, 1]] + 0.1}
    given |= {"velocities": random.normal(size=sheet.points.shape), "terms": [SPRING], "pins": [3, 0]}
    given |= {"gravity": (0.1, 0.2, -1.62), "duration": 0.3, "fps": 30.0, "free_axes": random.random(sheet.points.shape) > 0.2}
    return wc.Scene(sheet, **given)


def keyframes():
    sheet = mesh()
    vertices = [19, 2, 5]
    moves = np.linspace(0, 0.1, 4)[:, None, None] * np.arange(9.0).reshape(3, 3)
    return of(sheet, pins=wc.Pins(vertices, sheet.points[vertices] + moves))


def equilateral():
    return of(wc.Mesh.grid(4, 5, pattern="equilateral"), pins="z < 0.01", fps=23.976, duration=1 / 23.976)


def chain():
    return of(wc.Mesh.chain(7, length=1.3), terms=[wc.Spring(pairs="bending", stiffness=2.0), SPRING], pins=[0])


def net():
    """Edges in an order and directions of their own, a vertex without any, an attachment on it."""
    grid = wc.Mesh.grid(4, 3, size=0.7)
    edges = np.random.default_rng(1).permutation(grid.edges)
    edges[::2] = edges[::2, ::-1]
    points = np.concatenate([grid.points, [[3, 0, 0]]])
    return wc.Scene(
        wc.Mesh(points, edges=edges),
        masses=np.full(len(points), 0.1),
        terms=[wc.Spring(stiffness=1.0 + np.arange(len(edges))), wc.Attachment(vertices=[12], stiffness=1.0)],
        pins=wc.Pins([11, 5, 1], np.stack([points[[11, 5, 1]], points[[11, 5, 1]] + 1 / 3])),
    )


def awkward_names():
    names = [None, None, "Spring", "", "a:b", "a:b", "Spring_2", "weft", "weft", "π r²", "QuadraticBending", "9"]
    terms = [wc.Spring(stiffness=float(number), name=name) for number, name in enumerate(names)]
    return of(terms=[*terms, wc.QuadraticBending(stiffness=1.0, name="Spring")], name="")


def rollers():
    points = mesh().points[[4, 1, 2]]
    return of(pins=wc.Pins([4, 1, 2], [points, points + 1 / 3], axes=["yx", "xyz", "z"]))


def loads():
    sheet = mesh()
    loads = [
        wc.Pressure(vertices="all", pressure=100 / 3),
        wc.Force(vertices=[3, 1], force=[[1 / 3, 0, 0], [0, 1, 0]], name="pull"),
        wc.Force(vertices="corners", keyframes=[[0, 0, 0], [0, 1 / 3, 0], [1, 1, 1]], name="a:b"),
        wc.Traction(vertices="z == 0", traction=(1.0, 0.0, 0.0)),
        wc.Pressure(vertices="boundary or x < 0.4", keyframes=[0.0, 1 / 7, 3.0, 2.0]),
        wc.Force(vertices=[5, 7], keyframes=np.arange(12.0).reshape(2, 2, 3)),
        wc.Pressure(vertices="all", pressure=np.linspace(0, 1, len(sheet.triangles)), name="Force"),
        wc.Pressure(vertices="all", keyframes=np.ones((1, len(sheet.triangles)))),
    ]
    return of(sheet, pins=[0], loads=loads, duration=1 / 30)


def colliders():
    """Each kind, standing, moved, turned about an axis of its own and deformed, with numbers that float32 cannot hold."""
    cube, random = trimesh.creation.box((0.3, 0.2, 0.1)), np.random.default_rng(1)
    turns = [random.normal(size=(1000, 4))]
    for _ in range(3):
        turns.append(turns[-1] / np.linalg.norm(turns[-1], axis=1)[:, None])
    turns = turns[1][(turns[3] != turns[2]).any(axis=1)][:4]  # of length 1 to rounding, and never exactly
    moves = random.normal(size=(4, 3)) / 3 + np.array([0, -5, 0])
    colliders = [
        wc.Plane(normal=(0.1, 1, 0.3), position=(0, -1 / 3, 0), friction=0.3),
        wc.Plane(position=(0, -1, 0), rotation=(0.0998, 0, 0, 0.995)),
        wc.Sphere(radius=1 / 7, position=moves, name="my ball"),
        wc.Sphere(radius=0.5, position=(0, -9, 0), name="Sphere"),
        wc.Capsule(radius=0.1, length=1 / 3, axis=(1, 2, 3), position=(3, 1 / 3, 0), rotation=turns),
        wc.Box(size=(0.1, 1 / 3, 0.7), position=(5, 0, 0), rotation=turns[0], friction=0.5, name="/root/Box"),
        wc.MeshCollider(cube.vertices / 3, cube.faces, position=moves, rotation=turns, friction=1 / 3),
        wc.MeshCollider([cube.vertices + np.array([0, -9 - k / 3, 0]) for k in range(3)], cube.faces),
        wc.MeshCollider(np.float32(cube.vertices), cube.faces[1:], position=(9, 9, 9)),
    ]
    return of(colliders=colliders, contact=wc.Contact(distance=2e-3), duration=4 / 60)


MADE = (loads, colliders, rollers, every_term, hard_springs, states, keyframes, equilateral, chain, net, awkward_names)
SCENES = {make.__name__: make for make in MADE} | {
    "contact alone": lambda: of(contact=wc.Contact(stiffness=math.inf)),
    "self-contact": lambda: of(self_contact=wc.SelfContact(distance=1 / 300, friction=0.3, held_pins="allow")),
    "symmetry": lambda: of(pins=wc.Pins([0, 1], axes="zx")),
    "one keyframe": lambda: of(pins=wc.Pins([4], mesh().points[None, [4]])),
}


def assert_same(one, other, what):
    """Equal, bit for bit; sequences and arrays of the same numbers are the same."""
    if one is None or other is None or isinstance(one, str):
        assert one == other, what
    elif isinstance(one, tuple) and one and isinstance(one[0], str):
        assert tuple(other) == one, what
    else:
        assert np.shape(one) == np.shape(other), what
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other), err_msg=what)


def assert_same_scene(read, scene):
    order = np.argsort(scene.pins.vertices)
    np.testing.assert_array_equal(read.pins.vertices, scene.pins.vertices[order])
    np.testing.assert_array_equal(read.pins.held, scene.pins.held[order])
    if scene.pins.keyframes is None:
        assert read.pins.keyframes is None
    else:
        np.testing.assert_array_equal(read.pins.keyframes, scene.pins.keyframes[:, order])
    for field in fields(scene.mesh):
        one, other = getattr(scene.mesh, field.name), getattr(read.mesh, field.name)
        if field.name == "up_axis":  # a stage says its own, which gravity gives where the mesh has none
            one = one or scene.up_axis
        if field.name == "texture_coordinates" and one is not None:
            one = one.astype(np.float32).astype(np.float64)
        assert_same(one, other, field.name)
    for field in fields(scene):
        if field.name not in ("mesh", "terms", "pins", "stage", "loads", "colliders", "contact"):
            assert_same(getattr(scene, field.name), getattr(read, field.name), field.name)
    assert scene.contact is read.contact is None or vars(scene.contact) == vars(read.contact)
    assert [type(collider) for collider in read.colliders] == [type(collider) for collider in scene.colliders]
    for one, other in zip(scene.colliders, read.colliders, strict=True):
        assert (one.name, one.friction) == (other.name, other.friction)
        assert_same(one.poses, other.poses, one.label)  # an axis is a part of the rotation
        for field in ("points", "triangles") if isinstance(one, wc.MeshCollider) else ("core",):
            for value, found in zip(getattr(one, field), getattr(other, field), strict=True):
                assert_same(value, found, f"{one.label}.{field}")
    assert [type(load) for load in read.loads] == [type(load) for load in scene.loads]
    for one, other in zip(scene.loads, read.loads, strict=True):
        assert one.name == other.name
        for field in ("vertices", one.quantity, "keyframes"):
            value, found = getattr(one, field), getattr(other, field)
            assert_same(value if isinstance(value, str) or value is None else np.array(value), found, field)
    assert [type(term) for term in read.terms] == [type(term) for term in scene.terms]
    for one, other in zip(scene.terms, read.terms, strict=True):
        for field in fields(one):
            value = getattr(one, field.name)
            value = (value or None) if field.name == "name" else value
            value = np.array(value) if isinstance(value, list) else value
            assert_same(value, getattr(other, field.name), f"{type(one).__name__}.{field.name}")


@pytest.mark.parametrize("ending", slow_but(["usda"], ["usda", "usdc", "usd"]))
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_comes_back(tmp_path, name, ending):
    scene = SCENES[name]()
    path = write_scene(scene, tmp_path / f"scene.{ending}")
    assert path == str(tmp_path / f"scene.{ending}")
    read = read_scene(path)
    assert_same_scene(read, scene)
    assert read.stage.prim == "/World/Cloth" and read.stage.mesh is read.mesh
    for one, other in zip(scene.terms, read.terms, strict=True):
        np.testing.assert_array_equal(one.stencil(scene.mesh), other.stencil(read.mesh))  # so that arrays mean the same
    assert validate(path) == []
    assert_same_scene(read_scene(write_scene(read, tmp_path / f"again.{ending}")), read)


@pytest.mark.parametrize("kind", DECLARED)
def test_every_energy_comes_back(tmp_path, kind, monkeypatch):
    """Those of the package, and one from outside it."""
    monkeypatch.setitem(TERMS, "Plane", Plane)
    sheet = mesh()
    scene = of(sheet, terms=[DECLARED[kind](sheet)])
    read = read_scene(write_scene(scene, tmp_path / "scene.usda"))
    assert_same_scene(read, scene)
    one, other = (each.terms[0].elements(each.mesh, each.positions) for each in (scene, read))
    assert np.array_equal(one.rest, other.rest) and np.array_equal(one.stencil, other.stencil)


@pytest.mark.parametrize("other", [{"terms": [wc.Spring(stiffness=999.0)]}, {"density": np.nextafter(0.1, 1)}])
def test_the_comparison_can_fail(other):
    with pytest.raises(AssertionError):
        assert_same_scene(of(), of(**other))


def test_every_field_has_a_row():
    known = {row.field for row in attributes()}
    # The prim, other rows, other rows, a GeomSubset, the file, the stage's rate, other rows, other prims, prims
    elsewhere = {"mesh", "air", "terms", "loads", "pins", "stage", "fps", "contact", "self_contact", "colliders", "cloths"}
    assert {field.name for field in fields(wc.Scene)} <= known | elsewhere
    assert {f"contact.{field.name}" for field in fields(wc.Contact)} <= known
    for term in TERMS.values():
        assert {f"terms.{field.name}" for field in fields(term)} <= known
    for load in LOADS.values():  # keyframes are samples
        assert {f"loads.{field.name}" for field in fields(load)} <= known | {"loads.keyframes"}
    assert len({(row.name, row.location) for row in attributes()}) == len(attributes())


def test_a_limit_without_a_stiffness_is_hard(tmp_path):
    limit = {
        "warpcloth:density": ("Double", 0.1),
        "warpcloth:terms:limit:type": ("Token", "StrainLimit"),
        "warpcloth:terms:limit:most": ("Double", 1.05),
    }
    artist(tmp_path / "artist.usda", limit).Save()
    (term,) = read_scene(tmp_path / "artist.usda").terms
    assert (term.least, term.most, term.stiffness) == (None, 1.05, math.inf)


# Stages that artists make.


def artist(path, attributes=None, up="Z", pins=(), samples=(), material=None, body=None):
    """A stage in cm and g at 24 fps: /Set/Sheet with attributes (type, value) by name; optional pins, samples, material."""
    mesh = wc.Mesh.grid(3, 3)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    UsdGeom.SetStageUpAxis(stage, up)
    stage.SetTimeCodesPerSecond(24)
    stage.SetFramesPerSecond(24)
    root = UsdGeom.Xform.Define(stage, "/Set")
    root.AddTranslateOp().Set(Gf.Vec3d(0, 0, 200))
    stage.SetDefaultPrim(root.GetPrim())
    points = np.float32(mesh.points / 0.01)
    cloth = UsdGeom.Mesh.Define(stage, "/Set/Sheet")
    cloth.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    cloth.CreateFaceVertexCountsAttr([3] * len(mesh.triangles))
    cloth.CreateFaceVertexIndicesAttr(np.array(mesh.triangles).reshape(-1))
    cloth.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(Vt.Vec3fArray.FromNumpy(points)))
    for code, move in samples:
        cloth.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points + np.float32(move)), code)
    for number, vertices in enumerate(pins):
        UsdGeom.Subset.CreateGeomSubset(cloth, f"pins{number}", "point", Vt.IntArray(vertices), "pins", "unrestricted")
    author(cloth.GetPrim(), attributes or {})
    if body:
        root.GetPrim().AddAppliedSchema("PhysicsDeformableBodyAPI")
        author(root.GetPrim(), body)
    if material:
        linen = UsdShade.Material.Define(stage, "/Set/Linen")
        linen.GetPrim().AddAppliedSchema("PhysicsSurfaceDeformableMaterialAPI")
        author(linen.GetPrim(), material)
        UsdShade.MaterialBindingAPI.Apply(cloth.GetPrim()).Bind(linen, materialPurpose="physics")
    return stage


def author(prim, attributes):
    for name, (type_name, value) in attributes.items():
        prim.CreateAttribute(name, getattr(Sdf.ValueTypeNames, type_name)).Set(value)


OWN = {
    "warpcloth:density": ("Double", 0.15),
    "warpcloth:terms:threads:type": ("Token", "Spring"),
    "warpcloth:terms:threads:stiffness": ("Float", 1000.0),
}


def physics(**values):
    return {f"physics:{name}": ("Float", value) for name, value in values.items()}


# An iron, not a linen, sheet of 1 cm: 7.8 g/cm³, in units of the stage.
MATERIAL = physics(density=7.8, surfaceThickness=1.0, surfaceStretchStiffness=3e6, surfaceBendStiffness=2e7)


def test_an_artists_scene_runs_as_a_layer_over_it(tmp_path):
    path = tmp_path / "artist.usda"
    stage = artist(path, OWN, up="Y", pins=[[2], [0, 2]])
    UsdGeom.Subset.CreateGeomSubset(
        UsdGeom.Mesh.Get(stage, "/Set/Sheet"), "hem", "point", Vt.IntArray([7]), "seams", "unrestricted"
    )
    stage.SetStartTimeCode(101)
    stage.SetEndTimeCode(104)
    stage.Save()
    before = path.read_bytes()
    scene = read_scene(path)
    assert scene.name == "Sheet" and scene.fps == 24 and scene.frames == 3
    assert scene.pins.vertices.tolist() == [0, 2] and scene.pins.keyframes is None
    np.testing.assert_allclose(scene.gravity, [0, -9.81, 0])
    np.testing.assert_allclose(scene.mesh.points, SHEET, atol=4 * EPS)
    assert scene.density == 0.15
    assert [(term.name, term.pairs, term.stiffness) for term in scene.terms] == [("threads", "edges", 1000)]
    output = tmp_path / "result.usda"
    animation = wc.simulate(scene, wc.Newton(substeps=4), output=output)
    assert animation.status.result.name in ("CONVERGED", "ROUNDED")
    assert path.read_bytes() == before
    assert validate(output, path) == []
    result = Usd.Stage.Open(str(output))
    assert (result.GetStartTimeCode(), result.GetEndTimeCode()) == (101, 104)
    points = np.asarray(animation.points)
    assert points.shape == (4, 9, 3)
    # In world metres: the pins stay, the far corner falls as far as gravity takes it.
    np.testing.assert_allclose(points[:, [0, 2]], np.tile(points[0, [0, 2]], (4, 1, 1)), atol=4 * EPS)
    fall = points[0, 8, 1] - points[-1, 8, 1]
    assert 0.5 < fall / (0.5 * 9.81 * (3 / 24) ** 2) < 1.5
    # The animated points are no motion that the cloth is to follow: a result is the same scene.
    assert_same_scene(read_scene(output), scene)


def test_own_scene_runs_and_its_result_is_the_same_scene(tmp_path):
    path = write_scene(keyframes(), tmp_path / "scene.usdc")
    scene, output = read_scene(path), tmp_path / "result.usdc"
    expected = np.float32(wc.simulate(keyframes(), wc.Newton(substeps=4), frames=4).points)
    points = np.asarray(wc.simulate(scene, wc.Newton(substeps=4), frames=4, output=output).points)
    np.testing.assert_array_equal(points, expected)
    assert validate(output, path) == []
    assert_same_scene(read_scene(output), scene)


# K = 3000 N/m with ν = 0.3, the default of the proposal, and D = 2 N·m.
SHEET_TERMS = [("NeoHookeanMembrane", 3e3 * 0.91), ("QuadraticBending", 2.0)]


# Of 30 kg on 1 m², spread over it; thickness on the mesh, in cm, before that of the material.
CONSTANT = {f"physics:{name}": ("FloatArray", [value]) for name, value in (("masses", 3e4), ("thicknesses", 2.0))}
CONSTANT |= {f"{name}:elementType": ("Token", "constant") for name in CONSTANT}


@pytest.mark.parametrize(
    ("options", "density", "terms"),
    [
        ({}, 78.0, SHEET_TERMS),
        # Where there is no thickness the proposal says 1 mm.
        ({"material": {name: value for name, value in MATERIAL.items() if "Thick" not in name}}, 7.8, SHEET_TERMS),
        # The body's density is before the material's, its mass (300 g on 1 m²) before both, 0 is none, our own is first.
        ({"body": physics(density=1.0)}, 10.0, SHEET_TERMS),
        ({"body": physics(density=1.0, mass=300.0)}, 0.3, SHEET_TERMS),
        ({"body": physics(density=0.0, mass=0.0)}, 78.0, SHEET_TERMS),
        ({"attributes": physics(mass=300.0)}, 0.3, SHEET_TERMS),
        ({"attributes": {"warpcloth:density": ("Double", 5.0)}}, 5.0, SHEET_TERMS),
        ({"attributes": OWN}, 0.15, [("Spring", 1000.0)]),
        ({"material": MATERIAL | physics(surfaceStretchStiffness=0.0)}, 78.0, SHEET_TERMS[1:]),
        ({"attributes": CONSTANT}, 30.0, SHEET_TERMS),
    ],
)
def test_standard_names_are_read_in_units_of_the_stage(tmp_path, options, density, terms):
    options = {"material": MATERIAL} | options
    artist(tmp_path / "artist.usda", **options).Save()
    doubtful = pytest.warns(UserWarning, match="resists bending only") if terms == SHEET_TERMS[1:] else nullcontext()
    with doubtful:
        scene = read_scene(tmp_path / "artist.usda")
    np.testing.assert_allclose(scene.vertex_masses, density * scene.mesh.vertex_areas, rtol=8 * EPS)
    assert [type(term).__name__ for term in scene.terms] == [kind for kind, _ in terms]
    np.testing.assert_allclose([term.stiffness for term in scene.terms], [stiffness for _, stiffness in terms], rtol=4 * EPS)
    given = 0.02 if "thicknesses" in str(options) else 0.01
    names_alone = terms[0][0] != "Spring" and "Thick" in str(options)
    assert scene.thickness == (pytest.approx(given, rel=float(EPS)) if names_alone else None)


@pytest.mark.parametrize("given", [None, (0.0, -1.62, 0.0), (0.0, 0.0, -1.62), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("up", ["Y", "Z", None])
def test_gravity_follows_the_up_axis_of_a_loaded_mesh(tmp_path, up, given):
    """An explicit gravity wins, and files say what gravity says."""
    mesh = wc.Mesh.grid(3, 3)
    if up is not None:
        artist(tmp_path / "artist.usda", up=up).Save()
        mesh = wc.Mesh.load(tmp_path / "artist.usda")
    assert mesh.up_axis == up
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=10.0)], duration=1 / 60, gravity=given)
    own = (0.0, 0.0, -9.81) if up == "Z" else (0.0, -9.81, 0.0)
    assert scene.gravity.tolist() == list(own if given is None else given)
    said = {None: up or "Y", (0.0, -1.62, 0.0): "Y", (0.0, 0.0, -1.62): "Z"}.get(given, up or "Y")
    wc.simulate(scene, wc.Explicit(substeps=8), output=str(tmp_path / "run.usda"))
    write_scene(scene, tmp_path / "scene.usda")
    pins = wc.Pins([0, 8], np.array([mesh.points[[0, 8]]] * 2))
    wc.deform(mesh, pins, output=str(tmp_path / "deformed.usda"))
    axes = [UsdGeom.GetStageUpAxis(Usd.Stage.Open(str(tmp_path / f"{name}.usda"))) for name in ("run", "scene", "deformed")]
    assert axes == [said, said, up or "Y"]


@pytest.mark.parametrize(
    ("own", "direction", "magnitude", "up", "expected"),
    [
        (None, None, None, "Y", [0, -9.81, 0]),
        (None, None, None, "Z", [0, 0, -9.81]),
        (None, (0, 0, 0), -math.inf, "Z", [0, 0, -9.81]),
        (None, (2, 0, 0), 162.0, "Z", [1.62, 0, 0]),
        (None, (0, 0, 0), 0.0, "Y", [0, 0, 0]),
        ((0, 1, 2), (2, 0, 0), 162.0, "Z", [0, 1, 2]),
    ],
)
def test_gravity(tmp_path, own, direction, magnitude, up, expected):
    stage = artist(
        tmp_path / "artist.usda", OWN if own is None else {**OWN, "warpcloth:gravity": ("Double3", Gf.Vec3d(own))}, up=up
    )
    if direction is not None:
        physics = UsdPhysics.Scene.Define(stage, "/Physics")
        physics.CreateGravityDirectionAttr(Gf.Vec3f(direction))
        physics.CreateGravityMagnitudeAttr(magnitude)
    stage.Save()
    np.testing.assert_allclose(read_scene(tmp_path / "artist.usda").gravity, expected, rtol=4 * EPS)


@pytest.mark.parametrize(
    ("start", "end", "fps", "own", "duration"),
    [
        (None, None, 24, None, 1.0),
        (101, 149, 24, None, 2.0),
        (101, 149, 60, None, 2.0),
        (0, 1.5, 24, None, 1 / 24),  # whole frames
        (5, 5, 24, None, 1.0),
        (101, 149, 24, 0.5, 0.5),
    ],
)
def test_duration(tmp_path, start, end, fps, own, duration):
    stage = artist(tmp_path / "artist.usda", OWN if own is None else {**OWN, "warpcloth:duration": ("Double", own)})
    stage.SetFramesPerSecond(fps)
    if start is not None:
        stage.SetStartTimeCode(start)
        stage.SetEndTimeCode(end)
    stage.Save()
    scene = read_scene(tmp_path / "artist.usda")
    assert (scene.duration, scene.fps) == (pytest.approx(duration, rel=1e-12), fps)


@pytest.mark.parametrize("fps", [24, 48])
def test_pins_follow_the_artists_animation(tmp_path, fps):
    """From 10 cm aside, 2 cm a time code along x, up to time code 105; the stage lasts longer."""
    stage = artist(
        tmp_path / "artist.usda", OWN, pins=[[0, 4]], samples=[(101, (10, 0, 0)), (103, (14, 0, 0)), (105, (18, 0, 0))]
    )
    stage.SetStartTimeCode(101)
    stage.SetEndTimeCode(149)
    stage.SetFramesPerSecond(fps)
    stage.Save()
    scene = read_scene(tmp_path / "artist.usda")
    tolerance = 8 * EPS
    np.testing.assert_allclose(scene.mesh.points, SHEET, atol=tolerance)
    np.testing.assert_allclose(scene.positions, SHEET + np.array([0.1, 0, 0]), atol=tolerance)
    frames = 4 * fps // 24
    moves = 0.1 + 0.08 * np.arange(frames + 1) / frames
    expected = SHEET[[0, 4]] + moves[:, None, None] * [1, 0, 0]
    np.testing.assert_allclose(scene.pins.keyframes, expected, atol=tolerance)
    assert_same_scene(read_scene(write_scene(scene, tmp_path / "copy.usda")), scene)


def test_an_edit_of_the_points_wins_over_the_exact_copy(tmp_path):
    path = write_scene(keyframes(), tmp_path / "scene.usda")
    stage = Usd.Stage.Open(path)
    points = stage.GetPrimAtPath("/World/Cloth").GetAttribute("points")
    edited = np.array(points.Get())
    edited[7] += np.float32([0, 0.125, 0])
    points.Set(Vt.Vec3fArray.FromNumpy(edited))
    UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddTranslateOp().Set(Gf.Vec3d(0, 1, 0))
    stage.GetPrimAtPath("/World/Cloth").RemoveProperty("warpcloth:pins:keyframes")
    stage.Save()
    np.testing.assert_array_equal(read_scene(path).mesh.points, edited.astype(np.float64) + np.array([0, 1, 0]))


def test_the_cloth_is_the_mesh_with_attributes(tmp_path):
    stage, path = artist(tmp_path / "artist.usda", OWN), tmp_path / "artist.usda"
    other = UsdGeom.Mesh.Define(stage, "/Set/Body")
    other.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    other.CreateFaceVertexCountsAttr([3])
    other.CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.Save()
    assert read_scene(path).stage.prim == "/Set/Sheet"
    with pytest.raises(ValueError, match="several meshes"):
        read_stage_mesh(path)
    with pytest.raises(ValueError, match=r"/Set/Body: has no mass .* and no term"):
        read_scene(path, prim="Body")
    for name in ("/One", "/Two"):
        UsdPhysics.Scene.Define(stage, name)
    stage.Save()
    with pytest.raises(ValueError, match="has 2 PhysicsScenes, must have one or warpcloth:gravity"):
        read_scene(path)


def without(*names):
    return {name: value for name, value in OWN.items() if not name.endswith(names)}


def own(name, type_name, value):
    """A cloth with the attributes that it needs, and one more."""
    return OWN | {f"warpcloth:{name}": (type_name, value)}


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({}, r"has no mass \(warpcloth:density, .*physics:density\) and no term \(warpcloth:terms:<name>:type, .*\), must"),
        (without("density"), r"has no mass \(.*\), must have"),
        (without("type", "stiffness"), r"has no term \(.*\), must have"),
        (without("type"), "warpcloth:terms:threads:type is not given, must be one of Attachment, "),
        (without("stiffness"), "warpcloth:terms:threads:stiffness is not given, must be"),
        (own("terms:threads:type", "Token", "Rope"), "type is 'Rope', must be one of Attachment, "),
        (own("terms:threads:vertices", "IntArray", [1]), "threads has vertices, which a Spring has not"),
        (own("terms:threads:stifness", "Double", 1.0), "threads:stifness is no attribute of a cloth, must be"),
        (own("loads:wind:type", "Token", "Gale"), "warpcloth:loads:wind:type is 'Gale', must be one of Force, Traction, Press"),
        (own("loads:wind:type", "Token", "Force"), "warpcloth:loads:wind:vertices is not given, must be a selection or ind"),
        (
            own("loads:a:type", "Token", "Force") | own("loads:a:pressure", "Double", 1.0),
            "warpcloth:loads:a has pressure, which a Force has not; it must have none",
        ),
        (
            own("loads:a:type", "Token", "Pressure") | own("loads:a:vertices", "String", "all"),
            "warpcloth:loads:a: a: exactly one of pressure and keyframes must be given",
        ),
        (own("loads:a:strength", "Double", 1.0), "warpcloth:loads:a:strength is no attribute of a cloth, must be one of"),
        (own("freeAxes", "Int3Array", [(1, 1, 2)] * 9), r"warpcloth:freeAxes\[0\] has 2, must be 0 or 1 for each axis"),
        (own("freeAxes", "Int3Array", [(1, 1, 1)]), r"free_axes has shape \(1, 3\); it must be an array"),
        (own("mass", "Double", 1.0), "warpcloth:mass is no attribute of a cloth, must be one of .*density"),
        (own("terms:threads:stiffness", "Double", -1.0), r"stiffness is -1.0; it must be 0 or more"),
        (own("terms:threads:stiffness", "String", "stiff"), r"has type string, must be double or double\[\]"),
        (own("terms:threads:pairs", "IntArray", [0, 1]), r"has type int\[\], must be token or token\[\] or"),
        (own("terms:threads:pairs", "Token", "knots"), "kind is 'knots'; it must be"),
        (own("density", "Double", -1.0), "density is -1.0; it must be a number above 0"),
        (own("masses", "DoubleArray", [1.0] * 9), "exactly one of density and masses"),
        (own("duration", "Double", 0.0), "warpcloth:duration is 0.0 s, must be finite and above 0"),
        (own("positions", "Double3Array", [(0, 0, 0)]), r"positions has shape \(1, 3\); it must be \(9, 3\)"),
        (own("pins:keyframes", "Double3Array", [(0, 0, 0)]), "has 1 positions, must have one for each of 2"),
        (own("gridShape", "Int2", Gf.Vec2i(2, 2)), "grid_shape = .* must be the number of points, 9"),
    ],
)
def test_bad_stages_are_refused(tmp_path, attributes, message):
    artist(tmp_path / "artist.usda", attributes, pins=[[0, 2]]).Save()
    with pytest.raises(ValueError, match=message) as caught:
        read_scene(tmp_path / "artist.usda")
    assert str(caught.value).startswith(f"{tmp_path / 'artist.usda'}, prim /Set/Sheet: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "terms", "error", "message"),
    [
        ("scene.usdz", [SPRING], ValueError, "must end with one of .usd, .usda, .usdc"),
        ("nowhere/scene.usda", [SPRING], FileNotFoundError, "the folder .* does not exist"),
        ("a.usda", [], ValueError, "scene.terms is empty; a scene in a stage must have one or more"),
        ("a.usda", [wc.RigidCluster(vertices=[])], ValueError, "RigidCluster has no elements on this mesh .*; leave it out"),
    ],
)
def test_bad_writes_are_refused(tmp_path, name, terms, error, message):
    with pytest.raises(error, match=message):
        write_scene(of(terms=terms), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_scene_is_written_through_a_link_and_not_over_its_stage(tmp_path):
    (tmp_path / "link.usda").symlink_to("real.usda")
    assert write_scene(chain(), tmp_path / "link.usda") == str(tmp_path / "real.usda")
    scene = read_scene(tmp_path / "real.usda")
    assert (tmp_path / "link.usda").is_symlink() and len(scene.terms)
    with pytest.raises(ValueError, match="the stage that the scene was read from"):
        write_scene(scene, tmp_path / "real.usda")


def test_square_cloth_hangs(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scenes"))
    scene = __import__("usd_cloth").scene(duration=0.25)
    sys.modules.pop("usd_cloth")
    output = tmp_path / "cloth.usdc"
    animation = wc.simulate(scene, wc.Newton(dt=1 / 240), output=output)
    assert animation.status.result.name in ("CONVERGED", "ROUNDED") and animation.worst_strain < 0.05
    assert validate(output, scene.stage.path) == []
    # The middle falls freely at first, down z of a stage that has z up, with the error of first order of 60 steps.
    fall = scene.mesh.points.mean(axis=0) - animation.points[6].mean(axis=0)
    np.testing.assert_allclose(fall, [0, 0, 0.5 * 9.81 * 0.25**2], atol=0.05 * 9.81 * 0.25**2)
    assert_same_scene(read_scene(write_scene(scene, tmp_path / "copy.usdc")), scene)
