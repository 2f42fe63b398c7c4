"""Sweeps over the constraints of a model: Jacobi with three ways to keep it from overshooting, Gauss–Seidel by colour or not.

Gauss–Seidel lets each constraint see the moves of those before it. Constraints of one colour share no vertex that moves, so
their order does not matter and they run at once; between colours, and between terms, the order is fixed and changes the result.
"""

import numpy as np
import warp as wp

from ..core.thread_pool import ThreadPool
from ..fast.plan import plan
from ..kernels import project as kernels
from ..kernels.clusters import correct_clusters
from ..kernels.sparse import correct_cells
from ..model.host_values import host_values
from ..terms.refresh import EVALUATION, Moment

# By vertex: the average of where a vertex's n constraints want it, and α times where it is. By constraint: each correction over
# the largest n of its vertices. Jacobi: the plain sum.
SWEEPS = ("vertex-averaged", "constraint-averaged", "jacobi", "coloured", "sequential")
# Gauss–Seidel: an element sees the moves of those before it.
IN_PLACE = ("coloured", "sequential")


def colours(constraints, free):
    """Colours of elements, so that no two of one colour share a free vertex: (E,) int, from 0 without gaps.

    By Warp's maximum cardinality search: 8 colours for the structural and shear springs of a grid, which is the least, and 18
    for the hinges of an alternating one.

    Args:
        constraints: Vertices of each, (E, K) or a list of E arrays.
        free: Which vertices move, (n,); pinned ones may be shared (the hinges of ``bunny`` then need 17 colours, not 20).
    """
    sizes = [len(vertices) for vertices in constraints]
    elements, vertices = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes), np.concatenate(constraints)
    keep = free[vertices]
    order = np.argsort(vertices[keep], kind="stable")
    elements, vertices = elements[keep][order], vertices[keep][order]
    # Each element at a vertex is a neighbour of those before it there.
    first = np.searchsorted(vertices, vertices)
    before = np.arange(len(vertices)) - first
    others = np.arange(before.sum()) - np.repeat(np.cumsum(before) - before - first, before)
    pairs = np.stack([np.repeat(elements, before), elements[others]], axis=1)
    found = wp.zeros(len(sizes), dtype=wp.int32, device="cpu")
    if len(pairs):
        wp.utils.graph_coloring_assign(wp.array(pairs, dtype=wp.int32, device="cpu"), found)
    return found.numpy()


class _Sweep:
    """Sweeps over all constraints of a model, term by term as declared, which move the correction d from x̃ on.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃, (N,) vectors [m]; read only.
        h: Step [s].
        relaxation: ω, a factor of every Δλ.
        scalar: Whether terms that have both are taken by their scalar constraint.
        multipliers: Whether λ adds up over the sweeps of a step (XPBD).
        correction: The d to move on, if not one of its own.

    Attributes:
        correction: d (N,) [m].
        multipliers: λ of each term, (B·E,) numbers or M × 3 matrices, in the order of ``elements``, or Nones.
        elements: :class:`warpcloth.model.elements.DeviceElements` of each term, in the order of the sweep.
    """

    def __init__(self, model, x, h, relaxation, scalar, multipliers, correction):
        self.model, self.x, self.h, self.relaxation = model, x, h, relaxation
        self.correction, self.elements = model.vectors() if correction is None else correction, list(model.terms)
        self._keys = []
        for elements in model.terms:
            term = elements.term.whole
            only = term.project is None and term.prox is None
            self._keys.append((term, model.dtype, only or (scalar and term.constraint is not None)))
        self.multipliers = [
            wp.zeros(elements.count, dtype=kernels.multiplier_type(*key), device=model.device) if multipliers else None
            for elements, key in zip(model.terms, self._keys, strict=True)
        ]

    def with_multipliers(self):
        """Triples of the elements of each term, their multipliers, and the term, dtype and whether these are numbers."""
        return zip(self.elements, self.multipliers, self._keys, strict=True)


