"""Tests the degrees of freedom that hard and stiff edges leave, against closed forms and dense decompositions, and `info`."""

import json

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.lab.strips import strip
from warpcloth.scene import freedom as module
from warpcloth.scene.freedom import freedom, rank_of
from warpcloth.scenes import cantilever, hanging


def sphere():
    found = trimesh.creation.icosphere(subdivisions=2)
    return wc.Mesh(found.vertices, found.faces)


def cells(n):
    mesh = wc.Mesh.grid(n, n)
    return np.concatenate([mesh.springs("structural"), mesh.springs("shear")])


# Mesh, pairs that hold, and degrees of freedom that are left.
NETS = {
    "equilateral": lambda n: (wc.Mesh.grid(n, n, pattern="equilateral"), "edges", 3 + 4 * (n - 1)),
    "diagonal": lambda n: (wc.Mesh.grid(n, n, pattern="diagonal"), "edges", 3 + 4 * (n - 1)),
    "alternating": lambda n: (wc.Mesh.grid(n, n + 3, pattern="alternating"), "edges", 3 + 4 * (n - 1) + 6),
    "jittered": lambda n: (m := strip("jittered", 0.3, 1.0 / n).mesh, "edges", 3 + len(m.boundary_edges)),
    "rows and columns": lambda n: (wc.Mesh.grid(n, n), "structural", n * n + 2 * n),
    "both diagonals": lambda n: (wc.Mesh.grid(n, n), cells(n), 6),
    "closed surface": lambda n: (sphere(), "edges", 6),  # Gluck 1975
    "chain": lambda n: (wc.Mesh.chain(n), "edges", 2 * n + 1),
    "nothing": lambda n: (wc.Mesh.grid(n, n), np.empty((0, 2), dtype=int), 3 * n * n),
}


@pytest.mark.parametrize("n", [6, 12, pytest.param(64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NETS)
def test_ranks(name, n):
    """Matches the closed form, and for small meshes the rank from singular values of J in another general position."""
    mesh, pairs, left = NETS[name](n)
    pairs = mesh.springs(pairs) if isinstance(pairs, str) else pairs
    rank = rank_of(pairs, np.ones(mesh.points.shape, dtype=bool))
    assert 3 * len(mesh.points) - rank == left
    if len(mesh.points) < 200 and len(pairs):
        points = mesh.points + np.random.default_rng(1).uniform(-0.1, 0.1, mesh.points.shape) / n
        J = np.zeros((len(pairs), *points.shape))
        along = points[pairs[:, 1]] - points[pairs[:, 0]]
        for column, sign in ((0, -1.0), (1, 1.0)):
            J[np.arange(len(pairs)), pairs[:, column]] = sign * along / np.linalg.norm(along, axis=1)[:, None]
        assert np.linalg.matrix_rank(J.reshape(len(pairs), -1), tol=1e-9) == rank


@pytest.mark.parametrize(("pins", "rigid"), [([], 6), ([0], 3), ([0, 5], 1), ([0, 5, 30], 0)])
@pytest.mark.parametrize("kind", ["edges", ("structural", "shear")])
def test_pins_take_coordinates_and_rigid_motion(kind, pins, rigid):
    """A disc of triangles keeps its freedom beyond rigid motion, less what pins fix between them."""
    n = 6
    scene = wc.Scene(wc.Mesh.grid(n, n), density=0.1, pins=pins, terms=[wc.Spring(pairs=kind, stiffness=np.inf)])
    found = freedom(scene)
    assert (found.coordinates, found.rigid, found.hard) == (3 * (n * n - len(pins)), rigid, True)
    assert found.left == found.coordinates - found.rank and found.locked == (kind != "edges")
    assert found.left == (rigid if found.locked else 3 + 4 * (n - 1) - 3 * len(pins))


def test_locked_axes_take_coordinates_and_rigid_motion():
    """On a plane of symmetry a disc keeps two translations and the rotation in that plane."""
    mesh = wc.Mesh.grid(6, 6)
    free = np.ones((36, 3), dtype=bool)
    free[:6, 0] = False
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(pairs="edges", stiffness=np.inf)], free_axes=free)
    found = freedom(scene)
    assert (found.coordinates, found.rigid, found.left) == (108 - 6, 3, 102 - len(mesh.edges))
    bead = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], pins=[0], free_axes=[[True] * 3, [False, True, False]])
    assert freedom(bead).coordinates == 1


