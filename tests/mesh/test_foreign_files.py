"""Small files with the quirks of other programs: each is read rightly, or refused with the file, where in it, and why."""

import json
import re
import struct

import numpy as np
import pytest

import warpcloth as wc
from support.mesh_texts import usda

POINTS = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
V = "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 1 0 1\n"
VT = "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\n"
F = "f 1 3 2\nf 2 3 4\n"
NOTCH = "v 0 0 0\nv 2 0 0\nv 2 0 1\nv 1 0 0.5\nv 0 0 1\n"  # a pentagon of area 1.5

OBJ = {
    "blender": f"# Blender 4.2\nmtllib a.mtl\no Plane\n{V}vn 0 1 0\n{VT}s 0\nusemtl None\nf 1/1/1 3/3/1 4/4/1 2/2/1\n",
    "maya": f"g default\n{V}{VT}s off\ng pPlane1\nusemtl initialShadingGroup\nf 1/1 3/3 4/4 2/2\n",
    "3ds max": f"{V}# 4 vertices\n\ng Plane01\ns 1\nf 1 3 4 2 \n".replace("v ", "v  ").replace("\n", "\r\n"),
    "rhino": f"{V}f 1 \\\n3 4 \\\n2\n",
    "zbrush": "#MRGB ffffffff\n" + V.replace("\n", " 0.5 0.5 0.5\n") + F,
    "meshlab": f"####\n#\n# Meshlab\n#\n####\nvn 0 1 0\n{V}f 1//1 3//1 2//1\nf 2//1 3//1 4//1\n# End of File",
    "sketchup": f"{V}f -4 -2 -1 -3\n",
    "relative in between": "v 0 0 0\nv 0 0 1\nv 1 0 1\nf -3 -2 -1\nv 1 0 0\nf -4 -2 -1\n",
    "weights": V.replace("\n", " 1.0\n") + F,
    "indented": V + "f 1 3 2\n  f 2 3 4\n",
    "tabs": (V + F).replace(" ", "\t"),
    "only CR": (V + F).replace("\n", "\r"),
    "trailing comments": V + "f 1 3 2 # one\nf 2 3 4# two\n",
    "obsolete fo": V + F.replace("f", "fo"),
    "a mark of UTF-8": "\ufeff" + V + F,
    "latin-1": (f"o caf\xe9\n{V}{F}").encode("latin-1"),
    "exponents": V.replace("1 0", "1.0E+00 0e-5") + F,
    "no line break": V + F[:-1],
    "lines and points": f"{V}p 1 2\nl 1 2 3\n{F}",
    "empty slashes": f"{V}f 1/ 3/ 2/\nf 2// 3// 4//\n",
    "faces first": F + V,
    "lines among faces": f"{V}f 1 2\nf\n{F}f 4\n",
    "texture of a broken exporter": f"{V}vt nan nan\nvt -nan(ind) 0\nvt 1\nf 1/1 3/2 2/3\nf 2/3 3/9 4/0\n",
    "texture that is not there": f"{V}f 1/1/1 3/3/1 2/2/1\nf 2/99999999999999999999 3/x 4/-7\n",
    "colours and libraries": f"matlib a\nvc 1 0 0\n{V}{F}",
    "a mark of the end": f"{V}{F}\x1a",
    "a zero byte": f"{V}{F}\0",
    "UTF-16": (V + F).encode("utf-16"),
    "three texture coordinates": f"{V}{VT.replace(chr(10), ' 0' + chr(10))}f 1/1 3/3 2/2\nf 2/2 3/3 4/4\n",
}
VERTICES = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
ROWS = "0 0 0\n1 0 0\n0 0 1\n1 0 1\n"
LIST = "element face 2\nproperty list uchar int vertex_indices\n"
PLY_HEAD, PLY_ROWS = f"ply\nformat ascii 1.0\n{VERTICES}{LIST}end_header\n", f"{ROWS}3 0 2 1\n3 1 2 3\n"


