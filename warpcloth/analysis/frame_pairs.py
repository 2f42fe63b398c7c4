"""The pairs of a frame and its reference that an analysis measures."""

import re
from dataclasses import dataclass

import numpy as np

from ..base.checks import shown, whole


@dataclass(frozen=True)
class Pair:
    """One row of an analysis, by indices of frames.

    Attributes:
        reference: The undeformed frame; None for the rest shape.
        frame: The measured frame.
        before: The frame before, for rates, or None.
    """

    reference: int | None
    frame: int
    before: int | None


def pairs_of(labels, reference=None, pairs=None, lag=None, every=1):
    """Returns the rows of an analysis, :class:`Pair` records, and (number, reason) of frames left out.

    Args:
        labels: Numbers of the frames (F,), ascending.
        reference: "rest" (default), "first", "previous" or the number of a frame; rates are from the frame before.
        pairs: Instead, "1:2,1:3,72:75" or pairs of numbers, reference and frame, also for rates.
        lag: Instead, the distance from reference to frame, also for rates.
        every: Use every k-th frame.

    Raises:
        ValueError: More than one of the three is given, a number has no frame or is paired with itself, or there is no row.
    """
    given = [name for name, value in (("reference", reference), ("pairs", pairs), ("lag", lag)) if value is not None]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)}: give one of them")
    whole("every", every, least=1)
    if pairs is not None:
        if every != 1:
            raise ValueError(f"every = {every}: pairs name their frames, so that it must be 1")
        return [_pair(labels, one) for one in _listed(pairs)], []
    kept = np.arange(0, len(labels), every)
    if lag is not None:
        whole("lag", lag, least=1)
        return _lagged(labels, kept, lag)
    reference = "rest" if reference is None else reference
    before = [None, *kept[:-1].tolist()]
    named = isinstance(reference, str)
    if named and reference == "previous":
        found = [Pair(start, int(frame), start) for start, frame in zip(before[1:], kept[1:], strict=True)]
        if not found:
            raise ValueError(f'reference = "previous": the sequence has {len(kept)} frame, must have two or more')
        return found, []
    if named and reference in ("rest", "first"):
        start = None if reference == "rest" else 0
    else:
        start = _index(
            labels, reference, f"reference is {shown(reference)}", '"rest", "first", "previous" or a number of a frame'
        )
    return [Pair(start, int(frame), last) for frame, last in zip(kept, before, strict=True)], []


def _listed(pairs):
    rule = 'must be a text such as "1:2,1:3,72:75" or pairs of numbers of frames'
    if isinstance(pairs, str):
        found = [part.split(":") for part in re.split(r"[,\s]+", pairs.strip())]
    else:
        try:
            found = [() if isinstance(pair, (str, bytes)) else tuple(pair) for pair in pairs]
        except TypeError:
            raise ValueError(f"pairs is {shown(pairs)}; it {rule}") from None
    if not found or any(len(pair) != 2 for pair in found):
        raise ValueError(f"pairs is {shown(pairs)}; it {rule}")
    return found


def _pair(labels, pair):
    where = f"pairs, {pair[0]}:{pair[1]}"
    start, frame = (_index(labels, number, where, "numbers of frames") for number in pair)
    if start == frame:
        raise ValueError(f"{where}: is of a frame with itself, must be of two")
    return Pair(start, frame, start)


def _index(labels, value, where, rule):
    try:
        number = float(None if isinstance(value, (bool, np.bool_)) else value)
    except (TypeError, ValueError):
        raise ValueError(f"{where}; it must be {rule}") from None
    apart = np.abs(labels - number)
    if not apart.min() <= 1e-6:
        raise ValueError(
            f"{where}; there is no frame {number:g}, only {len(labels)} from {labels[0]:g} to {labels[-1]:g}; it must be {rule}"
        )
    return int(apart.argmin())


def _lagged(labels, kept, lag):
    if len(labels) < 2:
        raise ValueError(f"lag = {lag}: the sequence has one frame, must have two or more")
    later = lag * np.diff(labels).min().item()
    found, left_out = [], []
    for start in kept.tolist() if later <= labels[-1] - labels[0] + 1e-6 else ():
        target = labels[start] + later
        matches = np.flatnonzero(np.isclose(labels, target, rtol=0.0, atol=1e-6))
        if len(matches):
            found.append(Pair(start, int(matches[0]), start))
        elif target < labels[-1]:
            left_out.append((labels[start], f"has no frame {lag} later, for {target:g} is missing"))
    if not found:
        raise ValueError(f"lag = {lag}: no frame has another so much later, from {labels[0]:g} to {labels[-1]:g}")
    return found, left_out
