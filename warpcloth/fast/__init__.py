"""Faster implementations of the core, with one entry, `plan`, which imports those that a model needs."""

from ..base.catalogue import imported_on_use

_MODULES = {
    "BlockStep": "block_step",
    "ContactGuard": "contact_guard",
    "GatherGradient": "gather_gradient",
    "GatherStep": "gather_step",
    "GatherSweeps": "gather_corrections",
    "ScatterSweeps": "scatter_corrections",
    "TouchingSteps": "touching_steps",
    "as_pairs": "quadratic_pairs",
}
__getattr__ = imported_on_use(__name__, _MODULES)
