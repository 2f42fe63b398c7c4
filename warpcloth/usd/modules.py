"""Loads the modules of pxr with interrupts held back, because pxr would swallow one and go on with half of its modules."""

import math

from ..base.interrupts import deferred

with deferred(math.inf):
    from pxr import Ar, Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt

__all__ = ["Ar", "Gf", "Kind", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade", "UsdUtils", "Vt"]
