"""The energy of docs/extending.md, from outside the package."""

import importlib.util
import re
import sys
import tempfile
from pathlib import Path

from warpcloth.terms import TERMS

_PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = {m[1]: m[2] for m in re.finditer(r"`([\w.]+)`:\n\n```python\n(.*?)^```$", _PAGE, re.MULTILINE | re.DOTALL)}
_FOLDER = tempfile.TemporaryDirectory()


def write_files(folder):
    """Writes the files of the page into a folder."""
    for name, text in FILES.items():
        (Path(folder) / name).write_text(text, encoding="utf-8")


def _imported(name):
    """A module of the page; Warp reads the source of its functions again when it compiles them."""
    write_files(_FOLDER.name)
    spec = importlib.util.spec_from_file_location(name, Path(_FOLDER.name) / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


Plane = _imported("plane").Plane
# Known only where a test registers it, so that the catalogue of the others is that of the package.
del TERMS["Plane"]
del sys.modules["plane"]
