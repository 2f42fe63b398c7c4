"""Explains the convergence of projective dynamics by the spectrum of the true Hessian relative to its constant matrix.

Near the minimiser, an iteration d ← d − A⁻¹∇φ(d) maps the error e to (1 − A⁻¹H)e, with the Hessian H of φ and the constant
matrix A. Each component of e along an eigenvector v of Hv = μAv is multiplied by 1 − μ, so that ‖e‖²_A = eᵀAe shrinks at worst
by max |1 − μ| per iteration. As A takes projections as fixed, H ≤ A and 0 ≤ 1 − μ (Liu et al. 2017, *Quasi-Newton methods for
real-time simulation of hyperelastic materials*). With colliders, A includes the semi-definite Hessian of contact at the
minimiser, as in the iterations.
"""

import time

import numpy as np

from ..base.turns import in_turn
from ..core.constant_matrix import constant_matrices
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from ..solvers import ProjectiveDynamics
from .convergence import LADDER, one_step

# Largest number of unknowns for the spectrum, which uses dense matrices.
MAX_UNKNOWNS = 2000
# Range of errors, relative to that at x̃, in which iterations are linear and resolved. Predictions start at the first error
# below LINEAR.
LINEAR, RESOLVED = 1e-2, 1e-8


@in_turn
def relative_spectrum(step):
    """Returns μ (f,) ascending, V (f, f) and A (f, f) of Hv = μAv at the minimiser of a step, VᵀAV = 1, for f free coordinates.

    Raises:
        ValueError: There are too many unknowns, or projective dynamics does not take a term.
    """
    from scipy.linalg import eigh

    unknowns = np.flatnonzero(np.repeat(step.free, 3))
    if len(unknowns) > MAX_UNKNOWNS:
        raise ValueError(
            f"{step.scene.name} has {len(unknowns)} unknowns; a spectrum takes at most {MAX_UNKNOWNS}; take a coarser mesh"
        )
    model, s = step.model, 1.0 / step.h**2
    touching = [elements for elements in model.terms if elements.collider is not None]
    (scalar,) = constant_matrices(model.with_terms([each for each in model.terms if each.collider is None]), s)
    best = model.array(step.best, model.vec3)
    hessian = Hessian(model, HessianPolicy.RAW, corrected=True)
    hessian.assemble(step.base, s, best)
    both = [hessian.matrix().toarray(), np.kron(scalar.toarray(), np.eye(3))]
    if touching:
        contact = Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=touching)
        contact.assemble(step.base, 0.0, best)
        both[1] += contact.matrix().toarray()
    H, A = (matrix[np.ix_(unknowns, unknowns)] for matrix in both)
    mu, V = eigh(H, A)
    return mu, V, A


def measure(scene, digest, frame, substeps, device="cpu", limit=20.0):
    """Measures errors of plain projective dynamics after increasing iterations of one step, and predicts them.

    Arguments and results are JSON values, as for :func:`warpcloth.lab.convergence.measure`.

    Returns:
        dict: ``status`` ("ok", or "refused", also if the scene has no such step), ``reason``, ``eigenvalues`` μ,
        ``contraction`` max |1 − μ|, ``points`` with ``iterations``, ``error`` ‖d − d*‖_A over that at x̃, and ``predicted``,
        the error predicted from the first small one, or None; ``floor``, the largest error by rounding of x alone; and
        ``measured`` and ``expected``, the factor per iteration between the last two points, of errors and of predictions.

    Raises:
        ValueError: See :func:`relative_spectrum`.
    """
    result = {"status": "ok", "reason": "", "points": [], "floor": None, "measured": None, "expected": None}
    try:
        step = one_step(scene, digest, frame, substeps, device)
        _bound(step, 1, device)
    except ValueError as error:
        return result | {"status": "refused", "reason": str(error)}
    mu, V, A = relative_spectrum(step)
    result |= {"eigenvalues": mu.tolist(), "contraction": float(np.abs(1.0 - mu).max())}
    weights = A @ V  # maps an error to its components
    unknowns = np.repeat(step.free, 3)
    first = np.linalg.norm(step.best.ravel()[unknowns] @ weights)
    result["floor"] = max(float(np.linalg.norm(move.ravel()[unknowns] @ weights) / first) for move in step.roundings())
    parts, since, began = None, 0, time.perf_counter()
    for iterations in LADDER:
        stepper = _bound(step, iterations, device)
        step.set_state(stepper)
        stepper.step()
        found = (step.correction(stepper) - step.best).ravel()[unknowns] @ weights
        error = float(np.linalg.norm(found) / first)
        if parts is None and error < LINEAR:
            parts, since = found, iterations
        predicted = None if parts is None else float(np.linalg.norm(parts * (1.0 - mu) ** (iterations - since)) / first)
        result["points"].append({"iterations": iterations, "error": error, "predicted": predicted})
        if error < RESOLVED or 2.0 * (time.perf_counter() - began) > limit:
            break
    known = [point for point in result["points"] if point["predicted"] is not None and point["error"] > RESOLVED]
    if len(known) > 1:
        before, last = known[-2:]
        power = 1.0 / (last["iterations"] - before["iterations"])
        result |= {name: (last[of] / before[of]) ** power for name, of in (("measured", "error"), ("expected", "predicted"))}
    return result


def _bound(step, iterations, device):
    record = ProjectiveDynamics(substeps=step.substeps, iterations=iterations, tolerance=1e-14, acceleration="none")
    return record.bind(step.scene.build(device=device, dtype="float64"))
