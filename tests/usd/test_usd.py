"""USD files: what is read and what is written."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import warp.examples
from pxr import Gf, Sdf, Usd, UsdGeom

from support.stages import (
    CHUNK,
    FRAMES,
    PENTAGON,
    PENTAGON_AND_TRIANGLE,
    animated_prim,
    artist_stage,
    define_mesh,
    measures,
    motion,
    net,
    sphere,
    write,
)
from support.usd_validation import validate
from warpcloth.mesh.mesh import Mesh
from warpcloth.usd import AnimationWriter, FrameSequence, read_mesh, read_stage_mesh

EPS = np.finfo(np.float32).eps
SQUARE_CLOTH = os.path.join(warp.examples.get_asset_directory(), "square_cloth.usd")
SAMPLED = {"points", "velocities", "normals", "extent"}


def plain(folder):
    mesh = Mesh.grid(5, 4, size=(1.0, 0.7))
    return mesh, {"pins": {"corners": mesh.corners(), "row": [0, 1, 2]}, "metadata": {"solver": "none", "dt": 0.01}}


def chain(folder):
    return Mesh.chain(7, length=1.3), {"pins": {"top": [0]}}


def over(source, mesh=None):
    return mesh or read_mesh(source), {"source": source}


def over_net(folder):
    mesh, options = net(folder)
    return over(write(folder / "net.usda", mesh, single_file=True, **options), mesh)


SHEET = Mesh.grid(5, 4)
CASES = {  # what makes the mesh and the options in a folder, and endings of results, * for one file
    "plain": (plain, "usda usdc usd usda* usdc* usd* usdz*"),
    "chain": (chain, "usdc usdz*"),
    "net": (net, "usda usdc*"),
    "artist": (lambda folder: over(artist_stage(folder / "a.usda")), "usda usdc* usdz*"),
    "animated": (lambda folder: over(artist_stage(folder / "a.usda", animated=True)), "usdc usdc*"),
    "mirrored": (lambda folder: over(artist_stage(folder / "a.usda", sphere(), "leftHanded", (-1, 2, 1))), "usdc"),
    "package": (lambda folder: over(write(folder / "package.usdz", SHEET), SHEET), "usda usdc*"),
    "result": (lambda folder: over(write(folder / "first.usda", SHEET, frames=2 * FRAMES, sign=-1.0), SHEET), "usdc usdc*"),
    "over net": (over_net, "usda"),
    "square cloth": (lambda folder: over(SQUARE_CLOTH), "usda usdc*"),
}
ENDINGS = [("usdc", False), ("usda", False), ("usdc", True), ("usda", True), ("usdz", True)]
each_ending = pytest.mark.parametrize(("ending", "single_file"), ENDINGS)
each_way = pytest.mark.parametrize("single_file", [False, True], ids=["chunks", "one"])


@pytest.fixture(
    scope="module", params=[f"{name} {ending}" for name, (_, endings) in CASES.items() for ending in endings.split()]
)
def result(request, tmp_path_factory):
    """A written animation: (path, mesh, options, the file alone)."""
    name, _, how = request.param.rpartition(" ")
    folder, ending, single_file = tmp_path_factory.mktemp("usd"), how.strip("*"), how.endswith("*")
    mesh, options = CASES[name][0](folder)
    options["primvars"] = {"turn": "vertex", "warpcloth:strain": "uniform"} if len(mesh.triangles) else {"turn": "vertex"}
    path = write(folder / f"result.{ending}", mesh, single_file=single_file, **options)
    return path, mesh, options, single_file


def test_frames_come_back_in_metres_and_world_space(result):
    path, mesh, _, _ = result
    transform = read_stage_mesh(path).transform
    linear = transform[:3, :3]
    for attribute, part in (("points", 0), ("velocities", 1)):
        sequence = FrameSequence(path, attribute=attribute)
        assert sequence.shape == (FRAMES, len(mesh.points), 3) and sequence.dtype == np.float32
        for frame, values in enumerate(sequence):
            expected = motion(mesh, frame)[part]
            local = (expected - (transform[3, :3] if part == 0 else 0)) @ np.linalg.inv(linear)
            # Rounded once in the prim's own units, which the transform scales, and once in metres.
            tolerance = EPS * (np.abs(local).max() * np.linalg.norm(linear, 2) + np.abs(expected).max())
            np.testing.assert_allclose(values, expected, rtol=0, atol=tolerance)
        np.testing.assert_allclose(sequence.times, np.arange(FRAMES) / 24, atol=1e-12)


def test_primvars_come_back(result):
    path, mesh, options, _ = result
    _stage, prim = animated_prim(path)
    for name, interpolation in options["primvars"].items():
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        assert (primvar.GetInterpolation(), primvar.GetTypeName()) == (interpolation, Sdf.ValueTypeNames.FloatArray)
        assert primvar.GetAttr().GetTimeSamples() == prim.GetAttribute("points").GetTimeSamples()
        sequence = FrameSequence(path, attribute=f"primvars:{name}", scale=0.5)
        expected = [0.5 * measures(mesh, frame, options["primvars"])[name] for frame in range(FRAMES)]
        assert sequence.ndim == 2 and sequence.shape == np.shape(expected)
        np.testing.assert_array_equal(sequence, np.float32(expected))
        np.testing.assert_array_equal(sequence[1:3, 4], np.float32(expected)[1:3, 4])


def test_primvars_over_polygons_and_over_others_of_their_name(tmp_path):
    """A face has the mean of its triangles; what the artist has under the same name is not seen, its indices and sizes too."""
    stage, mesh = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    old = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("strain", Sdf.ValueTypeNames.FloatArray, "faceVarying", 3)
    old.Set([1.0, 2.0, 3.0])
    old.SetIndices([0] * 8)
    stage.SetDefaultPrim(mesh.GetPrim())
    stage.Save()
    cloth = read_mesh(tmp_path / "a.usda")
    primvars = {"strain": "uniform"}
    for ending in ("usdc", "usdz"):
        path = write(tmp_path / f"out.{ending}", cloth, source=tmp_path / "a.usda", primvars=primvars)
        _stage, prim = animated_prim(path)
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("strain")
        assert primvar.GetInterpolation() == "uniform" and not primvar.IsIndexed() and primvar.Get() is None
        assert list(primvar.ComputeFlattened(2)) == [201.0, 203.0] and primvar.GetElementSize() == 1
        assert validate(path, tmp_path / "a.usda") == []
        assert FrameSequence(path, attribute="primvars:strain")[1].tolist() == [101.0, 103.0]


def test_what_a_layer_over_a_prim_cannot_be(tmp_path):
    """USD takes the type of an attribute from its strongest opinion and calls the others wrong; triangles are the prim's."""
    stage, mesh = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("strain", Sdf.ValueTypeNames.Double).Set(1.0)
    stage.Save()
    cloth = read_mesh(tmp_path / "a.usda")
    with pytest.raises(ValueError, match=r"primvars:strain has type double, must be float\[\] or not be there"):
        AnimationWriter(tmp_path / "out.usdc", cloth, 24, source=tmp_path / "a.usda", primvars={"strain": "vertex"})
    other = Mesh(cloth.points, cloth.triangles[:, ::-1])
    with pytest.raises(ValueError, match="has other triangles than the mesh"):
        AnimationWriter(tmp_path / "out.usdc", other, 24, source=tmp_path / "a.usda")


