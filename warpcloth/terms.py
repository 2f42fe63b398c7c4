"""What a scene writes: one small frozen record per energy, with units. The energies themselves are in ``kernels/terms``."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from .kernels.term import Term
from .kernels.terms import ATTACHMENT, DIHEDRAL_BENDING, QUADRATIC_BENDING, SPRING


@dataclass(frozen=True)
class Elements:
    """The elements of one term on one mesh, as NumPy arrays.

    Attributes:
        label: Name of the term within its scene.
        kind: Class name of the term.
        term: The energy.
        stencil: Vertices of each element, (E, K) int32.
        stiffness: One value or (E,) [unit of the term].
        rest: Rest state (E, P).
    """

    label: str
    kind: str
    term: Term
    stencil: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray


@dataclass(frozen=True, kw_only=True)
class _Declared:
    """What all terms have: a stiffness and a name to tell two terms of one kind apart."""

    term: ClassVar[Term]

    stiffness: float | Sequence[float] | np.ndarray
    name: str | None = None

    def stencil(self, mesh):
        """Vertices of each element on ``mesh``, (E, K) int32."""
        raise NotImplementedError  # every term below has its own

    def elements(self, mesh, positions):
        """The elements of this term on a mesh.

        Args:
            mesh: The :class:`warpcloth.Mesh`; its points are the rest shape.
            positions: Where the vertices start, (n, 3) [m].

        Returns:
            :class:`Elements`.

        Raises:
            ValueError: If the mesh has none, or the stiffness is negative or NaN, or has another length than the elements.
        """
        label = self.name or type(self).__name__
        stencil = self.stencil(mesh)
        if len(stencil) == 0:
            raise ValueError(f"{label} has no elements on this mesh of {len(mesh.triangles)} triangles; leave it out")
        try:
            stiffness = np.asarray(self.stiffness, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{label}.stiffness is {self.stiffness!r}; it must be numeric") from None
        if stiffness.shape not in ((), (len(stencil),)):
            raise ValueError(
                f"{label}.stiffness has shape {stiffness.shape}; it must be one number or one for each of the "
                f"{len(stencil)} elements"
            )
        bad = np.flatnonzero(~(np.atleast_1d(stiffness) >= 0.0))
        if len(bad):
            value = np.atleast_1d(stiffness)[bad[0]]
            raise ValueError(f"{label}.stiffness[{bad[0]}] is {value}; it must be 0 or more")
        return Elements(label, type(self).__name__, self.term, stencil, stiffness, self.rest(mesh, positions, stencil))

    def rest(self, mesh, positions, stencil):
        """Rest state (E, P) of the elements, from the rest shape of the mesh."""
        return self.term.rest_state(mesh.points, stencil)


@dataclass(frozen=True, kw_only=True)
class Spring(_Declared):
    """Springs, U = Σ ½k(l − L)² (Provot 1995).

    Attributes:
        pairs: Which vertices: ``"edges"`` of the mesh; of a grid ``"structural"`` (along rows and columns), ``"shear"``
            (both diagonals of each cell), ``"bending"`` (two apart; on other meshes the opposite vertices of each hinge);
            several of these in a tuple; or own pairs (E, 2).
        stiffness: k [N/m], one or (E,); ``math.inf`` for solvers that take hard constraints.
        rest_lengths: L [m], one or (E,), if not those of the mesh.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = SPRING

    pairs: str | tuple | np.ndarray = "edges"
    rest_lengths: float | Sequence[float] | np.ndarray | None = None

    def stencil(self, mesh):
        if isinstance(self.pairs, str):
            return mesh.springs(self.pairs)
        if len(self.pairs) and all(isinstance(kind, str) for kind in self.pairs):
            return np.concatenate([mesh.springs(kind) for kind in self.pairs])
        return own_stencil(self.name or "Spring", "pairs", self.pairs, 2, len(mesh.points))

    def rest(self, mesh, positions, stencil):
        if self.rest_lengths is None:
            return super().rest(mesh, positions, stencil)
        lengths = np.asarray(self.rest_lengths, dtype=np.float64)
        if lengths.shape not in ((), (len(stencil),)):
            raise ValueError(
                f"{self.name or 'Spring'}.rest_lengths has shape {lengths.shape}; it must be one number or one for each "
                f"of the {len(stencil)} springs"
            )
        bad = np.flatnonzero(~((np.atleast_1d(lengths) >= 0.0) & np.isfinite(np.atleast_1d(lengths))))
        if len(bad):
            raise ValueError(
                f"{self.name or 'Spring'}.rest_lengths[{bad[0]}] is {np.atleast_1d(lengths)[bad[0]]}; it must be finite, "
                "0 or more"
            )
        return np.broadcast_to(lengths, len(stencil))[:, None].copy()


@dataclass(frozen=True, kw_only=True)
class QuadraticBending(_Declared):
    """Quadratic bending of a sheet that is flat at rest, U = Σ ½D‖y‖²/(A₁+A₂) (Bergou et al. 2006). Linear forces.

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated on an equilateral mesh. A grid with one diagonal a
            cell is 3 times as stiff where it curves along its diagonals, as stiff where it folds about them or curves along
            its rows, and 0.75 times 15° off the rows away from them; one with alternating diagonals is 1 to 1.5 times.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = QUADRATIC_BENDING

    def stencil(self, mesh):
        return mesh.hinges


@dataclass(frozen=True, kw_only=True)
class DihedralBending(_Declared):
    """Bending by the angle between neighbouring triangles, U = Σ ½D|e|²/(A₁+A₂)(θ−θ̄)² (Grinspun et al. 2003).

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated as in :class:`QuadraticBending`.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = DIHEDRAL_BENDING

    def stencil(self, mesh):
        return mesh.hinges


@dataclass(frozen=True, kw_only=True)
class Attachment(_Declared):
    """Vertices held by springs of no length, U = Σ ½k‖x − target‖²: a pin that gives way.

    Attributes:
        vertices: Indices (E,), or a selection such as ``"corners"``.
        stiffness: k [N/m], one or (E,).
        targets: Places (E, 3) [m], if not where the vertices start.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = ATTACHMENT

    vertices: str | Sequence[int] | np.ndarray = field(default=())
    targets: Sequence | np.ndarray | None = None

    def stencil(self, mesh):
        vertices = mesh.select(self.vertices) if isinstance(self.vertices, str) else self.vertices
        vertices = np.asarray(vertices)[:, None] if np.ndim(vertices) == 1 else vertices
        return own_stencil(self.name or "Attachment", "vertices", vertices, 1, len(mesh.points))

    def rest(self, mesh, positions, stencil):
        if self.targets is None:
            return super().rest(mesh, positions, stencil) if positions is None else positions[stencil[:, 0]]
        targets = np.asarray(self.targets, dtype=np.float64)
        if targets.shape != (len(stencil), 3) or not np.isfinite(targets).all():
            raise ValueError(
                f"{self.name or 'Attachment'}.targets has shape {targets.shape}; it must be ({len(stencil)}, 3), all finite"
            )
        return targets


TERMS = {cls.__name__: cls for cls in (Spring, QuadraticBending, DihedralBending, Attachment)}


def own_stencil(label, parameter, indices, vertices, count):
    """Indices that a user gave as (E, ``vertices``) int32.

    Raises:
        ValueError: If the shape is another, or an element names a vertex twice or one outside [0, ``count``).
    """
    stencil = np.asarray(indices)
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
