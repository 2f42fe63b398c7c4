"""Frame numbers in file names."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

# The last number of a name: perhaps a sign, digits, and perhaps more digits after a point.
_NAME = re.compile(r"(.*?)([-+−]?)(\d+)(?:[.,](\d+))?\D*$", re.DOTALL)
_VERSION = re.compile(r"(v|\d[.,])\d+$", re.IGNORECASE)  # or a number of several parts
_MAX_DIGITS = 15  # which float64 still tells apart
_MAX_PARTS = 100  # of a frame


class _Name(NamedTuple):
    before: str
    sign: str
    whole: str
    decimals: str


def frames_of_names(files: Iterable[Path]) -> dict[float, Path]:
    """Returns files by frame number, the last number in a name, ascending.

    A hyphen before it is a minus unless a letter, digit or blank precedes it; beside "cloth1", however, "cloth-4" is frame −4.
    Decimals, as in "c_1.25" and "c_2.00", are parts of a frame. A point separates after a version, as in "v2.0998", and after a
    number that all names have if that is not 0 and four digits or more follow, as in "take_2.0100", or if two digits or more
    follow and two frames are consecutive.

    Raises:
        ValueError: A name has no number or one of more than 15 digits, two have the same, or a hyphen or point is ambiguous;
            the message begins with the file.
    """
    names = {file: _parsed(file) for file in files}
    if any(name.decimals for name in names.values()):
        names = _without_separators(names)
    unsigned = {name.before for name in names.values() if not name.sign}
    positive = {name.before for name in names.values() if not name.sign and int(name.whole + name.decimals)}
    frames: dict[float, Path] = {}
    for file, (before, sign, whole, decimals) in names.items():
        joins = sign == "-" and (before[-1:].isalnum() or before[-1:].isspace())
        if joins and before in unsigned - positive:
            raise _unclear(file, f"-{whole}", whole)
        negative = sign in ("-", "−") and (not joins or before in positive)
        frame = (-1 if negative else 1) * (float(f"{whole}.{decimals}") if decimals else int(whole))
        other = frames.setdefault(frame, file)
        if other != file:
            raise ValueError(f"{file}: has number {frame}, the last in its name, as {other} has; each must be used once")
    return {frame: frames[frame] for frame in sorted(frames)}


def _parsed(file):
    found = _NAME.match(file.stem)
    if found is None:
        raise ValueError(f"{file}: has no number in its name, which must be the number of its frame")
    before, sign, whole, decimals = (part or "" for part in found.groups())
    if decimals and _VERSION.search(f"{before}{sign}{whole}"):
        before, sign, whole, decimals = f"{before}{whole}.", "", decimals, ""
    digits = max(len(whole), len(decimals))
    if digits > _MAX_DIGITS:
        raise ValueError(f"{file}: has a number of {digits} digits in its name, must have {_MAX_DIGITS} at most")
    return _Name(before, sign, whole, decimals)


def _without_separators(names):
    """Returns names by file, without points that separate; refuses ambiguous ones."""
    digits = max(len(name.decimals) for name in names.values())
    if len({name[:3] for name in names.values()}) == 1:
        numbers = sorted(int(name.decimals or 0) for name in names.values())
        one_width = all(len(name.decimals) == digits >= 2 for name in names.values())
        whole = int(next(iter(names.values())).whole)
        if one_width and (min(np.diff(numbers), default=1) == 1 or (digits >= 4 and whole)):
            return {file: _Name(f"{name.before}{name.whole}.", "", name.decimals, "") for file, name in names.items()}
    else:
        values = np.array([float(f"0.{name.decimals or 0}") for name in names.values()])
        for parts in range(1, _MAX_PARTS + 1):
            if np.abs(values * parts - np.rint(values * parts)).max() <= 0.51 * parts * 10.0**-digits:
                return names
    file, name = next((file, name) for file, name in names.items() if name.decimals)
    raise _unclear(file, f"{name.whole}.{name.decimals}", int(name.decimals))


def _unclear(file, one, other):
    reason = 'rename the files so that the frame is a whole number, after "_"'
    return ValueError(f"{file}: may be frame {one} or frame {other}; {reason}")
