"""Meshes from files, by trimesh."""

import logging
import re
from pathlib import Path

import numpy as np

from .mesh import READERS, Mesh

# Options of trimesh by file ending. By default it splits vertices at texture seams and makes a mesh of each material.
ENDINGS = {
    ".obj": {"split_objects": True, "group_material": False, "skip_materials": True},
    ".ply": {"fix_texture": False, "skip_materials": True},
    ".stl": {},
    ".off": {},
    ".glb": {},
    ".gltf": {},
}
# trimesh logs the tracebacks of its errors, which Python prints unless a handler is set.
_QUIET = logging.NullHandler()
# STL shares no vertices. glTF stores a vertex once for every normal and texture coordinate.
WELDED = (".stl", ".glb", ".gltf")


def read_file(path, name=None, kind=Mesh):
    """Reads the triangle mesh in a file.

    Vertices keep the order of the file. STL and glTF repeat a vertex wherever triangles differ in normal or texture,
    which would cut the cloth: there, vertices with exactly equal points are welded into the first of them. glTF node
    transforms are applied; lengths are taken for metres. Polygons are cut into fans of triangles (x₀, xₖ, xₖ₊₁), which
    come after the file's own triangles.

    Texture coordinates are read if there is one pair for each vertex: from PLY (if faces have their own, the last counts), and
    from glTF unless welding joins vertices with different ones. They are not read from OBJ, which has them for each corner of
    each face.

    Args:
        path: An .obj, .ply, .stl, .off, .glb or .gltf file.
        name: Name of the geometry (OBJ: object; glTF: node; STL: solid), if the file has several. Vertices of the others are
            left out.
        kind: `Mesh` or `Surface`.

    Returns:
        Mesh: With float64 points.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The ending is none of those above; the file is empty, cannot be read, has no triangles or (OBJ) has
            relative indices; an ASCII .ply or an .off file does not have the rows that its header announces; it has several
            geometries and `name` is none of them; or `kind` refuses the mesh. The message begins with the path.
    """
    points, triangles, st = read_arrays(path, name)
    try:
        return kind(points, triangles, texture_coordinates=st)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


READERS.update(dict.fromkeys(ENDINGS, read_file))


