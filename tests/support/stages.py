"""Stages of artists and of this package, whose numbers tell the frame, the vertex and the run that they belong to."""

import os
from itertools import count

import numpy as np
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from warpcloth.mesh.mesh import Mesh
from warpcloth.usd import AnimationWriter, MeasureWriter

FRAMES = 8
CHUNK = 3


def motion(mesh, frame, sign=1.0):
    """Points [m] and velocities [m/s] that tell the frame, the vertex and the run that they belong to."""
    vertex = np.arange(len(mesh.points))[:, None]
    points = mesh.points + sign * frame * np.array([0.01, -0.02, 0.03]) + 1e-3 * np.sin(vertex + frame)
    return points, sign * np.stack([np.full(len(vertex), frame), vertex[:, 0] / len(vertex), -0.5 + vertex[:, 0] % 3], 1)


def measures(mesh, frame, primvars):
    """Values of primvars that tell the frame and the vertex or triangle that they belong to."""
    counts = {"vertex": len(mesh.points), "uniform": len(mesh.triangles)}
    return {name: 100.0 * frame + np.arange(counts[interpolation]) for name, interpolation in primvars.items()}


def write(output, mesh, frames=FRAMES, fps=24, single_file=False, sign=1.0, **options):
    """Writes some frames, and returns the path of the result."""
    with AnimationWriter(output, mesh, fps, **{"chunk": CHUNK, **options}) as writer:
        for frame in range(frames):
            writer.append(*motion(mesh, frame, sign), measures(mesh, frame, options.get("primvars", {})))
        writer.close(single_file=single_file)
    return writer.path


def sphere():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    return Mesh(ball.vertices, ball.faces)


def artist_stage(path, mesh=None, orientation="rightHanded", scale=(1, 1, 1), animated=False):
    """A stage in cm, z up, 24 fps from time code 101: the cloth turned and moved, one animated prim beside it."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(24)
    stage.SetFramesPerSecond(24)
    stage.SetStartTimeCode(101)
    stage.SetEndTimeCode(500)
    world = UsdGeom.Xform.Define(stage, "/Set")
    stage.SetDefaultPrim(world.GetPrim())
    group = UsdGeom.Xform.Define(stage, "/Set/Group")
    group.AddTranslateOp().Set(Gf.Vec3d(30, -20, 150))
    group.AddRotateXYZOp().Set(Gf.Vec3f(20, 40, 70))
    group.AddScaleOp().Set(Gf.Vec3f(*scale))
    mesh = mesh or Mesh.grid(5, 4)
    points = Vt.Vec3fArray.FromNumpy(np.float32(100 * mesh.points))
    cloth = UsdGeom.Mesh.Define(stage, "/Set/Group/Sheet")
    cloth.CreatePointsAttr(points)
    cloth.CreateFaceVertexCountsAttr([3] * len(mesh.triangles))
    cloth.CreateFaceVertexIndicesAttr(np.array(mesh.triangles).reshape(-1))
    cloth.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    cloth.CreateOrientationAttr(orientation)
    # What an artist's mesh may carry, and must not be seen on the animated one.
    corners = UsdGeom.PrimvarsAPI(cloth).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "faceVarying")
    corners.Set([Gf.Vec3f(0, 1, 0)] * mesh.triangles.size)
    if animated:
        for code in (101, 110):
            cloth.GetPointsAttr().Set(Vt.Vec3fArray([Gf.Vec3f(code)] * len(points)), code)
    UsdGeom.Subset.CreateGeomSubset(cloth, "hem", "point", [0, 1, 2], "pins", "unrestricted")
    ball = UsdGeom.Sphere.Define(stage, "/Set/Ball")
    ball.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    ball.AddTranslateOp().Set(Gf.Vec3d(0), 101)
    ball.GetPrim().GetAttribute("xformOp:translate").Set(Gf.Vec3d(48, 0, 0), 149)
    stage.Save()
    return str(path)


def net(folder):
    grid = Mesh.grid(4, 3)
    return Mesh(np.concatenate([grid.points, [[3, 0, 0]]]), edges=grid.edges), {"pins": {"some": [1, 5, 11]}}


def animated_prim(path):
    """The stage, which has to be kept, and the prim in it."""
    stage = Usd.Stage.Open(str(path))
    return stage, stage.GetPrimAtPath(stage.GetRootLayer().customLayerData["warpcloth"]["prim"])


def define_mesh(path, points, counts, indices, **attributes):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/Sheet")
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(counts)
    mesh.CreateFaceVertexIndicesAttr(indices)
    for name, value in attributes.items():
        mesh.GetPrim().GetAttribute(name).Set(value)
    return stage, mesh


PENTAGON = [(0, 0, 0), (2, 0, 0), (3, 1, 0), (1, 3, 0), (-1, 1, 0), (5, 0, 0)]
PENTAGON_AND_TRIANGLE = ([5, 3], [0, 1, 2, 3, 4, 1, 5, 2])


def anonymous_memory():
    """Bytes of this process that are no file's pages; those the system can drop at any time."""
    with open("/proc/self/status") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("RssAnon:"))


