"""The command ``warpcloth``: runs scenes, lists them, and says what is in one.

Exit codes: 0 success (converged, completed, or iterations used up, which the summary says), 1 diverged (the good frames are
saved), 2 wrong use (one line on stderr), 130 interrupted. Any other error ends with 2 and one line as well, for most come of
what a scene file declares; with ``--debug`` the traceback stands above the line.
"""

import argparse
import json
import math
import os
import shutil
import statistics
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from . import scene_files

# A step that all solvers but the explicit ones take well; where no step is given the substeps come nearest to it.
_STEPS_A_SECOND = 240
_EXPLICIT_MARGIN = 1.1
# More substeps a frame than this, and the implicit solver is worth a hint.
_MANY_SUBSTEPS = 1000

_EPILOG = """\
Where neither dt nor substeps is given: newton and pbd take the substeps that come nearest to 1/240 s; explicit the fewest
that are 10 % below the limit about the rest shape and below the bound for motion (exact for springs; hinges count as at rest).
"""


def main(argv=None):
    """Runs the command line.

    Args:
        argv: Arguments, or those of the process.

    Returns:
        int: The exit code.
    """
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        debug = False
        try:
            parser = _parser()
            try:
                arguments = parser.parse_args(argv)
            except SystemExit as done:  # --help and --version
                return done.code
            if arguments.command is None:
                parser.print_help(sys.stderr)
                return 2
            debug = arguments.debug
            return arguments.command(arguments)
        except _Interrupted as interrupted:
            return _say(interrupted, 130)
        except KeyboardInterrupt:
            return _say("interrupted; nothing was saved", 130)
        except (Exception, SystemExit) as error:
            if debug:
                traceback.print_exc()
            return _say(_sentence(error, debug), 2)


def _sentence(error, debug):
    """What an error says; ours are sentences, others need their kind, and a hint at how to see more."""
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.strerror and error.filename else error
    if isinstance(error, ValueError) and not isinstance(error, np.linalg.LinAlgError):
        return error
    more = "" if debug else " (run again with --debug for the traceback)"
    return type(error).__name__ + (f": {error}" if str(error) else "") + more