@pytest.mark.parametrize("replaced", [2, 3, 4, 5, 6])
def test_an_interrupted_chunk_is_written_again(tmp_path, monkeypatch, replaced):
    """Whichever rename of a run is interrupted, closing leaves all frames that were appended."""
    mesh = Mesh.grid(3, 3)
    real, calls = os.replace, []

    def replace(*paths):
        calls.append(paths)
        if len(calls) == replaced:
            raise KeyboardInterrupt
        real(*paths)

    monkeypatch.setattr(os, "replace", replace)
    writer = AnimationWriter(tmp_path / "out.usdc", mesh, 24, chunk=2)
    appended = 0
    with pytest.raises(KeyboardInterrupt):
        for frame in range(6):
            appended += 1
            writer.append(mesh.points + frame, np.zeros_like(mesh.points))
    writer.close()
    assert len(FrameSequence(tmp_path / "out.usdc")) == appended


@pytest.mark.parametrize(
    ("attribute", "message"),
    [
        ("points", "points have no time samples"),
        ("normals", 'must be "points", "velocities" or a primvar'),
        ("primvars:turn", "primvars:turn have no time samples"),
        ("primvars:colour", r"primvars:colour has type color3f\[\], must be float\[\]"),
    ],
)
def test_what_a_sequence_cannot_read(tmp_path, attribute, message):
    stage, mesh = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("colour", Sdf.ValueTypeNames.Color3fArray).Set([Gf.Vec3f(1)], 3)
    stage.Save()
    with pytest.raises(ValueError, match=message):
        FrameSequence(tmp_path / "a.usda", attribute=attribute)


