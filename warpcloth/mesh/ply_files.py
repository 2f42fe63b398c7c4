"""Reads the polygons of .ply files, text and binary."""

import re
import struct

import numpy as np

from .file_faces import faces_of, plain_reason, refuse_open_end, text_lines

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_TYPES |= {f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint", "float") for size in (1, 2, 4, 8)}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TEXTURES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))


def read_ply(path, data):
    """Returns the `FileFaces` of a .ply file in bytes, with texture coordinates of vertices or of corners.

    Raises:
        ValueError: It is no .ply file, its rows do not match the header, or it has strips of triangles. The message has the
            path, for text the line, and the reason.
    """
    order, elements, head, start = _header(path, data)
    body = _Binary(data, start, order) if order else _Text(data, head)
    found, lines = {}, {}
    for name, count, properties in elements:
        columns, lines[name] = body.table(count, properties), []
        rows = []
        for index in range(count if columns is None else 0):
            try:
                body.begin()
                rows.append([body.take(kind, body.take(length, 1)[0] if length else 1) for _, kind, length in properties])
                body.end()
            except (EOFError, struct.error):
                of = f"{name} {index} of the {count} that its header says"
                raise ValueError(f"{path}{body.where}: the file ends before {of}") from None
            except ValueError as error:
                raise ValueError(f"{path}{body.where}: {name} {index} {plain_reason(error)}") from None
            lines[name].append(body.line)
        columns = columns or list(zip(*rows, strict=True)) or [()] * len(properties)
        found[name] = {key: column for (key, _, _), column in zip(properties, columns, strict=True)}
    if (line := body.beyond()) is not None:
        raise ValueError(f"{path}{line}: the file goes on after all vertices and faces that its header says")
    vertices, faces = found.get("vertex", {}), found.get("face", {})
    if not order and rows:
        is_index = any(length for _, _, length in properties)
        refuse_open_end(f"{path}{body.where}", data, body.words[-1], len(lines.get("vertex", ())) if is_index else np.inf)
    if "tristrips" in found or not {*"xyz"} <= vertices.keys():
        raise ValueError(f"{path}: its header must have vertices with x, y and z, and faces instead of tristrips")

    def at_vertices(names):
        return np.concatenate([np.reshape(vertices[name], (-1, 1)) for name in names], axis=1).astype(np.float64)

    st = next((at_vertices(names) for names in _TEXTURES if {*names} <= vertices.keys()), None)
    rows = faces.get("vertex_indices", faces.get("vertex_index", ()))
    if st is None and [2 * len(row) for row in rows] == [*map(len, faces.get("texcoord", ()))] != []:
        st = np.concatenate([np.reshape(row, (-1, 2)) for row in faces["texcoord"]]).astype(np.float64)
    return faces_of(path, at_vertices("xyz"), rows, st, None if order else lines.get("face"))


def _header(path, data):
    """Returns the order of bytes, empty for text, the elements, the number of lines of the header, and its number of bytes.

    An element is its name, its count, and of each property the name, the type, and for a list the type of its length.
    """
    line_break = b"\r\n" if data[3:5] == b"\r\n" else data[3:4]
    if data[:3] != b"ply" or not line_break.isspace():
        raise ValueError(f"{path}: cannot be read as .ply, it does not begin with a line ply")
    end = re.search(rb"[\r\n]end_header[ \t]*" + line_break, data)
    if end is None:
        raise ValueError(f"{path}: its header has no end_header, the file may be cut")
    order, elements = None, []
    lines = list(text_lines(data[: end.end() - len(line_break)]))
    for line, text in lines:
        keyword, *words = text.split() or [""]
        where = f"{path}, line {line}"
        if keyword == "format":
            order = _ORDERS.get(" ".join(words[:1]))
            if order is None:
                raise ValueError(f"{where}: the format is {' '.join(words)}, must be one of {', '.join(_ORDERS)}")
        elif keyword == "element":
            if len(words) != 2 or not words[1].isdecimal():
                raise ValueError(f"{where}: must be an element, its name and its count")
            elements.append((words[0], int(words[1]), []))
        elif keyword == "property":
            *lengths, kind = [_TYPES.get(word) for word in words[:-1] if word != "list"] or [None]
            if not elements or None in (*lengths, kind) or len(lengths) != words.count("list"):
                raise ValueError(f"{where}: must be a property of an element, its type and its name")
            elements[-1][2].append((words[-1], kind, "".join(lengths)))
    if order is None:
        raise ValueError(f"{path}: its header has no format")
    return order, elements, len(lines), end.end()


class _Text:
    """Reads rows of text, one for each line, after the ``line`` lines of the header."""

    def __init__(self, data, line):
        self._lines, self.line = [text for _, text in text_lines(data.rstrip())], line

    @property
    def where(self):
        return f", line {self.line}"

    def table(self, count, properties):
        """Returns None, as there are no columns before the rows are read."""

    def begin(self):
        self.line += 1
        if self.line > len(self._lines):
            raise EOFError
        self.words, self._used = self._lines[self.line - 1].split(), 0

    def take(self, kind, several):
        self._used += several
        if several < 0:
            raise ValueError(f"has a list of {several}, must be a whole number of 0 or more")
        if self._used > len(self.words):
            raise ValueError(f"has {len(self.words)} numbers, must have {self._used}")
        return [*map(float if kind[0] == "f" else int, self.words[self._used - several : self._used])]

    def end(self):
        if self._used < len(self.words):
            raise ValueError(f"has {len(self.words)} numbers, must have {self._used}")

    def beyond(self):
        """Returns where the file goes on, or None."""
        rest = (line for line, text in enumerate(self._lines[self.line :], start=self.line + 1) if text.strip())
        return next((f", line {line}" for line in rest), None)


class _Binary:
    """Reads rows of bytes from ``at`` on, in an order of bytes."""

    where, line = "", None

    def __init__(self, data, at, order):
        self._data, self._at, self._order = data, at, order

    def begin(self):
        """Does nothing, for rows have no marks."""

    end = begin

    def take(self, kind, several):
        kind = np.dtype(kind)
        values = struct.unpack_from(f"{self._order}{several}{kind.char}", self._data, self._at)
        self._at += several * kind.itemsize
        return values

    def table(self, count, properties):
        """Returns the columns of rows if all lists are as long as in the first, else None."""
        start, kinds = self._at, []
        try:
            for name, kind, length in properties:
                several = self.take(length, 1)[0] if length else 1
                self.take(kind, several)
                kinds += [(f"{name} length", self._order + length)] if length else []
                kinds.append((name, self._order + kind, (several,)))
            kinds = np.dtype(kinds)
            table = np.frombuffer(self._data, kinds, count, start)
            even = all(np.ptp(table[f"{name} length"]) == 0 for name, _, length in properties if length)
        except (struct.error, ValueError):  # there is no row, or the file is too short
            even = False
        self._at = start + kinds.itemsize * count if even else start
        return [table[name] for name, _, _ in properties] if even else None

    def beyond(self):
        """Returns an empty text if the file goes on, or None."""
        return "" if self._data[self._at :].strip() else None
