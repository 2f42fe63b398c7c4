"""Triangulated surfaces of the solids of a stage, such as Sphere prims."""

import numpy as np

from .modules import Usd


def _solid(make, *sizes):
    """Function (prim, time code or None) → the surface of a solid in the prim's space, from ``make`` (trimesh, sizes…) → the
    surface along z.
    """

    def made(prim, code=None):
        import trimesh

        code = Usd.TimeCode.EarliestTime() if code is None else code
        found = make(trimesh, *(float(prim.GetAttribute(name).Get(code)) for name in sizes))
        axis = prim.GetAttribute("axis")
        along = "XYZ".index(axis.Get() if axis and axis.Get() else "Z")
        order = [0, 1, 2]
        order[along], order[2] = 2, along
        vertices, faces = (found.vertices - found.bounds.mean(axis=0))[:, order], found.faces
        return trimesh.Trimesh(vertices, faces if along == 2 else faces[:, ::-1], process=False)  # two axes change places

    return made


def _plane(trimesh, width, length):
    corners = np.array([[0.0, 0.0, 0.0], [width, 0.0, 0.0], [width, length, 0.0], [0.0, length, 0.0]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


# By type name of the prim.
SOLIDS = {
    "Cube": _solid(lambda trimesh, size: trimesh.creation.box((size, size, size)), "size"),
    "Sphere": _solid(lambda trimesh, radius: trimesh.creation.icosphere(4, radius), "radius"),
    "Cylinder": _solid(lambda trimesh, radius, height: trimesh.creation.cylinder(radius, height, 64), "radius", "height"),
    "Capsule": _solid(lambda trimesh, radius, height: trimesh.creation.capsule(height, radius, (64, 64)), "radius", "height"),
    "Cone": _solid(lambda trimesh, radius, height: trimesh.creation.cone(radius, height, 64), "radius", "height"),
    "Plane": _solid(_plane, "width", "length"),
}
