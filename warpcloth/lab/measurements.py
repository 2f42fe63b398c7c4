"""Measurements as data: a scene, a solver with options, and a function that measures; each with a key by which it is kept."""

import hashlib
import json
import math
import platform
import threading
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import import_module

from ..base.digest import source_digest
from ..run import scene_files
from ..solvers import SOLVERS
from . import machine

# One measurement at a time in a process: threads side by side slow one another, and Warp records one graph at a time.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class SceneRef:
    """A scene by its name, so that another process can make it.

    Attributes:
        name: A known name, a .py file or a USD stage.
        parameters: Parameters of its function by name. Texts are converted, so "inf", which JSON lacks, is a number too.
        pins: A selection that replaces its pins, see :class:`warpcloth.run.scene_files.SceneSource`; or None.
    """

    name: str
    parameters: dict = field(default_factory=dict)
    pins: str | None = None

    def load(self):
        """The :class:`warpcloth.Scene`.

        Raises:
            FileNotFoundError: There is no such scene.
            ValueError: It takes no such parameter.
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
        solver: Its name on the command line, such as "projective-dynamics".
        options: Of its record, by name; what is not given has its default.
    """

    solver: str
    options: dict = field(default_factory=dict)

    def record(self):
        """The options record, such as ``wc.Newton(substeps=4)``.

        Raises:
            ValueError: There is no such solver, or an option is not allowed.
        """
        if self.solver not in SOLVERS:
            raise ValueError(f"solver is {self.solver!r}; it must be one of {', '.join(SOLVERS)}")
        try:
            return SOLVERS[self.solver](**self.options)
        except TypeError as error:
            raise ValueError(f"{self.solver}: {error}") from None

    def __str__(self):
        return " ".join([self.solver, *(f"{name}={value}" for name, value in self.options.items())])


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
        """A hash of what is measured, of the code that measures it, and of the machine: on another it takes another time."""
        here = _machine(self.arguments.get("device", "cpu"))
        text = json.dumps([self.function, self.arguments, source_digest(), here], sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def run(self):
        """Measures, in this process."""
        module, name = self.function.split(":")
        return getattr(import_module(module), name)(**self.arguments)


def task(function, **arguments):
    """The :class:`Task` of a function of a module; records such as :class:`SceneRef` become dictionaries.

    Args:
        function: A function at the top of a module, which another process can import.
        arguments: Its arguments.
    """
    plain = {name: asdict(value) if hasattr(value, "__dataclass_fields__") else value for name, value in arguments.items()}
    return Task(f"{function.__module__}:{function.__qualname__}", plain)


def finite(value):
    """A number as JSON has it, None for what is not finite."""
    return float(value) if math.isfinite(value) else None


def run(task, source):
    """Runs a task for an executor: returns its result and the name of the machine that measured it.

    Args:
        task: The :class:`Task`.
        source: The :func:`source_digest` of the process that asks.

    Raises:
        ValueError: This process has other code, whose results have other keys.
    """
    if source != source_digest():
        raise ValueError(
            f"the code of warpcloth of {platform.node()} is {source_digest()}, and that of the process that asks {source}; "
            "install the same on all machines and start the workers again"
        )
    with _ALONE:
        return task.run(), machine.name(task.arguments.get("device", "cpu"))


@cache
def _machine(device):
    return machine.machine(device)
