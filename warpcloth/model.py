"""What is built from a scene on a device: arrays of one or more copies laid out one after another, and nothing undeclared."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from .kernels.assemble import types
from .kernels.term import Term

DTYPES = {"float32": (wp.float32, np.float32), "float64": (wp.float64, np.float64)}


@dataclass(frozen=True, eq=False)
class DeviceElements:
    """The elements of one term in all copies, on the device.

    Attributes:
        label, kind, term: As in :class:`warpcloth.terms.Elements`.
        per_copy: Elements of one copy, E.
        stencil: (B·E, K) int32.
        stiffness: (B·E,); of stride 0 where all elements share one value.
        rest: (B·E,) vectors of P.
        host: The elements of one copy in NumPy.
        hard: Whether any stiffness is infinite.
    """

    label: str
    kind: str
    term: Term
    per_copy: int
    stencil: wp.array
    stiffness: wp.array
    rest: wp.array
    hard: bool

    @property
    def arguments(self):
        """The arguments that every kernel over elements starts with."""
        return [self.stencil, self.stiffness, self.rest]

    @property
    def count(self):
        """Elements of all copies, B·E."""
        return len(self.stencil)

    @cached_property
    def incidences(self):
        """(offsets (N+1,), incidences (B·E·K,)): for each vertex K·element + corner, in order. Built when first asked for."""
        stencil = self.stencil.numpy().ravel()
        order = np.argsort(stencil, kind="stable").astype(np.int32)
        vertices = int(stencil.max()) + 1
        offsets = np.searchsorted(stencil[order], np.arange(vertices + 1)).astype(np.int32)
        device = self.stencil.device
        return wp.array(offsets, dtype=wp.int32, device=device), wp.array(order, dtype=wp.int32, device=device)


class Model:
    """A scene on a device, as B copies one after another: vertex i of copy b is vertex b·n + i.

    Args:
        scene: The :class:`warpcloth.Scene`.
        device: A Warp device, ``"cpu"`` or ``"cuda:0"``.
        dtype: ``"float32"`` or ``"float64"``.
        copies: B.
        vary: What differs between the copies, by name, each with B entries: ``"gravity"`` (B, 3), ``"density"`` (B,),
            ``"masses"`` (B, n), ``"positions"`` and ``"velocities"`` (B, n, 3), and of terms, by their name or class,
            ``"Spring.stiffness"`` (B,) or (B, E).

    Attributes:
        positions, velocities: Where the copies start, (B·n,) vectors [m], [m/s].
        mass, inverse_mass: (B·n,) [kg], [1/kg]; the inverse of a pinned vertex is 0.
        gravity: (B,) vectors [m/s²].
        pins, keyframes: Moved pins (p,) and their places (F, p) [m], or None.
        terms: One :class:`DeviceElements` for each declared term.
        kernels: Names of the kernels that solvers asked for.

    Raises:
        ValueError: If an argument breaks a rule.
    """

    def __init__(self, scene, device="cpu", dtype="float32", copies=1, vary=None):
        if dtype not in DTYPES:
            raise ValueError(f"dtype is {dtype!r}; it must be 'float32' or 'float64'")
        if not isinstance(copies, int) or copies < 1:
            raise ValueError(f"copies is {copies!r}; it must be a whole number of 1 or more")
        self.scene, self.copies = scene, copies
        self.device = wp.get_device(device)
        self.dtype, self.numpy_dtype = DTYPES[dtype]
        self.vec3, self.mat33 = types(self.dtype)
        self.per_copy = len(scene.mesh.points)
        self.count = copies * self.per_copy
        self.kernels = set()
        vary = _Varied(vary or {}, copies)

        masses = vary.take("masses", scene.vertex_masses)
        if scene.density is not None:
            masses = masses * (vary.take("density", np.float64(scene.density)) / scene.density)[:, None]
        inverse = 1.0 / np.where(masses > 0.0, masses, np.inf)
        inverse[:, scene.pins.vertices] = 0.0
        free = np.setdiff1d(np.arange(self.per_copy), scene.pins.vertices)
        if not (np.isfinite(masses).all() and (masses[:, free] > 0.0).all()):
            raise ValueError("vary makes a mass that is not above 0; every vertex that is not pinned must have one")
        positions = vary.take("positions", scene.positions)
        self.positions = self.array(positions.reshape(-1, 3), self.vec3)
        self.velocities = self.array(vary.take("velocities", scene.velocities).reshape(-1, 3), self.vec3)
        self.mass = self.array(masses.ravel(), self.dtype)
        self.inverse_mass = self.array(inverse.ravel(), self.dtype)
        self.gravity = self.array(vary.take("gravity", scene.gravity), self.vec3)
        self.pins = self.keyframes = None
        if scene.pins.keyframes is not None:
            self.pins = wp.array(scene.pins.vertices, dtype=wp.int32, device=self.device)
            self.keyframes = self.array(scene.pins.keyframes, self.vec3)
        self.terms = tuple(self._on_device(term, positions, vary) for term in scene.terms)
        vary.refuse_rest()

    def array(self, values, dtype):
        """``values`` on the model's device, in its precision."""
        return wp.array(np.ascontiguousarray(values, dtype=self.numpy_dtype), dtype=dtype, device=self.device)

    def vectors(self):
        """A new array of one zero vector for each vertex of all copies."""
        return wp.zeros(self.count, dtype=self.vec3, device=self.device)

    def kernel(self, factory, *key):
        """The kernel that ``factory(*key)`` makes, noted for :meth:`report`."""
        kernel = factory(*key)
        terms = [part.name for part in key if isinstance(part, Term)]
        self.kernels.add(".".join([factory.__name__, *terms]))
        return kernel

    def launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _on_device(self, term, positions, vary):
        copies = [term.elements(self.scene.mesh, start) for start in (positions if vary.has("positions") else positions[:1])]
        one = copies[0]
        E = len(one.stencil)
        stencil = one.stencil[None] + (np.arange(self.copies) * self.per_copy)[:, None, None]
        rest = np.concatenate([copy.rest for copy in copies] * (self.copies // len(copies)))
        stiffness = vary.take_stiffness(one, E)
        if not (stiffness >= 0.0).all():
            raise ValueError(f"{one.label}.stiffness is {stiffness.min()} in a copy; it must be 0 or more")
        return DeviceElements(
            label=one.label,
            kind=one.kind,
            term=one.term,
            per_copy=E,
            stencil=wp.array(stencil.reshape(-1, stencil.shape[-1]).astype(np.int32), dtype=wp.int32, device=self.device),
            stiffness=self._broadcast(stiffness, E),
            rest=self.array(rest, wp.types.vector(one.term.parameters, self.dtype)),
            hard=bool(np.isinf(stiffness).any()),
        )

    def _broadcast(self, stiffness, E):
        """(B, 1) or (B, E) values as an array (B·E,), of stride 0 where all are one value."""
        if (stiffness != stiffness[0, 0]).any() or len(stiffness) * stiffness.shape[1] == self.copies * E:
            return self.array(np.broadcast_to(stiffness, (self.copies, E)).ravel(), self.dtype)
        value = self.array(stiffness[0, :1], self.dtype)
        array = wp.array(ptr=value.ptr, shape=(self.copies * E,), strides=(0,), dtype=self.dtype, device=self.device)
        array.value = value  # keeps the memory alive
        return array

    def report(self):
        """What was built: a dict of vertices, copies, dtype, device, bytes, terms (elements and bytes of each), kernels."""
        arrays = [self.positions, self.velocities, self.mass, self.inverse_mass, self.gravity]
        arrays += [array for array in (self.pins, self.keyframes) if array is not None]
        terms = [
            {
                "term": elements.label,
                "elements": elements.count,
                "bytes": sum(_bytes(array) for array in elements.arguments),
            }
            for elements in self.terms
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


def _bytes(array):
    return wp.types.type_size_in_bytes(array.dtype) if 0 in array.strides else array.size * array.strides[-1]


class _Varied:
    """The values of ``vary``, taken by name; what nobody takes is refused."""

    def __init__(self, values, copies):
        self.values, self.copies, self.taken = dict(values), copies, set()

    def has(self, name):
        return name in self.values

    def take(self, name, default):
        """``values[name]`` as (B, *shape of default), or the default B times."""
        if name not in self.values:
            return np.repeat(np.asarray(default, dtype=np.float64)[None], self.copies, axis=0)
        self.taken.add(name)
        array = np.asarray(self.values[name], dtype=np.float64)
        shape = (self.copies, *np.shape(default))
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"vary[{name!r}] has shape {array.shape}; it must be {shape}, all finite")
        return array

    def take_stiffness(self, elements, E):
        """Stiffness of a term as (B, 1) or (B, E)."""
        for name in (f"{elements.label}.stiffness", f"{elements.kind}.stiffness"):
            if name in self.values:
                self.taken.add(name)
                array = np.asarray(self.values[name], dtype=np.float64)
                if array.shape not in ((self.copies,), (self.copies, E)):
                    raise ValueError(
                        f"vary[{name!r}] has shape {array.shape}; it must be ({self.copies},) or ({self.copies}, {E})"
                    )
                return array.reshape(self.copies, -1)
        return np.repeat(np.atleast_1d(elements.stiffness)[None], self.copies, axis=0)

    def refuse_rest(self):
        rest = sorted(set(self.values) - self.taken)
        if rest:
            raise ValueError(
                f"vary[{rest[0]!r}] names nothing in this scene; allowed are gravity, density or masses, positions, "
                "velocities and <term>.stiffness"
            )
