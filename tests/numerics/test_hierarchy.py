"""The levels of hierarchical PBD on meshes of all kinds, and what they change in a step."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import Delaunay

import warpcloth as wc
from support.rows import table
from support.steps import after_steps
from warpcloth.numerics.hierarchy import levels
from warpcloth.numerics.unfolding import UnfoldedSurface
from warpcloth.scenes import chain

EPS = np.finfo(np.float64).eps


def edges_alone(points, edges, **scene):
    """A net of hard springs on edges, masses from 1 to 2 kg."""
    n = len(points)
    scene = {"terms": [wc.Spring(stiffness=np.inf)], "masses": np.linspace(1.0, 2.0, n), **scene}
    return wc.Scene(wc.Mesh(np.asarray(points, dtype=float), edges=edges), **scene)


def line(n, x=0.0):
    return np.stack([np.full(n, x), -np.arange(n, dtype=float), np.zeros(n)], axis=1)


def links(n, first=0):
    return np.stack([np.arange(n - 1), np.arange(1, n)], axis=1) + first


def scattered():
    """Points with springs to all within a radius: any valence, and no order of the vertices."""
    points = np.random.default_rng(1).uniform(size=(200, 3)) * [1.0, 0.0, 1.0]
    pairs = np.argwhere(np.triu(np.linalg.norm(points[:, None] - points[None], axis=-1) < 0.15, 1))
    return edges_alone(points, pairs, pins=[0, 7, 50])


def uneven(n, kind):
    """Delaunay's triangles of n² vertices of a unit square, those inside moved by up to half a cell, or put anywhere."""
    grid = wc.Mesh.grid(n, n).points[:, [0, 2]]
    inside = ((grid > 1e-9) & (grid < 1.0 - 1e-9)).all(axis=1)
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, size=(inside.sum(), 2))
    grid[inside] = grid[inside] + 0.5 / (n - 1) * noise if kind == "jittered" else 0.5 + 0.5 * noise
    triangles = Delaunay(grid).simplices
    return wc.Mesh(np.insert(grid, 1, 0.0, axis=1), triangles[np.ptp(grid[triangles], axis=1).min(axis=1) > 1e-9])


GRID = wc.Mesh.grid(12, 9, pattern="alternating")
JITTERED = uneven(9, "jittered")
HUB = np.vstack([line(1), np.random.default_rng(0).normal(size=(40, 3))])
SCENES = {
    "grid": wc.Scene(GRID, density=0.1, terms=[wc.Spring(pairs=("structural", "shear"), stiffness=100.0)], pins="corners"),
    "grid by an edge": wc.Scene(GRID, density=0.1, terms=[wc.Spring(stiffness=100.0)], pins="x < 0.01"),
    "jittered": wc.Scene(JITTERED, density=0.1, terms=[wc.Spring(stiffness=np.inf)], pins=[0]),
    "unlike springs": wc.Scene(
        JITTERED, density=0.1, terms=[wc.Spring(stiffness=5.0 ** (np.arange(len(JITTERED.edges)) % 17))], pins=[0]
    ),
    "limits of edges": wc.Scene(JITTERED, density=0.1, terms=[wc.SpringLimit(most=1.1)], pins=[0]),
    "membrane": wc.Scene(GRID, density=0.1, terms=[wc.CorotatedMembrane(stiffness=50.0)], pins=[0]),
    "limit of triangles": wc.Scene(GRID, density=0.1, terms=[wc.StrainLimit(most=1.1)], pins=[0]),
    "scattered": scattered(),
    "chain": edges_alone(line(30), links(30), pins=[0]),
    "two chains": edges_alone(np.vstack([line(9), line(14, 5.0)]), np.vstack([links(9), links(14, 9)]), pins=[0]),
    "isolated vertices": edges_alone(np.vstack([line(8), line(3, 5.0)]), links(8), pins=[0, 9]),
    "two vertices": edges_alone(line(2), links(2), pins=[0]),
    "two free vertices": edges_alone(line(2), links(2)),
    "hub": edges_alone(HUB, [[0, i] for i in range(1, 41)], pins=[1]),
    "springs twice": edges_alone(line(9), links(9), terms=[wc.Spring(stiffness=9.0), wc.Spring(stiffness=np.inf)], pins=[0]),
    "no rest length": edges_alone(line(9), links(9), terms=[wc.Spring(stiffness=np.inf, rest_lengths=0.0)], pins=[0]),
    "all pinned": edges_alone(line(6), links(6), pins=np.arange(6)),
    "bending alone": wc.Scene(GRID, density=0.1, terms=[wc.QuadraticBending(stiffness=1e-4)], pins=[0]),
    "no stiffness": edges_alone(line(6), links(6), terms=[wc.Spring(stiffness=0.0)]),
    "no terms": edges_alone(line(6), links(6), terms=[]),
}
STRAIGHT = ("grid", "grid by an edge", "jittered", "membrane", "limit of triangles")  # triangles that keep their shape
WITHOUT = ("two vertices", "two free vertices", "all pinned", "bending alone", "no stiffness", "no terms")