class JacobiSweep(_Sweep):
    """Jacobi sweeps, in which each constraint sees where its vertices were before.

    ``launch_start``, ``launch`` and ``parts`` are those of :class:`warpcloth.core.jacobi_sweeps.JacobiSweeps`.

    Args:
        model, x, h, relaxation, scalar, multipliers: See :class:`_Sweep`.
        kind: One of :data:`SWEEPS` that is not in :data:`IN_PLACE`.
        alpha: α of the average by vertex.
        spread: The number of sweeps that finite stiffness is spread over, or None.
        backend: See :func:`warpcloth.fast.plan.plan`.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, whose pairs all move after the elements; or None.
    """

    def __init__(
        self,
        model,
        x,
        h,
        kind,
        relaxation,
        alpha=0.0,
        scalar=False,
        multipliers=False,
        spread=None,
        backend="auto",
        pairs=None,
    ):
        super().__init__(model, x, h, relaxation, scalar, multipliers, None)
        for elements in model.terms:
            if elements.term.cell:
                raise ValueError(
                    f"sweep is {kind!r} with {elements.label}, whose elements differ in their number of vertices; it must be "
                    '"coloured" or "sequential"'
                )
        given = x, h, self.correction, self.multipliers, self._keys, *self._weights(kind, alpha), spread
        sweeps = plan(model, backend).jacobi_sweeps(*given)
        self.launch_start, self.launch, self.parts = sweeps.launch_start, sweeps.launch, sweeps.parts
        if pairs is not None:
            self._elements, self.pairs, self._adds = sweeps, pairs, multipliers
            pairs.forces.sweeps(in_turn=False)
            self.launch_start, self.launch, self.parts = self._launch_start, self._launch, self._parts

    def _launch_start(self):
        self.pairs.forces.launch_sweep_start(self.x)
        self._elements.launch_start()

    def _launch(self):
        self._elements.launch(1)
        self.pairs.forces.launch_sweep(self.x, self.correction, self.h, self._adds)

    def _parts(self, sweeps):
        return [(self._launch, sweeps)]

    def _weights(self, kind, alpha):
        """Factors of elements and of vertices."""
        model, terms = self.model, self.model.terms
        even = [model.constant(self.relaxation, elements.count) for elements in terms]
        if kind == "jacobi":
            return even, model.constant(1.0, model.count)
        constraints = np.zeros(model.count)
        for elements in terms:
            constraints += np.bincount(host_values(elements.stencil).ravel(), minlength=model.count)
        if kind == "vertex-averaged":
            return even, model.array(1.0 / np.maximum(constraints + alpha, np.finfo(np.float32).tiny), model.dtype)
        constraints[model.inverse_mass.numpy() == 0.0] = 1.0  # a vertex that does not move cannot overshoot
        largest = [constraints[host_values(elements.stencil)].max(axis=1) for elements in terms]
        for i, elements in enumerate(terms):
            if elements.cells:  # one factor for all of a cell
                firsts = host_values(elements.cells.offsets)[:-1]
                largest[i] = np.repeat(np.maximum.reduceat(largest[i], firsts), elements.cells.sizes)
        return [model.array(self.relaxation / each, model.dtype) for each in largest], model.constant(1.0, model.count)


def _correction(elements, dtype, key):
    """The factory of the kernel that sweeps over the elements, and the first of its arguments."""
    if elements.term.cell:
        return correct_cells, elements.term.cell, dtype
    return (correct_clusters, dtype) if elements.cells else (kernels.correct_in_place, *key)