def test_rest_shape_is_the_default_and_the_validators_pass(result):
    path, mesh, options, _ = result
    again = read_stage_mesh(path)
    span = max(np.abs(mesh.points).max(), np.linalg.norm(again.transform[3]))
    np.testing.assert_allclose(again.mesh.points, mesh.points, rtol=0, atol=4 * EPS * span)
    np.testing.assert_array_equal(again.mesh.triangles, mesh.triangles)
    np.testing.assert_array_equal(again.mesh.edges, mesh.edges)
    for name, vertices in options.get("pins", {}).items():
        np.testing.assert_array_equal(again.pins[name], np.unique(vertices))
    assert validate(path, options.get("source")) == []


def test_time_codes_and_samples(result):
    path, _, options, _ = result
    stage, prim = animated_prim(path)
    start = 0.0
    if "source" in options:
        source = Sdf.Layer.FindOrOpen(options["source"])
        start = source.startTimeCode if source.HasStartTimeCode() else 0.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (start, start + FRAMES - 1)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24
    for name in SAMPLED - ({"normals"} if prim.IsA(UsdGeom.BasisCurves) else set()):
        assert prim.GetAttribute(name).GetTimeSamples() == [start + frame for frame in range(FRAMES)], name
    # Frames between two samples, those at the seams of chunks too, and the last frame held after the end.
    points = prim.GetAttribute("points")
    for frame in range(FRAMES - 1):
        both = [np.array(points.Get(start + f)) for f in (frame, frame + 1)]
        size = np.abs(both).max()
        np.testing.assert_allclose(points.Get(start + frame + 0.5), sum(both) / 2, rtol=0, atol=2 * EPS * size)
    np.testing.assert_array_equal(points.Get(start + FRAMES + 5), points.Get(start + FRAMES - 1))
    np.testing.assert_array_equal(points.Get(start - 5), points.Get(start))


def test_extent_bounds_the_points(result):
    path, _, _, _ = result
    _stage, prim = animated_prim(path)
    widths = UsdGeom.Curves(prim).GetWidthsAttr().Get() if prim.IsA(UsdGeom.Curves) else [0.0]
    for code in [Usd.TimeCode.Default(), *prim.GetAttribute("points").GetTimeSamples()]:
        points = np.array(prim.GetAttribute("points").Get(code))
        extent = np.array(prim.GetAttribute("extent").Get(code))
        tolerance = 2 * EPS * np.abs(points).max()
        np.testing.assert_allclose(extent[0], points.min(0) - max(widths) / 2, rtol=0, atol=tolerance)
        np.testing.assert_allclose(extent[1], points.max(0) + max(widths) / 2, rtol=0, atol=tolerance)


def test_normals_are_unit_at_vertices(result):
    path, mesh, _, _ = result
    _stage, prim = animated_prim(path)
    if prim.IsA(UsdGeom.BasisCurves):
        assert not prim.GetAttribute("normals").HasAuthoredValue()
        return
    assert UsdGeom.PointBased(prim).GetNormalsInterpolation() == "vertex"
    assert UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get() == "none"
    assert not UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals").HasValue(), "would be used instead of normals"
    for code in [Usd.TimeCode.Default(), *prim.GetAttribute("normals").GetTimeSamples()]:
        normals = np.array(prim.GetAttribute("normals").Get(code))
        assert len(normals) == len(mesh.points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=4 * EPS)


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 2, 1)])
def test_normals_point_to_the_front(tmp_path, orientation, scale):
    """The faces say which side is the front: a left-handed sphere of the same faces is inside out."""
    ball = sphere()
    source = artist_stage(tmp_path / "artist.usda", ball, orientation, scale)
    path = write(tmp_path / "out.usdc", read_mesh(source), source=source)
    _stage, prim = animated_prim(path)
    front = 1 if orientation == "rightHanded" else -1
    for code in (Usd.TimeCode.Default(), 104):
        points, normals = (np.array(prim.GetAttribute(name).Get(code)) for name in ("points", "normals"))
        a, b, c = points[ball.triangles].swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        assert (front * np.einsum("tki,ti->tk", normals[ball.triangles], across) > 0).all()
    # Read back, triangle normals are the front in world space, mirrored or not.
    mesh = read_mesh(path)
    corners = mesh.points[mesh.triangles] - mesh.points.mean(axis=0)
    assert np.sign(np.linalg.det(corners)).tolist() == [front] * len(mesh.triangles)


