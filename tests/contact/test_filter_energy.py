"""The filters of contact add no energy, and leave cloth free that falls together."""

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but

FPS = 48  # a step of most solvers is a frame
SOLVERS = {  # PBD and HierarchicalPBD stretch springs in steps without cuts too, and do not bound that
    "explicit": wc.Explicit(substeps=60),
    "newton": wc.Newton(substeps=1),
    "xpbd": wc.XPBD(substeps=1, iterations=30),
    "xpbd_300": wc.XPBD(substeps=1, iterations=300),
    "xpbd_jacobi": wc.XPBD(substeps=1, iterations=1000, sweep="constraint-averaged"),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=1, iterations=100),
    "admm": wc.ADMM(substeps=1, iterations=100),
    "constrained_dynamics": wc.ConstrainedDynamics(substeps=1, iterations=20),
}
each_solver = pytest.mark.parametrize("name", slow_but(("xpbd", "explicit"), SOLVERS))


def rotation(angle, axis):
    """Returns the matrix of a rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    turn = np.eye(3)
    turn[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return turn


def largest_gain(scene, solver, device):
    """Returns by how much the energy of a run in float64 ever exceeds that of the start, over the largest that is kinetic."""
    found = wc.simulate(scene, solver, device=device, dtype="float64", record="energies")
    total = sum(each for name, each in found.energies.items() if not name.startswith(("work", "heat")))
    return (total - total[0]).max() / found.energies["kinetic"].max(), found


@each_solver
def test_two_sheets_meet(name, device):
    """At 3 m/s, without gravity, a sheet flies by more than its edges in a step onto another one, turned and tilted."""
    grid = wc.Mesh.grid(9, 9, size=0.3, pattern="alternating")
    below = grid.points - [0.15, 0.0, 0.15]
    above = below @ rotation(-0.6, 1).T @ rotation(0.25, 2).T + [0.03, 0.06, 0.02]
    mesh = wc.Mesh.join({"below": wc.Mesh(below, grid.triangles), "above": wc.Mesh(above, grid.triangles)})
    v = np.zeros((162, 3))
    v[81:] = 0.4, -3.0, 0.2
    scene = wc.Scene(
        mesh,
        density=0.15,
        velocities=v,
        terms=[wc.Spring(pairs="edges", stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        pins=[0, 8],
        gravity=(0.0, 0.0, 0.0),
        self_contact=wc.SelfContact(distance=2e-3, stiffness=2e4),
        duration=16 / FPS,
        fps=FPS,
    )
    gain, found = largest_gain(scene, SOLVERS[name], device)
    assert gain < 1e-6, gain
    assert not any(map(len, wc.intersections(found.points, mesh.triangles).pairs))


@each_solver
def test_a_sheet_falls_on_a_cone(name, device):
    """Triangles of a sheet that no vertex holds hang on the point of a cone, held by the filter alone where they fold."""
    around = np.arange(10) * np.pi / 5.0
    ring = np.stack([0.1 * np.cos(around), 0.0 * around - 0.2, 0.1 * np.sin(around)], axis=1)
    triangles = [t for i in range(10) for t in ([11, (i + 1) % 10, i], [10, i, (i + 1) % 10])]
    cone = wc.MeshCollider(np.vstack([ring, [[0.0, -0.2, 0.0], [0.0, 0.1, 0.0]]]), np.array(triangles))
    grid = wc.Mesh.grid(9, 9, size=0.4, pattern="alternating")
    flat = grid.points - [0.2, 0.0, 0.2]
    scene = wc.Scene(
        wc.Mesh(flat, grid.triangles),
        density=0.15,
        positions=flat @ rotation(np.radians(15.0), 2).T + [0.02, 0.15, 0.013],
        velocities=np.tile([0.0, -1.0, 0.0], (81, 1)),
        terms=[wc.Spring(pairs="edges", stiffness=300.0)],
        colliders=[cone],
        contact=wc.Contact(distance=5e-3, stiffness=10.0 * 0.15 * 9.81 / 5e-3, elements="triangles"),
        duration=16 / FPS,
        fps=FPS,
    )
    gain, _found = largest_gain(scene, SOLVERS[name], device)
    assert gain < 1e-6, gain


@pytest.mark.parametrize("name", ["newton", "xpbd"])
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
