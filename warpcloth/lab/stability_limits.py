"""Theoretical limits of methods: ratios for a scene and a solver that are above 1 beyond the limit."""

from functools import cached_property, lru_cache

import numpy as np

from ..base.turns import in_turn
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from ..numerics.integrators import INTEGRATORS
from ..numerics.local_weights import best_weights
from ..numerics.sweeps import IN_PLACE, colours
from ..solvers.explicit import step_limits
from ..terms import Spring

# Limits beyond which a run diverges. Beyond the others, it may be inaccurate.
DIVERGES = ("2/ω_max", "2/√(2 Σk/m)", "forward Euler", "ω λ_max = 2", "Gauss–Seidel, |z| = 1")
# Not a limit of a method: the error of the reference of a map over the requested accuracy.
KNOWN = "error of the reference = accuracy"
# Growth in energy of the fastest mode of a net, from noise, at which the whole net counts as diverged
# (:data:`warpcloth.run.balance.GAIN`). In runs of 40 to 400 steps it is 7 to 16.
GROWTH = 10.0
# Largest number of springs for which the eigenvalues of a sweep are computed, by a dense solver.
_MAX_SPRINGS = 1000


def limit_ratios(scene, record, steps):
    """Returns, by name, the ratios of those :data:`LIMITS` that the record of a solver names, each above 1 beyond its limit."""
    cell = _Cell(scene, record, steps)
    found = {name: LIMITS[name](cell) for name in record.facts.limits}
    return {name: ratio for name, ratio in found.items() if ratio is not None}


class _Cell:
    """A scene, a solver and the length of a run, with the quantities that limits need, such as h and hₑ [s]."""

    def __init__(self, scene, record, steps):
        self.scene, self.record, self.steps = scene, record, steps
        self.h = 1.0 / (scene.fps * record.per_frame(scene.fps))
        self.he = _integrator(record).share * self.h
        self.damped = any(getattr(term, "damping", None) is not None for term in scene.terms)
        self.springs = not self.damped and all(isinstance(term, Spring) for term in scene.terms)

    @cached_property
    def model(self):
        if any(np.isinf(term.stiffness).any() for term in self.scene.terms):
            return None
        return self.scene.build(dtype="float64")

    @cached_property
    def step_limits(self):
        return self.model and step_limits(self.model)


def _below_rest(cell):
    """Returns h over the largest stable step of symplectic Euler about the rest shape."""
    if cell.record.scheme == "symplectic" and cell.step_limits:
        return cell.h / cell.step_limits[0]


def _below_motion(cell):
    """Returns h over the largest stable step in motion."""
    if cell.record.scheme == "symplectic" and cell.step_limits:
        return cell.h / cell.step_limits[1]


def _forward_growth(cell):
    """Returns log growth of the fastest mode, by 1 + h²ω² per step, over that of :data:`GROWTH`; None with damping."""
    if cell.record.scheme == "forward" and not cell.damped and cell.step_limits:
        return cell.steps * np.log1p((2.0 * cell.h / cell.step_limits[0]) ** 2) / np.log(GROWTH)


def _jacobi_relaxation(cell):
    if cell.springs and cell.record.sweep not in IN_PLACE:
        return cell.record.relaxation / largest_relaxation(cell.scene, cell.he, cell.record)


def _ordered_relaxation(cell):
    if cell.springs and cell.record.sweep in IN_PLACE:
        limit = largest_ordered(cell.scene, cell.he, cell.record, cell.steps)
        return None if limit is None else cell.record.relaxation / limit


def _rings(cell):
    if len(cell.scene.pins.vertices):
        return rings(cell.scene) / cell.record.iterations


def _iterations_across(cell):
    """Returns the iterations that projections need across springs, or if accelerated the root, over those of the solver."""
    if cell.step_limits:
        needed = 1.0 + 2.0 * (cell.he / cell.step_limits[1]) ** 2
        return (needed if cell.record.acceleration == "none" else np.sqrt(needed)) / cell.record.iterations


def _weight(cell):
    """Returns the weight of ADMM over the best weight of the stiffest element; larger ones stall, smaller ones oscillate."""
    if cell.record.weight != "auto" and cell.model:
        return cell.record.weight / min(best_weights(cell.model, elements, cell.he).min() for elements in cell.model.terms)


def _not_convex(cell):
    """Returns hₑ√−λ, λ the lowest eigenvalue of M⁻¹∂²U/∂x² at the start; above 1 a step is not convex (Choi and Ko 2002)."""
    if cell.model:
        return cell.he * np.sqrt(concave_rate(cell.model))


# Functions of a :class:`_Cell` that return the ratio, or None if the limit does not apply, by the name of the limit. The record
# of a solver names its limits.
LIMITS = {
    "2/ω_max": _below_rest,
    "2/√(2 Σk/m)": _below_motion,
    "forward Euler": _forward_growth,
    "h² = m/(k(L/l − 1))": _not_convex,
    "ω λ_max = 2": _jacobi_relaxation,
    "Gauss–Seidel, |z| = 1": _ordered_relaxation,
    "1 + Σk h²/m iterations": _iterations_across,
    "r = 1/(2hω)": _weight,
    "a ring an iteration": _rings,
}


