"""The mesh of a cloth, and the topology that energies and solvers read."""

import itertools
import sys
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import choice, number, shown
from ..base.limits import refuse_memory
from ..base.types import Converted, FilePath, UpAxis, default
from ..kernels.columns import columns_of, cross_length, dot, length
from ..kernels.deformation import FLATTEST
from .parts import Part, checked_parts, joined
from .selection import select

# Readers by file ending: (path, name of the geometry, class) → mesh. `loading` and, for stages, `usd` register theirs.
READERS: dict[str, Callable[[FilePath, str | None, Any], Any]] = {}
UP_AXES = ("Y", "Z")
Own = TypeVar("Own", bound="Mesh")
Pattern = Literal["diagonal", "alternating", "equilateral"]
_MAX_VERTICES = 2**31 - 1  # indices are int32
# Memory that a grid needs at least: float64 positions and texture coordinates, int64 corners of two triangles.
_BYTES_OF_A_VERTEX = 24 + 16 + 48


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """A mesh in its rest shape: triangles, or edges alone, as for a chain or a net.

    Arrays are copied, checked and made read-only.

    Attributes:
        points: Rest positions (n, 3) [m], float64.
        triangles: Vertices of each triangle (T, 3), int32, counter-clockwise from the front; (0, 3) of an edge mesh.
        edges: Vertices of each edge (E, 2), int32. In a triangle mesh each occurs once, the smaller index first, in
            lexicographic order; in an edge mesh as given.
        texture_coordinates: st of each vertex (n, 2), or of each corner (T, 3, 2) if a vertex has several; float64, or None.
        grid_shape: (nx, ny) if vertex i + nx·j is column i, row j of a grid of four-sided cells, or None.
        up_axis: "Y" or "Z"; None if unknown, which counts as "Y".
        parts: (first vertex, count, grid_shape) by name of each part of :meth:`join`, or None.

    Raises:
        ValueError: An array has the wrong shape or type, or is empty. An element, named by its index, is not finite, refers to
            no vertex, repeats one, has no area or length, or is an edge that occurs twice. The up axis is unknown.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3, size=0.5)
        >>> mesh
        Mesh(9 points, 8 triangles, 16 edges)
        >>> mesh.select("x == 0").tolist()
        [0, 3, 6]
        >>> mesh.springs("shear").shape
        (8, 2)
    """

    points: Converted[ArrayLike, np.ndarray] = default(MISSING)
    triangles: Converted[ArrayLike | None, np.ndarray] = default(None)
    edges: Converted[ArrayLike | None, np.ndarray] = default(None)
    texture_coordinates: Converted[ArrayLike | None, np.ndarray | None] = default(None)
    grid_shape: tuple[int, int] | None = None
    up_axis: UpAxis | None = None
    parts: Mapping[str, Part] | None = None

    def __post_init__(self) -> None:
        if self.up_axis is not None:
            choice("up_axis", self.up_axis, UP_AXES)
        points = _numbers("points", self.points, 3)
        n = len(points)
        if (self.triangles is None) == (self.edges is None):
            raise ValueError("triangles, edges: give exactly one of the two, for the edges of triangles follow from them")
        keep = object.__setattr__
        keep(self, "points", _read_only(points))
        if self.triangles is not None:
            keep(self, "triangles", _read_only(_indices("triangles", self.triangles, 3, n)))
            self._refuse_degenerate()
            order, first, _ = self._sides
            start = order[first]
            corners = np.stack([start, start + 1], axis=1) % 3
            keep(self, "edges", _read_only(np.sort(self.triangles[start[:, None] // 3, corners], axis=1)))
        else:
            keep(self, "triangles", _read_only(np.empty((0, 3), np.int32)))
            keep(self, "edges", _read_only(_indices("edges", self.edges, 2, n)))
            self._refuse_degenerate()
            self._refuse_repeated_edges()
        if self.texture_coordinates is not None:
            keep(self, "texture_coordinates", _read_only(self._checked_texture(n)))
        if self.grid_shape is not None:
            if np.shape(self.grid_shape) != (2,):
                raise ValueError(f"grid_shape is {self.grid_shape}; it must be two counts (nx, ny)")
            nx, ny = (_count("grid_shape", value) for value in self.grid_shape)
            if nx * ny != n:
                raise ValueError(f"grid_shape = {self.grid_shape}: {nx}·{ny} must be the number of points, {n}")
            keep(self, "grid_shape", (nx, ny))
        if self.parts is not None:
            keep(self, "parts", checked_parts(self.parts, n, self.triangles if len(self.triangles) else self.edges))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.points)} points, {len(self.triangles)} triangles, {len(self.edges)} edges)"

    @classmethod
    def grid(cls: type[Own], nx: int, ny: int, size: float | tuple[float, float] = 1.0, pattern: Pattern = "diagonal") -> Own:
        """Builds a flat grid in the plane y = 0, its first corner at the origin, triangle normals along +y.

        Vertex i + nx·j is in column i along +x and row j along +z; patterns:

        - "diagonal": rectangular cells, all diagonals from (i, j) to (i+1, j+1).
        - "alternating": rectangular cells, the diagonals of neighbouring cells mirrored, like a checkerboard.
        - "equilateral": rows along x with edges of length a = size/(nx−1), a·√3/2 apart along z, odd rows shifted by a/2 along
          +x; without `grid_shape`, and the only pattern with isotropic hinge energies.

        Args:
            nx: Vertices in a row, at least 2.
            ny: Rows, at least 2.
            size: Width along x and depth along z, or one length [m]; for "equilateral" the width.
            pattern: One of these.

        Returns:
            Mesh: nx·ny vertices, 2(nx−1)(ny−1) triangles, texture coordinates in the unit square.

        Raises:
            ValueError: A count, the size or the pattern is not allowed.
        """
        nx, ny = _count("nx", nx), _count("ny", ny)
        if pattern not in ("diagonal", "alternating", "equilateral"):
            raise ValueError(f'pattern is {pattern!r}; it must be "diagonal", "alternating" or "equilateral"')
        refuse_memory(f"nx = {nx}, ny = {ny}", _BYTES_OF_A_VERTEX * nx * ny)
        equilateral = pattern == "equilateral"
        if np.shape(size) != () and (equilateral or np.shape(size) != (2,)):
            raise ValueError(f"size is {size}; it must be one length{'' if equilateral else ' or two'} for pattern={pattern!r}")
        width, depth = (_length("size", length) for length in np.broadcast_to(size, 2).tolist())

        column, row = np.meshgrid(np.arange(nx), np.arange(ny))
        points = np.zeros((ny, nx, 3))
        if equilateral:
            edge = width / (nx - 1)
            points[..., 0] = edge * (column + 0.5 * (row % 2))
            points[..., 2] = edge * np.sqrt(0.75) * row
        else:
            points[..., 0], points[..., 2] = np.meshgrid(np.linspace(0, width, nx), np.linspace(0, depth, ny))
        st = points.reshape(-1, 3)[:, [0, 2]]

        a = (column + nx * row)[:-1, :-1]
        b, c, d = a + 1, a + nx, a + nx + 1
        mirrored = {"diagonal": column < 0, "alternating": (column + row) % 2 == 1, "equilateral": row % 2 == 0}[pattern]
        straight = np.stack([a, c, d, a, d, b], axis=-1)
        triangles = np.where(mirrored[:-1, :-1, None], np.stack([a, c, b, b, c, d], axis=-1), straight).reshape(-1, 3)
        st = st / st.max(axis=0)
        return cls(points.reshape(-1, 3), triangles, texture_coordinates=st, grid_shape=None if equilateral else (nx, ny))

    @classmethod
    def join(cls: type[Own], meshes: Mapping[str, "Mesh"]) -> Own:
        """Joins several meshes, such as pieces of a garment, part after part.

        ``part(name)`` selects the vertices of a part; a term with ``part=name`` acts on it. A :class:`warpcloth.Spring` with
        given pairs can join parts. Texture coordinates are kept if all parts have them.

        Args:
            meshes: Meshes by name, an identifier.

        Raises:
            ValueError: There is none, one has parts, triangle and edge meshes are mixed, up axes differ, or a name is not an
                identifier.
        """
        return cls(**joined(meshes))

    def part(self, name: str) -> "Mesh":
        """Returns the mesh of a part, as before :meth:`join`.

        Raises:
            ValueError: There is no such part.
        """
        found = (self.parts or {}).get(name)
        if found is None:
            known = f"its parts are {', '.join(self.parts)}" if self.parts else "Mesh.join makes one of parts"
            raise ValueError(f"the mesh has no part {name!r}; {known}")
        first, count, grid_shape = found
        chosen = slice(first, first + count)

        def of_part(elements):
            return (elements[:, 0] >= first) & (elements[:, 0] < first + count)

        def own(elements):
            return elements[of_part(elements)] - first

        st = self.texture_coordinates
        if st is not None:
            st = st[chosen] if st.ndim == 2 else st[of_part(self.triangles)]
        return Mesh(
            self.points[chosen],
            triangles=own(self.triangles) if len(self.triangles) else None,
            edges=None if len(self.triangles) else own(self.edges),
            texture_coordinates=st,
            grid_shape=grid_shape,
            up_axis=self.up_axis,
        )

    def _of_parts(self, indices: Callable[["Mesh"], np.ndarray]) -> np.ndarray:
        return np.concatenate([indices(self.part(name)) + part.first for name, part in (self.parts or {}).items()])

    @classmethod
    def chain(cls: type[Own], n: int, length: float = 1.0, direction: ArrayLike = (0, -1, 0)) -> Own:
        """Builds a straight chain of n evenly spaced vertices from the origin, an edge mesh.

        Args:
            n: Vertices, at least 2.
            length: Its length [m].
            direction: Direction to the last vertex, not 0.

        Raises:
            ValueError: A value is not allowed.
        """
        n, length = _count("n", n), _length("length", length)
        refuse_memory(f"n = {n}", _BYTES_OF_A_VERTEX * n)
        along = _coordinates("direction", [direction], 3)[0]
        if not along.any():
            raise ValueError(f"direction is {shown(direction)}; it must not be zero")
        points = np.linspace(0, length, n)[:, None] * (along / np.linalg.norm(along))
        return cls(points, edges=np.stack([np.arange(n - 1), np.arange(1, n)], axis=1))

    @classmethod
    def load(cls: type[Own], path: FilePath, prim: str | None = None, scale: float = 1.0, up_axis: UpAxis | None = None) -> Own:
        """Reads the mesh in a file, by `loading.read_file`, or `usd.read_mesh` for stages.

        Args:
            path: An .obj, .ply, .stl, .off, .glb or .gltf file, or a .usd, .usda, .usdc or .usdz stage.
            prim: Geometry or prim, if there are several.
            scale: Factor on lengths, such as 0.01 for centimetres.
            up_axis: "Y" or "Z", for files other than stages, .glb and .gltf (Y).

        Returns:
            Mesh: Of this class, vertices in the order of the file.

        Raises:
            ValueError: The mesh cannot be read, ``scale`` is not above 0, or ``up_axis`` contradicts the file.
        """
        read = READERS.get(Path(path).suffix.lower())
        if read is None:
            raise ValueError(f"{path}: the ending must be one of {' '.join(READERS)}")
        number("scale", scale, above=0.0)
        mesh = read(path, prim, cls)
        own: UpAxis | None = "Y" if Path(path).suffix.lower() in (".glb", ".gltf") else mesh.up_axis
        if up_axis is not None and own not in (None, up_axis):
            raise ValueError(f"{path}: up_axis is {up_axis!r}, but in the file it is {own!r}; leave it out")
        if scale == 1.0 and up_axis is None:
            return mesh
        given = {name: getattr(mesh, name) for name in ("texture_coordinates", "grid_shape", "parts")}
        elements = {"triangles": mesh.triangles} if len(mesh.triangles) else {"edges": mesh.edges}
        return cls(scale * mesh.points, **elements, **given, up_axis=own or up_axis)

    def select(self, text: str) -> np.ndarray:
        """Returns the vertices of a selection such as "z == 0 and not corners", sorted, int32.

        Args:
            text: The selection, in the grammar of `selection.select`.

        Raises:
            ValueError: The text breaks the grammar; the message says where.
        """
        return select(self, text)

    def corners(self) -> np.ndarray:
        """Returns the vertices at the corners, int32.

        With a ``grid_shape`` they are (0, 0), (nx−1, 0), (0, ny−1), (nx−1, ny−1). Else they are the boundary vertices nearest
        to the corners of the boundary's bounding box in its two largest extents, in that order, each once. Edge meshes have
        their ends, meshes with parts the corners of each.

        Raises:
            ValueError: The triangles are closed, without a boundary.
        """
        if self.parts:
            return self._of_parts(Mesh.corners)
        if self.grid_shape:
            nx, ny = self.grid_shape
            return np.array([0, nx - 1, nx * (ny - 1), nx * ny - 1], dtype=np.int32)
        if not len(self.triangles):
            return self.boundary
        if not len(self.boundary):
            raise ValueError("corners: the mesh is closed and has no boundary, so it has no corners")
        points = self.points[self.boundary]
        plane = np.sort(np.argsort(-np.ptp(points, axis=0), kind="stable")[:2])
        low, high = points[:, plane].min(axis=0), points[:, plane].max(axis=0)
        box = np.array([low, (high[0], low[1]), (low[0], high[1]), high])
        nearest = np.linalg.norm(points[None, :, plane] - box[:, None], axis=2).argmin(axis=1)
        return self.boundary[list(dict.fromkeys(nearest.tolist()))]

    def springs(self, kind: str) -> np.ndarray:
        """Returns the vertex pairs of a kind of springs (Provot 1995, "Deformation constraints in a mass-spring model").

        | kind | a grid with `grid_shape` | other triangle meshes | edge meshes |
        |---|---|---|---|
        | "structural" | along rows and columns | every edge | every edge |
        | "shear" | both diagonals of every cell | refused: the edges resist shear already | refused: no cells |
        | "bending" | vertices two apart in a row or column | the two vertices opposite each hinge | the two neighbours of each vertex that has exactly two |
        | "edges" | every edge | every edge | every edge |

        Args:
            kind: One of the four.

        Returns:
            np.ndarray: Pairs (E, 2), int32, the smaller index first, each once: "every edge" in the order of edges, others in
            lexicographic order.

        Raises:
            ValueError: The kind is unknown, is "shear" on a mesh without cells, or "bending" on a mesh that refuses hinges.
        """  # noqa: E501 (a table's row is one line)
        if kind not in ("structural", "shear", "bending", "edges"):
            raise ValueError(f'kind is {kind!r}; it must be "structural", "shear", "bending" or "edges"')
        if self.parts and kind != "edges":
            return self._of_parts(lambda mesh: mesh.springs(kind))
        if self.grid_shape and kind != "edges":
            nx, ny = self.grid_shape
            vertex = np.arange(nx * ny).reshape(ny, nx)
            if kind == "shear":
                sides = [(vertex[:-1, :-1], vertex[1:, 1:]), (vertex[:-1, 1:], vertex[1:, :-1])]
            else:
                skip = 1 if kind == "structural" else 2
                sides = [(vertex[:, :-skip], vertex[:, skip:]), (vertex[:-skip], vertex[skip:])]
            pairs = np.concatenate([np.stack([one.ravel(), other.ravel()], axis=1) for one, other in sides])
        elif kind == "shear":
            raise ValueError(
                'kind is "shear", which needs the four-sided cells of a diagonal or alternating grid; '
                "the edges of any other triangle mesh resist shear already"
            )
        elif kind != "bending":
            return np.sort(self.edges, axis=1)
        elif len(self.triangles):
            pairs = self.hinges[:, 2:]
        else:
            both_ways = np.concatenate([self.edges, self.edges[:, ::-1]])
            both_ways = both_ways[np.argsort(both_ways[:, 0], kind="stable")]
            valence = np.bincount(both_ways[:, 0], minlength=len(self.points))
            pairs = both_ways[valence[both_ways[:, 0]] == 2, 1].reshape(-1, 2)
        return self.distinct_pairs(pairs)

    @cached_property
    def hinges(self) -> np.ndarray:
        """The vertices of pairs of triangles that share an edge (H, 4), int32, in the order of edges.

        In [x₀, x₁, x₂, x₃], x₀, x₁, x₂ is the triangle of the lower index in its cyclic order, with its normal along
        (x₁−x₀)×(x₂−x₀). x₃ is the third vertex of the other.

        Raises:
            ValueError: More than two triangles share an edge, or two share three vertices.
        """
        order, first, count = self._sides
        if (count > 2).any():
            edge = np.argmax(count > 2)
            around = (order[first[edge] : first[edge] + count[edge]] // 3).tolist()
            raise ValueError(
                f"triangles: edge {self.edges[edge].tolist()} belongs to triangles {around}, at most two are allowed"
            )
        shared = first[count == 2]
        one, two = order[shared], order[shared + 1]
        # Side k of triangle t, number 3t+k, runs from its corner k to corner k+1; corner k+2 is opposite.
        vertices, following = self.triangles.ravel(), np.arange(self.triangles.size)
        following += np.tile([1, 1, -2], len(self.triangles))
        after = following[one]
        corners = one, after, following[after], following[following[two]]
        hinges = np.stack([vertices[corner] for corner in corners], axis=1)
        folded = np.flatnonzero(hinges[:, 2] == hinges[:, 3])
        if len(folded):
            pair = [int(side[folded[0]]) // 3 for side in (one, two)]
            raise ValueError(f"triangles: {pair} have the same three vertices, must be different triangles")
        return _read_only(hinges)

    @property
    def corner_coordinates(self) -> np.ndarray | None:
        """Texture coordinates of the corners of each triangle (T, 3, 2), or None."""
        st = self.texture_coordinates
        return st if st is None or st.ndim == 3 else st[self.triangles]

    @cached_property
    def boundary_edges(self) -> np.ndarray:
        """Edges of exactly one triangle (B, 2), int32, rows of `edges`; (0, 2) for an edge mesh."""
        return _read_only(self.edges[self._sides[2] == 1] if len(self.triangles) else self.edges[:0])

    @cached_property
    def boundary(self) -> np.ndarray:
        """Sorted vertices of the boundary edges, int32; for an edge mesh the ends."""
        if len(self.triangles):
            return _read_only(np.unique(self.boundary_edges))
        return _read_only(np.flatnonzero(np.bincount(self.edges.ravel()) == 1).astype(np.int32))

    @cached_property
    def isolated(self) -> np.ndarray:
        """Sorted vertices without an edge, int32."""
        used = np.bincount(self.edges.ravel(), minlength=len(self.points))
        return _read_only(np.flatnonzero(used == 0).astype(np.int32))

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """Rest lengths (E,) [m]."""
        x0, x1 = columns_of(self.points, *self.edges.T)
        return _read_only(length(x1 - x0))

    @cached_property
    def triangle_areas(self) -> np.ndarray:
        """Rest areas (T,) [m²], ½‖(x₁−x₀)×(x₂−x₀)‖."""
        with np.errstate(invalid="ignore", over="ignore"):  # points of a `Surface` may be infinite
            return _read_only(areas_of(self.points, self.triangles))

    @cached_property
    def vertex_areas(self) -> np.ndarray:
        """Lumped areas (n,) [m²]: thirds of adjacent triangles; areas that are not finite count as 0."""
        third = np.repeat(np.where(np.isfinite(self.triangle_areas), self.triangle_areas, 0.0) / 3, 3)
        return _read_only(np.bincount(self.triangles.ravel(), weights=third, minlength=len(self.points)))

    @cached_property
    def vertex_lengths(self) -> np.ndarray:
        """Lumped lengths (n,) [m]: halves of adjacent edges."""
        half = np.repeat(self.edge_lengths / 2, 2)
        return _read_only(np.bincount(self.edges.ravel(), weights=half, minlength=len(self.points)))

    @cached_property
    def _sides(self):
        """The 3T sides sorted by edge, then triangle (3T,), and first position (E,) and number (E,) of each edge's sides."""
        keys = self._keys(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
        return order, first, np.diff(first, append=len(keys))

    def _keys(self, pairs):
        """Packs pairs (E, 2), smaller index first, into int64, which sort faster."""
        one, other = pairs.T
        return np.minimum(one, other).astype(np.int64) * len(self.points) + np.maximum(one, other)

    def distinct_pairs(self, pairs: np.ndarray) -> np.ndarray:
        """Returns the distinct pairs of vertices (E, 2), int32, in lexicographic order."""
        keys = np.sort(self._keys(pairs))
        keys = keys[np.append(True, keys[1:] != keys[:-1])[: len(keys)]]
        return np.stack(np.divmod(keys, len(self.points)), axis=1).astype(np.int32)

    def _flat(self):
        with np.errstate(invalid="ignore", over="ignore"):
            a, b, c = columns_of(self.points, *self.triangles.T)
            longest_squared = np.max([dot(side, side) for side in (a - c, b - a, c - b)], axis=0)
            # 2·area/longest² is the height over the longest side, divided by that side.
            return ~(2 * self.triangle_areas > FLATTEST * longest_squared)

    def _checked_texture(self, n):
        shape = np.shape(self.texture_coordinates)
        at_corners = len(shape) == 3 and shape[1] == 3
        given = np.reshape(self.texture_coordinates, (-1, shape[2])) if at_corners else self.texture_coordinates
        st = _coordinates("texture_coordinates", given, 2)
        if len(st) != (3 * len(self.triangles) if at_corners else n):
            rule = "one for each point, or three for each triangle"
            raise ValueError(f"texture_coordinates: {shape[0]} rows for {n} points, must be {rule}")
        return st.reshape(shape)

    def _refuse_degenerate(self):
        _refuse("points", self.points, ~np.isfinite(self.points).all(axis=1), "must be finite")
        _refuse("triangles", self.triangles, _repeated(self.triangles), "must be 3 different vertices")
        _refuse("triangles", self.triangles, self._flat(), f"must be higher than {FLATTEST:g} of its longest side")

    def _refuse_repeated_edges(self):
        _refuse("edges", self.edges, _repeated(self.edges), "must be 2 different vertices")
        keys = self._keys(self.edges)
        repeated = np.ones(len(keys), dtype=bool)
        repeated[np.unique(keys, return_index=True)[1]] = False
        _refuse("edges", self.edges, repeated, "must occur once, in either direction")
        _refuse("edges", self.edges, self.edge_lengths == 0, "must have two different end points")


class Surface(Mesh):
    """A mesh that is only measured: triangles may be degenerate and points may be infinite or NaN.

    `degenerate` triangles have no measures but belong to the topology, so an edge may join a vertex with itself.
    """

    @cached_property
    def degenerate(self) -> np.ndarray:
        """Sorted triangles (k,), int32, that a `Mesh` would refuse."""
        return _read_only(np.flatnonzero(self._flat()).astype(np.int32))

    def _refuse_degenerate(self):
        """Does nothing."""


def areas_of(x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns the areas (T,) [m²] of triangles (T, 3) with corners among the points x (n, 3) [m]."""
    a, b, c = columns_of(x, *triangles.T)
    return 0.5 * cross_length(b - a, c - a)


def same_topology(one: Mesh, other: Mesh) -> bool:
    """Whether two meshes have as many vertices and the same triangles."""
    return len(one.points) == len(other.points) and np.array_equal(one.triangles, other.triangles)


def _read_only(array):
    array.setflags(write=False)
    return array


def _refuse(name, rows, bad, rule):
    if bad.any():
        row = np.argmax(bad)
        raise ValueError(f"{name}[{row}] is {rows[row].tolist()}; it {rule}")


def _rows(name, value, width, kinds):
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name}: must be rows of {width} numbers; {error}") from None
    if array.ndim != 2 or array.shape[1] != width or not len(array):
        raise ValueError(f"{name}: has shape {array.shape}, must be (count, {width}) with at least one row")
    if array.dtype.kind not in kinds:
        raise ValueError(f"{name}: has type {array.dtype}, must be {'integers' if kinds == 'iu' else 'real numbers'}")
    return array


def _numbers(name, value, width):
    return _rows(name, value, width, "fiu").astype(np.float64)


def _coordinates(name, value, width):
    rows = _numbers(name, value, width)
    _refuse(name, rows, ~np.isfinite(rows).all(axis=1), "must be finite")
    return rows


def _indices(name, value, width, n):
    rows = _rows(name, value, width, "iu")
    _refuse(name, rows, ((rows < 0) | (rows >= n)).any(axis=1), f"must be indices of the {n} points, 0 to {n - 1}")
    return rows.astype(np.int32)


def _repeated(rows):
    columns = rows.T
    return np.any([one == other for one, other in itertools.combinations(columns, 2)], axis=0)


def _count(name, value):
    if not isinstance(value, int | np.integer) or not 2 <= value <= _MAX_VERTICES:
        allowed = f"a whole number of vertices, at least 2 and at most {_MAX_VERTICES:,}"
        raise ValueError(f"{name} is {shown(value)}; it must be {allowed}")
    return int(value)


def _length(name, value):
    if not isinstance(value, int | float | np.number) or not 0 < value <= sys.float_info.max:
        raise ValueError(f"{name} is {shown(value)}; it must be a finite positive length")
    return float(value)
