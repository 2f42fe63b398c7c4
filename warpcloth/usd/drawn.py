"""Everything visible in a stage: meshes, solids and linear curves, read frame by frame."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..base.checks import number
from ..mesh.polygons import loose_triangles_of
from .gprims import define_colliders
from .layers import COLOUR, CURVE_WIDTH, scene_layer
from .modules import Usd, UsdGeom, UsdPhysics, UsdShade
from .solids import SOLIDS
from .stage import (
    METADATA_KEY,
    animated_prims,
    curve_edges,
    face_corners,
    find_prim,
    local_to_metres,
    moving_space,
    open_stage,
    pinned_points,
    placed,
    posed,
    refuse_moving_topology,
)
from .values import array_of, check_composed, sentences, time_codes_of


@dataclass(frozen=True, eq=False)
class DrawnPrim:
    """A Mesh prim, a solid such as a Sphere, or linear BasisCurves.

    Attributes:
        cloth: Whether it is cloth.
        triangles: (T, 3) int32; empty for curves.
        edges: (E, 2) int32, the segments of curves; empty for a mesh.
        radius: Radius of the curves [m].
        pins: Pinned points (p,).
        colour: Base colour, linear Rec. 709; None if the stage gives none.
        points: Function (time code) → points (n, 3) [m] in world space.
        codes: Time codes of the samples of its points, or else of its transforms.
    """

    path: str
    cloth: bool
    count: int
    triangles: np.ndarray
    edges: np.ndarray
    radius: float
    pins: np.ndarray
    colour: tuple[float, float, float] | None
    points: Callable[[float], np.ndarray]
    codes: list[float]


@dataclass(frozen=True, eq=False)
class DrawnStage:
    """The drawn prims of a stage, and its time codes.

    Attributes:
        codes: Time codes of the frames (F,): of the cloth, else of its surroundings; one if nothing moves.
        stage: The stage, which keeps the prims valid.
    """

    prims: list[DrawnPrim]
    codes: np.ndarray
    rate: float
    up_axis: str
    stage: Any


def read_drawn(path, prim=None):
    """Reads all meshes, solids (in their first size) and linear curves that a stage shows, at the first frame.

    The cloth is the named prim, else what an earlier run animated, else each prim whose points move, else all. Invisible prims,
    guides, proxies and prototypes of point instancers are ignored.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a stage, shows nothing or has no such prim, or a prim is broken.
    """
    with sentences(path):
        stage = posed(open_stage(path), -np.inf, np.inf)
        own = dict(stage.GetRootLayer().customLayerData).get(METADATA_KEY)
        named = prim is not None or (isinstance(own, dict) and "prim" in own)
        chosen = [find_prim(stage, path, prim)] if named else animated_prims(stage)
        found = chosen + [each for each in _shown(stage) if each not in chosen]
        codes = {each: _codes(each) for each in found}
        moving = [each for each in found if len(codes[each]) > 1]
        moving = [each for each in moving if each.IsA(UsdGeom.PointBased)]
        moving = [each for each in moving if len(time_codes_of(UsdGeom.PointBased(each).GetPointsAttr())) > 1] or moving
        cloths = chosen or moving or [each for each in found if each.IsA(UsdGeom.PointBased)] or found
        prims = [_drawn(each, path, each in cloths, codes[each]) for each in found]
        prims = [each for each in prims if each is not None]
        if not prims:
            raise ValueError(f"{path}: shows no Mesh prim, solid or linear curves with points; there is nothing to draw")
        times = sorted({code for each in prims if each.cloth for code in each.codes})
        times = times or sorted({code for each in prims for code in each.codes}) or [0.0]
        return DrawnStage(prims, np.array(times), stage.GetTimeCodesPerSecond(), str(UsdGeom.GetStageUpAxis(stage)), stage)


def draw_colliders(scene):
    """Returns the colliders of a :class:`warpcloth.Scene` as a `DrawnStage` whose time codes are frames."""
    layer, *_rest = scene_layer(scene.mesh, None, scene.up_axis, "Cloth")
    define_colliders(layer, scene.colliders, scene.mesh)
    stage = Usd.Stage.Open(layer)
    found = [prim for prim in _shown(stage) if prim.HasAPI(UsdPhysics.CollisionAPI)]
    prims = [_drawn(prim, scene.name, False, _codes(prim)) for prim in found]
    return DrawnStage(prims, np.zeros(1), 1.0, scene.up_axis, stage)


def _shown(stage):
    walk = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    for prim in walk:
        if prim.IsA(UsdGeom.PointInstancer):
            walk.PruneChildren()
            continue
        linear = prim.IsA(UsdGeom.BasisCurves) and UsdGeom.BasisCurves(prim).GetTypeAttr().Get() == UsdGeom.Tokens.linear
        if not (linear or prim.IsA(UsdGeom.Mesh) or prim.GetTypeName() in SOLIDS):
            continue
        seen = UsdGeom.Imageable(prim)
        hidden = seen.ComputeVisibility(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible
        if not hidden and seen.ComputePurpose() not in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            yield prim


def _codes(prim):
    codes = time_codes_of(UsdGeom.PointBased(prim).GetPointsAttr()) if prim.IsA(UsdGeom.PointBased) else []
    ancestor = prim
    while not codes and ancestor and not ancestor.IsPseudoRoot():
        codes = UsdGeom.Xformable(ancestor).GetTimeSamples() if ancestor.IsA(UsdGeom.Xformable) else []
        ancestor = ancestor.GetParent()
    return list(codes)


def _drawn(prim, path, cloth, codes):
    check_composed(prim, path)
    where = f"{path}, prim {prim.GetPath()}"
    first = codes[0] if codes else Usd.TimeCode.Default()
    moving = moving_space(prim) is not None
    transform = None if moving else local_to_metres(prim, where)
    solid = SOLIDS[prim.GetTypeName()](prim) if prim.GetTypeName() in SOLIDS else None
    attribute = UsdGeom.PointBased(prim).GetPointsAttr() if solid is None else None

    def points(code, count=None):
        try:
            found = array_of(attribute, (3,), time=code) if solid is None else solid.vertices
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        number = 0 if found is None else len(found)
        if count is not None and number != count:
            raise ValueError(f"{where}: {number} points at time code {code}, must be {count} as at the first")
        if not number:
            return np.empty((0, 3))
        return placed(found.astype(np.float64), local_to_metres(prim, where, code) if moving else transform)

    start = points(first)
    if not len(start):
        if cloth:
            raise ValueError(f"{where}: has no points")
        return None
    try:
        if solid is None:
            refuse_moving_topology(prim)
        if solid is not None:
            triangles, edges, radius = np.asarray(solid.faces, np.int32), np.empty((0, 2), np.int32), 0.0
        elif prim.IsA(UsdGeom.Mesh):
            rest = start if len(codes) < 2 else array_of(attribute, (3,))
            shape = start if rest is None or len(rest) != len(start) else rest.astype(np.float64)
            corners, triangles = face_corners(prim, shape, loose_triangles_of)
            triangles, edges, radius = corners[triangles], np.empty((0, 2), np.int32), 0.0
            linear = local_to_metres(prim, where, first)[:3, :3]
            if np.linalg.slogdet(linear)[0] < 0:  # a reflection reverses the orientation of triangles
                triangles = triangles[:, ::-1]
        else:
            triangles, edges = np.empty((0, 3), np.int32), curve_edges(prim, len(start)).astype(np.int32)
            radius = _radius(prim, start, edges, local_to_metres(prim, where, first))
        pins = pinned_points(prim, len(start)) if solid is None else np.empty(0, np.int32)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    drawn = triangles, edges, radius, pins, _base_colour(prim), partial(points, count=len(start)), codes
    return DrawnPrim(str(prim.GetPath()), cloth, len(start), *drawn)


def _base_colour(prim):
    """Returns the constant base colour of a prim's material, else its displayColor; or None."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    source = material.ComputeSurfaceSource() if material else ()
    base = source[0].GetInput("diffuseColor") if source and source[0] else None
    colours = [base.Get()] if base and not base.HasConnectedSource() else UsdGeom.Gprim(prim).GetDisplayColorAttr().Get() or ()
    colour = np.array(colours[0] if len(colours) == 1 else np.nan, dtype=float)
    return None if colour.shape != (3,) or np.allclose(colour, COLOUR) else tuple(colour.clip(0.0, 1.0).tolist())


