"""Finds a cloth prim of a stage and reads it in metres and world space, with what writing needs."""

import os
import warnings

import numpy as np

from ..base.checks import shown
from ..base.types import FilePath
from ..mesh.mesh import Mesh
from ..mesh.polygons import triangles_of
from ..mesh.stage_mesh import StageMesh
from .modules import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdSkel
from .values import (
    array_of,
    check_composed,
    check_stage,
    checked_rows,
    reason_of,
    refuse_outside,
    refuse_path,
    sentences,
    time_codes_of,
    token_of,
)

# Key in the customLayerData of the root layer of an animation, which names the animated prim.
METADATA_KEY = "warpcloth"
# Metadata that USD reads from the root layer alone.
_READ_FROM_ROOTS = ("startTimeCode", "endTimeCode", "metersPerUnit", "upAxis", "kilogramsPerUnit", "customLayerData")
# Primvar of curves: the mesh vertex of each curve point, for curves repeat vertices where they meet.
VERTEX_PRIMVAR = "warpcloth:vertex"


def read_mesh(path: FilePath, prim: str | None = None, kind: type[Mesh] = Mesh) -> Mesh:
    """Reads the rest shape of a cloth.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path or name of the prim; None for the only mesh.
        kind: `Mesh` or `Surface`.

    Returns:
        Mesh: In metres and world space.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: As of `read_stage_mesh`.
    """
    return read_stage_mesh(path, prim, kind).mesh


def read_stage_mesh(path: FilePath, prim: str | None = None, kind: type[Mesh] = Mesh, time: float | None = None) -> StageMesh:
    """Reads a Mesh prim, or linear BasisCurves as an edge mesh, in metres and world space.

    The rest shape is at the default time; without default points, the first sample is read, with a warning. Holes are omitted,
    and polygons cut into triangles. Triangle normals point to the front.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path or name of the prim; None for the only mesh (or the only curves without meshes), or what an `AnimationWriter`
            animated.
        kind: `Mesh` or `Surface`.
        time: Time code of an animated transform, by default the start. If given, points without default are read at it without
            a warning.

    Returns:
        StageMesh: The mesh and its context in the stage.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a stage, or has invalid units, rates or times. The prim is missing, ambiguous, not a mesh,
            or refers to a missing file. Its transform is singular, its topology changes, a face crosses or touches itself or is
            not planar, or the `Mesh` is not valid.
    """
    found = stage_mesh(path, prim, kind, time)
    if time is None and not found.rest:
        warnings.warn(
            f"{path}, prim {found.prim}: points have no default value; their first sample is taken as the rest shape; "
            "author the rest shape as the default",
            stacklevel=2,
        )
    return found


def stage_mesh(path, prim=None, kind=Mesh, time=None):
    """Reads the same as :func:`read_stage_mesh`, without its warning."""
    with sentences(path):
        return _stage_mesh(open_stage(path), path, prim, kind, time)


def _stage_mesh(stage, path, prim, kind, time):
    found = find_prim(stage, path, prim)
    check_composed(found, path)
    where = f"{path}, prim {found.GetPath()}"
    layer = stage.GetRootLayer()
    start = stage.GetStartTimeCode() if layer.HasStartTimeCode() else None
    moving = moving_space(found) is not None
    transform = local_to_metres(found, where, (start or 0.0) if time is None and moving else time)
    point_vertices = None
    up_axis = str(UsdGeom.GetStageUpAxis(stage))
    try:
        points = placed(_rest_points(found, time), transform)
        if time is None:
            refuse_moving_topology(found)
        if found.IsA(UsdGeom.Mesh):
            corners, triangles = face_corners(found, points)
            if np.linalg.slogdet(transform[:3, :3])[0] < 0:  # the sign alone, because the determinant may overflow
                triangles = triangles[:, ::-1]
            at_vertices, at_corners = _texture_coordinates(found, len(points), corners)
            st = at_vertices if at_corners is None else at_corners[triangles]
            mesh = kind(points, corners[triangles], texture_coordinates=st, up_axis=up_axis)
        else:
            point_vertices = curve_vertices(found, len(points))
            edges = point_vertices[curve_edges(found, len(points))]
            edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0)
            mesh = kind(points[first_points(point_vertices)], edges=edges, up_axis=up_axis)
        pins = pins_of(found, point_vertices, len(points))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    rate = layer.framesPerSecond if layer.HasFramesPerSecond() else layer.timeCodesPerSecond
    return StageMesh(
        mesh=mesh,
        path=os.fspath(path),
        prim=str(found.GetPath()),
        transform=transform,
        meters_per_unit=UsdGeom.GetStageMetersPerUnit(stage),
        up_axis=up_axis,
        fps=rate if layer.HasFramesPerSecond() or layer.HasTimeCodesPerSecond() else None,
        time_codes_per_second=stage.GetTimeCodesPerSecond(),
        start=start,
        pins=pins,
        point_vertices=point_vertices,
        rest=UsdGeom.PointBased(found).GetPointsAttr().Get() is not None,
    )


