"""Writes scenes/character.usda: a figure with a skeleton that walks, in a skirt, which is the cloth.

python docs/character_stage.py
"""

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdSkel, Vt

FPS, SECONDS, SPEED = 24, 2.0, 0.7  # frames a second, s, m/s; a leg takes a step in a second
# Joints with the one above and where they are at rest [m]; the figure looks along z, y is up, and its left is x.
JOINTS = {
    "hips": (None, (0.0, 0.96, 0.0)),
    "chest": ("hips", (0.0, 1.15, 0.0)),
    "left_thigh": ("hips", (0.095, 0.9, 0.0)),
    "left_shin": ("left_thigh", (0.095, 0.5, 0.0)),
    "right_thigh": ("hips", (-0.095, 0.9, 0.0)),
    "right_shin": ("right_thigh", (-0.095, 0.5, 0.0)),
    "left_arm": ("chest", (0.235, 1.4, 0.0)),
    "right_arm": ("chest", (-0.235, 1.4, 0.0)),
}
NAMES = list(JOINTS)


def path_of(name):
    above = JOINTS[name][0]
    return name if above is None else f"{path_of(above)}/{name}"


def tube(centre, profile, around=16):
    """A closed surface about an upright axis: points (n, 3) and quads and triangles, their fronts outwards.

    Args:
        centre: x and z of the axis.
        profile: Height and half axes along x and z of each ring, from the top; the first and last are drawn to a point.
        around: Points of a ring.
    """
    angles = 2.0 * np.pi * np.arange(around) / around
    rings = [
        np.stack([centre[0] + a * np.sin(angles), np.full(around, y), centre[1] + b * np.cos(angles)], axis=1)
        for y, a, b in profile[1:-1]
    ]
    tips = [[centre[0], profile[0][0], centre[1]], [centre[0], profile[-1][0], centre[1]]]
    points = np.concatenate([*rings, tips])
    one, after = np.arange(around), np.roll(np.arange(around), -1)
    faces = []
    for ring in range(len(rings) - 1):
        up, down = ring * around, (ring + 1) * around
        faces += np.stack([up + one, down + one, down + after, up + after], axis=1).tolist()
    last, top = (len(rings) - 1) * around, len(rings) * around
    faces += [[top, a, b] for a, b in zip(one.tolist(), after.tolist(), strict=True)]
    faces += [[last + b, last + a, top + 1] for a, b in zip(one.tolist(), after.tolist(), strict=True)]
    return points, faces


def rounded(*rings, ends=(1.0, 1.0), steps=3):
    """A profile through rings (height, half axis along x, along z) with round ends, ``ends`` times as high as wide."""
    found = []
    for k, part in ((0, ends[0]), (-1, ends[1])):
        y, a, b = rings[k]
        at = 0.5 * np.pi * np.arange(1, steps + 1) / steps
        cap = [(y + (part if k == 0 else -part) * min(a, b) * np.sin(t), a * np.cos(t), b * np.cos(t)) for t in at]
        found.append(cap[::-1] if k == 0 else cap)
    return [*found[0], *rings, *found[1]]


def limb(x, *rings):
    """A profile about x with more rings between those given."""
    heights = np.array([ring[0] for ring in rings])
    more = np.linspace(heights[0], heights[-1], 3 * len(rings) + 1)
    half = np.interp(more[::-1], heights[::-1], [ring[1] for ring in rings][::-1])[::-1]
    return tube((x, 0.0), rounded(*zip(more, half, half, strict=True)))


def leg(side):
    return limb(0.095 * side, (0.92, 0.085), (0.5, 0.06), (0.08, 0.045))


def skirt(around=40, down=14, top=(1.06, 0.165, 0.125), hem=(0.56, 0.28, 0.26)):
    """Points (n, 3) and triangles of a cone without ends; the first ``around`` points are the waist."""
    angles = 2.0 * np.pi * np.arange(around) / around
    rings = []
    for part in np.linspace(0.0, 1.0, down):
        y, a, b = (1.0 - part) * np.array(top) + part * np.array(hem)
        rings.append(np.stack([a * np.sin(angles), np.full(around, y), b * np.cos(angles)], axis=1))
    one, after = np.arange(around), np.roll(np.arange(around), -1)
    faces = []
    for ring in range(down - 1):
        up, low = ring * around, (ring + 1) * around
        for k in range(around):
            quad = [up + one[k], low + one[k], low + after[k], up + after[k]]
            turned = (ring + k) % 2  # diagonals take turns, so that no direction is stiffer
            faces += [[quad[i] for i in each] for each in (((0, 1, 2), (0, 2, 3)) if turned else ((0, 1, 3), (1, 2, 3)))]
    return np.concatenate(rings), faces


def turn(angle, axis=(1.0, 0.0, 0.0)):
    half = 0.5 * np.radians(angle)
    return Gf.Quatf(float(np.cos(half)), Gf.Vec3f(*(float(np.sin(half) * each) for each in axis)))


