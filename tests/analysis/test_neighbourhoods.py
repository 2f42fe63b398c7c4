"""Neighbourhoods of vertices against brute force."""

import warnings
from itertools import pairwise
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.analysis.neighbourhoods import neighbourhoods
from warpcloth.mesh.mesh import Surface

ROOT = Path(__file__).parents[2]
GRID = wc.Mesh.grid(7, 6, size=(1.0, 0.9), pattern="alternating")
SHEET = wc.Mesh(np.concatenate([[[0.5, 0.0, 0.5]], GRID.points]), GRID.triangles + 1)  # vertex 0 is in no triangle
DISTANCES = np.linalg.norm(SHEET.points[1:, None] - SHEET.points[None, 1:], axis=2)


def sets(chosen, mesh=SHEET):
    offsets, members = neighbourhoods(mesh, chosen)
    return [set(members[a:b].tolist()) for a, b in pairwise(offsets)]


def linked():
    near = [{i} for i in range(len(SHEET.points))]
    for a, b in SHEET.edges.tolist():
        near[a].add(b)
        near[b].add(a)
    near[0] = set()
    return near


def test_rings():
    near = linked()
    assert sets("1-ring") == near
    assert sets("2-ring") == [set().union(*(near[j] for j in around)) for around in near]


def test_radius():
    assert sets("nearest:radius=0.2") == [set()] + [set((np.flatnonzero(d <= 0.2) + 1).tolist()) for d in DISTANCES]


@pytest.mark.parametrize("chosen, k", [("nearest:k=6", 6), ("nearest:25%", 11), ("nearest:8%", 4)])
def test_nearest(chosen, k):
    found = sets(chosen)
    assert not found[0]
    for around, distances in zip(found[1:], DISTANCES, strict=True):
        assert len(around) == k
        assert max(distances[j - 1] for j in around) <= np.sort(distances)[k - 1] * (1 + 1e-12)


@pytest.mark.parametrize("cells", [2, 3, 6, 9])
def test_a_share_of_few_vertices_determines_rotations(cells, device):
    """Below 101 vertices 2 % are one or two: the nearest three, or more if on a line, are taken with a warning."""
    mesh = wc.Mesh.grid(cells + 1, cells + 1)
    n, points = len(mesh.points), mesh.points
    with pytest.warns(
        UserWarning, match=rf"nearest:2%.*: [12] of the {n} vertices determines? no rotation at {n} of them.*3 to 4"
    ):
        found = sets("nearest:2%", mesh)
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    for i, around in enumerate(found):
        around = np.array(sorted(around, key=lambda j: distances[i, j]))
        assert i in around and distances[i, around].max() <= np.sort(distances[i])[len(around) - 1] * (1 + 1e-12)
        assert len(around) in (3, 4) and np.linalg.matrix_rank(points[around] - points[i]) == 2
    turn = wc.polar(np.random.default_rng(0).normal(size=(3, 3)))[0]
    with pytest.warns(UserWarning, match="no rotation"):
        measured = wc.analyze(
            [points @ turn.T], mesh, measures=("rotation",), neighbourhood="nearest:2%", device=device, dtype="float64"
        )
    assert np.abs(measured["rotation"] - turn).max() < 1e-12


def test_a_share_goes_as_far_as_a_line_does():
    """Of a ribbon of two long rows, 40 times as far apart as their vertices; what is given as a number is taken as it is."""
    ribbon = wc.Mesh.grid(60, 2, size=(1.0, 40 / 59), pattern="alternating")
    with pytest.warns(UserWarning, match=r"3 of the 120 vertices determine no rotation at 120 of them.*, 4[0-9] to "):
        found = sets("nearest:2%", ribbon)
    for i, around in enumerate(found):
        assert len({j // 60 for j in around}) == 2, i
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert {len(around) for around in sets("nearest:k=3", ribbon)} == {3}
        assert {len(around) for around in sets("nearest:2%", wc.Mesh.grid(20, 20))} == {8}


def test_two_per_cent_of_the_vertices_where_nothing_else_is_said():
    mesh = wc.Mesh.grid(30, 20)
    assert sets("nearest", mesh) == sets("nearest:2%", mesh)
    assert {len(around) for around in sets("nearest", mesh)} == {12}


def test_own_sets():
    own = [[i, (i + 1) % 43, (i + 7) % 43] for i in range(43)]
    assert sets(own) == [set(around) for around in own]


WRONG = "ring 3-ring nearest:k=2 nearest:k=99 nearest:k=3.5 nearest:k= nearest:radius=-1 nearest:radius=nan nearest:0%"


@pytest.mark.parametrize("chosen", [*WRONG.split(), "nearest:101%", [[0, 1, 2]], 3])
def test_refused(chosen):
    with pytest.raises(ValueError, match="neighbour"):
        neighbourhoods(SHEET, chosen)


def test_nowhere_is_nowhere_near():
    with pytest.raises(ValueError, match="no vertex with a triangle is at a finite position"):
        neighbourhoods(Surface(np.full((3, 3), np.nan), [[0, 1, 2]]), "nearest:radius=0.2")


STUDY = run_path(str(ROOT / "benchmarks" / "neighbourhoods.py"))


def test_the_study_of_neighbourhoods():
    """Checks the table of docs/measuring.md to half of its last digit, plus what other rounding may add."""
    text = (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")
    rows = {line.split("|")[1].strip(" `"): line.split("|")[2:-1] for line in text.splitlines() if line.startswith("| `")}
    for kind, *numbers in STUDY["table"]():
        assert [float(cell) for cell in rows[kind]] == pytest.approx(numbers, rel=0.055), kind


def test_blur_and_noise_of_a_neighbourhood():
    """Blur is in proportion to the share, on any mesh; noise makes F wrong by √(24π) σ/(h m), and DΔt by as much."""
    errors, blur = STUDY["errors"], {}
    for n, kinds in ((33, ("nearest:5%", "nearest:10%")), (49, ("nearest:5%",))):
        for kind in kinds:
            blur[n, kind] = errors(STUDY["sheet"](n), kind, 0.0, 0, 1.0)[1]
    assert blur[33, "nearest:10%"] / blur[33, "nearest:5%"] == pytest.approx(2.0, rel=0.15)
    # Irregular sets are not about their vertex, which the finer mesh has less of.
    assert blur[49, "nearest:5%"] / blur[33, "nearest:5%"] == pytest.approx(1.0, rel=0.1)
    mesh, noise = STUDY["sheet"](33), 1e-3
    quiet = STUDY["known"](mesh.points, 0.5 * STUDY["DT"], 1e-3)[1]  # one long wave blurs nothing
    size_of_D = np.sqrt((quiet**2).sum(axis=(1, 2)).mean())
    for kind, m in (("nearest:1%", 11), ("nearest:2%", 22), ("nearest:5%", 55)):
        found = np.array([errors(mesh, kind, noise, seed, 1e-3)[1] for seed in range(4)]) * [1.0, size_of_D * STUDY["DT"]]
        wanted = np.sqrt(24.0 * np.pi) * noise * mesh.edge_lengths.mean() * 32 / m
        # 400 inner vertices, whose sets overlap, and a grid that is no disc.
        assert np.sqrt((found**2).mean(axis=0)) == pytest.approx(2 * [wanted], rel=0.1), kind
