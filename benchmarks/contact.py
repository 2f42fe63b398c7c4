"""Where the time of a frame with contact goes: kernels by what they do, and launches.

    python benchmarks/contact.py [--device cpu|cuda:0] [--sizes 64 128] [--solver Newton(substeps=1)] [--frame 14]

The scene is ``drape`` with self-contact, where cloth has just met the ball. One frame runs launch by launch, so that each
kernel can be timed; the frame before runs as recorded, which is its time in a run. Prints for each size the milliseconds of
kernels by their part of the step, each without the shortest time of a launch, the numbers of launches and of iterations, and
what launches alone would take at 2 µs each.
"""

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.core.capture import Segment
from warpcloth.scenes import drape

# What kernels do, by the files that have them; those of other files count as the rest of a step.
PARTS = {
    "listing": ("proximity", "proximity_grid", "piece_motion", "scan", "obstacles"),
    "narrow phase": ("self_contact", "pair_potential", "self_planes", "self_gaps", "self_pairs"),
    "filter": ("self_filter", "self_advance", "collider_filter"),
    "elements": ("assemble", "sparse", "transpose"),
    "pairs": ("pair_sums", "self_friction", "pair_sweeps", "colliders", "collider_work"),
    "solves": ("linear", "multigrid", "v_cycle", "additive_multigrid"),
    "search": ("search", "minimise", "reduce"),
}


def part_of(kernel):
    """Returns the part of a step that a kernel belongs to."""
    stem = Path(kernel.func.__code__.co_filename).stem
    return next((part for part, stems in PARTS.items() if stem in stems), f"rest ({stem})")


def timed_frame(stepper, device):
    """Takes a frame launch by launch; returns milliseconds and numbers of launches by part."""
    found, launch, replay = [], wp.launch, Segment.__call__

    def timed(kernel, *args, **options):
        start, end = (wp.Event(device, enable_timing=True) for _ in range(2)) if device.is_cuda else (None, None)
        began = time.perf_counter()
        if device.is_cuda:
            wp.record_event(start)
        launch(kernel, *args, **options)
        if device.is_cuda:
            wp.record_event(end)
        found.append((part_of(kernel), 1e3 * (time.perf_counter() - began), start, end))

    wp.launch, Segment.__call__ = timed, lambda segment: segment.record()
    try:
        stepper.frame()
    finally:
        wp.launch, Segment.__call__ = launch, replay
    wp.synchronize_device(device)
    if device.is_cuda:
        found = [(part, wp.get_event_elapsed_time(start, end)) for part, _, start, end in found]
    shortest = min(row[1] for row in found)
    spent, counts = Counter(), Counter(row[0] for row in found)
    for row in found:
        spent[row[0]] += row[1] - shortest
    return spent, counts


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64])
    parser.add_argument("--solver", default="Newton(substeps=1)")
    parser.add_argument("--frame", type=int, default=14)
    given = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device(given.device)
    with wp.ScopedDevice(device):
        for n in given.sizes:
            scene = drape.scene(n=n, self_contact=True)
            stepper = eval(f"wc.{given.solver}", {"wc": wc}).bind(scene.build(device=device))
            for _ in range(given.frame - 2):
                stepper.frame()
            wp.synchronize_device(device)
            start = time.perf_counter()
            stepper.frame()
            wp.synchronize_device(device)
            whole = 1e3 * (time.perf_counter() - start)
            spent, counts = timed_frame(stepper, device)
            total, launches = sum(spent.values()), sum(counts.values())
            iterations = np.max(getattr(getattr(stepper, "minimiser", None), "iterations", 0))
            print(f"{n}²: frame {given.frame - 1} {whole:.1f} ms; {total:.1f} ms in kernels of frame {given.frame},")
            print(f"  {launches} launches ({2e-3 * launches:.1f} ms at 2 µs), {iterations} iterations")
            for part, value in spent.most_common():
                print(f"  {part:24} {value:9.2f} ms {100 * value / total:5.1f} % {counts[part]:8} launches")


if __name__ == "__main__":
    main()
