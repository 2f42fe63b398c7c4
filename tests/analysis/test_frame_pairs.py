"""Which frame is measured against which."""

import numpy as np
import pytest

from warpcloth.analysis.frame_pairs import Pair, pairs_of

LABELS = np.array([1, 2, 3, 5, 6, 7])  # 4 is missing


@pytest.mark.parametrize(
    "options, rows",
    [
        ({}, [(None, 0, None), (None, 1, 0), (None, 2, 1), (None, 3, 2), (None, 4, 3), (None, 5, 4)]),
        ({"reference": "rest", "every": 4}, [(None, 0, None), (None, 4, 0)]),
        ({"reference": "first", "every": 3}, [(0, 0, None), (0, 3, 0)]),
        ({"reference": "previous"}, [(0, 1, 0), (1, 2, 1), (2, 3, 2), (3, 4, 3), (4, 5, 4)]),
        ({"reference": "previous", "every": 2}, [(0, 2, 0), (2, 4, 2)]),
        ({"reference": 5, "every": 5}, [(3, 0, None), (3, 5, 0)]),
        ({"reference": "5", "every": 5}, [(3, 0, None), (3, 5, 0)]),
        ({"pairs": "1:2,1:3, 7:5"}, [(0, 1, 0), (0, 2, 0), (5, 3, 5)]),
        ({"pairs": [(1, 2), ("5", 6.0)]}, [(0, 1, 0), (3, 4, 3)]),
        ({"lag": 1}, [(0, 1, 0), (1, 2, 1), (3, 4, 3), (4, 5, 4)]),
        ({"lag": 3}, [(1, 3, 1), (2, 4, 2)]),
        ({"lag": 2, "every": 2}, [(0, 2, 0), (2, 3, 2)]),
    ],
)
def test_rows(options, rows):
    assert pairs_of(LABELS, **options)[0] == [Pair(*row) for row in rows]


def test_the_notes_own_lag():
    """1–4, 2–5 … 72–75."""
    labels = np.arange(1, 76)
    rows, left_out = pairs_of(labels, lag=3)
    assert [(labels[row.reference], labels[row.frame]) for row in rows] == [(k, k + 3) for k in range(1, 73)]
    assert not left_out


def test_a_lag_says_what_a_gap_takes():
    _, left_out = pairs_of(LABELS, lag=1)
    assert left_out == [(3, "has no frame 1 later, for 4 is missing")]


def test_of_near_time_codes_the_nearest_counts():
    assert pairs_of(np.array([0.0, 4e-7, 8e-7]), pairs=[(0, 8e-7)])[0] == [Pair(0, 2, 0)]


def test_time_codes_may_be_apart():
    rows, _ = pairs_of(np.array([0.0, 2.5, 5.0, 7.5]), lag=2)
    assert rows == [Pair(0, 2, 0), Pair(1, 3, 1)]


@pytest.mark.parametrize(
    "options, words",
    [
        ({"reference": "first", "lag": 2}, "reference and lag: give one"),
        ({"reference": "last"}, "reference is 'last'; it must be"),
        ({"reference": 4}, "no frame 4, only 6 from 1 to 7"),
        ({"pairs": "1:4"}, "pairs, 1:4; there is no frame 4"),
        ({"pairs": "1-2"}, "must be a text such as"),
        ({"pairs": "2:2"}, "of a frame with itself"),
        ({"pairs": []}, "must be a text such as"),
        ({"pairs": 3}, "must be a text such as"),
        ({"pairs": "1:2", "every": 2}, "every = 2: pairs name their frames"),
        ({"pairs": ["12"]}, "must be a text such as"),
        ({"pairs": [(True, 2)]}, "must be numbers of frames"),
        ({"reference": True}, "reference is True; it must be"),
        ({"reference": np.array([1, 2])}, "must be"),
        ({"lag": 10**30}, "must be 10,000,000 or less"),
        ({"lag": 0}, "lag is 0"),
        ({"lag": 9}, "no frame has another so much later"),
        ({"every": 0}, "every is 0"),
        ({"reference": "previous", "every": 9}, "must have two or more"),
    ],
)
def test_refused(options, words):
    with pytest.raises(ValueError, match=words):
        pairs_of(LABELS, **options)
