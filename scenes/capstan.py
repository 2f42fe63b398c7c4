"""A belt that is pulled over a fixed drum against a load: it slides when the pull is exp(μφ) times the load.

Where the belt turns by Δ, the tension ahead is at most (1 + μ tan Δ/2)/(1 − μ tan Δ/2) times that behind; the pull is at most
the load times that to the power ``turns``, the edges around the drum. A tension T presses with T over the radius of the
mid-surface. The belt has no weight, and starts at rest under the load.
"""

import numpy as np

import warpcloth as wc


def scene(
    friction: float = 0.3,
    angle: float = 180.0,
    turns: int = 16,
    load: float = 20.0,
    speed: float = 0.1,
    stretching: float = 5e3,
    distance: float = 1e-3,
    duration: float = 1.0,
):
    """Friction, wrap [°], edges around the drum, load [N/m], speed [m/s], EA/width [N/m], contact distance [m], time [s]."""
    for name, value in {"angle": angle, "load": load, "stretching": stretching, "distance": distance}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.number("friction", friction, least=0.0)
    wc.checks.number("duration", duration, above=0.0)
    wc.checks.whole("turns", turns, 2)
    fps, radius, width = 60.0, 0.1, 0.05
    turn, most = np.radians(angle) / turns, np.exp(friction * np.radians(angle))
    contact = wc.Contact(distance=distance, stiffness=10.0 * most * load / (radius * distance))
    outer = radius + distance * (1.0 - 0.1 / most)  # radius of the belt under the load
    edge = 2.0 * outer * np.sin(0.5 * turn)
    straight = int(np.ceil(0.2 / edge))  # edges on each side of the drum
    edges = turns - 1 + 2 * straight
    directions = -turn * np.clip(np.arange(edges) - 0.5 * (edges - 1), -0.5 * turns, 0.5 * turns)
    steps = edge * np.stack([np.cos(directions), 0.0 * directions, -np.sin(directions)], axis=1)
    line = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(steps, axis=0)])
    first = 0.5 * turn * (turns - 1)  # angle of the first vertex on the drum from the middle
    line += outer * np.array([-np.sin(first), 0.0, -np.cos(first)]) - line[straight]
    positions = np.concatenate([line, line]) + np.repeat([[0.0, 0.5 * width, 0.0], [0.0, 1.5 * width, 0.0]], edges + 1, axis=0)
    rest = edge / (1.0 + load / stretching)
    behind, ahead = np.array([[0, edges + 1], [edges, 2 * edges + 1]])
    times = np.arange(round(duration * fps) + 1) / fps
    pull = speed * np.where(times < 0.1, 5.0 * times**2, times - 0.05)  # the speed increases for 0.1 s
    return wc.Scene(
        wc.Mesh.grid(edges + 1, 2, size=(edges * rest, width)),
        density=0.15,
        positions=positions,
        terms=[
            wc.Spring(pairs="structural", stiffness=0.5 * width * stretching / rest, damping=0.5),
            wc.QuadraticBending(stiffness=1e-6, damping=2e-6),  # the only damping of contact in explicit steps
        ],
        pins=wc.Pins(ahead, positions[ahead] + pull[:, None, None] * steps[-1] / edge),
        loads=[wc.Force(vertices=behind, force=-0.5 * width * load * steps[0] / edge)],
        free_axes=np.tile([True, False, True], (len(positions), 1)),
        colliders=[wc.Capsule(radius=radius, length=2.0 * width, position=(0.0, width, 0.0), friction=friction, name="drum")],
        contact=contact,
        duration=duration,
        fps=fps,
        name="capstan",
    )
