"""Lists scenes, solvers and their options for the command line, by parsing source files.

Nothing here imports Warp.
"""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ..solvers import __all__ as _SOLVERS

_PACKAGE = Path(__file__).parents[1]


def folders():
    """Returns the folders of scenes that have names: ./scenes, then that of the package."""
    found = [Path("scenes"), _PACKAGE / "scenes"]
    return list({folder.resolve(): folder for folder in reversed(found) if folder.is_dir()})[::-1]


@dataclass(frozen=True)
class Listed:
    """A scene file: its name, the first lines of two docstrings, and its parameters as ``name=default`` texts."""

    name: str
    summary: str
    parameters: tuple = ()
    meaning: str = ""


def list_scenes(folder):
    """Lists the Python files of a folder that have a function ``scene``, by parsing them.

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


@cache
def list_solvers():
    """Returns the solvers of this package: their options, and the words that each takes, by name."""
    folder, classes = _PACKAGE / "solvers", {}
    for path in folder.glob("*.py"):
        classes |= {node.name: node for node in ast.parse(path.read_bytes()).body if isinstance(node, ast.ClassDef)}
    records = [classes[name] for name in _SOLVERS]
    return {_assigned(record, "name"): _options(record, classes) for record in records}


@cache
def list_failures():
    """Returns the names of the charts of failures, in order."""
    return tuple(map(ast.literal_eval, _value(ast.parse((_PACKAGE / "lab" / "failures.py").read_bytes()), "FAILURES").keys))


def _assigned(node, name):
    return ast.literal_eval(_value(node, name))


def _value(node, name):
    found = (each for each in node.body if isinstance(each, ast.Assign))
    return next(each.value for each in found if getattr(each.targets[0], "id", None) == name)


def _options(record, classes):
    found = {}
    for base in record.bases:
        found |= _options(classes[base.id], classes) if getattr(base, "id", None) in classes else {}
    annotated = [node for node in record.body if isinstance(node, ast.AnnAssign)]
    fields = [node for node in annotated if not ast.unparse(node.annotation).startswith("ClassVar")]
    return found | {field.target.id: _words(field.annotation) for field in fields}


def _words(annotation):
    found = [node for node in ast.walk(annotation) if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal"]
    return tuple(word for literal in found for word in ast.literal_eval(ast.Tuple(_elements(literal.slice), ast.Load())))


def _elements(node):
    return node.elts if isinstance(node, ast.Tuple) else [node]
