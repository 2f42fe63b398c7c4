"""Why projective dynamics converges as it does: the spectrum of the true Hessian relative to its matrix, and errors beside it.

Near the minimiser an iteration d ← d − A⁻¹∇φ(d) takes the error e to (1 − A⁻¹H)e, H the Hessian of φ there and A the constant
matrix. With the eigenvectors v of Hv = μAv each part of e shrinks by its own 1 − μ an iteration, the slowest by
max |1 − μ|, in the norm ‖e‖²_A = eᵀAe; as A takes projections as fixed, H ≤ A and 0 ≤ 1 − μ (Liu et al. 2017, *Quasi-Newton
methods for real-time simulation of hyperelastic materials*, for its view as a descent). With colliders A includes the
semi-definite Hessian of contact at the minimiser, as that of the iterations does near it.
"""

import time

import numpy as np

from ..core.constant_matrix import constant_matrices
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from ..solvers import ProjectiveDynamics
from .convergence import LADDER, one_step

# Unknowns of which the spectrum is found, by a dense matrix.
MOST = 2000
# Of the error at x̃, between which iterations are linear and resolved: what comes later is predicted from the first below.
LINEAR, RESOLVED = 1e-2, 1e-8


def relative_spectrum(step):
    """μ and v of Hv = μAv at the minimiser of a step, VᵀAV = 1.

    Args:
        step: The :class:`warpcloth.lab.convergence.OneStep`.

    Returns:
        tuple: (μ (f,) from small to large, V (f, f), A (f, f)), f the coordinates of the free vertices, x, y and z of each.

    Raises:
        ValueError: There are too many, or a term is none of projective dynamics.
    """
    from scipy.linalg import eigh

    unknowns = np.flatnonzero(np.repeat(step.free, 3))
    if len(unknowns) > MOST:
        raise ValueError(f"{step.scene.name} has {len(unknowns)} unknowns; a spectrum takes {MOST} at most, of a coarser mesh")
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
    """Errors of plain projective dynamics after more and more iterations of one step, and what the spectrum makes of them.

    Args:
        scene: :class:`SceneRef` as a dictionary.
        digest: Of the scene, as of :func:`warpcloth.lab.convergence.measure`.
        frame: Frames before the step.
        substeps: Steps a frame.
        device: A Warp device.
        limit: Seconds for the iterations.

    Returns:
        dict: ``status`` ("ok" or "refused", also where the scene has no such step), ``reason``, ``eigenvalues`` μ,
        ``contraction`` max |1 − μ|, ``points`` with ``iterations``, ``error`` ‖d − d*‖_A over that at x̃, and ``predicted``,
        the same from the first error that is small on, else None; ``floor``, the largest error that roundings of x alone make;
        and ``measured`` and ``expected``, the factor of an
        iteration between the last two points, of errors and of predictions.

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
    weights = A @ V  # of an error to its parts
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
