"""Measures written over the stage that was measured, or on a stage of their own."""

import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from support.disks import room_for
from support.stages import (
    CHUNK,
    CODES,
    DIRECTIONS,
    PENTAGON,
    PENTAGON_AND_TRIANGLE,
    animated_prim,
    artist_stage,
    define_mesh,
    full_from,
    measure,
    measured,
    net,
    segments_of,
    sphere,
    write,
)
from support.usd_validation import validate
from warpcloth.mesh.mesh import Mesh, Surface
from warpcloth.usd import FrameSequence, MeasureWriter, read_mesh, read_stage_mesh
from warpcloth.usd.chunks import export

EPS = np.finfo(np.float32).eps
LEGEND = {"stretch1": {"low": 0.5, "neutral": 1.0, "high": np.float32(2.0), "unit": "1"}, "frames excluded": 3}


def over_artist(folder):
    return read_stage_mesh(artist_stage(folder / "artist.usda", animated=True))


def over_moving(folder):
    path = artist_stage(folder / "artist.usda")
    stage = Usd.Stage.Open(path)
    translate = stage.GetPrimAtPath("/Set/Group").GetAttribute("xformOp:translate")
    for code in (101, 112):
        translate.Set(Gf.Vec3d(code, 2 * code, 0), code)
    stage.Save()
    return read_stage_mesh(path, kind=Surface, time=101.0)


def over_root(folder):
    stage, mesh = define_mesh(folder / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE, orientation="leftHanded")
    stage.SetDefaultPrim(mesh.GetPrim())
    stage.Save()
    return read_stage_mesh(folder / "a.usda")


def over_result(folder):
    return read_stage_mesh(write(folder / "first.usda", Mesh.grid(5, 4)))


def over_net(folder):
    mesh, options = net(folder)
    return read_stage_mesh(write(folder / "net.usda", mesh, **options))


CASES = {  # what makes the source in a folder, and endings of results, * for one file
    "artist": (over_artist, "usda usdc* usdz*"),
    "mirrored": (lambda folder: read_stage_mesh(artist_stage(folder / "a.usda", sphere(), "leftHanded", (-1, 2, 1))), "usdc"),
    "moving": (over_moving, "usdc usda*"),
    "result": (over_result, "usdc usdc*"),
    "package": (lambda folder: read_stage_mesh(write(folder / "first.usdz", Mesh.grid(5, 4))), "usda"),
    "net": (over_net, "usdc usdc*"),
    "none": (lambda folder: None, "usda usd* usdz*"),
}


@pytest.fixture(
    scope="module", params=[f"{name} {ending}" for name, (_, endings) in CASES.items() for ending in endings.split()]
)
def result(request, tmp_path_factory):
    """Written measures: (path, mesh, source, bytes of the source before)."""
    name, how = request.param.split()
    folder, ending, single_file = tmp_path_factory.mktemp("measures"), how.strip("*"), how.endswith("*")
    source = CASES[name][0](folder)
    mesh = source.mesh if source else Mesh.grid(5, 4)
    before = Path(source.path).read_bytes() if source else b""
    path = measure(folder / f"result.{ending}", mesh, source, single_file=single_file, metadata={"legend": LEGEND})
    return path, mesh, source, before


def test_measures_come_back_at_their_time_codes(result):
    path, mesh, _, _ = result
    _stage, prim = animated_prim(path)
    for name in ("stretch1", "warpcloth:turn"):
        expected = np.float32([measured(mesh, frame)[0][name] for frame in range(len(CODES))])
        sequence = FrameSequence(path, attribute=f"primvars:{name}")
        assert sequence.time_codes.tolist() == list(CODES)
        # Bits, and NaN where there was none: nothing of the frames beside it leaks in, at the seams of chunks too.
        np.testing.assert_array_equal(sequence, expected)
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        triangles = name == "stretch1" and len(mesh.triangles)
        assert primvar.GetInterpolation() == ("uniform" if triangles else "vertex")


