"""The base classes of records of energies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import numpy as np

from ..base.checks import as_array, keep_plain, numeric, refuse, shown
from ..kernels.term import Term
from ..mesh.mesh import Mesh
from .refresh import Refresh


@dataclass(frozen=True)
class Elements:
    """The elements of one term on one mesh, as NumPy arrays.

    Attributes:
        stencil: Vertices of each element, (E, K) int32.
        stiffness: One value, (E,), or (C,) with cells [unit of the term].
        rest: Rest states (E, P); with sparse cells (C, P).
        damping: One value or (E,) [unit of the term, times s].
        cells: Offsets (C+1,): elements cells[c] to cells[c+1] − 1 are the vertices of cell c; or None.
        weights: Weights (E, M) of the vertices of sparse cells (:mod:`.sparse`), or None.
        refresh: The :class:`warpcloth.terms.refresh.Refresh` of a changing rest state, or None.
    """

    label: str
    term: Term
    stencil: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray
    damping: np.ndarray
    cells: np.ndarray | None = None
    weights: np.ndarray | None = None
    refresh: Refresh | None = None


@dataclass(frozen=True)
class Quantity:
    """Metadata of a numeric field in SI units, from which checks, ``vary`` and USD attributes follow.

    Attributes:
        rule: The rule for values in error messages, such as "must be above 0".
        holds: (array of values) → which of them obey it.
        shape: Shape of one value, () or (3,).
    """

    rule: str
    holds: Callable
    shape: tuple[int, ...] = ()


@dataclass(frozen=True)
class Indices:
    """Metadata of a field of vertex indices.

    Attributes:
        each: Vertices per element.
        text: Meaning of a string: "selection" of vertices, a "word" of the energy, or "" if refused.
    """

    each: int = 1
    text: str = ""


def quantity(rule, holds, shape=()):
    """Returns the ``metadata`` of a :class:`Quantity`."""
    return {"quantity": Quantity(rule, holds, shape)}


def indices(each=1, text=""):
    """Returns the ``metadata`` of :class:`Indices`."""
    return {"indices": Indices(each, text)}


FROM_0 = quantity("must be 0 or more", lambda values: values >= 0.0)
FINITE = quantity("must be finite", np.isfinite)
FINITE_FROM_0 = quantity("must be finite, 0 or more", lambda values: (values >= 0.0) & np.isfinite(values))


@dataclass(frozen=True, kw_only=True)
class Declared:
    """The base class of all terms: a stiffness, a name and the part of the mesh.

    A subclass sets ``term`` and defines ``stencil``; numeric fields have the metadata of :func:`quantity`.

    Attributes:
        term: The :class:`warpcloth.kernels.term.Term` of the energy.
        stiffness: One or (E,) [unit of the term].
        name: Label among terms.
        part: Part of the mesh that selections, indices and arrays refer to (:meth:`warpcloth.Mesh.join`), or None.

    Raises:
        ValueError: A value is not allowed. Lengths of arrays are checked when the scene is built.
    """

    term: ClassVar[Term]

    stiffness: float | Sequence[float] | np.ndarray = field(metadata=FROM_0)
    name: str | None = None
    part: str | None = None

    def __post_init__(self):
        keep_plain(self)
        if not (self.part is None or isinstance(self.part, str)):
            raise ValueError(f"{self.label}.part is {shown(self.part)}; it must be the name of a part of the mesh or None")
        if not (self.name is None or isinstance(self.name, str)):
            raise ValueError(f"{type(self).__name__}.name is {shown(self.name)}; it must be a text or None")
        for name, of_field in self.quantities().items():
            if getattr(self, name) is not None or name == "stiffness":
                values = self._numeric(name)
                refuse(f"{self.label}.{name}", values, ~of_field.holds(values), of_field.rule)

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """Returns the :class:`Quantity` of each numeric field by name."""
        return {field.name: field.metadata["quantity"] for field in fields(cls) if "quantity" in field.metadata}

    @property
    def label(self) -> str:
        """The name, or the name of the class."""
        return self.name or type(self).__name__

    def _numeric(self, field):
        return numeric(f"{self.label}.{field}", getattr(self, field), "be a number or an array of numbers")

    def of_elements(self, field: str, count: int) -> np.ndarray:
        """Returns a numeric field as one value (…) or one per element (count, …); refuses other shapes."""
        values, shape = self._numeric(field), self.quantities()[field].shape
        if values.shape not in (shape, (count, *shape)):
            one = f"of shape {shape}" if shape else "number"
            raise ValueError(
                f"{self.label}.{field} has shape {values.shape}; it must be one {one} or one for each of the {count} elements"
            )
        return values

    def _stiffness(self, count):
        return self.of_elements("stiffness", count)

    def stencil(self, mesh: Mesh) -> np.ndarray:
        """Returns the vertices of each element on ``mesh``, (E, K) int32."""
        raise NotImplementedError  # every energy has its own

    def elements(self, mesh: Mesh, positions: np.ndarray) -> Elements:
        """Returns the :class:`Elements` of this term on a mesh.

        Args:
            mesh: The mesh; its points are the rest shape.
            positions: Initial positions, (n, 3) [m].

        Raises:
            ValueError: The mesh has no elements or no such part, or the length of an array is not that of the elements.
        """
        if self.part is None:
            return self.elements_on(mesh, positions)
        part = mesh.part(self.part)
        first = (mesh.parts or {})[self.part].first
        found = self.elements_on(part, None if positions is None else positions[first : first + len(part.points)])
        return replace(found, stencil=found.stencil + np.int32(first))

    def elements_on(self, mesh: Mesh, positions: np.ndarray) -> Elements:
        """Returns the elements on the mesh of the part."""
        stencil = self.stencil(mesh)
        if len(stencil) == 0:
            raise ValueError(f"{self.label} has no elements on this mesh of {len(mesh.triangles)} triangles; leave it out")
        of_stencil = np.shape(stencil)[1:]
        if of_stencil != (self.term.vertices,) or np.min(stencil) < 0 or np.max(stencil) >= len(mesh.points):
            raise ValueError(
                f"{self.label}: the stencil has shape {np.shape(stencil)} and vertices {np.min(stencil)} to {np.max(stencil)}; "
                f"it must be {self.term.vertices} of the {len(mesh.points)} vertices for each element"
            )
        stiffness = self._stiffness(len(stencil))
        damped = getattr(self, "damping", None) is not None
        damping = self.of_elements("damping", len(stencil)) if damped else np.zeros(())
        rest = self.rest(mesh, positions, stencil)
        if np.shape(rest)[1:] != (self.term.parameters,):
            raise ValueError(f"{self.label}: the rest state has shape {np.shape(rest)}; it must be (…, {self.term.parameters})")
        return Elements(self.label, self.term, stencil, stiffness, rest, damping)

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        """Returns the rest states (E, P) of the elements, by default of the rest shape."""
        return self.term.rest_state(mesh.points, stencil)

    def held(self, mesh: Mesh, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pairs of vertices whose distance the term keeps, (m, 2), and their K, (m,) [N/m]; by default none.

        K is force per width and strain of a sheet.
        """
        return np.empty((0, 2), dtype=np.int32), np.empty(0)