def test_scene_has_what_viewers_need(tmp_path):
    mesh, options = plain(tmp_path)
    stage, prim = animated_prim(write(tmp_path / "a.usda", mesh, **options))
    assert stage.GetDefaultPrim().GetPath() == "/World" and prim.GetPath() == "/World/Cloth"
    assert stage.GetPrimAtPath("/World/Looks").GetTypeName() == "Scope"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.HasAuthoredMetadata("kilogramsPerUnit")
    cloth = UsdGeom.Mesh(prim)
    assert cloth.GetDoubleSidedAttr().Get() and cloth.GetOrientationAttr().Get() == "rightHanded"
    assert cloth.GetDisplayColorAttr().Get() and not cloth.GetFaceVertexIndicesAttr().GetNumTimeSamples()
    np.testing.assert_allclose(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get(), mesh.texture_coordinates, atol=EPS)
    assert UsdGeom.Subset(prim.GetChild("row")).GetFamilyNameAttr().Get() == "pins"
    assert stage.GetRootLayer().customLayerData["warpcloth"] == {"prim": "/World/Cloth", "solver": "none", "dt": 0.01}


@each_way
def test_layer_leaves_the_source_alone(tmp_path, single_file):
    source = artist_stage(tmp_path / "artist.usda", animated=True)
    before = Path(source).read_bytes()
    output = tmp_path / "shots" / "shot.usda"
    output.parent.mkdir()
    write(output, read_mesh(source), source=source, single_file=single_file)
    assert Path(source).read_bytes() == before
    stage = Usd.Stage.Open(str(output))
    assert stage.GetPrimAtPath("/Set/Ball").GetAttribute("xformOp:translate").Get(149) == Gf.Vec3d(48, 0, 0)
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (0.01, "Z")
    assert stage.GetDefaultPrim().GetPath() == "/Set"
    assert str(tmp_path) not in stage.GetRootLayer().ExportToString(), "paths of other files must be relative"
    if single_file:
        assert not list(output.parent.glob("*_frames")) and not stage.GetRootLayer().subLayerPaths
        return
    own = set()
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        if layer.realPath != source:
            paths = []
            layer.Traverse("/", paths.append)
            own |= {str(path) for path in paths if path.IsPropertyPath()}
    allowed = {*SAMPLED, "subdivisionScheme", "primvars:normals"}
    assert own <= {f"/Set/Group/Sheet.{name}" for name in allowed}
    # The whole may be moved, as long as it stays together.
    shutil.copytree(tmp_path, tmp_path.parent / f"{tmp_path.name}-moved")
    Path(source).rename(tmp_path / "elsewhere.usda")
    shutil.rmtree(output.parent)
    moved = FrameSequence(tmp_path.parent / f"{tmp_path.name}-moved" / "shots" / "shot.usda")
    assert moved.shape[0] == FRAMES and np.isfinite(moved[-1]).all()


@each_way
def test_other_rates_stay_in_step_with_the_source(tmp_path, single_file):
    source = artist_stage(tmp_path / "artist.usda")
    path = write(tmp_path / "out.usdc", read_mesh(source), fps=48, source=source, single_file=single_file)
    stage, _ = animated_prim(path)
    # Time code 101 of 24 a second is the same moment as 202 of 48; the ball is half-way at 125, so at 250.
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (202, 202 + FRAMES - 1)
    assert stage.GetPrimAtPath("/Set/Ball").GetAttribute("xformOp:translate").Get(250) == Gf.Vec3d(24, 0, 0)


