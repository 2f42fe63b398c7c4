"""What an iteration of as-rigid-as-possible deformation costs, beside libigl in the same run, on one core.

    python benchmarks/arap.py [--device cpu|cuda:0] [--dtype float64|float32] [--n 200] [--iterations 60]

A square sheet of n × n vertices, one of two opposite sides turned by 120° about the line through the middles of both. Prints a
line for each energy: ms an iteration (median, 10th to 90th percentile, of warm ones), its parts, seconds to build and to
factorise, ms an iteration of libigl (of one call that makes many, so without a spread), and how far apart both results are.
"""

# ruff: noqa: E402 - libraries read the number of threads when they are loaded
import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS"):
    os.environ[name] = "1"

import argparse
import json
import time

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.numerics.linear import constant_factor


def twisted(mesh, handles, angle=2.0 * np.pi / 3.0):
    """All points turned about the line z = 1/2 in the plane y = 0 by an angle that grows along x, and the handles' alone."""
    c, s = np.cos(angle * mesh.points[:, 0]), np.sin(angle * mesh.points[:, 0])
    z = mesh.points[:, 2] - 0.5
    points = np.stack([mesh.points[:, 0], -s * z, 0.5 + c * z], axis=1)
    return points, points[handles]


def timed(work, device):
    start = time.perf_counter()
    result = work()
    wp.synchronize_device(device)
    return 1e3 * (time.perf_counter() - start), result


def spread(work, device, count):
    low, median, high = np.percentile([timed(work, device)[0] for _ in range(count)], [10, 50, 90])
    return {"median": round(median, 3), "10_to_90": [round(low, 3), round(high, 3)]}


def of_libigl(mesh, handles, targets, start, energy, iterations):
    """(ms an iteration, ms of the precomputation, points), or None without libigl."""
    try:
        import igl
    except ImportError:
        return None
    data = igl.ARAPData()
    data.energy = getattr(igl.ARAPEnergyType, f"ARAP_ENERGY_TYPE_{energy.upper()}")
    data.max_iter = iterations
    triangles = mesh.triangles.astype(np.int64)
    built, _ = timed(lambda: igl.arap_precomputation(mesh.points, triangles, 3, handles, data), "cpu")
    solved, points = timed(lambda: igl.arap_solve(targets, data, start), "cpu")
    return solved / iterations, built, points


def measure(n, energy, device, dtype, iterations):
    mesh = wc.Mesh.grid(n, n)
    handles = mesh.select("x == 0 or x == 1")
    start, targets = twisted(mesh, handles)
    built = [timed(lambda: wc.Arap(mesh, handles, energy=energy, device=device, dtype=dtype), device) for _ in range(3)]
    arap = built[-1][1]
    free = np.delete(np.arange(len(mesh.points)), handles)
    system = arap.laplacian[free][:, free]
    factorised = [timed(lambda: constant_factor(system, arap.device, arap._scalar), device)[0] for _ in range(3)]
    found = arap.solve(targets, iterations=iterations, tolerance=0.0, initial=start)

    def iterate():
        arap._factor.solve(arap._b, arap._x_free)
        arap._fit(0)

    result = {
        "energy": energy,
        "vertices": len(mesh.points),
        "device": str(arap.device),
        "dtype": dtype,
        "factors": type(arap._factor).__name__,
        "ms_per_iteration": spread(iterate, device, iterations),
        "ms_solve": spread(lambda: arap._factor.solve(arap._b, arap._x_free), device, iterations),
        "ms_rotations_energy_and_gather": spread(arap._local, device, iterations),
        "s_build": round(1e-3 * np.median([ms for ms, _ in built]), 3),
        "s_factorise": round(1e-3 * np.median(factorised), 3),
    }
    theirs = of_libigl(mesh, handles, targets, start, energy, iterations)
    if theirs:
        result["libigl_ms_per_iteration"] = round(theirs[0], 3)
        result["libigl_s_build"] = round(1e-3 * theirs[1], 3)
        result["libigl_times_as_long"] = round(theirs[0] / result["ms_per_iteration"]["median"], 2)
        result["largest_difference_m"] = float(np.abs(theirs[2] - found.points).max())
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", default="float64", choices=("float64", "float32"))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--iterations", type=int, default=60)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    for energy in ("spokes", "spokes_and_rims"):
        print(json.dumps(measure(options.n, energy, options.device, options.dtype, options.iterations)), flush=True)


if __name__ == "__main__":
    main()