@dataclass(frozen=True, kw_only=True)
class Damped(Declared):
    """The base class of terms with damping β, which adds the dissipation Σ (Aβ/2hₑ)‖s(y) − s(yₙ)‖² to each step.

    s is an invariant such as a length, by :class:`warpcloth.kernels.term.Dissipation`.

    Attributes:
        damping: β, one or (E,) [unit of the term, per unit of s², times s].
    """

    damping: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=FINITE_FROM_0)


def own_indices(name, given):
    """Returns indices as (E,) int32; refuses all but whole numbers below 2³¹."""
    found = as_array(given)
    found = found.astype(np.int32) if found.size == 0 else found
    if found.ndim != 1 or found.dtype.kind not in "iu":
        raise ValueError(f"{name} is {shown(given)}; it must be a list of whole numbers")
    held = found.astype(np.int32)
    for k in np.flatnonzero(held != found)[:1]:
        raise ValueError(f"{name}[{k}] is {found[k]}; it must be below 2^31")
    return held


def own_stencil(label, parameter, given, vertices, count):
    """Returns indices below ``count`` as (E, ``vertices``) int32, also of (E,) for one vertex; refuses pairs of one vertex."""
    stencil = as_array(given)
    if vertices == 1 and stencil.ndim == 1:
        stencil = stencil[:, None]
    if stencil.dtype.kind not in "iu" and stencil.size:
        raise ValueError(f"{label}.{parameter} is {shown(given)}; it must hold integers, {vertices} for each element")
    if stencil.ndim != 2 or stencil.shape[1] != vertices or len(stencil) == 0 or stencil.dtype.kind not in "iu":
        raise ValueError(
            f"{label}.{parameter} has shape {stencil.shape} and type {stencil.dtype}; it must hold integers, "
            f"{vertices} for each of one or more elements"
        )
    wrong = ((stencil < 0) | (stencil >= count)).any(axis=1)
    if vertices == 2:
        wrong |= stencil[:, 0] == stencil[:, 1]
    if wrong.any():
        e = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"{label}.{parameter}[{e}] is {stencil[e].tolist()}; indices must differ and lie in 0 … {count - 1}")
    return stencil.astype(np.int32)
