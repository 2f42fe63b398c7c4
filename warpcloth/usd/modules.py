"""The modules of pxr, loaded when a name is first used.

All are loaded together, without interrupts, which pxr would swallow.
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
    """A proxy for a module of pxr, which copies each name on first use."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, name):
        value = getattr(_load()[self._name], name)
        setattr(self, name, value)
        return value


Ar, Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdSkel, UsdUtils, Vt = map(_Module, __all__)
