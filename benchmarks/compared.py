"""Draws the charts and prints the tables of docs/compared.md: solvers of warpcloth and of other simulators, side by side.

    python benchmarks/compared.py                                          # all scenes, on the CPU
    python benchmarks/compared.py --scene drape --device cuda:0 --out gpu  # one of them
    python benchmarks/compared.py --stored cpu/*.json gpu/*.json           # tables and charts of stored results
    python benchmarks/compared.py --touching                               # how many vertices touch in each frame

For each scene it searches for the cheapest setting of warpcloth with an error of at most 1 %, and for that of each solver of
the other simulators: it doubles substeps and iterations until a setting has such an error or the limits are reached. These
settings are then timed in turns, frame by frame. A file of JSON and a chart are written for each scene. Measurements are stored
in WARPCLOTH_CACHE and reused, so that the same command goes on after an interruption.
"""

import argparse
import json
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import warp as wp

import warpcloth as wc
from warpcloth.base.checks import choice, number, whole
from warpcloth.base.texts import assignments
from warpcloth.chart.pareto import plot_time
from warpcloth.lab.choosing import percent
from warpcloth.lab.measurements import SceneRef
from warpcloth.lab.own_reference import words_of_own
from warpcloth.lab.reference import NoReference
from warpcloth.lab.setups import grid_in_words
from warpcloth.lab.side_by_side import nearest_setting, side_by_side
from warpcloth.lab.work_precision import WITHIN
from warpcloth.others.simulators import SIMULATORS, shown_name
from warpcloth.solvers import SOLVERS

# Scenes by name, with parameters and frames.
SCENES = {
    "hanging": (("hanging", {"n": 32}), 10),
    "stiff": (("hanging", {"n": 24, "stiffness": 1e5}), 10),
    "drape": (("drape", {"n": 24}), 10),
    "fold": (("fold", {"nx": 8, "ny": 24, "bending": 1e-4, "damping": 1e-5}), 20),
}


def touching(name):
    """Texts by frame: the fraction of vertices nearer to a collider than the contact distance, and pairs of self-contact."""
    given, frames = SCENES[name]
    scene = SceneRef(*given).load()
    record = ("pairs",) if scene.has_pairs else ()
    found = wc.simulate(scene, wc.Newton(substeps=32, integrator="bdf2"), dtype="float64", frames=frames, record=record)
    near = np.zeros(found.points.shape[:2], dtype=bool)
    for collider in scene.colliders:
        near |= np.array([collider.distances(points) < scene.contact.distance for points in found.points])
    parts = [f"{k}: {100.0 * part:.0f} %" for k, part in enumerate(near.mean(axis=1)) if part]
    return parts, [
        f"{k}: {int(count)} pairs" for k, count in enumerate(found.pairs["pairs in contact"]) if count
    ] if record else []


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs="+", choices=SCENES, default=list(SCENES), help="scenes (default: all)")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda:0, …")
    parser.add_argument("--with", dest="others", nargs="+", choices=SIMULATORS, default=list(SIMULATORS), help="simulators")
    parser.add_argument("--solvers", nargs="+", metavar="SOLVER", help="solvers of warpcloth to choose among (default: all)")
    parser.add_argument("-p", nargs="+", default=[], metavar="NAME=VALUE", help="parameters that replace those of the scenes")
    parser.add_argument("--frames", type=int, help="frames (default: those of each scene here)")
    parser.add_argument("--tolerance", type=float, default=WITHIN, help="error of settings that are compared (default: 0.01)")
    parser.add_argument("--limit", type=float, default=20.0, help="time limit of each run [s] (default: 20)")
    parser.add_argument("--total", type=float, default=math.inf, help="time limit of each scene [s] (default: none)")
    parser.add_argument("--out", type=Path, default=Path("compared"), help="folder of results (default: compared)")
    parser.add_argument("--stored", type=Path, nargs="+", metavar="JSON", help="only print and draw stored results")
    parser.add_argument("--touching", action="store_true", help="print vertices in contact in each frame, by BDF2, and end")
    options = parser.parse_args()
    if options.touching:
        for name in options.scene:
            print(name, *touching(name))
        return
    if options.stored:
        for path in options.stored:
            show(path, json.loads(path.read_text(encoding="utf-8")))
        return
    wp.config.quiet = True
    try:
        scenes = checked_scenes(options)
    except ValueError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    options.out.mkdir(parents=True, exist_ok=True)
    for name, (scene, frames) in scenes.items():
        began = time.perf_counter()
        with ThreadPoolExecutor(1) as executor:  # one process for all, so that kernels are compiled once
            try:
                found = side_by_side(
                    scene,
                    options.others,
                    options.tolerance,
                    frames=frames,
                    device=options.device,
                    solvers=options.solvers,
                    limit=options.limit,
                    total=options.total,
                    executor=executor,
                )
            except NoReference as error:
                found = {"scene": str(scene), "frames": frames, "device": options.device, "failed": str(error)}
        path = options.out / f"{name}.json"
        path.write_text(json.dumps(found, indent=1, default=float), encoding="utf-8")
        path.with_suffix(".png").unlink(missing_ok=True)  # of an older result
        show(path, found)
        print(f"  {time.perf_counter() - began:.0f} s, {path}", flush=True)


