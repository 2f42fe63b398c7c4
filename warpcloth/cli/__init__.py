"""The command ``warpcloth``: runs, lists and describes scenes, deforms meshes, measures, compares, checks and draws animations,
charts and benchmarks methods.

Exit codes: 0 success (converged or completed, as the summary says); 1 not usable (all frames are saved) or diverged (the good
frames are saved), or `check` found something; 2 wrong use (one line on stderr); 130 interrupted by Ctrl-C and 143 by SIGTERM,
as in shells (a line says what is saved). Any other error also ends with 2 and one line, because most come from a scene file;
``--debug`` prints the traceback above the line.

Help and completion do not load Warp: modules of commands import it inside functions, and `main` imports everything before it
runs a command. No other part of the package defers an import of its own modules.
"""

import argparse
import gc
import re
import sys
import traceback
import warnings

import numpy as np

from ..base.checks import did_you_mean
from ..base.interrupts import Interrupts
from ..base.version import installed_version
from . import (
    analyze,
    bench,
    chart,
    check,
    choose,
    compare,
    convert,
    deform,
    fabrics,
    fit,
    info,
    measure,
    options,
    render,
    resample,
    run,
    scenes,
    view,
)
from .terminal import DTYPES, StandardStreams, say, warnings_once


def main(argv=None):
    """Runs the command line.

    Args:
        argv: Arguments, or those of the process.

    Returns:
        int: The exit code.
    """
    with StandardStreams() as streams:
        streams.code = _run(argv)
    return streams.code


def _run(argv):
    with warnings.catch_warnings(), Interrupts() as interrupts:
        warnings.showwarning = warnings_once()
        debug = False
        try:
            options.load_extensions(sys.argv[1:] if argv is None else argv)
            parser = _parser()
            options.complete(parser)
            try:
                arguments = parser.parse_args(argv)
            except SystemExit as done:  # --help and --version
                return done.code
            if arguments.command is None:
                parser.print_help(sys.stderr)
                return 2
            debug = arguments.debug
            with interrupts.loading():
                from .. import simulate  # noqa: F401  loads Warp, which takes most of the time
            if argv is None:  # modules stay until the process ends, so the collector need not search them
                gc.freeze()
            if options.asks_for_help(arguments):
                return options.show_help(arguments)
            return arguments.command(arguments)
        except KeyboardInterrupt as interrupted:
            interrupts.over = True
            return say(str(interrupted) or "interrupted", interrupts.code)
        except (Exception, SystemExit) as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # raised while a class was created
                interrupts.over = True
                return say("interrupted", interrupts.code)
            if debug:
                traceback.print_exc()
            return say(_sentence(error, debug), 2)


def _sentence(error, debug):
    """Returns the line for an error: its message if it is ours, else with its type and a hint at --debug."""
    if isinstance(error, OSError):
        if error.strerror is None:
            return error
        return f"{error.filename or 'a file could not be read or written'}: {error.strerror}"
    refused = isinstance(error, RuntimeError) and str(error).startswith("Failed to allocate")  # by Warp
    if refused or isinstance(error, MemoryError):
        less = "a smaller mesh or picture, fewer copies or fewer frames take less"
        return f"there is not enough memory; {less}: {error}".removesuffix(": ")
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply to be read: {error}"
    if isinstance(error, ImportError) and error.name is None:  # our message about a missing extra
        return error
    if isinstance(error, ValueError) and not isinstance(error, np.linalg.LinAlgError):
        return error
    more = "" if debug else " (run again with --debug for the traceback)"
    return type(error).__name__ + (f": {error}" if str(error) else "") + more


