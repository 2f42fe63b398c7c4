"""Reads the polygons of .obj files."""

import numpy as np

from .file_faces import faces_of, plain_reason, text_lines

# Keywords without faces.
_IGNORED = {*"vn vp g s p l usemtl usemap mtllib maplib lod mg bevel c_interp d_interp shadow_obj trace_obj".split()}


def read_obj(path, data):
    """Returns the `FileFaces` of an .obj file in bytes, and the indices of those of each object by its name.

    Raises:
        ValueError: A line cannot be read, or names a vertex or texture coordinate that the file does not have. The message has
            path, line and reason.
    """
    points, texture, rows, st, lines, objects, name = [], [], [], [], [], {}, path.name
    joined = ""
    for line, text in text_lines(data):
        if text.endswith("\\"):
            joined += text[:-1] + " "
            continue
        keyword, *values = (joined + text).partition("#")[0].split() or [""]
        joined = ""
        try:
            if keyword == "v":
                points.append([float(value) for value in values[:3]])
                if len(values) < 3:
                    raise ValueError(f"a vertex has {len(values)} numbers, must have 3 or more")
            elif keyword == "vt":
                texture.append([float(value) for value in (*values, "0")[:2]])
            elif keyword in ("f", "fo"):
                corners = [(*value.split("/"), "")[:2] for value in values]
                rows.append([_index(vertex, len(points)) for vertex, _ in corners])
                st += [_index(each, len(texture)) if each else -1 for _, each in corners]
                objects.setdefault(name, []).append(len(lines))
                lines.append(line)
            elif keyword == "o":
                name = text.split(None, 1)[1].strip() if values else ""
            elif keyword and keyword not in _IGNORED:
                raise ValueError(f"{keyword!r} is not supported, must be v, vt, f or another keyword without faces")
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {plain_reason(error)}") from None
    found = faces_of(path, points, rows, lines=lines, first=1)
    for corner in np.flatnonzero(np.array(st) >= len(texture))[:1]:
        face = np.searchsorted(np.cumsum(found.counts), corner, side="right")
        reason = f"names texture coordinate {st[corner] + 1}; the file has {len(texture)}"
        raise ValueError(f"{path}, line {lines[face]}: face {face + 1} {reason}")
    return found._replace(st=np.array(texture)[st] if st and min(st) >= 0 else None), objects


def _index(word, count):
    """Returns the index from 0 of a number from 1, or of a negative one from the end."""
    number = int(word)
    if number == 0 or number < -count:
        raise ValueError(f"a face names {number}, must be 1 or more, or negative to count back from its line")
    return number - 1 if number > 0 else count + number
