"""A sheet of length L without bending stiffness on a table: it slips off if more than L m/(1 + m) hangs over the edge.

m = μ exp(μπ/2) for a small radius of the edge, which has the same friction μ as the table. The sheet starts at rest.
"""

import numpy as np

import warpcloth as wc


def scene(
    friction: float = 0.3,
    part: float = 1.1,
    elements: int = 40,
    length: float = 1.0,
    width: float = 0.1,
    radius: float = 0.03,
    duration: float = 1.0,
):
    """Friction, overhang over L m/(1 + m), elements along, L, width, radius of the edge [m], duration [s]."""
    for name, value in {"friction": friction, "part": part, "length": length, "width": width, "radius": radius}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.whole("elements", elements, 4)
    m = friction * np.exp(0.5 * np.pi * friction)
    density, distance, rows = 0.15, 1e-3, max(round(width * elements / length), 1) + 1
    outer = radius + distance
    over, arc = part * length * m / (1.0 + m), 0.5 * np.pi * outer  # beyond the flat top, and how much of it the edge takes
    if not arc < over < length:
        raise ValueError(
            f"the sheet hangs over by {over:.3g} m; it must be more than {arc:.3g} m, the edge, and less than {length:g} m"
        )
    contact = wc.Contact(distance=distance, stiffness=10.0 * 9.81 * density * over / (radius * distance))
    mesh = wc.Mesh.grid(elements + 1, rows, size=(length, width), pattern="alternating")
    along = mesh.points[:, 0] - (length - over)  # measured from the start of the edge
    turned = np.clip(along, 0.0, arc) / outer
    positions = np.stack(
        [
            np.minimum(along, 0.0) + outer * np.sin(turned),
            outer * np.cos(turned) - radius - np.maximum(along - arc, 0.0),
            mesh.points[:, 2] - 0.5 * width,
        ],
        axis=1,
    )
    return wc.Scene(
        mesh,
        density=density,
        positions=positions,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=300.0, damping=0.05)],
        colliders=[
            wc.Box(
                size=(1.1 * length, 2.0 * radius, width + 4.0 * radius),
                position=(-0.55 * length, -radius, 0.0),
                friction=friction,
                name="table",
            ),
            wc.Capsule(
                radius=radius,
                length=width + 2.0 * radius,
                axis=(0.0, 0.0, 1.0),
                position=(0.0, -radius, 0.0),
                friction=friction,
                name="edge",
            ),
        ],
        contact=contact,
        duration=duration,
        name="overhang",
    )