def test_nothing_of_an_earlier_run_is_left(tmp_path):
    mesh = Mesh.grid(5, 4)
    output = tmp_path / "out.usdc"
    write(output, mesh, frames=30, sign=-1.0)
    kept = FrameSequence(output)  # keeps the earlier result's layers in pxr's memory
    write(tmp_path / "out.usda", mesh, frames=4)  # another output whose folder has the same name
    with AnimationWriter(output, mesh, 24, chunk=CHUNK) as writer:
        for frame in range(FRAMES):
            writer.append(*motion(mesh, frame))
            earlier = frame < CHUNK - 1
            now = FrameSequence(output)
            assert len(now) == (30 if earlier else (frame + 1) // CHUNK * CHUNK)
            expected = motion(mesh, 2, sign=-1.0 if earlier else 1.0)[0]
            np.testing.assert_allclose(now[2], expected, atol=4 * EPS)
    assert len(FrameSequence(output)) == FRAMES and len(kept) == 30
    assert len(list((tmp_path / "out_frames").glob("usdc-*"))) == 1
    assert len(FrameSequence(tmp_path / "out.usda")) == 4


@each_ending
@pytest.mark.parametrize("frames", [FRAMES, 4])
def test_frames_of_two_runs_are_never_mixed(tmp_path, ending, single_file, frames):
    mesh, output = Mesh.grid(5, 4), tmp_path / f"out.{ending}"
    earlier = FrameSequence(write(output, mesh, single_file=single_file))
    assert len(earlier[:2]) == 2
    again = write(output, mesh, frames=frames, sign=-1.0, single_file=single_file)
    for read in (np.asarray, lambda sequence: sequence[0], lambda sequence: next(iter(sequence))):
        with pytest.raises(RuntimeError, match=f"out.{ending}: has been written again since these frames were opened; open it"):
            read(earlier)
    np.testing.assert_allclose(FrameSequence(again)[-1], motion(mesh, frames - 1, sign=-1.0)[0], atol=4 * EPS)


@pytest.mark.parametrize("there", [True, False], ids=["to a file", "to no file yet"])
@each_ending
def test_a_link_is_followed(tmp_path, ending, single_file, there):
    mesh, shelf = Mesh.grid(5, 4), tmp_path / "shelf"
    shelf.mkdir()
    target, link, second = shelf / f"real.{ending}", tmp_path / f"link.{ending}", tmp_path / f"second.{ending}"
    if there:
        write(target, mesh, sign=-1.0, single_file=single_file)
    link.symlink_to(target)
    second.symlink_to(link.name)
    path = write(second, mesh, single_file=single_file)
    assert link.is_symlink() and second.is_symlink() and path == str(target)
    assert sorted(os.listdir(tmp_path)) == sorted(["shelf", link.name, second.name])
    assert sorted(os.listdir(shelf)) == [target.name] + ([] if single_file else ["real_frames"])
    for name in (target, link, second):
        np.testing.assert_allclose(FrameSequence(name)[3], motion(mesh, 3)[0], atol=4 * EPS)
    assert validate(target) == []


def test_frames_that_were_opened_outlive_their_file(tmp_path):
    mesh = Mesh.grid(5, 4)
    sequence = FrameSequence(write(tmp_path / "out.usdc", mesh))
    expected = np.asarray(sequence)
    for path in tmp_path.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    np.testing.assert_array_equal(sequence, expected)


@pytest.mark.parametrize("ending", ["usda", "usdz"])
def test_an_error_keeps_the_frames_before_it_and_no_frames_write_nothing(tmp_path, ending):
    mesh = Mesh.grid(5, 4)
    with pytest.raises(RuntimeError), AnimationWriter(tmp_path / f"out.{ending}", mesh, 24, chunk=CHUNK) as writer:
        for frame in range(5):
            writer.append(*motion(mesh, frame))
        raise RuntimeError("diverged")
    assert len(FrameSequence(writer.path)) == 5
    assert validate(writer.path) == []
    (tmp_path / "none").mkdir()
    write(tmp_path / "none" / "out.usdz", mesh, frames=0)
    assert list((tmp_path / "none").iterdir()) == []


def test_sequence_behaves_as_an_array(tmp_path):
    mesh = Mesh.grid(5, 4)
    sequence = FrameSequence(write(tmp_path / "out.usdc", mesh))
    whole = np.asarray(sequence)
    assert whole.shape == sequence.shape and whole.dtype == np.float32 and sequence.ndim == 3
    for key in ((), 0, -1, slice(2, 7, 2), slice(None, None, -1), [1, 3], (2, 5), (slice(1, 3), 4, 0), (..., 1), np.int64(3)):
        np.testing.assert_array_equal(sequence[key], whole[key])
    with pytest.raises(IndexError):
        sequence[FRAMES]
    assert np.array(sequence, dtype=np.float64).dtype == np.float64


# ---------------------------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({}, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [1, 5, 2]]),
        ({"orientation": "leftHanded"}, [[2, 1, 0], [3, 2, 0], [4, 3, 0], [2, 5, 1]]),
    ],
)
def test_polygons_become_fans(tmp_path, attributes, expected):
    stage, _ = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE, **attributes)
    stage.Save()
    mesh = read_mesh(tmp_path / "a.usda")
    np.testing.assert_array_equal(mesh.triangles, expected)
    np.testing.assert_array_equal(mesh.points, PENTAGON)


