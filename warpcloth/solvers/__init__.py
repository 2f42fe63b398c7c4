"""One file a method: options, the equation and its source, the bound solver."""

from .explicit import Explicit
from .newton import Newton
from .pbd import PBD
from .xpbd import XPBD

SOLVERS = {"explicit": Explicit, "newton": Newton, "pbd": PBD, "xpbd": XPBD}

__all__ = ["PBD", "SOLVERS", "XPBD", "Explicit", "Newton"]
