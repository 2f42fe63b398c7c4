"""Lists options of solvers and parameters of scenes for ``-s help`` and ``-p help``, and completes them in a shell.

Completion parses source files, so that it need not load Warp. Only for the allowed words of a parameter, it runs the scene.
"""

import argparse
import contextlib
import os
from dataclasses import fields
from functools import partial

from ..base.extensions import load_extension, load_installed
from ..base.outputs import STAGE_ENDINGS
from ..base.texts import WORDS, json_text, kinds_of_parameter, parameters_of, words_in, words_of
from ..run.listing import folders, list_scenes, list_solvers
from ..solvers import SOLVERS
from .terminal import aligned

_HELP = "help"
DEFAULT = "newton"  # the default solver
_MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")  # those of warpcloth.mesh.loading, which loads Warp
_SIMULATORS = ("newton", "pbd", "uipc")  # those of warpcloth.others.simulators, which loads Warp


def asks_for_help(arguments):
    """Returns whether ``-s`` or ``-p`` asks for help."""
    return any(_HELP in (getattr(arguments, key, None) or ()) for key in "sp")


def show_help(arguments):
    """Lists the options of the solver for ``-s help`` and the parameters of the scene for ``-p help``."""
    found = {}
    if _HELP in getattr(arguments, "s", ()):
        found["options"] = _of_solver(getattr(arguments, "solver", None))
    if _HELP in getattr(arguments, "p", ()):
        found["parameters"] = _of_scene(_scene_name(arguments))
    print(json_text(found) if getattr(arguments, "json", False) else "\n\n".join(map(_text, found.values())))
    return 0


def _of_solver(name):
    name = name or DEFAULT
    record = SOLVERS[name]
    known = {field.name: str(field.metadata["range"]) for field in fields(record) if "range" in field.metadata}
    error = " or error (tolerance [m])" if "error" in record.step_options else ""
    note = f"give dt (the step [s]) or substeps (steps per frame){error}, or none, for which a step is chosen"
    return _listed(f"-s of {name}", record.__doc__, parameters_of(record), known) | {"note": note}


def _of_scene(name):
    from ..run.scene_files import find_source
    from ..scene.measured_fabrics import fabrics

    source = find_source(name)
    known = {"fabric": f"one of {', '.join(fabrics)}"}
    return _listed(f"-p of {source.path}", source.function.__doc__, source.parameters, known)


def _scene_name(arguments):
    name = next(filter(None, (getattr(arguments, key, None) for key in ("scene", "mesh", "file"))), None)
    if name is None:
        raise ValueError("-p help lists the parameters of a scene; give SCENE before it")
    return name


def _listed(title, doc, parameters, known):
    """Returns the options of a solver or a scene as JSON values; ``known`` are the allowed values, by name, of some."""
    rows = [
        {
            "name": name,
            "default": None if parameter.default is parameter.empty else parameter.default,
            "needed": parameter.default is parameter.empty,
            "allowed": _allowed(parameter, known.get(name)),
        }
        for name, parameter in parameters.items()
    ]
    return {"of": title, "meaning": (doc or "").strip().partition("\n")[0], "rows": rows}


def _text(found):
    lines = [found["of"] + (f": {found['meaning']}" if found["meaning"] else "")]
    rows = [(row["name"], _default(row), _values(row)) for row in found["rows"]]
    if not rows:
        return "\n".join([*lines, "  it has none"])
    lines += [f"  {line}" for line in aligned(rows)]
    return "\n".join([*lines, *([found["note"]] if "note" in found else [])])


def _default(row):
    return "needed" if row["needed"] else "–" if row["default"] is None else str(row["default"])


def _values(row):
    """Returns the allowed values, without None if that is the default."""
    return row["allowed"].removesuffix(", or none" if row["default"] is None and not row["needed"] else "")


