"""What explicit steps of the springs of ``hanging`` cost, and how far they stray from a finer run in double precision.

    python benchmarks/accuracy.py [--device cpu|cuda:0] [--n 64 128 …] [--finer 4]

One second of n² vertices in steps 1 % below the limit about the rest shape, in float32 and float64, against ``finer`` times as
many in float64. Prints a line for each: ms of a frame (median and quartiles of the second, points read apart), the largest
distance of centres of mass and the RMS distance of vertices, over all frames [% of the side], and the 99th percentile of the
difference of the strains of springs [percentage points].
"""

import argparse
import time
import warnings
from dataclasses import replace
from math import ceil

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.scenes import hanging
from warpcloth.solvers.explicit import step_limits


def run(scene, substeps, device, dtype):
    """The places of all frames (frames, n², 3) [m] in double precision, and what each frame took [ms]."""
    stepper = wc.Explicit(substeps=substeps).bind(scene.build(device=device, dtype=dtype))
    places, times = [], []
    for _ in range(scene.frames):
        wp.synchronize_device(device)
        began = time.perf_counter()
        stepper.frame()
        wp.synchronize_device(device)
        times.append(1e3 * (time.perf_counter() - began))
        places.append(stepper.state.x.numpy().astype(np.float64))
    return np.array(places), times


def strayed(scene, places, exact):
    """Centre, RMS and strain, as they are printed."""
    pairs = scene.terms[0].stencil(scene.mesh)
    rest = np.linalg.norm(np.subtract(*scene.mesh.points[pairs].swapaxes(0, 1)), axis=1)
    strains = [[np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) / rest for x in run[::4]] for run in (places, exact)]
    centre = np.linalg.norm(places.mean(axis=1) - exact.mean(axis=1), axis=1).max()
    rms = np.sqrt(((places - exact) ** 2).sum(axis=2).mean())
    return 100.0 * np.array([centre, rms, np.percentile(np.abs(np.subtract(*strains)), 99.0)])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--n", type=int, nargs="+", default=[64], help="vertices of a side")
    parser.add_argument("--finer", type=int, default=4)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # that it is above the bound in motion
    for n in arguments.n:
        scene = hanging.scene(n=n)
        scene = replace(scene, terms=scene.terms[:1])
        rest, _motion = step_limits(scene.build())
        substeps = ceil(1.01 / (scene.fps * rest))
        exact, _times = run(scene, arguments.finer * substeps, arguments.device, "float64")
        for dtype in ("float32", "float64"):
            places, times = run(scene, substeps, arguments.device, dtype)
            low, median, high = np.percentile(times, [25.0, 50.0, 75.0])
            centre, rms, strain = strayed(scene, places, exact)
            print(
                f"n = {n}, {substeps} steps, {dtype}: {median:.3g} ms ({low:.3g} to {high:.3g}), centre {centre:.2f} %, "
                f"RMS {rms:.2f} %, strain {strain:.2f} points",
                flush=True,
            )


if __name__ == "__main__":
    main()