class _Interrupted(Exception):
    """A run was interrupted; the message says what is saved."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message):
        raise ValueError(f"{message}; see {self.prog} --help")


def _parser():
    from .model import DTYPES
    from .solvers import SOLVERS

    parser = _Parser(prog="warpcloth", description="Cloth simulation, written as USD.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"warpcloth {_version()}")
    parser.set_defaults(command=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")

    def add(name, command, text, **more):
        form = argparse.RawDescriptionHelpFormatter
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False, formatter_class=form, **more)
        sub.set_defaults(command=command)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        return sub

    run = add("run", _run, "Run a scene and write its animation as USD.", epilog=_EPILOG)
    info = add("info", _info, "Say what is in a scene, and what is built from it.", epilog=_EPILOG)
    for sub in (run, info):
        sub.add_argument("scene", metavar="SCENE", help="a .py file with a function scene(), a USD stage, or a known name")
        sub.add_argument("--solver", choices=SOLVERS, help="newton where not given")
        sub.add_argument("-s", nargs="+", action="extend", default=[], metavar="option=value", help="options of the solver")
        sub.add_argument("-p", nargs="+", action="extend", default=[], metavar="parameter=value", help="of the scene")
        sub.add_argument("--device", default="cpu", help="cpu (default), cuda:0, …")
        sub.add_argument("--dtype", choices=DTYPES, default="float32")
        sub.add_argument("--json", action="store_true", help="print one JSON object")
    run.add_argument("--frames", type=int, metavar="N", help="that many frames after the first, if not the scene's")
    run.add_argument("-o", "--output", required=True, metavar="FILE", help="the .usd, .usda, .usdc or .usdz file to write")
    run.add_argument("--single-file", action="store_true", help="one file in the end, with no folder of frames beside it")
    scenes = add("scenes", _scenes, "List scenes and their parameters.")
    scenes.add_argument("folder", nargs="?", help="a folder of .py files, if not the ones whose scenes are known by name")
    return parser


def _run(arguments):
    from .simulate import simulate

    source, values, scene = _scene(arguments)
    frames = scene.frames if arguments.frames is None else arguments.frames
    _check_writable(arguments.output)
    device = _device(arguments.device)
    setup = _setup(arguments, scene, device)
    progress = _Progress(frames, _hint(arguments, setup, scene))
    try:
        animation = simulate(
            scene if setup.model is None else _Built(scene, setup.model),
            setup.checked,
            output=arguments.output,
            device=device,
            dtype=arguments.dtype,
            frames=frames,
            single_file=arguments.single_file,
            progress=progress,
        )
    except KeyboardInterrupt:
        raise _Interrupted(progress.interrupted(arguments.output)) from None
    finally:
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
        **_solver_facts(arguments, setup, scene.fps),
        "device": str(device),
        "dtype": arguments.dtype,
        "file": arguments.output,
        "frames_folder": _frames_folder(arguments),
    }
    print(_json(facts) if arguments.json else _summary(facts))
    if status.ok:
        return 0
    return _say(f"{status.message}; the last good frame is {status.frame}, in {arguments.output}", 1)


def _summary(facts):
    place = facts["file"]
    if facts["frames_folder"]:
        place += f", with its frames in {facts['frames_folder']}\n                "
        place += "(they belong together: move both, or make one file with --single-file)"
    return "\n".join(
        [
            f"{facts['scene']}: {facts['message']}",
            f"  frames        {facts['frames']} of {facts['frames_asked']}, {facts['seconds_per_frame']:.3g} s each (median)",
            f"  compiling     {facts['compile_seconds']:.3g} s",
            f"  worst strain  {100.0 * facts['worst_strain']:.3g} %",
            f"  residual      {facts['residual']:.2g}",
            f"  solver        {_solver_line(facts)}",
            f"  device        {facts['device']}, {facts['dtype']}",
            f"  file          {place}",
        ]
    )


def _info(arguments):
    _source, values, scene = _scene(arguments)
    device = _device(arguments.device)
    setup = _setup(arguments, scene, device, limits=True) if arguments.solver or arguments.s else _Setup()
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
    facts["model"] = model.report()
    print(_json(facts) if arguments.json else f"{scene}\n{_info_text(facts)}")
    hint = setup.solver and _hint(arguments, setup, scene)
    if hint:
        print(hint, file=sys.stderr)
    return 0


def _info_text(facts):
    model, solver = facts["model"], facts["solver"]
    lines = ["parameters: " + (", ".join(f"{k}={v!r}" for k, v in facts["scene"]["parameters"].items()) or "none")]
    lines.append(f"model on {model['device']}, {model['dtype']}: {model['bytes']:,} bytes")
    lines += [f"  {term['term']}: {term['elements']} elements, {term['bytes']:,} bytes" for term in model["terms"]]
    if solver:
        lines.append(f"solver: {_solver_line(solver)}")
        if "limit_about_rest" in solver:
            fps = facts["scene"]["fps"]
            for text, key in (("about the rest shape", "limit_about_rest"), ("in motion", "limit_in_motion")):
                lines.append(f"  stable {text} below {solver[key]:.4g} s, from {_fewest(fps, solver[key])} substeps a frame")
        lines.append("kernels: " + ", ".join(model["kernels"]))
    return "\n".join(lines)


def _scenes(arguments):
    folders = [arguments.folder] if arguments.folder else scene_files.folders()
    for folder, scenes in [(folder, scene_files.list_scenes(folder)) for folder in folders]:
        print(f"{folder}:")
        for listed in scenes:
            details = [listed.summary, ", ".join(listed.parameters), listed.meaning]
            print(f"  {listed.name}")
            print("".join(f"      {detail}\n" for detail in details if detail), end="")
    if not folders:
        print("no folder ./scenes, and none that came with the package; give a folder")
    return 0


def _scene(arguments):
    """(source, values of its parameters, scene) that the arguments name."""
    source = scene_files.find_source(arguments.scene)
    values = source.values(scene_files.assignments(arguments.p))
    return source, values, source.scene(values)


def _device(name):
    """The Warp device of a name, with Warp's greeting left out."""
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    _initialise_warp(wp)
    devices = [device.alias for device in wp.get_devices()]
    if name not in devices and not (name == "cuda" and len(devices) > 1):
        raise ValueError(f"device is {name!r}; on this machine there are {', '.join(devices)}")
    return wp.get_device(name)


