"""Scenes in files: found by name or path, and built with parameters given as text."""

import importlib.util
import itertools
import os
import sys
import typing
from dataclasses import dataclass, replace
from pathlib import Path

import warpcloth.usd as usd

from ..base.checks import did_you_mean
from ..base.outputs import STAGE_ENDINGS
from ..base.texts import allowed, convert, kinds_of_parameter, parameters_of
from ..mesh.caches import CACHES
from ..mesh.loading import ENDINGS
from ..mesh.selection import some_vertices
from ..scene.mesh_scene import mesh_scene
from ..scene.scene import Scene
from .listing import folders, list_scenes

_number_of_modules = itertools.count()
_KINDS = f"a .py file, a USD stage or a mesh ({' '.join(ENDINGS)})"


@dataclass(frozen=True)
class SceneSource:
    """The source of a scene: the ``scene`` function of a Python file, a USD stage, or a mesh file.

    Attributes:
        function: Function that returns a :class:`warpcloth.Scene`, called with ``parameters`` by name.
        parameters: Its parameters, `inspect.Parameter` by name.
        pins: Selection of fixed vertices in place of the pins of the scene, or None.
    """

    path: Path
    function: typing.Callable
    parameters: dict
    pins: str | None = None

    def values(self, texts):
        """Returns the values of all parameters: converted ``texts`` by name, else defaults.

        Raises:
            ValueError: The function does not take a name or a value, or a required value is missing.
        """
        values = {name: p.default for name, p in self.parameters.items() if p.default is not p.empty}
        for name, text in texts.items():
            if name not in self.parameters:
                raise ValueError(f"{self.path} has no parameter {name!r}; {allowed(self.parameters, name)}")
            values[name] = convert(name, text, kinds_of_parameter(self.parameters[name]))
        missing = [name for name in self.parameters if name not in values]
        if missing:
            raise ValueError(f"{self.path} needs a value for {missing[0]}; give it with -p {missing[0]}=…")
        return values

    def scene(self, values):
        """Builds the scene for the values of the parameters.

        Raises:
            ValueError: The function raises (with file and line) or returns no scene, or ``pins`` selects no vertex.
        """
        if self.path.suffix != ".py":
            scene = self.function(**values)
        else:
            with _Located(self.path):
                scene = self.function(**values)
            if not isinstance(scene, Scene):
                raise ValueError(f"{self.path}: scene() returned a {type(scene).__name__}; it must return a warpcloth.Scene")
        if self.pins is None:
            return scene
        return replace(scene, pins=some_vertices(f"--pins {self.pins!r}", self.pins, scene.mesh))


def find_source(name, pins=None):
    """Finds a scene: a Python file, a USD stage, a mesh file, or the name of a file in one of :func:`folders`.

    Raises:
        FileNotFoundError: There is no such file or name.
        ValueError: The file cannot be loaded, or has no function ``scene``.
    """
    path = find_path(name)
    if path.suffix == ".py":
        return _python_source(path, pins)
    if (ending := path.suffix.lower()) not in (*STAGE_ENDINGS, *ENDINGS):
        animation = ending in (".abc", ".npz", ".npy", *CACHES)
        hint = "; 'warpcloth convert' makes a stage of .pc2, .mdd, .npz and numbered .obj files" if animation else ""
        raise ValueError(f"{path}: is no scene; it must be {_KINDS}{hint}")
    read = usd.read_scene if ending in STAGE_ENDINGS else mesh_scene
    parameters = parameters_of(read)
    del parameters["path"]
    return SceneSource(path, lambda **values: read(str(path), **values), parameters, pins)


def find_path(name):
    """Finds the file of a scene, as :func:`find_source`, and does not read it.

    Raises:
        FileNotFoundError: There is no such file or name.
    """
    path = Path(name)
    if not path.suffix and path.name == str(name):
        candidates = [folder / f"{name}.py" for folder in folders()]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            known = sorted({listed.name for folder in folders() for listed in list_scenes(folder)})
            raise FileNotFoundError(
                f"there is no scene {name!r}; known by name are {', '.join(known) or 'none'}; or give {_KINDS}"
                + did_you_mean(name, known)
            )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: {'is a folder, no scene' if path.is_dir() else 'there is no such file'}")
    return path


def _python_source(path, pins):
    # A unique module name, because scenes may be called like modules, and may be loaded again after a change.
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


class _Located:
    """Turns any error of a scene file, or an exit, into a ValueError of one line with the file and the line of its cause."""

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