def followed(path):
    """The target of a link, through all links; another path unchanged."""
    return os.path.realpath(path) if os.path.islink(path) else path


def identity(path):
    """Returns a value that changes when the file is replaced; None without a file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


def open_stage(path):
    """Opens a stage as it is on disk now.

    Returns:
        Usd.Stage: Keep a reference: without one its prims become invalid.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a USD stage, or has invalid units, rates or times.
    """
    path = os.fspath(path)
    refuse_path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"{path}: there is no such file")
    if os.path.getsize(path) == 0:
        raise ValueError(f"{path}: the file is empty")
    # pxr caches a layer that is in use, and would return the content from before the file was replaced.
    known = Sdf.Layer.Find(os.path.abspath(path))
    if known and not known.dirty:
        known.Reload()
    with sentences(path):
        try:
            stage = Usd.Stage.Open(os.path.abspath(path))
        except Tf.ErrorException as error:
            raise ValueError(f"{path}: is no USD stage ({reason_of(error)})") from None
        check_stage(stage, path)
    return stage


def find_prim(stage, path, prim=None):
    """Finds the prim of the cloth: a Mesh, or linear BasisCurves.

    ``prim`` is its path or name, or that of the Xform above; None for the only one, or what an earlier run animated.

    Raises:
        ValueError: The prim is missing or of another type, or there are several and ``prim`` is None.
    """
    prims = list(stage.Traverse(Usd.TraverseInstanceProxies()))
    meshes = [p for p in prims if p.IsA(UsdGeom.Mesh)]
    curves = [p for p in prims if p.IsA(UsdGeom.BasisCurves) and UsdGeom.BasisCurves(p).GetTypeAttr().Get() == "linear"]
    if prim is None:
        own = dict(stage.GetRootLayer().customLayerData).get(METADATA_KEY)
        prim = own.get("prim") if isinstance(own, dict) else None
    if prim is None:
        candidates = [p for p in meshes or curves if not p.HasAPI(UsdPhysics.CollisionAPI)] or meshes or curves
    else:
        candidates = [p for p in meshes + curves if _called(p, prim)]
        candidates = candidates or [p for p in meshes + curves if _called(p.GetParent(), prim)]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise ValueError(f"{path}: has several meshes, name one of them as prim: {_listed(candidates)}")
    if prim is None:
        raise ValueError(f"{path}: has no Mesh prim, only {_listed(prims, types=True) or 'an empty stage'}")
    other = next((p for p in prims if _called(p, prim)), None)
    if other:
        raise ValueError(f"{path}, prim {other.GetPath()}: is {other.GetTypeName() or 'untyped'}, must be a Mesh prim")
    raise ValueError(f"{path}, prim {prim}: there is no such prim, only {_listed(meshes + curves) or 'others, no Mesh'}")


def animated_prims(stage):
    """The cloths that an earlier run animated, if several."""
    own = dict(stage.GetRootLayer().customLayerData).get(METADATA_KEY)
    named = str(own.get("prims", "")).split() if isinstance(own, dict) else []
    return [prim for prim in map(stage.GetPrimAtPath, named) if prim]


def _called(prim, name):
    return str(name) in (str(prim.GetPath()), prim.GetName())


def _listed(prims, types=False, most=12):
    names = [f"{p.GetPath()} ({p.GetTypeName() or 'untyped'})" if types else str(p.GetPath()) for p in prims]
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def moving_space(prim):
    """The prim or ancestor with an animated transform, or None."""
    ancestor = prim
    while ancestor and not ancestor.IsPseudoRoot():
        xformable = UsdGeom.Xformable(ancestor)
        if xformable and xformable.TransformMightBeTimeVarying():
            return ancestor
        if xformable and xformable.GetResetXformStack():
            break
        ancestor = ancestor.GetParent()
    return None


def posed(stage, first, last):
    """The stage, or a copy in memory with the animated points of its skinned characters between two time codes."""
    if not any(prim.IsA(UsdSkel.Root) for prim in stage.Traverse(Usd.TraverseInstanceProxies())):
        return stage
    root, own = Sdf.Layer.CreateAnonymous(".usda"), stage.GetRootLayer()
    for name in ("timeCodesPerSecond", "framesPerSecond", *_READ_FROM_ROOTS):
        if own.pseudoRoot.HasInfo(name):
            root.pseudoRoot.SetInfo(name, own.pseudoRoot.GetInfo(name))
    root.subLayerPaths = [own.identifier]
    copy = Usd.Stage.Open(root)
    while instances := [prim for prim in copy.Traverse() if prim.IsInstance() and _has_skeleton(prim)]:
        for prim in instances:  # prims within an instance cannot be given points
            prim.SetInstanceable(False)
    for prim in list(copy.Traverse()):
        if prim.IsA(UsdSkel.Root):
            UsdSkel.BakeSkinning(UsdSkel.Root(prim), Gf.Interval(first, last))
    return copy


def _has_skeleton(prim):
    return any(each.IsA(UsdSkel.Root) for each in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))


def frame_codes(samples, surroundings, frames, fps):
    """Time codes of frames 0 to ``frames``, or to the last of the time codes ``samples``."""
    rate = surroundings.time_codes_per_second / fps
    start = surroundings.start or 0.0
    last = np.ceil((max(samples) - start) / rate * (1 - 1e-9)) if samples else 0
    return [start + frame * rate for frame in range(int(np.clip(last, 0, frames)) + 1)]


def space_codes(prim):
    """Sorted time codes of transforms of a prim and its ancestors."""
    codes, ancestor = set(), prim
    while ancestor and not ancestor.IsPseudoRoot():
        xformable = UsdGeom.Xformable(ancestor)
        if xformable:
            for operation in xformable.GetOrderedXformOps():
                codes.update(time_codes_of(operation.GetAttr()))
            if xformable.GetResetXformStack():
                break
        ancestor = ancestor.GetParent()
    return sorted(codes)


def local_to_metres(prim, where, time=None, shrinks=False):
    """The transform (4, 4), for row vectors, from the space and units of a prim to world space [m], at a time code or constant.

    Raises:
        ValueError: The transform is animated without ``time``, not affine, not finite or, without ``shrinks``, singular.
    """
    where = f"{where}: " if where else ""
    moving = moving_space(prim) if time is None else None
    if moving:
        raise ValueError(f"{where}the transform of {moving.GetPath()} is animated, must be fixed for a cloth")
    # A transform with one sample is constant, but has no value at the default time.
    code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time)
    matrix = np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(code))
    if not np.isfinite(matrix).all() or (matrix[:, 3] != [0, 0, 0, 1]).any():
        raise ValueError(f"{where}the transform to world space is {matrix.tolist()}, must be affine and finite")
    if not (np.linalg.matrix_rank(matrix[:3, :3]) == 3 or (shrinks and not matrix[:3, :3].any())):
        raise ValueError(f"{where}the transform to world space is {matrix.tolist()}, must be invertible")
    matrix[:, :3] *= UsdGeom.GetStageMetersPerUnit(prim.GetStage())
    return matrix


def placed(points, transform):
    """Points (P, 3) after a transform (4, 4)."""
    # Multiplication by the identity would spread NaN to all coordinates of a point.
    if not np.array_equal(transform[:3, :3], np.eye(3)):
        with np.errstate(invalid="ignore"):
            points = points @ transform[:3, :3]
    return points + transform[3, :3]


def carried(points, before, now):
    """Displacements (P, 3) [m] of points (P, 3) of a moving space between two transforms (4, 4)."""
    return points @ (now - before)[:3, :3] + (now - before)[3, :3]


def curve_vertices(prim, count):
    """The mesh vertex of each of ``count`` points of a curves prim, (count,) int32; without the primvar their order."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(VERTEX_PRIMVAR)
    if not (primvar and primvar.HasValue()):
        return np.arange(count, dtype=np.int32)
    vertices = checked_rows(primvar.GetName(), primvar.Get(), whole=True)
    named = np.unique(vertices)
    if len(vertices) != count or not np.array_equal(named, np.arange(len(named))):
        raise ValueError(f"primvars:{VERTEX_PRIMVAR} must name each vertex from 0 on, once for each of {count} points")
    return vertices