def _allowed(parameter, text):
    """Returns the allowed values: ``text`` if it is not None, else the words or the types of its annotation."""
    kinds, words = kinds_of_parameter(parameter), words_in(parameter.annotation)
    if text is None and words:
        text = f"one of {', '.join(map(str, words))}"
    if text is None:
        text = " or ".join(words for kind, words in WORDS.items() if kind in kinds) or "nothing written as text"
    return text.replace("'", "") + (", or none" if type(None) in kinds else "")


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps line breaks, and puts SCENE before options that take several values."""

    def add_usage(self, usage, actions, groups, prefix=None):
        first = [action for action in actions if not action.option_strings and not isinstance(action.choices, dict)]
        for action in first:
            self._prog += f" {self._format_args(action, action.dest.upper())}"
        super().add_usage(usage, [action for action in actions if action not in first], groups, prefix)


# The options that several commands have, by the names of their values, as arguments of `add_argument`. The words of dtype are
# those of :data:`warpcloth.model.precision.DTYPES`, which loads Warp.
_SHARED = {
    "debug": {"action": "store_true", "help": "show the traceback of an error"},
    "device": {"default": "cpu", "help": "cpu (default), cuda:0, …"},
    "json": {"action": "store_true", "help": "print the result as one JSON object"},
    "dtype": {"choices": ("float32", "float64"), "help": "precision (default: by device and solver)"},
    "single_file": {"action": "store_true", "help": "write one file instead of a file and a folder of frames"},
}


def add_shared(parser, *names, **changes):
    """Adds options that several commands have; ``changes`` are changed arguments of `add_argument` by name of the option."""
    for name in names:
        parser.add_argument(f"--{name.replace('_', '-')}", **_SHARED[name] | changes.get(name, {}))


# The changes to ``dtype`` of commands that compute in float64 by default.
DOUBLE = {"default": "float64", "help": "precision (default: float64)"}


def add_stage(parser):
    """Adds the option that names a stage to write, which the command needs."""
    text = "the .usd, .usda, .usdc or .usdz file to write"
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=text)


def values_of(arguments, *names):
    """Returns the options of these names as keyword arguments."""
    return {name: getattr(arguments, name) for name in names}


def add_solver(parser, text):
    """Adds the option that names a solver."""
    names = solvers()
    parser.add_argument("--solver", choices=names, metavar="SOLVER", help=f"{text}: one of {', '.join(names)}")


def add_with(parser):
    """Adds the option that names other simulators."""
    text = "measure other simulators too: newton (the physics engine), pbd (pyPBD), uipc (libuipc); extras install them"
    parser.add_argument("--with", dest="others", nargs="+", metavar="SIMULATOR", choices=_SIMULATORS, help=text)


def add_scene(parser, **more):
    """Adds the scene and its parameters."""
    text = "a name that 'warpcloth scenes' lists, a .py file with a function scene(), a USD stage, or a mesh file"
    parser.add_argument("scene", metavar="SCENE", help=text, **more)
    add_values(parser, "-p", "parameter", "parameters of the scene")


# Parameters of scenes that have options of their own.
CLOTH = ("prim", "scale", "fabric")


def add_cloth(parser):
    """Adds the options of a cloth that is read from a file."""
    add = parser.add_argument
    add("--prim", help="path or name of the cloth's prim, if the stage has several meshes, or of the geometry of a mesh file")
    add("--scale", metavar="M", help="metres per unit of a mesh file, such as 0.01 for centimetres (default: 1)")
    add_fabric(parser)
    add_pins(parser)
    parser.set_defaults(of_scene=CLOTH)


def add_fabric(parser):
    """Adds the option for the parameter ``fabric`` of a scene."""
    text = "fabric of the cloth, one of 'warpcloth fabrics' (default for a mesh file: cotton)"
    parser.add_argument("--fabric", metavar="NAME", help=text)
    parser.set_defaults(of_scene=("fabric",))


def add_pins(parser):
    """Adds the option that replaces the pins of a scene."""
    text = "pin these vertices in place of the scene's pins, such as 'x < 0.1' or boundary"
    parser.add_argument("--pins", metavar="SELECTION", help=text)


def add_values(parser, option, of, text):
    """Adds an option that takes assignments, such as ``-s substeps=4``."""
    text = f"{text}; '{option} help' lists them"
    parser.add_argument(option, nargs="+", action="extend", default=[], metavar=f"{of}=value", help=text)


def add_import(parser):
    """Adds the option that names modules from outside the package."""
    text = "load energies or solvers from a module or a .py file; may be repeated (see docs/extending.md)"
    parser.add_argument("--import", dest="imports", action="append", default=[], metavar="MODULE", help=text)


def load_extensions(argv):
    """Imports the modules that a command line names, before its parser is built, and those that installed packages name.

    Raises:
        ValueError: A module of the command line cannot be imported.
    """
    completes = "_ARGCOMPLETE" in os.environ
    if completes:
        argv = os.environ.get("COMP_LINE", "").split()
    only = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    add_import(only)
    load_installed()
    try:
        names = only.parse_known_args(argv)[0].imports
    except argparse.ArgumentError:  # a missing name, which the main parser reports better
        return
    for name in names:
        with contextlib.suppress(*[ValueError] * completes):  # the shell may be completing the name
            load_extension(name)


def complete(parser):
    """Completes a command line and exits if a shell asks for it by argcomplete; otherwise does nothing."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    import argcomplete

    files = {"scene": argcomplete.FilesCompleter((*STAGE_ENDINGS, *_MESHES, ".py")), "mesh": argcomplete.FilesCompleter()}
    files["imports"] = argcomplete.FilesCompleter((".py",))
    _add_completers(parser, files)
    argcomplete.autocomplete(parser)