class GaussSeidelSweep(_Sweep):
    """Gauss–Seidel sweeps, in which each constraint sees the moves of those before it.

    Args:
        model, x, h, relaxation, scalar, multipliers, correction: See :class:`_Sweep`.
        kind: One of :data:`IN_PLACE`.
        spread: The number of sweeps that finite stiffness is spread over, or None.
        pool: The :class:`warpcloth.core.thread_pool.ThreadPool` that shares sweeps by colour; None for one thread.
        before: Positions where the step began (N,), by which one thread of the CPU lists the elements that may have a force, of
            terms with ``clear``; or None.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, whose pairs are swept last; or None.

    Attributes:
        ranges: The (first, count) of the elements that each launch takes, of each term.
    """

    def __init__(
        self,
        model,
        x,
        h,
        kind,
        relaxation,
        scalar=False,
        multipliers=False,
        spread=None,
        correction=None,
        pool=None,
        before=None,
        pairs=None,
    ):
        self.pairs = pairs
        super().__init__(model, x, h, relaxation, scalar, multipliers, correction)
        self.multipliers_add = multipliers
        if pairs is not None:
            pairs.forces.sweeps(in_turn=True)
        self.pool, self.spread, self.ordered = pool or ThreadPool(1), spread or 1, kind == "sequential"
        self.ranges = [[(0, (elements.cells or elements).count)] for elements in model.terms]
        if kind == "coloured" and model.terms:
            self.elements, self.ranges = zip(*map(self._by_colour, model.terms), strict=True)
        # Cells fit themselves as they are swept.
        refreshed = [elements for elements in self.elements if elements.refresh and not elements.cells]
        self._refreshed = [elements for elements in refreshed if elements.refresh.when == EVALUATION]
        more = multipliers, spread is not None, model.mobility is not None
        listing = before is not None and model.device.is_cpu and self.pool.threads == 1
        self._lists = [listing and self._list_of(*each, before) for each in self.with_multipliers()]
        self._kernels = [
            model.kernel(*_correction(elements, model.dtype, key), *more, *([True] if listed else []))
            for elements, key, listed in zip(model.terms, self._keys, self._lists, strict=True)
        ]

    def _list_of(self, elements, multipliers, key, before):
        """(kernel, arguments, counter of sweeps, list) of a term with ``clear``; else None."""
        term, dtype, scalar = key
        if elements.clear is None or scalar:
            return None
        model = self.model
        kernel = model.kernel(kernels.list_busy, term, dtype, multipliers is not None)
        given = [elements.stencil, elements.clear, before, self.x, self.correction, multipliers]
        sweep, busy = (wp.zeros(n, dtype=wp.int32, device=model.device) for n in (1, 1 + elements.count))
        return kernel, given, sweep, busy

    def _by_colour(self, elements):
        """The elements of all copies by colour, and the range of each colour."""
        model = self.model
        free = model.inverse_mass.numpy()[: model.per_copy] > 0.0
        one = elements.constraints[: elements.cells.per_copy if elements.cells else elements.per_copy]
        colour = np.tile(colours(one, free), model.copies)
        counts = np.bincount(colour)
        firsts = np.cumsum(counts) - counts
        return elements.reordered(np.argsort(colour, kind="stable")), list(zip(firsts.tolist(), counts.tolist(), strict=True))

    def launch_start(self):
        """Launches d = 0, λ = 0, once x̃ is there."""
        if self.pairs is not None:
            self.pairs.forces.launch_sweep_start(self.x)
        counters = [each[2] for each in self._lists if each]
        for array in (self.correction, *self.multipliers, *counters):
            if array is not None:
                array.zero_()

    def parts(self, sweeps):
        """Returns pairs of a function that launches and of how many times it runs, for so many sweeps."""
        return [(self.launch, sweeps)]

    def launch(self, backward=False):
        """Launches one sweep, or one backward, from the last term, colour and element to the first."""
        model, pool = self.model, self.pool
        if self._refreshed:
            pool.launch_alone(model, lambda: model.refresh(EVALUATION, Moment(self.x, self.correction), self._refreshed))
        way = -1 if backward else 1
        if backward:
            self._sweep_pairs(backward)
        for i in range(len(self.elements))[::way]:
            elements = self.elements[i]
            cells = elements.cells
            of_elements = elements.arguments
            if elements.term.cell:
                of_elements = [cells.offsets, cells.weights, cells.rest, elements.stencil, elements.stiffness]
            elif cells:
                of_elements = [cells.offsets, cells.shape, *of_elements]
            each = (cells or elements).per_copy if self.ordered else 1
            if self._lists[i]:
                find, listed, sweep, busy = self._lists[i]
                model.launch(find, 1, listed, [sweep, busy])
            for first, count in self.ranges[i][::way]:
                before, part = pool.part(count // each)
                # A thread of the CPU takes all its elements in one loop, in half of the time that as many threads take.
                threads, each_thread = (1, part * each) if model.device.is_cpu else (part, each)
                turn = kernels.sweep_turn(model.dtype)()
                turn.first, turn.each = first + before * each, way * each_thread
                turn.h, turn.sweeps, turn.relaxation = self.h, self.spread, self.relaxation
                if self._lists[i]:
                    turn.busy = busy
                given = [*of_elements, model.local_mobility, self.x, turn]
                if part:
                    model.launch(self._kernels[i], threads, given, [self.multipliers[i], self.correction])
                pool.launch_barrier(model)
        if not backward:
            self._sweep_pairs(backward)

    def _sweep_pairs(self, backward):
        if self.pairs is not None:
            self.pairs.forces.launch_sweep(self.x, self.correction, self.h, self.multipliers_add, backward)
