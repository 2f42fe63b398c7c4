"""A mobile: two rigid bars, the second hung from the first, carry three cloths sewn to rigid battens. A push makes it rotate.

A bar has two ends, and slightly above them its suspension, where its loads balance.
"""

import numpy as np

import warpcloth as wc


def scene(n: int = 9, stiffness: float = 500.0, bending: float = 1e-5, push: float = 0.4, duration: float = 4.0):
    """Vertices per side of a cloth, springs [N/m], bending [N·m], initial speed of the outer cloth [m/s], duration [s]."""
    width, string, bar, batten = 0.3, 0.15, 1e-3, 5e-3  # m, m, kg a vertex, kg
    grid = wc.Mesh.grid(n, n, size=width, pattern="alternating")
    upright = (grid.points - [width / 2, 0.0, 0.0])[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    load, right = 0.1 * width**2 + batten, 0.25
    left = right * (2.0 * load + 4.0 * bar) / (load + bar)
    upper = np.array([[0.0, -string, 0.0], [-left, -string - 0.03, 0.0], [right, -string - 0.03, 0.0]])
    lower = upper[2] - [0.0, string, 0.0] + [[0.0, 0.0, 0.0], [-0.2, -0.03, 0.0], [0.2, -0.03, 0.0]]
    cloths = [position - [0.0, string, 0.0] + upright for position in (upper[1], lower[1], lower[2] - [0.0, 2.0 * string, 0.0])]
    points = np.concatenate([[[0.0, 0.0, 0.0]], upper, lower, *cloths])
    first = 7 + n * n * np.arange(3)[:, None]
    mesh = wc.Mesh(points, np.concatenate([grid.triangles + offset for offset in first[:, 0]]))
    masses = np.where(np.arange(len(points)) < 7, bar, 0.1 * mesh.vertex_areas)
    masses[first + np.arange(n)] += batten / n
    return wc.Scene(
        mesh,
        masses=masses,
        velocities=np.outer(points[:, 0], [0.0, 0.0, push / left]),
        terms=[
            wc.RigidCluster(vertices=[[1, 2, 3], [4, 5, 6], *(first + np.arange(n))], name="bars"),
            wc.Spring(pairs=[[0, 1], [3, 4], *np.column_stack([[2, 5, 6], first + n // 2])], stiffness=np.inf, name="strings"),
            wc.Spring(pairs="edges", stiffness=stiffness),
            wc.QuadraticBending(stiffness=bending),
        ],
        pins=[0],
        duration=duration,
        name="mobile",
    )
