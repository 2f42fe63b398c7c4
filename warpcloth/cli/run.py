"""The command ``run``: runs a scene and writes its animation."""

import math
import statistics

from ..base.interrupts import Interrupted
from ..base.quiet import find_device
from ..base.texts import json_text
from .history_files import EPILOG as OF_HISTORY
from .history_files import record_of, write_history
from .options import add_shared, values_of
from .render import check_drawing, draw_film
from .setup import EPILOG as OF_STEPS
from .setup import add_scene_and_solver, hint_of, named_scene, solver_facts, solver_line, solver_setup, warn_of_seams
from .terminal import Progress, check_writable, frames_folder_of, location, own_output, say

TEXT = "Run a scene and write its animation as USD."
EPILOG = f"""\
  warpcloth run hanging --solver xpbd -s substeps=20 -p n=24 -o xpbd.usdc
  warpcloth run mine.obj --scale 0.01 --pins boundary --fabric cotton

{OF_STEPS}
{OF_HISTORY}"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add_scene_and_solver(parser, "the solver (default: newton)")
    add(
        "--tolerance",
        metavar="SHARE",
        help="find the cheapest solver and settings with at most this error, such as 1%% of the size of the cloth, and run "
        "with them; this takes many trial runs, see 'warpcloth choose'",
    )
    text = "find the most accurate solver and settings within this time per frame, such as 16ms, and run with them"
    add("--budget", metavar="TIME", help=text)
    text = "number of frames after the start (default: those of the scene's duration)"
    add("--frames", type=int, metavar="N", help=text)
    add_shared(parser, "device", "json", "dtype")
    text = (
        "the .usd, .usda, .usdc or .usdz file to write (default: named after the scene, such as hanging.usdc; an existing "
        "file is then not replaced)"
    )
    add("-o", "--output", metavar="FILE", help=text)
    add("--film", metavar="FILE", help="also draw the run as a film, .mp4, .webp or .gif; see 'warpcloth render'")
    add("--csv", metavar="FILE", help="also write a table of energies and forces, one row per frame")
    add("--report", metavar="FILE", help="also write energies, forces and the reaction of each pin as JSON")
    text = "continue the interrupted run to this output from its last checkpoint; there is one every ten frames"
    add("--resume", action="store_true", help=text)
    add_shared(parser, "single_file")


def run(arguments):
    from ..run.simulate import simulate

    source, values, scene = named_scene(arguments)
    warn_of_seams(scene.mesh, scene)
    frames = scene.frames if arguments.frames is None else arguments.frames
    arguments.output = own_output(scene.name, ".usdc", arguments.resume) if arguments.output is None else arguments.output
    check_writable(arguments.output)
    check_drawing(arguments.film, [arguments.output])
    record = record_of(arguments, scene)
    device = find_device(arguments.device)
    if arguments.tolerance is not None or arguments.budget is not None:
        from .choose import take_choice

        take_choice(arguments, device)
    setup = solver_setup(arguments, scene, device)
    progress = Progress(frames, hint_of(arguments, setup, scene))
    with progress.of(arguments.output):
        animation = simulate(
            scene,
            setup.checked,
            device=device,
            frames=frames,
            progress=progress,
            dtype=setup.dtype,
            record=record,
            **values_of(arguments, "output", "single_file", "resume"),
        )
        progress.close()
        status = animation.status
        if record:
            write_history(arguments, scene, animation)
        if arguments.film:
            try:
                draw_film([arguments.output], arguments.film, device=device.alias)  # draws everything in the stage
            except Interrupted as interrupted:
                raise Interrupted(f"{interrupted}; frames 0 to {status.frame} are in {arguments.output}") from None
        facts = {
            "scene": scene.name,
            "source": str(source.path),
            "parameters": values,
            "status": status.result.value,
            "grade": status.grade.value,
            "usable": status.ok,
            "distance": status.distance,
            "message": status.message,
            "frames": status.frame,
            "frames_asked": frames,
            "seconds_per_frame": statistics.median(animation.timings["frames"]),
            "compile_seconds": setup.seconds + animation.timings["compile"],
            "worst_strain": animation.worst_strain,
            **({"cut": animation.cut, "inside": [each._asdict() for each in animation.inside]} if scene.colliders else {}),
            **({"forced": [each._asdict() for each in animation.forced]} if scene.colliders else {}),
            **({"self_contact": _self_contact(animation.self_contact)} if animation.self_contact else {}),
            "residual": status.residual,
            "residual_measure": status.measure,
            "residual_unit": status.unit,
            **solver_facts(arguments, setup, scene.fps),
            "device": str(device),
            "dtype": setup.dtype,
            "file": arguments.output,
            "frames_folder": frames_folder_of(arguments),
            **values_of(arguments, "film", "csv", "report"),
        }
        print(json_text(facts) if arguments.json else _summary(facts, animation.inside, animation.forced))
        if status.ok:
            return 0
        where = f"all {frames} frames are" if status.complete else f"the last good frame is {status.frame},"
        return say(f"{status.message}; {where} in {arguments.output}", 1)


def _self_contact(found):
    """Returns a :class:`warpcloth.run.simulate.SelfContactSummary` as JSON values; an infinite gap is None."""
    return found._asdict() | {"least_gap": found.least_gap if math.isfinite(found.least_gap) else None}


def _lines_of(found):
    """Yields the lines of the summary about pairs."""
    gap = "no pair was listed" if found["least_gap"] is None else f"least gap {found['least_gap']:.3g} m"
    counts = f"up to {found['pairs']:,} pairs, {found['lists']:,} lists of them"
    yield f"  contact       {counts}, {100.0 * found['kept']:.4g} % of moves kept, {gap}"
    if found["too_near"]:
        yield f"  too near      {found['too_near']}"
    if found["moved_apart"]:
        yield f"  moved apart   {found['moved_apart']}"
    if found["held_pins"]:
        yield f"  pins          {found['held_pins']}"


def _summary(facts, inside, forced):
    from ..core.status import digits

    measured = facts["residual_measure"] is not None
    residual = f"{digits(facts['residual'])} {facts['residual_unit']}" if measured else "none, the method does not compute one"
    touching = facts.get("self_contact")
    cut = [f"  cut short     {100.0 * facts['cut']:.3g} % of the moves of vertices, by contact"] if "cut" in facts else []
    return "\n".join(
        [
            f"{facts['scene']}: {facts['message']}",
            f"  frames        {facts['frames']} of {facts['frames_asked']}, {facts['seconds_per_frame']:.3g} s each (median)",
            f"  compiling     {facts['compile_seconds']:.3g} s",
            f"  worst strain  {100.0 * facts['worst_strain']:.3g} %",
            *cut,
            *(f"  inside        {each}" for each in inside),
            *(f"  forced        {each}" for each in forced),
            *(_lines_of(touching) if touching else ()),
            f"  residual      {residual}",
            f"  solver        {solver_line(facts)}",
            f"  device        {facts['device']}, {facts['dtype']}",
            f"  file          {location(facts)}",
            *(f"  {name:<13} {facts[name]}" for name in ("film", "csv", "report") if facts[name]),
        ]
    )
