"""Reads the polygons of .ply files, text and binary."""

import re
import struct

import numpy as np

from .file_faces import faces_of, optional_number, plain_number, plain_reason, refuse_open_end, text_lines

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_TYPES |= {f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint", "float") for size in (1, 2, 4, 8)}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_NEEDED = {*"xyz", "vertex_indices", "vertex_index"}
_TEXTURES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))


def read_ply(path, data):
    """Returns the `FileFaces` of a .ply file, with texture coordinates of vertices or corners.

    Raises:
        ValueError: It is another file, rows do not match the header, or it has strips of triangles; the message has path, line
            of text and reason.
    """
    order, elements, line, at = _header(path, data)
    lines = [] if order else [text for _, text in text_lines(data.rstrip())]
    found = {}

    def where():
        return path if order else f"{path}, line {line}"

    for name, count, properties in elements:
        columns, end = _table(data, at, order, count, properties)
        rows, first = [], line + 1
        for index in range(count if columns is None else 0):
            line += 1
            try:
                if order:
                    row, end = _binary_row(data, end, order, properties)
                else:
                    row = _text_row(lines[line - 1].split(), properties)
            except (IndexError, struct.error):
                raise ValueError(
                    f"{where()}: the file ends before {name} {index} of the {count} that its header says"
                ) from None
            except ValueError as error:
                raise ValueError(f"{where()}: {name} {index} {plain_reason(error)}") from None
            rows.append(row)
        columns, at = columns or zip(*rows, strict=True), end
        found[name] = {p[0]: column for p, column in zip(properties, columns, strict=False) if name != "vertex" or not p[2]}
        if name == "face":
            of_faces = None if order else range(first, line + 1)
    more = next((f", line {k}" for k, text in enumerate(lines[line:], start=line + 1) if text.strip()), None)
    if more or (order and data[at:].strip()):
        raise ValueError(f"{path}{more or ''}: the file goes on after all vertices and faces that its header says")
    vertices, faces = found.get("vertex", {}), found.get("face", {})
    if "tristrips" in found or not {*"xyz"} <= vertices.keys():
        raise ValueError(f"{path}: its header must have vertices with x, y and z, and faces instead of tristrips")
    if not order:
        indices = any(length for _, _, length in properties)
        refuse_open_end(where(), data, lines[-1].split()[-1], len(vertices["x"]) if indices else np.inf)

    def at_vertices(names):
        return np.concatenate([np.asarray(vertices[name], dtype=np.float64).reshape(-1, 1) for name in names], axis=1)

    st, rows = None, faces.get("vertex_indices", faces.get("vertex_index", ()))
    if [2 * len(row) for row in rows] == [*map(len, faces.get("texcoord", ()))] != []:
        st = np.concatenate([np.reshape(row, (-1, 2)) for row in faces["texcoord"]]).astype(np.float64)
    read = faces_of(path, at_vertices("xyz"), rows, st, of_faces if faces else None)
    textures = (read._replace(st=at_vertices(names)[read.corners]) for names in _TEXTURES if {*names} <= vertices.keys())
    return next(textures, read)


def _header(path, data):
    """Returns the byte order (empty: text), the elements, and the header's lines and bytes.

    An element is its name, count, and of each property name, type, and for a list the type of its length.
    """
    begin = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\r|\n)", data)
    if begin is None:
        raise ValueError(f"{path}: cannot be read as .ply, it does not begin with a line ply")
    end = re.search(rb"[\r\n]end_header[ \t]*" + begin[1], data)
    if end is None:
        raise ValueError(f"{path}: its header has no end_header, the file may be cut")
    order, elements = None, []
    lines = list(text_lines(data[: end.end() - len(begin[1])]))
    for line, text in lines:
        keyword, *words = text.split() or [""]
        try:
            if keyword == "format":
                order = _ORDERS[words[0]]
            elif keyword == "element":
                elements.append((words[0], int(words[1]), []))
                if int(words[1]) < 0:
                    raise ValueError
            elif keyword == "property":
                *length, kind = (_TYPES[word] for word in words[:-1] if word != "list")
                elements[-1][2].append((words[-1], kind, *(length or [""])))
        except (ValueError, LookupError):
            allowed = {"format": " or ".join(_ORDERS), "element": "an element, its name and its count"}
            raise ValueError(
                f"{path}, line {line}: must be {allowed.get(keyword, 'a property, its type and its name')}"
            ) from None
    if order is None:
        raise ValueError(f"{path}: its header has no format")
    return order, elements, len(lines), end.end()


def _text_row(words, properties):
    row, used = [], 0
    for name, kind, length in properties:
        several = _list_length(int(words[used])) if length and used < len(words) else 1
        start, used = used + bool(length), used + bool(length) + several
        kind = int if length and kind[0] != "f" else float
        row.append([plain_number(word, kind) if name in _NEEDED else optional_number(word) for word in words[start:used]])
    if used != len(words):
        raise ValueError(f"has {len(words)} numbers, must have {used}")
    return row


def _binary_row(data, at, order, properties):
    row = []
    for _, kind, length in properties:
        several = _list_length(*struct.unpack_from(order + np.dtype(length).char, data, at)) if length else 1
        at += np.dtype(length).itemsize if length else 0
        row.append(struct.unpack_from(f"{order}{several}{np.dtype(kind).char}", data, at))
        at += several * np.dtype(kind).itemsize
    return row, at


def _list_length(number):
    if number < 0 or number % 1:
        raise ValueError(f"has a list of {number}, must be a whole number of 0 or more")
    return int(number)


def _table(data, at, order, count, properties):
    """Returns the columns of binary rows whose lists have the length of the first, and their end; else None and at."""
    try:
        first = _binary_row(data, at, order, properties)[0] if order and count else ()
        kinds = []
        for (name, kind, length), values in zip(properties, first, strict=True):
            kinds += [(f"{name} length", order + length)] * bool(length) + [(name, order + kind, (len(values),))]
        table = np.frombuffer(data, kinds, count, at)
        if all(np.ptp(table[f"{name} length"]) == 0 for name, _, length in properties if length):
            return [table[name] for name, _, _ in properties], at + table.nbytes
    except (struct.error, ValueError):  # there is no row, or the file is too short
        pass
    return None, at
