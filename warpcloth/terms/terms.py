"""What a scene writes: one small frozen record per energy, with units. The energies themselves are in ``kernels/terms``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ..base.checks import numeric, refuse, shown
from ..kernels.term import Term
from ..kernels.terms import (
    ATTACHMENT,
    COROTATED_MEMBRANE,
    DIHEDRAL_BENDING,
    NEO_HOOKEAN_MEMBRANE,
    QUADRATIC_BENDING,
    RIGID_CLUSTER,
    SPRING,
    SPRING_LIMIT,
    STRAIN_LIMIT,
    STVK_MEMBRANE,
)
from ..mesh.selection import distinct_vertices


@dataclass(frozen=True)
class Elements:
    """The elements of one term on one mesh, as NumPy arrays.

    Attributes:
        label: Name of the term within its scene.
        kind: Class name of the term.
        term: The energy.
        stencil: Vertices of each element, (E, K) int32.
        stiffness: One value or (E,), or (C,) of cells [unit of the term].
        rest: Rest state (E, P).
        damping: One value or (E,) [that times s].
        cells: Of elements that belong to cells, E of them from cells[c] to cells[c+1] to cell c, (C+1,); else None.
    """

    label: str
    kind: str
    term: Term
    stencil: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray
    damping: np.ndarray
    cells: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Declared:
    """What all terms have: a stiffness and a name to tell two terms of one kind apart.

    Raises:
        ValueError: If a value breaks a rule; lengths are compared with the number of elements when a scene is built.
    """

    term: ClassVar[Term]

    stiffness: float | Sequence[float] | np.ndarray
    name: str | None = None

    def __post_init__(self):
        if not (self.name is None or isinstance(self.name, str)):
            raise ValueError(f"{type(self).__name__}.name is {shown(self.name)}; it must be a text or None")
        stiffness = self._numeric("stiffness")
        refuse(f"{self.label}.stiffness", stiffness, ~(stiffness >= 0.0), "must be 0 or more")

    @property
    def label(self):
        """The name, or else that of the class."""
        return self.name or type(self).__name__

    def _numeric(self, field):
        return numeric(f"{self.label}.{field}", getattr(self, field), "be a number or an array of numbers")

    def _of_elements(self, field, count):
        """A field as one number () or one for each element (count,)."""
        values = self._numeric(field)
        if values.shape not in ((), (count,)):
            raise ValueError(
                f"{self.label}.{field} has shape {values.shape}; it must be one number or one for each of the {count} elements"
            )
        return values

    def _stiffness(self, count):
        return self._of_elements("stiffness", count)

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
            ValueError: If the mesh has none, or an array has another length than the elements.
        """
        stencil = self.stencil(mesh)
        if len(stencil) == 0:
            raise ValueError(f"{self.label} has no elements on this mesh of {len(mesh.triangles)} triangles; leave it out")
        stiffness = self._stiffness(len(stencil))
        damped = getattr(self, "damping", None) is not None
        damping = self._of_elements("damping", len(stencil)) if damped else np.zeros(())
        rest = self.rest(mesh, positions, stencil)
        return Elements(self.label, type(self).__name__, self.term, stencil, stiffness, rest, damping)

    def rest(self, mesh, positions, stencil):
        """Rest state (E, P) of the elements, from the rest shape of the mesh."""
        return self.term.rest_state(mesh.points, stencil)


@dataclass(frozen=True, kw_only=True)
class _Damped(Declared):
    """What terms have that can be damped: β, of a dissipation Σ (Aβ/2hₑ)‖s(y) − s(yₙ)‖² a step, s the term's own invariant."""

    damping: float | Sequence[float] | np.ndarray | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.damping is not None:
            damping = self._numeric("damping")
            refuse(f"{self.label}.damping", damping, ~((damping >= 0.0) & np.isfinite(damping)), "must be finite, 0 or more")


