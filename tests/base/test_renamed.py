"""Old names and an old order of parameters work for one release, with a warning."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import run
from warpcloth.base.texts import options

SPREAD = wc.PBD(substeps=2, correction="per-step")


def test_an_old_name_of_an_option_is_taken_and_read():
    plain = wc.PBD(substeps=2)
    for old in (
        lambda: wc.PBD(substeps=2, stiffness="per-step"),
        lambda: replace(plain, stiffness="per-step"),
        lambda: wc.PBD(**options(wc.PBD, {"substeps": "2", "stiffness": "per-step"})),
    ):
        with pytest.warns(DeprecationWarning, match="PBD: stiffness is now called correction"):
            assert old() == SPREAD
    with pytest.warns(DeprecationWarning, match="correction"):
        assert SPREAD.stiffness == "per-step"


def test_an_old_name_on_the_command_line_is_said(capfd):
    code, out, err = run(capfd, "info", "chain", "--solver", "pbd", "-s", "stiffness=per-step", "-p", "links=3")
    assert code == 0 and err == "warpcloth: warning: PBD: stiffness is now called correction\n", err
    assert out


def test_analyze_takes_the_mesh_first_as_it_did(capfd):
    mesh = wc.Mesh.grid(3, 3)
    frames = np.stack([mesh.points, 1.5 * mesh.points])
    expected = wc.analyze(frames, mesh)["stretch"]
    with pytest.warns(DeprecationWarning, match=r"analyze\(frames, mesh\)"):
        assert np.array_equal(wc.analyze(mesh, frames)["stretch"], expected)
    with pytest.warns(DeprecationWarning, match=r"Analyzer\(frames, mesh\)"):
        assert len(wc.Analyzer(mesh, frames)) == 2
    assert np.array_equal(wc.analyze(mesh=mesh, frames=frames)["stretch"], expected)


def test_old_names_of_an_analysis():
    mesh = wc.Mesh.grid(3, 3)
    analyzer = wc.Analyzer([mesh.points, 1.5 * mesh.points], mesh)
    with pytest.warns(DeprecationWarning, match="places is now called positions"):
        assert np.array_equal(analyzer.places(mesh.points), analyzer.positions(mesh.points))
    with pytest.warns(DeprecationWarning, match="place is now called index"):
        assert [sample.place for sample in analyzer] == [0, 1]
