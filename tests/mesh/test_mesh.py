"""The mesh: topology against slow references, springs, selections, files, and everything that it refuses."""

import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from warpcloth.mesh.mesh import Mesh

PATTERNS = ("diagonal", "alternating", "equilateral")
# Coordinates are products of a few factors near 1, so they are exact to a few rounding errors.
ROUNDING = 8 * np.finfo(np.float64).eps


def random_mesh(seed):
    """A jittered grid with holes, turned triangles, unused vertices, all in random order."""
    random = np.random.default_rng(seed)
    grid = Mesh.grid(*random.integers(2, 8, size=2).tolist(), pattern=PATTERNS[seed % 3])
    triangles = np.array(grid.triangles)[random.random(len(grid.triangles)) < 0.8]
    triangles = triangles if len(triangles) else grid.triangles[:1]
    turned = random.random(len(triangles)) < 0.3
    triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
    points = grid.points + random.normal(scale=0.01, size=grid.points.shape)
    new_index = random.permutation(len(points))
    return Mesh(points[np.argsort(new_index)], random.permutation(new_index[triangles]))


def slow_sides(triangles):
    """For every edge, the (triangle, start, end, opposite vertex) of the triangles on it, lower triangles first."""
    sides = {}
    for t, corners in enumerate(triangles.tolist()):
        for k in range(3):
            start, end, opposite = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
            sides.setdefault((min(start, end), max(start, end)), []).append((t, start, end, opposite))
    return dict(sorted(sides.items()))


def normal(points, i, j, k):
    return np.cross(points[j] - points[i], points[k] - points[i])


# --- grids and chains


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("nx, ny", [(2, 2), (2, 5), (7, 2), (6, 9)])
def test_grid_is_a_disc(nx, ny, pattern):
    mesh = Mesh.grid(nx, ny, pattern=pattern)
    vertices, triangles, edges = len(mesh.points), len(mesh.triangles), len(mesh.edges)
    assert (vertices, triangles) == (nx * ny, 2 * (nx - 1) * (ny - 1))
    assert vertices - edges + triangles == 1  # Euler's formula for a disc
    assert len(mesh.boundary) == len(mesh.boundary_edges) == 2 * (nx - 1) + 2 * (ny - 1)
    assert len(mesh.hinges) == edges - len(mesh.boundary_edges)
    x0, x1, x2, x3 = mesh.hinges.T  # convex and flat
    one, two = normal(mesh.points, x0, x1, x2), normal(mesh.points, x1, x0, x3)
    assert (np.einsum("ij,ij->i", one, two) > 0).all()
    normals = np.cross(*(mesh.points[mesh.triangles[:, k]] - mesh.points[mesh.triangles[:, 0]] for k in (1, 2)))
    assert (normals[:, 1] > 0).all() and (normals[:, [0, 2]] == 0).all()
    assert mesh.texture_coordinates.min() == 0 and (mesh.texture_coordinates.max(axis=0) == 1).all()
    assert mesh.corners().tolist() == [0, nx - 1, nx * (ny - 1), nx * ny - 1]


@pytest.mark.parametrize("pattern", ["diagonal", "alternating"])
def test_grid_of_cells(pattern):
    mesh = Mesh.grid(5, 3, size=(2.0, 0.3), pattern=pattern)
    assert mesh.grid_shape == (5, 3)
    expected = [(2.0 * i / 4, 0, 0.3 * j / 2) for j in range(3) for i in range(5)]
    np.testing.assert_allclose(mesh.points, expected, rtol=ROUNDING)
    diagonals = {tuple(edge) for edge in mesh.edges.tolist()} - {tuple(edge) for edge in mesh.springs("structural")}
    mirrored = [(i + j) % 2 == 1 and pattern == "alternating" for j in range(2) for i in range(4)]
    cells = [i + 5 * j for j in range(2) for i in range(4)]
    assert diagonals == {(a + 1, a + 5) if m else (a, a + 6) for a, m in zip(cells, mirrored, strict=True)}


def test_equilateral_grid():
    mesh = Mesh.grid(5, 4, size=2.0, pattern="equilateral")
    assert mesh.grid_shape is None
    np.testing.assert_allclose(mesh.edge_lengths, 0.5, rtol=ROUNDING)
    expected = [(0.5 * i + 0.25 * (j % 2), 0, 0.5 * j * np.sqrt(3) / 2) for j in range(4) for i in range(5)]
    np.testing.assert_allclose(mesh.points, expected, rtol=ROUNDING)


@pytest.mark.parametrize("size, area", [(1.0, 1.0), (3, 9.0), ((2.0, 0.25), 0.5), (1e-3, 1e-6)])
def test_areas_sum_to_size(size, area):
    mesh = Mesh.grid(9, 6, size=size)
    assert mesh.triangle_areas.sum() == pytest.approx(area, rel=1e-14 * len(mesh.triangles))
    assert mesh.vertex_areas.sum() == pytest.approx(area, rel=1e-14 * len(mesh.triangles))
    cell = area / 40
    assert mesh.vertex_areas[0] == pytest.approx(cell / 3)  # its diagonal makes it a corner of two triangles
    assert mesh.vertex_areas[8] == pytest.approx(cell / 6)
    assert mesh.vertex_areas[10] == pytest.approx(cell)