def test_colours_are_shown(result):
    path, mesh, _, _ = result
    _stage, prim = animated_prim(path)
    colour = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
    assert colour.GetTypeName() == Sdf.ValueTypeNames.Color3fArray and colour.Get() is None and not colour.IsIndexed()
    assert colour.GetInterpolation() == ("uniform" if len(mesh.triangles) else "vertex")
    assert colour.GetAttr().GetTimeSamples() == list(CODES)
    for frame, code in enumerate(CODES):
        expected = np.float32(measured(mesh, frame)[1])
        if not len(mesh.triangles):  # curves repeat vertices where they meet
            expected = expected[UsdGeom.PrimvarsAPI(prim).GetPrimvar("warpcloth:vertex").Get()]
        np.testing.assert_array_equal(colour.Get(code), expected)
    assert UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get()
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    reader = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert UsdShade.Shader(reader.GetPrim()).GetInput("varname").Get() == "displayColor"


def test_the_source_is_as_it_was(result):
    path, mesh, source, before = result
    stage, prim = animated_prim(path)
    points = prim.GetAttribute("points")
    if source is None:
        assert points.GetTimeSamples() == list(CODES) and stage.GetEndTimeCode() == CODES[-1]
        np.testing.assert_allclose(FrameSequence(path)[3], mesh.points + 0.03, rtol=0, atol=2 * EPS)
        np.testing.assert_allclose(np.linalg.norm(prim.GetAttribute("normals").Get(104.0), axis=1), 1, atol=4 * EPS)
        assert read_mesh(path).triangles.tolist() == mesh.triangles.tolist()
        return
    assert Path(source.path).read_bytes() == before
    artists_stage = Usd.Stage.Open(source.path)
    artist = artists_stage.GetPrimAtPath(source.prim)
    for name in ("points", "velocities", "normals", "extent", "subdivisionScheme", "orientation", "primvars:normals"):
        ours, theirs = prim.GetAttribute(name), artist.GetAttribute(name)
        assert bool(ours) == bool(theirs)
        if ours:
            codes = [Usd.TimeCode.Default(), *theirs.GetTimeSamples()]
            assert ours.GetTimeSamples() == theirs.GetTimeSamples(), name
            assert [ours.Get(code) for code in codes] == [theirs.Get(code) for code in codes], name
    for fact in ("GetStartTimeCode", "GetEndTimeCode", "GetTimeCodesPerSecond", "GetFramesPerSecond"):
        assert getattr(stage, fact)() == getattr(artists_stage, fact)(), fact
    for fact in (UsdGeom.GetStageMetersPerUnit, UsdGeom.GetStageUpAxis):
        assert fact(stage) == fact(artists_stage)
    assert stage.GetDefaultPrim().GetPath() == artists_stage.GetDefaultPrim().GetPath()


def test_nothing_but_measures_is_said_about_the_source(result):
    path, _, source, _ = result
    folder = Path(path).parent / f"{Path(path).stem}_frames"
    if source is None or not folder.exists():
        pytest.skip("a result in one file, or without a source, has no layer over one")
    own = set()
    stage, _ = animated_prim(path)
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        if layer.realPath == path or str(folder) in layer.realPath:
            paths = []
            layer.Traverse("/", paths.append)
            own |= {str(p) for p in paths if p.IsPropertyPath() and p.GetPrimPath() == source.prim}
    names = ("primvars:stretch1", "primvars:warpcloth:turn", "primvars:displayColor", "doubleSided", "material:binding")
    blocked = ("primvars:turn", "primvars:displayColor:indices")
    assert own - {f"{source.prim}.{name}" for name in blocked} == {f"{source.prim}.{name}" for name in names}
    assert str(folder.parent) not in Sdf.Layer.FindOrOpen(path).ExportToString(), "paths of other files must be relative"


def test_facts_survive_and_the_validators_pass(result):
    path, _, source, _ = result
    _stage, prim = animated_prim(path)
    facts = Sdf.Layer.FindOrOpen(path).customLayerData["warpcloth"]
    assert facts == {"prim": str(prim.GetPath()), "legend": LEGEND}
    assert validate(path, source and source.path) == []


