"""Contact on a device."""

from ..base.catalogue import imported_on_use

_MODULES = {
    "ColliderSteps": "collider_steps",
    "ColliderWork": "collider_work",
    "FilterWork": "collider_work",
    "PairWork": "collider_work",
    "ColliderPulls": "present",
    "PresentContact": "present",
    "SelfSteps": "self_steps",
}
__getattr__ = imported_on_use(__name__, _MODULES)
