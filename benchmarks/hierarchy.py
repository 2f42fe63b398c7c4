"""How fast hierarchical PBD and plain PBD meet hard springs in one step: residual against time, for a list of states.

    python benchmarks/hierarchy.py [--device cpu|cuda:0] [--n 256] [STATE …]
    python benchmarks/hierarchy.py nets

The cloth is ``hanging`` with n² vertices and hard springs, the step 1/240 s. Prints a line for each state and setup:
ms of the step (least of three), RMS and largest |l/L − 1| of the springs after it, RMS of the stretch alone, max(l/L − 1, 0).
Shear and structural springs both hard let a sheet fold along straight lines only, so that 0 is out of reach.

With ``nets``, a square of 1 m and 0.15 kg/m² with 25² vertices and hard springs on its edges, flat at first, swings for a
second by two corners, in float64: 4 substeps of 5 and of 20 sweeps a frame. Its vertices are a grid, a grid whose inner
vertices are moved by up to 0.3 edges along each axis, or random points, the latter two with Delaunay's triangles. Prints the
RMS of l/L − 1 over all springs and 60 frames for PBD and with levels, their ratio, and that of the times of a frame.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial import Delaunay

import warpcloth as wc
from warpcloth.scenes import hanging


def hard(n):
    """The hanging cloth with hard springs, without bending."""
    declared = hanging.scene(n=n)
    return replace(declared, terms=[replace(declared.terms[0], stiffness=np.inf)])


def stretched(n, device):
    """Hung straight down, half as long again, at rest."""
    declared = hard(n)
    return replace(declared, positions=declared.mesh.points[:, [0, 2, 1]] * [1.0, -1.5, 1.0])


def fallen(solver):
    """The state after 20 frames of a solver."""

    def state(n, device):
        declared = hard(n)
        past = wc.simulate(declared if isinstance(solver, wc.PBD) else hanging.scene(n=n), solver, device=device, frames=20)
        return replace(declared, positions=past.points[-1], velocities=past.velocities[-1])

    return state


STATES = {
    "stretched": stretched,
    "fallen-pbd": fallen(wc.PBD(substeps=4, iterations=20)),
    "fallen-newton": fallen(wc.Newton(substeps=4)),  # near the constraints already; for n up to 64 or so
}
SETUPS = [wc.PBD(substeps=4, iterations=n) for n in (1, 5, 20, 80, 320, 1280)]
SETUPS += [wc.HierarchicalPBD(substeps=4, iterations=n, coarse_iterations=m) for n, m in ((1, 1), (1, 5), (5, 5), (20, 5))]
SETUPS += [wc.HierarchicalPBD(substeps=4, iterations=n, coarse_iterations=20) for n in (5, 20, 80)]


def measure(scene, options, device):
    """Time of a step and what it leaves."""
    stepper = options.bind(scene.build(device=device))
    start = stepper.state.copy()
    times = []
    for _ in range(3):
        stepper.state.assign(start)
        wp.synchronize()
        began = time.perf_counter()
        stepper.step()
        wp.synchronize()
        times.append(time.perf_counter() - began)
    pairs, points = scene.terms[0].stencil(scene.mesh), stepper.state.x.numpy().astype(np.float64)
    now, rest = (np.linalg.norm(p[pairs[:, 1]] - p[pairs[:, 0]], axis=1) for p in (points, scene.mesh.points))
    strain = now / rest - 1.0
    return {
        "ms": round(1e3 * min(times), 2),
        "rms": float(f"{np.sqrt(np.mean(strain**2)):.3g}"),
        "rms_stretch": float(f"{np.sqrt(np.mean(np.maximum(strain, 0.0) ** 2)):.3g}"),
        "largest": float(f"{np.abs(strain).max():.3g}"),
    }


def nets(n=25):
    """Square meshes by name, with n vertices along each side."""
    grid, random = wc.Mesh.grid(n, n), np.random.default_rng(0)
    points = grid.points[:, [0, 2]]
    inside = np.all((points > points.min(axis=0) + 1e-9) & (points < points.max(axis=0) - 1e-9), axis=1)[:, None]
    corner, size = points.min(axis=0), np.ptp(points, axis=0)
    moved = points + 0.3 / (n - 1) * inside * random.uniform(-1.0, 1.0, points.shape)
    anywhere = np.where(inside, corner + size * random.uniform(0.5 / n, 1.0 - 0.5 / n, points.shape), points)
    found = {"grid": grid}
    for name, xz in {"jittered": moved, "random": anywhere}.items():
        found[name] = wc.Mesh(np.stack([xz[:, 0], 0.0 * xz[:, 0], xz[:, 1]], axis=1), Delaunay(xz).simplices)
    return found


def swing(mesh, options, device):
    """RMS strain over a second, and the median time of a frame [ms]."""
    corners = [0, int(np.argmax(mesh.points @ [1.0, 0.0, -1.0]))]
    scene = wc.Scene(mesh, density=0.15, terms=[wc.Spring(stiffness=np.inf)], pins=corners, duration=1.0, fps=60)
    animation = wc.simulate(scene, options, device=device, dtype="float64")
    a, b = scene.terms[0].stencil(mesh).T
    lengths = np.linalg.norm(animation.points[1:, a] - animation.points[1:, b], axis=-1)
    strain = lengths / np.linalg.norm(mesh.points[a] - mesh.points[b], axis=1) - 1.0
    return float(np.sqrt(np.mean(strain**2))), 1e3 * float(np.median(animation.timings["frames"]))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("states", nargs="*", choices=[[], *STATES, "nets"], help="stretched and fallen-pbd if none")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--n", type=int, default=256)
    options = parser.parse_args()
    for name, mesh in nets().items() if "nets" in options.states else ():
        for sweeps in (5, 20):
            given = {"substeps": 4, "iterations": sweeps}
            plain, levels = (swing(mesh, each(**given), options.device) for each in (wc.PBD, wc.HierarchicalPBD))
            row = {"net": name, "sweeps": sweeps, "pbd": plain[0], "levels": levels[0], "gain": plain[0] / levels[0]}
            print(json.dumps(row | {"time": levels[1] / plain[1]}), flush=True)
    for name in [each for each in options.states if each != "nets"] or ([] if options.states else ["stretched", "fallen-pbd"]):
        scene = STATES[name](options.n, options.device)
        for setup in SETUPS:
            sweeps = {"iterations": setup.iterations, "coarse": getattr(setup, "coarse_iterations", None)}
            row = {"state": name, "solver": type(setup).__name__, **sweeps, **measure(scene, setup, options.device)}
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
