"""The heavy elastica: a strip clamped horizontally that bends under its own weight (Romero et al. 2021, *Physical validation of
simulators in computer graphics*), and a hanging loop.

Γ = ρgL³/D. With the arc length u from the free tip in units of L, and the angle φ from the downward vertical,

    φ″ = Γ u sin φ,   φ′(0) = 0,   φ(1) = π/2;   H = ∫cos φ du,   W = ∫sin φ du.

H/W tends to Γ/8 for small Γ. Above Γ of about 150 there are several solutions.

A loop hangs from one point at which both ends are clamped. With the arc length s from its lowest point in units of L, the angle
a of the tangent from the horizontal, and an unknown horizontal force h in units of D/L²,

    a″ = h sin a − Γ s cos a,   a(0) = 0,   a(½) = nπ,   ∫cos a ds = 0;   depth = ∫sin a ds,

where n is ½ for a pear, 1 for a ring and 3/2 for a heart.
"""

import numpy as np

from ..scenes.loop import KINDS

MAX_GAMMA = 100.0


def curve(gamma, at=None):
    """Returns points (k, 2) in units of L, from the clamp at the origin along x, y up, for Γ up to 100.

    ``at`` (k,) are positions along the strip, from 0 at the clamp to 1 at the tip; by default 101.
    """

    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

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

    from scipy.optimize import brentq

    def gap(gamma):
        return aspect(gamma, at) - ratio

    low, high = near / 20.0, min(20.0 * near, MAX_GAMMA)
    return brentq(gap, low, high, rtol=1e-8) if gap(low) < 0.0 < gap(high) else None


def loop_depth(kind, gamma):
    """Returns the depth of a hanging "pear", "ring" or "heart" in units of L, for Γ up to 200."""
    from scipy.integrate import solve_bvp

    turns, closing, _ = KINDS[kind]
    s = np.linspace(0.0, 0.5, 41)
    a = np.pi * turns * 2.0 * s + closing * np.sin(2.0 * np.pi * s)
    k = 2.0 * np.pi * (turns + closing * np.cos(2.0 * np.pi * s))
    y, h = np.stack([a, k, np.cumsum(np.cos(a)) / 80.0, np.cumsum(np.sin(a)) / 80.0]), [0.0]
    for part in np.linspace(0.0, gamma, 1 + int(np.ceil(gamma / 50.0))):  # from the loop without weight
        found = solve_bvp(
            lambda s, y, h, weight=part: [y[1], h[0] * np.sin(y[0]) - weight * s * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])],
            lambda low, end, h: np.array([low[0], low[2], low[3], end[0] - np.pi * turns, end[2]]),
            s,
            y,
            h,
            tol=1e-6,
        )
        if not found.success:
            raise ValueError(f"gamma is {gamma:g}; no {kind} was found for it")
        s, y, h = found.x, found.y, found.p
    return float(y[3, -1])


def gamma_of_loop(kind, depth):
    """Returns the Γ at which the depth of a loop is ``depth`` times L, up to 200; or None."""

    from scipy.optimize import brentq

    def gap(gamma):
        return loop_depth(kind, gamma) - depth

    return brentq(gap, 0.0, 200.0, rtol=1e-6) if gap(0.0) < 0.0 < gap(200.0) else None
