"""The commands on scenes: ``run``, ``info`` and ``scenes``."""

import math
import os
import statistics
import sys
import time
import warnings
from dataclasses import asdict, dataclass, replace

from ..base.outputs import STAGE_ENDINGS
from ..base.quiet import find_device
from ..base.texts import assignments, options
from ..run.listing import folders, list_scenes
from .options import DEFAULT
from .terminal import Progress, as_json, check_writable, frames_folder_of, location, say

# A step that all solvers without a limit take well; where no step is given the substeps come nearest to it.
_STEPS_A_SECOND = 240
# More substeps a frame than this, and the implicit solver is worth a hint.
_MANY_SUBSTEPS = 1000

EPILOG = """\
If neither dt nor substeps is given, solvers with a limit of stability, such as explicit, take the fewest substeps that are
10 % below the limit about the rest shape and below the bound for motion (exact for springs; hinges count as at rest). All
others take those whose step is nearest to 1/240 s.
"""


def run(arguments):
    from ..run.simulate import simulate

    source, values, scene = named_scene(arguments)
    frames = scene.frames if arguments.frames is None else arguments.frames
    arguments.output = _own_output(scene, arguments.resume) if arguments.output is None else arguments.output
    check_writable(arguments.output)
    device = find_device(arguments.device)
    if arguments.tolerance is not None or arguments.budget is not None:
        from .choose import take_choice

        take_choice(arguments, device)
    setup = solver_setup(arguments, scene, device)
    progress = Progress(frames, _hint(arguments, setup, scene))
    with progress.of(arguments.output):
        animation = simulate(
            scene if setup.model is None else _Built(scene, setup.model),
            setup.checked,
            output=arguments.output,
            device=device,
            dtype=arguments.dtype,
            frames=frames,
            single_file=arguments.single_file,
            resume=arguments.resume,
            progress=progress,
            threads=arguments.threads,
        )
        progress.close()
        status = animation.status
        facts = {
            "scene": scene.name,
            "source": str(source.path),
            "parameters": values,
            "status": status.result.value,
            "message": status.message,
            "frames": status.frame,
            "frames_asked": frames,
            "seconds_per_frame": statistics.median(animation.timings["frames"]),
            "compile_seconds": setup.seconds + animation.timings["compile"],
            "worst_strain": animation.worst_strain,
            "residual": status.residual,
            "residual_measure": status.measure,
            "residual_unit": status.unit,
            **_solver_facts(arguments, setup, scene.fps),
            "device": str(device),
            "dtype": arguments.dtype,
            "threads": arguments.threads,
            "file": arguments.output,
            "frames_folder": frames_folder_of(arguments),
        }
        print(as_json(facts) if arguments.json else _summary(facts))
        if status.ok:
            return 0
        return say(f"{status.message}; the last good frame is {status.frame}, in {arguments.output}", 1)


def _own_output(scene, resume):
    """Returns the default output of a run: a file with the scene's name in the current folder.

    Raises:
        ValueError: The file exists already, or the name cannot be that of a file.
    """
    if scene.name != os.path.basename(scene.name) or not scene.name.isprintable() or scene.name.strip(". ") == "":
        raise ValueError(f"the scene is called {scene.name!r}, which cannot be the name of a file; give one with -o")
    output = f"{scene.name}.usdc"
    if os.path.lexists(output) and not resume:
        raise ValueError(f"{output} exists already, and without -o nothing is replaced; give -o {output} to replace it")
    return output


def _summary(facts):
    from ..core.status import digits

    threads, measured = facts["threads"], facts["residual_measure"] is not None
    residual = f"{digits(facts['residual'])} {facts['residual_unit']}" if measured else "none, the method does not compute one"
    return "\n".join(
        [
            f"{facts['scene']}: {facts['message']}",
            f"  frames        {facts['frames']} of {facts['frames_asked']}, {facts['seconds_per_frame']:.3g} s each (median)",
            f"  compiling     {facts['compile_seconds']:.3g} s",
            f"  worst strain  {100.0 * facts['worst_strain']:.3g} %",
            f"  residual      {residual}",
            f"  solver        {_solver_line(facts)}",
            f"  device        {facts['device']}, {facts['dtype']}" + (f", {threads} threads" if threads > 1 else ""),
            f"  file          {location(facts)}",
        ]
    )


def info(arguments):
    from ..scene.freedom import freedom

    source, values, scene = named_scene(arguments)
    device = find_device(arguments.device)
    if arguments.advise:
        from .advise import advise_on

        return advise_on(arguments, source, values, scene, device)
    for name in ("tolerance", "frames"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} is given without --advise, which it is for")
    setup = solver_setup(arguments, scene, device, limits=True) if arguments.solver or arguments.s else _Setup()
    model = setup.model or scene.build(device=device, dtype=arguments.dtype)
    facts = {
        "scene": {
            "name": scene.name,
            "parameters": values,
            "vertices": len(scene.mesh.points),
            "triangles": len(scene.mesh.triangles),
            "edges": len(scene.mesh.edges),
            "mass": float(scene.vertex_masses.sum()),
            "gravity": scene.gravity.tolist(),
            "duration": scene.duration,
            "fps": scene.fps,
            "frames": scene.frames,
            "pins": len(scene.pins.vertices),
        },
        "solver": None,
    }
    if setup.solver:
        setup.checked.bind(model)
        facts["solver"] = _solver_facts(arguments, setup, scene.fps)
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
    print(as_json(facts) if arguments.json else f"{scene}\n{_info_text(facts)}")
    hint = setup.solver and _hint(arguments, setup, scene)
    if hint:
        print(hint, file=sys.stderr)
    return 0


