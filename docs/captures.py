"""Makes the picture of docs/captures.md from a synthetic capture: python docs/captures.py"""

from pathlib import Path

import numpy as np

import warpcloth as wc
from warpcloth.lab.scans import scan
from warpcloth.scenes import hanging

DOCS = Path(__file__).parent


def picture(n=16, frame=16, spacing=0.05):
    """A frame of a capture, and beside it the resampled mesh in the colours of its distance [mm] from the true positions."""
    scene = hanging.scene(n=n)
    animation = wc.simulate(scene, wc.Newton(substeps=4), frames=frame, dtype="float64")
    true = np.array(animation.points)
    seen = scan(scene.mesh, true, 1 / scene.fps, spacing, noise=1e-3, holes=0.1)
    found = wc.resample(seen, scene.mesh, scene.positions, wc.Pins(scene.pins.vertices))
    errors = 1e3 * np.linalg.norm(found.points[-1] - true[-1], axis=1)
    capture = seen[frame]
    beside = found.points[-1] + np.array([1.25, 0.0, 0.0])
    mesh = wc.Mesh(
        np.concatenate([capture.points, beside]),
        np.concatenate([capture.triangles, scene.mesh.triangles + len(capture.points)]),
    )
    colour = {"error [mm]": np.concatenate([np.full(len(capture.points), np.nan), errors])[None]}
    wc.render(
        mesh, DOCS / "captures.png", size=(800, 380), samples=16, azimuth=-20.0, elevation=12.0, colour=colour, ground=False
    )


if __name__ == "__main__":
    picture()
