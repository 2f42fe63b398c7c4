"""A ring of radius R, bent from a flat strip, between two plates that close until the load is P per width.

Without weight and stretch it then has the height H. The angle φ between its arc s and the plates satisfies Dφ″ = P/2 cos φ. Up
to P = 2.786 D/R² the ring touches each plate along a line; above, it lies flat on them, and P = 5.742 D/H².
"""

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import warpcloth as wc


def height(load):
    """H/2R as a function of PR²/D, by quadrature over a quarter of the ring, where (R dφ/ds)² = c + PR²/D sin φ."""

    def integral(power, c):  # of sinᵖ φ ds/R; φ = t² removes the pole at c = 0
        return quad(lambda t: 2.0 * t * np.sin(t * t) ** power / np.sqrt(c + load * np.sin(t * t)), 0.0, np.sqrt(np.pi / 2))[0]

    flat = integral(0, 0.0) <= np.pi / 2
    return integral(1, 0.0 if flat else brentq(lambda c: integral(0, c) - np.pi / 2, 1e-9, 1.0))


def scene(load: float = 2.0, elements: int = 96, radius: float = 0.1, bending: float = 1.0, duration: float = 1.0):
    """PR²/D, edges around, R [m], D [N·m], duration [s]; the plates close in its first half."""
    for name, value in {"load": load, "radius": radius, "bending": bending, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.whole("elements", elements, 8)
    fps, distance = 60.0, 0.01 * radius
    vertex = radius / np.cos(0.5 * np.pi / elements)  # where vertices are, so that the middles of the polygon are on the ring
    edge, half = 2.0 * vertex * np.sin(np.pi / elements), 2.0 * vertex * np.sin(0.5 * np.pi / elements)
    width, force = np.sqrt(edge**2 - half**2), load * bending / radius**2
    angle = 2.0 * np.pi / elements * np.add.outer([-0.25, 0.25], np.arange(elements))
    points = np.stack([vertex * np.sin(angle), np.full(angle.shape, [[width], [2.0 * width]]), vertex * np.cos(angle)], axis=-1)
    one = np.arange(elements)
    after = np.roll(one, -1)
    triangles = [np.stack([one, after, one + elements], axis=1), np.stack([after, after + elements, one + elements], axis=1)]
    mesh = wc.Mesh(points.reshape(-1, 3), np.concatenate(triangles))
    part = 0.5 - 0.5 * np.cos(np.pi * np.minimum(2.0 * np.arange(round(duration * fps) + 1) / (duration * fps), 1.0))
    thick, outer = 0.2 * radius, radius + 0.995 * distance  # of a plate, and where its surface is when it just touches
    size = (2.5 * radius, 3.0 * width, thick)
    at = np.array([0.0, 1.5 * width, outer + 0.5 * thick])
    closing = -2.0 * radius * (1.0 - height(load)) * part
    return wc.Scene(
        mesh,
        density=0.3,
        # One row of triangles bends with 8/9 of D.
        terms=[
            wc.Spring(stiffness=8e3 * bending / radius**2),  # softer, bending shrinks the ring; stiffer, few edges do not bend
            wc.QuadraticBending(stiffness=9 / 8 * bending, damping=2e-4 * bending),
        ],
        free_axes=np.tile([True, False, True], (2 * elements, 1)),
        colliders=[
            wc.Box(size=size, position=at * [1.0, 1.0, -1.0], name="fixed plate"),
            wc.Box(size=size, position=at + closing[:, None] * [0.0, 0.0, 1.0], name="moving plate"),
        ],
        contact=wc.Contact(distance=distance, stiffness=100.0 * force / (edge * distance)),
        duration=duration,
        fps=fps,
        name="ring",
    )
