"""A scene on a device: arrays of one or more copies laid out one after another, and nothing undeclared."""

import inspect
import os
import warnings
from copy import copy as shallow_copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import warp as wp

from ..base.checks import choice, whole
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..kernels.sparse import share
from ..kernels.term import Term
from ..kernels.vectors import types
from ..mesh.selection import distinct_vertices
from ..terms.refresh import Refresh
from .precision import cast, refuse_coarse
from .vary import Vary

_PINNED = 1e3  # what a pinned vertex of a cell counts, in masses of the rest of the cell: it does not move, so the cell must

DTYPES = {"float32": (wp.float32, np.float32), "float64": (wp.float64, np.float64)}


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of elements: those from offsets[c] to offsets[c+1] are the vertices of cell c.

    Attributes:
        offsets: (B·C + 1,) int32.
        per_copy: Cells of one copy, C.
        shape: Rest place of each element about the centre of mass of its cell, (B·E,) vectors [m].
    """

    offsets: wp.array
    per_copy: int
    shape: wp.array

    weights = None

    @property
    def arrays(self):
        """All arrays."""
        return [self.offsets, self.shape]

    @property
    def count(self):
        """Cells of all copies, B·C."""
        return len(self.offsets) - 1

    def part(self, first, count, elements):
        """The cells of ``count`` of the copies from ``first`` on, whose elements are those of the slice ``elements``."""
        return replace(self, offsets=self.offsets[: count * self.per_copy + 1], shape=self.shape[elements])

    @property
    def sizes(self):
        """Elements of each cell, (B·C,)."""
        return np.diff(self.offsets.numpy())


@dataclass(frozen=True, eq=False)
class SparseCells:
    """Cells of a term whose elements have any number of vertices, each an element by itself, see :mod:`..kernels.sparse`.

    Attributes:
        term: The energy of a cell.
        offsets: (B·C + 1,) int32.
        per_copy: Cells of one copy, C.
        weights: (B·E,) vectors of M.
        rest: Rest state of each cell, (B·C,) vectors of P.
    """

    term: Term
    offsets: wp.array
    per_copy: int
    weights: wp.array
    rest: wp.array

    @property
    def arrays(self):
        """All arrays."""
        return [self.offsets, self.weights, self.rest]

    @property
    def count(self):
        """Cells of all copies, B·C."""
        return len(self.offsets) - 1

    def part(self, first, count, elements):
        """The cells of ``count`` of the copies from ``first`` on, whose elements are those of the slice ``elements``."""
        C = self.per_copy
        rest = self.rest[first * C : (first + count) * C]
        return replace(self, offsets=self.offsets[: count * C + 1], weights=self.weights[elements], rest=rest)


@dataclass(frozen=True, eq=False)
class DeviceElements:
    """The elements of one term in all copies, on the device.

    Attributes:
        label, kind, term: As in :class:`warpcloth.terms.declared.Elements`.
        per_copy: Elements of one copy, E.
        stencil: (B·E, K) int32.
        stiffness: (B·E,); of stride 0 where all elements share one value.
        rest: (B·E,) vectors of P.
        hard: Whether any stiffness is infinite.
        damping: β (B·E,), of stride 0 where all elements share one value; None where it is 0.
        refresh: :class:`warpcloth.terms.refresh.Refresh` of what changes during a run, or None.
        cells: :class:`Cells` or :class:`SparseCells` that the elements are the vertices of, or None.
    """

    label: str
    kind: str
    term: Term
    per_copy: int
    stencil: wp.array
    stiffness: wp.array
    rest: wp.array
    hard: bool
    damping: wp.array | None = None
    refresh: Refresh | None = None
    cells: Cells | SparseCells | None = None

    @property
    def arguments(self):
        """The arguments that every kernel over elements starts with."""
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
        # Colours put elements of all copies in one order; all vertices of an element are in one copy.
        by_copy = np.argsort(self.stencil.numpy()[:, 0] // model.per_copy, kind="stable")
        values = self.stiffness.numpy()[by_copy].reshape(model.copies, -1)
        return values[:, 0] if values.size and (values == values[:, :1]).all() else None

    def with_unit_stiffness(self):
        """Returns these elements with a stiffness of 1, or 0 where it is 0."""
        stiffness = self.stiffness.numpy()
        array = wp.array((stiffness > 0.0).astype(stiffness.dtype), device=self.stiffness.device)
        return replace(self, stiffness=array, hard=False)

    @property
    def constraints(self):
        """Vertices (B·C, K) of each constraint, or of cells a list of arrays: elements, and cells as a whole."""
        stencil = self.stencil.numpy()
        return stencil if self.cells is None else np.split(stencil[:, 0], self.cells.offsets.numpy()[1:-1])

    def reordered(self, order):
        """Returns the elements, or cells, of index ``order`` in that order."""

        def put(array):
            if 0 in array.strides:
                return array
            return wp.array(array.numpy()[order], dtype=array.dtype, device=array.device)

        cells = self.cells
        if cells:
            firsts, sizes = cells.offsets.numpy()[order], cells.sizes[order]
            ends = np.cumsum(sizes)
            order = np.arange(ends[-1]) + np.repeat(firsts - (ends - sizes), sizes)
            offsets = wp.array(np.append(0, ends).astype(np.int32), dtype=wp.int32, device=self.stencil.device)
            cells = replace(cells, offsets=offsets, shape=put(cells.shape))
        changed = {name: put(getattr(self, name)) for name in ("stencil", "stiffness", "rest")}
        if self.damping is not None:
            changed["damping"] = put(self.damping)
        return replace(self, **changed, refresh=self.refresh and self.refresh.with_arrays(put), cells=cells)

    def by_lowest(self):
        """Returns the elements in the order of their lowest vertices; themselves if they are in that order."""
        lowest = self.stencil.numpy().min(axis=1)
        return self.reordered(np.argsort(lowest, kind="stable")) if (np.diff(lowest) < 0).any() else self

    def part(self, first, count):
        """Those of ``count`` of the copies from ``first`` on, as a model of these alone has them."""
        E = self.per_copy
        chosen = slice(first * E, (first + count) * E)
        changed = {name: getattr(self, name)[chosen] for name in ("stiffness", "rest")}
        if self.damping is not None:
            changed["damping"] = self.damping[chosen]
        cells = self.cells and self.cells.part(first, count, chosen)
        refresh = self.refresh and self.refresh.with_arrays(lambda array: array[chosen])
        return replace(self, **changed, stencil=self.stencil[: count * E], cells=cells, refresh=refresh)

    def at_limit(self, points):
        """Of a limit the same elements with no range at all about the rest shape ``points`` of one copy; else these."""
        if not self.term.dead_zone:
            return self
        rest = self.term.rest_state(points, self.stencil.numpy() % len(points), least=1.0, most=1.0)
        held = rest.astype(wp.dtype_to_numpy(self.stiffness.dtype))
        return replace(self, rest=wp.array(held, dtype=self.rest.dtype, device=self.rest.device))

    @cached_property
    def incidences(self):
        """(offsets (N+1,), codes (B·E·K,)), see :func:`incidences_of`, on the device. Built when first asked for."""
        stencil, device = self.stencil.numpy().ravel(), self.stencil.device
        offsets, codes = incidences_of(stencil, int(stencil.max()) + 1)
        return tuple(wp.array(each.astype(np.int32), dtype=wp.int32, device=device) for each in (offsets, codes))


def incidences_of(vertices, count):
    """The elements of each vertex, one vertex after another.

    Args:
        vertices: (E·K,) the corners of elements, one element after another.
        count: Vertices, N.

    Returns:
        (offsets (N+1,), codes (E·K,)): vertex i has the codes from offsets[i] to offsets[i+1], K·element + corner, in order.
    """
    codes = np.argsort(vertices, kind="stable")
    return np.searchsorted(vertices[codes], np.arange(count + 1)), codes


class Model:
    """A scene on a device, as B copies one after another: vertex i of copy b is vertex b·n + i.

    Args:
        scene: The :class:`warpcloth.Scene`.
        device: A Warp device, ``"cpu"`` or ``"cuda:0"``.
        dtype: ``"float32"`` or ``"float64"``.
        copies: B.
        vary: What differs between the copies, by name, each with B entries: ``"gravity"`` (B, 3), ``"density"`` (B,),
            ``"masses"`` (B, n), ``"positions"`` and ``"velocities"`` (B, n, 3), and any numeric field of a term, by its name or
            class, such as ``"Spring.stiffness"`` and ``"Spring.rest_lengths"``, (B,) or (B, E).
        order: The scene's vertices in the order that the model has them in, (n,), such as
            :func:`warpcloth.mesh.ordering.near_order` gives; elements are then in the order of their lowest vertices there. All
            arguments here, and what is said of them, have the scene's own order, and all attributes and what solvers make of
            them have this one; :meth:`in_scene_order` leads back. None keeps the scene's, of vertices and elements.
        threads: Threads of the CPU that share the steps, see :class:`warpcloth.core.thread_pool.ThreadPool`.

    Attributes:
        positions, velocities: Where the copies start, (B·n,) vectors [m], [m/s]; the velocity of a pinned vertex is 0.
        mass, inverse_mass: (B·n,) [kg], [1/kg]; the inverse of a pinned vertex is 0.
        gravity: (B,) vectors [m/s²].
        pins, keyframes: Moved pins (p,) and their places (F, p) [m], or None.
        terms: One :class:`DeviceElements` for each declared term.
        rest_points: Rest shape of one copy, (n, 3) [m].
        order: As given, int32, or None.
        places: Where each vertex of the scene is in a copy, (n,) int32; None without an order.
        kernels: Names of the kernels that solvers asked for.
        launches: How many launches there have been, a list of one that models of other terms share.
        threads: As given.

    Raises:
        ValueError: If an argument breaks a rule, or a value or the cloth itself is lost in the precision of the model.

    Warns:
        UserWarning: If there are more threads than cores.
    """

    @in_turn
    def __init__(self, scene, device="cpu", dtype="float32", copies=1, vary=None, order=None, threads=1):
        choice("dtype", dtype, tuple(DTYPES))
        whole("copies", copies, 1)
        copies = int(copies)
        self.scene, self.copies = scene, copies
        self.device = find_device(device)
        self.threads = threads_on(self.device, threads)
        self.dtype, self.numpy_dtype = DTYPES[dtype]
        self.vec3, self.mat33 = types(self.dtype)
        self.per_copy = len(scene.mesh.points)
        self.count = copies * self.per_copy
        self.kernels, self.launches = set(), [0]
        self.order = self.places = None
        self.rest_points = scene.mesh.points
        if order is not None:
            self._set_order(order)
        vary = Vary({} if vary is None else vary, copies)

        masses = self._varied_masses(vary)
        with np.errstate(over="ignore"):  # an inverse that no precision holds is refused below
            inverse = 1.0 / np.where(masses > 0.0, masses, np.inf)
        inverse[:, scene.pins.vertices] = 0.0
        positions = vary.take("positions", scene.positions)
        velocities = vary.take("velocities", scene.velocities)
        velocities[:, scene.pins.vertices] = 0.0
        if vary.has("positions"):
            for copy, start in enumerate(positions):
                scene.pins.refuse_far(start, f" in copy {copy}")
        refuse_coarse(scene.mesh, positions, self.numpy_dtype, lambda copy, i: self._place("vertex", copy, i))
        self.positions = self._put("position", "m", positions, self.vec3)
        self.velocities = self._put("velocity", "m/s", velocities, self.vec3)
        self.mass = self._put("mass", "kg", masses, self.dtype)
        self.inverse_mass = self._put("inverse mass", "1/kg", inverse, self.dtype)
        self.gravity = self._put("gravity", "m/s²", vary.take("gravity", scene.gravity)[:, None], self.vec3, each=None)
        self.pins = self.keyframes = None
        if scene.pins.keyframes is not None:
            places, vertices = scene.pins.keyframes, scene.pins.vertices
            refuse_coarse(
                scene.mesh, places, self.numpy_dtype, lambda frame, i: f"keyframe {frame} of pinned vertex {vertices[i]}"
            )
            self.pins = wp.array(self._placed(vertices), dtype=wp.int32, device=self.device)
            self.keyframes = self.array(places, self.vec3)
        self.terms = tuple(self._on_device(term, positions, vary) for term in scene.terms)
        vary.refuse_rest()

    def _set_order(self, order):
        self.order = distinct_vertices("order", order, self.scene.mesh)
        if len(self.order) != self.per_copy:
            raise ValueError(f"order names {len(self.order)} vertices; it must name each of the {self.per_copy} once")
        self.places = np.argsort(self.order).astype(np.int32)
        self.rest_points = self.scene.mesh.points[self.order]

    def _placed(self, vertices):
        """Where vertices of the scene are in a copy."""
        return vertices if self.places is None else self.places[vertices]

    def in_scene_order(self, values):
        """NumPy ``values`` of all vertices (B·n, …) in the order of the scene; the same array where that is the model's."""
        if self.places is None:
            return values
        return values.reshape(self.copies, self.per_copy, *values.shape[1:])[:, self.places].reshape(values.shape)

    def with_terms(self, terms):
        """This model with other :class:`DeviceElements`, all else shared."""
        other = shallow_copy(self)
        other.terms = tuple(terms)
        return other

    def refresh(self, when, moment, terms=None):
        """Launches what its terms, or the ``terms`` given, have set anew.

        Args:
            when: :data:`warpcloth.terms.refresh.STEP` or :data:`warpcloth.terms.refresh.EVALUATION`.
            moment: The :class:`warpcloth.terms.refresh.Moment`.
            terms: :class:`DeviceElements`.
        """
        for elements in self.terms if terms is None else terms:
            if elements.refresh and elements.refresh.when == when:
                elements.refresh.launch(self, elements, moment)

    def alone(self, copy):
        """A model of one copy, whose arrays are parts of those of this one."""
        return self if self.copies == 1 else self.part(copy, 1)

    def part(self, first, count):
        """A model of ``count`` of the copies from ``first`` on, for one thread, whose arrays are parts of those of this one."""
        n = self.per_copy
        other, of_copies, of_vertices = shallow_copy(self), slice(first, first + count), slice(first * n, (first + count) * n)
        other.copies, other.count, other.threads = count, count * n, 1
        for name in ("positions", "velocities", "mass", "inverse_mass"):
            setattr(other, name, getattr(self, name)[of_vertices])
        other.gravity = self.gravity[of_copies]
        other.terms = tuple(elements.part(first, count) for elements in self.terms)
        return other

    @in_turn
    def array(self, values, dtype):
        """``values`` on the model's device, in its precision."""
        return wp.array(np.ascontiguousarray(values, dtype=self.numpy_dtype), dtype=dtype, device=self.device)

    def _varied_masses(self, vary):
        """Masses of all copies (B, n) [kg]."""
        scene = self.scene
        if vary.has("density") and vary.has("masses"):
            raise ValueError("vary has density and masses; at most one of the two may be given")
        if vary.has("density") and scene.density is None:
            raise ValueError("vary['density'] needs a scene with a density, and this one has masses; vary['masses'] instead")
        masses = vary.take("masses", scene.vertex_masses)
        if vary.has("density"):
            density = vary.take("density", np.float64(scene.density))
            for copy in np.flatnonzero(~(density > 0.0)):
                raise ValueError(f"vary['density'] is {density[copy]} in copy {copy}; it must be above 0")
            masses = masses * (density / scene.density)[:, None]
        allowed = masses > 0.0
        allowed[:, scene.pins.vertices] |= masses[:, scene.pins.vertices] == 0.0
        for copy, vertex in np.argwhere(~allowed)[:1]:
            raise ValueError(
                f"vary['masses'] of vertex {vertex} is {masses[copy, vertex]} kg in copy {copy}; it must be above 0, "
                "of a pinned vertex 0 or more"
            )
        return masses

    def _put(self, name, unit, values, dtype, each="vertex", infinite=False):
        """Values (B, count, …) on the device, one row after another, as :func:`warpcloth.model.precision.cast` lets them be."""
        held = cast(name, unit, values, self.numpy_dtype, lambda copy, i: self._place(each, copy, i), infinite)
        if each == "vertex" and self.order is not None:
            held = held[:, self.order]
        return self.array(held.reshape(-1, *held.shape[2:]), dtype)

    def _place(self, each, copy, i):
        """The words for one of what ``each`` names, or for a whole copy."""
        words = [] if each is None else [f"{each} {i}"]
        return " of ".join(words + ([f"copy {copy}"] if self.copies > 1 else []))

    @in_turn
    def vectors(self):
        """A new array of one zero vector for each vertex of all copies."""
        return wp.zeros(self.count, dtype=self.vec3, device=self.device)

    @in_turn
    def kernel(self, factory, *key):
        """The kernel that ``factory(*key)`` makes, noted for :meth:`report` as factory(variant).Term."""
        kernel = factory(*key)
        terms = [part.name for part in key if isinstance(part, Term)]
        terms += [part.term.name for parts in key if isinstance(parts, tuple) for part in parts]
        variants = [name for name, part in zip(inspect.signature(factory).parameters, key, strict=False) if part is True]
        variant = f"({', '.join(variants)})" if variants else ""
        self.kernels.add(".".join([f"{factory.__name__}{variant}", *terms]))
        return kernel

    @in_turn
    def launch(self, kernel, dim, inputs, outputs=(), block_dim=256):
        self.launches[0] += 1
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=block_dim)

    def _on_device(self, term, positions, vary):
        one, rest, stiffness, damping = vary.elements(term, self.scene.mesh, positions)
        E = len(one.stencil)
        vertices = self._placed(one.stencil)
        if self.order is not None and vertices.shape[1] == 2:
            vertices = np.sort(vertices, axis=1)  # a pair has no direction, and those of one are faster
        stencil = vertices[None] + (np.arange(self.copies) * self.per_copy)[:, None, None]
        cells, declared = None, one.term
        if one.cells is not None:
            if one.weights is None:
                cells, rest = self._cells(one)
            else:
                cells, rest, declared = *self._sparse_cells(one, rest), share(one.term.name)
            if stiffness.shape[1] > 1:
                stiffness = np.repeat(stiffness, np.diff(one.cells), axis=1)
        rest_type = wp.types.vector(declared.parameters, self.dtype)
        found = DeviceElements(
            label=one.label,
            kind=one.kind,
            term=declared,
            per_copy=E,
            stencil=wp.array(stencil.reshape(-1, stencil.shape[-1]).astype(np.int32), dtype=wp.int32, device=self.device),
            stiffness=self._broadcast(f"{one.label}.stiffness", stiffness, E),
            rest=self._put(f"{one.label}: rest state", "", rest, rest_type, "element", infinite=True),  # a limit may be none
            hard=bool(np.isinf(stiffness).any()),
            damping=self._broadcast(f"{one.label}.damping", damping, E) if damping.any() else None,
            cells=cells,
            refresh=one.refresh,
        )
        return found if self.order is None or cells else found.by_lowest()

    def _cells(self, elements):
        """:class:`Cells` of :class:`warpcloth.terms.declared.Elements`, and their rest state with the masses, (B, E, P)."""
        vertices, firsts = elements.stencil[:, 0], elements.cells[:-1]
        sizes = np.diff(elements.cells)
        shape = (self.copies, self.per_copy)
        mass, inverse = (array.numpy().astype(np.float64).reshape(shape) for array in (self.mass, self.inverse_mass))
        places = self._placed(vertices)
        weight = np.where(inverse > 0.0, mass, 0.0)[:, places]
        body = np.repeat(np.add.reduceat(weight, firsts, axis=1), sizes, axis=1)
        weight = np.where(inverse[:, places] > 0.0, weight, np.where(body > 0.0, _PINNED * body, 1.0))
        points = np.broadcast_to(self.scene.mesh.points[vertices], (self.copies, len(vertices), 3))
        points = points - np.repeat(points[:, firsts], sizes, axis=1)
        total = np.add.reduceat(weight, firsts, axis=1)
        centre = np.add.reduceat(weight[..., None] * points, firsts, axis=1) / total[..., None]
        cells = Cells(
            self._offsets(elements),
            len(sizes),
            self._put(f"{elements.label}: shape", "m", points - np.repeat(centre, sizes, axis=1), self.vec3, "element"),
        )
        rest = np.zeros((*weight.shape, elements.term.parameters))
        rest[..., -1] = weight
        return cells, rest

    def _sparse_cells(self, elements, rest):
        """:class:`SparseCells` of elements with rest states (B, C, P), and the rest states of their shares, (B, E, 4)."""
        E, M, P = *elements.weights.shape, elements.term.parameters
        weights = np.broadcast_to(elements.weights, (self.copies, E, M))
        cells = SparseCells(
            elements.term,
            self._offsets(elements),
            len(elements.cells) - 1,
            self._put(f"{elements.label}: weight", "", weights, wp.types.vector(M, self.dtype), "element"),
            self._put(f"{elements.label}: rest state", "", rest, wp.types.vector(P, self.dtype), "cell"),
        )
        return cells, np.zeros((self.copies, E, 4))

    def _offsets(self, elements):
        """Where the cells of all copies begin and the last ends, int32."""
        E = elements.cells[-1]
        offsets = np.append((elements.cells[:-1] + np.arange(self.copies)[:, None] * E).ravel(), self.copies * E)
        return wp.array(offsets.astype(np.int32), dtype=wp.int32, device=self.device)

    def _broadcast(self, name, values, E):
        """(B, 1) or (B, E) values as an array (B·E,), of stride 0 where all are one value."""
        each = "element" if values.shape[1] > 1 else None
        if (values != values[0, 0]).any() or len(values) * values.shape[1] == self.copies * E:
            return self._put(name, "", np.broadcast_to(values, (self.copies, E)), self.dtype, each, infinite=True)
        return self._repeat(self._put(name, "", values[:1, :1], self.dtype, None, infinite=True), self.copies * E)

    def constant(self, value, count):
        """An array (count,) of one value, of stride 0."""
        return self._repeat(self.array([value], self.dtype), count)

    def per_element(self, values):
        """Numbers (E,) in an array, of stride 0 where they are all one value."""
        if len(values) and (values == values[0]).all():
            return self.constant(values[0], len(values))
        return self.array(values, self.dtype)

    def _repeat(self, value, count):
        array = wp.array(ptr=value.ptr, shape=(count,), strides=(0,), dtype=self.dtype, device=self.device)
        array.value = value  # keeps the memory alive
        return array

    def report(self):
        """Describes the model: a dict of vertices, copies, dtype, device, bytes, terms (elements and bytes of each), kernels.

        Terms of one label are numbered from the second on: Spring, Spring 2. Kernels are factory(variant).Term.
        """
        labels = [elements.label for elements in self.terms]
        before = [labels[:i].count(label) for i, label in enumerate(labels)]
        arrays = [self.positions, self.velocities, self.mass, self.inverse_mass, self.gravity]
        arrays += [array for array in (self.pins, self.keyframes) if array is not None]
        terms = [
            {
                "term": elements.label + (f" {count + 1}" if count else ""),
                "elements": elements.count,
                "bytes": sum(_bytes(array) for array in elements.arrays),
            }
            for elements, count in zip(self.terms, before, strict=True)
        ]
        return {
            "scene": self.scene.name,
            "vertices": self.count,
            "copies": self.copies,
            "dtype": np.dtype(self.numpy_dtype).name,
            "device": str(self.device),
            "bytes": sum(_bytes(array) for array in arrays) + sum(term["bytes"] for term in terms),
            "terms": terms,
            "kernels": sorted(self.kernels),
        }


def threads_on(device, threads):
    """The number of threads, refused where one device or mode cannot have it."""
    whole("threads", threads, 1)
    if threads > 1 and not device.is_cpu:
        raise ValueError(f"threads is {threads} on {device}, which has its own; more than 1 is for device='cpu'")
    if threads > 1 and wp.config.mode == "debug" and wp.config.enable_tiles_in_stack_memory:
        raise ValueError(
            f"threads is {threads} in Warp's debug mode, where threads of one kernel share the pointer to its tiles; "
            "wp.config.mode='release' or wp.config.enable_tiles_in_stack_memory=False take more than 1"
        )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if threads > cores:
        warnings.warn(f"threads is {threads} on {cores} cores; more threads than cores are slower", stacklevel=5)
    return int(threads)


def _bytes(array):
    return wp.types.type_size_in_bytes(array.dtype) if 0 in array.strides else array.size * array.strides[-1]