def binary(order, faces=((3, 0, 2, 1), (3, 1, 2, 3)), points=POINTS):
    """A binary .ply file with st of vertices, as Blender writes it, and faces of several sizes."""
    head = f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\ncomment made by Blender\n"
    head += (
        VERTICES.replace("4", str(len(points))) + "property float s\nproperty float t\n" + LIST.replace("2", str(len(faces)))
    )
    rows = b"".join(struct.pack(f"{order}5f", *point, point[0], point[2]) for point in points)
    return f"{head}end_header\n".encode() + rows + b"".join(struct.pack(f"{order}B{len(f) - 1}i", *f) for f in faces)


HOUSE = [*POINTS, (0.5, 0, 1.5)]
PLY = {
    "ascii": PLY_HEAD + PLY_ROWS,
    "CRLF": (PLY_HEAD + PLY_ROWS).replace("\n", "\r\n"),
    "only CR": (PLY_HEAD + PLY_ROWS).replace("\n", "\r"),
    "little endian": binary("<"),
    "big endian": binary(">"),
    "a quad and a triangle": (binary("<", [(4, 0, 2, 3, 1), (3, 2, 4, 3)], HOUSE), 1.25),
    "vertex_index": PLY_HEAD.replace("indices", "index") + PLY_ROWS,
    "obj_info and blanks": PLY_HEAD.replace("ascii 1.0", "ascii 1.0 \nobj_info a scan\ncomment zipper") + PLY_ROWS + "\n\n",
    "colours": PLY_HEAD.replace("element face", "property uchar red\nelement face") + PLY_ROWS.replace("\n", " 9\n", 4),
    "edges after": PLY_HEAD.replace("end_h", "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_h")
    + PLY_ROWS
    + "0 1\n",
    "normals of a broken exporter": PLY_HEAD.replace("element face", "property float nx\nelement face")
    + PLY_ROWS.replace("\n", " -nan(ind)\n", 4),
    "colours with a point": PLY_HEAD.replace("element face", "property uchar red\nelement face")
    + PLY_ROWS.replace("\n", " 255.0\n", 4),
    "a blank after ply": PLY_HEAD.replace("ply", "ply ") + PLY_ROWS,
    "a mark of UTF-8": "\ufeff" + PLY_HEAD + PLY_ROWS,
    "lines among faces": PLY_HEAD.replace("face 2", "face 4") + f"{ROWS}2 0 1\n3 0 2 1\n0\n3 1 2 3\n",
    "lengths that are floats": binary("<", [(4, 0, 2, 3, 1)])
    .replace(b"list uchar", b"list float")
    .replace(b"\x04" + bytes(4), struct.pack("<fi", 4, 0)),
    "a list of colours": PLY_HEAD.replace("element face", "property list uchar uchar red\nelement face")
    + PLY_ROWS.replace("\n", " 1 9\n", 1).replace("\n", " 0\n", 4).replace(" 9 0\n", " 9\n"),
    "faces before vertices": f"ply\nformat ascii 1.0\n{LIST}{VERTICES}end_header\n3 0 2 1\n3 1 2 3\n{ROWS}",
    "texture of wedges": PLY_HEAD.replace("end_h", "property list uchar float texcoord\nproperty int texnumber\nend_h")
    + f"{ROWS}3 0 2 1 6 0 0 0 1 1 0 0\n3 1 2 3 6 1 0 0 1 1 1 0\n",
}
FACETS = [((0, 0, 0), (0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, 0, 1), (1, 0, 1))]


def facet(corners):
    return "facet normal 0 1 0\nouter loop\n" + "".join("vertex {} {} {}\n".format(*x) for x in corners) + "endloop\nendfacet\n"