def test_meshes_of_edges():
    mesh = Mesh.chain(5, length=2.0, direction=(0, 0, 4))
    np.testing.assert_array_equal(mesh.points, [(0, 0, 0.5 * i) for i in range(5)])
    assert mesh.edges.tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert mesh.vertex_lengths.tolist() == [0.25, 0.5, 0.5, 0.5, 0.25]
    assert mesh.boundary.tolist() == mesh.corners().tolist() == [0, 4]
    assert mesh.triangles.shape == (0, 3) and mesh.hinges.shape == (0, 4) and mesh.boundary_edges.shape == (0, 2)
    assert not mesh.vertex_areas.any() and len(mesh.isolated) == 0
    assert Mesh.chain(2).points.tolist() == [[0, 0, 0], [0, -1, 0]]
    assert STAR.boundary.tolist() == STAR.corners().tolist() == [2, 4, 6] and STAR.isolated.tolist() == [5]
    assert len(RING.boundary) == len(RING.corners()) == len(RING.isolated) == 0


# --- topology


def test_topology_against_a_dictionary():
    loose, against = 0, 0
    for seed in range(30):
        mesh = random_mesh(seed)
        sides = slow_sides(mesh.triangles)
        assert mesh.edges.tolist() == [list(edge) for edge in sides]
        assert mesh.hinges.tolist() == [[*two[0][1:], two[1][3]] for two in sides.values() if len(two) == 2], seed
        once = [list(edge) for edge, around in sides.items() if len(around) == 1]
        assert mesh.boundary_edges.tolist() == once
        assert mesh.boundary.tolist() == sorted({vertex for edge in once for vertex in edge})
        assert mesh.isolated.tolist() == sorted(set(range(len(mesh.points))) - set(mesh.triangles.ravel().tolist()))
        areas = np.zeros(len(mesh.points))
        for i, j, k in mesh.triangles:
            areas[[i, j, k]] += np.linalg.norm(normal(mesh.points, i, j, k)) / 6
        np.testing.assert_allclose(mesh.vertex_areas, areas, rtol=1e-13)
        loose += len(mesh.isolated) > 0
        run = set(map(tuple, mesh.triangles[:, [0, 1]]))
        against += any((x0, x1) in run for x0, x1 in mesh.hinges[:, :2].tolist())
    assert loose > 3 and against > 0, "the meshes cover all cases"


def test_hinge_orientation():
    points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
    consistent, turned = [(0, 2, 3), (0, 3, 1)], [(0, 2, 3), (1, 3, 0)]
    for triangles, same in ((consistent, True), (turned, False)):
        mesh = Mesh(points, triangles)
        ((x0, x1, x2, x3),) = mesh.hinges.tolist()
        assert (x0, x1, x2, x3) == (3, 0, 2, 1)
        np.testing.assert_array_equal(normal(mesh.points, x0, x1, x2), normal(mesh.points, *triangles[0]))
        second = normal(mesh.points, x1, x0, x3)
        np.testing.assert_array_equal(second, (1 if same else -1) * normal(mesh.points, *triangles[1]))


@pytest.mark.parametrize("seed", range(5))
def test_renumbering_changes_names_only(seed):
    mesh = random_mesh(seed)
    new_index = np.random.default_rng(seed).permutation(len(mesh.points))
    points = mesh.points[np.argsort(new_index)]
    renumbered = Mesh(points, new_index[mesh.triangles])
    for name in ("edges", "boundary_edges", "boundary", "isolated", "hinges"):
        before, after = new_index[getattr(mesh, name)], getattr(renumbered, name)
        order = name != "hinges"  # the four roles of a hinge's vertices must not change
        rows = [np.sort(rows, axis=-1) if order and rows.ndim == 2 else rows for rows in (before, after)]
        assert sorted(rows[0].tolist()) == sorted(rows[1].tolist()), name
    np.testing.assert_array_equal(renumbered.triangle_areas, mesh.triangle_areas)
    np.testing.assert_allclose(renumbered.vertex_areas[new_index], mesh.vertex_areas, rtol=ROUNDING)


@pytest.mark.parametrize(
    "triangles, message",
    [
        ([(0, 1, 2), (1, 0, 3), (0, 1, 4)], r"edge \[0, 1\] belongs to triangles \[0, 1, 2\], at most two"),
        ([(0, 1, 3), (1, 4, 2), (2, 4, 1)], r"triangles: \[1, 2\] have the same three vertices"),
    ],
)
def test_hinges_refused_when_asked(triangles, message):
    mesh = Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)], triangles)
    once = [list(edge) for edge, around in slow_sides(mesh.triangles).items() if len(around) == 1]
    assert mesh.boundary_edges.tolist() == once and mesh.triangle_areas.min() > 0
    with pytest.raises(ValueError, match=message):
        _ = mesh.hinges


def test_corners_of_other_triangle_meshes():
    closed = Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    assert len(closed.points) - len(closed.edges) + len(closed.triangles) == 2
    assert len(closed.hinges) == 6 and len(closed.boundary) == 0 and closed.boundary.dtype == np.int32
    with pytest.raises(ValueError, match="closed"):
        closed.corners()
    grid = Mesh.grid(5, 4)
    plane = np.stack([grid.points[:, 0], grid.points[:, 2], 0 * grid.points[:, 0]], axis=1)
    assert Mesh(plane, grid.triangles).corners().tolist() == [0, 4, 15, 19]
    assert Mesh(-plane, grid.triangles).corners().tolist() == [19, 15, 4, 0]
    assert Mesh([(0, 0, 0), (1, 0, 0), (0, 0, 1)], [(0, 2, 1)]).corners().tolist() == [0, 1, 2]


# --- springs


