"""The modules of pxr, loaded when one of their names is first used: importing this package stays light.

All are loaded at once, with interrupts held back, because pxr would swallow one and go on with half of its modules.
"""

import math
from functools import cache
from importlib import import_module

from ..base.interrupts import deferred

__all__ = ["Ar", "Gf", "Kind", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade", "UsdSkel", "UsdUtils", "Vt"]


@cache
def _load():
    with deferred(math.inf):
        return {name: import_module(f"pxr.{name}") for name in __all__}


class _Module:
    """Stands for a module of pxr, and takes over each of its names when that is first used."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, name):
        value = getattr(_load()[self._name], name)
        setattr(self, name, value)
        return value


Ar, Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdSkel, UsdUtils, Vt = map(_Module, __all__)
