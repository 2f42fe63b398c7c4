"""Accelerations of the iteration d ← d − A⁻¹∇φ(d): Chebyshev, Anderson and L-BFGS.

Each proposes d − c₀w + Σⱼ(aⱼsⱼ + bⱼzⱼ) with w = A⁻¹∇φ. The coefficients follow from dot products of the last m steps sⱼ,
changes yⱼ of ∇φ and zⱼ = A⁻¹yⱼ. All arrays here are on the host, in double precision, with a row for each copy.
"""

import numpy as np


class Plain:
    """No acceleration, d − w.

    Args:
        copies: B.
    """

    def __init__(self, copies):
        self.window, self._copies = 1, copies

    def start(self):
        """Before the first iteration of a step."""

    def propose(self, iteration, products, accepted):
        """As :meth:`Chebyshev.propose`."""
        return np.tile([1.0, 0.0, 0.0], (self._copies, 1))


class Chebyshev:
    """The Chebyshev semi-iterative method (Wang 2015): d ← ω(d − w − d₋₁) + d₋₁ with ω → 2/(1 + √(1 − ρ²)).

    ω is 1 in the first ten iterations, then 2/(2 − ρ²), then 4/(4 − ρ²ω). If a proposal is rejected, ω of that copy starts
    again from 1, without the ten iterations.

    Args:
        copies: B.
        rho: ρ in [0, 1), the assumed factor by which a plain iteration multiplies the error, one or (B,).
    """

    DELAY = 10

    def __init__(self, copies, rho):
        self.window, self.rho2 = 1, rho**2
        self.omega, self.count = np.ones(copies), np.zeros(copies, dtype=int)

    def start(self):
        """Before the first iteration of a step."""
        self.omega[:], self.count[:] = 1.0, 0

    def propose(self, iteration, products, accepted):
        """Returns the coefficients (c₀, a, b), (B, 1 + 2m).

        Args:
            iteration: Index of the iteration in the step, from 0.
            products: sⱼ·∇φ, zⱼ·∇φ, sⱼ·y and zⱼ·y with the latest y, (B, 4, m).
            accepted: Which copies accepted the last proposal, (B,).
        """
        self.count = np.where(accepted, self.count + 1, self.DELAY)
        later = np.where(self.omega > 1.0, 4.0 / (4.0 - self.rho2 * self.omega), 2.0 / (2.0 - self.rho2))
        self.omega = np.where(self.count > self.DELAY, later, 1.0)
        return np.stack([self.omega, self.omega - 1.0, np.zeros_like(self.omega)], axis=1)


def _dot(a, b):
    """Returns Σⱼ aⱼbⱼ of each copy, from (B, m) both, added in a fixed order, so that the result does not depend on B."""
    total = np.zeros(len(a))
    for j in range(a.shape[1]):
        total = total + a[:, j] * b[:, j]
    return total


def _times(A, b):
    """Returns A b of each copy, from (B, m, m) and (B, m), as :func:`_dot`."""
    total = np.zeros(A.shape[:2])
    for j in range(A.shape[2]):
        total = total + A[:, :, j] * b[:, j, None]
    return total


