"""What float64 costs on the CPU: each solver at its setting of `warpcloth bench`, in both precisions in turn.

    python benchmarks/precision.py [--scene hanging drape] [--solvers newton …] [--n 16 32 64] [--frames 40] [--seconds 60]

The scenes are ``hanging``, and ``drape`` with a corotated membrane in place of its springs. Both precisions run the scene side
by side, a frame of each in turn, on one thread. Frames before ``--from`` are not timed; in ``drape`` the cloth touches the ball
in frame 5. Prints a line for each solver and size: ms of a frame in float32 and float64 (means of the processor time), their
ratio, and the quartiles of the ratio frame by frame.
"""

import argparse
import time
import warnings
from dataclasses import replace

import numpy as np

import warpcloth as wc
from warpcloth.scenes import drape, hanging
from warpcloth.solvers import SOLVERS
from warpcloth.solvers.step import fewest_substeps

PRECISIONS = ("float32", "float64")


def scene_of(name, n):
    """Returns the scene with n² vertices."""
    if name == "hanging":
        return hanging.scene(n=n)
    scene = drape.scene(n=n, friction=0.0)  # PBD takes no friction
    springs, *others = scene.terms
    return replace(scene, terms=[wc.CorotatedMembrane(stiffness=springs.stiffness), *others])


def times_of(scene, name, first, frames, seconds):
    """Returns the processor time of each frame in float32 and float64, (frames, 2) [s], and the steps of a frame."""
    record = SOLVERS[name]
    options = record.facts.benchmarks[0].options
    if record.limited:
        options = options | {"substeps": fewest_substeps(scene.fps, *record.step_limits(scene.build(dtype="float64")))}
    solver = record(**options)
    steppers = [solver.bind(scene.build(dtype=dtype)) for dtype in PRECISIONS]
    times, began = [], time.perf_counter()
    for frame in range(first + frames):
        of_frame = [0.0, 0.0]
        for i in (0, 1) if frame % 2 else (1, 0):
            start = time.process_time()
            steppers[i].frame()
            of_frame[i] = time.process_time() - start
        if frame == first:
            began = time.perf_counter()
        if frame >= first:
            times.append(of_frame)
        if len(times) >= 5 and time.perf_counter() - began > seconds:
            break
    return np.array(times), solver.per_frame(scene.fps)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", choices=("hanging", "drape"), default=["hanging", "drape"])
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--n", type=int, nargs="+", default=[16, 32, 64], help="vertices of a side")
    parser.add_argument("--from", dest="first", type=int, default=8, help="the first frame that is timed")
    parser.add_argument("--frames", type=int, default=40, help="maximum number of timed frames")
    parser.add_argument("--seconds", type=float, default=60.0, help="no frame begins later than this; at least 5 are timed")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # that a step is above the bound in motion
    for name in arguments.scene:
        for solver in arguments.solvers:
            for n in arguments.n:
                given = arguments.first, arguments.frames, arguments.seconds
                times, steps = times_of(scene_of(name, n), solver, *given)
                single, double = 1e3 * np.mean(times, axis=0)
                low, high = np.percentile(times[:, 1] / times[:, 0], [25.0, 75.0])
                print(
                    f"{name} {n}², {solver}, {steps} steps: {single:.3g} and {double:.3g} ms, "
                    f"ratio {double / single:.2f} ({low:.2f} to {high:.2f}), {len(times)} frames",
                    flush=True,
                )


if __name__ == "__main__":
    main()