def lengths_of(points, pairs):
    return np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)


@pytest.mark.parametrize("name", SCENES)
def test_levels_of_any_mesh(name):
    """Each drops vertices linked to what it keeps, none of which are linked; weights are 1 in all; ways have their length."""
    # In a flat sheet of triangles that keep their shape none is shorter than the distance, else none than over links.
    scene = SCENES[name]
    model = scene.build(dtype="float64")
    n, found = model.per_copy, levels(model)
    free = model.inverse_mass.numpy() > 0.0
    assert bool(found) == (name not in WITHOUT)
    if not found:
        return
    points = scene.mesh.points
    given = [each.term.max_lengths(points, each.stencil.numpy(), each.rest.numpy())[:2] for each in model.terms]
    pairs, lengths = (np.concatenate(each) for each in zip(*given, strict=True))
    first = np.lexsort((lengths, pairs.max(axis=1), pairs.min(axis=1)))
    finest, unique = np.unique(np.sort(pairs, axis=1)[first], axis=0, return_index=True)
    graph = coo_array((np.maximum(lengths[first][unique], 1e-300), finest.T), shape=(n, n))
    shortest = dijkstra(graph, directed=False)
    there, linked = np.ones(n, dtype=bool), finest
    for level in found:
        kept = there.copy()
        kept[level.dropped] = False
        assert free[level.dropped].all() and there[level.dropped].all(), "pins are kept, and nothing is dropped twice"
        both = linked[kept[linked].all(axis=1)]
        assert not free[both].all(axis=1).any(), "no two kept free vertices are linked"
        assert (np.diff(level.offsets) > 0).all() and kept[level.parents].all()
        sums = np.add.reduceat(level.weights, level.offsets[:-1])
        assert np.abs(sums - 1.0).max() < 8 * EPS and (level.weights > 0.0).all()
        bounds = [each for each in level.bounds if len(each)]
        linked = np.concatenate([each.pairs for each in bounds])
        assert kept[linked].all() and free[linked].any(axis=1).all() and (linked[:, 0] != linked[:, 1]).all()
        ways, over_links = np.concatenate([each.lengths for each in bounds]), shortest[linked[:, 0], linked[:, 1]]
        least = over_links
        if name in STRAIGHT:
            least = (lengths / lengths_of(points, pairs)).min() * lengths_of(points, linked)
            assert (ways <= least * (1.0 + 1e-6)).mean() > 0.9, "nearly all are straight"
        assert (ways >= least * (1.0 - 100 * EPS) - 1e-200).all()
        assert (ways <= (8.0 if name == "hub" else 1.5) * over_links + 1e-200).all(), "detours stay small"
        there = kept


@table("name, dtype", [(name, "float32") for name in SCENES], [*((name, "float32") for name in SCENES), ("grid", "float64")])
def test_steps_on_any_mesh_and_copies(name, dtype, device):
    """Of a cloth stretched by a tenth: finite, no more stretched after; pins stay, and copies have the bits of one alone."""
    scene = replace(SCENES[name], positions=1.1 * SCENES[name].mesh.points, gravity=(0.0, 0.0, 0.0))
    solver = wc.HierarchicalPBD(substeps=1, iterations=5)
    alone = wc.simulate(scene, solver, device=device, dtype=dtype, frames=3)
    twice = wc.simulate(scene, solver, device=device, dtype=dtype, frames=3, copies=2)
    assert alone.status.complete and np.isfinite(alone.points).all()
    assert np.array_equal(twice.points[:, 0], alone.points) and np.array_equal(twice.points[:, 1], alone.points)
    assert np.array_equal(alone.points[-1, scene.pins.vertices], alone.points[0, scene.pins.vertices])
    edges = scene.mesh.edges
    assert lengths_of(alone.points[1], edges).sum() <= lengths_of(alone.points[0], edges).sum() * (1.0 + 1e-6)


