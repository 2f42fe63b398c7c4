"""What a frame costs: medians of warm frames, with their spread, for a list of scenes and setups.

    python benchmarks/cost.py [--device cpu|cuda:0] [--frames 30] [NAME …]

Prints a line for each setup: ms a frame (median, 10th to 90th percentile), ns an element and substep of the springs, seconds
until bound with the kernel cache as it is, and until the first frame.
"""

import argparse
import json
import time
import warnings
from dataclasses import replace

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.scenes import hanging
from warpcloth.solvers.explicit import step_limits


def springs_only(n):
    """The hanging cloth without bending."""
    declared = hanging.scene(n=n)
    return replace(declared, terms=declared.terms[:1], name=f"hanging {n}², springs only")


def with_bending(n):
    return replace(hanging.scene(n=n), name=f"hanging {n}²")


def fewest_substeps(scene, device, dtype):
    rest, _ = step_limits(scene.build(device=device, dtype=dtype))
    return int(1.0 / (scene.fps * rest)) + 1


# (name, scene, dtype, solver or a function of the fewest stable substeps that makes one)
SETUPS = [
    ("explicit-fewest", springs_only(64), "float32", lambda fewest: wc.Explicit(substeps=fewest)),
    ("explicit-fewest", springs_only(64), "float64", lambda fewest: wc.Explicit(substeps=fewest)),
    ("explicit-256", springs_only(64), "float32", wc.Explicit(substeps=256)),
    ("explicit-256", springs_only(64), "float64", wc.Explicit(substeps=256)),
    ("explicit-256", with_bending(64), "float32", wc.Explicit(substeps=256)),
    ("newton-4", with_bending(64), "float32", wc.Newton(substeps=4)),
    ("newton-4", with_bending(64), "float64", wc.Newton(substeps=4)),
    ("newton-4-factorised", with_bending(64), "float64", wc.Newton(substeps=4, linear="factorised")),
    ("pbd-4x20", with_bending(64), "float32", wc.PBD(substeps=4, iterations=20)),
    ("large-explicit", springs_only(512), "float32", lambda fewest: wc.Explicit(substeps=fewest)),
    ("large-newton-4", with_bending(512), "float32", wc.Newton(substeps=4)),
    ("large-pbd-4x20", with_bending(512), "float32", wc.PBD(substeps=4, iterations=20)),
]


def measure(name, scene, dtype, solver, device, frames):
    start = time.perf_counter()
    if callable(solver):
        solver = solver(fewest_substeps(scene, device, dtype))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stepper = solver.bind(scene.build(device=device, dtype=dtype))
    bound = time.perf_counter() - start
    times = []
    for frame in range(frames + 3):
        began = time.perf_counter()
        for _ in range(stepper.steps_per_frame):
            stepper.step()
        stepper.state.x.numpy()
        times.append(time.perf_counter() - began)
        if frame == 0:
            first = time.perf_counter() - start
    times = np.array(times[3:])
    springs = len(scene.terms[0].stencil(scene.mesh))
    low, median, high = np.percentile(times, [10, 50, 90])
    return {
        "name": name,
        "scene": scene.name,
        "dtype": dtype,
        "device": str(wp.get_device(device)),
        "substeps": stepper.steps_per_frame,
        "ms_per_frame": round(1e3 * median, 3),
        "ms_10_to_90": [round(1e3 * low, 3), round(1e3 * high, 3)],
        "ns_per_spring_substep": round(1e9 * median / springs / stepper.steps_per_frame, 3),
        "bind_s": round(bound, 2),
        "first_frame_s": round(first, 2),
        "result": ", ".join(sorted({result.value for result in stepper.results})),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="setups to run, all but the large ones if none")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=30)
    options = parser.parse_args()
    for name, *setup in SETUPS:
        if name in options.names or not (options.names or name.startswith("large")):
            print(json.dumps(measure(name, *setup, options.device, options.frames)), flush=True)


if __name__ == "__main__":
    main()
