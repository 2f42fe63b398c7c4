"""A scene on a device, as one copy or more laid out one after another. Only declared terms have arrays."""

import inspect
from copy import copy as shallow_copy
from functools import partial

import numpy as np
import warp as wp

import warpcloth.model as room

from ..base.checks import choice, whole
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..kernels.copy import repeat_indices
from ..kernels.step import lock
from ..kernels.term import PairTerm, Term
from ..kernels.terms.air import AIR
from ..kernels.terms.contact import Solid
from ..kernels.vectors import types
from ..mesh.selection import distinct_vertices
from ..terms.refresh import STEP, Moment
from .elements import elements_on
from .host_values import keep, repeat
from .loads import loads_on
from .precision import DTYPES, cast, refuse_coarse
from .report import report
from .threads import refuse_one_copy, threads_on
from .vary import Vary, unlike_copies


class Model:
    """A scene on a device, as B copies one after another: vertex i of copy b is vertex b·n + i.

    Args:
        scene: The :class:`warpcloth.Scene`.
        device: A Warp device, ``"cpu"`` or ``"cuda:0"``.
        dtype: ``"float32"`` or ``"float64"``.
        copies: B.
        vary: Values that differ between copies, by name: ``"gravity"`` (B, 3), ``"density"`` (B,), ``"masses"`` (B, n),
            ``"positions"`` and ``"velocities"`` (B, n, 3); any numeric field of a term, by its name or class, such as
            ``"Spring.stiffness"``, (B,) or (B, E); and values of a load, such as ``"Force.force"``, (B, 3) or (B, p, 3).
        order: Vertices of the scene in the order of the model, (n,), such as :func:`warpcloth.mesh.ordering.near_order` gives;
            elements are then sorted by their lowest vertices. Arguments and messages use the order of the scene, attributes
            and solvers that of the model, and :meth:`in_scene_order` converts. None keeps the order of vertices and elements.
        threads: Threads of the CPU that share out the copies; 1 if there is one copy.

    Attributes:
        positions, velocities: Initial state, (B·n,) vectors [m], [m/s]; the velocity of a pinned vertex is 0.
        moved_at_start: Distances by which vertices have been moved from the start of the scene, (B·n,) [m], see
            :meth:`move_start`.
        mass, inverse_mass: (B·n,) [kg], [1/kg]; the inverse mass of a pinned vertex is 0.
        mobility: Inverse masses along each axis, 0 along locked axes, (B·n,) vectors [1/kg]; None if no coordinate of a moving
            vertex is locked.
        gravity: (B,) vectors [m/s²].
        pins, keyframes: Moved pins (p,) and their positions (F, p) [m], or None.
        pin_axes: 1 along axes that each moved pin holds and 0 along others, (p,) vectors; None if all hold all axes.
        loads: The :class:`warpcloth.model.loads.DeviceLoads`, or None.
        terms: One :class:`warpcloth.model.elements.DeviceElements` for each declared term, then for contact with each collider
            and friction on it.
        dynamic: The :class:`warpcloth.core.dynamic_elements.DynamicElements` of a solver, as self-contact has; at first none.
        colliders: :class:`warpcloth.model.device_colliders.DeviceColliders`, or None.
        rest_points: Rest shape of one copy, (n, 3) [m].
        order: As given, int32, or None.
        indices: Index in a copy of each vertex of the scene, (n,) int32; None without an order.
        kernels: Names of the kernels that solvers use.
        motion: x and v (B·n,) of steppers, if they are views of those of a larger batch; else None.
        launches: Number of launches so far, in a list of one that models made from this one share.
        threads: As given.

    Raises:
        ValueError: An argument is not allowed, or the precision cannot represent a value or resolve the cloth.

    Warns:
        UserWarning: There are more threads than cores.
    """

    @in_turn
    def __init__(self, scene, device="cpu", dtype="float32", copies=1, vary=None, order=None, threads=1):
        choice("dtype", dtype, tuple(DTYPES))
        whole("copies", copies, 1)
        copies = int(copies)
        self.scene, self.copies = scene, copies
        self.device = find_device(device)
        refuse_one_copy(threads, copies)
        self.threads = threads_on(self.device, threads)
        self.dtype, self.numpy_dtype = DTYPES[dtype]
        self.vec3, self.mat33 = types(self.dtype)
        self.per_copy = len(scene.mesh.points)
        self.count = copies * self.per_copy
        self.kernels, self.launches = set(), [0]
        self.dynamic, self.motion = (), None
        self.order = self.indices = None
        self.rest_points = scene.mesh.points
        if order is not None:
            self._set_order(order)
        vary = Vary({} if vary is None else vary, copies)

        masses = vary.masses(scene)
        with np.errstate(over="ignore"):  # an infinite inverse is refused below
            inverse = 1.0 / np.where(unlike_copies(masses) > 0.0, unlike_copies(masses), np.inf)
        inverse[:, scene.fixed] = 0.0
        inverse = np.broadcast_to(inverse, masses.shape)
        positions = vary.take("positions", scene.positions)
        of_copies = vary.take("velocities", scene.velocities)
        velocities = unlike_copies(of_copies).copy()
        velocities[:, scene.fixed] = 0.0
        if scene.locked is not None:
            velocities[:, scene.locked] = 0.0
        velocities = np.broadcast_to(velocities, of_copies.shape)
        if vary.has("positions"):
            for copy, start in enumerate(positions):
                scene.pins.refuse_far(start, f" in copy {copy}")
        refuse_coarse(scene.mesh, unlike_copies(positions), self.numpy_dtype, lambda copy, i: self._label("vertex", copy, i))
        self.positions = self._put("position", "m", positions, self.vec3)
        self.velocities = self._put("velocity", "m/s", velocities, self.vec3)
        self.moved_at_start = np.zeros(self.count)
        self.mass = self._put("mass", "kg", masses, self.dtype)
        self.inverse_mass = self._put("inverse mass", "1/kg", inverse, self.dtype)
        gravity = vary.take("gravity", scene.gravity)[:, None]
        self.gravity = self._put("gravity", "m/s²", gravity, self.vec3, each=None)
        self.mobility = self._vertex_gravity = None
        if scene.locked is not None:
            free = ~scene.locked
            self.mobility = self._put("inverse mass", "1/kg", inverse[..., None] * free, self.vec3)
            self._vertex_gravity = self._put("gravity", "m/s²", gravity * free, self.vec3)
        self.pins = self.keyframes = self.pin_axes = None
        if scene.pins.keyframes is not None:
            keyframes, vertices = scene.pins.keyframes, scene.pins.vertices
            refuse_coarse(
                scene.mesh, keyframes, self.numpy_dtype, lambda frame, i: f"keyframe {frame} of pinned vertex {vertices[i]}"
            )
            self.pins = wp.array(self.in_model(vertices), dtype=wp.int32, device=self.device)
            self.keyframes = self.array(keyframes, self.vec3)
            if not scene.pins.held.all():
                self.pin_axes = self.array(scene.pins.held, self.vec3)
        self.loads = None
        if scene.loads or scene.air_terms:  # forces that explicit steps take of each vertex
            if self._vertex_gravity is None:
                self._vertex_gravity = self._put("gravity", "m/s²", np.repeat(gravity, self.per_copy, axis=1), self.vec3)
        if scene.loads:
            self.loads = loads_on(self, scene.loads, vary, self._vertex_gravity)
            self.loads.set(self, Moment(self.positions))
        for copy, start in enumerate(positions if vary.has("positions") else positions[:1]):
            scene.refuse_inside(start, f" in copy {copy}" if copies > 1 else "")
        self.colliders = room.colliders_on(self, scene) if scene.colliders else None
        declared = (*scene.terms, *scene.contact_terms, *scene.air_terms)
        self.terms = tuple(elements_on(self, term, positions, vary) for term in declared)
        if vary.has("Air.wind") and scene.air is not None and scene.air.changes:
            raise ValueError("vary['Air.wind'] is given and the wind follows keyframes or a function, the same for all copies")
        self.refresh(STEP, Moment(self.positions), [each for each in self.terms if each.term is AIR])  # uploads keyframes
        vary.refuse_rest()

    def _set_order(self, order):
        self.order = distinct_vertices("order", order, self.scene.mesh)
        if len(self.order) != self.per_copy:
            raise ValueError(f"order names {len(self.order)} vertices; it must name each of the {self.per_copy} once")
        self.indices = np.argsort(self.order).astype(np.int32)
        self.rest_points = self.scene.mesh.points[self.order]

    def in_model(self, vertices):
        """Returns the indices, in a copy, of vertices of the scene."""
        return vertices if self.indices is None else self.indices[vertices]

    def in_scene_order(self, values):
        """Returns NumPy ``values`` of all vertices (B·n, …) in the order of the scene."""
        if self.indices is None:
            return values
        return values.reshape(self.copies, self.per_copy, *values.shape[1:])[:, self.indices].reshape(values.shape)

    @property
    def free_gravity(self):
        """Acceleration by gravity and loads along free axes, (G,) vectors [m/s²], and how many vertices share an entry."""
        return (self.gravity, self.per_copy) if self.uniform else (self._vertex_gravity, 1)

    @property
    def uniform(self):
        """Whether gravity is the same for all vertices of a copy: there is no load and no locked coordinate."""
        return self._vertex_gravity is None

    @property
    def timed(self):
        """Whether pins, loads or wind follow keyframes, so that steps are counted."""
        blown = self.scene.air is not None and self.scene.air.changes
        return self.pins is not None or blown or (self.loads is not None and self.loads.timed)

    @property
    def local_mobility(self):
        """Inverse masses for local steps, (B·n,) numbers, or vectors if coordinates are locked [1/kg]."""
        return self.inverse_mass if self.mobility is None else self.mobility

    @property
    def has_pairs(self):
        """Whether steps list pairs: those of cloth with itself, or with a mesh among the colliders."""
        return self.scene.self_contact is not None or (self.colliders is not None and self.colliders.meshes is not None)

    def lock(self, values):
        """Sets vectors (N,) to 0 at coordinates that do not move, if a coordinate is locked."""
        if self.mobility is not None:
            self.launch(self.kernel(lock, self.dtype), self.count, [self.mobility], [values])

    def move_start(self, x):
        """Sets the initial positions to x (N,) [m], and notes how far vertices moved."""
        moved = np.linalg.norm(x.numpy() - self.positions.numpy(), axis=1)
        np.maximum(self.moved_at_start, moved, out=self.moved_at_start)  # in place, for models that share it
        wp.copy(self.positions, x)

    def coordinate_mobility(self):
        """Returns the inverse mass of each coordinate, 0 if it does not move, (3 B·n,) [1/kg] float64 on the host."""
        if self.mobility is None:
            return np.repeat(self.inverse_mass.numpy().astype(np.float64), 3)
        return self.mobility.numpy().astype(np.float64).ravel()

    def with_terms(self, terms):
        """Returns a model with other :class:`warpcloth.model.elements.DeviceElements` that shares all else."""
        other = shallow_copy(self)
        other.terms = tuple(terms)
        return other

    def with_dynamic(self, dynamic):
        """Returns a model with other dynamic elements that shares all else."""
        other = shallow_copy(self)
        other.dynamic = tuple(dynamic)
        return other

    def refresh(self, when, moment, terms=None):
        """Updates loads and the rest states of terms, or those of ``terms`` alone, see :mod:`warpcloth.terms.refresh`.

        Args:
            when: :data:`warpcloth.terms.refresh.STEP` or :data:`warpcloth.terms.refresh.EVALUATION`.
            moment: The :class:`warpcloth.terms.refresh.Moment`.
            terms: The :class:`warpcloth.model.elements.DeviceElements` to update, without loads; None for all and the loads.
        """
        if self.loads is not None and terms is None and when == STEP:
            self.loads.launch(self, moment)
        for elements in self.terms if terms is None else terms:
            if elements.refresh and elements.refresh.when == when:
                elements.refresh.launch(self, elements, moment)

    def alone(self, copy):
        """Returns a model of one copy, whose arrays are views of those of this one."""
        return self if self.copies == 1 else self.part(copy, 1)

    def part(self, first, count, motion=None):
        """Returns a model of copies ``first`` to ``first + count − 1``, for one thread, whose arrays are views.

        Args:
            first: The first copy.
            count: Number of copies.
            motion: x and v of all copies, of which the steppers of the part have views; None for arrays of their own.
        """
        n = self.per_copy
        other, of_copies, of_vertices = shallow_copy(self), slice(first, first + count), slice(first * n, (first + count) * n)
        other.copies, other.count, other.threads = count, count * n, 1
        for name in ("positions", "velocities", "mass", "inverse_mass", "mobility", "_vertex_gravity"):
            if getattr(self, name) is not None:
                setattr(other, name, getattr(self, name)[of_vertices])
        other.motion = motion and tuple(array[of_vertices] for array in motion)
        other.gravity = self.gravity[of_copies]
        if self.loads is not None:
            other.loads = self.loads.part(self, first, count)
        other.terms = tuple(elements.part(first, count) for elements in self.terms)
        return other

    def array(self, values, dtype):
        """Returns ``values`` as an array on the model's device, in its precision."""
        return wp.array(np.ascontiguousarray(values, dtype=self.numpy_dtype), dtype=dtype, device=self.device)

    def _put(self, name, unit, values, dtype, each="vertex"):
        """Returns values (B, count, …) on the device, one copy after another, see :func:`warpcloth.model.precision.cast`."""
        held = self._cast(name, unit, values, each)
        if each == "vertex" and self.order is not None:
            held = held[:, self.order]
        return self.array(held.reshape(-1, *held.shape[2:]), dtype)

    def keep(self, name, unit, values, dtype, each="element", infinite=False):
        """Returns values (B, count, …) of elements on the device, and keeps them on the host too, see `host_values.keep`."""
        held = self._cast(name, unit, values, each, infinite)
        return keep(held.reshape(-1, *held.shape[2:]), dtype, self.device)

    def _cast(self, name, unit, values, each, infinite=False):
        label = partial(self._label, each)
        return np.broadcast_to(cast(name, unit, unlike_copies(values), self.numpy_dtype, label, infinite), values.shape)

    def _label(self, each, copy, i):
        """Returns words for error messages, such as "vertex 3 of copy 0"."""
        words = [] if each is None else [f"{each} {i}"]
        return " of ".join(words + ([f"copy {copy}"] if self.copies > 1 else []))

    def vectors(self):
        """Returns a new array of a zero vector for each vertex of all copies."""
        return wp.zeros(self.count, dtype=self.vec3, device=self.device)

    def scalars(self, dtype=wp.float64):
        """Returns a new array of a zero for each copy."""
        return wp.zeros(self.copies, dtype=dtype, device=self.device)

    def kernel(self, factory, *key):
        """Returns the kernel of ``factory(*key)``, and notes its name for :meth:`report`, as factory(variant).Term."""
        kernel = factory(*key)
        terms = [part.name for part in key if isinstance(part, Term | PairTerm)]
        terms += [part.term.name for parts in key if isinstance(parts, tuple) for part in parts if not isinstance(part, Solid)]
        variants = [name for name, part in zip(inspect.signature(factory).parameters, key, strict=False) if part is True]
        variant = f"({', '.join(variants)})" if variants else ""
        self.kernels.add(".".join([f"{factory.__name__}{variant}", *terms]))
        return kernel

    def launch(self, kernel, dim, inputs, outputs=(), block_dim=256):
        self.launches[0] += 1
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=block_dim)

    def launcher(self, *made):
        """Makes the kernels of each (factories, *key), and returns a function (factory, dim, inputs, outputs) to launch them.

        All are made before the first launch, so that those of one module are compiled together.
        """
        kernels = {factory: self.kernel(factory, *key) for factories, *key in made for factory in factories}
        return lambda factory, dim, inputs, outputs: self.launch(kernels[factory], dim, inputs, outputs)

    def of_copies(self, indices, step, start=None):
        """Returns indices (m,) of the first copy, then for each other copy ``step`` more than for the one before.

        Args:
            indices: On the device, (m,) int32.
            step: Such as n, for indices of vertices.
            start: A number that comes before all others, such as the 0 of offsets; None for none.

        Returns:
            wp.array: (B·m,) int32 on the device, or (1 + B·m,) with ``start``.
        """
        first = int(start is not None)
        out = wp.empty(first + self.copies * len(indices), dtype=wp.int32, device=self.device)
        if first:
            out[:1].fill_(start)
        if len(indices):
            self.launch(self.kernel(repeat_indices), self.copies * len(indices), [indices, step], [out[first:]])
        return out

    def constant(self, value, count):
        """Returns an array (count,) of one value, with stride 0."""
        return repeat(keep(np.array([value], dtype=self.numpy_dtype), self.dtype, self.device), count)

    def per_element(self, values):
        """Returns numbers (E,) as an array, with stride 0 if all are equal."""
        if len(values) and (values == values[0]).all():
            return self.constant(values[0], len(values))
        return keep(np.array(values, dtype=self.numpy_dtype), self.dtype, self.device)

    def report(self):
        """Describes the model: a dict of vertices, copies, dtype, device, bytes, terms (elements and bytes of each), kernels.

        Terms of one label are numbered from the second on: Spring, Spring 2. Kernels are factory(variant).Term.
        """
        return report(self)
