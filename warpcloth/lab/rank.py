"""Best rotations of points in a plane, on a line or at one position (Kabsch 1976, *A solution for the best rotation to
relate two sets of vectors*).

The covariance of the points has the singular values σ₁² ≥ σ₂² ≥ σ₃². The rotation about their main axis follows from σ₂², which
has the rounding εσ₁², so it is accurate to about ε(σ₁/σ₂)²; the axis itself to a few ε. Points in a plane determine the
rotation, but UVᵀ is a reflection half of the time once (σ₃/σ₁)² is below ε. For points on a line, the smallest rotation is
taken, for one point the identity.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from ..numerics.rotation import kabsch, svd
from .measurements import task
from .panels import Panel, point

TITLE = "13. Best rotations of points whose covariance lacks rank"
EPS = {dtype: float(np.finfo(dtype).eps) for dtype in ("float32", "float64")}
_SETS, _POINTS = 200, 20


def known(ratio, dtype):
    """Returns ε(σ₁/σ₂)², at most π."""
    return min(EPS[dtype] / ratio**2, np.pi)


def least(degrees):
    """Returns the angle [°] between a line and the line rotated by ``degrees`` about an axis at 45° to it."""
    return np.degrees(np.arccos(0.5 + 0.5 * np.cos(np.radians(degrees))))


_LAWS = {dtype: f"ε(σ₁/σ₂)², {dtype}" for dtype in EPS}
_WHOLE, _ANGLE, _NONE = "the turn", "angle between the lines", "0"
PANELS = (
    Panel(
        "line",
        "Points in a plane that becomes a line: the turn about it is lost",
        "σ₂/σ₁",
        "largest error of 200 sets [rad]",
        ("log", "log"),
        laws={_LAWS[dtype]: (lambda r, dtype=dtype: known(r, dtype)) for dtype in EPS},
        limits=(1e-25, 30.0),
    ),
    Panel(
        "turn",
        "What is kept of a turn about an axis at 45° to the line",
        "turn [°]",
        "rotation found [°]",
        laws={_WHOLE: lambda d: d, _ANGLE: least, _NONE: lambda d: 0.0},
        follows={"in a plane": _WHOLE, "on a line": _ANGLE, "in one place": _NONE},
    ),
    Panel(
        "reflection",
        "Points in a volume that becomes a plane: U Vᵀ reflects",
        "σ₃/σ₁",
        "rotations that are reflections [%]",
        ("log", "linear"),
        marks={float(np.sqrt(eps)): f"√ε, {dtype}" for dtype, eps in EPS.items()},
    ),
)


def tasks(device):
    return [task(measure, device=device)]


def sets(ratios, dtype, seed=0):
    """Returns P and Q = R P (c, n, 3), R (c, 3, 3) and the first axis of P (c, 3); P has given singular values."""
    rng = np.random.default_rng(seed)
    centred = rng.normal(size=(_SETS, _POINTS, 3))
    axes, _ = np.linalg.qr(centred - centred.mean(axis=1, keepdims=True))
    own, R = (Rotation.random(_SETS, random_state=seed + k).as_matrix() for k in (1, 2))
    P = ((axes * ratios) @ own.mT).astype(dtype)
    Q = (P.astype(np.float64) @ R.mT).astype(dtype)
    return P, Q, R, own[:, :, 0]


def measure(device):
    """Returns the points of all panels."""
    import warp as wp

    def fit(P, Q):
        if device == "cpu":
            return kabsch(P, Q).astype(np.float64)
        return kabsch(wp.array(P, device=device), wp.array(Q, device=device)).numpy().astype(np.float64)

    return [*_lines(fit), *_turns(fit), *_reflections(fit)]


def _lines(fit):
    for dtype in EPS:
        for ratio in np.geomspace(1.0, 1e-10, 21):
            P, Q, R, line = sets((1.0, ratio, 0.0), dtype)
            found = fit(P, Q)
            whole = Rotation.from_matrix(found @ R.mT).magnitude()
            moved, right = ((turn @ line[:, :, None])[:, :, 0] for turn in (found, R))
            yield point("line", f"{dtype}: the rotation", ratio, whole.max())
            yield point("line", f"{dtype}: where the line goes", ratio, np.linalg.norm(moved - right, axis=1).max())


def _turns(fit):
    t = np.linspace(-1.0, 1.0, 5)
    shapes = {
        "in a plane": np.stack([t, t**2, 0.0 * t], axis=1),
        "on a line": t[:, None] * [1.0, 0.0, 0.0],
        "in one place": np.zeros((1, 3)),
    }
    for degrees in np.arange(0.0, 180.1, 10.0):
        R = Rotation.from_rotvec(np.radians(degrees) * np.sqrt(0.5) * np.array([1.0, 1.0, 0.0])).as_matrix()
        for series, P in shapes.items():
            yield point("turn", series, degrees, np.degrees(Rotation.from_matrix(fit(P, P @ R.T)).magnitude()))


def _reflections(fit):
    for dtype in EPS:
        for ratio in np.geomspace(1.0, 1e-12, 25):
            P, Q, _, _ = sets((1.0, 0.5, ratio), dtype)
            U, _, V = svd(Q.mT @ P)
            for series, R in ((f"U Vᵀ, {dtype}", U @ V.mT), (f"kabsch, {dtype}", fit(P, Q))):
                yield point("reflection", series, ratio, 100.0 * (np.linalg.det(R) < 0.0).mean())