def _add_completers(parser, files):
    for action in parser._actions:
        if isinstance(action.choices, dict) and action.dest == "==SUPPRESS==":
            for command in action.choices.values():
                _add_completers(command, files)
        elif action.dest == "imports":
            action.completer = files["imports"]
        elif action.dest in files:
            action.completer = partial(_scenes, files[action.dest])
        elif action.dest == "s":
            action.completer = _solver_words
        elif action.dest == "p":
            action.completer = _scene_words


def solvers():
    """Returns a dict of solvers: by name a dict from options to the words that they take, or ()."""
    found = dict(list_solvers())
    for record in [SOLVERS[name] for name in SOLVERS if name not in found]:  # those of extensions
        found[record.name] = dict.fromkeys((field.name for field in fields(record)), ()) | words_of(record)
    return found


def _scenes(files, prefix, **_):
    known = {listed.name for folder in folders() for listed in list_scenes(folder)}
    return [*sorted(known), *files(prefix)]


def _solver_words(prefix, parsed_args, **_):
    return _words(prefix, solvers()[getattr(parsed_args, "solver", None) or DEFAULT])


def _scene_words(prefix, parsed_args, **_):
    name, sign, _value = prefix.partition("=")
    scene = _scene_name(parsed_args)
    if sign:
        (text,) = [row["allowed"] for row in _of_scene(scene)["rows"] if row["name"] == name] or [""]
        words = text.removeprefix("one of ").split(", ") if text.startswith("one of ") else []
        return _words(prefix, {name: [word.removeprefix("or ") for word in words]})
    listed = {listed.name: listed for folder in folders()[::-1] for listed in list_scenes(folder)}
    known = listed[scene].parameters if scene in listed else [row["name"] for row in _of_scene(scene)["rows"]]
    return _words(prefix, dict.fromkeys((text.partition("=")[0] for text in known), ()))


def _words(prefix, options):
    """Completes ``name=`` for each name, or ``name=value`` for each of its words once the name is typed."""
    name, sign, _value = prefix.partition("=")
    if not sign:
        return [f"{name}=" for name in options] + [_HELP]
    return [f"{name}={word}" for word in options.get(name, ())]
