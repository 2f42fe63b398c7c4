"""A second of contact in warpcloth and in other simulators: time, and errors from each one's own finest motion.

    python benchmarks/second_of_contact.py --sizes 64 128 256 --device cuda:0 --with newton uipc
    python benchmarks/second_of_contact.py --sizes 512 --device cuda:0 --with newton uipc --finest-frames 0

The scene is ``drape`` with self-contact: a cloth of 1 m falls on a ball over a floor. Each simulator runs its two finest
settings first. While these agree to 0.3 % of the cloth's size (:func:`warpcloth.lab.reference.position_error` from frame 0 on),
the finest is its own motion. Folds amplify any difference, so that later frames have none. Other settings run the whole second,
and are compared with the own motion of their simulator as long as there is one: positions, and strains of edges (the 99th
percentile). Times are those of all frames, with positions read back; ``--limit`` ends a run early. Prints for each simulator
its fastest setting with an error of at most 1 % and strains within 1 point. Without finest frames it only times.
"""

import argparse
import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.lab.reference import position_error, strain_error
from warpcloth.others.newton_runs import NewtonPhysics
from warpcloth.others.runs import worst_strain
from warpcloth.others.uipc_runs import LibUipc
from warpcloth.scenes import drape

AGREE, WITHIN = 3e-3, 1e-2
SOME = ((1, 1), (1, 2), (1, 4), (2, 1), (2, 2), (2, 4), (4, 1), (4, 2), (4, 4), (8, 2))


class Ours:
    """A setting of ``wc.Newton``, of substeps and of iterations at most, with the methods of a run of another simulator."""

    def __init__(self, substeps, iterations, **options):
        self._solver = wc.Newton(substeps=substeps, iterations=iterations, **options)

    def bind(self, scene, device):
        self._stepper = self._solver.bind(scene.build(device=device))
        self.frame = self._stepper.frame
        return self

    def points(self):
        return self._stepper.state.x.numpy().copy()


# Makers of runs, their two finest settings, and others, as substeps × iterations.
ENGINES = {
    "warpcloth": {
        "Newton": (
            Ours,
            ((8, 300), (16, 300)),
            ((1, 2), (1, 3), (1, 4), (1, 6), (2, 2), (2, 3), (2, 4), (4, 1), (4, 2), (4, 3), (4, 4)),
        ),
        "Newton, BDF2": (partial(Ours, integrator="bdf2"), None, ((1, 4), (1, 6), (2, 3), (2, 4), (4, 3))),
    },
    "newton": {
        "VBD": (
            partial(NewtonPhysics, "vbd"),
            ((20, 20), (40, 40)),
            ((5, 5), (5, 10), (6, 8), (10, 5), (10, 10), (10, 20), (20, 5), (20, 10)),
        )
    },
    "uipc": {"libuipc": (LibUipc, ((8, 4), (16, 4)), SOME)},
}


def touching(n):
    """Returns the scene. VBD takes self-contact that is up to twice as stiff as contact with colliders."""
    scene = drape.scene(n=n, self_contact=True, duration=1.0)
    return replace(scene, contact=replace(scene.contact, stiffness=0.51 * scene.self_contact.stiffness))


def run(made, scene, device, frames, limit):
    """Returns points (F, n, 3) and milliseconds of frames, as far as the limit [s] allows."""
    with wp.ScopedDevice(device):
        bound = made.bind(scene, device)
        points, spent = [bound.points().astype(np.float32)], []
        while len(spent) < frames and sum(spent) < 1e3 * limit:
            began = time.perf_counter()
            bound.frame()
            points.append(bound.points().astype(np.float32))
            spent.append(1e3 * (time.perf_counter() - began))
            if not worst_strain(scene.mesh, points[-1]) < 10.0:
                break
    return np.array(points), np.array(spent)


def agreement(points, others, mesh):
    """Returns the number of frames for which two motions agree."""
    shared = min(len(points), len(others))
    return max((k for k in range(1, shared + 1) if position_error(points[:k], others[:k], mesh) <= AGREE), default=0)


def row_of(points, spent, own, scene):
    """Returns the figures of a run beside an own motion."""
    last, shared = points[-1].astype(np.float64), min(len(points), len(own))
    compared = shared == len(own) > 1
    pair = *(each[:shared].astype(np.float64) for each in (points, np.array(own))), scene.mesh
    return {
        "frames": len(spent),
        "ms": float(spent.mean()),
        "first ms": float(spent[: max(shared - 1, 1)].mean()),
        "error": position_error(*pair) if compared else np.nan,
        "strain error": strain_error(*pair) if compared else np.nan,
        "strain": worst_strain(scene.mesh, last),
        "crossings": int(wc.intersections(last, scene.mesh).counts[0]) if np.isfinite(last).all() else -1,
    }


def compare(name, make, finest, settings, scene, options, own):
    """Prints and returns rows of the settings of a solver, and its own motion, by default the one given."""
    rows = []
    if finest and options.finest_frames:
        found = [run(make(*each), scene, options.device, options.finest_frames, 3.0 * options.limit) for each in finest]
        frames = agreement(found[0][0], found[1][0], scene.mesh)
        own = found[1][0][:frames]
        spent = ", ".join(f"{a} × {b} {ms.mean():.1f} ms" for (a, b), (_, ms) in zip(finest, found, strict=True))
        print(f"{name}: own motion to frame {frames - 1} ({spent})", flush=True)
    for setting in settings:
        if options.settings and f"{name} {setting[0]}x{setting[1]}" not in options.settings:
            continue
        points, spent = run(make(*setting), scene, options.device, options.frames, options.limit)
        row = {"solver": name, "setting": setting} | row_of(points, spent, own, scene)
        rows.append(row)
        print(
            f"  {name:14} {setting[0]:2} × {setting[1]:<3} {row['ms']:8.1f} ms ({row['frames']} frames; "
            f"first {row['first ms']:.1f}), error {100 * row['error']:.2f} %, strains {100 * row['strain error']:.2f}, "
            f"largest {100 * row['strain']:.1f} %, {row['crossings']} crossings",
            flush=True,
        )
    return rows, own


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32])
    parser.add_argument("--with", dest="others", nargs="+", choices=("newton", "uipc"), default=[])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--finest-frames", type=int, default=24)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of a run")
    parser.add_argument(
        "--settings", nargs="+", metavar='"SOLVER AxB"', help="substeps x iterations of those to run (default: all)"
    )
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    wp.config.quiet, stored = True, {}
    for engine in ("warpcloth", *options.others):
        for make, *_ in ENGINES[engine].values():  # compiles
            run(make(1, 2), touching(12), options.device, 1, options.limit)
        for n in options.sizes:
            scene, rows, own = touching(n), [], ()
            print(f"{n}²", flush=True)
            for name, (make, finest, settings) in ENGINES[engine].items():
                found, own = compare(name, make, finest, settings, scene, options, own)
                rows += found
            good = [row for row in rows if row["error"] <= WITHIN and row["strain error"] <= WITHIN]
            if good:
                best = min(good, key=lambda row: row["ms"])
                print(f"  fastest to 1 %: {best['solver']} {best['setting'][0]} × {best['setting'][1]}, {best['ms']:.1f} ms")
            stored[f"{engine} {n}"] = rows
            if options.out:
                options.out.write_text(json.dumps(stored, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
