"""Where methods fail by theory: of a scene and a solver, numbers that are above 1 beyond the limit."""

import numpy as np

from ..kernels.term import HessianPolicy
from ..operators import Hessian
from ..solvers import ADMM, PBD, XPBD, ConstrainedDynamics, Explicit, HierarchicalPBD, Newton, ProjectiveDynamics
from ..solvers.explicit import step_limits
from ..terms import Spring

# Beyond these a run diverges; beyond the others it is wrong, or need not be.
DIVERGES = ("2/ω_max", "2/√(2 Σk/m)", "forward Euler", "ω λ_max = 2", "ω = 1 + 3^(−1/n)")
# Not of a method: how far the reference of a map is known, over the accuracy that is asked for.
KNOWN = "error of the reference = accuracy"
# What a run must gain in energy to count as diverged.
GROWTH = 100.0


def rules(scene, record, steps):
    """Ratios by name, each above 1 beyond its limit.

    - ``2/ω_max``: h over the largest stable step of symplectic Euler about the rest shape; ``2/√(2 Σk/m)``: over that in
      motion, see :func:`warpcloth.solvers.explicit.step_limits`.
    - ``forward Euler``: by 1 + h²ω² a step its energy has grown by :data:`GROWTH` at the end.
    - ``h² = m/(k(L/l − 1))``: h √−λ with λ the least eigenvalue of M⁻¹∂²U/∂x² at the start, beyond which what a step minimises
      is not convex (Choi and Ko 2002).
    - ``ω λ_max = 2``: of Jacobi sweeps over springs, averaged or not, see :func:`largest_relaxation`.
    - ``ω = 1 + 3^(−1/n)``: of n Gauss–Seidel sweeps a step, which multiply what is wrong by (1 − ω)ⁿ in a net of structural
      springs; with more springs, and in one order for all, less may do.
    - ``1 + Σk h²/m iterations``: those that projections need across springs, for accelerated ones the root.
    - ``a ring an iteration``: how many edges lie between pins and the furthest vertex, over the sweeps.

    Args:
        scene: The :class:`warpcloth.Scene` of a cell, of finite stiffness but for sweeps.
        record: The options of the solver.
        steps: Length of the run.
    """
    h, hard = 1.0 / (scene.fps * record.per_frame(scene.fps)), any(np.isinf(t.stiffness).any() for t in scene.terms)
    found = {}
    if isinstance(record, (PBD, XPBD)):
        if record.sweep in ("coloured", "sequential"):
            found["ω = 1 + 3^(−1/n)"] = record.relaxation / (1.0 + 3.0 ** (-1.0 / record.iterations))
        elif all(isinstance(term, Spring) for term in scene.terms):
            found["ω λ_max = 2"] = record.relaxation / largest_relaxation(scene, h, record)
    if isinstance(record, (PBD, XPBD)) and len(scene.pins.vertices):
        found["a ring an iteration"] = rings(scene) / record.iterations
    if hard or isinstance(record, (PBD, HierarchicalPBD)):
        return found
    model = scene.build(dtype="float64")
    if isinstance(record, Explicit):
        rest, motion = step_limits(model)
        if record.scheme == "forward":
            return {"forward Euler": steps * np.log1p((2.0 * h / rest) ** 2) / np.log(GROWTH)}
        return {"2/ω_max": h / rest, "2/√(2 Σk/m)": h / motion}
    if isinstance(record, ProjectiveDynamics):
        needed = 1.0 + 2.0 * (h / step_limits(model)[1]) ** 2
        found["1 + Σk h²/m iterations"] = (needed if record.acceleration == "none" else np.sqrt(needed)) / record.iterations
    if isinstance(record, (Newton, ProjectiveDynamics, ADMM, XPBD, ConstrainedDynamics)):
        found["h² = m/(k(L/l − 1))"] = h * np.sqrt(concave_rate(model))
    return found


def concave_rate(model):
    """−λ of the least eigenvalue λ of M⁻¹∂²U/∂x² at the start of one copy [1/s²]; 0 where there is none below 0."""
    hessian = Hessian(model, policy=HessianPolicy.RAW)
    hessian.assemble(model.positions, 0.0)
    root = np.repeat(np.sqrt(model.inverse_mass.numpy().astype(np.float64)), 3)
    matrix = hessian.matrix().multiply(root[:, None]).multiply(root).tocsr()
    if matrix.shape[0] <= 300:
        return max(0.0, -float(np.linalg.eigvalsh(matrix.toarray())[0]))
    from scipy.sparse.linalg import eigsh

    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    return max(0.0, -float(eigsh(matrix, k=1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0]))


def largest_relaxation(scene, h, record):
    """The largest stable relaxation ω of Jacobi sweeps over springs about the rest shape.

    A sweep multiplies what is wrong by 1 − ωλ, λ the eigenvalues of C(D + α̃)⁻¹JVWJᵀ, D the diagonal of JWJᵀ, α̃ = 1/(kh²) and
    C and V what constraints and vertices are averaged by; it settles iff ωλ_max < 2. Velocities are differences of places,
    hence from step to step x ← q(2x − x_before) with q = (1 − ωλ)ⁿ of n sweeps: stable for −1/3 < q < 1, which of an even n is
    the same, and of an odd one ωλ_max < 1 + 3^(−1/n).

    Args:
        scene: Of springs alone.
        h: Step [s].
        record: :class:`warpcloth.PBD` or :class:`warpcloth.XPBD` with a Jacobi sweep.
    """
    from scipy.sparse import csr_array, diags

    points = scene.mesh.points
    pairs = np.concatenate([term.stencil(scene.mesh) for term in scene.terms])
    stiffness = np.concatenate([np.broadcast_to(term.stiffness, len(term.stencil(scene.mesh))) for term in scene.terms])
    directions = points[pairs[:, 1]] - points[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    columns = (3 * pairs[:, :, None] + np.arange(3)).ravel()
    values = np.stack([-directions, directions], axis=1).ravel()
    J = csr_array((values, columns, np.arange(len(pairs) + 1) * 6), shape=(len(pairs), points.size))
    inverse = 1.0 / scene.vertex_masses
    inverse[scene.pins.vertices] = 0.0
    with np.errstate(divide="ignore"):
        factor = 1.0 / (inverse[pairs].sum(axis=1) + 1.0 / (stiffness * h**2))
    counts = np.bincount(pairs.ravel(), minlength=len(points)).astype(float)
    if record.sweep == "constraint-averaged":
        counts[inverse == 0.0] = 1.0
        factor /= counts[pairs].max(axis=1)
    elif record.sweep == "vertex-averaged":
        inverse /= np.maximum(counts + record.alpha, 1.0)
    J = (diags(np.sqrt(factor)) @ J @ diags(np.repeat(np.sqrt(inverse), 3))).tocsr()
    n = record.iterations
    return float((1.0 + 3.0 ** (-1.0 / n) if n % 2 else 2.0) / _largest(J @ J.T))


def _largest(matrix):
    if matrix.shape[0] <= 300:
        return np.linalg.eigvalsh(matrix.toarray())[-1]
    from scipy.sparse.linalg import eigsh

    return eigsh(matrix, k=1, which="LA", v0=np.ones(matrix.shape[0]), tol=1e-4, return_eigenvectors=False)[0]


def rings(scene):
    """The most edges on the shortest way from a pin to a vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    n, (a, b) = len(scene.mesh.points), scene.mesh.edges.T
    edges = coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    ways = dijkstra(edges, directed=False, unweighted=True, indices=scene.pins.vertices, min_only=True)
    return int(ways[np.isfinite(ways)].max())
