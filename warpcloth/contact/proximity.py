"""Pairs of vertices and triangles, and of edges, of the cloths that are near one another: found on the device, in a fixed order."""

import numpy as np
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..base.limits import refuse_memory
from ..base.turns import in_turn
from ..core.capture import Mirror
from ..core.scan import Scan
from ..kernels import proximity as kernels

BYTES_OF_A_PAIR = 56


class Proximity:
    """The pairs of a vertex and a triangle, and of two edges, of each copy of a model that are nearer than a distance and a skin.

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
        first, corners: The corners of pairs at each vertex i, sorted: 4·pair + corner in ``corners`` from first[i] to
            first[i+1].
        flag: (1,) int32, see :meth:`moved`.
    """

    @in_turn
    def __init__(self, model, distance, skin):
        self.model, self.distance, self.skin = model, distance, skin
        mesh, n, device = model.scene.mesh, model.per_copy, model.device
        self._triangles, self._edges = len(mesh.triangles) * model.copies, len(mesh.edges) * model.copies
        piece, points = self._pieces(model.in_model(mesh.edges))
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
        self._centre = int(np.linalg.norm(model.rest_points - model.rest_points.mean(axis=0), axis=1).argmin())
        self._found = wp.clone(model.positions)
        self.flag = wp.zeros(1, dtype=wp.int32, device=device)
        self._rows = Scan(model, model.count + self._edges)
        self._vertices = Scan(model, model.count)
        self._pairs_of = {each: model.kernel(kernels.find_pairs, model.dtype, each) for each in (False, True)}
        self._launch = model.launcher(
            (
                (kernels.count_items, kernels.fill_buckets, kernels.fill_rows, kernels.write_pairs, kernels.fill_corners),
                model.dtype,
            ),
            ((kernels.find_motion,), model.dtype),
            ((kernels.sort_corners,),),
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

    def _pieces(self, edges):
        """The connected piece of each vertex, −1 of one of no element, and rest points about the middle of each piece."""
        n, points = self.model.per_copy, self.model.rest_points
        joined = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
        count, piece = connected_components(joined, directed=False)
        sizes = np.bincount(piece, minlength=count)
        middle = np.stack([np.bincount(piece, axis, count) for axis in points.T], axis=1) / sizes[:, None]
        return np.where(sizes[piece] > 1, piece, -1).astype(np.int32), points - middle[piece]

    def _allocate_grid(self):
        model, items = self.model, self._triangles + self._edges
        size = 0.5 * (1.05 * model.scene.mesh.edge_lengths.max() + self.distance + self.skin)
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
        self.stencils, self.distances = zeros(capacity, wp.vec4i), zeros(capacity, model.dtype)
        self.first, self.corners = zeros(model.count + 1), zeros(4 * capacity)
        self._arrays = {
            "counts": self.counts,
            "found": zeros(capacity, wp.vec2i),
            "row_counts": zeros(rows),
            "first": zeros(rows + 1),
            "items": zeros(capacity),
            "stencils": self.stencils,
            "distances": self.distances,
            "corner_counts": zeros(model.count),
        }
        self._pairs = kernels.pair_lists(model.dtype)()
        for name, value in self._arrays.items():
            setattr(self._pairs, name, value)

    def launch(self, x):
        """Launches the detection at positions x (N,)."""
        surface, grid, pairs, N = self._surface, self._grid, self._pairs, self.model.count
        items, own = self._triangles + self._edges, self._arrays
        wp.copy(self._found, x)
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
        self._vertices.launch(own["corner_counts"], self.first)
        self._launch(kernels.fill_corners, self.capacity, [pairs, self.first], [self.corners])
        self._launch(kernels.sort_corners, N, [self.first], [self.corners])

    def moved(self, x):
        """Launches flag = 1 where pairs may be missing at x (N,), else 0, and returns it; for :func:`warp.capture_if`.

        That is if a vertex has moved by more than half the skin since the last detection, apart from the motion that a vertex in
        the middle of its copy has made.
        """
        self.flag.zero_()
        given = [x, self._found, self.model.per_copy, self._centre, 0.5 * self.skin]
        self._launch(kernels.find_motion, self.model.count, given, [self.flag])
        return self.flag

    @property
    def overflowed(self):
        """Whether the last detection found more pairs than there is room for, read on the host."""
        return self._mirror.read().sum(dtype=np.int64) > self.capacity

    @in_turn
    def grow(self):
        """Allocates room for half as many more pairs as were found. What was recorded with the old arrays must be recorded anew.

        Raises:
            ValueError: There is no memory for it.
        """
        self._allocate(int(1.5 * self._mirror.read().sum(dtype=np.int64)))
