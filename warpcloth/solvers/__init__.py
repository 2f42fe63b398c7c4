"""One file a method: options, the equation and its source, the bound solver."""

from .explicit import Explicit
from .newton import Newton
from .pbd import PBD

SOLVERS = {"explicit": Explicit, "newton": Newton, "pbd": PBD}

__all__ = ["PBD", "SOLVERS", "Explicit", "Newton"]
