"""Which frame of a sequence is measured against which."""

import re
from dataclasses import dataclass

import numpy as np

from ..base.checks import shown, whole


@dataclass(frozen=True)
class Pair:
    """One row of an analysis, by indices of frames in their sequence.

    Attributes:
        reference: The frame that counts as undeformed; None for the rest shape.
        frame: The frame that is measured.
        before: The frame from which rates are taken; None where there is none.
    """

    reference: int | None
    frame: int
    before: int | None


def pairs_of(labels, reference=None, pairs=None, lag=None, every=1):
    """The rows of an analysis.

    Args:
        labels: Numbers of the frames, rising (F,).
        reference: "rest", "first", "previous" or the number of a frame: what each frame is measured against; "rest" where
            nothing is given. Rates are taken from the frame before, of "previous" from the reference.
        pairs: Instead, a text such as "1:2,1:3,72:75" or pairs of numbers: reference and frame, also for rates.
        lag: Instead, whole number K: of every frame the one K frames later, as 1:4, 2:5 and so on for 3, also for rates.
        every: Every k-th frame alone, beginning with the first.

    Returns:
        tuple: A list of :class:`Pair`, and a list of (number, reason) of frames that could have been in one and are not.

    Raises:
        ValueError: More than one of the three, a number that no frame has, a pair of a frame with itself, or no row at all.
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