def first_points(point_vertices):
    """The first point of each vertex, (n,)."""
    return np.unique(point_vertices, return_index=True)[1]


def _rest_points(prim, time=None):
    """Points (P, 3) in the prim's space, at the default time, else at ``time``, else at the first sample."""
    attribute = UsdGeom.PointBased(prim).GetPointsAttr()
    codes = time_codes_of(attribute)
    points = array_of(attribute, (3,))
    if points is None and time is not None:
        points = array_of(attribute, (3,), time=time)
    elif points is None and codes:
        points = array_of(attribute, (3,), time=codes[0])
    if points is None or len(points) == 0:
        raise ValueError("has no points")
    return points.astype(np.float64)


def topology(attribute, time=None):
    """An integer array attribute at a time code or the default time, else the first sample; empty without a value."""
    found = array_of(attribute, whole=True, time=time)
    if time is None and (found is None or len(found) == 0):  # fallbacks of the schema are empty
        found = array_of(attribute, whole=True, time=Usd.TimeCode.EarliestTime())
    return np.array([], dtype=np.int32) if found is None else found


def refuse_change(name, now, fixed, code):
    """Raises ValueError with the first changed entry if an integer array has changed at a time code."""
    if len(now) != len(fixed):
        raise ValueError(f"{len(now)} {name} at time code {code:g}, must stay {len(fixed)}")
    if not np.array_equal(now, fixed):
        first = int(np.argmax(now != fixed))
        raise ValueError(f"{name}[{first}] is {now[first]} at time code {code:g}, must stay {fixed[first]}")


