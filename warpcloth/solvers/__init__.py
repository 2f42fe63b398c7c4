"""One file a method: options, the equation and its source, the bound solver."""

from .admm import ADMM
from .constrained_dynamics import ConstrainedDynamics
from .explicit import Explicit
from .hierarchical_pbd import HierarchicalPBD
from .newton import Newton
from .pbd import PBD
from .projective_dynamics import ProjectiveDynamics
from .xpbd import XPBD

SOLVERS = {
    "explicit": Explicit,
    "newton": Newton,
    "projective-dynamics": ProjectiveDynamics,
    "admm": ADMM,
    "pbd": PBD,
    "hierarchical-pbd": HierarchicalPBD,
    "xpbd": XPBD,
    "constrained-dynamics": ConstrainedDynamics,
}

__all__ = [
    "ADMM",
    "PBD",
    "SOLVERS",
    "XPBD",
    "ConstrainedDynamics",
    "Explicit",
    "HierarchicalPBD",
    "Newton",
    "ProjectiveDynamics",
]
