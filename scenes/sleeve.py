"""A lining that is pulled out of a sleeve: two tubes. The inner one has a larger rest radius than fits."""

import numpy as np

import warpcloth as wc


def scene(
    around: int = 32,
    along: int = 24,
    radius: float = 0.05,
    length: float = 0.3,
    wider: float = 0.03,
    pull: float = 0.2,
    duration: float = 2.0,
):
    """Edges around and along, radius and length [m], relative excess of the lining's radius, pull [m], duration [s]."""
    wc.checks.whole("around", around, 4)
    wc.checks.whole("along", along, 2)
    for name, value in {"radius": radius, "length": length, "duration": duration}.items():
        wc.checks.number(name, value, above=0.0)
    wc.checks.number("wider", wider, least=0.0)
    wc.checks.number("pull", pull)
    fps, distance, grid = 50.0, 2e-3, wc.Mesh.grid(around + 1, along + 1, pattern="alternating")
    row, column = np.divmod(np.arange((around + 1) * (along + 1)), around + 1)
    triangles = (row * around + column % around)[grid.triangles]  # the last column is the first
    row, column = np.divmod(np.arange(around * (along + 1)), around)
    angle = 2.0 * np.pi * column / around

    def tube(radius, turn=0.0):
        return np.stack([length * row / along, radius * np.cos(angle + turn), radius * np.sin(angle + turn)], axis=1)

    shrunk = tube(radius - distance, np.pi / around)
    mesh = wc.Mesh.join({"sleeve": wc.Mesh(tube(radius), triangles), "lining": wc.Mesh(tube((1 + wider) * radius), triangles)})
    count = len(row)
    positions = np.concatenate([tube(radius), shrunk])
    held = np.concatenate([np.flatnonzero(row == 0), count + np.flatnonzero(row == along)])
    keyframes = np.tile(positions[held], (round(duration * fps) + 1, 1, 1))
    keyframes[:, around:, 0] += pull * np.clip(1.25 * np.arange(len(keyframes)) / (len(keyframes) - 1), 0.0, 1.0)[:, None]
    return wc.Scene(
        mesh,
        density=0.15,
        positions=positions,
        terms=[wc.Spring(pairs="edges", stiffness=200.0, damping=0.02), wc.QuadraticBending(stiffness=1e-5)],
        pins=wc.Pins(held, keyframes),
        gravity=(0.0, 0.0, 0.0),
        self_contact=wc.SelfContact(distance=distance, stiffness=1e5),
        duration=duration,
        fps=fps,
        name="sleeve",
    )