class _History:
    """The dot products of the last m steps: sᵢ·yⱼ for j no older than i, and zᵢ·yⱼ = yᵢᵀA⁻¹yⱼ for all.

    Every PLAIN iterations there is a plain step. With accelerated steps alone, Anderson acceleration and L-BFGS of a few steps
    often settle into slow convergence, from which a plain step frees them: in a step of ``hanging`` of 32 × 32 vertices and
    1/240 s, Anderson acceleration takes 1378 iterations to a residual of 1e-5 without plain steps, 356 with them (float64,
    medians of 7 states; 345 with one every 12). Pratapa, Suryanarayana and Pask (2016) mix both for linear systems.

    Args:
        copies: B.
        window: m.
        epsilon: Relative rounding of the products.
    """

    PLAIN = 24

    def __init__(self, copies, window, epsilon):
        self.window, self.epsilon = window, epsilon
        self.sy, self.zy = (np.zeros((copies, window, window)) for _ in range(2))

    def start(self):
        """Before the first iteration of a step."""

    def propose(self, iteration, products, accepted):
        """As :meth:`Chebyshev.propose`."""
        B, _, m = products.shape
        proposal = np.zeros((B, 1 + 2 * m))
        proposal[:, 0] = 1.0
        if iteration == 0:
            return proposal
        newest = iteration % m
        self.sy[:, :, newest] = products[:, 2]
        self.zy[:, :, newest] = self.zy[:, newest] = products[:, 3]
        if iteration % self.PLAIN == 0:
            return proposal
        slots = [(newest - age) % m for age in range(min(iteration, m))]
        with np.errstate(all="ignore"):  # a copy may be NaN or infinite
            a, b = self._coefficients(slots, products[:, 0, slots], products[:, 1, slots])
        good = (np.isfinite(a) & np.isfinite(b)).all(axis=1)[:, None]
        proposal[:, [1 + j for j in slots]] = np.where(good, a, 0.0)
        proposal[:, [1 + m + j for j in slots]] = np.where(good, b, 0.0)
        return proposal

    def _coefficients(self, slots, s, z):
        """Returns a and b (B, pairs) of the pairs in ``slots``, newest first, from their products s and z with ∇φ."""
        raise NotImplementedError  # every method has its own


class Anderson(_History):
    """Anderson acceleration (Peng et al. 2018): d − w − Σθⱼ(sⱼ − zⱼ) with the θ that minimises ‖w − Σθⱼzⱼ‖ in the norm of A.

    In that norm zᵢᵀAzⱼ = zᵢ·yⱼ and zᵢᵀAw = zᵢ·∇φ. Linearly dependent directions are left out.
    """

    def _coefficients(self, slots, s, z):
        gram = self.zy[:, slots][:, :, slots]
        scale = np.sqrt(np.diagonal(gram, axis1=1, axis2=2))
        scale = np.where(scale > 0.0, scale, 1.0)
        gram = gram / (scale[:, :, None] * scale[:, None])
        finite = np.isfinite(gram).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(np.where(finite[:, None, None], gram, 0.0))
        kept = values > len(slots) * self.epsilon * values[:, -1:]
        inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
        theta = _times(vectors, inverse * _times(vectors.transpose(0, 2, 1), z / scale)) / scale
        return -theta, theta


class LBFGS(_History):
    """L-BFGS with A as initial Hessian (Liu et al. 2017), computed from dot products alone. Pairs with sᵀy ≤ 0 are left out."""

    def _coefficients(self, slots, s, z):
        sy, zy = self.sy[:, slots][:, :, slots], self.zy[:, slots][:, :, slots]
        along = np.diagonal(sy, axis1=1, axis2=2)
        good = along > self.epsilon * np.diagonal(zy, axis1=1, axis2=2)
        rho = np.where(good, 1.0 / np.where(good, along, 1.0), 0.0)
        alpha, beta = np.zeros_like(s), np.zeros_like(s)
        pairs = range(len(slots))
        for i in pairs:  # the newest first: j < i is newer
            alpha[:, i] = rho[:, i] * (s[:, i] - _dot(alpha[:, :i], sy[:, i, :i]))
        curved = z - _times(zy, alpha)
        for i in reversed(pairs):
            older = _dot((alpha - beta)[:, i + 1 :], sy[:, i + 1 :, i])
            beta[:, i] = rho[:, i] * (curved[:, i] + older)
        return beta - alpha, alpha


def accelerated(name, model, window, slowest):
    """Returns the acceleration of a name.

    Args:
        name: ``"none"``, ``"chebyshev"``, ``"anderson"`` or ``"l-bfgs"``.
        model: The :class:`warpcloth.model.model.Model`.
        window: Number of steps that Anderson and L-BFGS remember.
        slowest: Function that returns ρ of Chebyshev, (B,).
    """
    if name == "none":
        return Plain(model.copies)
    if name == "chebyshev":
        return Chebyshev(model.copies, slowest())
    epsilon = 10.0 * float(np.finfo(model.numpy_dtype).eps)
    return {"anderson": Anderson, "l-bfgs": LBFGS}[name](model.copies, window, epsilon)
