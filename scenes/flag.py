"""A flag on a pole that oscillates about its axis, by keyframes of its pins, or stands in the wind."""

import numpy as np

import warpcloth as wc


def scene(
    nx: int = 36,
    ny: int = 24,
    swing: float = 60.0,
    period: float = 1.5,
    stiffness: float = 1e3,
    bending: float = 1e-5,
    duration: float = 3.0,
    wind: float = 0.0,
):
    """Vertices along and down, amplitude [°], period [s], springs [N/m], bending [N·m], duration [s], wind [m/s]."""
    wc.checks.number("wind", wind)
    wc.checks.number("swing", swing, least=0.0)
    wc.checks.number("period", period, above=0.0)
    wc.checks.number("duration", duration, above=0.0)
    mesh = wc.Mesh.grid(nx, ny, size=(0.9, 0.6), pattern="alternating")
    fps = 60.0
    upright = mesh.points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # the grid's z is down
    pole = np.arange(0, nx * ny, nx)
    times = np.arange(round(duration * fps) + 1)[:, None] / fps
    angle = np.radians(swing) * np.sin(2.0 * np.pi * times / period) * np.minimum(times / period, 1.0)
    # The pole is as thick as the first cell of the flag is wide, so that its rotation rotates the cloth.
    held = np.concatenate([pole, pole + 1])
    x = upright[held, 0]
    keyframes = np.stack([x * np.cos(angle), np.tile(upright[held, 1], (len(times), 1)), x * np.sin(angle)], axis=-1)
    return wc.Scene(
        mesh,
        density=0.1,
        positions=upright,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=stiffness), wc.QuadraticBending(stiffness=bending)],
        pins=wc.Pins(held, keyframes),
        air=wc.Air(wind=(wind, 0.0, 0.3 * wind)) if wind else None,
        duration=duration,
        fps=fps,
        name="flag",
    )
