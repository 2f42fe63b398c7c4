"""A square tablecloth, rotated on a square table: its corners hang over the sides."""

import numpy as np

import warpcloth as wc


def scene(
    n: int = 41,
    size: float = 1.2,
    angle: float = 45.0,
    table: float = 0.8,
    friction: float = 0.3,
    bending: float = 1e-4,
    duration: float = 1.5,
):
    """Vertices per side, side [m], rotation [°], side of the table [m], friction, bending stiffness [N·m], duration [s]."""
    for name, value in {"table": table, "bending": bending}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.whole("n", n, 3)
    density, radius = 0.2, 0.05  # radius of the edges of the table
    # Keeps edges of the cloth that cross those of the table outside it, when the weight takes a fifth of the distance.
    distance = min(1.5 * (size / (n - 1)) ** 2 / (4.0 * radius), radius)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    grid = wc.Mesh.grid(n, n, size=size, pattern="alternating")
    flat = (grid.points - [0.5 * size, 0.0, 0.5 * size]) @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    side = table - 2.0 * radius
    colliders = [wc.Box(size=(side, table, side), position=(0.0, -0.5 * table, 0.0), friction=friction, name="table")]
    for x, z in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        colliders.append(
            wc.Capsule(
                radius=radius,
                length=side,
                axis=(abs(z), 0.0, abs(x)),
                position=(0.5 * side * x, -radius, 0.5 * side * z),
                friction=friction,
                name=f"edge {len(colliders)}",
            )
        )
    return wc.Scene(
        grid,
        density=density,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=500.0), wc.QuadraticBending(stiffness=bending)],
        positions=flat + np.array([0.0, 0.98 * distance, 0.0]),
        colliders=colliders,
        contact=wc.Contact(distance=distance, stiffness=50.0 * 9.81 * density / distance),
        duration=duration,
        name="tablecloth",
    )
