"""The catalogue of solvers: each has a file of its own, with its record, and two lines here.

A file has the equation of a method and its source, its options, what it needs of every term, its settings for benchmarks and
charts, and the bound solver. The command line, benchmarks and charts look up a solver by name in :data:`SOLVERS`.
:func:`register` adds one from outside the package.
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

# In the order of lists and charts.
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