@pytest.mark.parametrize("n", [2, 3, 7])
@pytest.mark.parametrize("pattern", ["diagonal", "alternating"])
def test_springs_of_a_grid(n, pattern):
    mesh = Mesh.grid(n, n, size=n - 1.0, pattern=pattern)
    expected = {  # how many, and how long
        "structural": (2 * n * (n - 1), {1.0}),
        "shear": (2 * (n - 1) ** 2, {np.sqrt(2)}),
        "bending": (2 * n * (n - 2), {2.0}),
        "edges": (2 * n * (n - 1) + (n - 1) ** 2, {1.0, np.sqrt(2)}),
    }
    for kind, (count, lengths) in expected.items():
        pairs = mesh.springs(kind)
        assert pairs.dtype == np.int32 and pairs.shape == (count, 2), kind
        rows = [tuple(pair) for pair in pairs.tolist()]
        assert rows == sorted(set(rows)) and all(i < j for i, j in rows), kind
        measured = np.linalg.norm(mesh.points[pairs[:, 1]] - mesh.points[pairs[:, 0]], axis=1)
        assert all(min(abs(length - known) for known in lengths) < 1e-12 for length in measured), kind


RING = Mesh([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)], edges=[(0, 1), (2, 1), (2, 3), (3, 0)])
# Vertex 0 has three edges, vertex 5 none.
STAR = Mesh(
    [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 2), (9, 9, 9), (2, 0, 0)],
    edges=[(1, 0), (2, 0), (0, 3), (4, 3), (1, 6)],
)


@pytest.mark.parametrize(
    "mesh, kind, pairs",
    [
        (Mesh.chain(4), "structural", [[0, 1], [1, 2], [2, 3]]),
        (Mesh.chain(4), "bending", [[0, 2], [1, 3]]),
        (Mesh.chain(2), "bending", []),
        (RING, "edges", [[0, 1], [1, 2], [2, 3], [0, 3]]),
        (RING, "structural", [[0, 1], [1, 2], [2, 3], [0, 3]]),
        (RING, "bending", [[0, 2], [1, 3]]),
        (STAR, "bending", [[0, 4], [0, 6]]),
        (Mesh.grid(3, 2, pattern="equilateral"), "structural", Mesh.grid(3, 2, pattern="equilateral").edges.tolist()),
        (Mesh.grid(3, 2, pattern="equilateral"), "bending", [[0, 4], [1, 5], [2, 3]]),
    ],
)
def test_springs_of_other_meshes(mesh, kind, pairs):
    assert mesh.springs(kind).tolist() == pairs
    assert mesh.springs(kind).dtype == np.int32


# --- selections

SELECTIONS = [  # on the 4 by 3 grid of size (3, 2): vertex i + 4j at x = i, z = j
    ("all", range(12)),
    ("x < 1", [0, 4, 8]),
    ("x<=1", [0, 1, 4, 5, 8, 9]),
    ("x == 1", [1, 5, 9]),
    ("x == 1.000001", [1, 5, 9]),
    ("x == 1.00001", []),
    ("x < 1.000001", [0, 4, 8]),
    ("x >= 2.000001 and z > 1", [10, 11]),
    ("z != 1", [0, 1, 2, 3, 8, 9, 10, 11]),
    ("x > -1e0 and y == +.0", range(12)),
    ("boundary", [0, 1, 2, 3, 4, 7, 8, 9, 10, 11]),
    ("not boundary", [5, 6]),
    ("corners", [0, 3, 8, 11]),
    ("nearest(3, 0, 2)", [11]),
    ("nearest(0.9, 5, 1.2)", [5]),
    ("nearest(0, 0, 0, 3)", [0, 1, 4]),
    ("nearest(1.5, 0, 0)", [1]),  # as near as 2, which has the higher index
    ("index(0, 3, 10:12)", [0, 3, 10, 11]),
    ("index(:2, 11:, 3, 3)", [0, 1, 3, 11]),
    ("index(1::4)", [1, 5, 9]),
    ("x == 0 or z == 0 and x == 3", [0, 3, 4, 8]),  # "and" binds more tightly
    ("(x == 0 or z == 0) and x == 3", [3]),
    ("not x == 0 and z == 0", [1, 2, 3]),
    ("not (x == 0 and z == 0) and corners", [3, 8, 11]),
    ("not not index(7)", [7]),
    ("x*x + z*z < 1.1", [0, 1, 4]),
    ("x*x + z*z <= 1", [0, 1, 4]),
    ("x-1.000001 == 0", [1, 5, 9]),  # the tolerance is that of x
    ("100*x - 100.0001 == 0", [1, 5, 9]),
    ("x*x == 9.00001", [3, 7, 11]),
    ("x*x == 9.0001", []),
    ("x == z", [0, 5, 10]),
    ("1 < x", [2, 3, 6, 7, 10, 11]),
    ("x -1 > z", [2, 3, 7]),
    ("x-1>+1", [3, 7, 11]),
    ("-x + 2*-1 < -4", [3, 7, 11]),
    ("(x + z) == 2", [2, 5, 8]),
    ("(x + z)/2 - 1 == 0 and not (z > 1)", [2, 5]),
    ("((x - 1)*(x - 2)) == 0 and (x == 1 or (z) > 1)", [1, 5, 9, 10]),
    ("1/(x + 1) < 0.3", [3, 7, 11]),
    ("3 - 2 - 1 == x", [0, 4, 8]),
    ("8/4/2 == x", [1, 5, 9]),
    ("+x > 2.5", [3, 7, 11]),
    ("1 - + - x > +(2.5)", [2, 3, 6, 7, 10, 11]),
    (5000 * "-" + "x < -2.5", []),
    (5001 * "-" + "x < -2.5", [3, 7, 11]),
]


