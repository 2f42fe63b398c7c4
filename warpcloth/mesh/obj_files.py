"""Reads the polygons of .obj files."""

import warnings

import numpy as np

from .file_faces import faces_of, optional_number, plain_number, plain_reason, text_lines

# Keywords without faces.
_IGNORED = {*"vn vp vc g s p l usemtl usemap mtllib matlib maplib lod mg bevel c_interp d_interp shadow_obj trace_obj".split()}
_IGNORED |= {*"cstype deg bmat step parm trim hole scrv sp end con curv curv2 ctech stech".split()}
_CURVED = {*"surf bzp bsp cdc cdp res".split()}


def read_obj(path, data):
    """Returns the `FileFaces` of an .obj file, and the indices of each object's faces by name.

    Raises:
        ValueError: A line cannot be read or names no vertex; the message has path, line and reason.
    """
    points, texture, rows, st, lines, objects, name, curved = [], [], [], [], [], {}, path.name, None
    joined = ""
    for line, text in text_lines(data):
        if text.endswith("\\"):
            joined += text[:-1] + " "
            continue
        keyword, *values = (joined + text).partition("#")[0].split() or [""]
        joined = ""
        try:
            if keyword == "v":
                points.append([plain_number(value) for value in values[:3]])
                if len(values) < 3:
                    raise ValueError(f"a vertex has {len(values)} numbers, must have 3 or more")
            elif keyword == "vt":
                texture.append([optional_number(value) for value in (*values, "0", "0")[:2]])
            elif keyword in ("f", "fo"):
                corners = [value.split("/") for value in values]
                row = [_index(corner[0], len(points)) for corner in corners]
                if len(row) < 3:
                    continue
                rows.append(row)
                st += [_texture_index(corner[1], len(texture)) if len(corner) > 1 else -1 for corner in corners]
                objects.setdefault(name, []).append(len(lines))
                lines.append(line)
            elif keyword == "o":
                name = text.split(None, 1)[1].strip() if values else ""
            elif keyword in _CURVED:
                curved = curved or f"{path}, line {line}: {keyword!r} is left out, as only polygons are read"
            elif keyword and keyword not in _IGNORED:
                raise ValueError(f"{keyword!r} is not supported, must be v, vt, f or another keyword without faces")
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {plain_reason(error)}") from None
    if curved:
        warnings.warn(curved, stacklevel=2)
    st = np.array([*texture, (np.nan, np.nan)])[np.clip(st, -1, len(texture)).astype(int)] if texture else None
    return faces_of(path, points, rows, st, lines, 1), objects


def _index(word, count):
    """Returns the index from 0 of a number from 1, or of a negative one from the end."""
    index = plain_number(word, int)
    if index == 0 or index < -count:
        raise ValueError(f"a face names {index}, must be 1 or more, or negative to count back from its line")
    return index - 1 if index > 0 else count + index


def _texture_index(word, count):
    index = optional_number(word)
    return index - 1 if index > 0 else count + index if -count <= index < 0 else -1
