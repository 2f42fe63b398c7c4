"""Where methods fail by theory: of a scene and a solver, numbers that are above 1 beyond the limit."""

from functools import lru_cache

import numpy as np

from ..base.turns import in_turn
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from ..numerics.integrators import INTEGRATORS
from ..numerics.sweeps import colours
from ..solvers import ADMM, PBD, XPBD, ConstrainedDynamics, Explicit, HierarchicalPBD, Newton, ProjectiveDynamics
from ..solvers.admm import best_weights
from ..solvers.explicit import step_limits
from ..terms import Spring

# Beyond these a run diverges; beyond the others it is wrong, or need not be.
DIVERGES = ("2/ω_max", "2/√(2 Σk/m)", "forward Euler", "ω λ_max = 2", "Gauss–Seidel, |z| = 1")
# Not of a method: how far the reference of a map is known, over the accuracy that is asked for.
KNOWN = "error of the reference = accuracy"
# Growth in energy of the fastest mode of a net when the whole net, which starts as noise, has grown enough to count as diverged
# (:data:`warpcloth.run.balance.GAIN`). Measured in runs of 40 to 400 steps it is 7 to 16 times.
GROWTH = 10.0
# Factors z of a step, complex, where sweeps multiply x̃ by q: Euler z² − 2qz + q = 0, midpoint z² − 2(2q − 1)z + 1 = 0, BDF2
# z² = r(4z − 1)/3 with r = q ± √(q² − q).
_STEPS = {
    "euler": lambda q: _roots(q, q),
    "midpoint": lambda q: _roots(2.0 * q - 1.0, 1.0),
    "bdf2": lambda q: np.concatenate([_roots(2.0 * r / 3.0, r / 3.0) for r in _roots(q, q)]),
}
# Smallest real q for which |z| ≤ 1.
_LEAST = {"euler": -1.0 / 3.0, "midpoint": 0.0, "bdf2": -9.0 / 55.0}
# Most springs for which the eigenvalues of a sweep are computed, by a dense solver.
_MOST = 1000


def rules(scene, record, steps):
    """Ratios by name, each above 1 beyond its limit.

    - ``2/ω_max``: h over the largest stable step of symplectic Euler about the rest shape; ``2/√(2 Σk/m)``: over that in
      motion, see :func:`warpcloth.solvers.explicit.step_limits`.
    - ``forward Euler``: the fastest mode grows by 1 + h²ω² a step and has grown by :data:`GROWTH` at the end; no line if
      damping stops it.
    - ``h² = m/(k(L/l − 1))``: hₑ √−λ with λ the least eigenvalue of M⁻¹∂²U/∂x² at the start and hₑ the effective step of the
      integrator, beyond which what a step minimises is not convex (Choi and Ko 2002).
    - ``ω λ_max = 2``: of Jacobi sweeps over springs, averaged or not, see :func:`largest_relaxation`.
    - ``Gauss–Seidel, |z| = 1``: for sweeps in their own order; beyond it energy grows by :data:`GROWTH` in the steps of the
      run, see :func:`largest_ordered`.
    - ``1 + Σk h²/m iterations``: those that projections need across springs, for accelerated ones the root.
    - ``r = 1/(2hω)``: the weight of ADMM divided by the smallest that :func:`warpcloth.solvers.admm.best_weights` gives, that
      of the stiffest element. A larger weight stalls, a smaller one oscillates.
    - ``a ring an iteration``: how many edges lie between pins and the furthest vertex, over the sweeps.

    Args:
        scene: The :class:`warpcloth.Scene` of a cell, of finite stiffness but for sweeps.
        record: The options of the solver.
        steps: Length of the run.
    """
    h, hard = 1.0 / (scene.fps * record.per_frame(scene.fps)), any(np.isinf(t.stiffness).any() for t in scene.terms)
    he = INTEGRATORS[getattr(record, "integrator", "euler")].part * h
    damped = any(getattr(term, "damping", None) is not None for term in scene.terms)
    found = {}
    if isinstance(record, (PBD, XPBD)) and not damped and all(isinstance(term, Spring) for term in scene.terms):
        if record.sweep not in ("coloured", "sequential"):
            found["ω λ_max = 2"] = record.relaxation / largest_relaxation(scene, he, record)
        elif (limit := largest_ordered(scene, he, record, steps)) is not None:
            found["Gauss–Seidel, |z| = 1"] = record.relaxation / limit
    if isinstance(record, (PBD, XPBD)) and len(scene.pins.vertices):
        found["a ring an iteration"] = rings(scene) / record.iterations
    if hard or isinstance(record, (PBD, HierarchicalPBD)):
        return found
    model = scene.build(dtype="float64")
    if isinstance(record, Explicit):
        rest, motion = step_limits(model)
        if record.scheme == "forward":
            return {} if damped else {"forward Euler": steps * np.log1p((2.0 * h / rest) ** 2) / np.log(GROWTH)}
        return {"2/ω_max": h / rest, "2/√(2 Σk/m)": h / motion}
    if isinstance(record, ProjectiveDynamics):
        needed = 1.0 + 2.0 * (he / step_limits(model)[1]) ** 2
        found["1 + Σk h²/m iterations"] = (needed if record.acceleration == "none" else np.sqrt(needed)) / record.iterations
    if isinstance(record, ADMM) and record.weight != "auto":
        found["r = 1/(2hω)"] = record.weight / min(best_weights(model, elements, he).min() for elements in model.terms)
    if isinstance(record, (Newton, ProjectiveDynamics, ADMM, XPBD, ConstrainedDynamics)):
        found["h² = m/(k(L/l − 1))"] = he * np.sqrt(concave_rate(model))
    return found


