"""Scenes in files: found by name or path, listed, and called with parameters that are written as text."""

import ast
import importlib.util
import inspect
import itertools
import math
import os
import sys
import types
import typing
from dataclasses import dataclass, fields, replace
from pathlib import Path

from ..base.checks import number
from ..base.renamed import new_name
from ..scene.scene import Scene
from ..usd import ENDINGS as STAGES
from ..usd import read_scene

WORDS = {bool: "true or false", int: "a whole number", float: "a number, or two as in 1/240", str: "a text"}
_TRUTH = dict.fromkeys(("true", "yes", "on", "1"), True) | dict.fromkeys(("false", "no", "off", "0"), False)
_number_of_modules = itertools.count()


def folders():
    """Folders of scenes that are known by their names: ./scenes, then those that come with the package."""
    found = [Path("scenes"), Path(__file__).parents[1] / "scenes"]
    return list({folder.resolve(): folder for folder in reversed(found) if folder.is_dir()})[::-1]


@dataclass(frozen=True)
class SceneSource:
    """What makes a scene: the ``scene`` function of a Python file, or a USD stage.

    Attributes:
        path: The file.
        function: Called with ``parameters`` by name, returns a :class:`warpcloth.Scene`.
        parameters: Of the function, as `inspect.Parameter` by name.
        pins: A selection of vertices that stand still and replace the pins of the scene, or None.
    """

    path: Path
    function: typing.Callable
    parameters: dict
    pins: str | None = None

    def values(self, texts):
        """The parameters that ``texts`` (text by name) sets, converted, and the defaults of the others.

        Raises:
            ValueError: A name or a value that the function does not take, or one missing that it needs.
        """
        values = {name: p.default for name, p in self.parameters.items() if p.default is not p.empty}
        for name, text in texts.items():
            if name not in self.parameters:
                raise ValueError(f"{self.path} has no parameter {name!r}; {_allowed(self.parameters)}")
            values[name] = convert(name, text, kinds_of_parameter(self.parameters[name]))
        missing = [name for name in self.parameters if name not in values]
        if missing:
            raise ValueError(f"{self.path} needs a value for {missing[0]}; give it with -p {missing[0]}=…")
        return values

    def scene(self, values):
        """Builds the scene for the values of the parameters.

        Raises:
            ValueError: The function raises (the message has its file and line) or returns no scene, or ``pins`` selects no
                vertex.
        """
        if self.path.suffix in STAGES:
            scene = self.function(**values)
        else:
            with _Located(self.path):
                scene = self.function(**values)
            if not isinstance(scene, Scene):
                raise ValueError(f"{self.path}: scene() returned a {type(scene).__name__}; it must return a warpcloth.Scene")
        if self.pins is None:
            return scene
        return replace(scene, pins=some_vertices(f"--pins {self.pins!r}", self.pins, scene.mesh))


def some_vertices(option, selection, mesh):
    """Returns the vertices that an option selects.

    Raises:
        ValueError: It selects none, or does not follow the grammar of selections.
    """
    vertices = mesh.select(selection)
    if not len(vertices):
        low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in (mesh.points.min(0), mesh.points.max(0)))
        raise ValueError(f"{option} names no vertex; the mesh reaches from ({low}) to ({high})")
    return vertices


def find_source(name, pins=None):
    """The scene that a Python file, a USD stage or a name in one of :func:`folders` stands for.

    Args:
        name: One of the three.
        pins: See :class:`SceneSource`.

    Raises:
        FileNotFoundError: There is no such file or name.
        ValueError: The file cannot be loaded, or has no function ``scene``.
    """
    path = Path(name)
    if not path.suffix and path.name == str(name):
        candidates = [folder / f"{name}.py" for folder in folders()]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            known = sorted({listed.name for folder in folders() for listed in list_scenes(folder)})
            raise FileNotFoundError(
                f"there is no scene {name!r}; known by name are {', '.join(known) or 'none'}; or give a .py file or a USD stage"
            )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: {'is a folder, no scene' if path.is_dir() else 'there is no such file'}")
    if path.suffix == ".py":
        return _python_source(path, pins)
    if path.suffix in STAGES:
        parameters = parameters_of(read_scene)
        del parameters["path"]
        return SceneSource(path, lambda **values: read_scene(str(path), **values), parameters, pins)
    raise ValueError(f"{path}: is no scene; it must be a .py file or a USD stage ({', '.join(STAGES)})")


def _python_source(path, pins):
    # Under a name of its own: scenes may be called like modules, and may be loaded again after a change.
    name = f"warpcloth_scene_{next(_number_of_modules)}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    with _Located(path):
        spec.loader.exec_module(module)
        function = getattr(module, "scene", None)
        if callable(function):
            return SceneSource(path, function, parameters_of(function), pins)
    raise ValueError(f"{path}: has no function scene(); it must have one that returns a warpcloth.Scene")


def parameters_of(function):
    """Returns the `inspect.Parameter` of each parameter of a function, or of a record of options, by name."""
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    found = inspect.signature(function, eval_str=True).parameters
    return {name: parameter for name, parameter in found.items() if parameter.kind in by_name}


