"""How runs of random scenes end by solver, and which of them independent judges condemn though they are called usable.

    python benchmarks/random_scenes.py [--seeds 0:1000] [--solver NAME] [--device cpu|cuda:0] [--processes 1] [--json FILE]

Scenes, judges and their tolerances are those of tests/support. Prints each condemned run that is called usable. Then prints a
table by solver: runs by their end (refused if the package takes no such scene), runs that are condemned, those of them that are
called usable, and runs that are not usable though no judge condemns them. Exits with 1 if a condemned run is called usable.
"""

import argparse
import json
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from warpcloth.core.status import Result

ENDS = ("converged", "completed", "not usable", "diverged", "refused")
COLUMNS = ("runs", *ENDS, "condemned", "condemned, usable", "not usable, not condemned")


def run(seed, device):
    """Runs the scene of a seed; returns a dictionary of facts."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.random_scenes import random_case, run_case

    case, began = random_case(seed), time.perf_counter()
    facts = {"seed": seed, "solver": case.solver.name, "dtype": case.dtype, "scene": case.text}
    try:
        animation, found = run_case(case, device)
    except ValueError as error:
        return facts | {"end": "refused", "usable": False, "message": str(error), "condemned": []}
    status = animation.status
    return facts | {
        "end": end_of(status),
        "usable": bool(status.ok),
        "message": status.message,
        "strain": float(animation.worst_strain),
        "cut": float(animation.cut),
        "condemned": [f"{each.judge}, frame {each.frame}: {each.text}" for each in found],
        "seconds": round(time.perf_counter() - began, 3),
    }


def end_of(status):
    """Returns one of :data:`ENDS`."""
    if status.result in (Result.DIVERGED, Result.STOPPED):
        return "diverged"
    if not status.ok:
        return "not usable"
    return "converged" if status.result in (Result.CONVERGED, Result.ROUNDED) else "completed"


def table(runs):
    """Returns the lines of the table by solver."""
    counts = {}
    for each in runs:
        for name in (each["solver"], "all"):
            count = counts.setdefault(name, Counter())
            count.update(["runs", each["end"]])
            count["condemned"] += bool(each["condemned"])
            count["condemned, usable"] += bool(each["condemned"]) and each["usable"]
            count["not usable, not condemned"] += each["end"] == "not usable" and not each["condemned"]
    lines = [f"{'solver':22}" + "".join(f"{name:>{len(name) + 3}}" for name in COLUMNS)]
    for name in sorted(counts, key=lambda name: (name == "all", name)):
        lines.append(f"{name:22}" + "".join(f"{counts[name][column]:{len(column) + 3}}" for column in COLUMNS))
    return lines


def seeds_of(text):
    """Reads ``A:B``, the integers from A to B − 1."""
    first, last = map(int, text.split(":"))
    return range(first, last)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default=range(1000), metavar="A:B", help="from A to B - 1")
    parser.add_argument("--solver", help="name of the only solver")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", type=argparse.FileType("w"), metavar="FILE", help="one line of JSON for each run")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.random_scenes import SOLVERS

    seeds = [seed for seed in arguments.seeds if arguments.solver in (None, SOLVERS[seed % len(SOLVERS)])]
    runs = []
    with ProcessPoolExecutor(arguments.processes, get_context("spawn")) as pool:
        for each in pool.map(run, seeds, [arguments.device] * len(seeds)):
            runs.append(each)
            if arguments.json:
                print(json.dumps(each), file=arguments.json, flush=True)
            if each["condemned"] and each["usable"]:
                print(f"{each['seed']}, {each['solver']}: {'; '.join(each['condemned'])} | {each['message']}", flush=True)
    print("\n".join(table(runs)))
    return int(any(each["condemned"] and each["usable"] for each in runs))


if __name__ == "__main__":
    sys.exit(main())