@in_turn
def concave_rate(model):
    """−λ of the least eigenvalue λ of M⁻¹∂²U/∂x² at the start of one copy [1/s²]; 0 where there is none below 0.

    Of more than 100 vertices to 1e-4 of the sum of a row, which bounds the largest; a cloth that is flat and unstrained has a
    multitude about 0, of which none is then found.
    """
    hessian = Hessian(model, policy=HessianPolicy.RAW)
    hessian.assemble(model.positions, 0.0)
    root = np.repeat(np.sqrt(model.inverse_mass.numpy().astype(np.float64)), 3)
    matrix = hessian.matrix().multiply(root[:, None]).multiply(root).tocsr()
    if matrix.shape[0] <= 300:
        return max(0.0, -float(np.linalg.eigvalsh(matrix.toarray())[0]))
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import ArpackNoConvergence, eigsh

    # Errors are relative to what is looked for, so that the least is looked for as the largest of bound − λ.
    bound, start = float(abs(matrix).sum(axis=1).max()), np.random.default_rng(0).normal(size=matrix.shape[0])
    turned = bound * eye_array(matrix.shape[0], format="csr") - matrix
    try:
        found = eigsh(turned, k=1, which="LA", v0=start, tol=1e-4, ncv=60, maxiter=20, return_eigenvectors=False)
    except ArpackNoConvergence:
        return 0.0
    return max(0.0, float(found[0]) - bound)