class _Located:
    """Turns any error of a scene file, and an exit, into a ValueError of one line that says where in the file it arose."""

    def __init__(self, path):
        self.path = path

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if error is None or isinstance(error, KeyboardInterrupt):
            return
        message, line = " ".join(str(error).split()), None
        names = (str(self.path), os.path.abspath(self.path))
        if isinstance(error, SyntaxError) and error.filename in names:
            message, line = error.msg, error.lineno
        while trace is not None:
            if trace.tb_frame.f_code.co_filename in names:
                line = trace.tb_lineno
            trace = trace.tb_next
        where = str(self.path) if line is None else f"{self.path}, line {line}"
        raise ValueError(f"{where}: {kind.__name__}" + (f": {message}" if message else "")) from error


@dataclass(frozen=True)
class Listed:
    """A scene file as :func:`list_scenes` shows it: the first lines of two docstrings, and ``name=default`` texts."""

    name: str
    summary: str
    parameters: tuple = ()
    meaning: str = ""


def list_scenes(folder):
    """The Python files of a folder that have a function ``scene``, read without running them.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: there is no such folder")
    listed = []
    for path in sorted(folder.glob("*.py")):
        try:
            tree = ast.parse(path.read_bytes())
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:  # the last two from too deep nesting
            listed.append(Listed(path.stem, f"cannot be read: {error}"))
            continue
        function = next((n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "scene"), None)
        if function is not None:
            listed.append(Listed(path.stem, _first_line(tree), _defaults(function.args), _first_line(function)))
    return listed


def _first_line(node):
    return (ast.get_docstring(node) or "").partition("\n")[0]


def _defaults(arguments):
    names = arguments.posonlyargs + arguments.args
    values = [None] * (len(names) - len(arguments.defaults)) + arguments.defaults
    pairs = zip(names + arguments.kwonlyargs, values + arguments.kw_defaults, strict=True)
    return tuple(name.arg if value is None else f"{name.arg}={ast.unparse(value)}" for name, value in pairs)


def assignments(texts):
    """A dict from texts of the form ``name=value``.

    Raises:
        ValueError: A text of another form, or a name that stands twice.
    """
    result = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign):
            raise ValueError(f"{text!r} is not of the form name=value (SCENE stands before -s and -p)")
        if name in result:
            raise ValueError(f"{name} is given twice, as {result[name]!r} and {value!r}")
        result[name] = value
    return result


def options(record, texts):
    """Arguments for the dataclass ``record`` from text by name, converted by its annotations.

    Raises:
        ValueError: A name or a value that it does not take.
    """
    hints = typing.get_type_hints(record)
    kinds = {field.name: hints[field.name] for field in fields(record)}
    texts = {new_name(record, name, stacklevel=1): text for name, text in texts.items()}
    for name in texts:
        if name not in kinds:
            raise ValueError(f"{record.__name__} has no option {name!r}; {_allowed(kinds)}")
    return {name: convert(name, text, _kinds(kinds[name])) for name, text in texts.items()}


def convert(name, text, kinds):
    """``text`` as the first of bool, int, float, str that is in ``kinds`` and takes it; "none" where None is.

    Nothing is evaluated: a number is what `float` takes, or two of these with a / between them.

    Raises:
        ValueError: If none takes it.
    """
    if type(None) in kinds and text.lower() == "none":
        return None
    converters = {bool: _truth, int: _whole, float: _number, str: str}
    known = [kind for kind in converters if kind in kinds]
    if not known:
        raise ValueError(f"{name} takes {' or '.join(kind.__name__ for kind in kinds)}, which cannot be written as text")
    for kind in known:
        try:
            return converters[kind](text)
        except (KeyError, ValueError, ZeroDivisionError, OverflowError):
            continue
    raise ValueError(f"{name} is {text!r}; it must be {' or '.join(WORDS[kind] for kind in known)}")


def share(name, text):
    """A share of the whole, written as 1% or 0.01; above 1 it is refused, as a percentage without its sign."""
    value = convert(name, text.removesuffix("%"), (float,)) / (100.0 if text.endswith("%") else 1.0)
    number(name, value, above=0.0)
    if value > 1.0:
        raise ValueError(f"{name} is {text}, {value:g} times the whole; it must be no more than 100%, such as 1% or 0.01")
    return value


def milliseconds(name, text):
    """A time in ms, written as 16ms, 0.016s or 16."""
    unit = next((unit for unit in ("ms", "s") if text.endswith(unit)), "")
    value = convert(name, text.removesuffix(unit).strip(), (float,)) * (1e3 if unit == "s" else 1.0)
    number(name, value, above=0.0)
    return value


def _truth(text):
    return _TRUTH[text.lower()]


def _whole(text):
    value = _number(text)
    if value != math.floor(value):
        raise ValueError
    return int(text) if text.strip().lstrip("+-").isdigit() else int(value)


def _number(text):
    above, sign, below = text.partition("/")
    value = float(above) / float(below) if sign else float(above)
    if math.isnan(value):
        raise ValueError
    return value


def _kinds(annotation):
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return typing.get_args(annotation)
    return (annotation if isinstance(annotation, type) else type(annotation),)


def kinds_of_parameter(parameter):
    """Returns the types that a parameter takes: those of its annotation, or else that of its default."""
    if parameter.annotation is not parameter.empty:
        return _kinds(parameter.annotation)
    if parameter.default is None or parameter.default is parameter.empty:
        return (int, float, str, type(None))
    return (type(parameter.default),)


def _allowed(names):
    return f"allowed are {', '.join(names)}" if names else "it takes none"
