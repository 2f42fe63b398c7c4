"""Reads the polygons of .off files."""

import re

import numpy as np

from .file_faces import faces_of, plain_number, plain_reason, refuse_open_end, text_lines


def read_off(path, data):
    """Returns the `FileFaces` of an .off file, without normals, colours and texture coordinates.

    Raises:
        ValueError: A line cannot be read or does not match the header; the message has path, line and reason.
    """
    rows = [(line, words) for line, text in text_lines(data) if (words := text.partition("#")[0].split())]
    if rows and rows[0][1][0].endswith("OFF"):
        line, (keyword, *words) = rows.pop(0)
        if not re.fullmatch("(ST)?(C?N?|NC)OFF", keyword) or words[:1] == ["BINARY"]:
            raise ValueError(f"{path}, line {line}: is {' '.join([keyword, *words])}, must be text of three dimensions")
        rows = [(line, words)] * bool(words) + rows
    if not rows:
        raise ValueError(f"{path}: has no line with the numbers of vertices and faces")
    line, counts = rows.pop(0)
    if len(counts) < 2 or not all(count.isdecimal() for count in counts[:2]):
        raise ValueError(f"{path}, line {line}: must be the numbers of vertices, faces and edges, each 0 or more")
    vertices, faces = map(int, counts[:2])
    found = []
    for line, words in rows[: vertices + faces]:
        name, index = ("vertex", len(found)) if len(found) < vertices else ("face", len(found) - vertices)
        try:
            needed = 3 if name == "vertex" else 1 + int(words[0])
            if not 0 < needed <= len(words):  # more may be a colour
                raise ValueError(f"has {len(words)} numbers, must have {needed}")
            kind, wanted = (float, words[:3]) if name == "vertex" else (int, words[1:needed])
            found.append([plain_number(word, kind) for word in wanted])
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {name} {index} {plain_reason(error)}") from None
    for count, most, plural in ((len(found), vertices, "vertices"), (len(found) - vertices, faces, "faces")):
        if count < most:
            raise ValueError(f"{path}, line {line}: the file ends after {count} of the {most} {plural} that its header says")
    for line, _ in rows[vertices + faces :][:1]:
        raise ValueError(f"{path}, line {line}: the file goes on after all vertices and faces that its header says")
    if found and len(words) == needed:
        refuse_open_end(f"{path}, line {line}", data, words[-1], vertices if faces else np.inf)
    return faces_of(path, found[:vertices], found[vertices:], lines=[line for line, _ in rows[vertices:]])
