"""A strip of cloth, wound loosely on a cylinder that turns and pulls it tight by its inner end; its outer end is held.

The layers lie on a spiral of Archimedes. With 50 layers and a width of 0.25 m the strip has 250 000 vertices.
"""

import numpy as np

import warpcloth as wc


def scene(
    layers: int = 4,
    width: float = 0.05,
    edge: float = 7e-3,
    radius: float = 0.1,
    gap: float = 2e-3,
    distance: float = 1e-3,
    friction: float = 0.1,
    speed: float = 1.0,
    stiffness: float = 300.0,
    duration: float = 1.0,
):
    """Layers, width, edges, cylinder and gap of layers [m], contact [m], friction, turns [1/s], springs [N/m], duration [s]."""
    wc.checks.whole("layers", layers, 1)
    lengths = {"width": width, "edge": edge, "radius": radius, "gap": gap, "distance": distance, "duration": duration}
    for name, value in lengths.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.number("speed", speed)
    fps, begin = 600.0, 0.1
    angle = np.linspace(0.0, 2.0 * np.pi * layers, 1000 * layers + 1)

    def spiral(angle):
        return (radius + gap * (0.5 + angle / (2.0 * np.pi)))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spiral(angle), axis=0), axis=1))])
    along, across = (max(round(each / edge), 1) for each in (length[-1], width))
    line = spiral(np.interp(np.linspace(0.0, length[-1], along + 1), length, angle))
    strip = wc.Mesh.grid(
        along + 1, across + 1, size=(np.linalg.norm(np.diff(line, axis=0), axis=1).sum(), width), pattern="alternating"
    )
    row, column = np.divmod(np.arange(len(strip.points)), along + 1)
    points = np.column_stack([line[column], width * (row / across - 0.5)])
    times = np.arange(round(duration * fps) + 1) / fps
    turned = -2.0 * np.pi * speed * np.where(times < begin, 0.5 * times**2 / begin, times - 0.5 * begin)
    ends = [np.flatnonzero(column == end) for end in (0, along)]
    x, y, z = points[ends[0]].T
    c, s = np.cos(turned)[:, None], np.sin(turned)[:, None]
    inner = np.stack([c * x - s * y, s * x + c * y, z + 0.0 * c], axis=2)
    outer = np.broadcast_to(points[ends[1]], (len(times), len(ends[1]), 3))
    c, s = np.sqrt(0.5) * np.cos(0.5 * turned), np.sqrt(0.5) * np.sin(0.5 * turned)  # from the axis y to z, then about z
    return wc.Scene(
        strip,
        density=0.15,
        positions=points,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=stiffness), wc.QuadraticBending(stiffness=1e-5)],
        pins=wc.Pins(np.concatenate(ends), np.concatenate([inner, outer], axis=1)),
        colliders=[
            wc.Capsule(
                radius=radius,
                length=2.0 * width,
                rotation=np.stack([c, s, s, c], axis=1),
                friction=friction,
                name="cylinder",
            )
        ],
        contact=wc.Contact(distance=distance),
        self_contact=wc.SelfContact(distance=distance, friction=friction, held_pins="allow"),
        duration=duration,
        fps=fps,
        name="winding",
    )