@pytest.mark.parametrize("text, expected", SELECTIONS, ids=[text[:40] for text, _ in SELECTIONS])
def test_select(text, expected):
    chosen = Mesh.grid(4, 3, size=(3, 2)).select(text)
    assert chosen.dtype == np.int32
    assert chosen.tolist() == list(expected)


SUMS = st.recursive(
    st.sampled_from(["x", "z", "1", "2.5", "-3", "0.5e1"]),
    lambda inner: (
        st.builds("{}{}{}".format, inner, st.sampled_from([" + ", "-", "*", " - "]), inner)
        | st.builds("({})".format, inner)
        | st.builds("{}{}".format, st.sampled_from("+-"), inner.filter(lambda text: text[0] not in "+-"))
    ),
    max_leaves=5,
)


@given(SUMS, SUMS)
def test_sums_are_those_of_python(left, right):
    """Of whole numbers and halves, whose values are never near π."""
    mesh = Mesh.grid(4, 3, size=(3, 2))
    coordinates = dict(zip("xyz", mesh.points.T, strict=True))
    above = eval(f"{left} - ({right}) + 0*x", {"__builtins__": {}}, coordinates) > np.pi  # the test writes the text
    assert mesh.select(f"{left} > {right} + {np.pi}").tolist() == np.flatnonzero(above).tolist()
    assert mesh.select(f"({left} - ({right}) > {np.pi})").tolist() == np.flatnonzero(above).tolist()


def test_selections_have_one_scale_and_may_be_long():
    for scale in (1e-6, 1e6):
        mesh = Mesh.grid(4, 3, size=(3 * scale, 2 * scale))
        assert mesh.select(f"x == {scale}").tolist() == [1, 5, 9]
        assert mesh.select(f"x == {1.00001 * scale}").tolist() == []
    for text in ("not ", "x < 0 or "):
        assert len(Mesh.grid(4, 3).select(20_000 * text + "all")) == 12


BAD_SELECTIONS = [
    ("", "column 1: the text ends, expected x, y, z, all, boundary"),
    ("x", "column 2: the text ends, expected < or <= or =="),
    ("x = 1", "column 3: unexpected '=', expected a number, name, comparison or one of \\( \\) , : \\+ - \\* /"),
    ("x < all", "column 5: found 'all', expected a number"),
    ("x * < 1", "column 5: found '<', expected a number"),
    ("(x + 1", "column 7: the text ends, expected"),
    ("(x + 1)", r"column 7: found .\)., expected < or"),
    ("1 + 2", "column 6: the text ends, expected < or"),
    ("x < 1 < 2", "column 7: found '<', expected \"and\""),
    ("x ** 2 < 1", r"column 4: found '\*', expected a number, x, y, z or \("),
    ("1/x < 1", "column 1: is not finite at vertex 0"),
    ("x*1e300*1e300 < 1", "column 1: is not finite at vertex"),
    ("x * (y < 1) < 1", "column 8: found '<', expected"),
    (1000 * "(" + "x" + 1000 * ")" + " < 1", "column 101: is 101 brackets deep"),
    ("x < 1e999", "column 5: found 1e999, expected a finite number"),
    ("x < nan", "column 5: found 'nan', expected a number"),
    ("x < 1 y < 2", 'column 7: found \'y\', expected "and", "or" or the end'),
    ("(x < 1", r"column 7: the text ends, expected \)"),
    ("x < 1)", "column 6: found '\\)', expected \"and\""),
    ("and", "column 1: found 'and', expected x, y, z"),
    ("X < 1", "column 1: found 'X', expected x, y, z"),
    ("__import__('os')", 'unexpected "\'"'),
    ("edge", "column 1: found 'edge', expected x, y, z"),
    ("nearest(1, 2)", r"column 13: found '\)', expected ,"),
    ("nearest(1, 2, 3, 0)", "column 18: found 0, expected a whole number from 1 to 12"),
    ("nearest(1, 2, 3, 13)", "column 18: found 13, expected a whole number from 1 to 12"),
    ("index()", r"column 7: found '\)', expected an index or a range"),
    ("index(12)", "column 7: found 12, expected a whole number from 0 to 11"),
    ("index(-1)", "column 7: found -1, expected a whole number"),
    ("index(1.0)", "column 7: found 1.0, expected a whole number"),
    ("index(3:13)", "column 9: found 13, expected a whole number from 0 to 12"),
    ("index(::0)", "column 9: found 0, expected a whole number from 1"),
    ("index(1 2)", r"column 9: found '2', expected , or \)"),
    (None, "selection is None; it must be a text"),
    (1000 * "(" + "all", r"\(…', column 101: is 101 brackets deep, must be 100 at most"),
    ("index(" + 5000 * "9" + ")", r"column 7: found 9{27}\.\.\.9{28}, expected a whole number from 0 to 11"),
    (1000 * "all or " + "x < \x1b[31m", r"^selection '….{56}x < .{8}', column 7005: unexpected"),
]


@pytest.mark.parametrize("text, message", BAD_SELECTIONS, ids=[str(text)[:40] for text, _ in BAD_SELECTIONS])
def test_select_refuses(text, message):
    with pytest.raises(ValueError, match=message) as error:
        Mesh.grid(4, 3, size=(3, 2)).select(text)
    assert repr(text) in str(error.value) or len(text) > 60


