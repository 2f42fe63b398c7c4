"""The cost of grading a run: the time of the errors of steps and of the balance of energy, over that of the frames.

    python benchmarks/grades.py [--device cpu|cuda:0] [--sizes 32 64 128] [--frames 60] [--scene hanging]

Each solver takes its setting of ``warpcloth bench``. The first run compiles kernels and is not counted. Prints, in per cent of
the time of the frames, the errors of steps, the energies and strains that were checked before grades existed, and all that
follows a frame; then the milliseconds of a frame.
"""

import argparse
import time

import warp as wp

from warpcloth.run.frames_ahead import Frame, state_of
from warpcloth.run.scene_files import find_source
from warpcloth.run.watch import Watch
from warpcloth.solvers import SOLVERS


def measure(scene, solver, device, frames, dtype):
    """Returns the seconds of the frames, of the errors of steps and of all checks."""
    stepper = solver.bind(model := scene.build(device=device, dtype=dtype))
    watch, seconds = Watch(model, stepper), [0.0, 0.0, 0.0]
    for number in range(1, frames + 1):
        times = [time.perf_counter()]
        stepper.frame()
        wp.synchronize_device(device)
        times.append(time.perf_counter())
        error = watch.grades.errors.find()
        wp.synchronize_device(device)
        times.append(time.perf_counter())
        points, velocities = state_of(stepper)
        began = time.perf_counter()
        watch.passes(number, Frame(points, velocities, stepper.results, stepper.residual, 0.0, error))
        seconds[0] += times[1] - times[0]
        seconds[1] += times[2] - times[1]
        seconds[2] += time.perf_counter() - began
    return seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--scene", default="hanging")
    arguments = parser.parse_args()
    source = find_source(arguments.scene)
    for name, record in SOLVERS.items():
        options = record.facts.benchmarks[0].options
        for n in arguments.sizes:
            scene = source.scene(source.values({"n": str(n)}))
            try:
                if record.limited:
                    limit = min(record.step_limits(scene.build(dtype="float64")))
                    options = {"substeps": int(1.1 / (scene.fps * limit)) + 1}
                solver = record(**options)
                dtype = solver.precision_on(wp.get_device(arguments.device))
                measure(scene, solver, arguments.device, 3, dtype)
                frames, errors, checks = measure(scene, solver, arguments.device, arguments.frames, dtype)
            except ValueError as error:
                print(f"{name:22} {n:4}  {error}", flush=True)
                continue
            shares = [f"{name} {100.0 * seconds / frames:6.2f} %" for name, seconds in (("errors", errors), ("checks", checks))]
            print(f"{name:22} {n:4}", *shares, f"{1e3 * frames / arguments.frames:8.2f} ms a frame", flush=True)


if __name__ == "__main__":
    main()
