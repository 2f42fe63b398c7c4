"""Sweeps over the constraints of a model: Jacobi sweeps of three kinds, and Gauss–Seidel sweeps, coloured or sequential.

In Gauss–Seidel sweeps, each constraint sees the moves of those before it. Constraints of one colour share no free vertex, so
they run in parallel. The order of colours and terms is fixed, and affects the result.
"""

import numpy as np
import warp as wp

from ..core.dynamic import dynamic_of
from ..fast.plan import plan
from ..kernels import project as kernels
from ..kernels.clusters import correct_clusters
from ..kernels.sparse import correct_cells
from ..model.host_values import host_values
from ..terms.refresh import EVALUATION, Moment

# "vertex-averaged": a vertex moves to the average of the targets of its n constraints and of α times its position.
# "constraint-averaged": each correction is divided by the largest n of its vertices. "jacobi": corrections add up.
SWEEPS = ("vertex-averaged", "constraint-averaged", "jacobi", "coloured", "sequential")
# Gauss–Seidel sweeps.
IN_PLACE = ("coloured", "sequential")


def colours(constraints, free):
    """Returns colours of elements such that no two of one colour share a free vertex: (E,) int, from 0 without gaps.

    Warp's maximum cardinality search finds 8 colours for the structural and shear springs of a grid, the optimum, and 18 for
    the hinges of an alternating grid.

    Args:
        constraints: Vertices of each element, (E, K) or a list of E arrays.
        free: Which vertices are free, (n,).
    """
    sizes = [len(vertices) for vertices in constraints]
    elements, vertices = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes), np.concatenate(constraints)
    keep = free[vertices]
    order = np.argsort(vertices[keep], kind="stable")
    elements, vertices = elements[keep][order], vertices[keep][order]
    # Elements at a vertex are neighbours in the graph.
    first = np.searchsorted(vertices, vertices)
    before = np.arange(len(vertices)) - first
    others = np.arange(before.sum()) - np.repeat(np.cumsum(before) - before - first, before)
    pairs = np.stack([np.repeat(elements, before), elements[others]], axis=1)
    found = wp.zeros(len(sizes), dtype=wp.int32, device="cpu")
    if len(pairs):
        wp.utils.graph_coloring_assign(wp.array(pairs, dtype=wp.int32, device="cpu"), found)
    return found.numpy()


class _Sweep:
    """The base class of sweeps over all constraints, term by term as declared, then dynamic ones, which update d = x − x̃.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃, (N,) vectors [m]; read only.
        h: Step [s].
        relaxation: ω, a factor on every Δλ.
        scalar: Whether to use the scalar constraint of terms that have a projection too.
        multipliers: Whether λ accumulates over the sweeps of a step (XPBD).
        correction: The array of d, or None for a new one.

    Attributes:
        correction: d (N,) [m].
        multipliers: λ of each term, (B·E,) numbers or M × 3 matrices, in the order of ``elements``, or None.
        elements: :class:`warpcloth.model.elements.DeviceElements` of each term, in the order of the sweep.
    """

    def __init__(self, model, x, h, relaxation, scalar, multipliers, correction):
        self.model, self.x, self.h, self.relaxation = model, x, h, relaxation
        self.correction, self.elements = model.vectors() if correction is None else correction, list(model.terms)
        self._keys, self._dynamic = [], dynamic_of(model)
        for elements in model.terms:
            term = elements.term.whole
            only = term.project is None and term.prox is None
            self._keys.append((term, model.dtype, term.constraint is not None and (only or scalar)))
        self.multipliers = [
            wp.zeros(elements.count, dtype=kernels.multiplier_type(*key), device=model.device) if multipliers else None
            for elements, key in zip(model.terms, self._keys, strict=True)
        ]

    def with_multipliers(self):
        """Returns triples: the elements of each term, their multipliers, and (term, dtype, whether multipliers are numbers)."""
        return zip(self.elements, self.multipliers, self._keys, strict=True)