# --- what a mesh refuses

SQUARE = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
TWO = [(0, 2, 3), (0, 3, 1)]

REFUSED = [
    (lambda: Mesh(SQUARE), "triangles, edges: give exactly one"),
    (lambda: Mesh(SQUARE, TWO, [(0, 1)]), "triangles, edges: give exactly one"),
    (lambda: Mesh([], TWO), r"points: has shape \(0,\), must be \(count, 3\) with at least one row"),
    (lambda: Mesh(np.zeros((4, 2)), TWO), r"points: has shape \(4, 2\), must be \(count, 3\)"),
    (lambda: Mesh([(0, 0, 0), (1, 0)], TWO), "points: must be rows of 3 numbers"),
    (lambda: Mesh(np.array(SQUARE) * 1j, TWO), "points: has type complex128, must be real"),
    (lambda: Mesh(np.array(SQUARE).astype(str), TWO), "points: has type <U.*must be real"),
    (lambda: Mesh([*SQUARE[:2], (0, np.nan, 1), (1, 0, 1)], TWO), r"points\[2\] is \[0.0, nan, 1.0\]; it must be finite"),
    (lambda: Mesh([*SQUARE[:3], (np.inf, 0, 1)], TWO), r"points\[3\] is \[inf, 0.0, 1.0\]; it must be finite"),
    (lambda: Mesh(SQUARE, []), r"triangles: has shape \(0,\)"),
    (lambda: Mesh(SQUARE, np.empty((0, 3), int)), r"triangles: has shape \(0, 3\)"),
    (lambda: Mesh(SQUARE, [(0, 1, 2, 3)]), r"triangles: has shape \(1, 4\), must be \(count, 3\)"),
    (lambda: Mesh(SQUARE, np.array(TWO, float)), "triangles: has type float64, must be integers"),
    (lambda: Mesh(SQUARE, np.ones((2, 3), bool)), "triangles: has type bool, must be integers"),
    (lambda: Mesh(SQUARE, [*TWO, (0, 1, 4)]), r"triangles\[2\] is \[0, 1, 4\]; it must be indices of the 4 points, 0 to 3"),
    (lambda: Mesh(SQUARE, [*TWO, (0, -1, 3)]), r"triangles\[2\] is \[0, -1, 3\]; it must be indices"),
    (lambda: Mesh(SQUARE, [(0, 2, 2**40)]), r"triangles\[0\] is .*must be indices"),
    (lambda: Mesh(SQUARE, [TWO[0], (1, 3, 1)]), r"triangles\[1\] is \[1, 3, 1\]; it must be 3 different vertices"),
    (lambda: Mesh([*SQUARE, (2, 0, 2)], [*TWO, (0, 3, 4)]), r"triangles\[2\] is \[0, 3, 4\]; it must be higher than 1e-07"),
    (lambda: Mesh([*SQUARE, (0, 0, 0)], [(0, 1, 4)]), r"triangles\[0\] is \[0, 1, 4\]; it must be higher"),
    (lambda: Mesh(SQUARE, edges=[(0, 1, 2)]), r"edges: has shape \(1, 3\)"),
    (lambda: Mesh(SQUARE, edges=[(0.0, 1.0)]), "edges: has type float64, must be integers"),
    (lambda: Mesh(SQUARE, edges=[(0, 1), (2, 2)]), r"edges\[1\] is \[2, 2\]; it must be 2 different vertices"),
    (lambda: Mesh(SQUARE, edges=[(0, 1), (1, 4)]), r"edges\[1\] is \[1, 4\]; it must be indices"),
    (lambda: Mesh(SQUARE, edges=[(0, 1), (1, 2), (1, 0)]), r"edges\[2\] is \[1, 0\]; it must occur once"),
    (lambda: Mesh([*SQUARE, (1, 0, 1)], edges=[(0, 1), (4, 3)]), r"edges\[1\] is \[4, 3\]; it must have two different"),
    (lambda: Mesh(SQUARE, TWO, texture_coordinates=[(0, 0)]), "texture_coordinates: 1 rows for 4 points"),
    (lambda: Mesh(SQUARE, TWO, texture_coordinates=[(0, np.nan)] * 4), r"texture_coordinates\[0\] is .*must be finite"),
    (lambda: Mesh(SQUARE, TWO, grid_shape=(2, 3)), r"grid_shape = \(2, 3\): 2·3 must be the number of points, 4"),
    (lambda: Mesh(SQUARE, TWO, grid_shape=4), "grid_shape is 4; it must be two counts"),
    (lambda: Mesh.grid(1, 5), "nx is 1; it must be a whole number of vertices, at least 2"),
    (lambda: Mesh.grid(5, 2.0), "ny is 2.0; it must be a whole number"),
    (lambda: Mesh.grid(5, True), "ny is True; it must be a whole number"),
    (lambda: Mesh.grid(3, 3, size=0), "size is 0; it must be a finite positive length"),
    (lambda: Mesh.grid(3, 3, size=(1.0, -2.0)), "size is -2.0; it must be a finite positive length"),
    (lambda: Mesh.grid(3, 3, size=np.nan), "size is nan; it must be a finite positive length"),
    (lambda: Mesh.grid(3, 3, size="1"), "size is '1'; it must be a finite positive length"),
    (lambda: Mesh.grid(3, 3, size=(1, 2, 3)), r"size is \(1, 2, 3\); it must be one length or two"),
    (lambda: Mesh.grid(3, 3, size=(1, 2), pattern="equilateral"), r"size is \(1, 2\); it must be one length for pattern"),
    (lambda: Mesh.grid(3, 3, pattern="hexagonal"), "pattern is 'hexagonal'; it must be"),
    (lambda: Mesh.chain(1), "n is 1; it must be a whole number of vertices, at least 2"),
    (lambda: Mesh.chain(3, length=-1), "length is -1; it must be a finite positive length"),
    (lambda: Mesh.chain(3, direction=(0, 0, 0)), r"direction is \(0, 0, 0\); it must not be zero"),
    (lambda: Mesh.chain(3, direction=(0, 1)), r"direction: has shape \(1, 2\)"),
    (lambda: Mesh.grid(3, 3).springs("bend"), "kind is 'bend'; it must be"),
    (lambda: Mesh.grid(3, 3, pattern="equilateral").springs("shear"), r"shear.*needs the four-sided cells"),
    (lambda: Mesh.chain(3).springs("shear"), r"shear.*needs the four-sided cells"),
    (lambda: random_mesh(0).springs("shear"), r"shear.*needs the four-sided cells"),
]


