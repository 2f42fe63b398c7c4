"""Energies and solvers from outside this package: modules that register them, by entry points, by name or by file.

A module registers a record by :func:`warpcloth.terms.register` or :func:`warpcloth.solvers.register` when it is imported. Its
code counts where results are kept, and goes with the measurements to other processes and machines.
"""

import importlib
import importlib.util
import sys
import warnings
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

# Installed packages name their modules in this group, see docs/extending.md.
GROUP = "warpcloth.extensions"
_names: set[str] = set()  # of modules that registered something, or were loaded to do so
_files: set[str] = set()  # names of modules that were loaded by the path of a file


@cache
def load_installed():
    """Imports, once, the modules that installed packages name in :data:`GROUP`.

    Warns:
        UserWarning: One of them cannot be imported.
    """
    for point in entry_points(group=GROUP):
        try:
            load_extension(point.module)
        except ValueError as error:
            warnings.warn(f"{point.name} of the entry points {GROUP}: {error}", stacklevel=2)


def load_extension(name):
    """Imports a module that registers energies and solvers.

    Args:
        name: Name of the module, or path of a .py file; a file replaces another of its name that was loaded before.

    Raises:
        ValueError: It cannot be imported.
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
    """Imports modules, and forgets those that were loaded for others: a worker of a cluster measures for many."""
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
    """Notes the module of a record that is registered."""
    if record.__module__.partition(".")[0] != __name__.partition(".")[0]:
        _names.add(record.__module__)


def extensions():
    """Returns the files of the modules from outside that this process uses.

    Returns:
        dict: The paths of each by what :func:`load_extension` takes: the name of a module of a package, which stands for all
        files of that package, or the path of the only file; sorted.
    """
    found = {}
    for name in sorted(_names & set(sys.modules)):
        file, top = getattr(sys.modules[name], "__file__", None), sys.modules.get(name.partition(".")[0])
        if hasattr(top, "__path__"):
            found[name] = sorted(Path(top.__path__[0]).rglob("*.py"))
        elif file is not None:
            found[file] = [Path(file)]
    return found