def _info_text(facts):
    model, solver = facts["model"], facts["solver"]
    lines = ["parameters: " + (", ".join(f"{k}={v!r}" for k, v in facts["scene"]["parameters"].items()) or "none")]
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
        lines.append(f"solver: {_solver_line(solver)}")
        if "limit_about_rest" in solver:
            fps = facts["scene"]["fps"]
            for text, key in (("about the rest shape", "limit_about_rest"), ("in motion", "limit_in_motion")):
                lines.append(f"  stable {text} below {solver[key]:.4g} s, from {_fewest(fps, solver[key])} substeps a frame")
        lines.append("kernels: " + ", ".join(model["kernels"]))
    return "\n".join(lines)


def scenes(arguments):
    found = [arguments.folder] if arguments.folder else folders()
    for folder, scenes in [(folder, list_scenes(folder)) for folder in found]:
        print(f"{folder}:")
        for listed in scenes:
            details = [listed.summary, ", ".join(listed.parameters), listed.meaning]
            print(f"  {listed.name}")
            print("".join(f"      {detail}\n" for detail in details if detail), end="")
    if not found:
        print("no folder ./scenes, and none that came with the package; give a folder")
    return 0


def named_scene(arguments):
    """(source, values of its parameters, scene) that the arguments name."""
    from ..run.scene_files import find_source

    source = find_source(arguments.scene, getattr(arguments, "pins", None))
    prim = getattr(arguments, "prim", None)
    if prim is not None:  # a parameter of a stage like others, so measurements in other processes get it too
        if source.path.suffix not in STAGE_ENDINGS:
            raise ValueError(f"--prim is given, but {arguments.scene} is not a stage; leave it out")
        arguments.p, arguments.prim = [*arguments.p, f"prim={prim}"], None
    values = source.values(assignments(arguments.p))
    return source, values, source.scene(values)


@dataclass
class _Setup:
    """A solver, and what had to be built to choose its step.

    Attributes:
        solver: With its options, as they are shown.
        checked: The same to be run; it does not look for limits again that are known to be kept.
        chosen: How its step was chosen, or None where it was given.
        model: Of the scene, if it is built already.
        limits: As ``step_limits`` gives them, if they were asked for.
        seconds: What building and the limits took.
    """

    solver: object = None
    checked: object = None
    chosen: str | None = None
    model: object = None
    limits: tuple | None = None
    seconds: float = 0.0


class _Built:
    """A scene whose model stands already."""

    def __init__(self, scene, model):
        self._scene, self._model = scene, model

    def __getattr__(self, name):
        return getattr(self._scene, name)

    def build(self, **_):
        """The model, whose device and precision are those of the whole command."""
        return self._model


def solver_setup(arguments, scene, device, limits=False):
    """Returns the solver that the arguments name; ``limits`` asks for those of a limited one even where its step is given."""
    from ..solvers import SOLVERS

    arguments.solver = arguments.solver or DEFAULT
    record = SOLVERS[arguments.solver]
    given = options(record, assignments(arguments.s))
    step_given = "dt" in given or "substeps" in given
    solver = record(**given, **({} if step_given else {"substeps": 1}))  # a wrong option is said before anything is built
    if not record.limited:
        if step_given:
            return _Setup(solver, solver)
        solver = replace(solver, substeps=max(1, round(_STEPS_A_SECOND / scene.fps)))
        return _Setup(solver, solver, "by default about 1/240 s")
    if step_given and not limits:
        return _Setup(solver, solver)
    from ..mesh.ordering import order_of_run
    from ..solvers.step import fewest_substeps

    began = time.perf_counter()
    model = scene.build(
        device=device, dtype=arguments.dtype, order=order_of_run(scene, solver), threads=getattr(arguments, "threads", 1)
    )
    rest, motion = record.step_limits(model)
    setup = _Setup(solver, solver, None, model, (rest, motion), time.perf_counter() - began)
    if not step_given:
        setup.solver = replace(solver, substeps=fewest_substeps(scene.fps, rest, motion))
        setup.chosen = f"by default the fewest stable ones, limits {rest:.3g} and {motion:.3g} s"
    setup.checked = setup.solver
    if setup.solver.stable(1.0 / (scene.fps * setup.solver.per_frame(scene.fps)), min(rest, motion)):
        setup.checked = setup.solver.without_limits()  # which leaves out a second search for them
    return setup


def _fewest(fps, limit):
    """The fewest substeps a frame whose step is below ``limit``."""
    return math.floor(1.0 / (fps * limit)) + 1


def _hint(arguments, setup, scene):
    """A line for those who may wait longer than they need, or None."""
    substeps = setup.solver.per_frame(scene.fps)
    if not setup.solver.limited or substeps <= _MANY_SUBSTEPS:
        return None
    return f"warpcloth: hint: {setup.solver.name} takes {substeps:,} substeps a frame here; --solver {DEFAULT} may suit better"


def _solver_facts(arguments, setup, fps):
    step = 1.0 / (fps * setup.solver.per_frame(fps))
    return {"solver": arguments.solver, "options": asdict(setup.solver), "step": step, "step_chosen": setup.chosen}


def _solver_line(facts):
    options = ", ".join(f"{name}={value}" for name, value in facts["options"].items() if value is not None)
    return f"{facts['solver']}({options}), step 1/{1.0 / facts['step']:.6g} s" + (
        f" ({facts['step_chosen']})" if facts["step_chosen"] else ""
    )