def test_pieces_and_loose_vertices_count_by_themselves():
    one = wc.Mesh.grid(4, 4)
    points = np.concatenate([one.points, one.points + np.array([0.0, 1.0, 0.0])])
    two = wc.Mesh(points, np.concatenate([one.triangles, one.triangles + 16]))
    pairs = np.concatenate([cells(4), cells(4) + 16])
    held = [wc.Spring(pairs=pairs, stiffness=np.inf)]
    assert freedom(wc.Scene(two, density=0.1, terms=held)).locked
    half = freedom(wc.Scene(two, density=0.1, terms=[wc.Spring(pairs=cells(4), stiffness=np.inf)]))
    assert not half.locked and (half.left, half.rigid) == (6 + 48, 12)


@pytest.mark.parametrize(
    ("scene", "edges"),
    [
        (hanging.scene(n=8), False),
        (hanging.scene(n=8, stiffness=1e7), True),
        (hanging.scene(n=8, stiffness=np.inf), True),
        (cantilever.scene(elements=8, stretching=1e4), False),
        (cantilever.scene(elements=8, stretching=1e9), True),
        (wc.Scene(wc.Mesh.grid(5, 5), density=0.1, terms=[wc.StVKMembrane(stiffness=1e3)]), False),
        (wc.Scene(wc.Mesh.grid(5, 5), density=0.1, terms=[wc.StVKMembrane(stiffness=1e7)]), True),
        (wc.Scene(wc.Mesh.chain(5), density=0.1, terms=[wc.Spring(stiffness=1e9)]), False),  # bends without strain
        (wc.Scene(wc.Mesh.chain(5), density=0.1, terms=[wc.Spring(stiffness=np.inf)]), True),
    ],
    ids=lambda given: given.name if isinstance(given, wc.Scene) else str(given),
)
def test_which_edges_are_stiff(scene, edges):
    """Where the strain of a fold of four edges costs more than its bending and the weight; all of a membrane's edges, once."""
    found = freedom(scene)
    assert (found.edges > 0) == edges
    if edges and isinstance(scene.terms[0], wc.StVKMembrane):
        assert found.edges == len(scene.mesh.edges) and found.left == 3 + len(scene.mesh.boundary_edges)


def test_of_a_large_mesh_the_count_is_a_bound(monkeypatch):
    """Rank up to the number of edges: exact of a triangulated disc and of what is rigid, and elsewhere no less is left."""
    disc = wc.Scene(wc.Mesh.grid(6, 6), density=0.1, terms=[wc.Spring(stiffness=np.inf)])
    scenes = [disc, hanging.scene(n=6, stiffness=np.inf), cantilever.scene(elements=8, stretching=1e9)]
    exact = [freedom(scene) for scene in scenes]
    monkeypatch.setattr(module, "MAX_VERTICES", 10)
    bounds = [freedom(scene) for scene in scenes]
    assert all(bound.counted and bound.left <= known.left for bound, known in zip(bounds, exact, strict=True))
    assert [(b.rank, b.locked) for b in bounds[:2]] == [(k.rank, k.locked) for k in exact[:2]]


def test_info_counts_and_warns(capfd, monkeypatch):
    def info(*arguments):
        assert main(["info", *arguments]) == 0
        found = capfd.readouterr()
        return found.out, [line for line in found.err.splitlines() if "warning: " in line and "Warp" not in line]

    out, warned = info("hanging", "-p", "n=5")
    assert "hard or stiff edges" not in out and not warned
    out, (warned,) = info("hanging", "-p", "n=5", "stiffness=inf")
    assert "hard or stiff edges: 72, of rank 68 in 69 coordinates; 1 degrees of freedom are left, 1 of them rigid motion" in out
    assert warned.startswith("warpcloth: warning: 72 hard or stiff edges leave no freedom to bend once the cloth is not flat; ")
    out, warned = info("hanging", "-p", "n=5", "stiffness=inf", "--json")
    assert json.loads(out)["freedom"]["locked"] is True and len(warned) == 1
    out, warned = info("cantilever", "-p", "elements=8", "stretching=1e9", "width=0.5", "--json")
    found = json.loads(out)["freedom"]
    assert found["locked"] is False and found["left"] == found["coordinates"] - found["rank"] > found["rigid"] and not warned
    monkeypatch.setattr(module, "MAX_VERTICES", 10)
    out, (warned,) = info("hanging", "-p", "n=5", "stiffness=inf")
    assert "of rank up to 68 in 69 coordinates; 1 or more degrees" in out and "so many that they may leave" in warned
