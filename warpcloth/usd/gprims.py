"""Writes colliders as prims of a stage, with their motion and UsdPhysics schemas."""

import numpy as np

from ..scene.colliders import Box, Capsule, Plane, Sphere
from ..scene.mesh_collider import MeshCollider
from .attributes import author
from .layers import bind_material
from .modules import Gf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade
from .targets import vertex_normals

_COLOUR = (0.55, 0.55, 0.6)
_SPREAD = 4.0  # size of a drawn plane, in sizes of the cloth


def define_colliders(layer, colliders, mesh):
    """Defines a prim for each collider, with its motion, in a layer of :func:`.layers.scene_layer`.

    `colliders.read_colliders` returns the same motion and shape, bit for bit. A drawn plane is sized by the cloth ``mesh``.
    """
    if not colliders:
        return
    stage = Usd.Stage.Open(layer)
    root = UsdGeom.Scope.Define(stage, "/World/Colliders").GetPath()
    material = UsdShade.Material.Get(stage, "/World/Looks/Cloth")
    for collider in colliders:
        gprim = _define(stage, _free_path(stage, root, collider.label.rpartition("/")[2]), collider, mesh)
        gprim.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*_COLOUR)])
        bind_material(gprim.GetPrim(), material)
        _move(gprim, collider)
        _add_physics(stage, gprim.GetPrim(), collider)


def _free_path(stage, parent, name):
    name = Tf.MakeValidIdentifier(name)
    path, number = parent.AppendChild(name), 1
    while stage.GetPrimAtPath(path):
        number += 1
        path = parent.AppendChild(f"{name}_{number}")
    return path


def _define(stage, path, collider, mesh):
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
    gprim, frames = UsdGeom.Mesh.Define(stage, path), collider.frames
    gprim.CreateFaceVertexCountsAttr(np.full(len(collider.triangles), 3, np.int32))
    gprim.CreateFaceVertexIndicesAttr(collider.triangles.ravel())
    gprim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    gprim.CreateDoubleSidedAttr(not collider.closed)
    gprim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    exact = np.array_equal(frames, frames.astype(np.float32))
    times = [Usd.TimeCode.Default(), *(range(len(frames)) if len(frames) > 1 else ())]  # viewers need a default shape too
    for time, points in zip(times, (frames[0], *frames), strict=False):
        gprim.CreatePointsAttr().Set(points.astype(np.float32), time)
        gprim.CreateNormalsAttr().Set(vertex_normals(points, collider.triangles).astype(np.float32), time)
        gprim.CreateExtentAttr().Set(np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float32), time)
        if not exact:
            author(gprim.GetPrim(), "colliders.points", points, time=time)
    return gprim


def _move(gprim, collider):
    translate, orient = gprim.AddTranslateOp(), gprim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    poses = collider.poses
    for frame, pose in enumerate(poses):
        x, y, z, *turn, w = map(float, pose)
        time = frame if len(poses) > 1 else Usd.TimeCode.Default()
        translate.Set(Gf.Vec3d(x, y, z), time)
        orient.Set(Gf.Quatd(w, *turn), time)
    if isinstance(collider, Box):
        gprim.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, collider.size)))


def _add_physics(stage, prim, collider):
    UsdPhysics.CollisionAPI.Apply(prim)
    if prim.IsA(UsdGeom.Mesh):
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(UsdPhysics.Tokens.none)
    if collider.moves:
        UsdPhysics.RigidBodyAPI.Apply(prim).CreateKinematicEnabledAttr(True)
    author(prim, "colliders.name", collider.name or "")
    if collider.friction:
        looks = stage.GetPrimAtPath("/World/Looks").GetPath()
        material = UsdShade.Material.Define(stage, _free_path(stage, looks, f"{prim.GetName()}Physics"))
        physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        physics.CreateStaticFrictionAttr(float(collider.friction))
        physics.CreateDynamicFrictionAttr(float(collider.friction))
        UsdShade.MaterialBindingAPI(prim).Bind(material, materialPurpose="physics")
        if collider.friction != float(np.float32(collider.friction)):
            author(prim, "colliders.friction", collider.friction)
