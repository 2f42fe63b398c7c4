"""Compares the time of a frame of solvers of Newton, the physics engine, with solvers of warpcloth, alternating in one process.

    python benchmarks/compared.py      # settings with errors below 1 % on hanging with 32 × 32 vertices; about three minutes

Times are CPU times of the process, divided by those of ``Explicit``: medians over frames with their quartiles. Errors come from
`warpcloth chart work-precision hanging -p n=32 --frames 10 --with newton`.
"""

import time

import numpy as np

import warpcloth as wc
from warpcloth.others.newton_model import engine
from warpcloth.others.newton_runs import NewtonPhysics, NewtonSteps
from warpcloth.scenes import hanging

OURS = {
    "Explicit, 107 substeps": wc.Explicit(substeps=107),
    "XPBD, BDF2, 10 substeps, 4 sweeps": wc.XPBD(substeps=10, iterations=4, integrator="bdf2"),
}
OTHERS = {
    "newton-semi-implicit, 107 substeps": NewtonPhysics("semi-implicit", 107),
    "newton-xpbd, 160 substeps, 1 iteration": NewtonPhysics("xpbd", 160),
    "newton-style3d, 16 substeps, 10 iterations": NewtonPhysics("style3d", 16, 10),
    "newton-vbd, 8 substeps, 5 iterations": NewtonPhysics("vbd", 8, 5),
}
FRAMES = 10


def main():
    scene = hanging.scene(n=32)
    runs = {name: record.bind(scene.build()) for name, record in OURS.items()}
    runs |= {name: NewtonSteps(scene, record, "cpu") for name, record in OTHERS.items()}
    times = {name: [] for name in runs}
    for _ in range(FRAMES):
        for name, run in runs.items():
            began = time.process_time()
            run.frame()
            times[name].append(time.process_time() - began)
    first = np.array(next(iter(times.values())))[1:]
    print(f"hanging, 32 × 32 vertices, CPU, Newton {engine().__version__}")
    for name, spent in times.items():
        low, middle, high = np.percentile(np.array(spent)[1:] / first, [25, 50, 75])
        print(f"  {name:<44} {middle:8.2f}  ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