def test_directions_stand_in_the_world(result):
    path, mesh, _, _ = result
    if not len(mesh.triangles):
        pytest.skip("a net has no directions")
    stage, prim = animated_prim(path)
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    for name in DIRECTIONS:
        curves = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"{prim.GetPath()}_{name}"))
        assert curves.GetPointsAttr().GetTimeSamples() == list(CODES) == curves.GetExtentAttr().GetTimeSamples()
        assert set(curves.GetCurveVertexCountsAttr().Get()) == {2} and curves.GetPointsAttr().Get() is not None
        assert UsdGeom.PrimvarsAPI(curves).GetPrimvar("displayColor").GetInterpolation() == "constant"
        half_width = max(curves.GetWidthsAttr().Get()) / 2
        for frame, code in enumerate(CODES):
            local = np.array(curves.GetPointsAttr().Get(code), np.float64)
            world = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(curves.GetPrim()))
            ends = metres * (local @ world[:3, :3] + world[3, :3])
            start, end = ends[0::2], ends[1::2]
            centre, vector = segments_of(mesh, frame)[name]
            # As points: rounded in the parent's units. Its transform is at most 2 times longer one way than another.
            tolerance = 4 * EPS * (metres * np.linalg.norm(world[:3, :3], 2) * np.abs(local).max() + np.abs(ends).max())
            known = np.isfinite(vector).all(axis=1) & np.isfinite(centre).all(axis=1)
            assert not known[[2, 4, 5]].any()
            np.testing.assert_allclose((end - start)[known], vector[known], rtol=0, atol=tolerance)
            placed = np.isfinite(centre).all(axis=1)
            np.testing.assert_allclose(0.5 * (start + end)[placed], centre[placed], rtol=0, atol=tolerance)
            assert (start == end)[~known].all() and np.isfinite(ends).all()
            extent = np.array(curves.GetExtentAttr().Get(code))
            around = np.array([local.min(axis=0) - half_width, local.max(axis=0) + half_width])
            np.testing.assert_allclose(extent, around, rtol=0, atol=2 * EPS * np.abs(around).max())
            low, high = ends[np.repeat(placed, 2)].min(axis=0), ends[np.repeat(placed, 2)].max(axis=0)
            assert (ends[8] >= low).all() and (ends[8] <= high).all(), "an element without a position is amid the others"


def test_no_place_at_all_is_the_middle_of_the_rest_shape(tmp_path):
    mesh = Mesh.grid(3, 3)
    none = np.full((8, 3), np.nan)
    with MeasureWriter(tmp_path / "a.usdc", mesh, {}, directions={"axis": "uniform"}) as writer:
        writer.append(0, {}, directions={"axis": (none, none)}, points=mesh.points)
    stage, prim = animated_prim(writer.path)
    points = np.array(stage.GetPrimAtPath(f"{prim.GetPath()}_axis").GetAttribute("points").Get(0))
    np.testing.assert_array_equal(points, np.tile(np.float32(mesh.points.mean(axis=0)), (16, 1)))


