"""Examples in the docstrings of the names that are used most, run as doctests."""

import doctest

import pytest

import warpcloth as wc

NAMES = (
    *("Mesh", "Pins", "Scene", "Spring", "QuadraticBending", "simulate", "equilibrium", "analyze", "compare", "deform", "Arap"),
    *("kabsch", "Explicit", "Newton", "ProjectiveDynamics", "ADMM", "PBD", "XPBD"),
)


@pytest.mark.parametrize("name", NAMES)
def test_an_example_shows_what_it_says(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.DocTestParser().get_doctest(getattr(wc, name).__doc__, {}, name, None, None)
    assert found.examples
    said = []
    doctest.DocTestRunner().run(found, out=said.append)
    assert not said, "".join(said)