def camera_of(stage, path, name):
    """Returns a function (time code, aspect) of a Camera: position [m], direction, up direction, and lens.

    The lens is the vertical field of view [°] that shows all of the aperture, and the shift and rise of
    :class:`warpcloth.picture.camera.Camera`.

    Raises:
        ValueError: No Camera or several have that path or ``name``, or it has no perspective.
    """
    known = [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if prim.IsA(UsdGeom.Camera)]
    found = [prim for prim in known if name in (str(prim.GetPath()), prim.GetName())]
    if len(found) != 1:
        paths = ", ".join(str(prim.GetPath()) for prim in known) or "none"
        raise ValueError(f"{path}: camera is {name!r}; it must be one of its cameras, {paths}")
    prim = found[0]
    if UsdGeom.Camera(prim).GetProjectionAttr().Get() != UsdGeom.Tokens.perspective:
        raise ValueError(f"{path}, prim {prim.GetPath()}: has no perspective, must have it to be drawn from")

    def view(code, aspect):
        camera, matrix = UsdGeom.Camera(prim).GetCamera(code), local_to_metres(prim, f"{path}, prim {prim.GetPath()}", code)
        height = max(camera.verticalAperture, camera.horizontalAperture / aspect)
        for name, value in (("focalLength", camera.focalLength), ("verticalAperture", height)):
            number(f"{path}, prim {prim.GetPath()}: {name}", value, above=0.0)
        fov = np.degrees(2.0 * np.arctan(0.5 * height / camera.focalLength))
        shift, rise = camera.horizontalApertureOffset / height, camera.verticalApertureOffset / height
        return matrix[3, :3], -matrix[2, :3], matrix[1, :3], fov, shift, rise

    return view


def _radius(prim, points, edges, transform):
    widths = array_of(UsdGeom.Curves(prim).GetWidthsAttr())
    if widths is not None and len(widths) and np.isfinite(widths).all() and widths.mean() > 0.0:
        return 0.5 * float(widths.mean()) * abs(np.linalg.det(transform[:3, :3])) ** (1 / 3)
    lengths = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    return 0.5 * CURVE_WIDTH * float(lengths.mean()) if len(lengths) else 0.0