@dataclass(frozen=True, kw_only=True)
class Spring(_Damped):
    """Springs, U = Σ ½k(l − L)² (Provot 1995).

    Attributes:
        pairs: Which vertices: ``"edges"`` of the mesh; of a grid ``"structural"`` (along rows and columns), ``"shear"``
            (both diagonals of each cell), ``"bending"`` (two apart; on other meshes the opposite vertices of each hinge);
            several of these in a tuple, where a pair that belongs to more than one kind is one spring; or own pairs (E, 2).
            Arrays of the other fields have one value per pair. Own pairs keep their order. ``"edges"`` (and ``"structural"``
            without a grid) have the order of ``mesh.edges``, which for an edge mesh is the order in which its edges were given.
            All other kinds, and several kinds together, are in lexicographic order, the smaller index first.
        stiffness: k [N/m], one or (E,); ``math.inf`` for solvers that take hard constraints.
        rest_lengths: L [m], one or (E,), if not those of the mesh.
        damping: β [N·s/m], one or (E,): a force −β dl/dt along the spring.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = SPRING

    pairs: str | tuple | np.ndarray = "edges"
    rest_lengths: float | Sequence[float] | np.ndarray | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.rest_lengths is not None:
            lengths = self._numeric("rest_lengths")
            wrong = ~((lengths >= 0.0) & np.isfinite(lengths))
            refuse(f"{self.label}.rest_lengths", lengths, wrong, "must be finite, 0 or more")

    def stencil(self, mesh):
        return pairs_on(mesh, self.label, self.pairs)

    def rest(self, mesh, positions, stencil):
        if self.rest_lengths is None:
            return super().rest(mesh, positions, stencil)
        lengths = self._of_elements("rest_lengths", len(stencil))
        return np.broadcast_to(lengths, len(stencil))[:, None].copy()


@dataclass(frozen=True, kw_only=True)
class CorotatedMembrane(_Damped):
    """A membrane of triangles without Poisson's effect, U = Σ ½kA‖F − R‖², R the polar rotation of F (Chao et al. 2010).

    F (3×2) is the deformation gradient and A the rest area of a triangle. Linear in the stretch, and has a projection.

    Attributes:
        stiffness: k = Et = 2μ [N/m], Young's modulus times thickness: force over width and strain of a strip that is pulled.
            One or (T,); ``math.inf`` for solvers that take hard constraints.
        damping: β [N·s/m], one or (T,): a stress βĖ, E = ½(FᵀF − I) the Green strain.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = COROTATED_MEMBRANE

    @classmethod
    def from_material(cls, youngs_modulus, thickness, **fields):
        """Of a material with E [Pa] and ν = 0, ``thickness`` t [m] thick."""
        return cls(stiffness=_product(cls, youngs_modulus, thickness), **fields)

    def stencil(self, mesh):
        return mesh.triangles


@dataclass(frozen=True, kw_only=True)
class _Isotropic(_Damped):
    """What isotropic membranes in plane stress have: k = Et, and Poisson's ratio ν.

    In these μ = k/(2(1 + ν)) and λ = kν/(1 − ν²). A stiffness that varies leaves ν as it is.
    """

    poisson_ratio: float | Sequence[float] | np.ndarray = 0.0

    def __post_init__(self):
        super().__post_init__()
        ratio = self._numeric("poisson_ratio")
        refuse(f"{self.label}.poisson_ratio", ratio, ~((ratio > -1.0) & (ratio < 1.0)), "must be above -1 and below 1")

    @classmethod
    def from_material(cls, youngs_modulus, poisson_ratio, thickness, **fields):
        """Of a material with E [Pa] and ν, ``thickness`` t [m] thick: μ = Et/(2(1 + ν)), λ = Eνt/(1 − ν²) [N/m]."""
        return cls(stiffness=_product(cls, youngs_modulus, thickness), poisson_ratio=poisson_ratio, **fields)

    @classmethod
    def from_moduli(cls, mu, lam, **fields):
        """Of Lamé's moduli of the membrane, μ above 0 and λ above −μ [N/m]: ν = λ/(λ + 2μ), k = 2μ(1 + ν)."""
        mu, lam = (numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in (("mu", mu), ("lam", lam)))
        refuse(f"{cls.__name__}.mu", mu, ~(mu > 0.0), "must be above 0")
        ratio = lam / (lam + 2.0 * mu)
        return cls(stiffness=2.0 * mu * (1.0 + ratio), poisson_ratio=ratio, **fields)

    def stencil(self, mesh):
        return mesh.triangles

    def rest(self, mesh, positions, stencil):
        return self.term.rest_state(mesh.points, stencil, poisson_ratio=self._of_elements("poisson_ratio", len(stencil)))