@pytest.mark.parametrize("make, message", REFUSED, ids=[message[:50] for _, message in REFUSED])
def test_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e9])
@pytest.mark.parametrize("height, allowed", [(1e-8, False), (1e-6, True)])
def test_flatness_is_relative(scale, height, allowed):
    points = scale * np.array([(0, 0, 0), (1, 0, 0), (0.5, 0, height)])
    if allowed:
        assert len(Mesh(points, [(0, 1, 2)]).triangles) == 1
    else:
        with pytest.raises(ValueError, match="must be higher"):
            Mesh(points, [(0, 1, 2)])


def test_arrays_are_copies_and_read_only():
    points, triangles = np.array(SQUARE, dtype=np.float64), np.array(TWO, dtype=np.int32)
    mesh = Mesh(points, triangles)
    points[0], triangles[0] = 7, 1
    assert mesh.points[0].tolist() == [0, 0, 0] and mesh.triangles[0].tolist() == [0, 2, 3]
    whole = ("triangles", "edges", "hinges", "boundary", "boundary_edges", "isolated")
    for name in (*whole, "points", "edge_lengths", "triangle_areas", "vertex_areas", "vertex_lengths"):
        array = getattr(mesh, name)
        assert array.dtype == ("i4" if name in whole else "f8") and not array.flags.writeable, name
        assert getattr(mesh, name) is array, name  # computed once
    with pytest.raises(AttributeError):
        mesh.points = points


# --- files


def exported(mesh, path):
    import trimesh

    visual = trimesh.visual.TextureVisuals(uv=mesh.texture_coordinates)
    trimesh.Trimesh(mesh.points, mesh.triangles, visual=visual, process=False).export(path)
    return path


@pytest.mark.parametrize("ending", ["obj", "ply", "off", "glb", "gltf", "stl", "OBJ"])
@pytest.mark.parametrize("seed", range(3))
def test_files_keep_the_order(tmp_path, ending, seed):
    random = np.random.default_rng(seed)
    grid = Mesh.grid(5, 4, pattern=PATTERNS[seed])
    order = random.permutation(20)
    points = (grid.points + random.normal(scale=0.01, size=(20, 3)))[np.argsort(order)].astype(np.float32)
    mesh = Mesh(points, order[random.permutation(grid.triangles)], texture_coordinates=grid.texture_coordinates)
    loaded = Mesh.load(exported(mesh, tmp_path / f"cloth.{ending}"))
    if ending == "stl":  # has no indices: vertices come in the order in which triangles use them first
        used = mesh.triangles.ravel()
        _, first = np.unique(used, return_index=True)
        order = used[np.sort(first)]
        np.testing.assert_array_equal(loaded.points, mesh.points[order])
        np.testing.assert_array_equal(order[loaded.triangles], mesh.triangles)
    else:
        # Text formats have at least 8 decimals; the points are about 1 m.
        np.testing.assert_allclose(loaded.points, mesh.points, atol=1e-8 if ending in ("obj", "OBJ", "off") else 0)
        np.testing.assert_array_equal(loaded.triangles, mesh.triangles)
    if ending in ("ply", "glb", "gltf"):
        np.testing.assert_allclose(loaded.texture_coordinates, mesh.texture_coordinates, atol=1e-7)


CLOTH = "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE)
BODY = "".join(f"v {x} {y + 2} {z}\n" for x, y, z in SQUARE)
TEXTURE = "".join(f"vt {k / 8} {k / 8}\n" for k in range(6))

READ = [  # text of an OBJ file, name, number of points, triangles
    ("quad", CLOTH + "f 1 3 4 2\n", None, 4, [[0, 2, 3], [3, 1, 0]]),
    ("pentagon", CLOTH + "v 2 0 .5\nf 1 3 4 5 2\n", None, 5, [[0, 2, 3], [0, 3, 4], [0, 4, 1]]),
    ("materials", CLOTH + "usemtl red\nf 1 3 4\nusemtl blue\nf 1 4 2\n", None, 4, [[0, 2, 3], [0, 3, 1]]),
    ("relative", CLOTH + "f -4 -2 -1\nf 1 -1 2\n", None, 4, [[0, 2, 3], [0, 3, 1]]),
    ("normals", CLOTH + "vn 0 1 0\nvn 0 -1 0\nf 1//1 3//1 4//1\nf 1//2 4//2 2//2\n", None, 4, [[0, 2, 3], [0, 3, 1]]),
    ("unused vertex", "v 9 9 9\n" + CLOTH + "f 2 4 5\n", None, 5, [[1, 3, 4]]),
    ("groups", CLOTH + "g a\nf 1 3 4\ng b\nf 1 4 2\n", None, 4, [[0, 2, 3], [0, 3, 1]]),
    ("second object", "o cloth\n" + CLOTH + "f 1 3 4\no body\n" + BODY + "f 6 7 8\n", "body", 3, [[0, 1, 2]]),
    ("first object", "o cloth\n" + CLOTH + "f 1 3 4\no body\n" + BODY + "f 5 6 7\n", "cloth", 3, [[0, 1, 2]]),
]


