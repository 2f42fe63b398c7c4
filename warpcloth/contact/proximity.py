"""Lists near vertex–triangle pairs and edge–edge pairs, on the device and in a fixed order."""

import numpy as np
import warp as wp

from ..base.limits import refuse_memory
from ..core.capture import Mirror
from ..core.filled import filled
from ..core.scan import Scan
from ..kernels.contact import local_motion, piece_motion, proximity_grid
from ..kernels.contact import proximity as kernels
from ..kernels.contact.pair_potential import CLOSE

# The longest move of a vertex in a round of the filter, relative to the common motion, over the skin. A list serves for another
# round while its sides have approached by less than the rest of the skin. Meshes stand in a round. A round moves a vertex by a
# 64th less, so that a list serves two rounds despite rounding.
MAX_MOVE = 0.25
ROUND = MAX_MOVE * 63 / 64
# Memory of a listed pair, with its gap, its near face and two keys [bytes].
BYTES_OF_A_PAIR = 200
# Edges along a cluster of vertices whose moves have a mean.
CLUSTER = 8
MAX_PAIRS = (1 << 28) - 1  # four corners of each of two keys


class Proximity:
    """The vertex–triangle pairs and edge–edge pairs that are near one another in each copy of a surface.

    A pair is listed if its distance is below r_c + skin. r_c is the contact distance, but at most half the rest distance of two
    elements of one piece; for edges and vertices of meshes it is CLOSE r or, if more, such that gaps up to r are known until
    :meth:`launch_kept` lists again. Pairs with a common vertex or with coordinates that are not finite are not listed.

    Args:
        distance: The contact distance r [m].
        skin: The list is complete until two vertices have approached one another by it [m].
        of_meshes: The contact distance of cloth with meshes [m].

    Attributes:
        stencils: (capacity,) vertices (v, a, b, c) of vertex–triangle pairs, sorted, then (a, b, c, d) of edges ab and cd.
        distances: (capacity,) r_c of each pair [m].
        counts: (2,) int32, numbers of pairs of each kind, which may exceed the capacity.
        rows: Pairs rows[i] to rows[i+1] are the vertex–triangle pairs of vertex i; those of edges follow, by their first edge.
        found: Positions of the last list, (V,) [m]. After setting them, call :meth:`launch_kept` before the list is used.
        kept: The ``part`` of :meth:`moved` up to which a list serves for another round of the filter.
        listed: Positions (V,) [m] of the list that is in the arrays.
        pieces: The connected piece of each vertex of a copy of the cloth, −1 without an element, (n,).
        drift: Motion of each piece of all copies since ``found`` [m].
    """

    def __init__(self, surface, distance, skin, of_meshes=0.0):
        self.surface, self.model, self.skin = surface, surface.model, skin
        model, device = self.model, self.model.device
        self.kept = 0.5 * (1.0 - (2.0 if surface.meets_itself else 1.0) * MAX_MOVE)
        self._max_distance = max(distance * surface.meets_itself, of_meshes)
        self._triangles, self._edges, self._vertices = surface.triangles, surface.edges, surface.count
        self.pieces, points = self._connected(model.in_model(model.scene.mesh.edges))
        piece = surface.pieces(self.pieces)
        rest = np.concatenate([points, surface.rest[len(points) :]])
        boxes = model.copies if surface.obstacles else 0
        values = {
            "items": wp.array(surface.items, dtype=wp.vec4i, device=device),
            "groups": wp.array(surface.groups, dtype=wp.int32, device=device),
            "vertex_groups": wp.array(surface.vertex_groups, dtype=wp.int32, device=device),
            "rest": model.array(rest, model.vec3),
            "piece": wp.array(piece, dtype=wp.int32, device=device),
            "lowest": wp.zeros(boxes, dtype=model.vec3, device=device),
            "highest": wp.zeros(boxes, dtype=model.vec3, device=device),
        }
        values |= {"layout": surface.layout, "itself": surface.meets_itself, "distance": distance, "of_meshes": of_meshes}
        values |= {"close": max(float(CLOSE) * of_meshes, of_meshes - (1.0 - 2.0 * self.kept) * skin)}
        values |= {"max_distance": self._max_distance, "skin": skin, "far": 2.0 * (distance + surface.edge_lengths.max())}
        self._surface = filled(proximity_grid.surfaces(model.dtype), **values)
        touching = dict.fromkeys(("close", "max_distance", "skin"), 0.0)
        self._along = filled(proximity_grid.surfaces(model.dtype), **values | touching)
        self._allocate_grid()
        self._set_pieces(piece)
        self._set_clusters(points)
        # Threads that share a search repeat work, so they are at most a million. Of 1, 2, 4 and 8 shares 8 is fastest with 64²
        # vertices, 4 with 256², and 1 with 512² (one H200).
        most = min((1 << 20) // max(self._edges, 1), 8)
        self._shares = 1 << max(most.bit_length() - 1, 0) if model.device.is_cuda else 1
        self.found, self.listed = surface.vectors(), surface.vectors()  # all 0, so that the first call makes a list
        self.flag, self._due = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self.copies = model.scalars(wp.int32)
        self._rows = Scan(model, self._vertices + self._edges)
        self._near = self.searches(kernels.take_near, "near")
        self._launch = model.launcher(
            ((proximity_grid.bound_cloth, proximity_grid.count_items, proximity_grid.fill_buckets), model.dtype),
            ((proximity_grid.note_large,), model.dtype),
            ((kernels.write_pairs,), model.dtype),
            ((piece_motion.extend_boxes, piece_motion.find_drift, piece_motion.compare_positions), model.dtype),
            ((piece_motion.find_motion, piece_motion.compare_motions, piece_motion.add_positions), model.dtype),
            ((local_motion.find_means, local_motion.note_moves, local_motion.bound_moves), model.dtype),
        )
        self.counts = wp.zeros(2, dtype=wp.int32, device=device)
        self._mirror = Mirror(self.counts)
        self._allocate(max(1024, 4 * model.count))

    def _connected(self, edges):
        """Returns :attr:`pieces`, and rest points relative to the middle of their piece."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        n, points = self.model.per_copy, self.model.rest_points
        joined = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
        count, piece = connected_components(joined, directed=False)
        sizes = np.bincount(piece, minlength=count)
        middle = np.stack([np.bincount(piece, axis, count) for axis in points.T], axis=1) / sizes[:, None]
        return np.where(sizes[piece] > 1, piece, -1).astype(np.int32), points - middle[piece]

    def _set_pieces(self, piece):
        model, surface = self.model, self.surface
        used, numbers = np.unique(piece[piece >= 0], return_inverse=True)
        number = np.full(len(piece), -1)
        number[piece >= 0] = numbers
        members = np.argsort(number, kind="stable")
        ends = np.searchsorted(number[members], np.arange(len(used) + 1))
        part = (np.arange(piece_motion.SAMPLES) + 0.5) * 0.6180339887 % 1.0
        samples = members[(ends[:-1, None] + np.diff(ends)[:, None] * part).astype(int)].ravel()
        n, copy = model.per_copy, np.arange(model.copies)[:, None]
        of_copies = np.where(number < 0, -1, number + copy * len(used))
        arrays = {
            "piece": np.concatenate([of_copies[:, :n].ravel(), of_copies[:, n:].ravel()]),
            "samples": np.where(samples < n, samples + copy * n, model.count + copy * surface.obstacles + samples - n).ravel(),
        }
        arrays = {name: wp.array(each, dtype=wp.int32, device=model.device) for name, each in arrays.items()}
        kinds = {"drift": model.vec3}
        if len(used) > 1:
            kinds |= {"lower": model.vec3, "upper": model.vec3, "motion": model.dtype}
        size = model.copies * len(used)
        arrays |= {name: wp.zeros(size, dtype=kind, device=model.device) for name, kind in kinds.items()}
        numbers = {"per_copy": len(used), "cloth": len(used) - len(np.unique(surface.colliders))}
        meets = {"layout": surface.layout, "itself": surface.meets_itself}
        self._pieces = filled(piece_motion.pieces(model.dtype), **numbers, **meets, **arrays)
        self.drift = self._pieces.drift

    def _set_clusters(self, points):
        """Divides pieces into clusters of vertices, in cubes of CLUSTER edges at rest."""
        model, n, device = self.model, self.model.per_copy, self.model.device
        copies, used = np.arange(model.copies)[:, None], np.flatnonzero(self.pieces >= 0)
        cubes = np.floor(points[used] / (CLUSTER * np.median(self.surface.edge_lengths))).astype(np.int64)
        _, cluster = np.unique(np.column_stack([self.pieces[used], cubes]), axis=0, return_inverse=True)
        sizes = np.bincount(cluster.ravel())
        members = used[np.argsort(cluster.ravel(), kind="stable")]
        of_vertices = np.full(n, -1)
        of_vertices[used] = cluster.ravel()
        numbers = {
            "first": np.concatenate([[0], np.cumsum(np.tile(sizes, model.copies))]),
            "members": (members + n * copies).ravel(),
            "cluster": np.where(of_vertices < 0, -1, of_vertices + len(sizes) * copies).ravel(),
            "calm": np.zeros(model.count),
        }
        arrays = {name: wp.array(each.astype(np.int32), device=device) for name, each in numbers.items()}
        counts = {"mean": len(sizes) * model.copies, "lowest": model.copies, "highest": model.copies}
        counts |= {"low": self._vertices, "high": self._vertices, "tables": (4, 1 << max(4, (model.count // 4).bit_length()))}
        arrays |= {name: wp.zeros(count, dtype=model.vec3, device=device) for name, count in counts.items()}
        arrays["some"] = wp.zeros(1, dtype=wp.int32, device=device)
        self.alike = (1.0 - 2.0**-6) * self.skin
        values = {"layout": self.surface.layout, "size": self._grid.size, "alike": (1.0 - 2.0**-10) * self.alike}
        self._motion = filled(local_motion.motions(model.dtype), **values, **arrays)

    def _allocate_grid(self):
        model, items, lengths = self.model, self._triangles + self._edges, self.surface.edge_lengths
        size = 0.5 * (min(1.05 * lengths.max(), 2.0 * np.median(lengths)) + self._max_distance + self.skin)
        buckets = 1 << max(4, (items - 1).bit_length())
        counts = {"levels": 4, "counts": buckets, "keys": items, "first": buckets + 1}
        arrays = {name: wp.zeros(count, dtype=wp.int32, device=model.device) for name, count in counts.items()}
        for name, kind in (("boxes", wp.types.vector(8, model.dtype)), ("entries", wp.vec4i)):
            arrays[name] = wp.zeros(items, dtype=kind, device=model.device)
        arrays["extents"] = wp.zeros((4, proximity_grid.LEVELS + 1), dtype=model.vec3, device=model.device)
        self._grid = filled(proximity_grid.grids(model.dtype), size=size, **arrays)
        self._buckets = Scan(model, buckets)

    def _allocate(self, capacity):
        model, rows = self.model, self._vertices + self._edges
        what = f"the cloth needs room for {capacity} pairs that are near one another"
        if capacity > MAX_PAIRS:
            raise ValueError(f"{what}; it must be at most {MAX_PAIRS}, because corners of contacts are numbered in 32 bits")
        refuse_memory(what, BYTES_OF_A_PAIR * capacity, model.device)

        def zeros(count, dtype=wp.int32):
            return wp.zeros(count, dtype=dtype, device=model.device)

        self.capacity = capacity
        self.listed.fill_(np.nan)
        self.stencils, self.distances = zeros(capacity, wp.vec4i), zeros(capacity, wp.float64)
        self.rows = zeros(rows + 1)
        self._pairs = filled(
            kernels.PairList,
            counts=self.counts,
            found=zeros(capacity, wp.vec2i),
            row_counts=zeros(rows),
            first=self.rows,
            items=zeros(capacity),
            stencils=self.stencils,
            distances=self.distances,
        )

    def set_skin(self, skin):
        """Sets another skin [m]; the next :meth:`launch_kept` lists again."""
        self._surface.skin = skin
        self.listed.fill_(np.nan)

    def launch_moved(self, x):
        """Launches the detection at x (V,) in ``copies``, after :meth:`moved`, and at ``found`` in the others."""
        given = [x, None, 1.0, self.copies, self.surface.layout]
        self._launch(piece_motion.add_positions, self._vertices, given, [self.found])
        self.launch(self.found)

    def launch(self, x):
        pairs, N = self._pairs, self._vertices
        if x is not self.found:
            wp.copy(self.found, x)
        wp.copy(self.listed, x)
        if self._pieces.per_copy > 1:
            self._launch_boxes(x)
        self.counts.zero_()
        self._launch_grid(self._surface, x, None, self._near, pairs)
        self._rows.launch(pairs.row_counts, pairs.first)
        self.model.launch(kernels.fill_rows, self.capacity, [], [pairs])
        self._launch(kernels.write_pairs, N + self._edges, [self._surface, N, self._triangles], [pairs])

    def searches(self, take, name):
        """Returns the kernels of :func:`warpcloth.kernels.contact.proximity.search_pairs`."""
        return [self.model.kernel(kernels.search_pairs, self.model.dtype, each, take, name) for each in (False, True)]

    def launch_along(self, x, p, searches, out):
        """Launches ``searches`` of pairs whose boxes meet while vertices move from x (V,) by p [m], (V,) or (N,).

        Call :meth:`launch_apart` before. Pairs of the cloth may be left out whose sides move by at most ``alike`` [m] relative
        to one another.
        """
        self._launch_grid(self._along, x, p, searches, out)

    def launch_apart(self, x, p, far):
        """Sets ``far`` (1,) to 0 if pairs that are not listed stay apart while vertices move from x (V,) by p [m], else to 1.

        They do if all cloth that may come near moves by at most ``alike`` [m] relative to one another, from ``found`` on. If
        cloth does not meet itself, ``far`` does not change.
        """
        if not self.surface.meets_itself:
            return
        motion, model = self._motion, self.model
        for array, start in ((motion.lowest, np.inf), (motion.highest, -np.inf)):
            array.fill_(start)
        for k, start in enumerate((np.inf, -np.inf) * 2):
            motion.tables[k].fill_(start)
        motion.some.zero_()
        self._launch(local_motion.find_means, len(motion.mean) + self._vertices - model.count, [p], [motion])
        self._launch(local_motion.note_moves, model.count, [x, p, self.found], [motion])
        self._launch(local_motion.bound_moves, self._vertices, [x], [motion])
        given = [self._along, x, self._grid.size, self._triangles]
        self._launch(proximity_grid.note_large, self._edges, given, [motion])
        wp.copy(far, motion.some)

    def _launch_grid(self, surface, x, p, searches, out):
        grid, items, model = self._grid, self._triangles + self._edges, self.model
        grid.levels.zero_()
        grid.extents.zero_()
        if self.surface.obstacles:
            surface.lowest.fill_(np.inf)
            surface.highest.fill_(-np.inf)
            self._launch(proximity_grid.bound_cloth, model.count, [surface, x, p], [])
        self._launch(proximity_grid.count_items, items, [surface, x, p, self._motion], [grid])
        self._buckets.launch(grid.counts, grid.first)
        self._launch(proximity_grid.fill_buckets, items, [surface, x, p, self._motion], [grid])
        for search, count in zip(searches, (self._vertices if self._triangles else 0, self._edges), strict=True):
            if count:
                given = [surface, x, p, self._motion, grid, self._triangles, self._shares]
                self.model.launch(search, (count, self._shares), given, [out])

    def _launch_boxes(self, x):
        self._pieces.lower.fill_(np.inf)
        self._pieces.upper.fill_(-np.inf)
        self._launch(piece_motion.extend_boxes, self._vertices, [x], [self._pieces])

    def launch_kept(self, x, launch):
        """Calls ``launch`` with x if :meth:`moved` sets the flag for ``kept``, or if the list is not that of ``found``."""
        for array in (self.flag, self.copies, self._due):
            array.zero_()
        self._launch(piece_motion.compare_positions, self._vertices, [self.found, self.listed], [self._due])
        self._launch_moved_since(x, self.kept, None, self.flag)
        wp.capture_if(self._due, launch, x=x)

    def moved(self, x, part=0.5, active=None):
        """Launches flag = 1 if pairs may be missing at x (V,), else 0, and returns it; ``copies`` is 1 for copies with such.

        The flag is 0 while each vertex has moved by at most ``part`` of the skin since the last list, relative to the drift of
        its piece, and two pieces have approached one another by at most twice that and the excess of the distance of their
        boxes over the contact distance and the skin.

        Args:
            x: Positions (V,) [m].
            part: At most ½. If the flag is 0, no pair within its r_c is missing, also after each vertex moves by another
                fraction ½ − ``part`` of the skin.
            active: Copies that count (B,) int32; None for all.
        """
        self.flag.zero_()
        self.launch_moved_since(x, part, active, self.flag)
        return self.flag

    def launch_moved_since(self, x, part, active, flag, correction=None):
        """Launches ``flag`` (1,) = 1 where :meth:`moved` sets it, at x (V,) + ``correction`` (N,)."""
        for array in (self.copies, self._due):
            array.zero_()
        self._launch_moved_since(x, part, active, flag, correction)

    def _launch_moved_since(self, x, part, active, flag, correction=None):
        several = self._pieces.per_copy > 1
        if several:
            self._pieces.motion.zero_()
        at = [x, correction, self.found]
        self._launch(piece_motion.find_drift, len(self.drift), at, [self._pieces])
        most = part * self.skin if self.surface.meets_itself else np.inf
        given, out = [*at, active, most], [self._pieces, self.copies, flag, self._due]
        self._launch(piece_motion.find_motion, self._vertices, given, out)
        if several:
            wp.capture_if(self._due, lambda: self._launch_boxes(self.found))
            given = [self._pieces, active, self._max_distance + self.skin, 2.0 * part * self.skin]
            self._launch(piece_motion.compare_motions, len(self.drift), given, [self.copies, flag, self._due])

    @property
    def overflowed(self):
        """Whether more pairs were found than fit; waits for the device."""
        return self._mirror.read().sum(dtype=np.int64) > self.capacity

    def grow(self, count=None):
        """Allocates room for 1.5 times ``count`` pairs, by default as last found. Graphs must be recorded again.

        Raises:
            ValueError: There is not enough memory.
        """
        self._allocate(int(1.5 * (self._mirror.read().sum(dtype=np.int64) if count is None else count)))