def refuse_moving_topology(prim):
    """Raises ValueError with the first changed entry if faces or curves change over time."""
    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        sampled = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr())
    else:
        sampled = (UsdGeom.BasisCurves(prim).GetCurveVertexCountsAttr(),)
    for attribute in sampled:
        fixed = topology(attribute)
        for code in time_codes_of(attribute):
            refuse_change(attribute.GetName(), topology(attribute, code), fixed, code)


def face_corners(prim, points, triangles_of=triangles_of):
    """Vertices (C,) int32 of face corners of a Mesh prim, and the corners of each triangle (T, 3), cut by ``triangles_of``.

    Triangles are counter-clockwise from the front in the prim's space.
    """
    mesh = UsdGeom.Mesh(prim)
    counts, corners = topology(mesh.GetFaceVertexCountsAttr()), topology(mesh.GetFaceVertexIndicesAttr())
    if len(counts) == 0:
        raise ValueError("has no faces")
    if (counts < 3).any():
        face = int(np.argmax(counts < 3))
        raise ValueError(f"face {face} has {counts[face]} corners, must have at least 3")
    if counts.sum() != len(corners):
        raise ValueError(f"faceVertexCounts add up to {counts.sum()}, must be the number of indices, {len(corners)}")
    refuse_outside("faceVertexIndices", corners, len(points), "vertex")
    found = triangles_of(points[corners], counts, np.flatnonzero(triangles_of_faces(prim) == 0))
    sides = (UsdGeom.Tokens.rightHanded, UsdGeom.Tokens.leftHanded)
    return corners, found[:, ::-1] if token_of(mesh.GetOrientationAttr(), sides) == UsdGeom.Tokens.leftHanded else found


def triangles_of_faces(prim):
    """Returns the number of triangles (F,) of each face, 0 for a hole."""
    mesh = UsdGeom.Mesh(prim)
    triangles = topology(mesh.GetFaceVertexCountsAttr()) - 2
    holes = topology(mesh.GetHoleIndicesAttr())
    refuse_outside("holeIndices", holes, len(triangles), "face")
    triangles[holes] = 0
    return triangles


