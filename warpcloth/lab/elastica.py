"""The heavy elastica: a strip clamped horizontally that bends under its own weight (Romero et al. 2021, *Physical validation
of simulators in computer graphics*).

Γ = ρgL³/D. With the arc length u from the free tip in units of L, and the angle φ from the downward vertical,

    φ″ = Γ u sin φ,   φ′(0) = 0,   φ(1) = π/2;   H = ∫cos φ du,   W = ∫sin φ du.

H/W tends to Γ/8 for small Γ. Above Γ of about 150 there are several solutions; this module is for smaller Γ.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

MOST = 100.0


def curve(gamma, at=None):
    """Returns points (k, 2) in units of L, from the clamp at the origin along x, y up.

    Args:
        gamma: Γ, up to 100.
        at: Positions along the strip (k,), from 0 at the clamp to 1 at the tip; by default 101.
    """

    def shoot(tip, **options):
        return solve_ivp(
            lambda u, y: [y[1], gamma * u * np.sin(y[0]), np.cos(y[0]), np.sin(y[0])],
            (0.0, 1.0),
            [tip, 0.0, 0.0, 0.0],
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
            **options,
        )

    tip = brentq(lambda angle: shoot(angle).y[0, -1] - np.pi / 2, 1e-9, np.pi / 2, xtol=1e-14)
    found = shoot(tip, dense_output=True)
    _, _, H, W = found.sol(1.0 - np.asarray(np.linspace(0.0, 1.0, 101) if at is None else at))
    return np.stack([found.y[3, -1] - W, H - found.y[2, -1]], axis=1)


def aspect(gamma, at=1.0):
    """Returns H/W of the tip, or of another position along the strip."""
    ((x, y),) = curve(gamma, [at])
    return -y / x


def gamma_of(ratio, at, near):
    """Returns the Γ at which position ``at`` has H/W = ``ratio``, within a factor of 20 of ``near``; or None."""

    def gap(gamma):
        return aspect(gamma, at) - ratio

    low, high = near / 20.0, min(20.0 * near, MOST)
    return brentq(gap, low, high, rtol=1e-8) if gap(low) < 0.0 < gap(high) else None
