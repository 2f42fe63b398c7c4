"""Directions of elements, drawn as segments in curves beside the measured prim."""

import numpy as np

from .layers import CURVE_WIDTH, bind_material
from .modules import Gf, Sdf, Usd, UsdGeom, Vt
from .stage import local_to_metres
from .targets import Target

# The first direction is dark, the second light, so that both are visible on any colour of a map.
_COLOURS = ((0.05, 0.05, 0.05), (0.95, 0.95, 0.95))


def check_directions(directions, mesh):
    """Checks that names are allowed, and interpolations "vertex" or, with triangles, "uniform"."""
    allowed = ("vertex", "uniform") if len(mesh.triangles) else ("vertex",)
    for name, interpolation in directions.items():
        if not (isinstance(name, str) and Sdf.Path.IsValidIdentifier(name)):
            raise ValueError(f"directions: {name!r} must be a name such as principal1, of letters, digits and _")
        if interpolation not in allowed:
            raise ValueError(f"directions[{name!r}] is {interpolation!r}; it must be {' or '.join(map(repr, allowed))}")


def define_directions(stage, prim, mesh, directions, material, nowhere):
    """Defines linear BasisCurves `<prim>_<name>` beside a prim, in the stage's edit target, and returns their `Target` records.

    They are in the space of the prim's parent at its first time; ``directions`` are "vertex" or "uniform" by name.

    Raises:
        ValueError: The stage has another prim at that path.
    """
    transform = to_metres(stage, prim, Usd.TimeCode.EarliestTime())
    with np.errstate(invalid="ignore"):
        lengths = np.linalg.norm(mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]], axis=1)
    lengths = lengths[np.isfinite(lengths)]
    mean_length = lengths.mean() if len(lengths) else 1.0  # any width will do without segments
    width = float(np.float32(CURVE_WIDTH * mean_length / np.cbrt(abs(np.linalg.det(transform[:3, :3])))))
    targets = []
    for row, (name, interpolation) in enumerate(directions.items()):
        path = f"{prim}_{name}"
        refuse_taken(stage, path, "BasisCurves")
        curves = UsdGeom.BasisCurves.Define(stage, path)
        target = Target(path, np.empty((0, 3), np.int32), transform, half_width=width / 2, vectors=("points", "extent"))
        centres = mesh.points if interpolation == "vertex" else mesh.points[mesh.triangles].mean(axis=1)
        for attribute, value in target.samples({"points": segments(centres, np.zeros_like(centres), nowhere)}).items():
            curves.GetPrim().GetAttribute(attribute).Set(value)
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
        curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        curves.CreateCurveVertexCountsAttr(Vt.IntArray(len(centres), 2))
        curves.CreateWidthsAttr([width])
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        colour = Gf.Vec3f(*_COLOURS[row % len(_COLOURS)])
        curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([colour])
        bind_material(curves.GetPrim(), material)
        targets.append(target)
    return targets


def segments(centres, vectors, nowhere):
    """Returns the ends c ± v/2 (2E, 3) [m] of segments of centres c and vectors v (E, 3) [m]: of length 0 where NaN, and at
    ``nowhere`` (3,) if no centre is finite.
    """
    placed = np.isfinite(centres).all(axis=1)[:, None]
    # In the middle of the others, so that invisible segments do not enlarge the extent.
    centres = np.where(placed, centres, _middle(centres, nowhere))
    half = np.where(placed & np.isfinite(vectors).all(axis=1)[:, None], 0.5 * np.asarray(vectors), 0.0)
    return np.stack([centres - half, centres + half], axis=1).reshape(-1, 3)


def _middle(points, otherwise):
    points = points[np.isfinite(points).all(axis=1)]
    return points.mean(axis=0) if len(points) else otherwise


def to_metres(stage, prim, time):
    """Returns the transform (4, 4), for row vectors, from the space of a prim's siblings to world space [m]."""
    parent = stage.GetPrimAtPath(prim).GetParent()
    return local_to_metres(parent, f"prim {parent.GetPath()}, time code {time}", time)


def middle(mesh):
    """Returns the mean finite rest point (3,) [m], for elements without a position in any frame."""
    return _middle(mesh.points, np.zeros(3))


def refuse_taken(stage, path, kind):
    """Raises ValueError if a prim at a path is not of type ``kind``."""
    prim = stage.GetPrimAtPath(path)
    if prim and prim.GetTypeName() != kind:
        raise ValueError(f"prim {path}: is {prim.GetTypeName() or 'untyped'} in the source, must be free for a {kind}")