@pytest.mark.parametrize(("name", "most"), [("membrane", 1.0), ("limit of triangles", 1.1)])
def test_reach_of_triangles(name, most):
    """Their edges, σ_max times as long as at rest; springs that resist a uniform stretch ε by Aε², as ½kA‖F − I‖² does."""
    scene = SCENES[name]
    elements = scene.terms[0].elements(scene.mesh, scene.positions)
    pairs, lengths, factors = elements.term.max_lengths(scene.mesh.points, elements.stencil, elements.rest)
    rest = lengths_of(scene.mesh.points, pairs)
    assert np.allclose(lengths, most * rest, rtol=8 * EPS)
    energy = 0.5 * (factors * rest**2).reshape(-1, 3).sum(axis=1)
    assert np.allclose(energy, scene.mesh.triangle_areas, rtol=100 * EPS)


def test_without_levels_it_is_pbd(device):
    for scene, most in ((SCENES["grid"], 0), (SCENES["bending alone"], None)):
        solvers = wc.HierarchicalPBD(substeps=2, levels=most), wc.PBD(substeps=2)
        assert np.array_equal(*(wc.simulate(scene, solver, device=device, frames=5).points for solver in solvers))


def crumpled(n):
    """A chain of links of 1 m in random directions."""
    steps = np.random.default_rng(2).normal(size=(n - 1, 3))
    return np.vstack([np.zeros(3), np.cumsum(steps / np.linalg.norm(steps, axis=1)[:, None], axis=0)])


def folded(points):
    """A flat grid folded along a line of its vertices and across another."""
    x = points.copy()
    right = points[:, 0] > points[6, 0]
    x[right, 0], x[right, 1] = points[6, 0], points[right, 0] - points[6, 0]
    return x


def test_what_meets_the_constraints_is_left_alone(device):
    """A bound is a way over finer ones, so that no state that meets those is beyond it, folded or straight."""
    grid = SCENES["grid"]
    hard, soft = [wc.Spring(pairs=("structural", "shear"), stiffness=np.inf)], [wc.Spring(stiffness=0.0)]
    soft.append(wc.SpringLimit(most=1.1))
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    states = {
        "crumpled": replace(SCENES["chain"], positions=crumpled(30), pins=None),
        "folded": replace(grid, terms=hard, positions=folded(grid.mesh.points), pins=None),
        "turned": replace(SCENES["scattered"], positions=SCENES["scattered"].mesh.points @ rotation, pins=None),
        "crushed": replace(grid, terms=[wc.SpringLimit(most=1.0)], positions=0.5 * grid.mesh.points),
        "soft, below a hard limit": replace(grid, terms=soft, positions=1.09 * grid.mesh.points, pins=None),
    }
    for name, scene in states.items():
        x, stepper = after_steps(replace(scene, gravity=(0.0, 0.0, 0.0)), wc.HierarchicalPBD(substeps=1), device)
        # Ways of up to some 10 m are a sum of some ten links, each rounded to ε of the coordinates.
        assert stepper.levels and np.abs(x - scene.positions).max() < 1000 * EPS, name


def test_bent_sheets_meet_the_bounds_of_the_flat_one():
    """A ring with a slit, rolled to a cone that overlaps by a third of a turn, which parts the sides of the slit."""
    # Cones and cylinders are isometric to the plane, so that no vertices are farther apart than the shortest path in the sheet.
    mesh = wc.Mesh.grid(6, 41, pattern="alternating")
    across, along = (mesh.points / np.ptp(mesh.points, axis=0).clip(1e-9)).T[::2]
    r, turn = 0.4 + 0.6 * across, 0.98 * np.pi * (2.0 * along - 1.0)
    flat, tip = wc.Mesh(np.stack([r * np.sin(turn), 0.0 * r, r * np.cos(turn)], axis=1), mesh.triangles), 0.75
    cone = np.stack([tip * r * np.sin(turn / tip), np.sqrt(1.0 - tip**2) * r, tip * r * np.cos(turn / tip)], axis=1)
    x, y, z = flat.points.T
    rolled = np.stack([0.2 * np.sin(x / 0.2), y - 0.2 * np.cos(x / 0.2), z], axis=1)
    bounds = [level.bounds[1] for level in levels(wc.Scene(flat, density=0.1, terms=[wc.StrainLimit(most=1.0)]).build())]
    sides = lengths_of(flat.points, flat.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)).reshape(-1, 3)
    every = np.stack(np.triu_indices(len(r), 1), axis=1)
    links_of = dijkstra(coo_array((flat.edge_lengths, flat.edges.T), shape=(len(r), len(r))), directed=False)
    over_links, surface = links_of[tuple(every.T)], UnfoldedSurface(flat.points, flat.triangles, sides, 0.0 * r > 0.0)
    straight = surface.shortened(every, over_links)
    pairs = np.concatenate([each.pairs for each in bounds] + [every])
    lengths = np.concatenate([each.lengths for each in bounds] + [straight])
    for state in (flat.points, cone, rolled):
        assert (lengths >= lengths_of(state, pairs) * (1.0 - 100 * EPS)).all()
    assert (straight < over_links * (1.0 - 1e-3)).mean() > 0.1, "many straight paths, or this proves nothing"
    assert (lengths_of(cone, every) > 1.1 * lengths_of(flat.points, every)).any(), "the sides of the slit part"


