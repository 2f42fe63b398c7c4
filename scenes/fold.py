"""A sheet that hangs in waves above a floor, falls on it, and folds onto itself."""

import numpy as np

import warpcloth as wc


def scene(
    nx: int = 16,
    ny: int = 48,
    folds: int = 3,
    width: float = 0.2,
    height: float = 0.6,
    friction: float = 0.5,
    bending: float = 1e-5,
    damping: float = 1e-7,
    duration: float = 2.0,
):
    """Vertices across and down, folds, width and height [m], friction of the floor, stiffness of bending [N·m] and its damping
    [N·m·s], duration [s]."""
    wc.checks.whole("nx", nx, 2)
    wc.checks.whole("folds", folds, 1)
    wc.checks.whole("ny", ny, 4 * folds)
    for name, value in {"width": width, "height": height, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    grid = wc.Mesh.grid(nx, ny, size=(width, height), pattern="alternating")
    down = (np.arange(ny) + 0.5)[:-1] / (ny - 1)
    slope = np.radians(70.0) * np.sin(2.0 * np.pi * folds * down)  # of the sheet to the vertical
    steps = height / (ny - 1) * np.stack([np.sin(slope), -np.cos(slope)], axis=1)
    line = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
    line += [0.0, 0.02 - line[-1, 1]]
    positions = np.stack([np.repeat(line[:, 0], nx), np.repeat(line[:, 1], nx), grid.points[:, 0]], axis=1)
    return wc.Scene(
        grid,
        density=0.15,
        positions=positions,
        terms=[
            wc.Spring(pairs=("structural", "shear"), stiffness=200.0, damping=0.02),
            wc.QuadraticBending(stiffness=bending, damping=damping),
        ],
        colliders=[wc.Plane(friction=friction, name="floor")],
        contact=wc.Contact(distance=3e-3),
        self_contact=wc.SelfContact(distance=3e-3),
        duration=duration,
        name="fold",
    )