# At no constant distance, and none of them 0, where float noise would hide; the third is a sample of no artist.
CODES = (101.0, 102.5, 103.0 + 1 / 3, 104.0, 110.0, 111.3, 112.0)
DIRECTIONS = {"principal1": "uniform", "corner": "vertex"}


def measured(mesh, frame, sign=1.0):
    """Arguments of `append`, with values that tell the frame and the element; element `frame` and the last have none."""
    n, count = len(mesh.points), len(mesh.triangles)
    element = np.arange(count or n, dtype=np.float64)
    stretch = sign * (100.0 * frame + element)
    stretch[[frame, -1]] = np.nan
    primvars = {"stretch1": stretch, "warpcloth:turn": sign * (frame + np.arange(n) / 7)}
    colours = np.stack([element / len(element), np.full(len(element), frame / 10), np.where(np.isnan(stretch), 1, 0)], 1)
    return primvars, colours


def segments_of(mesh, frame):
    """Centres and vectors [m] of the directions: an element without a vector, one without a centre, one without both."""
    moved = mesh.points + 0.01 * frame
    centres = {"uniform": moved[mesh.triangles].mean(axis=1), "vertex": moved}
    directions = {}
    for name, interpolation in DIRECTIONS.items():
        centre = centres[interpolation]
        vector = 0.1 * np.stack([np.cos(np.arange(len(centre)) + frame), np.sin(np.arange(len(centre))), centre[:, 0]], 1)
        vector[2], vector[4], centre[4:6] = (np.nan, 0.1, 0.1), np.nan, np.nan
        directions[name] = centre, vector
    return directions


def measure(output, mesh, source=None, codes=CODES, single_file=False, sign=1.0, **options):
    """Writes measures of some frames, and returns the path of the result."""
    own = {"stretch1": "uniform" if len(mesh.triangles) else "vertex", "warpcloth:turn": "vertex"}
    options = {"coloured": "stretch1", "directions": DIRECTIONS if len(mesh.triangles) else None, "chunk": CHUNK, **options}
    with MeasureWriter(output, mesh, own, source=source, **options) as writer:
        for frame, code in enumerate(codes):
            primvars, colours = measured(mesh, frame, sign)
            points = None if source else mesh.points + 0.01 * frame
            directions = segments_of(mesh, frame) if options["directions"] else None
            writer.append(code, primvars, colours if options["coloured"] else None, directions, points)
        writer.close(single_file=single_file)
    return writer.path


def full_from(step, monkeypatch, once=True):
    """Lets the rename of that number fail, and those after it too unless ``once``, as where a disk is full."""
    steps, rename = count(), os.replace

    def replace(*paths):
        now = next(steps)
        if now == step or (now > step and not once):
            raise OSError("no space left on device")
        rename(*paths)

    monkeypatch.setattr(os, "replace", replace)