@in_turn
def concave_rate(model):
    """Returns −λ for the lowest eigenvalue λ of M⁻¹∂²U/∂x² at the start of one copy [1/s²]; 0 if none is negative.

    With more than 100 vertices, the error is up to 1e-4 of the largest row sum, and smaller eigenvalues count as 0.
    """
    hessian = Hessian(model, policy=HessianPolicy.RAW)
    hessian.assemble(model.positions, 0.0)
    root = np.sqrt(model.coordinate_mobility())
    matrix = hessian.matrix().multiply(root[:, None]).multiply(root).tocsr()
    if matrix.shape[0] <= 300:
        return max(0.0, -float(np.linalg.eigvalsh(matrix.toarray())[0]))
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import ArpackNoConvergence, eigsh

    # Errors are relative to the eigenvalue found, so find the largest of bound − λ.
    bound, start = float(abs(matrix).sum(axis=1).max()), np.random.default_rng(0).normal(size=matrix.shape[0])
    turned = bound * eye_array(matrix.shape[0], format="csr") - matrix
    try:
        found = eigsh(turned, k=1, which="LA", v0=start, tol=1e-4, ncv=60, maxiter=20, return_eigenvectors=False)
    except ArpackNoConvergence:
        return 0.0
    return max(0.0, float(found[0]) - bound)


def largest_relaxation(scene, he, record):
    """Returns the largest stable relaxation ω of Jacobi sweeps over springs without damping, about the rest shape.

    A sweep multiplies errors by 1 − ωλ. λ are the eigenvalues of C(D + α̃)⁻¹JVWJᵀ, with D the diagonal of JWJᵀ, α̃ = 1/(khₑ²),
    and C and V the factors of constraints and vertices; for XPBD, with multipliers, those of C(D + α̃)⁻¹(JWJᵀ + α̃). Sweeps
    converge iff ωλ_max < 2. The factor by which n sweeps multiply x̃, q = 1 − ρ(1 − (1 − ωλ)ⁿ) with ρ the fraction of JWJᵀ in
    λ, must be below 1 and above the ``least_factor`` of the integrator. For even n that is the same condition, for odd n it is
    (ωλ_max − 1)ⁿ < (1 − q_min)/ρ − 1.
    """
    from scipy.sparse import diags_array

    (pairs, mobility, compliance), inverse = _springs(scene, he), _inverse_masses(scene)
    if not len(pairs):
        return np.inf
    J = _directions(scene, pairs)
    factor = _share(mobility, compliance, record) / mobility
    counts = np.bincount(np.concatenate([term.stencil(scene.mesh) for term in scene.terms]).ravel(), minlength=len(inverse))
    if record.sweep == "constraint-averaged":
        factor /= np.where(inverse == 0.0, 1, counts)[pairs].max(axis=1)
    elif record.sweep == "vertex-averaged":
        inverse /= np.maximum(counts + record.alpha, 1.0)
    J = (diags_array(np.sqrt(factor)) @ J @ diags_array(np.repeat(np.sqrt(inverse), 3))).tocsr()
    moved = J @ J.T
    n = record.iterations
    # Before the first sweep, the multipliers are 0.
    largest, v = _largest(moved + diags_array(factor * compliance) if record.multipliers and n > 1 else moved)
    part = float(v @ (moved @ v)) / largest
    least = _integrator(record).least_factor
    return float(1.0 + (((1.0 - least) / part - 1.0) ** (1.0 / n) if n % 2 else 1.0)) / largest


def largest_ordered(scene, he, record, steps):
    """Finds the largest relaxation ω of Gauss–Seidel sweeps over undamped springs, about the rest shape, stable for a run.

    A sweep solves (D/ω + L)Δλ = −(Jx̃ + Aλ). A is JWJᵀ + α̃ for XPBD and JWJᵀ for PBD, D is the diagonal of JWJᵀ + α̃, α̃ =
    1/(khₑ²), and L is the part of JWJᵀ that comes before an element in the order of the sweep; x = x̃ + WJᵀλ. The matrix by
    which n sweeps multiply x̃ has complex eigenvalues q, because the order makes it unsymmetric. A run is stable while no |z|,
    by which steps multiply, makes the energy grow by :data:`GROWTH` in all steps. In a net of structural springs the smallest q
    is (1 − ω)ⁿ, which is −1/3 for ω = 1 + 3^(−1/n); with more springs complex q grow before that.

    Returns:
        float: ω; None if twice 1 + 3^(−1/n) is still stable, if no spring moves anything, or for more than :data:`_MAX_SPRINGS`
            springs, which take too long.
    """
    pairs, mobility, compliance = _springs(scene, he, _turns(scene, record))
    if not 0 < len(pairs) <= _MAX_SPRINGS:
        return None
    J = (_directions(scene, pairs) * np.repeat(np.sqrt(_inverse_masses(scene)), 3)).toarray()
    share = _share(mobility, compliance, record)
    kept = compliance if record.multipliers else np.zeros_like(compliance)
    given = J.tobytes(), len(pairs), (mobility / share).tobytes(), kept.tobytes()
    return _largest_ordered(*given, record.iterations, _integrator(record), steps)


