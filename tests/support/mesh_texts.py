"""Texts of mesh files with polygons."""

import numpy as np


def obj(points, faces):
    return "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in _plain(points)) + "".join(f"f {_row(f, 1)}\n" for f in faces)


def off(points, faces):
    return f"OFF\n{len(points)} {len(faces)} 0\n{_rows(points, faces)}"


def ply(points, faces):
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    return f"{head}element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n{_rows(points, faces)}"


def usda(points, faces, attributes="", schemas="", before=""):
    corners = [corner for face in faces for corner in face]
    points = ", ".join(f"({x!r}, {y!r}, {z!r})" for x, y, z in _plain(points))
    return f"""#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
{before}
def Mesh "Sheet" {schemas}
{{
    int[] faceVertexCounts = {[len(face) for face in faces]}
    int[] faceVertexIndices = {corners}
    point3f[] points = [{points}]
    {attributes}
}}
"""


TEXTS = {"obj": obj, "off": off, "ply": ply, "usda": usda}


def _plain(points):
    return np.asarray(points, dtype=np.float64).tolist()


def _row(face, first=0):
    return " ".join(str(corner + first) for corner in face)


def _rows(points, faces):
    return "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in _plain(points)) + "".join(f"{len(f)} {_row(f)}\n" for f in faces)
