"""Two cards that lean on each other on a floor, upright by friction.

The top of the first, shorter one rests on the face of the second, at ρ = 0.97 of its length. They stand at an angle θ to the
vertical if the friction between them is above (ρ² − cos 2θ)/sin 2θ.
"""

import numpy as np

import warpcloth as wc


def scene(angle: float = 20.0, friction: float = 0.6, floor: float = 0.5, n: int = 4, duration: float = 2.0):
    """Angle to the vertical [degrees], friction between the cards and on the floor, vertices per side, duration [s]."""
    wc.checks.whole("n", n, least=2)
    wc.checks.number("angle", angle, above=0.0)
    length, width, distance, theta = 0.088, 0.063, 1e-3, np.radians(angle)
    c, s, gap = np.cos(theta), np.sin(theta), 0.9 * distance  # gap below a resting sheet
    top = 0.97 * length * np.array([-s, c]) - gap * np.array([c, s])
    density, cards = 0.3, {}
    stiffness = 10.0 * 9.81 * density / distance
    for name, high, side in (("first", top, s), ("second", length * np.array([-s, c]), -s)):
        card = wc.Mesh.grid(n, n, size=(high[1] / c, width), pattern="alternating")
        xy = high + (card.points[:, :1] - high[1] / c) * [side, c] + [0.0, gap]
        cards[name] = wc.Mesh(np.column_stack([xy, card.points[:, 2]]), card.triangles)
    return wc.Scene(
        wc.Mesh.join(cards),
        density=density,
        terms=[wc.Spring(stiffness=1e3), wc.QuadraticBending(stiffness=1e-2)],
        colliders=[wc.Plane(friction=floor, name="floor")],
        contact=wc.Contact(distance=distance, stiffness=stiffness),
        self_contact=wc.SelfContact(distance=distance, stiffness=stiffness, friction=friction),
        duration=duration,
        name="cards",
    )
