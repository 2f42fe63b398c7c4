"""Models: scenes on a device, with all arrays of terms, loads and colliders."""

from ..base.catalogue import imported_on_use

_MODULES = {"colliders_on": "device_colliders"}
__getattr__ = imported_on_use(__name__, _MODULES)