def test_stage_is_read_with_its_surroundings(tmp_path):
    source = artist_stage(tmp_path / "artist.usda")
    read = read_stage_mesh(source, "Sheet")
    assert (read.prim, read.meters_per_unit, read.up_axis) == ("/Set/Group/Sheet", 0.01, "Z")
    assert (read.fps, read.time_codes_per_second, read.start) == (24, 24, 101)
    assert read.pins["hem"].tolist() == [0, 1, 2]
    stage = Usd.Stage.Open(source)
    world = UsdGeom.Imageable(stage.GetPrimAtPath(read.prim)).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    for point, rest in zip(read.mesh.points, Mesh.grid(5, 4).points, strict=True):
        expected = 0.01 * np.array(world.Transform(Gf.Vec3d(*map(float, np.float32(100 * rest)))))
        np.testing.assert_allclose(point, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("seam", [False, True])
def test_corner_texture_coordinates_are_read_where_each_vertex_has_one(tmp_path, seam):
    stage, mesh = define_mesh(tmp_path / "a.usda", PENTAGON, *PENTAGON_AND_TRIANGLE)
    st = np.array(PENTAGON)[PENTAGON_AND_TRIANGLE[1], :2] / 10
    if seam:
        st[5] += 0.5
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    primvar.Set([Gf.Vec2f(*map(float, pair)) for pair in st])
    stage.Save()
    read = read_stage_mesh(tmp_path / "a.usda")
    if seam:
        corners = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [5, 6, 7]]  # of the fan, and of the triangle
        np.testing.assert_allclose(read.mesh.texture_coordinates, st[corners], atol=EPS)
    else:
        np.testing.assert_allclose(read.mesh.texture_coordinates, np.array(PENTAGON)[:, :2] / 10, atol=EPS)


def test_samples_alone_are_read_with_a_warning(tmp_path):
    stage, mesh = define_mesh(tmp_path / "a.usda", None, *PENTAGON_AND_TRIANGLE)
    mesh.GetPointsAttr().Set(PENTAGON, 7)
    stage.Save()
    with pytest.warns(UserWarning, match="no default value; their first sample"):
        mesh = read_mesh(tmp_path / "a.usda")
    np.testing.assert_array_equal(mesh.points, PENTAGON)
    path = write(tmp_path / "out.usda", mesh, source=tmp_path / "a.usda")  # without the warning again
    np.testing.assert_array_equal(read_mesh(path).points, PENTAGON)


def test_curves(tmp_path):
    """A chain is one in its order; periodic ones are closed."""
    mesh, options = chain(tmp_path)
    _stage, prim = animated_prim(write(tmp_path / "chain.usda", mesh, **options))
    assert list(UsdGeom.BasisCurves(prim).GetCurveVertexCountsAttr().Get()) == [len(mesh.points)]
    np.testing.assert_allclose(prim.GetAttribute("points").Get(), mesh.points, atol=EPS * 1.3)
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    curves = UsdGeom.BasisCurves.Define(stage, "/Rope")
    curves.CreateTypeAttr("linear")
    curves.CreateWrapAttr("periodic")
    curves.CreatePointsAttr(PENTAGON)
    curves.CreateCurveVertexCountsAttr([3, 3])
    stage.Save()
    mesh = read_mesh(tmp_path / "a.usda")
    assert mesh.edges.tolist() == [[0, 1], [0, 2], [1, 2], [3, 4], [3, 5], [4, 5]] and len(mesh.triangles) == 0


def test_missing_textures_are_left_out_of_a_package(tmp_path):
    with pytest.warns(UserWarning, match="the package is made without it"):
        path = write(tmp_path / "a.usdz", read_mesh(SQUARE_CLOTH), source=SQUARE_CLOTH)
    assert validate(path, SQUARE_CLOTH) == []
    assert len(FrameSequence(path)) == FRAMES


