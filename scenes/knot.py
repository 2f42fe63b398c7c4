"""Two strips in a loose reef knot. Their ends pull it tight against friction."""

import numpy as np
from scipy.interpolate import CubicSpline

import warpcloth as wc

# The middle line of one half of the first strip, from its end to its bight. The other strip is its image under (−x, y, −z).
LINE = np.array(
    [
        [20.0, 1.0, 0.0],
        [12.0, 1.0, -0.3],
        [7.0, 1.0, -0.65],
        [0.0, 2.0, 0.65],
        [-5.0, 2.6, 0.0],
        [-7.6, 1.2, -0.6],
        [-8.0, 0.0, -0.65],
    ]
)


def scene(
    along: int = 120, across: int = 5, width: float = 0.02, pull: float = 0.1, friction: float = 0.02, duration: float = 2.0
):
    """Edges along a strip and across it, its width [m], displacement of each end [m], friction of the strips, duration [s]."""
    wc.checks.whole("along", along, 40)
    wc.checks.whole("across", across, 1)
    for name, value in {"width": width, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.number("pull", pull)
    wc.checks.number("friction", friction, least=0.0)
    fps, points = 25.0, width * np.concatenate([LINE, LINE[-2::-1] * [1.0, -1.0, 1.0]])
    spline = CubicSpline(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))], points)
    fine = np.linspace(0.0, spline.x[-1], 4000)
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))]
    at = np.interp(np.linspace(0.0, lengths[-1], along + 1), lengths, fine)
    middle, ahead = spline(at), spline(at, 1)
    upward = np.array([0.0, 0.0, 1.0]) - ahead * (ahead[:, 2:] / (ahead**2).sum(axis=1, keepdims=True))
    upward *= width / np.linalg.norm(upward, axis=1, keepdims=True)
    grid = wc.Mesh.grid(along + 1, across + 1, size=(lengths[-1], width), pattern="alternating")
    strip = (middle + np.multiply.outer(np.linspace(-0.5, 0.5, across + 1), upward)).reshape(-1, 3)
    positions = np.concatenate([strip, strip * [-1.0, 1.0, -1.0]])
    ends = np.flatnonzero(np.isin(np.arange(len(strip)) % (along + 1), [0, along]))
    held = np.concatenate([ends, len(strip) + ends])
    ease = np.minimum(1.25 * np.linspace(0.0, 1.0, round(duration * fps) + 1), 1.0)
    way = pull * np.sign(positions[held] * [1.0, 0.0, 0.0])
    return wc.Scene(
        wc.Mesh.join({"first": grid, "second": grid}),
        density=0.15,
        positions=positions,
        terms=[wc.Spring(pairs="edges", stiffness=500.0, damping=0.05), wc.QuadraticBending(stiffness=1e-5)],
        pins=wc.Pins(held, positions[held] + np.multiply.outer(ease, way)),
        gravity=(0.0, 0.0, 0.0),
        self_contact=wc.SelfContact(distance=1e-3, stiffness=1e6, friction=friction),
        duration=duration,
        fps=fps,
        name="knot",
    )