def test_a_rest_shape_may_have_holes_where_the_source_has_the_points(tmp_path):
    """A point that is not finite, and a triangle that names a vertex twice, are the artist's; curves are ours, and finite."""
    points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (np.nan, 0, 0)]
    stage, _ = define_mesh(tmp_path / "a.usda", points, [3, 3, 3], [0, 2, 1, 0, 1, 1, 1, 2, 3])
    stage.Save()
    source = read_stage_mesh(tmp_path / "a.usda", kind=Surface)
    options = {"coloured": "a", "directions": {"axis": "uniform"}, "source": source}
    with MeasureWriter(tmp_path / "out.usda", source.mesh, {"a": "uniform"}, **options) as writer:
        centres = source.mesh.points[source.mesh.triangles].mean(axis=1)
        writer.append(1, {"a": [1, np.nan, np.nan]}, np.eye(3), {"axis": (centres, np.ones((3, 3)))})
    assert np.isnan(FrameSequence(writer.path, attribute="primvars:a")[0]).tolist() == [False, True, True]
    stage = Usd.Stage.Open(writer.path)
    axis = stage.GetPrimAtPath("/Sheet_axis")
    for code in (Usd.TimeCode.Default(), 1):
        for name in ("points", "extent", "widths"):
            assert np.isfinite(axis.GetAttribute(name).Get(code)).all(), (name, code)
    with pytest.raises(ValueError, match=r"points of the rest shape: .*nan.* at frame 0, vertex 3, must be finite"):
        MeasureWriter(tmp_path / "out.usdc", source.mesh, {})


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_a_face_has_the_mean_of_what_is_known(tmp_path, ending):
    """A pentagon of three triangles and a triangle; and a prim that is a root, so that curves are roots too."""
    source = over_root(tmp_path)
    values = [[1, 2, 6, 5], [1, np.nan, 6, 5], [np.nan] * 3 + [5], [1, 2, 6, np.nan]]
    colours = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.6, 0, 0], [0.7, 0, 0]])
    options = {"coloured": "strain", "directions": {"axis": "uniform"}, "source": source, "chunk": 2}
    with MeasureWriter(tmp_path / f"out.{ending}", source.mesh, {"strain": "uniform"}, **options) as writer:
        for frame, strain in enumerate(values):
            writer.append(frame, {"strain": strain}, colours, {"axis": (np.zeros((4, 3)), np.ones((4, 3)))})
    means = [[3, 5], [3.5, 5], [np.nan, 5], [3, np.nan]]
    np.testing.assert_array_equal(FrameSequence(writer.path, attribute="primvars:strain"), np.float32(means))
    stage, prim = animated_prim(writer.path)
    shown = [np.array(prim.GetAttribute("primvars:displayColor").Get(frame))[:, 0] for frame in range(4)]
    # Without any value the colours that say so, here different ones, are all that there is to show.
    np.testing.assert_allclose(shown, [[0.3, 0.7], [0.35, 0.7], [0.3, 0.7], [0.3, 0.7]], rtol=4 * EPS)
    assert len(stage.GetPrimAtPath("/Sheet_axis").GetAttribute("points").Get(0)) == 8
    # Curves can be nowhere else: below a mesh they would be wrong, and a root has only roots beside it.
    assert [rule for rule, _ in validate(writer.path, source.path)] == ["DefaultPrimChecker"]


def add_materials(stage, cloth):
    """Binds materials that hide displayColor: materials of a prim for all purposes and for one, and of some of its faces."""
    materials = [UsdShade.Material.Define(stage, f"/Looks/{name}") for name in ("All", "Full", "Part", "Above")]
    api = UsdShade.MaterialBindingAPI.Apply(cloth.GetPrim())
    api.Bind(materials[0])
    api.Bind(materials[1], materialPurpose=UsdShade.Tokens.full)
    subset = UsdGeom.Subset.CreateGeomSubset(cloth, "front", "face", [0], "materialBind", "partition")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(materials[2])
    return materials[3]


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_what_would_hide_the_colours_is_overridden(tmp_path, ending):
    stage, mesh = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name, kind, value in (
        ("displayColor", Sdf.ValueTypeNames.Color3fArray, [Gf.Vec3f(1)] * 3),
        ("strain", Sdf.ValueTypeNames.FloatArray, [1.0] * 3),
    ):
        old = primvars.CreatePrimvar(name, kind, "faceVarying", 3)
        old.Set(value)
        old.GetAttr().Set(value, 2.0)
        old.SetIndices([0] * 8)
    add_materials(stage, mesh)
    stage.SetDefaultPrim(mesh.GetPrim())
    stage.Save()
    source = read_stage_mesh(tmp_path / "a.usda")
    with MeasureWriter(tmp_path / f"out.{ending}", source.mesh, {"strain": "vertex"}, "strain", source=source) as writer:
        writer.append(2.5, {"strain": np.arange(6.0)}, np.full((6, 3), 0.5))
    stage, prim = animated_prim(writer.path)
    for name in ("displayColor", "strain"):
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        assert primvar.GetInterpolation() == "vertex" and not primvar.IsIndexed() and primvar.GetElementSize() == 1
        assert primvar.GetAttr().GetTimeSamples() == [2.5] and primvar.Get() is None and len(primvar.Get(2)) == 6
    for path in (prim.GetPath(), f"{prim.GetPath()}/front"):
        for purpose in UsdShade.MaterialBindingAPI.GetMaterialPurposes():
            bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial(purpose)[0]
            assert bound.GetPath() == f"{prim.GetPath()}/DisplayColour", (path, purpose)


