"""The catalogue of solvers: each has a file of its own, with its record, and a line here.

A file has the equation of a method and its source, its options, what it needs of every term, its settings for benchmarks and
charts, and the bound solver. The command line, benchmarks and charts look up a solver by name in :data:`SOLVERS`.
:func:`register` adds one from outside the package.
"""

from ..base.catalogue import Catalogue, imported_on_use

# The record of each, by its name, in the order of lists and charts; the module of a solver is called like it.
_RECORDS = {
    "explicit": "Explicit",
    "newton": "Newton",
    "projective-dynamics": "ProjectiveDynamics",
    "admm": "ADMM",
    "pbd": "PBD",
    "hierarchical-pbd": "HierarchicalPBD",
    "xpbd": "XPBD",
    "constrained-dynamics": "ConstrainedDynamics",
}
SOLVERS = Catalogue(__name__, _RECORDS)
__all__ = list(_RECORDS.values())

_MODULES = {record: name.replace("-", "_") for name, record in _RECORDS.items()} | {"register": "step"}
__getattr__ = imported_on_use(__name__, _MODULES)