STL_TEXT = "solid a\n" + "".join(map(facet, FACETS)) + "endsolid a\n"
STL_BYTES = struct.pack("<80sI", b"solid made by a program", 2)
STL_BYTES += b"".join(struct.pack("<12fH", 0, 1, 0, *np.ravel(facet), 0) for facet in FACETS)
STL = {
    "text": STL_TEXT,
    "capitals and blanks": STL_TEXT.upper().replace("\n", "\n\t  "),
    "two on a line": STL_TEXT.replace("endfacet\nfacet", "endfacet facet"),
    "CRLF": STL_TEXT.replace("\n", "\r\n"),
    "bytes that begin with solid": STL_BYTES,
}
OFF_ROWS = f"{ROWS}3 0 2 1\n3 1 2 3\n"
OFF = {
    "plain": f"OFF\n4 2 0\n{OFF_ROWS}",
    "counts beside the keyword": f"OFF 4 2 5\n{OFF_ROWS}",
    "no keyword": f"4 2 0\n{OFF_ROWS}",
    "no number of edges": f"OFF\n4 2\n{OFF_ROWS}",
    "colours": "COFF\n4 2 0\n" + ROWS.replace("\n", " 255 0 0 255\n") + "3 0 2 1 3 255 0 0\n3 1 2 3 0.5 0.5 0.5\n",
    "normals and colours": "NCOFF\n4 2 0\n" + ROWS.replace("\n", " 0 1 0 9 9 9\n") + "3 0 2 1\n3 1 2 3\n",
    "lines among faces": f"OFF\n4 4 0\n{ROWS}2 0 1\n3 0 2 1\n0\n3 1 2 3\n",
    "normals": "NOFF\n4 2 0\n" + ROWS.replace("\n", " 0 1 0\n") + "3 0 2 1\n3 1 2 3\n",
    "comments and blanks": f"# a square\nOFF # of two\n\n 4  2\t0\n\n{OFF_ROWS}",
    "CRLF": f"OFF\n4 2 0\n{OFF_ROWS}".replace("\n", "\r\n"),
}


def glb(indices=(0, 2, 1, 1, 2, 3), points=POINTS, mode=4, kind=5123, node=None, primitives=1, required=(), count=None):
    """A binary glTF file of one mesh; indices may be None."""
    code = {5121: "B", 5123: "H", 5125: "I"}[kind]
    data = struct.pack(f"<{3 * len(points)}f", *np.ravel(points))
    listed = b"" if indices is None else struct.pack(f"<{len(indices)}{code}", *indices)
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(data)}]
    views += [{"buffer": 0, "byteOffset": len(data), "byteLength": len(listed)}] * bool(listed)
    accessors = [{"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"}]
    accessors += [{"bufferView": 1, "componentType": kind, "count": len(indices or ()), "type": "SCALAR"}] * bool(listed)
    primitive = {"attributes": {"POSITION": 0}, "mode": mode} | ({"indices": 1} if listed else {})
    tree = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    tree |= {"nodes": [{"mesh": 0, "name": "a", **(node or {})}]}
    tree |= {"meshes": [{"primitives": [primitive] * primitives}], "accessors": accessors, "bufferViews": views}
    tree |= {"buffers": [{"byteLength": len(data + listed)}], "extensionsRequired": list(required)}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = data + listed + bytes(-len(data + listed) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body)) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(body), b"BIN\0") + body


LOOSE = [POINTS[k] for k in (0, 2, 1, 1, 2, 3)]
GLB = {
    "indices": glb(),
    "indices of a byte": glb(kind=5121),
    "no indices": glb(None, LOOSE),
    "a strip": glb((0, 2, 1, 3), mode=5),
    "a node with a scale": (glb(node={"scale": [2, 2, 2]}), 4.0),
}
QUAD = [(0, 2, 3, 1)]
USD = {
    "a quad": usda(POINTS, QUAD),
    "left-handed": usda(POINTS, [(0, 1, 3, 2)], 'uniform token orientation = "leftHanded"'),
    "a cage of a subdivision": usda(POINTS, QUAD, 'uniform token subdivisionScheme = "catmullClark"'),
    "centimetres": (usda(POINTS, QUAD).replace("metersPerUnit = 1", "metersPerUnit = 0.01"), 1e-4),
    "a hole": (usda(POINTS, [(0, 2, 1), (1, 2, 3)], "int[] holeIndices = [1]"), 0.5),
    "scaled by its transform": (
        usda(POINTS, QUAD, 'float3 xformOp:scale = (2, 2, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]'),
        4,
    ),
    "texture at corners": usda(
        POINTS, QUAD, 'texCoord2f[] primvars:st = [(0, 0), (0, 1), (1, 1), (1, 0)] (interpolation = "faceVarying")'
    ),
}
READ = [
    (f"{name}.{ending}", *(content if isinstance(content, tuple) else (content, 1.0)))
    for ending, rows in {"obj": OBJ, "ply": PLY, "stl": STL, "off": OFF, "glb": GLB, "usda": USD}.items()
    for name, content in rows.items()
] + [
    ("a notch.obj", f"{NOTCH}f 1 5 4 3 2\n", 1.5),
    ("a notch.off", "OFF 5 1 0\n" + NOTCH.replace("v ", "") + "5 4 3 2 1 0\n", 1.5),
]


