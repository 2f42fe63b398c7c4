"""A square cloth on a funnel, which is pulled through the spout by its middle."""

import numpy as np

import warpcloth as wc


def scene(
    n: int = 33,
    size: float = 0.6,
    spout: float = 0.06,
    pull: float = 0.5,
    friction: float = 0.2,
    duration: float = 3.0,
):
    """Vertices per side, side, spout radius, displacement of the middle [m], friction, duration [s]."""
    wc.checks.whole("n", n, 3)
    for name, value in {"size": size, "spout": spout, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.number("pull", pull)
    wc.checks.number("friction", friction, least=0.0)
    fps, around, distance = 25.0, 48, 3e-3
    # Radii and heights of the rings of the funnel, from the rim of the cone to the end of the spout.
    radii = np.array([0.6 * size, spout, spout])
    heights = np.array([0.0, 0.5 * (spout - 0.6 * size), 0.5 * (spout - 0.6 * size) - 0.2 * size])
    angle = 2.0 * np.pi * np.arange(around) / around
    rings = [
        np.stack([r * np.cos(angle), y + 0.0 * angle, r * np.sin(angle)], axis=1) for r, y in zip(radii, heights, strict=True)
    ]
    one = np.arange(around)
    after = np.roll(one, -1)
    band = np.concatenate(
        [np.stack([one, after, one + around], axis=1), np.stack([after, after + around, one + around], axis=1)]
    )
    grid = wc.Mesh.grid(n, n, size=size, pattern="alternating")
    positions = grid.points - 0.5 * size * np.array([1.0, 0.0, 1.0]) + [0.0, 0.01, 0.0]
    middle = np.flatnonzero(np.linalg.norm(positions[:, [0, 2]], axis=1) < 0.5 * spout)
    times = np.arange(round(duration * fps) + 1) / fps
    way = pull * np.minimum(times / (0.9 * duration), 1.0)
    keyframes = positions[middle] - np.multiply.outer(way, [0.0, 1.0, 0.0])[:, None]
    return wc.Scene(
        grid,
        density=0.15,
        positions=positions,
        terms=[
            wc.Spring(pairs=("structural", "shear"), stiffness=300.0, damping=0.03),
            wc.QuadraticBending(stiffness=1e-5),
        ],
        pins=wc.Pins(middle, keyframes),
        colliders=[
            wc.MeshCollider(np.concatenate(rings), np.concatenate([band, band + around]), friction=friction, name="funnel")
        ],
        contact=wc.Contact(distance=distance),
        self_contact=wc.SelfContact(distance=distance),
        duration=duration,
        fps=fps,
        name="funnel",
    )
