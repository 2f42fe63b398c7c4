"""The command ``info``: describes a scene and its model, and with ``--advise`` which of its parts matter."""

import contextlib
import sys
import warnings
from dataclasses import asdict

from ..base.quiet import find_device
from ..base.texts import fraction, json_text
from .options import DEFAULT, add_shared
from .setup import EPILOG as EPILOG
from .setup import Chosen, add_scene_and_solver, fewest_below, hint_of, named_scene, solver_facts, solver_line, solver_setup
from .terminal import Progress

TEXT = "Show what a scene contains, and the model that is built from it."


def add_arguments(parser):
    """Adds the arguments of this command."""
    text = "also show the step and the kernels of this solver (default: none, or newton if -s or --advise is given)"
    add_scene_and_solver(parser, text)
    text = "find out whether each term, the precision, the step and the resolution matter to the result"
    parser.add_argument("--advise", action="store_true", help=text)
    text = "with --advise: the largest change that does not matter (default: 1%%)"
    parser.add_argument("--tolerance", metavar="SHARE", help=text)
    text = "with --advise: number of frames to simulate (default: at most 30)"
    parser.add_argument("--frames", type=int, metavar="N", help=text)
    add_shared(parser, "device", "json", "dtype")


def info(arguments):
    from ..mesh.seams import coincident, piece_count
    from ..scene.freedom import freedom
    from ..solvers import SOLVERS

    source, values, scene = named_scene(arguments)
    device = find_device(arguments.device)
    if arguments.advise:
        return advise_on(arguments, source, values, scene, device)
    for name in ("tolerance", "frames"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} is given without --advise, which it is for")
    if arguments.solver or arguments.s:
        setup = solver_setup(arguments, scene, device, limits=True)
    else:  # in the precision of a run by default
        setup = Chosen(SOLVERS[DEFAULT].precision_on(device, arguments.dtype))
    model = scene.build(device=device, dtype=setup.dtype)
    facts = {
        "scene": {
            "name": scene.name,
            "parameters": values,
            "vertices": len(scene.mesh.points),
            "triangles": len(scene.mesh.triangles),
            "edges": len(scene.mesh.edges),
            "coincident": coincident(scene.mesh.points),
            "pieces": piece_count(scene.mesh),
            "mass": float(scene.vertex_masses.sum()),
            "gravity": scene.gravity.tolist(),
            "duration": scene.duration,
            "fps": scene.fps,
            "frames": scene.frames,
            "pins": len(scene.pins.vertices),
            "cloths": list(scene.cloths),
        },
        "solver": None,
    }
    if setup.solver:
        setup.checked.bind(model)
        facts["solver"] = solver_facts(arguments, setup, scene.fps)
        if setup.limits:
            facts["solver"] |= dict(zip(("limit_about_rest", "limit_in_motion"), setup.limits, strict=True))
    facts["model"], free = model.report(), freedom(scene)
    facts["freedom"] = asdict(free) | {"locked": free.locked}
    if free.locked:
        leave = "are so many that they may leave" if free.counted else "leave"
        warnings.warn(
            f"{free.edges:,} hard or stiff edges {leave} no freedom to bend once the cloth is not flat; make them softer, or "
            "hold only the edges of triangles, which leaves 3 + boundary edges degrees of freedom",
            stacklevel=2,
        )
    print(json_text(facts) if arguments.json else f"{scene}\n{_info_text(facts)}")
    hint = setup.solver and hint_of(arguments, setup, scene)
    if hint:
        print(hint, file=sys.stderr)
    return 0


def _info_text(facts):
    model, solver, scene = facts["model"], facts["solver"], facts["scene"]
    lines = ["parameters: " + (", ".join(f"{k}={v!r}" for k, v in scene["parameters"].items()) or "none")]
    if scene["coincident"] or scene["pieces"] > 1:
        lines.append(f"mesh of {scene['pieces']} pieces; {scene['coincident']} vertices lie exactly upon others")
    lines.append(f"model on {model['device']}, {model['dtype']}: {model['bytes']:,} bytes")
    lines += [f"  {term['term']}: {term['elements']} elements, {term['bytes']:,} bytes" for term in model["terms"]]
    free = facts["freedom"]
    if free["edges"]:
        most, least = ("up to ", " or more") if free["counted"] else ("", "")
        lines.append(
            f"hard or stiff edges: {free['edges']:,}, of rank {most}{free['rank']:,} in {free['coordinates']:,} coordinates; "
            f"{free['left']:,}{least} degrees of freedom are left, {free['rigid']} of them rigid motion"
        )
    if solver:
        lines.append(f"solver: {solver_line(solver)}")
        if "limit_about_rest" in solver:
            fps = scene["fps"]
            for text, key in (("about the rest shape", "limit_about_rest"), ("in motion", "limit_in_motion")):
                lines.append(
                    f"  stable {text} below {solver[key]:.4g} s, from {fewest_below(fps, solver[key])} substeps a frame"
                )
        lines.append("kernels: " + ", ".join(model["kernels"]))
    return "\n".join(lines)


def advise_on(arguments, source, values, scene, device):
    """Prints which terms, precision, step and resolution matter, by leaving out or changing each."""
    from ..lab.advice import advise

    tolerance = 0.01 if arguments.tolerance is None else fraction("tolerance", arguments.tolerance)
    setup = solver_setup(arguments, scene, device)
    resolutions = _resolutions(source, values, len(scene.mesh.points))
    with contextlib.closing(Progress(None, first="trying")) as progress:
        found = advise(
            scene,
            setup.checked,
            tolerance,
            arguments.frames,
            resolutions=resolutions,
            device=device,
            dtype=setup.dtype,
            progress=progress,
        )
    facts = {
        "scene": scene.name,
        "parameters": values,
        "solver": arguments.solver,
        "options": asdict(setup.checked),
        "device": str(device),
        "dtype": setup.dtype,
        "tolerance": tolerance,
        "frames": found.frames,
        "milliseconds": list(found.milliseconds),
        "steady": found.steady,
        "grade": found.status.grade.value,
        "usable": found.status.ok,
        "trials": [asdict(trial) for trial in found.trials],
        "advice": found.sentences
        + (
            []
            if resolutions
            else ["resolution is not tried: no whole number among the parameters of the scene sets its vertices"]
        ),
    }
    print(json_text(facts) if arguments.json else _advice(facts))
    return 0


def _resolutions(source, values, vertices):
    """Returns the scene with half and twice the value of the first parameter that sets its number of vertices, by name."""
    for name, value in values.items():
        if isinstance(value, int) and not isinstance(value, bool) and value > 1:
            found = {}
            for other in (value // 2, 2 * value):
                with contextlib.suppress(ValueError):  # the scene may refuse a coarse resolution
                    found[f"{name}={other}"] = source.scene(values | {name: other})
            if any(len(scene.mesh.points) != vertices for scene in found.values()):
                return found
    return None


_VERDICTS = {True: "matters", False: "does not matter"}


def _advice(facts):
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
