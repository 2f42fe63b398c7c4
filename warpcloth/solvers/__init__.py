"""The catalogue of solvers, :data:`SOLVERS`; :func:`register` adds one from outside the package."""

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
