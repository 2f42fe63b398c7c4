"""A strip bent into a hanging loop. Both ends, the contact distance apart, are clamped at one point, and point down (pear),
sideways (ring) or up (heart).

Without weight, its depth below that point is .424308, .318310 and .133860 of its length L. For a heart with Γ = ρgL³/D of 10,
100 and 400 it is .139540, .184043 and .275445.

With a fabric, a heart is the heart loop test. L follows from Γ, ρ and D at an angle to the warp; its clamps are 0.18 edges
behind the second row of pins, as in `cantilever`.
"""

from typing import Literal

import numpy as np

import warpcloth as wc
from warpcloth.scenes.cantilever import CLAMP

# Half turns of one half of the strip, coefficient that closes the initial loop, direction from the first end to the second.
KINDS = {"pear": (0.5, 1.171066, [1, 0, 0]), "ring": (1.0, 0.0, [0, 1, 0]), "heart": (1.5, -0.670103, [1, 0, 0])}


def scene(
    kind: Literal["pear", "ring", "heart"] = "heart",
    gamma: float = 100.0,
    elements: int = 128,
    length: float = 0.2,
    duration: float = 2.0,
    fabric: str | None = None,
    angle: float = 0.0,
    width: float = 0.025,
):
    """pear, ring or heart, Γ, edges along L, L [m], duration [s]; fabric, its angle to the warp [°], width [m]."""
    wc.checks.choice(*("kind", kind, tuple(KINDS)) if fabric is None else ("kind with a fabric", kind, ("heart",)))
    wc.checks.number("gamma", gamma, least=0.0)
    wc.checks.whole("elements", elements, 8)
    wc.checks.number("length", length, above=0.0)
    wc.checks.number("angle", angle)
    wc.checks.number("width", width, above=0.0)
    (turns, closing, aside), edge, bending = KINDS[kind], length / elements, 1e-6
    if fabric is None:
        s = edge * (np.arange(2 * elements + 3) - 1) / 2.0  # a row of triangles, half an edge beyond L at each end
        odd, one = np.arange(len(s)) % 2, np.arange(len(s) - 2)
        points = np.stack([s, 0.0 * s, np.sqrt(0.75) * edge * odd], axis=1)
        mesh = wc.Mesh(points, np.stack([one, one + 1 + odd[:-2], one + 2 - odd[:-2]], axis=1))
        density, rows, free = max(gamma, 1.0) * bending / (9.81 * length**3), 3, 0.5 * edge
        # One row of triangles bends with 8/9 of D.
        bend = wc.QuadraticBending(stiffness=9 / 8 * bending, damping=1e-2 * bending)
        terms = [wc.Spring(stiffness=2e6 * bending / length**2), bend]
    else:
        cloth = wc.fabrics.find(fabric)
        density, rows, terms = cloth.density, 2, cloth.terms(warp_angle=-np.radians(angle))
        length = (max(gamma, 1.0) * cloth.bending_along(np.radians(angle)) / (9.81 * density)) ** (1 / 3)
        edge = length / (elements + 2 * CLAMP)
        free, s = CLAMP * edge, edge * (CLAMP - 1.0 + np.arange(elements + 3))
        if width < 3.9 * edge:
            raise ValueError(f"width is {width:g} m, below 4 edges of {edge:.3g} m; take more elements or a wider strip")
        size = ((elements + 2) * edge, width)
        mesh = wc.Mesh.grid(elements + 3, round(width / edge) + 1, size=size, pattern="alternating")
    u = np.clip((s[1:] + s[:-1] - length) / (length - 2.0 * free), -1.0, 1.0)  # clamps are straight
    turned = np.pi * turns * u + closing * np.sin(np.pi * u)
    steps = (s[1] - s[0]) * np.stack([np.cos(turned), np.sin(turned), 0.0 * turned], axis=1)
    line = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(steps, axis=0)])
    ends = s[1] / (s[1] - s[0]) * np.stack([steps[0], -steps[-1]])  # from the clamps to the second row of pins
    gap = 5e-4 * length * np.array(aside) + (ends[1] - ends[0]) - (line[-2] - line[1])
    line += np.outer(np.interp(s, [free, length - free], [-0.5, 0.5]), gap) + ends.mean(axis=0) - 0.5 * (line[1] + line[-2])
    column = np.arange(len(mesh.points)) % len(s)
    return wc.Scene(
        mesh,
        density=density,
        positions=line[column] + mesh.points * [0.0, 0.0, 1.0],
        terms=terms,
        pins=np.flatnonzero((column < rows) | (column >= len(s) - rows)),
        gravity=(0.0, -9.81 if gamma else 0.0, 0.0),
        free_axes=np.tile([True, True, False], (len(column), 1)),
        self_contact=wc.SelfContact(distance=5e-4 * length, stiffness=1e6),
        duration=duration,
        name="loop",
    )
