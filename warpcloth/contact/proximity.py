"""Finds pairs of a vertex and a triangle, and of two edges, that are near one another, on the device and in a fixed order."""

import numpy as np
import warp as wp

from ..base.limits import refuse_memory
from ..base.turns import in_turn
from ..core.capture import Mirror
from ..core.scan import Scan
from ..kernels import proximity as kernels

BYTES_OF_A_PAIR = 56


class Proximity:
    """The pairs of a vertex and a triangle, and of two edges, that are near one another in a copy of a model.

    A pair is found if it is nearer than r_c + skin. r_c is the contact distance, but at most half of what two elements of one
    connected piece are apart at rest. Pairs that share a vertex do not count, nor do coordinates that are not finite. Meshes of
    edges alone have pairs of edges alone.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        distance: The contact distance r [m].
        skin: By how much more pairs are sought [m]: until two vertices have come nearer by so much, none is missing.

    Attributes:
        capacity: How many pairs there is room for.
        stencils: (capacity,) vertices of the model: (v, a, b, c) of the pairs of a vertex and a triangle, sorted, and then
            (a, b, c, d) of the pairs of the edges ab and cd.
        distances: (capacity,) r_c of each [m].
        counts: (2,) int32: how many pairs of either kind were found, which may be more than the capacity.
        rows: Pairs rows[i] to rows[i+1] are those of vertex i and a triangle; those of edges follow, by the first of the two.
        found: Positions of the last list, (N,) [m]. Whoever sets them calls :meth:`launch_kept` before the list is used.
        flag, copies: (1,) and (B,) int32, see :meth:`moved`.
        listed: Positions of which the list in the arrays is, (N,) [m].
        centre: The vertex in the middle of each connected piece of all copies.
    """

    @in_turn
    def __init__(self, model, distance, skin):
        self.model, self.distance, self.skin = model, distance, skin
        mesh, n, device = model.scene.mesh, model.per_copy, model.device
        self._triangles, self._edges = len(mesh.triangles) * model.copies, len(mesh.edges) * model.copies
        piece, points = self._connected(model.in_model(mesh.edges))
        self._kept = {  # whose memory the struct does not keep
            "items": wp.array(self._items(), dtype=wp.vec4i, device=device),
            "rest": model.array(points, model.vec3),
            "piece": wp.array(piece, dtype=wp.int32, device=device),
        }
        self._surface = kernels.surfaces(model.dtype)()
        far = 2.0 * (distance + mesh.edge_lengths.max())
        for name, value in ({"vertices": n, "distance": distance, "skin": skin, "far": far} | self._kept).items():
            setattr(self._surface, name, value)
        self._allocate_grid()
        self._set_pieces(piece, points)
        self.found = model.vectors()  # no surface, from which all have moved
        self.listed = model.vectors()  # those of the pairs in the arrays
        self.flag, self._stale = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self.copies = model.scalars(wp.int32)
        self._rows = Scan(model, model.count + self._edges)
        self._pairs_of = {each: model.kernel(kernels.find_pairs, model.dtype, each) for each in (False, True)}
        self._launch = model.launcher(
            (
                (kernels.count_items, kernels.fill_buckets, kernels.fill_rows, kernels.write_pairs),
                model.dtype,
            ),
            ((kernels.begin_boxes, kernels.extend_boxes, kernels.find_motion, kernels.compare_motions), model.dtype),
            ((kernels.take_moved,), model.dtype),
        )
        self.counts = wp.zeros(2, dtype=wp.int32, device=device)
        self._mirror = Mirror(self.counts)
        self._allocate(max(1024, 4 * model.count))

    def _items(self):
        """The vertices of the triangles of all copies, and then of the edges, with 2·copy + kind, (items, 4) int32."""
        model, mesh = self.model, self.model.scene.mesh
        kinds = []
        for kind, elements in enumerate((mesh.triangles, mesh.edges[:, [0, 1, 1]])):
            copy = np.repeat(np.arange(model.copies), len(elements))
            vertices = np.tile(model.in_model(elements), (model.copies, 1)) + copy[:, None] * model.per_copy
            kinds.append(np.column_stack([vertices, 2 * copy + kind]))
        return np.concatenate(kinds).astype(np.int32)

    def _connected(self, edges):
        """The connected piece of each vertex, −1 of one of no element, and rest points about the middle of each piece."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        n, points = self.model.per_copy, self.model.rest_points
        joined = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
        count, piece = connected_components(joined, directed=False)
        sizes = np.bincount(piece, minlength=count)
        middle = np.stack([np.bincount(piece, axis, count) for axis in points.T], axis=1) / sizes[:, None]
        return np.where(sizes[piece] > 1, piece, -1).astype(np.int32), points - middle[piece]

    def _set_pieces(self, piece, points):
        """Numbers the pieces of all copies, and takes the vertex nearest to the middle of each."""
        model = self.model
        used, numbers = np.unique(piece[piece >= 0], return_inverse=True)
        number = np.full(model.per_copy, -1)
        number[piece >= 0] = numbers
        by_distance = np.lexsort((np.linalg.norm(points, axis=1), number))
        centre = by_distance[np.searchsorted(number[by_distance], np.arange(len(used)))]
        copy = np.arange(model.copies)[:, None]
        arrays = {
            "piece": np.where(number < 0, -1, number + copy * len(used)),
            "centre": centre + copy * model.per_copy,
        }
        self._piece_arrays = {k: wp.array(v.ravel(), dtype=wp.int32, device=model.device) for k, v in arrays.items()}
        if len(used) > 1:
            for name, kind in (("lower", model.vec3), ("upper", model.vec3), ("motion", model.dtype)):
                self._piece_arrays[name] = wp.zeros(model.copies * len(used), dtype=kind, device=model.device)
        self.centre = self._piece_arrays["centre"]
        self._pieces = kernels.pieces(model.dtype)()
        for name, value in ({"per_copy": len(used)} | self._piece_arrays).items():
            setattr(self._pieces, name, value)

    def _allocate_grid(self):
        model, items = self.model, self._triangles + self._edges
        lengths = model.scene.mesh.edge_lengths
        size = 0.5 * (min(1.05 * lengths.max(), 2.0 * np.median(lengths)) + self.distance + self.skin)
        buckets = 1 << max(4, (items - 1).bit_length())
        count = {"levels": 2, "counts": buckets, "keys": items, "first": buckets + 1}
        self._grid_arrays = {k: wp.zeros(size, dtype=wp.int32, device=model.device) for k, size in count.items()}
        for name, kind in (("lower", model.vec3), ("upper", model.vec3), ("entries", wp.vec4i)):
            self._grid_arrays[name] = wp.zeros(items, dtype=kind, device=model.device)
        self._grid = kernels.grids(model.dtype)()
        for name, value in ({"size": size} | self._grid_arrays).items():
            setattr(self._grid, name, value)
        self._buckets = Scan(model, buckets)

    def _allocate(self, capacity):
        model = self.model
        rows = model.count + self._edges
        refuse_memory(f"the cloth has {capacity} pairs that are near one another", BYTES_OF_A_PAIR * capacity)

        def zeros(count, dtype=wp.int32):
            return wp.zeros(count, dtype=dtype, device=model.device)

        self.capacity = capacity
        self.listed.fill_(np.nan)
        self.stencils, self.distances = zeros(capacity, wp.vec4i), zeros(capacity, model.dtype)
        self.rows = zeros(rows + 1)
        self._arrays = {
            "counts": self.counts,
            "found": zeros(capacity, wp.vec2i),
            "row_counts": zeros(rows),
            "first": self.rows,
            "items": zeros(capacity),
            "stencils": self.stencils,
            "distances": self.distances,
        }
        self._pairs = kernels.pair_lists(model.dtype)()
        for name, value in self._arrays.items():
            setattr(self._pairs, name, value)

    def set_skin(self, skin):
        """Sets another skin; the list is then made anew wherever :meth:`launch_kept` is called."""
        self._surface.skin = skin
        self.listed.fill_(np.nan)

    def launch_moved(self, x):
        """Launches the detection at x (N,) in ``copies``, and where it was before in the others.

        So the pairs of a copy do not depend on the others.
        """
        self._launch(kernels.take_moved, self.model.count, [x, self.copies, self.model.per_copy], [self.found])
        self.launch(self.found)

    def launch(self, x):
        """Launches the detection at positions x (N,)."""
        surface, grid, pairs, N = self._surface, self._grid, self._pairs, self.model.count
        items, own = self._triangles + self._edges, self._arrays
        if x is not self.found:
            wp.copy(self.found, x)
        wp.copy(self.listed, x)
        if self._pieces.per_copy > 1:
            self._launch_boxes(x)
        self.counts.zero_()
        self._grid_arrays["levels"].zero_()
        self._launch(kernels.count_items, items, [surface, x], [grid])
        self._buckets.launch(self._grid_arrays["counts"], self._grid_arrays["first"])
        self._launch(kernels.fill_buckets, items, [surface, x], [grid])
        for of_edges, count in ((False, N if self._triangles else 0), (True, self._edges)):
            if count:
                self.model.launch(self._pairs_of[of_edges], count, [surface, x, grid, self._triangles], [pairs])
        self._rows.launch(own["row_counts"], own["first"])
        self._launch(kernels.fill_rows, self.capacity, [], [pairs])
        self._launch(kernels.write_pairs, N + self._edges, [surface, N, self._triangles], [pairs])

    def _launch_boxes(self, x):
        self._launch(kernels.begin_boxes, len(self._pieces.centre), [x], [self._pieces])
        self._launch(kernels.extend_boxes, self.model.count, [x], [self._pieces])

    def launch_kept(self, x, part, launch):
        """Launches ``launch`` of x where :meth:`moved` says so, else of ``found`` if the list is not that of ``found``.

        So the list is a function of x and ``found`` alone, whatever was listed since ``found`` was set.
        """
        flag = self.moved(x, part)
        wp.capture_if(flag, launch, lambda x: wp.capture_if(self._stale, lambda: launch(self.found)), x=x)

    def moved(self, x, part=0.5, active=None):
        """Launches flag = 1 where pairs may be missing at x (N,), else 0, and returns it; for :func:`warp.capture_if`.

        ``copies`` are 1 of those of which pairs may be missing.

        It is 0 while each vertex has moved by at most a ``part`` of the skin since the last detection, relative to the vertex
        in the middle of its connected piece. Two pieces may have come nearer by twice that, and by as much as their boxes were
        farther apart than the contact distance and the skin. So sheets that fall together, or far apart, need no detection.

        Args:
            x: Positions [m].
            part: At most ½, at which no pair within its r_c is missing where the flag is 0. With less, vertices may still move
                by a ½ − ``part`` of the skin each, relative to one another, before one is.
            active: The copies that count (B,) int32, or None for all.
        """
        for array in (self.flag, self.copies, self._stale):
            array.zero_()
        several = self._pieces.per_copy > 1
        if several:
            self._pieces.motion.zero_()
        given = [x, self.found, self.listed, active, part * self.skin]
        self._launch(kernels.find_motion, self.model.count, given, [self._pieces, self.copies, self.flag, self._stale])
        if several:
            wp.capture_if(self._stale, lambda: self._launch_boxes(self.found))
            given = [x, self.found, self._pieces, active, self.distance + self.skin, 2.0 * part * self.skin]
            self._launch(kernels.compare_motions, len(self._pieces.centre), given, [self.copies, self.flag])
        return self.flag

    @property
    def overflowed(self):
        """Whether the last detection found more pairs than there is room for, read on the host."""
        return self._mirror.read().sum(dtype=np.int64) > self.capacity

    @in_turn
    def grow(self, count=None):
        """Allocates room for half as many pairs more than a ``count``, by default those that the last detection found.

        What was recorded with the old arrays must be recorded anew.

        Raises:
            ValueError: There is no memory for it.
        """
        self._allocate(int(1.5 * (self._mirror.read().sum(dtype=np.int64) if count is None else count)))