# ----------------------------------------------------------------------------------------------------------- errors


MESH = 'def Mesh "Sheet"\n{{\nint[] faceVertexCounts = {}\nint[] faceVertexIndices = {}\npoint3f[] points = {}\n{}\n}}\n'
FLAT = 'float3 xformOp:scale = (1, 0, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
NO_MESH = 'def Xform "Set"\n{\ndef Sphere "Ball"\n{\n}\n}\n'
TWO = MESH.format(*PENTAGON_AND_TRIANGLE, PENTAGON, "") + 'def Mesh "Other"\n{\n}\n'


def topology(counts, indices, more=""):
    return MESH.format(counts, indices, PENTAGON, more)


@pytest.mark.parametrize(
    ("text", "prim", "message"),
    [
        (None, None, "there is no such file"),
        ("solid stl", None, "is no USD stage"),
        (NO_MESH, None, r"has no Mesh prim, only /Set.*, /Set/Ball \(Sphere\)"),
        (NO_MESH, "/Set/Ball", "prim /Set/Ball: is Sphere, must be a Mesh prim"),
        (TWO, None, "several meshes, name one of them as prim: /Sheet, /Other"),
        (TWO, "/Third", "prim /Third: there is no such prim, only /Sheet, /Other"),
        (TWO, "/Other", "prim /Other: has no points"),
        (topology(*PENTAGON_AND_TRIANGLE, FLAT), None, "must be invertible"),
        (topology([3, 3], [0, 1, 2, 3, 4]), None, "add up to 6, must be the number of indices, 5"),
        (topology([3], [0, 1, 6]), None, r"faceVertexIndices\[2\] = 6, must be a vertex, 0 to 5"),
        (topology([3], [0, 1, 1]), None, "prim /Sheet: triangles"),
        (topology([], []), None, "prim /Sheet: has no faces"),
    ],
)
def test_bad_stages_are_refused(tmp_path, text, prim, message):
    path = tmp_path / "a.usda"
    if text is not None:
        path.write_text(text if "solid" in text else f"#usda 1.0\n(\nmetersPerUnit = 1\n)\n{text}")
    with pytest.raises(ValueError if text else FileNotFoundError, match=message) as caught:
        read_mesh(path, prim)
    assert str(path) in str(caught.value)