def largest_relaxation(scene, he, record):
    """The largest stable relaxation ω of Jacobi sweeps over springs about the rest shape.

    A sweep multiplies what is wrong by 1 − ωλ, λ the eigenvalues of C(D + α̃)⁻¹JVWJᵀ, D the diagonal of JWJᵀ, α̃ = 1/(khₑ²) and
    C and V what constraints and vertices are averaged by; of XPBD, whose multipliers count, C(D + α̃)⁻¹(JWJᵀ + α̃). It settles
    iff ωλ_max < 2. Velocities are differences of places, so that what n sweeps multiply x̃ by, q = 1 − ρ(1 − (1 − ωλ)ⁿ) with ρ
    the part of JWJᵀ in λ, must be below 1, and above :data:`_LEAST`: of an even n that is the same, of an odd one
    (ωλ_max − 1)ⁿ < (1 − q_min)/ρ − 1.

    Args:
        scene: Of springs alone, without damping.
        he: Effective step hₑ [s].
        record: :class:`warpcloth.PBD` or :class:`warpcloth.XPBD` with a Jacobi sweep.
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
    # Of the first sweep λ is 0 before it.
    largest, v = _largest(moved + diags_array(factor * compliance) if isinstance(record, XPBD) and n > 1 else moved)
    part = float(v @ (moved @ v)) / largest
    least = _LEAST[getattr(record, "integrator", "euler")]
    return float(1.0 + (((1.0 - least) / part - 1.0) ** (1.0 / n) if n % 2 else 1.0)) / largest


def largest_ordered(scene, he, record, steps):
    """Finds the largest relaxation ω at which Gauss–Seidel sweeps over springs, about the rest shape, are stable for a run.

    A sweep solves (D/ω + L)Δλ = −(Jx̃ + Aλ). A is JWJᵀ + α̃ for XPBD and JWJᵀ for PBD, D is the diagonal of JWJᵀ + α̃,
    α̃ = 1/(khₑ²), and L is the part of JWJᵀ that comes before an element in the order of the sweep; x = x̃ + WJᵀλ. The matrix by
    which n sweeps multiply x̃ has complex eigenvalues q, because the order makes it unsymmetric. Steps multiply by z, see
    :data:`_STEPS`. A run is stable while no |z| makes the energy grow by :data:`GROWTH` in all steps. In a net of structural
    springs the smallest q is (1 − ω)ⁿ, which is −1/3 for ω = 1 + 3^(−1/n); with more springs complex q grow before that.

    Args:
        scene: A scene of springs alone, without damping.
        he: Effective step hₑ [s].
        record: :class:`warpcloth.PBD` or :class:`warpcloth.XPBD` with a Gauss–Seidel sweep.
        steps: Number of steps of the run.

    Returns:
        float: ω; None if twice 1 + 3^(−1/n) is still stable, if no spring moves anything, or for more than :data:`_MOST`
            springs, which take too long.
    """
    pairs, mobility, compliance = _springs(scene, he, _turns(scene, record))
    if not 0 < len(pairs) <= _MOST:
        return None
    J = (_directions(scene, pairs) * np.repeat(np.sqrt(_inverse_masses(scene)), 3)).toarray()
    share = _share(mobility, compliance, record)
    kept = compliance if isinstance(record, XPBD) else np.zeros_like(compliance)
    integrator = getattr(record, "integrator", "euler")
    to_and_fro = integrator == "midpoint"
    return _largest_ordered(
        J.tobytes(), len(pairs), (mobility / share).tobytes(), kept.tobytes(), record.iterations, integrator, to_and_fro, steps
    )


@lru_cache(256)  # cells that differ in relaxation share a limit, and so do those of a hard net at all steps
def _largest_ordered(J, count, diagonal, compliance, n, integrator, to_and_fro, steps):
    """Implements :func:`largest_ordered` with JW^½ (E, 3N), D (E,) and α̃ (E,), each as bytes."""
    from scipy.linalg import solve_triangular

    J, diagonal, compliance = np.frombuffer(J).reshape(count, -1), np.frombuffer(diagonal), np.frombuffer(compliance)
    A, B = J @ J.T + np.diag(compliance), J @ _range(J)
    before, after = np.tril(J @ J.T, -1), np.triu(J @ J.T, 1)

    def grows(omega):
        moves = np.zeros_like(B)
        for sweep in range(n):
            back = to_and_fro and sweep % 2
            factor = np.diag(diagonal / omega) + (after if back else before)
            moves -= solve_triangular(factor, B + A @ moves, lower=not back, check_finite=False)
        q = np.linalg.eigvals(np.eye(B.shape[1]) + B.T @ moves).astype(complex)
        return abs(_STEPS[integrator](q)).max() > GROWTH ** (0.5 / steps)

    # Beyond the first unstable ω there may be stable ones again.
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
    """Returns an orthonormal basis of the range of Jᵀ (3N, rank), the moves that change the length of springs."""
    _, values, vectors = np.linalg.svd(J, full_matrices=False)
    return vectors[values > 1e-9 * values[0]].T


def _roots(half, product):
    """Solves z² − 2·half·z + product = 0 for both z, complex."""
    root = np.sqrt(half * half - product + 0j)
    return np.stack([half + root, half - root])


def _share(mobility, compliance, record):
    """What a sweep takes of what is wrong with a constraint by itself, without ω."""
    if getattr(record, "stiffness", None) == "per-step":
        return 1.0 - (compliance / (mobility + compliance)) ** (1.0 / record.iterations)
    return mobility / (mobility + compliance)


def _inverse_masses(scene):
    inverse = 1.0 / scene.vertex_masses
    inverse[scene.pins.vertices] = 0.0
    return inverse


def _largest(matrix):
    """The largest eigenvalue of a symmetric matrix, and its vector."""
    if matrix.shape[0] <= 300:
        values, vectors = np.linalg.eigh(matrix.toarray())
    else:
        from scipy.sparse.linalg import eigsh

        values, vectors = eigsh(matrix, k=1, which="LA", v0=np.ones(matrix.shape[0]), tol=1e-4)
    return values[-1], vectors[:, -1]


def rings(scene):
    """The most edges on the shortest way from a pin to a vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    n, (a, b) = len(scene.mesh.points), scene.mesh.edges.T
    edges = coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    ways = dijkstra(edges, directed=False, unweighted=True, indices=scene.pins.vertices, min_only=True)
    return int(ways[np.isfinite(ways)].max())
