"""Extensions: modules outside this package that register energies and solvers, loaded by entry point, name or file.

On import, a module calls :func:`warpcloth.terms.register` or :func:`warpcloth.solvers.register`. Its code is part of the hash
under which measurements are kept, and other processes that measure load it.
"""

import importlib
import importlib.util
import sys
import warnings
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

# Entry-point group in which installed packages name their modules, see docs/extending.md.
GROUP = "warpcloth.extensions"
_names: set[str] = set()  # modules that registered something, or were loaded for that
_files: set[str] = set()  # modules that were loaded from the path of a file


@cache
def load_installed():
    """Imports the modules that installed packages name in :data:`GROUP`, on the first call only.

    Warns:
        UserWarning: A module cannot be imported.
    """
    for point in entry_points(group=GROUP):
        try:
            load_extension(point.module)
        except ValueError as error:
            warnings.warn(f"{point.name} of the entry points {GROUP}: {error}", stacklevel=2)


def load_extension(name):
    """Imports a module that registers energies and solvers.

    Args:
        name: Name of the module, or path of a .py file. A file replaces a file of the same name that was loaded before.

    Raises:
        ValueError: The module cannot be imported.
    """
    try:
        if name.endswith(".py"):
            _run_file(Path(name).resolve())
        else:
            importlib.import_module(name)
            _names.add(name)
    except (Exception, SystemExit) as error:  # whatever the module raises
        raise ValueError(f"{name} cannot be imported: {type(error).__name__}: {error}") from error


def load_only(names):
    """Imports modules and forgets extensions loaded before, because a process may measure for several others in turn."""
    _names.clear()
    for name in names:
        load_extension(name)


def _run_file(path):
    name = path.stem
    known = Path(getattr(sys.modules.get(name), "__file__", None) or "").resolve()
    if name in sys.modules and name not in _files and known != path:
        raise ValueError(f"another module is called {name} already; give the file another name")
    if known != path:
        spec = importlib.util.spec_from_file_location(name, path)
        before, sys.modules[name] = sys.modules.get(name), importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            if before is not None:
                sys.modules[name] = before
            raise
        _files.add(name)
    _names.add(name)


def note(record):
    """Remembers the module that registers a record, unless it is part of this package."""
    if record.__module__.partition(".")[0] != __name__.partition(".")[0]:
        _names.add(record.__module__)


def extensions():
    """Returns the files of the extensions that this process uses.

    Returns:
        dict: Paths of source files by the argument for :func:`load_extension`: for a module in a package its name, with all
        files of the package; else the path of its one file.
    """
    found = {}
    for name in sorted(_names & set(sys.modules)):
        file, top = getattr(sys.modules[name], "__file__", None), sys.modules.get(name.partition(".")[0])
        if hasattr(top, "__path__"):
            found[name] = sorted(Path(top.__path__[0]).rglob("*.py"))
        elif file is not None:
            found[file] = [Path(file)]
    return found