@lru_cache(256)  # cells that differ in relaxation share a limit, and so do those of a hard net at all steps
def _largest_ordered(J, count, diagonal, compliance, n, integrator, steps):
    """Implements :func:`largest_ordered` with JW^½ (E, 3N), D (E,) and α̃ (E,), each as bytes."""
    from scipy.linalg import solve_triangular

    J, diagonal, compliance = np.frombuffer(J).reshape(count, -1), np.frombuffer(diagonal), np.frombuffer(compliance)
    A, B = J @ J.T + np.diag(compliance), J @ _range(J)
    before, after = np.tril(J @ J.T, -1), np.triu(J @ J.T, 1)

    def grows(omega):
        moves = np.zeros_like(B)
        for sweep in range(n):
            back = integrator.to_and_fro and sweep % 2
            factor = np.diag(diagonal / omega) + (after if back else before)
            moves -= solve_triangular(factor, B + A @ moves, lower=not back, check_finite=False)
        q = np.linalg.eigvals(np.eye(B.shape[1]) + B.T @ moves).astype(complex)
        return abs(integrator.growth(q)).max() > GROWTH ** (0.5 / steps)

    # There may be stable ω again beyond the first unstable one.
    trials = np.linspace(0.0, 2.0 * (1.0 + 3.0 ** (-1.0 / n)), 41)[1:] * (diagonal / np.diag(J @ J.T)).min()
    first = next((k for k, omega in enumerate(trials) if grows(omega)), None)
    if first is None:
        return None
    low, high = trials[first - 1] if first else 0.0, trials[first]
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return float(high)


def _springs(scene, he, turns=None):
    """Returns, for springs with a free vertex, vertices (E, 2), GWGᵀ (E,) and α̃ (E,), in the order of ``turns`` if given."""
    pairs = [term.stencil(scene.mesh) for term in scene.terms]
    stiffness = np.concatenate([np.broadcast_to(t.stiffness, len(p)) for t, p in zip(scene.terms, pairs, strict=True)])
    pairs = np.concatenate(pairs)
    if turns is not None:
        pairs, stiffness = pairs[turns], stiffness[turns]
    mobility = _inverse_masses(scene)[pairs].sum(axis=1)
    keep = (mobility > 0.0) & (stiffness > 0.0)
    return pairs[keep], mobility[keep], 1.0 / (stiffness[keep] * he**2)


def _turns(scene, record):
    """Returns the order in which a Gauss–Seidel sweep takes springs: term by term as declared, and by colour if coloured."""
    found, first, free = [], 0, _inverse_masses(scene) > 0.0
    for pairs in (term.stencil(scene.mesh) for term in scene.terms):
        order = np.argsort(colours(pairs, free), kind="stable") if record.sweep == "coloured" else np.arange(len(pairs))
        found.append(first + order)
        first += len(pairs)
    return np.concatenate(found)


def _directions(scene, pairs):
    """Assembles J at the rest shape (E, 3N), sparse: a spring's direction at one end, and the opposite at the other."""
    from scipy.sparse import csr_array

    points = scene.mesh.points
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    columns = (3 * pairs[:, :, None] + np.arange(3)).ravel()
    values = np.stack([-along, along], axis=1).ravel()
    return csr_array((values, columns, np.arange(len(pairs) + 1) * 6), shape=(len(pairs), points.size))


def _range(J):
    _, values, vectors = np.linalg.svd(J, full_matrices=False)
    return vectors[values > 1e-9 * values[0]].T


def _integrator(record):
    return INTEGRATORS[getattr(record, "integrator", "euler")]


def _share(mobility, compliance, record):
    """Returns the fraction of the violation of a single constraint that a sweep corrects, without ω."""
    if getattr(record, "correction", None) == "per-step":
        return 1.0 - (compliance / (mobility + compliance)) ** (1.0 / record.iterations)
    return mobility / (mobility + compliance)


def _inverse_masses(scene):
    inverse = 1.0 / scene.vertex_masses
    inverse[scene.fixed] = 0.0
    return inverse


def _largest(matrix):
    if matrix.shape[0] <= 300:
        values, vectors = np.linalg.eigh(matrix.toarray())
    else:
        from scipy.sparse.linalg import eigsh

        values, vectors = eigsh(matrix, k=1, which="LA", v0=np.ones(matrix.shape[0]), tol=1e-4)
    return values[-1], vectors[:, -1]


def rings(scene):
    """Returns the largest number of edges on the shortest path from a pin to a vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    n, (a, b) = len(scene.mesh.points), scene.mesh.edges.T
    edges = coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    ways = dijkstra(edges, directed=False, unweighted=True, indices=scene.pins.vertices, min_only=True)
    return int(ways[np.isfinite(ways)].max())