@pytest.mark.parametrize("text, name, points, triangles", [row[1:] for row in READ], ids=[row[0] for row in READ])
def test_obj(tmp_path, text, name, points, triangles):
    path = tmp_path / "cloth.obj"
    path.write_text(text)
    mesh = Mesh.load(path, name)
    assert len(mesh.points) == points
    assert mesh.triangles.tolist() == triangles
    assert mesh.texture_coordinates is None


@pytest.mark.parametrize("seam", [True, False])
def test_obj_has_texture_coordinates_at_corners_if_a_vertex_has_several(tmp_path, seam):
    corners = [[1, 2, 3], [4, 5, 6]] if seam else [[1, 2, 3], [1, 3, 4]]
    faces = [
        "f " + " ".join(f"{v}/{t}" for v, t in zip(*row, strict=True))
        for row in zip([(1, 3, 4), (1, 4, 2)], corners, strict=True)
    ]
    (tmp_path / "cloth.obj").write_text(CLOTH + TEXTURE + "\n".join(faces))
    mesh = Mesh.load(tmp_path / "cloth.obj")
    assert len(mesh.points) == 4 and mesh.triangles.tolist() == [[0, 2, 3], [0, 3, 1]]
    np.testing.assert_array_equal(mesh.corner_coordinates, (np.array(corners)[..., None] - 1) / [8, 8])
    assert mesh.texture_coordinates.shape == ((2, 3, 2) if seam else (4, 2))


def test_ply_stays_whole_at_seams(tmp_path):
    elements = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    elements += "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    points = "".join(f"{x} {y} {z}\n" for x, y, z in SQUARE)
    faces = "3 0 2 3 6 0 0 0 1 1 1\n3 0 3 1 6 .5 .5 0 .5 1 .5\n"
    (tmp_path / "cloth.ply").write_text(f"ply\nformat ascii 1.0\n{elements}end_header\n{points}{faces}")
    mesh = Mesh.load(tmp_path / "cloth.ply")
    assert mesh.points.tolist() == [list(point) for point in SQUARE] and mesh.triangles.tolist() == [[0, 2, 3], [0, 3, 1]]
    assert mesh.texture_coordinates.tolist() == [[[0, 0], [0, 1], [1, 1]], [[0.5, 0.5], [0, 0.5], [1, 0.5]]]


def test_gltf_transforms_and_names(tmp_path):
    import trimesh

    mesh = Mesh.grid(3, 3)
    scene = trimesh.Scene()
    mirror = np.array([(0, 1.0, 0, 1), (2, 0, 0, 2), (0, 0, 1, 3), (0, 0, 0, 1)])  # (x, y, z) to (y + 1, 2x + 2, z + 3)
    for name, transform in (("cloth", mirror), ("body", np.eye(4))):
        copy = trimesh.Trimesh(mesh.points, mesh.triangles, process=False)
        scene.add_geometry(copy, node_name=name, geom_name=name, transform=transform)
    scene.export(tmp_path / "two.glb")
    with pytest.raises(ValueError, match=r"two.glb: has several geometries, name one of them: 'body', 'cloth'"):
        Mesh.load(tmp_path / "two.glb")
    with pytest.raises(ValueError, match=r"two.glb: has no geometry 'hat', it has 'body', 'cloth'"):
        Mesh.load(tmp_path / "two.glb", "hat")
    loaded = Mesh.load(tmp_path / "two.glb", "cloth")
    np.testing.assert_array_equal(loaded.points, mesh.points[:, [1, 0, 2]] * (1, 2, 1) + (1, 2, 3))
    assert (normal(loaded.points, *loaded.triangles.T)[:, 0] > 0).all()  # still the front


def test_gltf_is_welded_at_seams(tmp_path):
    import trimesh

    mesh = Mesh.grid(3, 3)
    loose = mesh.points[mesh.triangles].reshape(-1, 3)
    st = np.arange(48).reshape(24, 2) / 48
    for uv, expected in ((st, st.reshape(8, 3, 2)), (loose[:, [0, 2]], mesh.texture_coordinates)):
        visual = trimesh.visual.TextureVisuals(uv=uv)
        cut = trimesh.Trimesh(loose, np.arange(24).reshape(-1, 3), visual=visual, process=False)
        cut.export(tmp_path / "seams.glb")
        loaded = Mesh.load(tmp_path / "seams.glb")
        assert (len(loaded.points), len(loaded.hinges)) == (9, len(mesh.hinges))
        expected = loaded.points[:, [0, 2]] if expected.ndim == 2 else expected
        np.testing.assert_allclose(loaded.texture_coordinates, expected, atol=1e-7)


HEAD = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
)
ROWS = "".join(f"{x} {y} {z}\n" for x, y, z in SQUARE) + "3 0 2 1\n3 1 2 3\n"

