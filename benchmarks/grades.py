"""The cost of grading a run: the time of the errors of steps and of the balance of energy, over that of the frames.

    python benchmarks/grades.py [--device cpu|cuda:0] [--sizes 32 64 128] [--frames 60] [--scene hanging]

Each solver takes its setting of ``warpcloth bench``. The first run compiles kernels and is not counted. Prints, in per cent of
the time of the frames after the first, the errors of steps with the Newton steps among them, those of a median frame, and the
energies and strains of frames; then the milliseconds of a frame, and those of the errors of the first one, which load kernels.
"""

import argparse
import time

import numpy as np
import warp as wp

from warpcloth.run.frames_ahead import Frame, state_of
from warpcloth.run.scene_files import find_source
from warpcloth.run.watch import Watch
from warpcloth.solvers import SOLVERS


def measure(scene, solver, device, frames, dtype):
    """Returns the seconds (frames, 3) of each frame, of the errors of its steps and of its checks."""
    stepper = solver.bind(model := scene.build(device=device, dtype=dtype))
    watch, seconds = Watch(model, stepper), []
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
        seconds.append((*np.diff(times), time.perf_counter() - began))
    return np.array(seconds)


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
                first, *later = measure(scene, solver, arguments.device, arguments.frames, dtype)
            except ValueError as error:
                print(f"{name:22} {n:4}  {error}", flush=True)
                continue
            (frames, errors, checks), (_, usual, _) = np.sum(later, axis=0), len(later) * np.median(later, axis=0)
            found = (("errors", errors), ("of a median frame", usual), ("checks", checks))
            shares = [f"{name} {100.0 * seconds / frames:6.2f} %" for name, seconds in found]
            print(
                f"{name:22} {n:4}", *shares, f"{1e3 * frames / len(later):8.2f} ms, first {1e3 * first[1]:.0f} ms", flush=True
            )


if __name__ == "__main__":
    main()