def test_straight_paths_cross_what_keeps_its_shape():
    """From corner to corner of a unit square: not across a side of two fixed vertices, nor one that triangles see otherwise."""
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 1.0], [0.0, 0, 1.0]])
    triangles, sides = np.array([[0, 1, 3], [1, 2, 3]]), np.array([[1.0, np.sqrt(2.0), 1.0], [1.0, 1.0, np.sqrt(2.0)]])
    longer = sides * [[1.0], [1.1]]
    cases = (sides, [], np.sqrt(2.0)), (sides, [1, 3], 2.0), (longer, [], 2.0), (sides * 1e-200, [], 2.0)
    for lengths, fixed, expected in cases:
        surface = UnfoldedSurface(points, triangles, lengths, np.isin(np.arange(4), fixed))
        assert surface.shortened(np.array([[0, 2]]), np.array([2.0])) == pytest.approx(expected, rel=8 * EPS)


@pytest.mark.parametrize("kind", ["grid", "jittered", "random"])
def test_levels_gain_as_much_on_any_mesh(kind, device):
    """RMS strain of a hard net that swings by two corners, that of PBD over that with levels: 3 or more at equal settings."""
    # With the lengths of paths over links alone it is 7.6, 1.4 and 1.5.
    mesh = wc.Mesh.grid(17, 17, pattern="alternating") if kind == "grid" else uneven(17, kind)
    pins = [int(np.abs(mesh.points - corner).sum(axis=1).argmin()) for corner in ([0.0, 0, 0], [1.0, 0, 0])]
    hung = wc.Scene(mesh, masses=np.full(len(mesh.points), 1.0), terms=[wc.Spring(stiffness=np.inf)], pins=pins)
    strain = []
    for solver in (wc.PBD, wc.HierarchicalPBD):
        run = wc.simulate(hung, solver(substeps=4, iterations=5), device=device, dtype="float64", frames=40)
        strain.append(np.mean([(lengths_of(x, mesh.edges) / mesh.edge_lengths - 1.0) ** 2 for x in run.points[1:]]))
    assert strain[0] > 9.0 * strain[1]


def test_levels_are_as_stiff_as_the_cloth():
    """A chain of half the vertices k/2, a square net of a quarter of them k: Σ kL² is kept; hard stays hard."""
    found = levels(edges_alone(line(33), links(33), terms=[wc.Spring(stiffness=8.0)], pins=[0]).build(dtype="float64"))
    for i, level in enumerate(found[:5]):
        assert np.allclose(1.0 / level.bounds[0].compliance, 8.0 / 2 ** (i + 1), rtol=1e-12)
        assert np.allclose(level.bounds[0].lengths, 2 ** (i + 1), rtol=1e-12)
    mesh = wc.Mesh.grid(33, 33)
    sheet = wc.Scene(mesh, density=0.1, terms=[wc.Spring(pairs=("structural", "shear"), stiffness=8.0)])
    for level in levels(sheet.build(dtype="float64"))[:3]:
        # The border has as many springs on every level, by which the sum is off by some links of each row.
        assert np.allclose(1.0 / level.bounds[0].compliance, 8.0, rtol=0.3)
    assert all((each.compliance == 0.0).all() for level in levels(SCENES["scattered"].build()) for each in level.bounds)


def test_soft_and_hard_bounds_stay_apart():
    """A soft spring and a hard limit on one pair: the hard bound has the length of the limit, not of the spring."""
    scene = edges_alone(line(31), links(31), terms=[wc.Spring(stiffness=5.0), wc.SpringLimit(most=1.25)], pins=[0])
    soft, hard = levels(scene.build(dtype="float64"))[0].bounds
    assert np.allclose(soft.lengths, 2.0) and np.allclose(1.0 / soft.compliance, 2.5)
    assert np.allclose(hard.lengths, 2.5) and (hard.compliance == 0.0).all()


