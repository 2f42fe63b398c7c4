"""Checks of single values that users give. Each error names the parameter, the value and the rule."""

import difflib
import math
import reprlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .limits import MAX_COUNT


class _Short(reprlib.Repr):
    """Short texts of values, with NumPy's numbers as plain ones, in lists and dicts too."""

    def repr1(self, x: Any, level: int) -> str:
        x = x.item() if isinstance(x, np.generic) else x
        return str(x) if isinstance(x, np.generic) else super().repr1(x, level)  # Python has no long double


_SHORT = _Short()
_SHORT.maxother = _SHORT.maxstring = 60


def shown(value: object) -> str:
    """Returns a value as one short line of text, for error messages."""
    return " ".join(_SHORT.repr(value).split())


def keep_plain(record: Any) -> None:
    """Replaces NumPy's numbers in fields of a frozen dataclass by Python's, so that its text has plain numbers."""
    for each in fields(record):
        if isinstance(value := getattr(record, each.name), np.generic):
            plain = float(value) if isinstance(value, np.longdouble) else value.item()
            object.__setattr__(record, each.name, plain)


def number(name: str, value: Any, above: float | None = None, least: float | None = None) -> None:
    """Checks that an option is a finite number, greater than ``above`` and no less than ``least``, where they are given.

    Raises:
        ValueError: It is not.
    """
    rule = "that is finite" if above is least is None else f"above {above:g}" if above is not None else f"of {least:g} or more"
    if isinstance(value, float) and math.isinf(value) and value > 0.0 and rule != "that is finite":
        rule += ", and finite"
    good = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    good = good and _is_finite(value)
    if not good or (above is not None and not value > above) or (least is not None and not value >= least):
        raise ValueError(f"{name} is {shown(value)}; it must be a number {rule}")


def _is_finite(value):
    try:
        return math.isfinite(value)
    except OverflowError:  # an int above all floats
        return False


def whole(name: str, value: Any, least: int, most: int = MAX_COUNT) -> None:
    """Checks that an option is a whole number from ``least`` to ``most``.

    Raises:
        ValueError: It is not.
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} is {shown(value)}; it must be a whole number of {least} or more")
    if value > most:
        raise ValueError(f"{name} is {shown(value)}; it must be {most:,} or less")


@dataclass(frozen=True)
class Range:
    """The numbers that an option of a record takes, from which its check and its help follow.

    Attributes:
        above: The option is greater than this, or None.
        least: The option is no less than this, or None.
        whole: Whether it is a whole number.
        word: A word that it takes in place of a number, or None.
    """

    above: float | None = None
    least: int | float | None = None
    whole: bool = False
    word: str | None = None

    def __str__(self) -> str:
        rule = f"above {self.above:g}" if self.above is not None else f"of {self.least:g} or more"
        number_text = f"a {'whole ' if self.whole else ''}number {rule}"
        return number_text if self.word is None else f"{self.word!r} or {number_text}"

    def check(self, name: str, value: object) -> None:
        """Checks the value of an option.

        Raises:
            ValueError: It is not allowed.
        """
        if isinstance(value, str) and self.word is not None:
            if value != self.word:
                raise ValueError(f"{name} is {shown(value)}; it must be {self}")
        elif self.whole:
            whole(name, value, int(self.least or 0))
        else:
            number(name, value, self.above, self.least)


def ranged(default: Any, **of_range: Any) -> Any:
    """Returns a field of a dataclass with a default, and the :class:`Range` of these arguments as metadata."""
    return field(default=default, metadata={"range": Range(**of_range)})


def choice(name: str, value: object, allowed: Collection[str]) -> None:
    """Checks that an option is one of the ``allowed`` strings.

    Raises:
        ValueError: It is not.
    """
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(
            f"{name} is {shown(value)}; it must be one of {', '.join(map(repr, allowed))}{did_you_mean(value, allowed)}"
        )


def did_you_mean(given: object, names: Iterable[str]) -> str:
    """Returns the end of an error that names the closest of several allowed ``names``; an empty text if none is close."""
    names = list(names)
    close = difflib.get_close_matches(str(given), names, n=1) if len(names) > 1 else []
    return f"; did you mean {close[0]}?" if close and close[0] != given else ""


def as_array(value: object) -> np.ndarray:
    """Converts ``value`` to an array; where NumPy cannot, as for rows of different lengths, returns an array of None."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError):
        return np.asarray(None)


def numeric(name: str, value: object, rule: str) -> np.ndarray:
    """Copies ``value`` to a read-only float64 array.

    Raises:
        ValueError: It is neither a number nor an array of numbers. Strings and booleans are not numbers.
    """
    array = as_array(value)
    if array.dtype.kind not in "iuf" and array.size:
        raise ValueError(f"{name} is {shown(value)}, which is not numeric; it must {rule}")
    array = np.array(array, dtype=np.float64)
    array.setflags(write=False)
    return array


def array(name: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """Copies ``value`` to a read-only float64 array of ``shape``.

    Raises:
        ValueError: It has another shape, or is not finite.
    """
    found = numeric(name, value, f"have shape {shape}")
    if found.shape != shape:
        raise ValueError(f"{name} has shape {found.shape}; it must be {shape}")
    refuse(name, found, ~np.isfinite(found), "must be finite")
    return found


def refuse(name: str, values: np.ndarray, wrong: ArrayLike, rule: str) -> None:
    """Raises a ValueError that names the first entry of an array where ``wrong`` is true, if there is one."""
    where = np.argwhere(wrong)
    if len(where):
        index = where[0].tolist()
        raise ValueError(f"{name}{index or ''} is {float(values[tuple(index)])}; it {rule}")