def _initialise_warp(wp):
    """Initialises Warp without its native line about a missing CUDA driver, which is no news where only a CPU is asked for."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as said:
        before = os.dup(2)
        try:
            os.dup2(said.fileno(), 2)
            wp.init()
        finally:
            os.dup2(before, 2)
            os.close(before)
            said.seek(0)
            lines = said.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "load the NVIDIA CUDA driver" not in line))


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


def _setup(arguments, scene, device, limits=False):
    """The solver that the arguments name; ``limits`` asks for those of explicit even where its step is given."""
    from .solvers import SOLVERS

    arguments.solver = arguments.solver or "newton"
    record = SOLVERS[arguments.solver]
    given = scene_files.options(record, scene_files.assignments(arguments.s))
    step_given = "dt" in given or "substeps" in given
    solver = record(**given, **({} if step_given else {"substeps": 1}))  # a wrong option is said before anything is built
    if arguments.solver != "explicit":
        if step_given:
            return _Setup(solver, solver)
        solver = replace(solver, substeps=max(1, round(_STEPS_A_SECOND / scene.fps)))
        return _Setup(solver, solver, "by default about 1/240 s")
    if step_given and not limits:
        return _Setup(solver, solver)
    from .solvers.explicit import step_limits

    began = time.perf_counter()
    model = scene.build(device=device, dtype=arguments.dtype)
    rest, motion = step_limits(model)
    setup = _Setup(solver, solver, None, model, (rest, motion), time.perf_counter() - began)
    if not step_given:
        setup.solver = replace(solver, substeps=_fewest(scene.fps, min(rest / _EXPLICIT_MARGIN, motion)))
        setup.chosen = f"by default the fewest stable ones, limits {rest:.3g} and {motion:.3g} s"
    setup.checked = setup.solver
    if solver.scheme == "symplectic" and 1.0 / (scene.fps * setup.solver.per_frame(scene.fps)) < min(rest, motion):
        setup.checked = replace(setup.solver, above_limit="allow")  # which leaves out a second search for the limits
    return setup


def _fewest(fps, limit):
    """The fewest substeps a frame whose step is below ``limit``."""
    return math.floor(1.0 / (fps * limit)) + 1


def _hint(arguments, setup, scene):
    """A line for those who may wait longer than they need, or None."""
    substeps = setup.solver.per_frame(scene.fps)
    if arguments.solver != "explicit" or substeps <= _MANY_SUBSTEPS:
        return None
    return f"warpcloth: hint: explicit takes {substeps:,} substeps a frame here; --solver newton may suit better"


def _solver_facts(arguments, setup, fps):
    step = 1.0 / (fps * setup.solver.per_frame(fps))
    return {"solver": arguments.solver, "options": asdict(setup.solver), "step": step, "step_chosen": setup.chosen}


def _solver_line(facts):
    options = ", ".join(f"{name}={value}" for name, value in facts["options"].items() if value is not None)
    return f"{facts['solver']}({options}), step 1/{1.0 / facts['step']:.6g} s" + (
        f" ({facts['step_chosen']})" if facts["step_chosen"] else ""
    )


def _frames_folder(arguments):
    """The folder that belongs to the output, or None where the output is one file."""
    from .usd.writer import frames_folder

    output = Path(arguments.output)
    return None if arguments.single_file or output.suffix == ".usdz" else str(frames_folder(output))


def _check_writable(output):
    """Finds out before the first frame, and not after ten, that a folder cannot be written."""
    folder = os.path.dirname(os.path.realpath(output))  # of a link the folder of the file that it stands for
    try:
        if os.path.isdir(folder):
            tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ValueError(f"output = {output}: the folder {folder} cannot be written ({error.strerror})") from None


class _Progress:
    """Counts frames, and shows them on a terminal."""

    def __init__(self, frames, hint=None):
        self.frame, self.frames, self.hint, self.bar = None, frames, hint, None
        if sys.stderr.isatty():
            from tqdm import tqdm

            form = "{desc}{percentage:3.0f}%|{bar}| {n_fmt} of {total_fmt} frames{postfix}, {remaining} left"
            # tqdm hides the bar on a terminal that does not know its size.
            size = shutil.get_terminal_size()
            shape = {"ncols": min(size.columns, 120), "nrows": size.lines}
            self.bar = tqdm(total=frames, desc="compiling: ", bar_format=form, leave=False, file=sys.stderr, **shape)

    def __call__(self, frame, frames):
        self.frame = frame
        if frame == 0 and self.hint:  # now that nothing was refused, and while it can still be followed
            if self.bar is not None:
                self.bar.clear()
            print(self.hint, file=sys.stderr)
        if self.bar is None:
            return
        if frame == 0:
            self.bar.set_description("running", refresh=False)
            self.bar.reset()
        else:
            elapsed = self.bar.format_dict["elapsed"]
            self.bar.set_postfix_str(f"{elapsed / frame:.3g} s each", refresh=False)
            self.bar.update()

    def close(self):
        if self.bar is not None:
            self.bar.close()

    def interrupted(self, output):
        """What a run leaves that ends here."""
        if self.frame is None:
            return "interrupted before the first frame; nothing was saved"
        return f"interrupted after frame {self.frame} of {self.frames}; frames 0 to {self.frame} are in {output}"


def _json(facts):
    return json.dumps(_plain(facts), allow_nan=False)


def _plain(value):
    """``value`` with numbers that JSON does not have as texts: "inf", "nan"."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def _version():
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("warpcloth")
    except PackageNotFoundError:
        return "(a checkout that is not installed)"


def _show_warning(message, category, filename, lineno, file=None, line=None):
    print(f"warpcloth: warning: {message}", file=sys.stderr)


def _say(message, code):
    print("warpcloth:", " ".join(str(message).split()), file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
