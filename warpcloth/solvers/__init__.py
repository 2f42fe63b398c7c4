"""The catalogue of the solvers: one file, one record and two lines here for each.

A file has the equation of a method and its source, its options, its needs of every term, the settings by which it is measured
and drawn, and the bound solver. The command line and others that name a solver look it up in :data:`SOLVERS`; :func:`register`
adds one from outside the package.
"""

from .admm import ADMM
from .constrained_dynamics import ConstrainedDynamics
from .explicit import Explicit
from .hierarchical_pbd import HierarchicalPBD
from .newton import Newton
from .pbd import PBD
from .projective_dynamics import ProjectiveDynamics
from .step import SOLVERS as SOLVERS
from .step import register as register
from .xpbd import XPBD

# In the order in which lists and charts have them.
__all__ = [  # noqa: RUF022
    "Explicit",
    "Newton",
    "ProjectiveDynamics",
    "ADMM",
    "PBD",
    "HierarchicalPBD",
    "XPBD",
    "ConstrainedDynamics",
]

for _name in __all__:
    register(globals()[_name])
