"""Checks of single values that users give; the error names the parameter, the value and the rule."""

import numpy as np


def number(name, value, above=None, least=None):
    """Checks that an option is a finite number."""
    rule = f"above {above:g}" if above is not None else f"of {least:g} or more"
    good = isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and np.isfinite(value)
    if not good or (above is not None and not value > above) or (least is not None and not value >= least):
        raise ValueError(f"{name} is {value!r}; it must be a number {rule}")


def whole(name, value, least):
    """Checks that an option is a whole number."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of {least} or more")


def choice(name, value, allowed):
    """Checks that an option is one of some words."""
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, allowed))}")
