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
from .terminal import StandardStreams, say, warnings_once


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


# In the order of the manual. Each module has the text of the command, its arguments, and a function of its own name.
_COMMANDS = (
    run,
    info,
    deform,
    analyze,
    compare,
    resample,
    measure,
    check,
    render,
    view,
    convert,
    chart,
    choose,
    bench,
    fit,
    fabrics,
    scenes,
)
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
    for module in _COMMANDS:
        name = module.__name__.rpartition(".")[2]
        if module is chart:  # each chart has the options of all commands
            chart.add_arguments(commands.add_parser(name, description=chart.TEXT, allow_abbrev=False))
            continue
        form = {"formatter_class": options.HelpFormatter, "epilog": getattr(module, "EPILOG", None)}
        sub = commands.add_parser(name, description=module.TEXT, allow_abbrev=False, **form)
        sub.set_defaults(command=getattr(module, name))
        options.add_shared(sub, "debug")
        options.add_import(sub)
        module.add_arguments(sub)
    about = {name: command.description for name, command in commands.choices.items()}
    groups = ["\n".join([f"{group}:", *(f"  {name:9} {about[name]}" for name in names)]) for group, names in _GROUPS.items()]
    parser.epilog = "\n\n".join([*groups, "'warpcloth COMMAND --help' has the options and examples of a command."])
    return parser
