"""Polygons of files."""

import re
from itertools import chain
from typing import NamedTuple

import numpy as np

from .polygons import triangles_of


class FileFaces(NamedTuple):
    """The faces of a file.

    Attributes:
        points: (n, 3) [m], float64.
        counts: Number of corners of each face (F,), at least 3.
        corners: Vertices of one face after another (C,), int64.
        st: Texture coordinates of the corners (C, 2), NaN where missing, or None.
    """

    points: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    st: np.ndarray | None = None

    def triangles(self, triangles_of=triangles_of):
        """Returns points (n, 3), triangles (T, 3), and texture coordinates, or None.

        Repeated corners are dropped, and polygons with fewer than three others. Texture coordinates are (n, 2), (T, 3, 2) if a
        vertex has several, or None if a corner has none.

        Raises:
            ValueError: A face crosses or touches itself, is far from planar, or none has three corners.
        """
        begins, ahead = np.cumsum(self.counts) - self.counts, np.append(self.corners[1:], -1)
        ahead[begins + self.counts - 1] = self.corners[begins]
        other = (self.corners != ahead) | (np.repeat(self.counts, self.counts) == 3)
        counts, corners = np.add.reduceat(other, begins, dtype=np.int64), self.corners[other]
        chosen, st = triangles_of(self.points[corners], counts, np.flatnonzero(counts < 3)), None
        if not len(chosen):
            raise ValueError("has no face with three different corners")
        halves = (np.repeat(counts, np.maximum(counts - 2, 0)) == 4) & (chosen[:, 1] - chosen[:, 0] == 2)
        chosen[halves] = np.roll(chosen[halves], -1, axis=1)
        if self.st is not None and np.isfinite(self.st).all():
            at_vertices = np.zeros((len(self.points), 2))
            at_vertices[corners] = self.st[other]
            st = at_vertices if np.array_equal(at_vertices[corners], self.st[other]) else self.st[other][chosen]
        return self.points, corners[chosen], st


def faces_of(path, points, rows, st=None, lines=None, first=0):
    """Returns the `FileFaces` of a file, without lines and points, from points (n, 3) [m] and rows of vertices from 0.

    ``lines`` (F,) are the lines of faces in text, ``first`` is the number of the first vertex and face there, for messages.
    """
    points, counts = np.asarray(points, dtype=np.float64).reshape(-1, 3), np.fromiter(map(len, rows), np.int64, len(rows))
    try:
        corners = np.fromiter(chain.from_iterable(rows), np.int64, counts.sum())
    except OverflowError:
        corners = np.array([*chain.from_iterable(rows)], dtype=object)
    far = np.flatnonzero((corners < 0) | (corners >= len(points)))[:1]
    for at in far:
        face = int(np.searchsorted(np.cumsum(counts), at, side="right"))
        where, reason = "" if lines is None else f", line {lines[face]}", f"names vertex {corners[at] + first}"
        raise ValueError(f"{path}{where}: face {face + first} {reason}; the file has {len(points)}")
    kept = np.repeat(counts >= 3, counts)
    return FileFaces(points, counts[counts >= 3], corners[kept], None if st is None else st[kept])


def text_lines(data):
    """Returns (number, text) of each line of a file in bytes, which may end with an end-of-file mark."""
    text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", "replace")
    return enumerate(re.split(r"\r\n|\r|\n", text.removesuffix("\0").removesuffix("\x1a")), start=1)


def plain_number(word, kind=float):
    """Returns the number of a word; refuses underscores."""
    if "_" in word:
        raise ValueError(f"has {word!r}, must be a number")
    return kind(word)


def optional_number(word):
    """Returns a number, or NaN if it is none."""
    try:
        return float(word)
    except ValueError:
        return np.nan


def plain_reason(error):
    """Returns why a line could not be read."""
    words = re.fullmatch(r"(could not convert|invalid literal).* (float|int)\b.*?: (.*)", str(error))
    return str(error) if words is None else f"has {words[3]}, must be a {'whole ' * (words[2] == 'int')}number"


def refuse_open_end(where, data, last, most):
    """Raises ValueError if the last number, an index below ``most``, has no line break after it and may be cut."""
    if data[-1:] not in b"\r\n" and not (last.isdecimal() and (int(last) == 0 or 10 * int(last) >= most)):
        raise ValueError(f"{where}: ends in {last} without a line break, so the file may be cut; end the line with one")
