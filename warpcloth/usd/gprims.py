"""Colliders as geometric primitives of a stage."""

import numpy as np

from ..scene.colliders import Box, Capsule, Plane, Sphere
from ..scene.mesh_collider import MeshCollider
from .layers import bind_material
from .modules import Gf, Tf, Usd, UsdGeom, UsdShade

_COLOUR = (0.55, 0.55, 0.6)
_SPREAD = 4.0  # of a plane, in sizes of the cloth


def define_colliders(layer, colliders, mesh):
    """Defines a prim for each collider, such as a Sphere, in a layer of :func:`.layers.scene_layer`, with its motion.

    Args:
        layer: The layer.
        colliders: Of a scene.
        mesh: The cloth, which says how much of a plane is drawn.
    """
    if not colliders:
        return
    stage = Usd.Stage.Open(layer)
    root = UsdGeom.Scope.Define(stage, "/World/Colliders").GetPath()
    material = UsdShade.Material.Get(stage, "/World/Looks/Cloth")
    for collider in colliders:
        path = root.AppendChild(Tf.MakeValidIdentifier(collider.label))
        number = 1
        while stage.GetPrimAtPath(path):
            number += 1
            path = root.AppendChild(f"{Tf.MakeValidIdentifier(collider.label)}_{number}")
        gprim = _define(stage, path, collider, mesh)
        gprim.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*_COLOUR)])
        bind_material(gprim.GetPrim(), material)
        _move(gprim, collider)


def _define(stage, path, collider, mesh):
    """The primitive about the origin, its axis along y."""
    if isinstance(collider, MeshCollider):
        return _define_mesh(stage, path, collider)
    _half, radius = collider.core
    if isinstance(collider, Sphere):
        gprim = UsdGeom.Sphere.Define(stage, path)
        gprim.CreateRadiusAttr(radius)
    elif isinstance(collider, Capsule):
        gprim = UsdGeom.Capsule.Define(stage, path)
        gprim.CreateRadiusAttr(radius)
        gprim.CreateHeightAttr(float(collider.length))
        gprim.CreateAxisAttr(UsdGeom.Tokens.y)
    elif isinstance(collider, Box):
        gprim = UsdGeom.Cube.Define(stage, path)
        gprim.CreateSizeAttr(1.0)
    elif isinstance(collider, Plane):
        gprim = UsdGeom.Plane.Define(stage, path)
        size = _SPREAD * float(np.ptp(mesh.points, axis=0).max())
        gprim.CreateWidthAttr(size)
        gprim.CreateLengthAttr(size)
        gprim.CreateAxisAttr(UsdGeom.Tokens.y)
        gprim.CreateDoubleSidedAttr(True)
    else:
        raise ValueError(f"the collider {collider.label} is a {type(collider).__name__}, which has no primitive in USD")
    gprim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(gprim, Usd.TimeCode.Default()))
    return gprim


def _define_mesh(stage, path, collider):
    """Its triangles, with a time sample of the points a frame where they deform."""
    gprim, frames = UsdGeom.Mesh.Define(stage, path), collider.frames
    gprim.CreateFaceVertexCountsAttr(np.full(len(collider.triangles), 3, np.int32))
    gprim.CreateFaceVertexIndicesAttr(collider.triangles.ravel())
    gprim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    gprim.CreateDoubleSidedAttr(not collider.closed)
    for frame, points in enumerate(frames):
        time = frame if len(frames) > 1 else Usd.TimeCode.Default()
        gprim.CreatePointsAttr().Set(points.astype(np.float32), time)
        gprim.CreateExtentAttr().Set(np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float32), time)
    return gprim


def _move(gprim, collider):
    """Its position and rotation, with a time sample a frame where it moves, and the scale of a box."""
    translate, orient = gprim.AddTranslateOp(), gprim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    poses = collider.poses
    for frame, pose in enumerate(poses):
        x, y, z, *turn, w = map(float, pose)
        time = frame if len(poses) > 1 else Usd.TimeCode.Default()
        translate.Set(Gf.Vec3d(x, y, z), time)
        orient.Set(Gf.Quatd(w, *turn), time)
    if isinstance(collider, Box):
        gprim.AddScaleOp().Set(Gf.Vec3f(*map(float, collider.size)))
