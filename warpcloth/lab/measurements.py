"""Measurements as data: a scene, a solver with options, and a function that measures, with a key for storage."""

import hashlib
import json
import math
import platform
import threading
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib import import_module
from pathlib import Path

from ..base.digest import source_digest
from ..base.extensions import extensions, load_only
from ..core.status import Grade
from ..others.simulators import other_solvers, shown_name, simulator_of
from ..run import scene_files
from ..run.listing import folders
from ..solvers import SOLVERS
from . import machine

# One measurement at a time in a process, because threads slow one another, and Warp captures one graph at a time.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class SceneRef:
    """A reference to a scene by name, so that another process can build it.

    Attributes:
        name: A known name, a .py file or a USD stage.
        parameters: Parameters of its function by name. Strings are converted, so that "inf", which JSON lacks, is a number.
        pins: A selection that replaces its pins, see :class:`warpcloth.run.scene_files.SceneSource`; or None.
    """

    name: str
    parameters: dict = field(default_factory=dict)
    pins: str | None = None

    def load(self):
        """Builds the :class:`warpcloth.Scene`.

        Raises:
            FileNotFoundError: There is no such scene.
            ValueError: It has no such parameter.
        """
        source = scene_files.find_source(self.name, self.pins)
        for name in self.parameters:
            if name not in source.parameters:
                raise ValueError(f"{source.path} has no parameter {name!r}, only {', '.join(source.parameters) or 'none'}")
        texts = {name: value for name, value in self.parameters.items() if isinstance(value, str)}
        return source.scene(source.values(texts) | {k: v for k, v in self.parameters.items() if k not in texts})

    def __str__(self):
        shown = ", ".join(f"{name}={value}" for name, value in self.parameters.items())
        return f"{self.name}({shown})" if shown else self.name


@dataclass(frozen=True)
class Setup:
    """A solver with options, as data.

    Attributes:
        solver: Its name on the command line, such as "projective-dynamics", or of another simulator, such as "newton-vbd".
        options: Options of its record by name; others have their defaults.
    """

    solver: str
    options: dict = field(default_factory=dict)

    def record(self):
        """Returns the record, such as ``wc.Newton(substeps=4)``, or that of a solver of another simulator.

        Raises:
            ValueError: There is no such solver, or an option is not allowed.
        """
        others = other_solvers()
        if self.solver not in SOLVERS and self.solver not in others:
            raise ValueError(f"solver is {self.solver!r}; it must be one of {', '.join(SOLVERS)}")
        make = others[self.solver].record if self.solver in others else SOLVERS[self.solver]
        try:
            return make(**self.options)
        except TypeError as error:
            raise ValueError(f"{self.solver}: {error}") from None

    def precision_on(self, device, dtype=None):
        """Returns the precision of its runs on a device; a simulator has its own, whatever ``dtype`` is."""
        other = simulator_of(self.solver)
        return SOLVERS[self.solver].precision_on(device, dtype) if other is None else other.dtype

    def __str__(self):
        return " ".join([shown_name(self.solver), *(f"{name}={value}" for name, value in self.options.items())])


@dataclass(frozen=True)
class Task:
    """One measurement: a function of JSON values that returns JSON values.

    Attributes:
        function: Module and name, "package.module:function".
        arguments: Its arguments by name: numbers, texts, lists and dictionaries of such.
    """

    function: str
    arguments: dict

    @property
    def key(self):
        """A hash of the measurement, of the code and of the machine, because times differ between machines."""
        here = _machine(self.arguments.get("device", "cpu"))
        text = json.dumps([self.function, self.arguments, source_digest(), here], sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def located(self):
        """Returns it with absolute paths of its scene and its reference, for a process in another working directory.

        Raises:
            FileNotFoundError: There is no such scene.
        """
        found = dict(self.arguments)
        if found.get("scene"):
            path = scene_files.find_path(found["scene"]["name"]).resolve()
            if path.parent != folders()[-1].resolve():  # an included scene has another path on another machine
                found["scene"] = found["scene"] | {"name": str(path)}
        if isinstance(found.get("reference"), str):
            found["reference"] = str(Path(found["reference"]).resolve())
        return replace(self, arguments=found)

    def run(self):
        """Measures in this process, and returns the result."""
        module, name = self.function.split(":")
        return getattr(import_module(module), name)(**self.arguments)


def task(function, **arguments):
    """Returns the :class:`Task` of a function of a module; records such as :class:`SceneRef` become dictionaries.

    Args:
        function: A function at the top of a module, which another process can import.
        arguments: Its arguments.
    """
    plain = {name: asdict(value) if hasattr(value, "__dataclass_fields__") else value for name, value in arguments.items()}
    return Task(f"{function.__module__}:{function.__qualname__}", plain)


def usable(row):
    """Returns whether the run of a row counts as usable without a reference, see :class:`warpcloth.core.status.Grade`.

    Rows without a grade do.
    """
    return row.get("grade") != Grade.NOT_USABLE.value


def finite(value):
    """Returns a number for JSON, None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def run(task, source, modules):
    """Runs a task for an executor: returns its result and the name of the machine that measured it.

    Args:
        task: The :class:`Task`.
        source: The :func:`source_digest` of the calling process.
        modules: Its :func:`warpcloth.base.extensions.extensions`, a tuple of names.

    Raises:
        ValueError: This process has other code, so that its results would have other keys, or cannot import a module.
    """
    with _ALONE:
        code = _code(modules)
        if source != code:
            raise ValueError(
                f"the code of warpcloth of {platform.node()} is {code}, and that of the process that asks {source}; "
                "install the same on all machines and start the workers again"
            )
        return task.run(), machine.name(task.arguments.get("device", "cpu"))


@cache
def _code(modules):
    """Loads the extensions of the process that asks, and returns the hash of the code as this process first read it."""
    if {*modules} != {*extensions()}:
        load_only(modules)
    return source_digest()


@cache
def _machine(device):
    return machine.machine(device)
