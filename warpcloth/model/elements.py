"""The elements of a term on a device."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import warp as wp

from ..kernels.sparse import share
from ..kernels.term import Term
from ..terms.refresh import Refresh
from .csr_cells import Cells, SparseCells, rigid_cells, sparse_cells
from .host_values import host_values, keep, part, release, reordered, repeat


@dataclass(frozen=True, eq=False)
class DeviceElements:
    """The elements of one term in all copies, on the device.

    Attributes:
        label, term: As in :class:`warpcloth.terms.declared.Elements`.
        per_copy: Number of elements of one copy, E.
        stencil: (B·E, K) int32.
        stiffness: (B·E,), with stride 0 if all elements share one value [unit of the term].
        rest: (B·E,) vectors of P.
        hard: Whether any stiffness is infinite.
        damping: β (B·E,), with stride 0 if all elements share one value; None if all are 0.
        refresh: :class:`warpcloth.terms.refresh.Refresh` of a rest state that changes during a run, or None.
        cells: :class:`Cells` or :class:`SparseCells` whose vertices the elements are, or None.
        collider: For contact and friction, index of the collider in the scene; else None.
        clear: How far each vertex may move from x̃ in a step before there is a force, (B·E,) [m], see
            :mod:`warpcloth.kernels.contact.clear_elements`; None for elements that are always evaluated.
    """

    label: str
    term: Term
    per_copy: int
    stencil: wp.array
    stiffness: wp.array
    rest: wp.array
    hard: bool
    damping: wp.array | None = None
    refresh: Refresh | None = None
    cells: Cells | SparseCells | None = None
    collider: int | None = None
    clear: wp.array | None = None

    @property
    def arguments(self):
        """The first arguments of every kernel over elements."""
        return [self.stencil, self.stiffness, self.rest]

    @property
    def arrays(self):
        """All arrays of the term."""
        cells = self.cells.arrays if self.cells else []
        return self.arguments + ([] if self.damping is None else [self.damping]) + cells

    @property
    def count(self):
        """Elements of all copies, B·E."""
        return len(self.stencil)

    def stiffness_of_copies(self, model):
        """Returns the stiffness (B,) that all elements of each copy share, or None if the elements of a copy differ."""
        if 0 in self.stiffness.strides:
            return np.repeat(host_values(self.stiffness)[:1], model.copies)
        values = host_values(self.by_copies(model).stiffness).reshape(model.copies, -1)
        return values[:, 0] if values.size and (values == values[:, :1]).all() else None

    def by_copies(self, model):
        """Returns the elements in the order of their copies, such as coloured ones, which stand in the order of colours."""
        copies = host_values(self.stencil)[:, 0] // model.per_copy  # all vertices of an element are in one copy
        return self.reordered(np.argsort(copies, kind="stable")) if (np.diff(copies) < 0).any() else self

    def alike(self, copies):
        """Whether all copies have the same numbers; the elements are in the order of copies."""
        arrays = (host_values(array) for array in self.arguments[1:] if 0 not in array.strides)
        return all((array.reshape(copies, -1) == array[: self.per_copy].ravel()).all() for array in arrays)

    def with_unit_stiffness(self):
        """Returns these elements with a stiffness of 1, of 1/A for contact, and of 0 where it is 0."""
        stiffness = host_values(self.stiffness)
        ones = (stiffness > 0.0) / (1.0 if self.collider is None else host_values(self.rest)[:, -1])  # A is last
        ones = keep(ones.astype(stiffness.dtype), self.stiffness.dtype, self.stiffness.device)
        return replace(self, stiffness=ones, hard=False)

    def weighed(self, factor):
        """Returns these elements with the stiffness multiplied by a factor (E,)."""
        stiffness = host_values(self.stiffness)
        product = (stiffness * factor).astype(stiffness.dtype)
        return replace(self, stiffness=keep(product, self.stiffness.dtype, self.stiffness.device))

    @property
    def constraints(self):
        """Vertices of each constraint: of elements (B·E, K), of cells a list of B·C arrays."""
        stencil = host_values(self.stencil)
        return stencil if self.cells is None else np.split(stencil[:, 0], host_values(self.cells.offsets)[1:-1])

    def reordered(self, order):
        """Returns the elements, or cells, in another ``order``."""
        cells = self.cells
        if cells:
            cells, order = cells.reordered(order)
        return self._changed(lambda array: reordered(array, order), cells)

    def by_lowest(self):
        """Returns the elements in the order of their lowest vertices."""
        lowest = host_values(self.stencil).min(axis=1)
        return self.reordered(np.argsort(lowest, kind="stable")) if (np.diff(lowest) < 0).any() else self

    def part(self, first, count):
        """Returns the elements of copies ``first`` to ``first + count − 1``, for a model of these copies alone."""
        E = self.per_copy
        chosen = slice(first * E, (first + count) * E)
        found = self._changed(lambda array: part(array, chosen), self.cells and self.cells.part(first, count, chosen))
        return replace(found, stencil=part(self.stencil, slice(count * E)))  # vertices count from 0 in each model

    def _changed(self, change, cells):
        """Returns the elements with ``change`` applied to every array, and with other cells."""
        changed = {name: change(getattr(self, name)) for name in ("stencil", "stiffness", "rest")}
        if self.damping is not None:
            changed["damping"] = change(self.damping)
        if self.clear is not None:  # found anew in each step
            changed["clear"] = wp.zeros_like(self.clear)
        return replace(self, **changed, refresh=self.refresh and self.refresh.with_arrays(change), cells=cells)

    def at_limit(self, points):
        """Returns the elements with the largest Hessian that explicit steps may meet, from which the stability limit follows.

        A limit has an empty range about the rest shape ``points`` (n, 3) [m]. Contact has its ``bounded`` term.
        """
        if self.term.bounded is not None:
            return replace(self, term=self.term.bounded)
        if not self.term.dead_zone:
            return self
        rest = self.term.rest_state(points, host_values(self.stencil) % len(points), least=1.0, most=1.0)
        return replace(self, rest=keep(rest.astype(host_values(self.stiffness).dtype), self.rest.dtype, self.rest.device))

    @cached_property
    def incidences(self):
        """(offsets (N+1,), codes (B·E·K,)) on the device, see :func:`incidences_of`. Built on first use."""
        stencil, device = host_values(self.stencil).ravel(), self.stencil.device
        found = incidences_of(stencil, int(stencil.max()) + 1)
        return tuple(wp.array(each.astype(np.int32), dtype=wp.int32, device=device) for each in found)


def incidences_of(vertices, count):
    """Lists the elements of each vertex, one vertex after another.

    Args:
        vertices: The stencils of all elements in one row, (E·K,).
        count: Number of vertices, N.

    Returns:
        (offsets (N+1,), codes (E·K,)): vertex i has codes offsets[i] to offsets[i+1] − 1, each K·element + corner, ascending.
    """
    codes = np.argsort(vertices, kind="stable")
    return np.append(0, np.cumsum(np.bincount(vertices, minlength=count))), codes


def elements_on(model, term, positions, vary):
    """Returns the :class:`DeviceElements` of a term on a model.

    Args:
        model: The :class:`warpcloth.model.model.Model`, complete but for its terms.
        term: A :class:`warpcloth.terms.declared.Declared`.
        positions: Initial positions of each copy, (B, n, 3) [m].
        vary: :class:`warpcloth.model.vary.Vary`.
    """
    one, rest, stiffness, damping = vary.elements(term, model.scene.mesh, positions)
    E = len(one.stencil)
    vertices = model.in_model(one.stencil)
    if model.order is not None and vertices.shape[1] == 2:
        vertices = np.sort(vertices, axis=1)  # a pair has no direction, and sorted pairs are faster
    stencil = (
        vertices[None].astype(np.int32) + np.int32(model.per_copy) * np.arange(model.copies, dtype=np.int32)[:, None, None]
    )
    cells, declared = None, one.term
    if one.cells is not None:
        if one.weights is None:
            cells, rest = rigid_cells(model, one)
        else:
            cells, rest, declared = *sparse_cells(model, one, rest), share(one.term)
        if stiffness.shape[1] > 1:
            stiffness = np.repeat(stiffness, np.diff(one.cells), axis=1)
    rest_type = wp.types.vector(declared.parameters, model.dtype)
    rest = model.keep(f"{one.label}: rest state", "", rest, rest_type, infinite=True)  # an absent limit is infinite
    if one.refresh:
        release(rest)
    found = DeviceElements(
        label=one.label,
        term=declared,
        per_copy=E,
        stencil=keep(stencil.reshape(-1, stencil.shape[-1]), wp.int32, model.device),
        stiffness=_numbers(model, f"{one.label}.stiffness", stiffness, E),
        rest=rest,
        hard=bool(np.isinf(stiffness).any()),
        damping=_numbers(model, f"{one.label}.damping", damping, E) if damping.any() else None,
        cells=cells,
        refresh=one.refresh,
        collider=getattr(term, "collider", None),
    )
    return found if model.order is None or cells else found.by_lowest()


def _numbers(model, name, values, E):
    """Returns values (B, 1) or (B, E) as an array (B·E,), with stride 0 if all are equal."""
    each = "element" if values.shape[1] > 1 else None
    if (values != values[0, 0]).any() or len(values) * values.shape[1] == model.copies * E:
        return model.keep(name, "", np.broadcast_to(values, (model.copies, E)), model.dtype, each, infinite=True)
    return repeat(model.keep(name, "", values[:1, :1], model.dtype, None, infinite=True), model.copies * E)
