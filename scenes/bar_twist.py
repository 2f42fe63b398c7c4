"""A bar with a closed surface, fixed at one end. Keyframes rotate the other end about the axis of the bar."""

import numpy as np

import warpcloth as wc


def scene(angle: float = 150.0, cells: int = 5, stiffness: float = 100.0, bending: float = 0.1, duration: float = 2.0):
    """Turn [°], cells across the bar, springs [N/m], bending [N·m], duration [s]."""
    wc.checks.number("angle", angle)
    wc.checks.whole("cells", cells, least=1)
    wc.checks.number("duration", duration, above=0.0)
    size, fps = np.array([5 * cells, cells, cells]), 24.0
    squares = []  # of the six sides, on an integer lattice
    for axis, far in [(axis, far) for axis in range(3) for far in (0, 1)]:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        first = np.argwhere(np.ones(size[[u, v]]))
        square = np.full((len(first), 4, 3), far * size[axis])
        square[..., [u, v]] = first[:, None] + [[0, 0], [1, 0], [1, 1], [0, 1]]
        odd = first.sum(axis=1) % 2 == 1
        square[odd] = np.roll(square[odd], 1, axis=1)  # so that diagonals alternate
        squares.append(square if far else square[:, ::-1])
    lattice, corners = np.unique(np.concatenate(squares).reshape(-1, 3), axis=0, return_inverse=True)
    triangles = corners.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    mesh = wc.Mesh((lattice - [0, cells / 2, cells / 2]) * 0.2 / cells, triangles)  # 1 m × 0.2 m × 0.2 m, axis y = z = 0
    held = mesh.select("x == 0 or x == 1")
    x, y, z = mesh.points[held].T
    turn = np.radians(angle) * np.linspace(0.0, 1.0, round(duration * fps) + 1)[:, None] * (x > 0.5)
    keyframes = [x + 0 * turn, y * np.cos(turn) - z * np.sin(turn), y * np.sin(turn) + z * np.cos(turn)]
    return wc.Scene(
        mesh,
        density=1.0,
        terms=[wc.Spring(pairs="edges", stiffness=stiffness), wc.DihedralBending(stiffness=bending)],
        pins=wc.Pins(held, np.stack(keyframes, axis=-1)),
        gravity=(0.0, 0.0, 0.0),
        duration=duration,
        fps=fps,
        name="bar_twist",
    )