@dataclass(frozen=True, kw_only=True)
class StVKMembrane(_Isotropic):
    """A St. Venant–Kirchhoff membrane of triangles, U = Σ A(μ‖E‖² + ½λ(tr E)²), E = ½(FᵀF − I) the Green strain.

    F (3×2) is the deformation gradient and A the rest area of a triangle. It gives way under large pressure.

    Attributes:
        stiffness: k = Et [N/m], Young's modulus times thickness: force over width and strain of a strip that is pulled a
            little. One or (T,). μ = k/(2(1 + ν)), λ = kν/(1 − ν²).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ, E = ½(FᵀF − I) the Green strain.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = STVK_MEMBRANE


@dataclass(frozen=True, kw_only=True)
class NeoHookeanMembrane(_Isotropic):
    """A stable Neo-Hookean membrane, U = Σ A(½μ(‖F‖² − 2) − μ(J − 1) + ½(λ + μ)(J − 1)²) (Smith, De Goes and Kim 2018).

    F (3×2) is the deformation gradient, J = ‖f₁×f₂‖, and A the rest area of a triangle. It recovers from any deformation.

    Attributes:
        stiffness: k = Et [N/m], Young's modulus times thickness: force over width and strain of a strip that is pulled a
            little. One or (T,). μ = k/(2(1 + ν)), λ = kν/(1 − ν²).
        poisson_ratio: ν, above −1 and below 1, one or (T,).
        damping: β [N·s/m], one or (T,): a stress βĖ, E = ½(FᵀF − I) the Green strain.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = NEO_HOOKEAN_MEMBRANE


@dataclass(frozen=True, kw_only=True)
class QuadraticBending(_Damped):
    """Quadratic bending of a sheet that is flat at rest, U = Σ ½D‖y‖²/(A₁+A₂) (Bergou et al. 2006). Linear forces.

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated on an equilateral mesh. A grid with one diagonal a
            cell is 3 times as stiff where it curves along its diagonals, as stiff where it folds about them or curves along
            its rows, and 0.75 times 15° off the rows away from them; one with alternating diagonals is 1 to 1.5 times.
            The equilateral mesh has a Poisson's ratio of −1/3; the other meshes are not isotropic plates.
        damping: β [N·m·s], of the rate of ‖y‖, which for a small angle θ is |e|·|θ|.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = QUADRATIC_BENDING

    def stencil(self, mesh):
        return mesh.hinges


@dataclass(frozen=True, kw_only=True)
class DihedralBending(_Damped):
    """Bending by the angle between neighbouring triangles, U = Σ ½D|e|²/(A₁+A₂)(θ−θ̄)² (Grinspun et al. 2003).

    Attributes:
        stiffness: D, the bending stiffness of the plate [N·m], calibrated as in :class:`QuadraticBending`.
        damping: β [N·m·s], of the rate of θ.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = DIHEDRAL_BENDING

    def stencil(self, mesh):
        return mesh.hinges


@dataclass(frozen=True, kw_only=True)
class Attachment(_Damped):
    """Vertices held by springs of no length, U = Σ ½k‖x − target‖²: a pin that gives way.

    Attributes:
        vertices: Indices (E,), or a selection such as ``"corners"``.
        stiffness: k [N/m], one or (E,).
        targets: Places (E, 3) [m], if not where the vertices start.
        damping: β [N·s/m], one or (E,): a force −βv. Unlike that of other terms it acts in rigid motion too.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = ATTACHMENT

    vertices: str | Sequence[int] | np.ndarray = field(default=())
    targets: Sequence | np.ndarray | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.targets is not None:
            targets = self._numeric("targets")
            refuse(f"{self.label}.targets", targets, ~np.isfinite(targets), "must be finite")

    def stencil(self, mesh):
        vertices = mesh.select(self.vertices) if isinstance(self.vertices, str) else self.vertices
        return own_stencil(self.label, "vertices", vertices, 1, len(mesh.points))

    def rest(self, mesh, positions, stencil):
        if self.targets is None:
            return super().rest(mesh, positions, stencil) if positions is None else positions[stencil[:, 0]]
        targets = self._numeric("targets")
        if targets.shape != (len(stencil), 3):
            raise ValueError(f"{self.label}.targets has shape {targets.shape}; it must be ({len(stencil)}, 3)")
        return targets


@dataclass(frozen=True, kw_only=True)
class _Limit(Declared):
    """What limits have: a stiffness that is infinite unless it is given, and a least and a most."""

    stiffness: float | Sequence[float] | np.ndarray = math.inf
    least: float | Sequence[float] | np.ndarray | None = None
    most: float | Sequence[float] | np.ndarray | None = None

    def __post_init__(self):
        super().__post_init__()
        given = {name: self._numeric(name) for name in ("least", "most") if getattr(self, name) is not None}
        if not given:
            raise ValueError(f"{self.label} has neither least nor most; at least one of the two must be given")
        for name, values in given.items():
            refuse(f"{self.label}.{name}", values, ~((values > 0.0) & np.isfinite(values)), "must be finite, above 0")
        if len(given) == 2 and len({values.shape for values in given.values() if values.ndim}) < 2:
            least, most = np.broadcast_arrays(given["least"], given["most"])
            refuse(f"{self.label}.least", least, ~(least <= most), "must be no more than most")

    def rest(self, mesh, positions, stencil):
        given = {name: self._of_elements(name, len(stencil)) for name in ("least", "most") if getattr(self, name) is not None}
        return self.term.rest_state(mesh.points, stencil, **given)


@dataclass(frozen=True, kw_only=True)
class SpringLimit(_Limit):
    """Limits of the lengths of pairs, U = Σ ½k(l − c)², c = l clamped to [σ_min L, σ_max L] (Provot 1995).

    Attributes:
        least, most: σ_min, σ_max, ratios to the rest length L, one or (E,); at least one of the two.
        pairs: Which vertices, and in which order, as in :class:`Spring`.
        stiffness: k [N/m], one or (E,): of the springs that pairs beyond their limits are; infinite for PBD, which takes
            hard constraints, finite for solvers that need forces.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = SPRING_LIMIT

    pairs: str | tuple | np.ndarray = "edges"

    def stencil(self, mesh):
        return pairs_on(mesh, self.label, self.pairs)