_GROUPS = {
    "make": ("run", "deform", "resample", "convert"),
    "look": ("scenes", "fabrics", "info", "view", "render"),
    "measure": ("analyze", "compare", "check", "measure", "bench", "chart"),
    "choose": ("choose", "fit"),
}


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        # argparse would take "-1e-3", "-1,0,0" and "-1:2" for options, before Python 3.14.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def parse_known_args(self, args=None, namespace=None):
        self._given = sys.argv[1:] if args is None else args
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:  # here, because argparse would leave those of a command to the parser of all commands
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return namespace, unknown

    def _check_value(self, action, value):
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(value, map(str, action.choices))
            raise

    def error(self, message):
        if message.startswith("unrecognized arguments: -"):
            message += did_you_mean(message.split()[2], self._option_string_actions)
        _said, required, names = message.partition(" are required: ")
        first = {action.metavar for action in self._get_positional_actions()} & set(names.split(", "))
        several = {option for action in self._get_optional_actions() if action.nargs == "+" for option in action.option_strings}
        takes = next((option for option in self._given if option in several), None)
        if required and first and takes:
            message += f" ({' and '.join(sorted(first))} must stand before {takes}, which takes all that follows it)"
        raise ValueError(f"{message}; see {self.prog} --help")


def _parser():
    about = {"description": "Simulate cloth and write it as USD.", "usage": "%(prog)s [-h] [--version] COMMAND ..."}
    parser = _Parser(prog="warpcloth", **about, formatter_class=options.HelpFormatter, allow_abbrev=False)
    version = installed_version() or "(a checkout that is not installed)"
    parser.add_argument("--version", action="version", version=f"warpcloth {version}")
    parser.set_defaults(command=None)
    commands = parser.add_subparsers(prog=parser.prog, metavar="COMMAND", help=argparse.SUPPRESS)

    def add(name, command, text, **more):
        form = {"formatter_class": options.HelpFormatter, "allow_abbrev": False}
        sub = commands.add_parser(name, description=text, **form, **more)
        sub.set_defaults(command=command)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        options.add_import(sub)
        return sub

    runs = add("run", run.run, "Run a scene and write its animation as USD.", epilog=run.EPILOG)
    infos = add("info", info.info, "Show what a scene contains, and the model that is built from it.", epilog=info.EPILOG)
    deforms = add("deform", deform.deform, "Deform a mesh by handles, as rigidly as possible (ARAP).", epilog=deform.EPILOG)
    deform.add_arguments(deforms)
    analyzes = add("analyze", analyze.analyze, "Measure how an animated cloth deforms.", epilog=analyze.EPILOG)
    analyze.add_arguments(analyzes)
    compares = add("compare", compare.compare, "Measure the distance between two animations.", epilog=compare.EPILOG)
    compare.add_arguments(compares)
    text = "Move a mesh onto each frame of a capture, so that its triangles stay."
    resamples = add("resample", resample.resample, text, epilog=resample.EPILOG)
    resample.add_arguments(resamples)
    measures = add("measure", measure.measure, "Read what a device of a textile laboratory measures.", epilog=measure.EPILOG)
    options.add_scene(measures)
    measure.add_arguments(measures)
    checks = add("check", check.check, "Find what intersects in an animation, exactly.", epilog=check.EPILOG)
    check.add_arguments(checks)
    renders = add("render", render.render, "Draw a picture or a film of an animation.", epilog=render.EPILOG)
    render.add_arguments(renders)
    views = add("view", view.view, "Write a page that shows an animation in a browser.", epilog=view.EPILOG)
    view.add_arguments(views)
    converts = add("convert", convert.convert, "Write an animation in another format.", epilog=convert.EPILOG)
    convert.add_arguments(converts)
    charts = commands.add_parser("chart", description=chart.TEXT, allow_abbrev=False)
    chart.add_arguments(charts)
    chooses = add("choose", choose.choose, "Choose the cheapest solver and settings for a scene.", epilog=choose.EPILOG)
    choose.add_arguments(chooses)
    benches = add("bench", bench.bench, "Measure the time and memory of frames, or compare two results.", epilog=bench.EPILOG)
    bench.add_arguments(benches)
    fitted = add("fit", fit.fit, "Find parameters with which a scene moves as measured.", epilog=fit.EPILOG)
    fit.add_arguments(fitted)
    for sub in (runs, infos):
        options.add_scene(sub)
        of_info = "also show the step and the kernels of this solver (default: none, or newton if -s or --advise is given)"
        options.add_solver(sub, of_info if sub is infos else "the solver (default: newton)")
        options.add_values(sub, "-s", "option", "options of the solver")
        options.add_cloth(sub)
    infos.add_argument(
        "--advise",
        action="store_true",
        help="find out whether each term, the precision, the step and the resolution matter to the result",
    )
    infos.add_argument(
        "--tolerance", metavar="SHARE", help="with --advise: the largest change that does not matter (default: 1%%)"
    )
    infos.add_argument(
        "--frames", type=int, metavar="N", help="with --advise: number of frames to simulate (default: at most 30)"
    )
    runs.add_argument(
        "--tolerance",
        metavar="SHARE",
        help="find the cheapest solver and settings with at most this error, such as 1%% of the size of the cloth, and run "
        "with them; this takes many trial runs, see 'warpcloth choose'",
    )
    runs.add_argument(
        "--budget",
        metavar="TIME",
        help="find the most accurate solver and settings within this time per frame, such as 16ms, and run with them",
    )
    runs.add_argument(
        "--frames", type=int, metavar="N", help="number of frames after the start (default: those of the scene's duration)"
    )
    for sub in (
        runs,
        infos,
        deforms,
        analyzes,
        compares,
        resamples,
        measures,
        checks,
        renders,
        views,
        chooses,
        benches,
        fitted,
    ):
        if sub is not checks:
            sub.add_argument("--device", default="cpu", help="cpu (default), cuda:0, …")
        sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
    for sub in (runs, infos, deforms, analyzes, chooses, benches, fitted):
        default = "float64" if sub in (deforms, analyzes, fitted) else None
        text = default or "by device and solver"
        sub.add_argument("--dtype", choices=DTYPES, default=default, help=f"precision (default: {text})")
    for sub in (runs, deforms, resamples):
        text = "the .usd, .usda, .usdc or .usdz file to write"
        text += (
            ""
            if sub is not runs
            else " (default: named after the scene, such as hanging.usdc; an existing file is then not replaced)"
        )
        sub.add_argument("-o", "--output", required=sub is not runs, metavar="FILE", help=text)
    runs.add_argument("--film", metavar="FILE", help="also draw the run as a film, .mp4, .webp or .gif; see 'warpcloth render'")
    runs.add_argument("--csv", metavar="FILE", help="also write a table of energies and forces, one row per frame")
    runs.add_argument("--report", metavar="FILE", help="also write energies, forces and the reaction of each pin as JSON")
    runs.add_argument(
        "--resume",
        action="store_true",
        help="continue the interrupted run to this output from its last checkpoint; there is one every ten frames",
    )
    for sub in (runs, deforms, resamples, analyzes, checks):
        sub.add_argument("--single-file", action="store_true", help="write one file instead of a file and a folder of frames")
    lists = add("fabrics", fabrics.fabrics, "List measured fabrics, their moduli, bending lengths and sources.")
    text = "show one fabric, or list those of a file instead: .json of ARCSim, or a .csv table of KES-F or FAST measurements"
    lists.add_argument("file", metavar="NAME|FILE", nargs="?", help=text)
    lists = add("scenes", scenes.scenes, "List scenes and their parameters.")
    lists.add_argument(
        "folder", metavar="FOLDER", nargs="?", help="a folder of scene files (default: ./scenes and the included scenes)"
    )
    about = {name: command.description for name, command in commands.choices.items()}
    groups = ["\n".join([f"{group}:", *(f"  {name:9} {about[name]}" for name in names)]) for group, names in _GROUPS.items()]
    parser.epilog = "\n\n".join([*groups, "'warpcloth COMMAND --help' has the options and examples of a command."])
    return parser