def test_a_stronger_material_above_is_reported(tmp_path):
    path = artist_stage(tmp_path / "artist.usda")
    stage = Usd.Stage.Open(path)
    above = add_materials(stage, UsdGeom.Mesh(stage.GetPrimAtPath("/Set/Group/Sheet")))
    group = UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/Set/Group"))
    group.Bind(above, bindingStrength=UsdShade.Tokens.strongerThanDescendants)
    stage.Save()
    source = read_stage_mesh(path)
    with pytest.warns(UserWarning, match="prim /Set/Group/Sheet.*: the material /Looks/Above is bound above it, stronger"):
        MeasureWriter(tmp_path / "out.usdc", source.mesh, {"a": "vertex"}, "a", source=source)


def test_without_colours_the_look_stays(tmp_path):
    source = over_artist(tmp_path)
    path = measure(tmp_path / "out.usda", source.mesh, source, coloured=None, directions=None)
    _stage, prim = animated_prim(path)
    assert not prim.GetChild("DisplayColour") and not UsdGeom.Gprim(prim).GetDoubleSidedAttr().HasAuthoredValue()
    assert not prim.GetAttribute("primvars:displayColor").HasAuthoredValue()
    own = measure(tmp_path / "own.usda", Mesh.grid(3, 3), coloured=None, directions=None)
    _own_stage, prim = animated_prim(own)
    assert len(prim.GetAttribute("primvars:displayColor").Get()) == 1
    assert validate(path, source.path) == validate(own) == []


@pytest.mark.parametrize("single_file", [False, True], ids=["chunks", "one"])
def test_measures_of_a_measured_stage(tmp_path, single_file):
    """Other measures stay, those of the same name are replaced, and the motion is that of the first file."""
    motion = over_result(tmp_path)
    first = measure(tmp_path / "measured.usdc", motion.mesh, motion, single_file=single_file)
    source = read_stage_mesh(first)
    with MeasureWriter(tmp_path / "again.usdc", source.mesh, {"stretch1": "uniform"}, source=source) as writer:
        writer.append(3.5, {"stretch1": np.full(24, 7.0)})
        writer.close(single_file=single_file)
    assert FrameSequence(writer.path, attribute="primvars:stretch1").time_codes.tolist() == [3.5]
    assert np.asarray(FrameSequence(writer.path, attribute="primvars:stretch1")).tolist() == [[7.0] * 24]
    for name in ("primvars:warpcloth:turn", "points"):
        before, after = FrameSequence(first, attribute=name), FrameSequence(writer.path, attribute=name)
        np.testing.assert_array_equal(before, after)
    # Twice with all: the prims that it adds are there already, and are its own.
    again = measure(tmp_path / "all.usdc", source.mesh, source, single_file=single_file, sign=-1.0)
    assert FrameSequence(again, attribute="primvars:stretch1")[1][0] == -100.0
    assert validate(again) == []


def test_the_whole_may_be_moved(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "out").mkdir()
    source = over_artist(folder)
    measure(folder / "out" / "measured.usdc", source.mesh, source)
    shutil.move(folder, tmp_path / "there")
    moved = FrameSequence(tmp_path / "there" / "out" / "measured.usdc", attribute="primvars:stretch1")
    assert np.isnan(moved[1]).sum() == 2 and len(moved) == len(CODES)