def test_a_level_has_the_mass_of_what_follows():
    """Without pins all of it, of each copy; so that a move of the level conserves momentum in what follows too."""
    masses = np.stack([np.linspace(1.0, 2.0, 30), np.linspace(3.0, 1.0, 30)])
    scene = replace(SCENES["chain"], pins=None)
    model = scene.build(dtype="float64", copies=2, vary={"masses": masses})
    for level in levels(model):
        inverse = level.inverse_mass
        kept = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0.0)
        assert np.allclose(kept.sum(axis=1), masses.sum(axis=1), rtol=100 * EPS)


def test_copies_of_unlike_stiffness_are_as_alone(device):
    """None in one copy, infinite in another."""
    base = replace(SCENES["chain"], terms=[wc.Spring(stiffness=1.0)])
    stiffness, solver = [0.0, 50.0, np.inf], wc.HierarchicalPBD(substeps=1, iterations=3)
    kept = {"device": device, "dtype": "float64", "frames": 5}
    build = {"copies": 3, "vary": {"Spring.stiffness": stiffness}}
    assert levels(base.build(dtype="float64", **build))
    batch = wc.simulate(base, solver, **build, **kept).points
    for copy, k in enumerate(stiffness):
        points = wc.simulate(replace(base, terms=[wc.Spring(stiffness=k)]), solver, **kept).points
        assert np.abs(batch[:, copy] - points).max() < 1e-9


def test_the_longest_bound_of_the_copies_holds_for_all():
    """Of copies with other rest lengths; those of each meet in the sweeps over all terms."""
    mesh = wc.Mesh.chain(9)
    scene = wc.Scene(mesh, density=0.2, terms=[wc.Spring(stiffness=np.inf)], pins=[0])
    batch = scene.build(dtype="float64", copies=2, vary={"Spring.rest_lengths": [0.1, 0.2]})
    alone = replace(scene, terms=[wc.Spring(stiffness=np.inf, rest_lengths=0.2)]).build(dtype="float64")
    for one, other in zip(levels(batch), levels(alone), strict=True):
        assert all(np.array_equal(a.lengths, b.lengths) for a, b in zip(one.bounds, other.bounds, strict=True))


def test_triangles_of_other_shape_in_a_copy_have_no_straight_paths():
    """A triangle with one side shorter is not inside a larger one. Those of one shape have the paths of the largest."""
    scene, rest = SCENES["jittered"], JITTERED.edge_lengths
    shorter = rest * np.random.default_rng(0).uniform(0.9, 1.0, size=len(rest))
    for other, straight in ((0.8 * rest, True), (shorter, False)):
        batch = scene.build(dtype="float64", copies=2, vary={"Spring.rest_lengths": np.stack([rest, other])})
        bounds = levels(batch)[0].bounds[1]
        distance = lengths_of(JITTERED.points, bounds.pairs)
        assert ((bounds.lengths < distance * (1.0 + 1e-6)).mean() > 0.95) == straight


def test_stretch_grows_with_resolution_only_without_levels(device):
    """Information moves one link a sweep: 10 sweeps a step stretch a chain of 1 m with hard links the more the finer it is."""
    stretch = {}
    for solver in (wc.PBD, wc.HierarchicalPBD):
        for n in (16, 64, 256):
            hung = chain.scene(links=n, stiffness=np.inf)
            hung = replace(hung, positions=hung.mesh.points[:, [1, 0, 2]])  # level, so that it swings
            animation = wc.simulate(hung, solver(substeps=1, iterations=10), device=device, dtype="float64", frames=60)
            stretch[solver, n] = max(lengths_of(x, hung.mesh.edges).sum() for x in animation.points) - 1.0
    assert stretch[wc.PBD, 64] > 3.0 * stretch[wc.PBD, 16]
    assert stretch[wc.HierarchicalPBD, 256] < 0.1 * stretch[wc.PBD, 256]


def test_no_bound_of_a_mixed_net_is_shorter_than_the_way():
    """Vertices that are linked to kept ones by hard springs alone have no soft ways, and the reverse."""
    mesh = wc.Mesh.grid(9, 9)
    pairs = mesh.springs("structural")
    stiffness = np.where(np.random.default_rng(0).random(len(pairs)) < 0.5, 1e3, np.inf)
    terms = [wc.Spring(pairs=pairs, stiffness=stiffness)]
    for level in levels(wc.Scene(mesh, density=0.2, terms=terms, pins=[0]).build(dtype="float64")):
        for bounds in level.bounds:
            ends = mesh.points[bounds.pairs]
            assert (bounds.lengths >= np.abs(ends[:, 1] - ends[:, 0]).sum(axis=1) * (1.0 - 100 * EPS)).all()