BAD_FILES = [
    ("missing.obj", None, FileNotFoundError, "no such file"),
    ("cloth.step", "x", ValueError, "the ending must be one of .obj .ply .stl"),
    ("cloth", "x", ValueError, "the ending must be one of"),
    ("empty.ply", "", ValueError, "the file is empty"),
    ("empty.stl", "", ValueError, "the file is empty"),
    ("noise.ply", "no header\n", ValueError, "cannot be read as .ply"),
    ("noise.glb", "no header, but long enough for one", ValueError, "cannot be read as .glb"),
    ("noise.obj", "no vertices\n", ValueError, "line 1: 'no' is not supported, must be v, vt, f"),
    ("cloud.obj", CLOTH, ValueError, "has no triangles"),
    ("relative.obj", CLOTH + "f 1 2 -5\n", ValueError, "line 5: a face names -5, must be 1 or more, or negative"),
    ("flat.obj", CLOTH + "f 1 1 3\n", ValueError, r"triangles\[0\] is \[0, 0, 2\]; it must be 3 different"),
    ("nan.obj", CLOTH.replace("1", "nan") + "f 1 3 4\n", ValueError, r"points\[1\] is .*must be finite"),
    ("range.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", ValueError, "line 6: face 0 names vertex 3; the file has 3$"),
    ("short.off", "# a square\nOFF\n\n4 3 0\n" + ROWS, ValueError, "line 10: the file ends after 2 of the 3 faces"),
    ("points.off", "OFF 40 2 0\n" + ROWS, ValueError, "line 7: the file ends after 6 of the 40 vertices"),
    ("long.off", "OFF\n4 1 0\n" + ROWS, ValueError, "line 8: the file goes on after all vertices and faces that its header"),
    ("long.ply", HEAD.replace("face 2", "face 1") + ROWS, ValueError, "line 15: the file goes on after all"),
    ("row.off", "OFF\n4 2 0\n" + ROWS[:-3], ValueError, "line 8: face 1 has 3 numbers, must have 4"),
    ("counts.off", "OFF\n4 -2 0\n" + ROWS, ValueError, "line 2: must be the numbers of vertices, faces"),
    ("open.off", "OFF\n40 1 0\n" + "0 0 0\n" * 40 + "3 0 2 1", ValueError, "line 43: ends in 1 without a line break"),
    ("nothing.off", "OFF\n", ValueError, "has no line with the numbers of vertices and faces"),
    ("short.ply", HEAD.replace("face 2", "face 3") + ROWS, ValueError, "line 16: the file ends before face 2 of the 3"),
    ("row.ply", HEAD + ROWS[:-3], ValueError, "line 15: face 1 has 3 numbers, must have 4"),
    ("list.ply", HEAD + ROWS.replace("3 0", "-3 0"), ValueError, "line 14: face 0 has a list of -3"),
    ("counts.ply", HEAD.replace("face 2", "face many") + ROWS, ValueError, "line 7: must be an element"),
    ("header.ply", HEAD[:-5], ValueError, "its header has no end_header"),
    ("huge.ply", HEAD.replace("face 2", "face " + 30 * "9") + ROWS, ValueError, "line 16: the file ends before face 2"),
]


@pytest.mark.parametrize("name, text, kind, message", BAD_FILES, ids=[row[0] for row in BAD_FILES])
def test_bad_files(tmp_path, name, text, kind, message):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(kind, match=f"^{re.escape(str(tmp_path / name))}[:,] .*{message}"):
        Mesh.load(tmp_path / name)


@pytest.mark.parametrize("ending", ["ply", "off"])
def test_a_file_that_is_cut_is_no_other_mesh(tmp_path, ending):
    """At every byte: what loads at all is the whole mesh, without the line break at its end. A cut 11 would be 1."""
    mesh = Mesh.grid(4, 4)
    path = tmp_path / f"cut.{ending}"
    text = {"ply": HEAD.replace("vertex 4", "vertex 16").replace("face 2", "face 18"), "off": "OFF\n16 18 0\n"}[ending]
    text += "".join("{:.3f} {:.3f} {:.3f}\n".format(*point) for point in mesh.points)
    text += "".join("3 {} {} {}\n".format(*corners) for corners in mesh.triangles)
    loaded = []
    for length in range(1, len(text) + 1):
        path.write_text(text[:length])
        try:
            found = Mesh.load(path)
        except ValueError as error:
            assert str(error).startswith(str(path)), length
        else:
            np.testing.assert_array_equal(found.triangles, mesh.triangles)
            loaded.append(length)
    assert loaded == [len(text) - 1, len(text)]


def test_what_trimesh_stumbles_over_is_no_traceback(tmp_path):
    """It logs the traceback of a normal that is none, and goes on without normals, which nobody here needs."""
    path = tmp_path / "cloth.stl"
    facet = "facet normal 0 None 0\nouter loop\nvertex 0 0 0\nvertex 0 0 1\nvertex 1 0 0\nendloop\nendfacet\n"
    path.write_text(f"solid \n{facet}endsolid\n")
    code = f"import warpcloth as wc; print(wc.Mesh.load({str(path)!r}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("Mesh(3 points, 1 triangles, 3 edges)\n", "")


def test_import_is_light():
    modules = "{name.split('.')[0] for name in sys.modules} & {'trimesh', 'pxr', 'scipy'}"
    code = f"import sys, warpcloth.mesh; print({modules})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"
