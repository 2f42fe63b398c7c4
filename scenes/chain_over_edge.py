"""A chain of length L that slides off a smooth table: the depth of its tip below the top is x = a₀ cosh(t√(g/L)).

This holds for any radius of the edge once the tip is below the edge. At x = (L + √(L² + 8a₀²))/4 the chain lifts off an edge of
small radius.
"""

import numpy as np

import warpcloth as wc


def scene(
    links: int = 100,
    length: float = 1.0,
    depth: float = 0.1,
    radius: float = 0.03,
    stretching: float = 2e3,
    duration: float = 0.75,
):
    """Number of links, L [m], a₀ [m], radius of the edge [m], EA [N], duration [s]."""
    wc.checks.whole("links", links, 4)
    for name, value in {"length": length, "radius": radius, "stretching": stretching}.items():
        wc.checks.number(name, value, above=0.0)
    if not radius <= depth <= 0.5 * length:
        raise ValueError(
            f"depth is {depth}; it must be from {radius:g} m, the radius of the edge, to half of the length, {length / 2:g} m"
        )
    density, distance = 0.1, 1e-3
    outer = radius + distance
    arc = 0.5 * np.pi * outer
    over = arc + depth - outer  # beyond the flat top
    contact = wc.Contact(distance=distance, stiffness=10.0 * 9.81 * density * length / (8.0 * radius * distance**2))
    mesh = wc.Mesh.chain(links + 1, length=length, direction=(1.0, 0.0, 0.0))
    along = mesh.points[:, 0] - (length - over)
    turned = np.clip(along, 0.0, arc) / outer
    positions = np.stack(
        [
            np.minimum(along, 0.0) + outer * np.sin(turned),
            outer * np.cos(turned) - radius - np.maximum(along - arc, 0.0),
            np.zeros(links + 1),
        ],
        axis=1,
    )
    return wc.Scene(
        mesh,
        density=density,
        positions=positions,
        terms=[wc.Spring(stiffness=stretching * links / length, damping=1.0)],
        colliders=[
            wc.Box(size=(1.1 * length, 2.0 * radius, 6.0 * radius), position=(-0.55 * length, -radius, 0.0), name="table"),
            wc.Capsule(radius=radius, length=4.0 * radius, axis=(0.0, 0.0, 1.0), position=(0.0, -radius, 0.0), name="edge"),
        ],
        contact=contact,
        duration=duration,
        name="chain_over_edge",
    )
