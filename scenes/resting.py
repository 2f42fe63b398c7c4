"""A sheet of 1 m at rest on a collider, in contact with all vertices, or far above it, to measure the cost of contact."""

from typing import Literal, get_args

import numpy as np

import warpcloth as wc

BEND = 5.0  # radius of the ball and the capsule [m], on which friction of 0.14 and more holds the sheet
Shape = Literal["plane", "sphere", "capsule", "box", "mesh"]


def scene(collider: Shape = "plane", gap: float = 0.9e-3, n: int = 64, friction: float = 0.3, triangles: int = 20000):
    """Shape of the collider, gap [m], vertices per side, coefficient of friction, triangles of the flat mesh collider."""
    wc.checks.choice("collider", collider, get_args(Shape))
    wc.checks.number("gap", gap, above=0.0)
    wc.checks.whole("triangles", triangles, least=2)
    grid = wc.Mesh.grid(n, n, size=1.0, pattern="alternating")
    x, _, z = (grid.points - [0.5, 0.0, 0.5]).T
    square = {"sphere": x**2 + z**2, "capsule": z**2}.get(collider, 0.0 * x)
    height = np.sqrt((BEND + gap) ** 2 - square) - BEND
    if collider == "mesh":
        cells = max(round(np.sqrt(triangles / 2)), 1) + 1
        ground = wc.Mesh.grid(cells, cells, size=2.0)
        shape = wc.MeshCollider(ground.points - [1.0, 0.0, 1.0], ground.triangles, friction=friction)
    else:
        round_ = {"radius": BEND, "position": (0.0, -BEND, 0.0), "friction": friction}
        shape = {
            "plane": lambda: wc.Plane(friction=friction),
            "sphere": lambda: wc.Sphere(**round_),
            "capsule": lambda: wc.Capsule(length=4.0, axis=(1.0, 0.0, 0.0), **round_),
            "box": lambda: wc.Box(size=(2.0, 1.0, 2.0), position=(0.0, -0.5, 0.0), friction=friction),
        }[collider]()
    density, distance = 0.15, 1e-3
    return wc.Scene(
        grid,
        density=density,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        positions=np.stack([x, height, z], axis=1),
        colliders=[shape],
        contact=wc.Contact(distance=distance, stiffness=10.0 * 9.81 * density / distance),  # rests at 0.9 mm
        name="resting",
    )
