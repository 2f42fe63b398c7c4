"""Rows of tables of tests, of which some run always and the others only with `-m slow`."""

import pytest


def slow_but(kept, rows):
    """Marks rows as slow, but for those in ``kept``. A row is a value, or a tuple of several."""
    rows = list(rows)
    assert all(row in rows for row in kept), "a row that is kept is not in the table"
    return [
        row if row in kept else pytest.param(*(row if isinstance(row, tuple) else (row,)), marks=pytest.mark.slow)
        for row in rows
    ]


def table(names, kept, rows):
    """Runs a test with each of the rows, of which all but those in ``kept`` are slow."""
    return pytest.mark.parametrize(names, slow_but(kept, rows))
