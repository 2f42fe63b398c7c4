"""Meshes from files: .obj, .ply and .off, with polygons, by readers here; .stl and glTF by trimesh."""

import json
import logging
import re
from pathlib import Path

import numpy as np

from .file_faces import FileFaces
from .mesh import READERS, Mesh, Surface
from .obj_files import read_obj
from .off_files import read_off
from .ply_files import read_ply
from .seams import first_of_equals, welded

_OWN = {".obj": read_obj, ".ply": read_ply, ".off": read_off}
# STL shares no vertices. glTF stores a vertex once for every normal and texture coordinate.
WELDED = (".stl", ".glb", ".gltf")
ENDINGS = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
# trimesh logs the tracebacks of its errors, which Python prints unless a handler is set.
_QUIET = logging.NullHandler()
_COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}


def read_file(path, name=None, kind=Mesh):
    """Reads the mesh in a file, vertices in the order of the file.

    STL and glTF repeat vertices, so equal points are welded into the first; other files are welded along coinciding sides
    (seams), but not a `Surface`. glTF node transforms are applied; lengths are metres; polygons are cut as by `polygons.cut`.

    Texture coordinates (OBJ, PLY, glTF) are at vertices if each has one pair, else at corners; None unless all corners have
    them.

    Args:
        path: An .obj, .ply, .stl, .off, .glb or .gltf file.
        name: Geometry (object, node or solid), if there are several.
        kind: `Mesh` or `Surface`.

    Returns:
        Mesh: With float64 points.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The ending is unknown; the file is empty, broken, or without triangles; a face crosses or touches itself or
            is not planar; there are several geometries and no `name`; or `kind` refuses the mesh. The message begins with the
            path and line.
    """
    faces = read_faces(path, name)
    try:
        points, triangles, st = (faces if issubclass(kind, Surface) else welded(faces)).triangles()
        return kind(points, triangles, texture_coordinates=st)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


READERS.update(dict.fromkeys(ENDINGS, read_file))


def read_arrays(path, name=None):
    """Returns points, triangles and texture coordinates of a file, seams not welded."""
    faces = read_faces(path, name)
    try:
        return faces.triangles()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_faces(path, name=None):
    """Reads the `FileFaces` of a file, seams not welded."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path}: the ending must be one of {' '.join(ENDINGS)}")
    data = path.read_bytes()
    if not data:
        raise ValueError(f"{path}: the file is empty")
    if ending in WELDED:
        return _read_by_trimesh(path, data, ending, name)
    faces, objects = read_obj(path, data) if ending == ".obj" else (_OWN[ending](path, data), {})
    if not len(faces.counts):
        raise ValueError(f"{path}: has no triangles")
    chosen = _chosen(path, objects or {path.name: None}, name)
    return faces if len(objects) < 2 else _some_of(faces, objects[chosen])


def _chosen(path, geometries, name):
    names = ", ".join(repr(each) for each in sorted(geometries, key=str))
    if name is None and len(geometries) > 1:
        raise ValueError(f"{path}: has several geometries, name one of them: {names}")
    if name is not None and name not in geometries:
        raise ValueError(f"{path}: has no geometry {name!r}, it has {names}")
    return next(iter(geometries)) if name is None else name


def _some_of(faces, indices):
    chosen = np.zeros(len(faces.counts), dtype=bool)
    chosen[indices] = True
    at_corners = np.repeat(chosen, faces.counts)
    used, corners = np.unique(faces.corners[at_corners], return_inverse=True)
    st = None if faces.st is None else faces.st[at_corners]
    return FileFaces(faces.points[used], faces.counts[chosen], corners, st)


def _read_by_trimesh(path, data, ending, name):
    import trimesh

    logging.getLogger("trimesh").addHandler(_QUIET)
    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True)
    except ModuleNotFoundError:  # chardet, which guesses the encoding of text that is not UTF-8
        raise ValueError(f"{path}: cannot be read as {ending}, it is not UTF-8") from None
    except Exception as error:  # a broken file makes trimesh raise errors of many types
        raise ValueError(f"{path}: cannot be read as {ending}, {type(error).__name__}: {error}") from error
    found = {node: scene.graph[node] for node in scene.graph.nodes_geometry}
    found = {node: at for node, at in found.items() if len(getattr(scene.geometry[at[1]], "faces", ()))}
    _check_count(path, data, ending, sum(len(getattr(each, "faces", ())) for each in scene.geometry.values()))
    if not found:
        raise ValueError(f"{path}: has no triangles")
    transform, geometry = found[_chosen(path, found, name)]
    return _faces(path, scene.geometry[geometry], transform, len(found) > 1)


def _check_count(path, data, ending, loaded):
    if ending == ".stl":
        binary = len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
        written = loaded if binary else len(re.findall(rb"\bfacet\s+normal\b", data, re.IGNORECASE))
    else:
        start = 20 if ending == ".glb" else 0
        header = json.loads(data[start : start + int.from_bytes(data[12:16], "little")] if start else data)
        if lacking := _COMPRESSED & {*header.get("extensionsRequired", ())}:
            raise ValueError(f"{path}: is compressed ({', '.join(sorted(lacking))}), must be exported without compression")
        written = 0
        for primitive in (each for mesh in header.get("meshes", ()) for each in mesh["primitives"]):
            count = header["accessors"][primitive.get("indices", primitive["attributes"]["POSITION"])]["count"]
            mode = primitive.get("mode", 4)  # 4 triangles, 5 a strip, 6 a fan
            written += count // 3 if mode == 4 else count - 2 if mode in (5, 6) else 0
    if written != loaded:
        raise ValueError(f"{path}: {loaded} of its {written} triangles could be read; it is broken or not supported")


def _faces(path, geometry, transform, drop_unused):
    points, triangles = np.asarray(geometry.vertices, dtype=np.float64), np.asarray(geometry.faces, dtype=np.int64)
    if not np.array_equal(transform, np.eye(4)):
        points = points @ transform[:3, :3].T + transform[:3, 3]
        if np.linalg.slogdet(transform[:3, :3])[0] < 0:  # a reflection reverses the orientation of triangles
            triangles = triangles[:, ::-1]
    st = getattr(geometry.visual, "uv", None)
    st = None if st is None or len(st) != len(points) else np.asarray(st, dtype=np.float64)
    if triangles.min() < 0 or triangles.max() >= len(points):
        span = f"{triangles.min()} to {triangles.max()}"
        raise ValueError(f"{path}: triangles refer to vertices {span}, must be 0 to {len(points) - 1}")
    corners = triangles.ravel()
    first, group = first_of_equals(points)
    faces = FileFaces(points[first], np.full(len(triangles), 3), group[corners], None if st is None else st[corners])
    return _some_of(faces, slice(None)) if drop_unused else faces
