"""Solvers by local projections, PBD and XPBD: colours, orders, stiffness, and what the sweeps of a step converge to."""

import numpy as np
import pytest

import warpcloth as wc
from support.meshes import delaunay
from support.scenes import scene
from support.steps import after_frames, after_steps
from warpcloth.numerics.sweeps import GaussSeidelSweep, colours

EPS = np.finfo(np.float64).eps


# --- colours


PATTERNS = ("diagonal", "alternating", "equilateral")
MESHES = {
    **{pattern: lambda pattern=pattern: wc.Mesh.grid(9, 7, pattern=pattern) for pattern in PATTERNS},
    "Delaunay": lambda: delaunay(np.random.default_rng(3).uniform(size=(200, 2))),
    "bunny": lambda: scene("bunny").mesh,
    "chain": lambda: wc.Mesh.chain(12),
}


@pytest.mark.parametrize("pinned", [False, True], ids=["free", "pinned"])
@pytest.mark.parametrize("name", MESHES)
def test_colours_share_no_vertex_that_moves(name, pinned, device):
    """Every constraint is in one colour, and in one range of the sweep, of both copies."""
    mesh = MESHES[name]()
    pins = list(range(0, len(mesh.points), 5)) if pinned else [0]
    terms = [wc.Spring(stiffness=1.0), wc.Attachment(vertices=[1, 2, 2], stiffness=1.0)]
    if len(mesh.triangles):
        terms += [wc.QuadraticBending(stiffness=1.0), wc.DihedralBending(stiffness=1.0)]
    declared = wc.Scene(mesh, masses=np.ones(len(mesh.points)), terms=terms, pins=pins)
    model = declared.build(device=device, copies=2, dtype="float64")
    sweep = GaussSeidelSweep(model, model.positions, 1.0, "coloured", 1.0)
    free = model.inverse_mass.numpy() > 0.0
    for given, elements, ranges in zip(model.terms, sweep.elements, sweep.ranges, strict=True):
        stencil = elements.stencil.numpy()
        assert [first for first, _ in ranges] == np.cumsum([0, *(count for _, count in ranges)])[:-1].tolist()
        assert sum(count for _, count in ranges) == len(stencil)
        for first, count in ranges:
            vertices = stencil[first : first + count]
            vertices = vertices[free[vertices]]
            assert count > 0 and len(np.unique(vertices)) == len(vertices)
        # The same elements, with what belongs to them.
        both = [
            np.column_stack([each.stencil.numpy(), each.rest.numpy().reshape(len(stencil), -1), each.stiffness.numpy()])
            for each in (given, elements)
        ]
        assert np.array_equal(*(rows[np.lexsort(rows.T)] for rows in both))


@pytest.mark.parametrize(("pattern", "springs", "hinges"), [("alternating", 8, 18), ("equilateral", 6, 15)])
def test_grids_need_few_colours(pattern, springs, hinges):
    """Springs of a grid need no more than the most that meet at a vertex."""
    mesh = wc.Mesh.grid(32, 32, pattern=pattern)
    free = np.ones(len(mesh.points), dtype=bool)
    assert np.bincount(mesh.edges.ravel()).max() == springs and colours(mesh.edges, free).max() + 1 == springs
    assert colours(mesh.hinges, free).max() + 1 <= hinges


# --- convergence


@pytest.mark.parametrize("solver", [wc.PBD, wc.XPBD])
@pytest.mark.parametrize("pins", [[], [0]], ids=["free", "pinned"])
def test_averaging_counts_the_constraints_of_the_busiest_vertex_that_moves(pins, solver, device):
    """A bundle of springs at one hub: times 1 at the hub they overshoot tenfold; with the hub pinned they meet in a sweep."""
    leaves = np.stack([np.ones(20), np.linspace(-0.05, 0.05, 20), np.zeros(20)], axis=1)
    rest = np.vstack([np.zeros(3), leaves])
    mesh = wc.Mesh(rest, edges=[[0, i] for i in range(1, 21)])
    terms = [wc.Spring(stiffness=np.inf)]
    bundle = wc.Scene(mesh, masses=np.ones(21), positions=1.1 * rest, terms=terms, pins=pins, gravity=(0, 0, 0))
    stretched = []
    for iterations in (1, 10, 100):
        options = solver(substeps=1, iterations=iterations, sweep="constraint-averaged")
        x, _ = after_steps(bundle, options, device)
        stretched.append(np.abs(np.linalg.norm(x[1:] - x[0], axis=1) / mesh.edge_lengths - 1.0).max())
    assert stretched[0] < (8 * EPS if pins else 0.1)
    assert stretched[2] < 0.01 and stretched[2] <= stretched[1] + 8 * EPS


# --- one hanging mass


def test_one_sweep_of_a_step_has_no_stiffness_to_spread(device):
    found = []
    for correction in ("per-sweep", "per-step"):
        stepper = after_frames(scene("hanging", n=8), wc.PBD(substeps=4, iterations=1, correction=correction), 5, device=device)
        found.append((stepper.state.x.numpy(), stepper.model.kernels))
    assert np.array_equal(found[0][0], found[1][0]) and found[0][1] == found[1][1]


# --- what the sweeps of a step converge to


def test_residual_of_hard_constraints_is_the_last_move(device):
    chain = scene("chain", stiffness=np.inf)
    residuals = [after_steps(chain, wc.XPBD(substeps=1, iterations=n), device)[1].residual[0] for n in (1, 10, 1000)]
    assert residuals[0] > residuals[1] > residuals[2] > 0.0
