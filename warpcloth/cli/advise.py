"""The option ``--advise`` of ``info``: which declarations of a scene matter."""

import contextlib
from dataclasses import asdict

from ..base.texts import fraction
from .run import solver_setup
from .terminal import Progress, as_json


def advise_on(arguments, source, values, scene, device):
    """Says which terms, precision and resolution matter, by leaving out or changing each."""
    from ..lab.advice import advise

    tolerance = 0.01 if arguments.tolerance is None else fraction("tolerance", arguments.tolerance)
    solver = solver_setup(arguments, scene, device).checked
    resolutions = _resolutions(source, values, len(scene.mesh.points))
    progress = Progress(None, first="trying")
    try:
        found = advise(
            scene,
            solver,
            tolerance,
            arguments.frames,
            resolutions=resolutions,
            device=device,
            dtype=arguments.dtype,
            progress=progress,
        )
    finally:
        progress.close()
    facts = {
        "scene": scene.name,
        "parameters": values,
        "solver": arguments.solver,
        "options": asdict(solver),
        "tolerance": tolerance,
        "frames": found.frames,
        "milliseconds": list(found.milliseconds),
        "steady": found.steady,
        "trials": [asdict(trial) for trial in found.trials],
        "advice": found.sentences
        + (
            []
            if resolutions
            else ["resolution is not tried: no whole number among the parameters of the scene sets its vertices"]
        ),
    }
    print(as_json(facts) if arguments.json else _text(facts))
    return 0


def _resolutions(source, values, vertices):
    """The scene with half and twice the value of the first parameter that sets the number of vertices, by name."""
    for name, value in values.items():
        if isinstance(value, int) and not isinstance(value, bool) and value > 1:
            found = {}
            for other in (value // 2, 2 * value):
                with contextlib.suppress(ValueError):  # of a scene that cannot be so coarse
                    found[f"{name}={other}"] = source.scene(values | {name: other})
            if any(len(scene.mesh.points) != vertices for scene in found.values()):
                return found
    return None


_VERDICTS = {True: "matters", False: "does not matter"}


def _text(facts):
    first, last = facts["milliseconds"]
    times = f"{first:.3g} ms each" if facts["steady"] else f"{first:.3g} and {last:.3g} ms each, too unlike to compare costs"
    lines = [f"{facts['scene']}: {facts['frames']} frames with {facts['solver']}, {times}; tolerance {facts['tolerance']:.3g}"]
    width = max(len(trial["name"]) for trial in facts["trials"])
    for trial in facts["trials"]:
        name, change = trial["name"].ljust(width), f"{trial['change']:9.3%}"
        if trial["matters"] is None:
            lines.append(f"  {name}  no result: {trial['reason']}")
        else:
            why = f": {trial['reason']}" if trial["reason"] else ""
            lines.append(f"  {name}  {change} change  {trial['cost']:5.2f} of the time  {_VERDICTS[trial['matters']]}{why}")
    return "\n".join([*lines, *(f"advice: {sentence}" for sentence in facts["advice"])])