def curve_edges(prim, count):
    """Pairs of points (E, 2): the segments of linear curves."""
    curves = UsdGeom.BasisCurves(prim)
    counts = topology(curves.GetCurveVertexCountsAttr())
    if (counts < 2).any():
        curve = int(np.argmax(counts < 2))
        raise ValueError(f"curveVertexCounts[{curve}] is {counts[curve]}, must be at least 2")
    if counts.sum() != count:
        raise ValueError(f"curveVertexCounts add up to {counts.sum()}, must be the number of points, {count}")
    end = np.cumsum(counts)
    inner = np.setdiff1d(np.arange(counts.sum()), end - 1)
    edges = np.stack([inner, inner + 1], axis=1)
    wraps = (UsdGeom.Tokens.nonperiodic, UsdGeom.Tokens.periodic, UsdGeom.Tokens.pinned)
    if token_of(curves.GetWrapAttr(), wraps) == UsdGeom.Tokens.periodic:
        edges = np.concatenate([edges, np.stack([end - 1, end - counts], axis=1)])
    return edges


def _texture_coordinates(prim, count, corners):
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    if not (primvar and primvar.HasValue()):
        return None, None
    st = np.array(primvar.ComputeFlattened())
    st = st.astype(np.float64) if st.dtype.kind in "iuf" else st  # with another type the check for (count, 2) below fails
    interpolation = primvar.GetInterpolation()
    if interpolation in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying) and st.shape == (count, 2):
        return st, None
    if interpolation != UsdGeom.Tokens.faceVarying or st.shape != (len(corners), 2):
        return None, None
    at_vertices = np.zeros((count, 2))
    at_vertices[corners] = st
    return (at_vertices, None) if np.array_equal(at_vertices[corners], st) else (None, st)


def pinned_points(prim, count):
    """Pinned points (p,): of GeomSubsets with the family or name "pins", and of weights ≥ ½ in `primvars:pins`.

    A subset of faces pins their corners.

    Raises:
        ValueError: A subset is not of points or faces, or the primvar changes over time or is not one number per point.
    """
    pinned = np.zeros(count, dtype=bool)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        name, kind = subset.GetPrim().GetName(), subset.GetElementTypeAttr().Get()
        if "pins" not in (name, subset.GetFamilyNameAttr().Get()):
            continue
        if kind == UsdGeom.Tokens.point:
            pinned[pins_of(prim, None, count)[name]] = True
        elif kind == UsdGeom.Tokens.face and prim.IsA(UsdGeom.Mesh):
            mesh, faces = UsdGeom.Mesh(prim), topology(subset.GetIndicesAttr())
            counts, corners = topology(mesh.GetFaceVertexCountsAttr()), topology(mesh.GetFaceVertexIndicesAttr())
            refuse_outside(f"GeomSubset {name}: indices", faces, len(counts), "face")
            pinned[corners[np.isin(np.repeat(np.arange(len(counts)), counts), faces)]] = True
        else:
            raise ValueError(f"GeomSubset {name}: elementType is {shown(str(kind))}, must be 'point' or 'face' for pins")
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("pins")
    if primvar and primvar.HasAuthoredValue():
        codes = [Usd.TimeCode.EarliestTime(), *primvar.GetTimeSamples()]
        weights = [np.array(primvar.ComputeFlattened(code)) for code in codes]
        if weights[0].dtype.kind not in "biuf" or weights[0].shape != (count,):
            raise ValueError(f"primvars:pins has shape {weights[0].shape}, must have a number for each of {count} points")
        if any(not np.array_equal(each, weights[0]) for each in weights):
            raise ValueError("primvars:pins changes over time, must have one value")
        pinned |= weights[0] >= 0.5
    return np.flatnonzero(pinned)


def pins_of(prim, point_vertices, count):
    """Sorted vertices (p,) int32 of each GeomSubset of points, by name."""
    pins = {}
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.point:
            indices, name = subset.GetIndicesAttr(), f"GeomSubset {subset.GetPrim().GetName()}: indices"
            points = topology(indices)
            for code in time_codes_of(indices):
                refuse_change(name, topology(indices, code), points, code)
            refuse_outside(name, points, count, "point")
            vertices = points if point_vertices is None else point_vertices[points]
            pins[subset.GetPrim().GetName()] = np.unique(vertices)
    return pins