def test_edits_of_another_source_of_the_mesh_are_seen(tmp_path):
    """Sources are read as they are on disk now, not as an earlier run of this process knew them."""
    source = over_root(tmp_path)
    stage, mesh = define_mesh(tmp_path / "b.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("strain", Sdf.ValueTypeNames.Double).Set(1.0)
    stage.Save()
    os.replace(tmp_path / "b.usda", source.path)
    with pytest.raises(ValueError, match=r"primvars:strain has type double, must be float\[\] or not be there"):
        MeasureWriter(tmp_path / "out.usdc", source.mesh, {"strain": "vertex"}, source=source)


# ----------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"directions": {"ball": "vertex"}}, "/Sheet_ball: is Sphere in the source, must be free for"),
        ({"coloured": "a"}, "/Sheet/DisplayColour: is Scope in the source, must be free for a Material"),
        ({"output": "a.usda"}, "a file of the source's stage; it must be another file"),
        ({"mesh": Mesh.grid(3, 3)}, "a.usda, prim /Sheet: has 6 vertices, must have as many as the mesh, 9"),
        ({"primvars": {"displayColor": "vertex"}, "coloured": "displayColor"}, "'displayColor' has a meaning already"),
        ({"primvars": {"a": "faceVarying"}}, "primvars.'a'. is 'faceVarying'; it must be 'vertex' or 'uniform'"),
        ({"coloured": "b"}, "coloured is 'b'; it must be one of 'a', or None"),
        ({"directions": {"axis 1": "vertex"}}, "directions: 'axis 1' must be a name such as principal1"),
        ({"directions": {"axis": "face"}}, "directions.'axis'. is 'face'; it must be 'vertex' or 'uniform'"),
        ({"directions": {"axis": "uniform"}, "mesh": Mesh.chain(3)}, "is 'uniform'; it must be 'vertex'"),
        ({"chunk": 0}, "chunk is 0; it must be a whole number"),
        ({"fps": np.nan}, "fps is nan; it must be positive and finite"),
        ({"up_axis": "X"}, "up_axis is 'X'"),
        ({"metadata": {"legend": {"low": None}}}, r"metadata\['legend'\]\['low'\] is None; it must be a number, a text"),
        ({"metadata": {"levels": [1, 2]}}, r"metadata\['levels'\] is \[1, 2\]; it must be a number, a text"),
        ({"source": "instanced.usda"}, "is part of an instance"),
        ({"output": "nowhere/out.usdc", "source": None}, "nowhere does not exist"),
    ],
)
def test_bad_options_are_refused(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    stage, _ = define_mesh("a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    UsdGeom.Sphere.Define(stage, "/Sheet_ball")
    if options == {"coloured": "a"}:
        UsdGeom.Scope.Define(stage, "/Sheet/DisplayColour")
    stage.Save()
    artist_stage("artist.usda")
    instance = 'def Xform "Copy" (\n    instanceable = true\n    references = @./artist.usda@\n)\n{\n}\n'
    Path("instanced.usda").write_text(f"#usda 1.0\n{instance}")
    source = read_stage_mesh(options.get("source") or "a.usda")
    given = {"output": "out.usda", "mesh": source.mesh, "primvars": {"a": "vertex"}, "source": source} | options
    given["source"] = given["source"] and source
    with pytest.raises(FileNotFoundError if "exist" in message else ValueError, match=message):
        MeasureWriter(**given)
    assert sorted(os.listdir()) == ["a.usda", "artist.usda", "instanced.usda"]


GOOD = np.arange(9.0)
THREE = np.zeros((9, 3))
NOT_FINITE = np.where(np.arange(9) == 7, np.nan, 0.0)[:, None] + THREE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time_code": 1}, "time_code is 1 at frame 1; it must be finite and after the one before"),
        ({"time_code": np.nan}, "time_code is nan at frame 1"),
        ({"primvars": {}}, "primvars: none at frame 1, must be 'a'"),
        ({"primvars": {"a": GOOD[:8]}}, r"primvars\['a'\]: shape \(8,\) at frame 1, must be \(9,\)"),
        ({"primvars": {"a": np.where(GOOD == 7, np.inf, GOOD)}}, r"\['a'\]: inf at frame 1, vertex 7, must be .* or NaN"),
        ({"primvars": {"a": np.where(GOOD == 7, 1e39, GOOD)}}, r"\['a'\]: 1e\+39 at frame 1, vertex 7, must be finite in"),
        ({"colours": None}, "colours: must be given with each frame"),
        ({"colours": THREE[:, :2]}, r"colours: shape \(9, 2\) at frame 1"),
        ({"colours": NOT_FINITE}, "colours: .*nan.* at frame 1, vertex 7, must be finite in float32$"),
        ({"points": None}, "points: must be given with each frame"),
        ({"points": NOT_FINITE}, "points: .*nan.* at frame 1, vertex 7, must be finite in float32$"),
        ({"directions": None}, "directions: none at frame 1, must be 'axis'"),
        ({"directions": {"axis": (THREE, THREE[1:])}}, r"vectors of directions\['axis'\]: shape \(8, 3\) at frame 1"),
        ({"directions": {"axis": (THREE + np.inf, THREE)}}, r"centres of directions\['axis'\]: .* vertex 0, must be finite"),
    ],
)
def test_bad_frames_are_refused(tmp_path, change, message):
    options = {"coloured": "a", "directions": {"axis": "vertex"}}
    writer = MeasureWriter(tmp_path / "a.usda", Mesh.grid(3, 3), {"a": "vertex"}, **options)
    good = {"primvars": {"a": GOOD}, "colours": THREE, "directions": {"axis": (THREE, THREE)}, "points": THREE}
    writer.append(1, **good)
    with pytest.raises(ValueError, match=message):
        writer.append(**{"time_code": 2, **good, **change})
    writer.close()
    assert FrameSequence(writer.path, attribute="primvars:a").time_codes.tolist() == [1]
    with pytest.raises(ValueError, match="is closed"):
        writer.append(2, **good)