def read_arrays(path, name=None):
    """Reads the arrays of a mesh, as `read_file` describes them.

    Args:
        path: As for `read_file`.
        name: As for `read_file`.

    Returns:
        Points (n, 3) float64, finite or not, triangles (T, 3) int64 and texture coordinates (n, 2) or None.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: As for `read_file`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path}: the ending must be one of {' '.join(ENDINGS)}")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the file is empty")
    # trimesh counts relative indices from the end of the file instead of from their line, and reads wrong triangles.
    if ending == ".obj" and re.search(rb"^f\s[^\n#]*-\d", path.read_bytes(), re.MULTILINE):
        raise ValueError(f"{path}: its faces have relative (negative) indices, which are not supported")
    if ending in _COUNTED:
        _COUNTED[ending](path, path.read_bytes())
    import trimesh

    logging.getLogger("trimesh").addHandler(_QUIET)
    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True, **ENDINGS[ending])
    except ModuleNotFoundError:  # chardet, which guesses the encoding of text that is not UTF-8
        raise ValueError(f"{path}: cannot be read as {ending}, it is not UTF-8") from None
    except Exception as error:  # a broken file makes trimesh raise errors of many types
        if ending == ".obj":
            _refuse_far_corner(path, path.read_bytes())
        raise ValueError(f"{path}: cannot be read as {ending}, {type(error).__name__}: {error}") from error
    found = {node: scene.graph[node] for node in scene.graph.nodes_geometry}
    found = {node: at for node, at in found.items() if len(getattr(scene.geometry[at[1]], "faces", ()))}
    if not found:
        raise ValueError(f"{path}: has no triangles")
    names = ", ".join(repr(node) for node in sorted(found, key=str))
    if name is None and len(found) > 1:
        raise ValueError(f"{path}: has several geometries, name one of them: {names}")
    if name is not None and name not in found:
        raise ValueError(f"{path}: has no geometry {name!r}, it has {names}")
    transform, geometry = found[next(iter(found)) if name is None else name]
    return _arrays(path, scene.geometry[geometry], transform, len(found) > 1)


def _check_ply(path, data):
    """Raises ValueError if the lines of an ASCII .ply file do not match its header; trimesh would read a wrong mesh."""
    head, end, body = data.partition(b"end_header")
    words = [line.split() for line in head.decode("latin-1").splitlines()]
    if ["format", "ascii"] not in [line[:2] for line in words]:
        return  # trimesh checks the size of a binary file itself
    if not end:
        raise ValueError(f"{path}: its header has no end_header, the file may be cut")
    elements = []
    for number, line in enumerate(words, start=1):
        if line[:1] == ["element"]:
            if len(line) != 3 or not line[2].isdecimal():
                raise ValueError(f"{path}, line {number}: must be an element, its name and its count")
            elements.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"] and elements:
            elements[-1][2].append(line[1] == "list" if len(line) > 1 else False)
    vertices = next((count for name, count, _ in elements if name == "vertex"), 0)
    lines = body.decode("latin-1").splitlines()[1:]  # the first entry is the rest of the header's last line
    first, row = len(words) + 2, 0
    for name, count, lists in elements:
        for index in range(count):
            where = f"{path}, line {first + row}"
            if row >= len(lines):
                raise ValueError(f"{where}: the file ends before {name} {index} of the {count} that its header says")
            numbers, needed = lines[row].split(), 0
            for several in lists:
                length = numbers[needed] if several and needed < len(numbers) else "0"
                if not length.isdecimal():
                    raise ValueError(f"{where}: {name} {index} has a list of {length}, must be a whole number of 0 or more")
                needed += 1 + int(length)
            if len(numbers) != needed:
                raise ValueError(f"{where}: {name} {index} has {len(numbers)} numbers, must have {needed}")
            row += 1
        if row == len(lines) and count:
            _refuse_open_end(f"{path}, line {first + row - 1}", data, lines[-1], vertices if any(lists) else np.inf)
    _refuse_more(path, next((first + row + index for index, line in enumerate(lines[row:]) if line.strip()), None))


def _check_off(path, data):
    """Raises ValueError if the lines of an .off file do not match its header; trimesh would read a wrong mesh."""
    lines = enumerate(data.decode("latin-1").splitlines(), start=1)
    lines = [(number, words) for number, line in lines if (words := line.partition("#")[0].split())]
    if lines and lines[0][1][0].endswith("OFF"):
        lines[0][1].pop(0)
        lines = lines if lines[0][1] else lines[1:]
    if not lines:
        raise ValueError(f"{path}: has no line with the numbers of vertices and faces")
    (number, counts), *rows = lines
    if len(counts) < 2 or not all(count.isdecimal() for count in counts[:2]):
        raise ValueError(f"{path}, line {number}: must be the numbers of vertices, faces and edges, each 0 or more")
    vertices, faces = map(int, counts[:2])
    for name, count, rows_of in (("vertex", vertices, rows[:vertices]), ("face", faces, rows[vertices : vertices + faces])):
        for index, (number, words) in enumerate(rows_of):
            needed = 3
            if name == "face":
                if not words[0].isdecimal():
                    raise ValueError(f"{path}, line {number}: face {index} has {words[0]} corners, must be a whole number")
                needed = 1 + int(words[0])
            if len(words) < needed:  # more may be a colour
                raise ValueError(f"{path}, line {number}: {name} {index} has {len(words)} numbers, must have {needed}")
        if len(rows_of) < count:
            last = rows_of[-1][0] if rows_of else number
            raise ValueError(
                f"{path}, line {last}: the file ends after {len(rows_of)} of the {count} {_PLURAL[name]} that its header says"
            )
    _refuse_more(path, next((number for number, _ in rows[vertices + faces :]), None))
    if rows and len(rows[-1][1]) <= needed:
        _refuse_open_end(f"{path}, line {rows[-1][0]}", data, rows[-1][1][-1], vertices if faces else np.inf)


def _refuse_far_corner(path, data):
    """Raises ValueError if a face of an .obj file has a vertex that the file does not have."""
    vertices = len(re.findall(rb"^v\s", data, re.MULTILINE))
    for number, corners in enumerate(re.findall(rb"^f\s([^\r\n#]*)", data, re.MULTILINE), start=1):
        far = [index for index in map(int, re.findall(rb"(?<!\S)\d+", corners)) if index > vertices]
        if far:
            raise ValueError(f"{path}: face {number} names vertex {far[0]}; the file has {vertices}")


def _refuse_more(path, line):
    """Raises ValueError if ``line``, the first line after all that the header counts, is not None."""
    if line is not None:
        raise ValueError(f"{path}, line {line}: the file goes on after all vertices and faces that its header says")


_COUNTED = {".ply": _check_ply, ".off": _check_off}
_PLURAL = {"vertex": "vertices", "face": "faces"}


def _refuse_open_end(where, data, line, most):
    """Raises ValueError if the last number has no line break after it and may be cut, as more digits would still be valid.

    The last number is an index below ``most``, which is infinite if it is no index.
    """
    last = line.split()[-1:] or [""]
    if data[-1:] not in b"\r\n" and not (last[0].isdecimal() and (int(last[0]) == 0 or 10 * int(last[0]) >= most)):
        raise ValueError(f"{where}: ends in {last[0]} without a line break, so the file may be cut; end the line with one")


def _arrays(path, geometry, transform, drop_unused):
    """Returns points, triangles and texture coordinates of a trimesh.Trimesh, as for `read_file`."""
    ending = path.suffix.lower()
    points = np.asarray(geometry.vertices, dtype=np.float64)
    triangles = np.asarray(geometry.faces, dtype=np.int64)
    if not np.array_equal(transform, np.eye(4)):
        points = points @ transform[:3, :3].T + transform[:3, 3]
        if np.linalg.slogdet(transform[:3, :3])[0] < 0:  # a reflection reverses the orientation of triangles
            triangles = triangles[:, ::-1]
    # For an OBJ, trimesh averages the *indices* of texture coordinates at a seam, which gives unrelated coordinates.
    st = None if ending == ".obj" else getattr(geometry.visual, "uv", None)
    st = None if st is None or len(st) != len(points) else np.asarray(st, dtype=np.float64)
    if triangles.min() < 0 or triangles.max() >= len(points):
        span = f"{triangles.min()} to {triangles.max()}"
        raise ValueError(f"{path}: triangles refer to vertices {span}, must be 0 to {len(points) - 1}")
    kept = np.arange(len(points))
    if drop_unused:
        kept = np.unique(triangles)
        triangles = np.searchsorted(kept, triangles)
    if ending in WELDED:
        first, group = _first_of_equals(points[kept])
        if st is not None and not np.array_equal(st[kept], st[kept][first][group]):
            st = None
        kept, triangles = kept[first], group[triangles]
    return points[kept], triangles, None if st is None else st[kept]


def _first_of_equals(points):
    """Returns the first row of each set of equal rows, in order, and for each row the index of its set."""
    order = np.lexsort(points.T)  # stable: equal rows stay in order
    new = np.concatenate([[True], (points[order][1:] != points[order][:-1]).any(axis=1)])
    first = order[new]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    group = np.empty(len(points), dtype=np.int64)
    group[order] = rank[np.cumsum(new) - 1]
    return np.sort(first), group
