"""Classes of random 3×3 matrices, and how far a decomposition of them is from what it should be."""

import numpy as np
from scipy.sparse import bsr_array


def rotations(rng, n):
    """Uniformly random rotations (n, 3, 3), from unit quaternions."""
    q = rng.normal(size=(n, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)]
    rows += [2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def half_turns(rng, n):
    """Rotations by 180° (n, 3, 3)."""
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


def with_values(rng, *values):
    """U diag(S) Vᵀ with random rotations; values (n,) or numbers."""
    S = np.stack(np.broadcast_arrays(*values), axis=-1)
    return np.einsum("nij,nj,nkj->nik", rotations(rng, len(S)), S, rotations(rng, len(S)))


def powers(rng, n, low, high=0.0):
    """10 to evenly random powers (n,)."""
    return 10.0 ** rng.uniform(low, high, n)


# Each takes a generator and a number, and gives that many matrices in float64.
CLASSES = {
    "Gaussian": lambda rng, n: rng.normal(size=(n, 3, 3)),
    "rotation × near identity": lambda rng, n: (
        rotations(rng, n) @ (np.eye(3) + powers(rng, n, -9, -1)[:, None, None] * rng.normal(size=(n, 3, 3)))
    ),
    "condition 1e3": lambda rng, n: with_values(rng, np.ones(n), powers(rng, n, -3), 1e-3),
    "condition 1e6": lambda rng, n: with_values(rng, np.ones(n), powers(rng, n, -6), 1e-6),
    "rank 2": lambda rng, n: with_values(rng, np.ones(n), powers(rng, n, -3), 0.0),
    "rank 1": lambda rng, n: rng.normal(size=(n, 3, 1)) * rng.normal(size=(n, 1, 3)),
    "reflection": lambda rng, n: with_values(rng, np.ones(n), rng.uniform(0, 1, n), -rng.uniform(0, 1, n)),
    "reflection, small gap": lambda rng, n: with_values(rng, 1.0, *_nearly_equal(rng, n)),
    "repeated σ₁ = σ₂": lambda rng, n: with_values(rng, np.ones(n), 1.0, rng.uniform(-1, 1, n)),
    "repeated ±σ₂ = σ₃": lambda rng, n: with_values(rng, np.ones(n), *_equal(rng, n)),
    "rotation": rotations,
    "half turn": half_turns,
    "reflected rotation": lambda rng, n: -rotations(rng, n),
    "nearly −e₀e₀ᵀ": lambda rng, n: _turned_round(rng, n),
    "small integers": lambda rng, n: rng.integers(-2, 3, size=(n, 3, 3)).astype(np.float64),
    "zero": lambda rng, n: np.zeros((n, 3, 3)),
}


def _turned_round(rng, n):
    """Matrices that turn the first axis round with parts far below rounding; squares underflow in either precision."""
    A = rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-45, -6, size=(n, 3, 3))
    A[::2] = np.sign(A[::2]) * np.abs(A[::2]) ** 3.5
    A[:, 0, 0] = -1.0
    return A


def _equal(rng, n):
    value = rng.uniform(0, 1, n)
    return value, value * rng.choice([-1.0, 1.0], n)


def _nearly_equal(rng, n):
    value = powers(rng, n, -3)
    return value, value * (powers(rng, n, -8) - 1.0)


def samples(name, rng, n, dtype):
    """Matrices of a class (n, 3, 3), every second one scaled by 1e-12 to 1e12."""
    A = CLASSES[name](rng, n)
    A[::2] *= powers(rng, len(A[::2]), -12, 12)[:, None, None]
    return A.astype(dtype)


def reference(A):
    """The nearest rotations to A (n, 3, 3), and its singular values, the last with the sign of det A.

    Of float64 matrices LAPACK's rotations are wrong by some 50 ε, so that those are improved by Newton's method on the
    rotations, R ← R exp(ω) with (tr M − M) ω = axial M, M = RᵀA, in extended precision.
    """
    U, S, Vt = np.linalg.svd(A.astype(np.float64))
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    U[:, :, 2] *= sign[:, None]
    S[:, 2] *= sign
    R = U @ Vt
    if A.dtype == np.float64:
        largest = np.where(S[:, 0] > 0, S[:, 0], 1)[:, None, None]
        A, R = (A / largest).astype(np.longdouble), R.astype(np.longdouble)
        for _ in range(2):
            R = _product(R, 3 * np.eye(3) - _product(R.mT, R)) / 2
            M = _product(R.mT, A)
            axial = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=1)
            system = np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3) - (M + M.mT) / 2
            w = (np.linalg.pinv(system.astype(np.float64), hermitian=True) @ axial.astype(np.float64)[:, :, None])[:, :, 0]
            w[np.linalg.norm(w, axis=1) > 1e-6] = 0.0  # not determined
            turn = np.zeros_like(R)
            for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
                turn[:, row, column], turn[:, column, row] = w[:, axis], -w[:, axis]
            R = R + _product(R, turn + _product(turn, turn) / 2)
    return R, S


def _product(A, B):
    """A B in extended precision, which matmul does by a slow loop."""
    return np.einsum("nij,njk->nik", A, B, optimize=False)


def angle(R, Q):
    """The angle between rotations (n, 3, 3) [rad], without cancellation."""
    chord = np.linalg.norm((R - Q).astype(np.float64), axis=(1, 2)) / np.sqrt(8.0)
    return 2.0 * np.arcsin(np.minimum(chord, 1.0))


def orthogonality(Q):
    """Largest ‖QᵀQ − I‖ (Frobenius)."""
    Q = Q.astype(np.float64)
    return float(np.linalg.norm(Q.mT @ Q - np.eye(Q.shape[-1]), axis=(1, 2)).max(initial=0.0))


def determinant(Q, wanted):
    """Largest |det Q − wanted|."""
    return float(np.abs(np.linalg.det(Q.astype(np.float64)) - wanted).max(initial=0.0))


def reconstruction(A, *factors):
    """Largest ‖A − product of the factors‖/‖A‖ (Frobenius)."""
    A, product = A.astype(np.float64), factors[0].astype(np.float64)
    for factor in factors[1:]:
        product = product @ factor.astype(np.float64)
    norm = np.linalg.norm(A, axis=(1, 2))
    return float((np.linalg.norm(product - A, axis=(1, 2)) / np.where(norm > 0, norm, 1)).max(initial=0.0))


def times(U, S):
    """U diag(S) in float64."""
    return U.astype(np.float64) * S.astype(np.float64)[:, None, :]


def block_matrix(matrix):
    """The dense matrix of 3 × 3 blocks on the device, by its offsets, columns and values."""
    offsets = matrix.offsets.numpy()
    columns, values = (each.numpy()[: offsets[-1]] for each in (matrix.columns, matrix.values))
    return bsr_array((values, columns, offsets), shape=(3 * len(offsets) - 3,) * 2).toarray()