def test_what_the_writer_has_not_is_not_given(tmp_path):
    source = over_root(tmp_path)
    writer = MeasureWriter(tmp_path / "out.usda", source.mesh, {}, source=source)
    for given, message in (
        ({"colours": np.zeros((6, 3))}, "colours: must be left out, this writer has none"),
        ({"points": np.zeros((6, 3))}, "points: must be left out, this writer has none"),
        ({"directions": {"axis": (0, 0)}}, "directions: 'axis' at frame 0, must be none"),
    ):
        with pytest.raises(ValueError, match=message):
            writer.append(0, {}, **given)


# ------------------------------------------------------------------------------------------------------------ kills


@pytest.mark.parametrize("step", range(10))
def test_every_rename_may_be_the_last(tmp_path, monkeypatch, step):
    """As for animations: an earlier result, or the new one as far as it got. Here samples of three prims."""
    source, output = over_artist(tmp_path), tmp_path / "out.usdc"
    measure(output, source.mesh, source, sign=-1.0, single_file=True)
    full_from(step, monkeypatch, once=False)
    with suppress(OSError):
        measure(output, source.mesh, source, single_file=True)
    now = FrameSequence(output, attribute="primvars:stretch1")
    # Renames: the rest, the manifest, then of each of three chunks the frames and the root; two more for one file.
    earlier = step <= 3
    assert len(now) == (7 if earlier or step > 7 else CHUNK * ((step - 2) // 2))
    for frame, values in enumerate(now):
        np.testing.assert_array_equal(values, np.float32(measured(source.mesh, frame, -1.0 if earlier else 1.0)[0]["stretch1"]))
    stage, prim = animated_prim(output)
    assert len(stage.GetPrimAtPath(f"{prim.GetPath()}_corner").GetAttribute("points").GetTimeSamples()) == len(now)


def test_a_layer_for_which_the_disk_has_no_room_is_named(tmp_path):
    path, layer = tmp_path / "a.usdc", Sdf.Layer.CreateAnonymous(".usdc")
    Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, "/A"), "x", Sdf.ValueTypeNames.FloatArray)
    layer.GetAttributeAtPath("/A.x").default = Vt.FloatArray.FromNumpy(np.random.default_rng(0).random(100_000, np.float32))
    with room_for(10_000), pytest.raises(OSError, match=re.escape(f"{path}: could not be written")) as raised:
        export(layer, path)
    assert "pxrInternal" not in str(raised.value) and not path.exists()