CHAIN = {"primvars": {"turn": "uniform"}, "mesh": Mesh.chain(3)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"output": "nowhere/a.usda"}, "nowhere does not exist"),
        ({"output": "a.abc"}, "must end with one of .usd, .usda, .usdc, .usdz; 'warpcloth convert' makes .pc2"),
        ({"output": "artist.usda", "source": "artist.usda"}, "a file of the source's stage"),
        ({"output": "artist.usda", "source": "shot.usda"}, "a file of the source's stage"),
        ({"source": "missing.usda"}, "missing.usda: there is no such file"),
        ({"source": "artist.usda", "pins": {"a": [0]}}, "pins: a source has its own"),
        ({"source": "instanced.usda"}, "is part of an instance"),
        ({"source": "artist.usda", "mesh": Mesh.grid(3, 3)}, "has 20 vertices, must have as many.* 9"),
        ({"pins": {"left side": [0]}}, "pins: 'left side' must be a name"),
        ({"pins": {"left": [0, 20]}}, "0 to 20, must be whole numbers, 0 to 19"),
        ({"fps": 0}, "fps is 0; it must be positive"),
        ({"chunk": 0}, "chunk is 0; it must be a whole number, at least 1"),
        ({"up_axis": "X"}, "up_axis is 'X'"),
        ({"primvars": {"max strain": "vertex"}}, "primvars: 'max strain' must be a name such as rotationAngle"),
        ({"primvars": {"primvars:turn": "vertex"}}, "'primvars:turn' must be a name .* without primvars: before it"),
        ({"primvars": {"turn:indices": "vertex"}}, "'turn:indices' must be a name"),
        ({"primvars": {"st": "vertex"}}, "'st' has a meaning already, must be none of normals, st, displayColor"),
        ({"primvars": {"turn": "varying"}}, "primvars.'turn'. is 'varying'; it must be 'vertex' or 'uniform'"),
        (CHAIN, "is 'uniform'; it must be 'vertex' of a mesh of edges"),
        ({"prim": "/World/Cloth"}, "prim is '/World/Cloth'; it must be a name"),
        ({"output": "taken.usda"}, "taken_frames: is a file"),
        ({"output": "link.usdc"}, "output is link.usdc, a link to .*real.usda; it must end as that does"),
        ({"output": "lost.usda"}, "the folder .*lost does not exist"),
    ],
)
def test_bad_options_are_refused(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    artist_stage("artist.usda")
    Path("shot.usda").write_text("#usda 1.0\n(\n    subLayers = [@./artist.usda@]\n)\n")
    instance = 'def Xform "Copy" (\n    instanceable = true\n    references = @./artist.usda@\n)\n{\n}\n'
    Path("instanced.usda").write_text(f"#usda 1.0\n{instance}")
    Path("taken_frames").write_text("")
    Path("link.usdc").symlink_to("real.usda")
    Path("lost.usda").symlink_to("lost/real.usda")
    before = sorted(os.listdir())
    missing = message.endswith(("exist", "no such file"))
    with pytest.raises(FileNotFoundError if missing else ValueError, match=message):
        AnimationWriter(**{"output": "out.usda", "mesh": Mesh.grid(5, 4), "fps": 24, **options})
    assert sorted(os.listdir()) == before


def with_value(value, vertex):
    points = Mesh.grid(5, 4).points.copy()
    points[vertex, 1] = value
    return points


GOOD = Mesh.grid(5, 4).points


TURN, STRAIN = GOOD[:, 0], np.zeros(24)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": GOOD[:-1]}, r"points: shape \(19, 3\) at frame 1, must be \(20, 3\)"),
        ({"velocities": GOOD[:, :2]}, r"velocities: shape \(20, 2\) at frame 1"),
        ({"points": with_value(np.nan, 7)}, "points: .*nan.* at frame 1, vertex 7, must be finite"),
        ({"velocities": with_value(-np.inf, 3)}, "velocities: .*-inf.* at frame 1, vertex 3, must be finite"),
        ({"points": with_value(1e39, 0)}, "points: .* at frame 1, vertex 0, must be finite in float32"),
        (None, "primvars: none at frame 1, must be 'turn', 'strain'"),
        ({"turn": TURN, "stress": TURN}, "primvars: 'turn', 'stress' at frame 1, must be 'turn', 'strain'"),
        ({"turn": GOOD, "strain": STRAIN}, r"primvars\['turn'\]: shape \(20, 3\) at frame 1, must be \(20,\)"),
        ({"turn": with_value(np.nan, 7)[:, 1], "strain": STRAIN}, r"\['turn'\]: nan at frame 1, vertex 7, must be finite"),
        ({"turn": TURN, "strain": np.geomspace(1, 1e39, 24)}, r"\['strain'\]: 1e\+39 at frame 1, triangle 23, must be"),
    ],
)
def test_bad_frames_are_refused(tmp_path, change, message):
    declared = {"turn": "vertex", "strain": "uniform"} if change is None or "turn" in change else {}
    writer = AnimationWriter(tmp_path / "a.usda", Mesh.grid(5, 4), 24, primvars=declared)
    good = GOOD, GOOD, measures(Mesh.grid(5, 4), 0, declared)
    writer.append(*good)
    bad = {"points": GOOD, "velocities": GOOD} | ({"primvars": change} if declared else change)
    with pytest.raises(ValueError, match=message):
        writer.append(**bad)
    writer.close()
    assert len(FrameSequence(writer.path)) == 1
    with pytest.raises(ValueError, match="is closed"):
        writer.append(*good)


SMALL = [(0, 0, 0), (0.1, 0.1, 0.1)]
DAMAGES = {
    "default": lambda stage, prim: prim.GetAttribute("points").ClearDefault(),
    "extent": lambda stage, prim: [prim.GetAttribute("extent").Set(SMALL, *code) for code in ((), (3,))],
    "topology": lambda stage, prim: prim.GetAttribute("faceVertexIndices").Set([99] * 72),
    "units": lambda stage, prim: stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit"),
    "material": lambda stage, prim: stage.RemovePrim("/World/Looks/Cloth"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_the_validators_can_fail(tmp_path, damage):
    pytest.importorskip("usd_validation_nvidia", reason="part of the test extra")
    path = write(tmp_path / "a.usdc", Mesh.grid(5, 4), single_file=True)
    assert validate(path) == []
    stage, prim = animated_prim(path)
    damage(stage, prim)
    stage.Save()
    assert validate(path) != []
