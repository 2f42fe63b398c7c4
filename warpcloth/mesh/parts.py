"""Parts: meshes joined into one, such as pieces of a garment.

The vertices of a part are consecutive; only springs join parts.
"""

import operator
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..base.checks import shown


class Part(NamedTuple):
    """A part of a mesh.

    Attributes:
        first: Its first vertex.
        count: Number of its vertices, first to first + count − 1.
        grid_shape: (nx, ny) if it is a grid, or None.
    """

    first: int
    count: int  # type: ignore[assignment]  # hides tuple.count
    grid_shape: tuple[int, int] | None = None


def joined(meshes):
    """Returns the fields of a mesh of these parts; refuses parts of parts, edges beside triangles, and differing up axes."""
    if not (isinstance(meshes, Mapping) and meshes and all(hasattr(mesh, "triangles") for mesh in meshes.values())):
        raise ValueError(f"parts is {shown(meshes)}; it must be a mapping of names to meshes, with one part or more")
    nested = [name for name, mesh in meshes.items() if mesh.parts]
    if nested:
        raise ValueError(f"parts: the mesh {nested[0]!r} has parts itself; each must be joined by itself, and all at once")
    each = list(meshes.values())
    of_triangles = [len(mesh.triangles) > 0 for mesh in each]
    if any(of_triangles) != all(of_triangles):
        raise ValueError("parts has meshes of triangles and meshes of edges alone; all must be of one kind")
    axes = {mesh.up_axis for mesh in each} - {None}
    if len(axes) > 1:
        raise ValueError("parts has meshes whose up axis is Y and others whose up axis is Z; it must be the same for all")
    firsts = np.cumsum([0, *(len(mesh.points) for mesh in each)])

    def shifted(field):
        return np.concatenate([getattr(mesh, field) + first for mesh, first in zip(each, firsts[:-1], strict=True)])

    textures = [mesh.texture_coordinates for mesh in each]
    textured = all(st is not None for st in textures)
    if textured and any(st.ndim == 3 for st in textures):
        textures = [mesh.corner_coordinates for mesh in each]
    return {
        "points": np.concatenate([mesh.points for mesh in each]),
        "triangles": shifted("triangles") if all(of_triangles) else None,
        "edges": None if all(of_triangles) else shifted("edges"),
        "texture_coordinates": np.concatenate(textures) if textured else None,
        "up_axis": next(iter(axes), None),
        "parts": {
            name: Part(int(first), len(mesh.points), mesh.grid_shape)
            for (name, mesh), first in zip(meshes.items(), firsts[:-1], strict=True)
        },
    }


def checked_parts(parts, count, elements):
    """Returns :class:`Part` records from (first, count, grid_shape) by name; they must cover all vertices in order, and no
    element (m, K) may join two.
    """
    try:
        rows = {name: (operator.index(first), operator.index(count), *grid) for name, (first, count, *grid) in parts.items()}
        found = {name: Part(*row) for name, row in rows.items()}
    except (AttributeError, TypeError, ValueError):
        raise ValueError(f"parts is {shown(parts)}; it must be a dict of (first, count, grid_shape) by name") from None
    for name in found:
        if not (isinstance(name, str) and name.isidentifier()):
            raise ValueError(f"parts: the name {name!r} must be letters, digits and underscores, and begin with no digit")
    ends = np.cumsum([0, *(part.count for part in found.values())])
    follow = [part.first == first and part.count > 0 for part, first in zip(found.values(), ends, strict=False)]
    if not (found and all(follow)) or ends[-1] != count:
        raise ValueError(f"parts is {shown(found)}; it must have all {count} vertices, one part after another")
    of_part = np.searchsorted(ends, elements, side="right")
    apart = np.flatnonzero((of_part != of_part[:, :1]).any(axis=1))
    if len(apart):
        raise ValueError(f"parts: vertices {elements[apart[0]].tolist()} of an element must lie in one part")
    return found
