"""How long the measures of an animation take, and how much memory: hanging cloth written as USD, analysed in fresh processes.

    python benchmarks/analysis.py [--device cpu|cuda:0] [--n 200] [--frames 75] [SETUP …]

The cloth is ``hanging`` with n² vertices, run by XPBD. Prints a line for each setup and number of frames: seconds for all
frames, reading included (median of three, and the range), with kernels compiled; and the most memory of its own (RssAnon, so
without the mapped file) that the process had after a row [MiB].
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

import warpcloth as wc
from warpcloth.scenes import hanging

MATERIAL = {"directions": "st", "material": wc.NeoHookeanMembrane(stiffness=1e3, poisson_ratio=0.3)}
SETUPS = {
    "triangles": MATERIAL,
    "triangles, no rates": {**MATERIAL, "measures": "still"},
    "triangles, logarithm": {**MATERIAL, "rates": "logarithm"},
    "triangles, float32": {**MATERIAL, "dtype": "float32"},
    "1-ring": {"neighbourhood": "1-ring"},
    "2-ring": {"neighbourhood": "2-ring"},
    "nearest 12": {"neighbourhood": "nearest:k=12"},
    "nearest 2%": {"neighbourhood": "nearest:2%"},
}


def measure(path, setup, device, frames):
    """Seconds of three analyses of the first frames, and the most memory in MiB."""
    options = {"measures": "all", "device": device, **SETUPS[setup]}
    if options["measures"] == "still":
        from warpcloth.analysis.measures import MEASURES

        options["measures"] = [name for name, found in MEASURES["triangle"].items() if not found.rate]
    sequence = wc.open_sequence(path)
    sequence = wc.as_sequence(sequence.mesh, [sequence[frame] for frame in range(2)], dt=1 / 60)
    consume(wc.Analyzer(sequence, **options))  # compiles
    seconds = []
    for _ in range(3):
        sequence = wc.open_sequence(path)
        for name in ("labels", "times"):
            object.__setattr__(sequence, name, getattr(sequence, name)[:frames])
        start = time.perf_counter()
        memory = consume(wc.Analyzer(sequence, **options))
        seconds.append(time.perf_counter() - start)
    return seconds, memory


def consume(analyzer):
    """Reads all rows, and returns the most memory after one [MiB]."""
    most = 0
    for _ in analyzer:
        with open("/proc/self/status") as status:
            most = max(most, *(int(line.split()[1]) for line in status if line.startswith("RssAnon")))
    return most / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("setups", nargs="*", metavar="SETUP", help=", ".join(SETUPS))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--frames", type=int, default=75)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.setups[0], arguments.device, arguments.frames)))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "hanging.usdc")
        scene = hanging.scene(n=arguments.n, duration=(arguments.frames - 1) / 60)
        wc.simulate(scene, wc.XPBD(substeps=20, iterations=1), device=arguments.device, output=path)
        for setup in arguments.setups or SETUPS:
            for frames in (arguments.frames // 3, arguments.frames):
                own = ["--one", path, "--device", arguments.device, "--frames", str(frames), setup]
                done = subprocess.run([sys.executable, __file__, *own], capture_output=True, text=True, check=True)
                seconds, memory = json.loads(done.stdout.splitlines()[-1])
                spread = f"{min(seconds):.2f} to {max(seconds):.2f}"
                print(f"{setup:<22} {frames:4d} frames  {np.median(seconds):7.2f} s ({spread})  {memory:7.1f} MiB", flush=True)


if __name__ == "__main__":
    main()
