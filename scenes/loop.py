"""A strip bent into a hanging loop. Both ends are clamped at one point, and point down (pear), sideways (ring) or up (heart).

Without weight, its depth from that point to the lowest one is .424308, .318310 and .133860 of its length L. For a heart with
Γ = ρgL³/D of 10, 100 and 400 it is .139540, .184043 and .275445. The two ends are the contact distance apart.
"""

import numpy as np

import warpcloth as wc

# Half turns of one half of the strip, coefficient that closes the initial loop, direction from the first end to the second.
KINDS = {"pear": (0.5, 1.171066, [1, 0, 0]), "ring": (1.0, 0.0, [0, 1, 0]), "heart": (1.5, -0.670103, [1, 0, 0])}


def scene(kind: str = "heart", gamma: float = 100.0, elements: int = 64, length: float = 0.2, duration: float = 2.0):
    """pear, ring or heart, Γ, edges along L, L [m], duration [s]."""
    wc.checks.choice("kind", kind, tuple(KINDS))
    wc.checks.number("gamma", gamma, least=0.0)
    wc.checks.whole("elements", elements, 8)
    wc.checks.number("length", length, above=0.0)
    (turns, closing, aside), edge, bending = KINDS[kind], length / elements, 1e-6
    s = edge * (np.arange(2 * elements + 3) - 1) / 2.0  # a row of triangles, which reaches half an edge beyond L at each end
    odd, one = np.arange(len(s)) % 2, np.arange(len(s) - 2)
    mesh = wc.Mesh(
        np.stack([s, 0.0 * s, np.sqrt(0.75) * edge * odd], axis=1),
        np.stack([one, one + 1 + odd[:-2], one + 2 - odd[:-2]], axis=1),
    )
    u = np.clip((s[1:] + s[:-1] - length) / (length - edge), -1.0, 1.0)  # clamps are straight
    angle = np.pi * turns * u + closing * np.sin(np.pi * u)
    steps = 0.5 * edge * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    line = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(steps, axis=0)])
    gap = 5e-4 * length * np.array(aside) - (line[-2] - line[1])
    line += np.outer(np.interp(s, [0.5 * edge, length - 0.5 * edge], [-0.5, 0.5]), gap) - 0.5 * (line[1] + line[-2])
    return wc.Scene(
        mesh,
        density=max(gamma, 1.0) * bending / (9.81 * length**3),
        positions=line + mesh.points * [0.0, 0.0, 1.0],
        terms=[  # one row of triangles bends with 8/9 of D
            wc.Spring(stiffness=2e6 * bending / length**2),
            wc.QuadraticBending(stiffness=9 / 8 * bending, damping=1e-2 * bending),
        ],
        pins=[0, 1, 2, len(s) - 3, len(s) - 2, len(s) - 1],
        gravity=(0.0, -9.81 if gamma else 0.0, 0.0),
        free_axes=np.tile([True, True, False], (len(s), 1)),
        self_contact=wc.SelfContact(distance=5e-4 * length, stiffness=1e6),
        duration=duration,
        name="loop",
    )
