"""A mobile: two rigid bars hung from one another by strings, and three cloths sewn to rigid battens, pushed to turn.

The cloths are `width` wide: one hangs from the upper bar, two from the lower. Bars hang where their loads balance.
"""

import numpy as np

import warpcloth as wc


def scene(n: int = 9, stiffness: float = 500.0, bending: float = 1e-5, push: float = 0.4, duration: float = 4.0):
    """Vertices a side of a cloth (odd), springs [N/m], bending [N·m], speed of a corner at the start [m/s], duration [s]."""
    width, string, grid = 0.3, 0.15, wc.Mesh.grid(n, n, size=0.3, pattern="alternating")
    upright = (grid.points - [width / 2, 0.0, 0.0])[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    # A bar is three vertices: where it hangs, and where its left and right load do, twice as near as a load is twice as heavy.
    upper = np.array([[0.0, -string, 0.0], [-0.5, -string, 0.0], [0.25, -string, 0.0]])
    lower = np.array([[0.25, -2 * string, 0.0], [0.05, -2 * string, 0.0], [0.45, -2 * string, 0.0]])
    hung = [upper[1], lower[1], lower[2]]  # where the string of each cloth begins
    cloths = [place + [0.0, -string * (1 + 2 * (i == 2)), 0.0] + upright for i, place in enumerate(hung)]
    points = np.concatenate([[[0.0, 0.0, 0.0]], upper, lower, *cloths])
    first = 7 + n * n * np.arange(3)
    mesh = wc.Mesh(points, np.concatenate([grid.triangles + offset for offset in first]))
    strings = [[0, 1], [3, 4], [2, first[0] + n // 2], [5, first[1] + n // 2], [6, first[2] + n // 2]]
    masses = np.where(np.arange(len(points)) < 7, 1e-3, 0.1 * mesh.vertex_areas)
    masses[first[:, None] + np.arange(n)] += 5e-3 / n  # battens
    swung = points[:, 2:] + points[:, :1]  # turning about the string
    return wc.Scene(
        mesh,
        masses=masses,
        velocities=np.concatenate([0 * swung, 0 * swung, push * swung / 0.65], axis=1) * (points[:, 1:2] < 0.0),
        terms=[
            wc.RigidCluster(vertices=[[1, 2, 3], [4, 5, 6], *(first[:, None] + np.arange(n))]),
            wc.Spring(pairs=strings, stiffness=np.inf, name="strings"),
            wc.Spring(pairs="edges", stiffness=stiffness),
            wc.QuadraticBending(stiffness=bending),
        ],
        pins=[0],
        duration=duration,
        name="mobile",
    )
