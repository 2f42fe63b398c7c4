"""A square cloth of 1 m that falls onto a ball over a floor; it can also touch itself."""

import numpy as np

import warpcloth as wc


def scene(
    n: int = 32,
    radius: float = 0.3,
    friction: float = 0.3,
    stiffness: float = 300.0,
    duration: float = 2.0,
    fabric: str | None = None,
    self_contact: bool = False,
):
    """Vertices per side, ball [m], friction, springs [N/m], duration [s]; one of 'warpcloth fabrics'; touches itself or not."""
    wc.checks.number("radius", radius, above=0.0)
    wc.checks.whole("n", n, 2)
    grid = wc.Mesh.grid(n, n, size=1.0, pattern="alternating")
    springs = [wc.Spring(pairs=("structural", "shear"), stiffness=stiffness), wc.QuadraticBending(stiffness=1e-5)]
    cloth = {"density": 0.15, "terms": springs} if fabric is None else {"fabric": fabric}
    density = 0.15 if fabric is None else wc.fabrics.find(fabric).density
    distance = max(0.75 / (n - 1) ** 2 / radius, 1e-3)  # also keeps edges of triangles out of the ball
    touches = {"self_contact": wc.SelfContact(distance=min(2e-3, 0.4 / (n - 1)), friction=friction)} if self_contact else {}
    height = max(2.2 * radius, 2.0 * radius + 1.1 * distance)  # above the ball, without contact
    return wc.Scene(
        grid,
        **cloth,
        positions=grid.points + np.array([-0.5, height, -0.5]),
        colliders=[
            wc.Sphere(radius=radius, position=(0.0, radius, 0.0), friction=friction, name="ball"),
            wc.Plane(friction=friction, name="floor"),
        ],
        contact=wc.Contact(distance=distance, stiffness=40.0 * 9.81 * density / distance),
        **touches,
        duration=duration,
        name="drape",
    )