class JacobiSweep(_Sweep):
    """Jacobi sweeps, in which all constraints see the positions before the sweep.

    Args:
        model, x, h, relaxation, scalar, multipliers: See :class:`_Sweep`.
        kind: One of :data:`SWEEPS` that is not in :data:`IN_PLACE`.
        alpha: α of ``"vertex-averaged"``.
        spread: Number of sweeps over which the correction of finite stiffness is spread, or None.
        backend: See :func:`warpcloth.fast.plan.plan`.
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
        if self._dynamic:
            self._elements, self._adds = sweeps, multipliers
            self._dynamic.sweeps(in_turn=False)
            self.launch_start, self.launch, self.parts = self._launch_start, self._launch, self._parts

    def _launch_start(self):
        self._dynamic.launch_sweep_start(self.x)
        self._elements.launch_start()

    def _launch(self, sweeps=1):
        self._elements.launch(sweeps, self._sweep_dynamic)

    def _parts(self, sweeps):
        return self._elements.parts(sweeps, self._sweep_dynamic)

    def _sweep_dynamic(self, correction):
        self._dynamic.launch_sweep(self.x, correction, self.h, self._adds)

    def _weights(self, kind, alpha):
        """Returns the factors of elements and of vertices."""
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
    """Returns the factory of the kernel that sweeps over the elements, and its first arguments."""
    if elements.term.cell:
        return correct_cells, elements.term.cell, dtype
    return (correct_clusters, dtype) if elements.cells else (kernels.correct_in_place, *key)


class GaussSeidelSweep(_Sweep):
    """Gauss–Seidel sweeps, in which each constraint sees the moves of those before it.

    Args:
        model, x, h, relaxation, scalar, multipliers, correction: See :class:`_Sweep`.
        kind: One of :data:`IN_PLACE`.
        spread: Number of sweeps over which the correction of finite stiffness is spread, or None.
        follows: Whether dynamic elements are found anew after some of these sweeps.

    Attributes:
        ranges: For each term, the ranges (first, count) of elements of its launches.
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
        follows=True,
    ):
        super().__init__(model, x, h, relaxation, scalar, multipliers, correction)
        self.multipliers_add, self._follows = multipliers, follows
        self._dynamic.sweeps(in_turn=True)
        self.spread, self.ordered = spread or 1, kind == "sequential"
        self.ranges = [[(0, (elements.cells or elements).count)] for elements in model.terms]
        if kind == "coloured" and model.terms:
            self.elements, self.ranges = zip(*map(self._by_colour, model.terms), strict=True)
        # The sweep over cells updates them itself.
        refreshed = [elements for elements in self.elements if elements.refresh and not elements.cells]
        self._refreshed = [elements for elements in refreshed if elements.refresh.when == EVALUATION]
        more = multipliers, spread is not None, model.mobility is not None
        self._kernels = [
            model.kernel(*_correction(elements, model.dtype, key), *more, *([True] if elements.clear is not None else []))
            for elements, key in zip(model.terms, self._keys, strict=True)
        ]

    def _by_colour(self, elements):
        """Returns the elements of all copies sorted by colour, and the range of each colour."""
        model = self.model
        free = model.inverse_mass.numpy()[: model.per_copy] > 0.0
        one = elements.constraints[: elements.cells.per_copy if elements.cells else elements.per_copy]
        colour = np.tile(colours(one, free), model.copies)
        counts = np.bincount(colour)
        firsts = np.cumsum(counts) - counts
        return elements.reordered(np.argsort(colour, kind="stable")), list(zip(firsts.tolist(), counts.tolist(), strict=True))

    def launch_start(self):
        """Launches d = 0, λ = 0; x must be x̃ already."""
        self._dynamic.launch_sweep_start(self.x)
        for array in (self.correction, *self.multipliers):
            if array is not None:
                array.zero_()

    def parts(self, sweeps):
        """Returns pairs (function that launches, number of calls) for this number of sweeps."""
        return [(self.launch, sweeps)]

    def launch(self, backward=False):
        """Launches one sweep, forward or backward through terms, colours and elements."""
        model = self.model
        if self._refreshed:
            model.refresh(EVALUATION, Moment(self.x, self.correction), self._refreshed)
        way = -1 if backward else 1
        if backward:
            self._sweep_dynamic(backward)
        for i in range(len(self.elements))[::way]:
            elements = self.elements[i]
            cells = elements.cells
            of_elements = [*elements.arguments, elements.clear]
            if elements.term.cell:
                of_elements = [cells.offsets, cells.weights, cells.rest, elements.stencil, elements.stiffness]
            elif cells:
                of_elements = [cells.offsets, cells.shape, *elements.arguments]
            each = (cells or elements).per_copy if self.ordered else 1
            for first, count in self.ranges[i][::way]:
                # On the CPU, one thread loops over all elements, in half of the time of one launch thread per element.
                threads, each_thread = (1, count) if model.device.is_cpu else (count // each, each)
                turn = kernels.sweep_turn(model.dtype)()
                turn.first, turn.each = first, way * each_thread
                turn.h, turn.sweeps, turn.relaxation = self.h, self.spread, self.relaxation
                given = [*of_elements, model.local_mobility, self.x, turn]
                if count:
                    model.launch(self._kernels[i], threads, given, [self.multipliers[i], self.correction])
        if not backward:
            self._sweep_dynamic(backward)

    def _sweep_dynamic(self, backward):
        self._dynamic.launch_sweep(self.x, self.correction, self.h, self.multipliers_add, backward, self._follows)
