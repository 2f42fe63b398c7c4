"""Cloth simulation: every classic method on the same scene, from energies written once, on NVIDIA Warp, writing USD.

Its names are those of :mod:`warpcloth.api`, which is imported when one of them is first used, and Warp with it.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING

from .base import interrupts as interrupts  # first: it handles interrupts while the other modules load, which takes a second
from .base.quiet import prepare_warp

if TYPE_CHECKING:  # type checkers do not read an __all__ that another is added to
    from .api import *  # noqa: F403
    from .solvers import *  # noqa: F403
    from .terms import *  # noqa: F403
else:

    def __getattr__(name):
        if not name.startswith("__") or name == "__all__":  # of all else Python and its tools ask every module
            api = import_module(".api", __name__)
            if hasattr(api, name):
                globals()[name] = getattr(api, name)
            if name in globals():  # or a package that came with it, such as solvers
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if sys.modules.get("warp"):  # whose settings may be changed from here on
    prepare_warp()


def __dir__():
    return __getattr__("__all__")