@pytest.mark.parametrize(("name", "content", "area"), READ, ids=[row[0] for row in READ])
def test_read(tmp_path, name, content, area):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = wc.Mesh.load(tmp_path / name)
    assert mesh.triangle_areas.sum() == pytest.approx(area)
    corners = mesh.points[mesh.triangles]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1] > 0.0).all()
    assert len(mesh.points) == len(np.unique(mesh.points, axis=0)) and not len(mesh.isolated) == len(mesh.points)


REFUSED = [  # name, content, where in the file, why
    ("comma.obj", V.replace("v 1 0 0", "v 1,0 0,0 0,0") + F, "line 2", "has '1,0', must be a number"),
    ("underscore.obj", V.replace("v 1 0 0", "v 1_0 0 0") + F, "line 2", "has '1_0', must be a number"),
    ("underscore.off", "OFF\n4 2 0\n" + OFF_ROWS.replace("1 0 0", "1_0 0 0"), "line 4", "has '1_0', must be a number"),
    ("underscore.ply", PLY_HEAD + PLY_ROWS.replace("1 0 0", "1_0 0 0"), "line 11", "has '1_0', must be a number"),
    ("short.obj", V.replace("v 1 0 1", "v 1 0") + F, "line 4", "a vertex has 2 numbers, must have 3 or more"),
    ("pair.obj", V + "f 1 2\n", "", "has no triangles"),
    ("huge.obj", V + "f 1 3 99999999999999999999\n", "line 5", "face 1 names vertex 99999999999999999999; the file has 4"),
    ("far.obj", V + "f 1 3 2\nf 2 3 5\n", "line 6", "face 2 names vertex 5; the file has 4"),
    ("zero.obj", V + "f 0 1 2\n", "line 5", "a face names 0, must be 1 or more"),
    ("fraction.obj", V + "f 1 3 2.5\n", "line 5", "has '2.5', must be a whole number"),
    ("capital.obj", V + "f 1 3 2\nF 2 3 4\n", "line 6", "'F' is not supported"),
    ("call.obj", V + "call other.obj\n" + F, "line 5", "'call' is not supported"),
    ("pointer.obj", "version https://git-lfs.github.com/spec/v1\n", "line 1", "'version' is not supported"),
    ("page.obj", "<!DOCTYPE html>\n", "line 1", "'<!DOCTYPE' is not supported"),
    ("several.obj", f"o a\n{V}{F}o b\n{V}f 5 7 6\n", "", "has several geometries, name one of them: 'a', 'b'"),
    ("cloud.ply", f"ply\nformat ascii 1.0\n{VERTICES}end_header\n{ROWS}", "", "has no triangles"),
    ("strips.ply", PLY_HEAD.replace("face 2", "tristrips 1") + f"{ROWS}4 0 2 1 3\n", "", "faces instead of tristrips"),
    ("fraction.ply", PLY_HEAD + PLY_ROWS.replace("3 0 2 1", "3 0 2 1.0"), "line 14", "face 0 has '1.0', must be a whole"),
    ("huge.ply", PLY_HEAD + PLY_ROWS.replace("0 2 1", "0 2 99999999999999999999"), "line 14", "face 0 names vertex 999"),
    ("lists.ply", PLY_HEAD.replace("float x", "list uchar int x") + "1 " + PLY_ROWS.replace("\n", "\n1 ", 3), "", "with x, y"),
    ("negative.ply", binary("<").replace(b"uchar", b"char").replace(b"\x03", b"\xfd"), "", "face 0 has a list of -3, must be"),
    ("cut.ply", binary("<")[:-3], "", "the file ends before face 1 of the 2 that its header says"),
    ("longer.ply", binary(">") + b"more", "", "the file goes on after all vertices and faces"),
    ("far.ply", binary("<", [(3, 0, 2, 7)]), "", "face 0 names vertex 7; the file has 4"),
    ("type.ply", PLY_HEAD.replace("float x", "half x") + PLY_ROWS, "line 4", "must be a property, its type and its name"),
    ("version.ply", PLY_HEAD.replace("ascii", "utf8") + PLY_ROWS, "line 2", "must be ascii or binary_little_endian or"),
    ("quads.stl", "solid a\n" + 3 * facet(LOOSE[:4]) + "endsolid a\n", "", "4 of its 3 triangles could be read"),
    ("open.stl", STL_TEXT.replace("endsolid a\n", ""), "", "0 of its 2 triangles could be read"),
    ("cut.stl", STL_BYTES[:-1], "", "cannot be read as .stl"),
    ("only CR.stl", STL_TEXT.replace("\n", "\r"), "", "cannot be read as .stl"),
    ("4.off", f"4OFF\n4 2 0\n{OFF_ROWS}", "line 1", "is 4OFF, must be text of three dimensions"),
    ("binary.off", f"OFF BINARY\n{OFF_ROWS}", "line 1", "is OFF BINARY, must be text"),
    ("lower.off", f"off\n4 2 0\n{OFF_ROWS}", "line 1", "must be the numbers of vertices, faces and edges"),
    ("pair.off", f"OFF\n4 1 0\n{ROWS}2 0 1\n", "", "has no triangles"),
    ("huge.off", f"OFF\n4 1 0\n{ROWS}3 0 2 99999999999999999999\n", "line 7", "face 0 names vertex 99999999999999999999"),
    ("negative.off", f"OFF\n4 1 0\n{ROWS}3 0 2 -1\n", "line 7", "face 0 names vertex -1; the file has 4"),
    ("comma.off", "OFF\n4 2 0\n" + OFF_ROWS.replace("1 0 0", "1,0 0 0"), "line 4", "vertex 1 has '1,0', must be a number"),
    ("fan.glb", glb((0, 2, 3, 1), mode=6), "", "0 of its 2 triangles could be read"),
    ("draco.glb", glb(required=["KHR_draco_mesh_compression"]), "", "KHR_draco_mesh_compression"),
    ("materials.glb", glb(primitives=2), "", "has several geometries, name one of them"),
    ("cut.glb", glb()[:-9], "", "cannot be read as .glb"),
    ("pair.usda", usda(POINTS, [(0, 1)]), "prim /Sheet", "face 0 has 2 corners, must have at least 3"),
    ("empty.usda", usda([], []), "prim /Sheet", "has no points"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "where", "why"), REFUSED, ids=[row[0] for row in REFUSED])