def pose(time):
    """Rotation of each joint, and the translation of the hips [m], at a time [s]."""
    start = min(time / 0.4, 1.0)
    grown = start * start * (3.0 - 2.0 * start)  # from standing
    phase = 2.0 * np.pi * time
    found = {
        "hips": turn(6.0 * grown * np.sin(phase), (0.0, 1.0, 0.0)),
        "chest": turn(-8.0 * grown * np.sin(phase), (0.0, 1.0, 0.0)),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = grown * np.sin(phase) * sign
        found[f"{side}_thigh"] = turn(-28.0 * swing - 6.0 * grown)
        found[f"{side}_shin"] = turn(grown * (22.0 - 20.0 * np.cos(phase + 2.2 if sign > 0 else phase + np.pi + 2.2)))
        found[f"{side}_arm"] = turn(22.0 * swing)
    walked = SPEED * (time - 0.2 if time > 0.4 else 0.5 * time * time / 0.4)
    x, y, z = JOINTS["hips"][1]
    return [found[name] for name in NAMES], (x, y - 0.015 * grown * (1.0 - np.cos(2.0 * phase)), z + walked)


def write(path):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetFramesPerSecond(FPS)
    frames = round(FPS * SECONDS)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frames)
    root = UsdSkel.Root.Define(stage, "/Character")
    stage.SetDefaultPrim(root.GetPrim())

    skeleton = UsdSkel.Skeleton.Define(stage, "/Character/Skeleton")
    at = [Gf.Vec3d(*JOINTS[name][1]) for name in NAMES]
    skeleton.CreateJointsAttr([path_of(name) for name in NAMES])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d().SetTranslate(each) for each in at])
    above = [Gf.Vec3d(0.0) if JOINTS[name][0] is None else at[NAMES.index(JOINTS[name][0])] for name in NAMES]
    local = [one - other for one, other in zip(at, above, strict=True)]
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d().SetTranslate(each) for each in local])
    walk = UsdSkel.Animation.Define(stage, "/Character/Skeleton/Walk")
    walk.CreateJointsAttr([path_of(name) for name in NAMES])
    walk.CreateScalesAttr([Gf.Vec3h(1.0)] * len(NAMES))
    rotations, translations = walk.CreateRotationsAttr(), walk.CreateTranslationsAttr()
    for frame in range(frames + 1):
        turns, hips = pose(frame / FPS)
        rotations.Set(Vt.QuatfArray(turns), frame)
        translations.Set([Gf.Vec3f(*hips), *(Gf.Vec3f(*each) for each in local[1:])], frame)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([walk.GetPath()])

    def mesh(name, points, faces, joints, weights, colour):
        made = UsdGeom.Mesh.Define(stage, f"/Character/{name}")
        made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.round(points, 5).astype(np.float32)))
        made.CreateFaceVertexCountsAttr([len(face) for face in faces])
        made.CreateFaceVertexIndicesAttr([int(vertex) for face in faces for vertex in face])
        made.CreateSubdivisionSchemeAttr("none")
        made.CreateDisplayColorAttr([Gf.Vec3f(*colour)])
        binding = UsdSkel.BindingAPI.Apply(made.GetPrim())
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        if len(joints) == 1:  # with one weight for the whole mesh
            binding.CreateJointIndicesPrimvar(True, 1).Set([NAMES.index(joints[0])])
            binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
        else:
            binding.CreateJointIndicesPrimvar(False, 2).Set([NAMES.index(joint) for _ in points for joint in joints])
            binding.CreateJointWeightsPrimvar(False, 2).Set(np.round(weights, 4).ravel().tolist())
        return made.GetPrim()

    skin = (0.55, 0.42, 0.34)
    touched = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        points, faces = leg(sign)
        low = np.clip((0.56 - points[:, 1]) / 0.12, 0.0, 1.0)  # bent over 12 cm at the knee
        joints = (f"{side}_thigh", f"{side}_shin")
        touched.append(mesh(f"{side}_leg", points, faces, joints, np.stack([1.0 - low, low], axis=1), skin))
        points, faces = limb(0.235 * sign, (1.38, 0.045), (0.85, 0.035))
        mesh(f"{side}_hand", points, faces, (f"{side}_arm",), None, skin)
    pelvis = tube((0.0, 0.0), rounded((1.02, 0.155, 0.11), (0.94, 0.17, 0.12), (0.9, 0.16, 0.11), ends=(0.5, 0.5)))
    touched.append(mesh("pelvis", *pelvis, ("hips",), None, skin))
    chest = tube((0.0, 0.0), rounded((1.42, 0.165, 0.09), (1.25, 0.165, 0.11), (1.0, 0.14, 0.1), ends=(0.6, 0.2)))
    mesh("torso", *chest, ("chest",), None, (0.75, 0.73, 0.7))
    mesh("neck", *tube((0.0, 0.0), rounded((1.52, 0.05, 0.055), (1.42, 0.055, 0.06))), ("chest",), None, skin)
    mesh("head", *tube((0.0, 0.0), rounded((1.63, 0.085, 0.1), ends=(1.3, 1.5), steps=5)), ("chest",), None, skin)
    for prim in touched:
        UsdPhysics.CollisionAPI.Apply(prim)
        prim.CreateAttribute("warpcloth:friction", Sdf.ValueTypeNames.Double).Set(0.3)

    points, faces = skirt()
    cloth = mesh("Skirt", points, faces, ("hips",), None, (0.2, 0.35, 0.7))
    kinds = Sdf.ValueTypeNames
    for name, kind, value in (
        ("density", kinds.Double, 0.2),
        ("pins", kinds.IntArray, list(range(40))),
        ("contact:distance", kinds.Double, 6e-3),
        ("contact:stiffness", kinds.Double, 2e4),
        ("terms:threads:type", kinds.Token, "Spring"),
        ("terms:threads:stiffness", kinds.Double, 300.0),
        ("terms:threads:damping", kinds.Double, 0.05),
        ("terms:folds:type", kinds.Token, "QuadraticBending"),
        ("terms:folds:stiffness", kinds.Double, 2e-5),
    ):
        cloth.CreateAttribute(f"warpcloth:{name}", kind).Set(value)
    stage.GetRootLayer().Save()


if __name__ == "__main__":
    write(Path(__file__).parents[1] / "scenes" / "character.usda")
