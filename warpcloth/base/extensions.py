"""Energies and solvers from outside this package: modules that register them, by entry points, by name or by file.

A module registers a record by :func:`warpcloth.terms.register` or :func:`warpcloth.solvers.register` when it is imported. Its
code counts where results are kept, and goes with the measurements to other processes and machines.
"""

import importlib
import importlib.util
import sys
import warnings
from importlib.metadata import entry_points
from pathlib import Path

# Installed packages name their modules in this group, see docs/extending.md.
GROUP = "warpcloth.extensions"
_names = set()  # of modules that registered something


def load_installed():
    """Imports the modules that installed packages name in :data:`GROUP`.

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
        name: Name of the module, or path of a .py file.

    Raises:
        ValueError: It cannot be imported.
    """
    try:
        if not name.endswith(".py"):
            importlib.import_module(name)
            return
        path = Path(name).resolve()
        spec = importlib.util.spec_from_file_location(path.stem, path)
        known = sys.modules.get(path.stem)
        if known is not None:
            if Path(getattr(known, "__file__", None) or "").resolve() != path:
                raise ValueError(f"another module is called {path.stem} already; give the file another name")
            return
        sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[path.stem]
            raise
    except Exception as error:  # whatever the module raises
        raise ValueError(f"{name} cannot be imported: {type(error).__name__}: {error}") from error


def note(record):
    """Notes the module of a record that is registered."""
    if record.__module__.partition(".")[0] != __name__.partition(".")[0]:
        _names.add(record.__module__)


def extensions():
    """Returns the files of the modules that registered an energy or a solver.

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