def test_refused(tmp_path, name, content, where, why):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=f"^{re.escape(str(tmp_path / name))}.*{where}.*{re.escape(why)}") as error:
        wc.Mesh.load(tmp_path / name)
    assert "\n" not in str(error.value)


def test_curved_surfaces_beside_polygons_are_left_out_aloud(tmp_path):
    (tmp_path / "a.obj").write_text(V + "cstype bspline\ndeg 3 3\nsurf 0 1 0 1 1 2 3 4\nparm u 0 1\nend\n" + F)
    with pytest.warns(UserWarning, match="a.obj, line 7: 'surf' is left out, as only polygons are read"):
        assert len(wc.Mesh.load(tmp_path / "a.obj").triangles) == 2


TEXTURED = f"o a\n{V}{VT}f 1/1 3/3 4/4 2/2\n"
BARE = f"o b\n{V}f 5 7 8 6\n"
ST = [[0, 0], [1, 0], [0, 1], [1, 1]]


@pytest.mark.parametrize(
    ("content", "name", "st"),
    [
        (TEXTURED, None, ST),  # as many corners as vertices
        (TEXTURED + BARE, "a", ST),
        (TEXTURED + BARE, "b", None),
        (TEXTURED.replace("2/2", "2"), None, None),
        (TEXTURED.replace("vt 1 1", "vt nan nan"), None, None),
    ],
)
def test_texture_coordinates_of_objects(tmp_path, content, name, st):
    (tmp_path / "a.obj").write_text(content)
    found = wc.Mesh.load(tmp_path / "a.obj", name).texture_coordinates
    assert (None if found is None else found.tolist()) == st
