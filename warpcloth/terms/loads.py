"""Loads on vertices, edges and triangles."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..base.checks import keep_plain, numeric, refuse, shown
from ..mesh.mesh import Mesh
from ..mesh.orientation import turned_over
from ..mesh.selection import distinct_vertices


@dataclass(frozen=True, eq=False, kw_only=True)
class Load:
    """The base class of loads, with a constant value or keyframes.

    Attributes:
        quantity: Name of the field with the constant value.
        shape: Shape of one value.
        acts_on: Its elements, for messages.
        vertices: Indices (p,), or a selection of the mesh such as ``"x == 1"``.
        keyframes: Values at frames 0 … F−1, (F, …), linear in between, constant after.

    Raises:
        ValueError: A value is not allowed. The scene checks vertices and lengths.
    """

    quantity: ClassVar[str]
    shape: ClassVar[tuple[int, ...]]
    acts_on: ClassVar[str]

    vertices: str | Sequence[int] | np.ndarray
    keyframes: Sequence | np.ndarray | None = None
    name: str | None = None

    def __post_init__(self):
        keep_plain(self)
        if (getattr(self, self.quantity) is None) == (self.keyframes is None):
            raise ValueError(f"{self.label}: exactly one of {self.quantity} and keyframes must be given")
        if not (self.name is None or isinstance(self.name, str)):
            raise ValueError(f"{type(self).__name__}.name is {shown(self.name)}; it must be a text or None")
        self._values()

    @property
    def label(self) -> str:
        return self.name or type(self).__name__

    def elements(self, mesh: Mesh) -> np.ndarray:
        """Returns the vertices (p,), edges (E, 2) or triangles (T, 3) that it acts on."""
        raise NotImplementedError  # every load has its own

    def of_elements(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Returns the elements, and the keyframes of each, (F, count, …), F = 1 if constant.

        Raises:
            ValueError: There are no elements, or another number of values.
        """
        found, values = self.elements(mesh), self._values()
        if not len(found):
            raise ValueError(f"{self.label} acts on nothing, for the mesh has no {self.acts_on}; leave the load out")
        count, each = values.shape[: self.keyframes is not None], (len(found), *self.shape)
        if values.shape not in ((*count, *self.shape), (*count, *each)) or count == (0,):
            given, many = values.shape, ("F",) * len(count)
            shapes = [str((*many, *shape)).replace("'F'", "F") for shape in (self.shape, each)]
            raise ValueError(
                f"{self._field} has shape {given}; it must be {' or '.join(shapes)} for {len(found)} {self.acts_on}"
            )
        values = values if count else values[None]
        values = values if values.shape[1:] == each else values[:, None]
        return found, np.broadcast_to(values, (len(values), *each))

    @property
    def _field(self):
        return f"{self.label}.{self.quantity if self.keyframes is None else 'keyframes'}"

    def _values(self):
        given = getattr(self, self.quantity) if self.keyframes is None else self.keyframes
        values = numeric(self._field, given, "be a number or an array of numbers")
        refuse(self._field, values, ~np.isfinite(values), "must be finite")
        return values


@dataclass(frozen=True, eq=False, kw_only=True)
class Force(Load):
    """Forces on vertices, of fixed direction.

    Attributes:
        force: [N] on each vertex, (3,), or (p, 3).
        keyframes: (F, 3) or (F, p, 3) [N].

    Examples:
        >>> import warpcloth as wc
        >>> chain, spring = wc.Mesh.chain(2), wc.Spring(stiffness=1e3)
        >>> pull = wc.Force(vertices=[1], force=(0, -10, 0))
        >>> scene = wc.Scene(chain, masses=[1, 1], terms=[spring], pins=[0], gravity=(0, 0, 0), loads=[pull])
        >>> round(float(-1 - wc.equilibrium(scene).points[1, 1]), 6)  # the force over the stiffness
        0.01
    """

    quantity: ClassVar[str] = "force"
    shape: ClassVar[tuple[int, ...]] = (3,)
    acts_on: ClassVar[str] = "such vertices"

    force: Sequence | np.ndarray | None = None

    def elements(self, mesh: Mesh) -> np.ndarray:
        return distinct_vertices(f"{self.label}.vertices", self.vertices, mesh)


@dataclass(frozen=True, eq=False, kw_only=True)
class Traction(Load):
    """Tractions on edges, of fixed direction. A force ½tL acts at each end of an edge of rest length L.

    Attributes:
        vertices: An edge is loaded if both of its ends are among these.
        traction: t [N/m] of rest length, (3,), or (E, 3) in the order of ``mesh.edges``.
        keyframes: (F, 3) or (F, E, 3) [N/m].
    """

    quantity: ClassVar[str] = "traction"
    shape: ClassVar[tuple[int, ...]] = (3,)
    acts_on: ClassVar[str] = "edges between such vertices"

    traction: Sequence | np.ndarray | None = None

    def elements(self, mesh: Mesh) -> np.ndarray:
        return mesh.edges[_within(self, mesh, mesh.edges)]


@dataclass(frozen=True, eq=False, kw_only=True)
class Pressure(Load):
    """Pressure on triangles along their normals: a force pAn/3 on each corner, with the current area A and normal n.

    Triangles that wind against their neighbours are turned over, the fewer in each piece, with a warning; a one-sided surface
    is refused. Pressure is evaluated once per step: at x for explicit steps and implicit Euler, at x + ½h v for midpoint, at
    2xₙ − xₙ₋₁ for BDF2.

    Attributes:
        vertices: A triangle is loaded if all its corners are among these.
        pressure: p [Pa], or (T,) in the order of ``mesh.triangles``.
        keyframes: (F,) or (F, T) [Pa].
    """

    quantity: ClassVar[str] = "pressure"
    shape: ClassVar[tuple[int, ...]] = ()
    acts_on: ClassVar[str] = "triangles of such vertices"

    pressure: float | Sequence[float] | np.ndarray | None = None

    def elements(self, mesh: Mesh) -> np.ndarray:
        loaded = np.flatnonzero(_within(self, mesh, mesh.triangles))
        triangles = mesh.triangles[loaded]
        if not len(triangles):
            return triangles
        try:
            against = turned_over(mesh.triangles, loaded)
        except ValueError as error:
            raise ValueError(f"{self.label}: {error}; pressure must act on a surface with two sides") from None
        if against.any():
            warnings.warn(
                f"{self.label}: {against.sum()} of {len(loaded)} triangles wind against their neighbours, the first of them "
                f"triangle {loaded[np.argmax(against)]}; they are pressed from the same side as the others",
                stacklevel=2,
            )
        return np.where(against[:, None], triangles[:, ::-1], triangles)


class Loads(tuple[Load, ...]):
    """All loads of a scene."""


LOADS = {kind.__name__: kind for kind in (Force, Traction, Pressure)}


def checked_loads(loads: Any, mesh: Mesh) -> Loads:
    """Returns one load or several as :class:`Loads`; refuses others, and those that do not fit the mesh."""
    if not isinstance(loads, Iterable):
        loads = (loads,)
    loads = Loads(loads)
    for k, load in enumerate(loads):
        if not isinstance(load, Load):
            raise ValueError(f"loads[{k}] is {shown(load)}; it must be a Force, Traction or Pressure")
        load.of_elements(mesh)
    return loads


def _within(load, mesh, elements):
    chosen = np.zeros(len(mesh.points), dtype=bool)
    chosen[distinct_vertices(f"{load.label}.vertices", load.vertices, mesh)] = True
    return chosen[elements].all(axis=1)