@dataclass(frozen=True, kw_only=True)
class StrainLimit(_Limit):
    """Limits of the principal stretches of triangles, U = Σ ½kA‖F − p‖², p the nearest with σ_min ≤ σᵢ ≤ σ_max (Thomaszewski
    et al. 2009).

    Attributes:
        least, most: σ_min, σ_max of the singular values of the deformation gradient F, one or (T,); at least one of the two.
        stiffness: k [N/m], one or (T,), that of :class:`CorotatedMembrane` beyond the limits; infinite for PBD, which takes
            hard constraints, finite for solvers that need forces.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = STRAIN_LIMIT

    def stencil(self, mesh):
        return mesh.triangles


@dataclass(frozen=True, kw_only=True)
class RigidCluster(Declared):
    """Bodies, U = Σ (κ/2)Σ mᵢ‖xᵢ − (c + R qᵢ)‖² over their vertices, c and R the best motion of their rest shape (Müller et al.
    2005).

    Bodies that share a vertex hang together there. The mass of a vertex in several bodies counts in each. A pinned vertex
    counts as a thousand times all others of its body, so that the body turns about it. A body on a line keeps no
    orientation about it. Newton's method takes κM for the Hessian, which holds bodies back as a whole: steps with κh² near 1
    or above take more iterations, and ``equilibrium`` of bodies that move far may use up its own.

    Attributes:
        vertices: Indices of the bodies, one after the other, (E,); or a list of an array for each body; or a selection such as
            ``"x < 0.1"`` for one body, or a list of them.
        sizes: Vertices of each body, (C,), where ``vertices`` is one array of several bodies; else found.
        stiffness: κ [1/s²], one or (C,): the square of the frequency at which a vertex swings about its place; infinite for
            solvers that take hard constraints.
        name: To tell two terms of one kind apart.
    """

    term: ClassVar[Term] = RIGID_CLUSTER

    vertices: str | Sequence | np.ndarray = field(default=())
    sizes: Sequence[int] | np.ndarray | None = None
    stiffness: float | Sequence[float] | np.ndarray = math.inf

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.vertices, (str, Sequence)) and not (
            isinstance(self.vertices, np.ndarray) and self.vertices.ndim
        ):
            raise ValueError(f"{self.label}.vertices is {shown(self.vertices)}; it must be a list of bodies or a selection")
        texts = self._selections
        if texts and self.sizes is not None:
            raise ValueError(f"{self.label} has sizes and selections, which are one body each; leave sizes out")
        if texts or not len(self.vertices) or np.ndim(self.vertices[0]) == 0:
            return
        if self.sizes is not None:
            raise ValueError(f"{self.label} has sizes and a list for each body; at most one of the two may be given")
        bodies = [own_indices(f"{self.label}.vertices[{c}]", body) for c, body in enumerate(self.vertices)]
        object.__setattr__(self, "vertices", np.concatenate(bodies))
        object.__setattr__(self, "sizes", np.array([len(body) for body in bodies]))

    @property
    def _selections(self):
        """The selection of each body, or () where bodies are given by indices."""
        vertices = (self.vertices,) if isinstance(self.vertices, str) else self.vertices
        texts = [isinstance(body, str) for body in vertices]
        if any(texts) and not all(texts):
            raise ValueError(
                f"{self.label}.vertices has both selections and indices; all bodies must be given by one of the two"
            )
        return tuple(vertices) if any(texts) else ()

    def _bodies(self, mesh):
        """Vertices of each body, a list of index arrays."""
        if texts := self._selections:
            bodies = [mesh.select(text) for text in texts]
            for text in [text for text, body in zip(texts, bodies, strict=True) if not len(body)][:1]:
                raise ValueError(f"{self.label}.vertices: {text!r} selects nothing; a body must have one vertex or more")
            return bodies
        vertices = own_indices(f"{self.label}.vertices", self.vertices)
        if not len(vertices) and self.sizes is None:
            return []
        sizes = np.array([len(vertices)]) if self.sizes is None else own_indices(f"{self.label}.sizes", self.sizes)
        if sizes.sum() != len(vertices) or (sizes < 1).any():
            raise ValueError(
                f"{self.label}.sizes is {shown(sizes.tolist())}; it must be 1 or more each and {len(vertices)} in all"
            )
        return np.split(vertices, np.cumsum(sizes)[:-1])

    def stencil(self, mesh):
        bodies = [
            distinct_vertices(f"{self.label}.vertices, body {c}", body, mesh) for c, body in enumerate(self._bodies(mesh))
        ]
        return np.concatenate([np.zeros(0, np.int32), *bodies])[:, None]

    def _stiffness(self, count):
        bodies = (len(self._selections) or 1) if self.sizes is None else len(self.sizes)
        return self._of_elements("stiffness", bodies)

    def elements(self, mesh, positions):
        found = super().elements(mesh, positions)
        return replace(found, cells=np.cumsum([0, *(len(body) for body in self._bodies(mesh))]))


TERMS = {
    cls.__name__: cls
    for cls in (
        Spring,
        CorotatedMembrane,
        StVKMembrane,
        NeoHookeanMembrane,
        QuadraticBending,
        DihedralBending,
        Attachment,
        SpringLimit,
        StrainLimit,
        RigidCluster,
    )
}


def own_indices(name, indices):
    """Indices that a user gave as (E,) int32.

    Raises:
        ValueError: If they are no whole numbers in a row.
    """
    try:
        found = np.asarray(indices)
    except ValueError:  # rows of different lengths
        found = np.asarray(None)
    found = found.astype(np.int32) if found.size == 0 else found
    if found.ndim != 1 or found.dtype.kind not in "iu":
        raise ValueError(f"{name} is {shown(indices)}; it must be a list of whole numbers")
    return found.astype(np.int32)


def _product(cls, youngs_modulus, thickness):
    """Et [N/m]."""
    given = {"youngs_modulus": youngs_modulus, "thickness": thickness}
    modulus, t = (numeric(f"{cls.__name__}.{name}", value, "be a number") for name, value in given.items())
    refuse(f"{cls.__name__}.youngs_modulus", modulus, ~(modulus >= 0.0), "must be 0 or more")
    refuse(f"{cls.__name__}.thickness", t, ~(t > 0.0), "must be above 0")
    return (modulus * t)[()]


def pairs_on(mesh, label, pairs):
    """The pairs of :class:`Spring` on a mesh, (E, 2) int32."""
    kinds = (pairs,) if isinstance(pairs, str) else pairs
    if isinstance(kinds, (tuple, list)) and kinds and all(isinstance(kind, str) for kind in kinds):
        found = [mesh.springs(kind) for kind in kinds]
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found), axis=0)
    return own_stencil(label, "pairs", pairs, 2, len(mesh.points))


def own_stencil(label, parameter, indices, vertices, count):
    """Indices that a user gave, (E, ``vertices``) or (E,) of single ones, as (E, ``vertices``) int32.

    Raises:
        ValueError: If the shape is another, or an element names a vertex twice or one outside [0, ``count``).
    """
    try:
        stencil = np.asarray(indices)
    except ValueError:  # rows of different lengths
        stencil = np.asarray(None)
    if vertices == 1 and stencil.ndim == 1:
        stencil = stencil[:, None]
    if stencil.dtype.kind not in "iu" and stencil.size:
        raise ValueError(f"{label}.{parameter} is {shown(indices)}; it must hold integers, {vertices} for each element")
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
