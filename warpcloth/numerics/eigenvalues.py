"""The largest eigenvalue of the Hessian of a model over its masses, which limits explicit steps."""

import numpy as np
import warp as wp

from ..core.hessian import Hessian

DENSE = 30  # most rows of a matrix whose eigenvalues are all computed
# From this number of rows on, a matrix is only multiplied, on the device of the model.
LARGE = 50_000
STEPS = 20  # of Lanczos iterations between estimates, as many as ARPACK takes before it starts again


def over_mass(model, terms, x):
    """Returns M^-½ A M^-½ of a model of one copy, A = ∂²U/∂x² of ``terms`` at x, as a scipy matrix or operator (3n, 3n) [1/s²].

    Its row and column are 0 for coordinates that do not move.
    """
    from scipy.sparse import diags

    hessian = Hessian(model, terms=terms)
    hessian.assemble(x, 0.0)
    root = np.sqrt(model.coordinate_mobility())
    if len(root) < LARGE:
        return (diags(root) @ hessian.matrix() @ diags(root)).tocsr()
    return _operator(hessian, root)


def _operator(hessian, root):
    """Returns R A R as a scipy operator, with R = diag(``root``). Products A p are computed on the device, in its precision."""
    from scipy.sparse.linalg import LinearOperator

    model = hessian.model
    p, q, active = model.vectors(), model.vectors(), wp.full(1, 1, dtype=wp.int32, device=model.device)
    hessian.prepare()
    scale = root.max(initial=0.0) or 1.0  # so that products do not overflow
    root = root / scale

    def product(v):
        p.assign((root * v.ravel()).reshape(-1, 3))
        hessian.multiply(p, q, active)
        return scale**2 * (root * q.numpy().ravel().astype(np.float64))

    return LinearOperator((len(root),) * 2, matvec=product, rmatvec=product, dtype=np.float64)


def largest(matrix):
    """Returns the largest eigenvalue of a positive semi-definite matrix of :func:`over_mass`, and a function for its vector.

    The residual, about as large as the error, is added, so that no unstable step passes.

    Raises:
        ValueError: A large matrix is not finite.
    """
    from scipy.sparse.linalg import eigsh

    size = matrix.shape[0]
    start = np.random.default_rng(0).normal(size=size)
    # The upper eigenvalues of a large net are close together: 1e-2 gives a value 0.4 % too small.
    if size >= LARGE:
        return _lanczos(matrix, start, 1e-2)
    if size <= DENSE:
        values, vectors = np.linalg.eigh(matrix.toarray())
        return float(values[-1]), lambda: vectors[:, -1]
    if not matrix.count_nonzero():
        return 0.0, lambda: start
    values, vectors = eigsh(matrix, k=1, which="LA", v0=start, tol=1e-4)
    u = vectors[:, 0]
    return float(values[0] + np.linalg.norm(matrix @ u - values[0] * u)), lambda: u


def _lanczos(matrix, start, tolerance):
    """Returns the largest eigenvalue λ, plus its residual of at most λ·``tolerance``, and a function for its vector.

    The iteration is that of Lanczos (1950). Vectors are not orthogonalised again. The rounding that this leaves repeats
    eigenvalues that have converged, but moves none (Paige 1980, *Accuracy and effectiveness of the Lanczos algorithm for the
    symmetric eigenproblem*).
    """
    diagonal, side = [], []
    for _v, a, b in _krylov(matrix, start):
        if not np.isfinite(a + b):
            raise ValueError("the stiffness of the cloth at rest is not finite, so no step is stable")
        diagonal.append(a)
        side.append(b)
        if b == 0.0 or len(side) % STEPS == 0:
            values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(side[:-1], 1) + np.diag(side[:-1], -1))
            residual = b * abs(vectors[-1, -1])
            if residual <= tolerance * values[-1]:
                break

    def vector():  # iterates again instead of storing all vectors
        return sum(weight * v for weight, (v, _a, _b) in zip(vectors[:, -1], _krylov(matrix, start), strict=False))

    return float(values[-1] + residual), vector


def _krylov(matrix, start):
    """Yields the vectors of a Lanczos iteration, with the entries of the tridiagonal matrix on and beside its diagonal."""
    v, before, b = start / np.linalg.norm(start), 0.0, 0.0
    while True:
        w = matrix @ v - b * before
        a = float(w @ v)
        w -= a * v
        b = float(np.linalg.norm(w))
        yield v, a, b
        v, before = w / b, v
