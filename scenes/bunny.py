"""A bunny, a closed surface from a stage. Keyframes move pins at its feet, head and ears: it turns its head.

The mesh, 1.6 m high, is one of Warp's example assets; the animation is a layer over the file.
"""

import os

import numpy as np
import warp.examples

import warpcloth as wc
from warpcloth.usd import read_stage_mesh


def scene(angle: float = 45.0, lift: float = 0.1, stiffness: float = 1e3, bending: float = 1.0, duration: float = 2.0):
    """Turn of the head [°], rise of the head [m], springs [N/m], plate bending stiffness [N·m], duration [s]."""
    wc.checks.number("angle", angle)
    wc.checks.number("lift", lift)
    wc.checks.number("duration", duration, above=0.0)
    stage = read_stage_mesh(os.path.join(warp.examples.get_asset_directory(), "bunny.usd"))
    mesh, fps = stage.mesh, stage.time_codes_per_second
    held = mesh.select("y < 0.1 or y > 0.95 and x < -0.45 or y > 1.2")  # the feet, the head and the ears
    neck = np.array([-0.6, 0.0, 0.2])  # a point on the axis of rotation
    x, y, z = (mesh.points[held] - neck).T
    ease = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, round(duration * fps) + 1))[:, None] * np.ones_like(y)
    turn, rise = np.radians(angle) * ease * (y > 0.5), lift * ease * (y > 0.5)
    keyframes = [x * np.cos(turn) + z * np.sin(turn), y + rise, z * np.cos(turn) - x * np.sin(turn)]
    return wc.Scene(
        mesh,
        density=1.0,
        terms=[wc.Spring(pairs="edges", stiffness=stiffness), wc.DihedralBending(stiffness=bending)],
        pins=wc.Pins(held, np.stack(keyframes, axis=-1) + neck),
        gravity=(0.0, 0.0, 0.0),
        duration=duration,
        fps=fps,
        name="bunny",
        stage=stage,
    )