def checked_scenes(options):
    """Returns, by name, the scenes to run and their frames, once all options are checked.

    Raises:
        ValueError: An option is not allowed.
    """
    for solver in options.solvers or ():
        choice("solvers", solver, SOLVERS)
    number("tolerance", options.tolerance, above=0.0)
    number("limit", options.limit, above=0.0)
    if options.total != math.inf:
        number("total", options.total, above=0.0)
    if options.frames is not None:
        whole("frames", options.frames, 1)
    wp.get_device(options.device)
    given, scenes = assignments(options.p), {}
    for name in options.scene:
        (scene, parameters), frames = SCENES[name]
        scenes[name] = SceneRef(scene, parameters | given), frames if options.frames is None else options.frames
        scenes[name][0].load()
    return scenes


def show(path, found):
    """Prints the tables of a result and draws its chart beside its file."""
    print(text_of(found), flush=True)
    if not found.get("rows"):
        return
    try:
        plot_time(path.with_suffix(".png"), found)
    except ImportError as error:
        print(f"no chart: {error}")


def text_of(found):
    """Returns the tables of a result: ratios at equal error, how each search ended, and its grid of settings."""
    if "failed" in found:
        return f"\n{found['scene']}, {found['frames']} frames, {found['device']}: no result, because {found['failed']}"
    machine, rows = found["machine"], found["rows"]
    device = machine["processor"] if machine["device"] == "cpu" else machine["device"]
    versions = ", ".join(f"{SIMULATORS[name].title} {machine[name]}" for name in SIMULATORS if machine.get(name))
    known = f"reference known to {percent(found['reference']['error'])} by {found['reference']['method']}"
    lines = [f"\n{found['scene']}, {found['frames']} frames, {device}, Warp {machine['warp']}, {versions}; {known}"]
    lines.append("| setting | error | to its own | ratio of times | quartiles | ms | crossings | inside |")
    lines.append("|---|---|---|---|---|---|---|---|")
    for each in found["ratios"]:
        own = "–" if each["own_error"] is None else percent(each["own_error"])
        numbers = f"{each['ratio']:.3g} | {each['spread'][0]:.3g} to {each['spread'][1]:.3g} | {each['ms']:.3g}"
        error = percent(each["error"]) + ("" if each["to"] == "reference" else " (its own counts)")
        lines.append(f"| {each['label']} | {error} | {own} | {numbers} | {each['crossings']} | {each['inside']} |")
    lines += [f"  {said}" for said in [nearest_setting(found)] if said]
    for solver, ended in found["searched"].items():
        same = [row for row in rows if row["solver"] == solver]
        own, statuses = found["others"][solver], [row["status"] for row in same]
        counts = ", ".join(f"{statuses.count(status)} {status}" for status in dict.fromkeys(statuses))
        lines.append(f"  {shown_name(solver)}: {ended} ({counts})")
        lines.append(f"    its own motion: {words_of_own(own)}")
        tried = [row["options"] for row in same]
        errors = [(row["error"], row["label"]) for row in same if row["error"] is not None]
        lines.append(f"    least error {percent(min(errors)[0])}, {min(errors)[1]}" if errors else "    no error is known")
        lines.append(f"    settings: {grid_in_words(tried)}")
        lines += [f"    {why}" for why in dict.fromkeys(row["reason"] for row in same if row["status"] != "ok")]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
