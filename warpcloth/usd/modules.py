"""The modules of pxr, loaded at once: an interrupt waits, for pxr would swallow it and go on with half of them."""

import math

from ..interrupts import deferred

with deferred(math.inf):
    from pxr import Ar, Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt

__all__ = ["Ar", "Gf", "Kind", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade", "UsdUtils", "Vt"]
