"""Whether what `warpcloth choose` picks is the cheapest: its pick and its near rivals measured again, in turns.

    python benchmarks/choose.py [--device cpu|cuda:0] [--repeats 5] [NAME …]

Of each scene `choose` picks what meets 1 %. The pick and all else that it measured, that meets the tolerance and took at most
three times as long, run again, one after another and that five times, so that what else loads the machine is shared. Prints a
line for each setup: its error, ms a frame as `choose` had it and now (median, least to most), and its time over that of the
pick in the same round (the same). Cheaper is what takes less by more than half of what lies between the least and the most of
these ratios; if something is, the exit status is 1.
"""

import argparse
import statistics
import sys

from warpcloth.lab import trajectory
from warpcloth.lab.campaign import Store, sweep
from warpcloth.lab.choosing import choose
from warpcloth.lab.measurements import SceneRef, task

TOLERANCE = 0.01
NEAR = 3.0  # times the pick, up to which it is measured again
# (scene, frames): later motion is chaotic
SCENES = {
    "hanging-32": (SceneRef("hanging", {"n": 32}), 20),
    "hanging-64": (SceneRef("hanging", {"n": 64}), 15),
    "cantilever": (SceneRef("cantilever"), 20),
    "chain": (SceneRef("chain"), 60),
}


def near(choice, found, floor):
    """The pick, and what meets the tolerance and is not much dearer."""
    most = NEAR * choice.chosen.milliseconds
    others = [each for each in found if each is not choice.chosen and each.error is not None and each.milliseconds is not None]
    meeting = [each for each in others if each.error + floor <= TOLERANCE and each.milliseconds <= most]
    return [choice.chosen, *sorted(meeting, key=lambda each: each.milliseconds)]


def in_turns(scene, frames, setups, device, repeats):
    """ms a frame of each setup in each round, one process a round, [repeats][setups]."""
    tasks = [task(trajectory.measure, scene=scene, setup=setup, frames=frames, device=device) for setup in setups]
    rounds = []
    for _ in range(repeats):
        results = {each.key: result for each, result in sweep(tasks, store=Store(), workers=1)}
        rounds.append([results[each.key]["ms"] for each in tasks])
    return rounds


def spread(values):
    return statistics.median(values), min(values), max(values)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], *SCENES], help="all if none")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    cheaper = []
    for name in options.names or SCENES:
        scene, frames = SCENES[name]
        choice, found, exact = choose(scene, TOLERANCE, frames=frames, device=options.device)
        print(
            f"{name}, {frames} frames: {len(found)} settings measured, the reference is known to {exact.error:.2%}", flush=True
        )
        if not choice.meets:
            print(f"  {choice.certainty}")
            continue
        rivals = near(choice, found, exact.error)
        times = in_turns(scene, frames, [each.setup for each in rivals], options.device, options.repeats)
        for k, each in enumerate(rivals):
            now, ratio = spread([row[k] for row in times]), spread([row[k] / row[0] for row in times])
            wins = 1.0 - ratio[0] > 0.5 * (ratio[2] - ratio[1])
            said = "chosen" if k == 0 else "cheaper" if wins else ""
            numbers = "{:6.2%}  {:8.3g} ms  {:8.3g} ms ({:.3g} to {:.3g})  {:5.2f} ({:.2f} to {:.2f})"
            print(f"  {numbers.format(each.error, each.milliseconds, *now, *ratio)}  {each.setup}  {said}".rstrip(), flush=True)
            cheaper += [f"{name}: {each.setup}"] if wins else []
    print(
        f"cheaper than the pick: {'; '.join(cheaper)}"
        if cheaper
        else "nothing is cheaper than the pick by more than the spread"
    )
    return 1 if cheaper else 0


if __name__ == "__main__":
    sys.exit(main())
