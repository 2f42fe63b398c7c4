"""The filter of self-contact leaves cloth free that falls together."""

import numpy as np
import pytest

import warpcloth as wc

FPS = 48  # a step is a frame
SOLVERS = {"newton": wc.Newton(substeps=1), "xpbd": wc.XPBD(substeps=1, iterations=30)}


@pytest.mark.parametrize("name", SOLVERS)
def test_a_stack_falls_freely(name, device):
    """Sheets that fall together at their contact distance, with a pinned piece far away, move as without the filter."""
    grid, layers, h = wc.Mesh.grid(5, 5, size=0.2, pattern="alternating"), 3, 1 / FPS
    parts = {f"sheet_{i}": wc.Mesh(np.add(grid.points, [0.0, 2e-3 * i, 0.0]), grid.triangles) for i in range(layers)}
    parts["pinned"] = wc.Mesh([[5.0, 0.0, 0.0], [5.1, 0.0, 0.0], [5.0, 0.0, 0.1]], [[0, 1, 2]])
    scene = wc.Scene(
        wc.Mesh.join(parts),
        density=0.15,
        velocities=np.vstack([np.tile([0.0, -3.0, 0.0], (75, 1)), np.zeros((3, 3))]),
        terms=[wc.Spring(pairs="edges", stiffness=100.0)],
        pins=[75, 76, 77],
        self_contact=wc.SelfContact(distance=2e-3),
        duration=8 * h,
        fps=FPS,
    )
    found = wc.simulate(scene, SOLVERS[name], device=device, dtype="float64")
    fall = 3.0 * 8 * h + 9.81 * h**2 * 8 * 9 / 2  # implicit Euler
    assert found.cut == 0.0
    assert found.points[0, :75, 1] - found.points[-1, :75, 1] == pytest.approx(fall, abs=1e-6)
