"""As-rigid-as-possible deformation against plain NumPy, libigl, the KKT system and closed forms."""

import warnings
from functools import cache

import numpy as np
import pytest
import trimesh
import warp as wp
import warp.examples
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

import warpcloth as wc
from support import matrices
from support.meshes import kite
from support.rows import table
from support.setups import allocated
from warpcloth.deformation import arap as module
from warpcloth.numerics import linear

EPS = np.finfo(np.float64).eps
CELLS = [("spokes", name) for name in ("cotangent", "clamped", "intrinsic", "uniform")] + [("spokes_and_rims", "cotangent")]


# --- meshes, each with handles and targets


def twisted(mesh, handles):
    """Those right of the middle turned by 120° about the x axis through the middle."""
    start, centre = mesh.points[handles], 0.5 * (mesh.points.min(axis=0) + mesh.points.max(axis=0))
    turned = Rotation.from_rotvec([2.0 * np.pi / 3.0, 0.0, 0.0]).apply(start - centre) + centre
    return np.where(start[:, :1] > centre[0], turned, start)


def irregular(seed=0):
    """A flat rectangle of triangles between random points, many of them obtuse, in random order."""
    random, border = np.random.default_rng(seed), np.linspace(0.0, 1.0, 8)[:-1]
    sides = np.concatenate([np.stack(pair, axis=1) for pair in ((border, 0 * border), (border, 0 * border + 1))])
    points = np.concatenate([sides, sides[:, ::-1] * [1, -1] + [0, 1], random.random((80, 2))])
    points = np.unique(np.round(points, 12), axis=0)
    points = points[random.permutation(len(points))]
    triangles = Delaunay(points).simplices
    a, b, c = (points[triangles[:, k]] for k in range(3))
    (x0, y0), (x1, y1) = (b - a).T, (c - a).T
    triangles = triangles[np.abs(x0 * y1 - x1 * y0) > 1e-6]
    # Stretched, so that Delaunay's triangles are Delaunay no more.
    return wc.Mesh(np.stack([3.0 * points[:, 0], 0 * points[:, 0], points[:, 1]], axis=1), triangles)


@cache
def load(name):
    if name == "bunny":
        mesh = wc.Mesh.load(f"{warp.examples.get_asset_directory()}/bunny.usd")
        x = mesh.points[:, 0]
        handles = np.flatnonzero((x < np.quantile(x, 0.05)) | (x > np.quantile(x, 0.95)))
    elif name == "sphere":
        sphere = trimesh.creation.icosphere(subdivisions=3)
        mesh = wc.Mesh(sphere.vertices, sphere.faces)
        handles = mesh.select("x < -0.8 or x > 0.8")
    elif name == "irregular":
        mesh = irregular()
        handles = mesh.select("x == 0 or x == 3")
    else:
        mesh = wc.Mesh.grid(14, 11, pattern="alternating")
        handles = mesh.select("x == 0 or x == 1")
    return mesh, handles, twisted(mesh, handles)


def bend(*arguments, **options):
    """An Arap without its warning of negative weights."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return wc.Arap(*arguments, **options)


# --- a plain implementation: terms (c, i, j, w) stand for w ‖(xᵢ − xⱼ) − R_c(Xᵢ − Xⱼ)‖²


def cotangent(points, i, j, k):
    """Of the angle at k, by the law of cosines and Heron's formula."""
    a, b, c = (np.linalg.norm(points[one] - points[other]) for one, other in ((j, k), (i, k), (i, j)))
    s = 0.5 * (a + b + c)
    return (a * a + b * b - c * c) / (4 * np.sqrt(s * (s - a) * (s - b) * (s - c)))


def terms(mesh, energy, weights, laplacian):
    found = []
    if energy == "spokes_and_rims":
        for triangle in mesh.triangles.tolist():
            for k in range(3):
                i, j, opposite = triangle[k - 2], triangle[k - 1], triangle[k]
                found += [(c, i, j, 0.5 * cotangent(mesh.points, i, j, opposite)) for c in triangle]
    else:
        if weights == "uniform":
            of_edges = dict.fromkeys(map(tuple, mesh.edges.tolist()), 1.0)
        elif weights == "intrinsic":
            upper = coo_matrix(laplacian)
            of_edges = {(i, j): -v for i, j, v in zip(upper.row, upper.col, upper.data, strict=True) if i < j}
        else:
            of_edges = {}
            for triangle in mesh.triangles.tolist():
                for k in range(3):
                    edge = tuple(sorted((triangle[k - 2], triangle[k - 1])))
                    half = 0.5 * cotangent(mesh.points, *edge, triangle[k])
                    of_edges[edge] = of_edges.get(edge, 0.0) + half
        if weights == "clamped":
            of_edges = {edge: max(w, 0.0) for edge, w in of_edges.items()}
        for (i, j), w in of_edges.items():
            found += [(i, i, j, w), (j, j, i, w)]
    c, i, j, w = (np.array(column) for column in zip(*found, strict=True))
    return c, i, j, w


def plain_rotations(cells, X, x):
    c, i, j, w = cells
    S = np.zeros((len(X), 3, 3))
    np.add.at(S, c, w[:, None, None] * np.einsum("ea,eb->eab", x[i] - x[j], X[i] - X[j]))
    U, _, Vt = np.linalg.svd(S)
    U[:, :, 2] *= (np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt


def plain_energy(cells, X, x, R):
    c, i, j, w = cells
    return np.sum(w * np.sum((x[i] - x[j] - np.einsum("eab,eb->ea", R[c], X[i] - X[j])) ** 2, axis=1))


def plain_system(cells, X, R):
    c, i, j, w = cells
    n = len(X)
    A = csr_matrix((np.r_[w, w, -w, -w], (np.r_[i, j, i, j], np.r_[i, j, j, i])), shape=(n, n))
    turned, b = w[:, None] * np.einsum("eab,eb->ea", R[c], X[i] - X[j]), np.zeros_like(X)
    np.add.at(b, i, turned)
    np.add.at(b, j, -turned)
    return A, b


def plain_arap(cells, X, handles, targets, x, iterations):
    """(points, energy) after each iteration."""
    free, x = np.setdiff1d(np.arange(len(X)), handles), x.copy()
    x[handles] = targets
    R, factors = plain_rotations(cells, X, x), None
    for _ in range(iterations):
        A, b = plain_system(cells, X, R)
        factors = factors or splu(A[free][:, free].tocsc())
        x[free] = factors.solve(b[free] - A[free][:, handles] @ targets)
        R = plain_rotations(cells, X, x)
        yield x.copy(), plain_energy(cells, X, x, R)


# --- against other implementations


# scipy factorises the same matrices.
@table(
    "name, energy, weights, library",
    [*(("grid", *cells, "cholespy") for cells in CELLS), ("irregular", *CELLS[0], "scipy")],
    [(name, *cells, "cholespy") for name in ("grid", "irregular") for cells in CELLS]
    + [("sphere", *cells, "cholespy") for cells in (CELLS[0], CELLS[-1])]
    + [("bunny", *CELLS[0], "cholespy")]
    + [("irregular", *cells, "scipy") for cells in CELLS],
)
def test_iterations_are_those_of_plain_numpy(name, energy, weights, library, device, monkeypatch):
    if library == "scipy":
        monkeypatch.setattr(linear, "CholeskyFactor", linear.LUFactor)
    mesh, handles, targets = load(name)
    arap = bend(mesh, handles, weights=weights, energy=energy, device=device)
    assert type(arap._factor) is (linear.LUFactor if library == "scipy" else linear.CholeskyFactor)
    cells = terms(mesh, energy, weights, arap.laplacian)
    most = {"bunny": 5, "sphere": 15}.get(name, 40)  # the plain one is slow
    plain, size = list(plain_arap(cells, mesh.points, handles, targets, mesh.points, most)), np.ptp(mesh.points)
    for iterations in (1, most) if name == "bunny" else (1, 10, most):
        found = arap.solve(targets, iterations=iterations, tolerance=0.0, initial=mesh.points)
        x, _ = plain[iterations - 1]
        assert found.iterations == iterations and not found.converged
        assert np.abs(found.points - x).max() < 1e-9 * size
        assert found.energies[1:] == pytest.approx([E for _, E in plain[:iterations]], rel=1e-9)
    assert found.energies[0] == pytest.approx(energy_of_start(cells, mesh.points, handles, targets), rel=1e-9)
    assert np.linalg.det(found.rotations) == pytest.approx(1.0, abs=1e-12)
    assert plain_energy(cells, mesh.points, found.points, found.rotations) == pytest.approx(found.energies[-1], rel=1e-9)


def energy_of_start(cells, X, handles, targets):
    x = X.copy()
    x[handles] = targets
    return plain_energy(cells, X, x, plain_rotations(cells, X, x))


@pytest.mark.parametrize("energy", ["spokes", "spokes_and_rims"])
@table("name", ["sphere"], ["grid", "sphere", "bunny"])
def test_agrees_with_libigl(name, energy, device):
    """From a smooth twist of 60°: libigl fits in single precision, which ill-conditioned cells and soft modes would show."""
    igl = pytest.importorskip("igl")
    mesh, handles, _ = load(name)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    angle = np.pi / 3.0 * (mesh.points[:, 0] - low[0]) / (high - low)[0]
    start = Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0])).apply(mesh.points - 0.5 * (low + high))
    targets, arap = start[handles], bend(mesh, handles, energy=energy, device=device)
    for iterations in (1, 10, 100)[: 2 if name == "bunny" else 3]:
        data = igl.ARAPData()
        data.energy = getattr(igl.ARAPEnergyType, f"ARAP_ENERGY_TYPE_{energy.upper()}")
        data.max_iter = iterations
        igl.arap_precomputation(mesh.points, mesh.triangles.astype(np.int64), 3, handles.astype(np.int32), data)
        theirs = igl.arap_solve(targets, data, start)
        ours = arap.solve(targets, iterations=iterations, tolerance=0.0, initial=start).points
        assert np.abs(ours - theirs).max() < 1e-5 * np.ptp(mesh.points)


@pytest.mark.parametrize("energy", ["spokes", "spokes_and_rims"])
def test_global_step_solves_the_kkt_system(energy, device):
    """[L Cᵀ; C 0], a row of C for each handle."""
    mesh, handles, targets = load("grid")
    arap, cells = wc.Arap(mesh, handles, energy=energy, device=device), terms(mesh, energy, "cotangent", None)
    start = np.array(mesh.points)
    start[handles] = targets
    A, b = plain_system(cells, mesh.points, plain_rotations(cells, mesh.points, start))
    often = 3 if energy == "spokes_and_rims" else 2
    assert np.abs(A - often * arap.laplacian).max() < 100 * EPS
    C = np.eye(len(mesh.points))[handles]
    system = np.block([[arap.laplacian.toarray(), C.T], [C, np.zeros((len(handles),) * 2)]])
    x = np.linalg.solve(system, np.concatenate([b / often, targets]))[: len(mesh.points)]
    assert np.abs(arap.solve(targets, iterations=1, initial=start).points - x).max() < 1e-12


# --- properties


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    ("name", "energy", "weights"),
    [(name, *cells) for name in ("grid", "sphere") for cells in CELLS]
    # Not the others, for strong negative weights can make a cell prefer another rotation even at rest.
    + [("irregular", "spokes", "clamped"), ("irregular", "spokes", "uniform"), ("irregular", "spokes_and_rims", "cotangent")],
)
def test_a_rigid_motion_of_the_handles_is_followed_exactly(name, energy, weights, dtype, device):
    mesh, handles, _ = load(name)
    Q = Rotation.from_rotvec([1.0, -2.0, 0.7]).as_matrix()
    arap = bend(mesh, handles, weights=weights, energy=energy, device=device, dtype=dtype)
    found, eps = arap.solve(mesh.points[handles] @ Q.T + [3.0, -2.0, 5.0]), np.finfo(dtype).eps
    assert found.converged and found.iterations == 1
    assert np.abs(found.points - (mesh.points @ Q.T + [3.0, -2.0, 5.0])).max() < 100 * eps
    assert np.abs(found.rotations - Q).max() < 100 * eps
    # Σ w ε² over the cells, for errors of a few ε in coordinates of about 1.
    assert np.abs(found.energies).max() < 20 * eps**2 * np.abs(arap.laplacian).sum()


def squares(n):
    """A mesh of two, and its points."""
    square = wc.Mesh.grid(n, n)
    points = np.concatenate([square.points, square.points + np.array([5.0, 0.0, 0.0])])
    return wc.Mesh(points, np.concatenate([square.triangles, square.triangles + n * n])), points


def test_parts_follow_their_own_handles(device):
    """Two squares, one moved and turned, the other held by a single vertex, and so only moved."""
    mesh, points = squares(4)
    Q = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()
    targets = np.concatenate([points[:4] @ Q.T, [points[20] + [0.0, 1.0, 0.0]]])
    found = wc.Arap(mesh, [0, 1, 2, 3, 20], device=device).solve(targets)
    # The handles of the first lie on a line: of all that turn it the least rotation is taken.
    assert np.abs(found.points[:16] - points[:16] @ Q.T).max() < 1e-13
    assert np.abs(found.points[16:] - points[16:] - [0.0, 1.0, 0.0]).max() < 1e-13


@table("name", ["irregular"], ["grid", "irregular", "bunny"])
@pytest.mark.parametrize(("energy", "weights"), CELLS)
def test_the_energy_never_rises(name, energy, weights, device):
    """Negative weights included, for each step minimises exactly; in rounding of E and of the solve."""
    mesh, handles, targets = load(name)
    energies = bend(mesh, handles, weights=weights, energy=energy, device=device).solve(targets, tolerance=0.0).energies
    assert len(energies) == 101 and energies[-1] < energies[0]
    assert (np.diff(energies) <= 1e-12 * np.abs(energies[:-1])).all()


def test_tolerance_ends_the_iterations(device):
    mesh, handles, targets = load("grid")
    arap, falls = wc.Arap(mesh, handles, device=device), []
    for tolerance in (1e-2, 1e-4):
        found = arap.solve(targets, tolerance=tolerance)
        fall = -np.diff(found.energies) / found.energies[1:]
        assert found.converged and fall[-1] <= tolerance < fall[:-1].min()
        falls.append(found.iterations)
    assert falls[0] < falls[1] < 100
    # From far away back to rest, where the energy is made of rounding.
    disturbed = mesh.points + 0.01 * np.sin(9 * mesh.points[:, ::-1])
    found = arap.solve(mesh.points[handles], iterations=10_000, tolerance=1e-12, initial=disturbed)
    assert found.converged and found.energies[-1] < 1e-20
    # Nearly there: what is left is the energy of strains of 1e-6, of 4 times the area (1 m²) in edges strained by 1.
    found = arap.solve(mesh.points[handles], iterations=10_000, initial=disturbed)
    assert found.converged and -np.diff(found.energies)[-1] < 4e-12 < found.energies[-1] * 1e6
    assert arap.solve(targets, iterations=0).energies.shape == (1,)


def test_handles_keep_their_order(device):
    mesh, handles, targets = load("grid")
    shuffled = np.random.default_rng(0).permutation(len(handles))
    one = wc.Arap(mesh, handles, device=device).solve(targets, iterations=5)
    arap = wc.Arap(mesh, handles[shuffled], device=device)
    other = arap.solve(targets[shuffled], iterations=5)
    assert np.abs(one.points - other.points).max() < 1e-13
    assert np.array_equal(other.points[handles], targets) and np.array_equal(arap.handles, handles[shuffled])
    assert np.array_equal(wc.Arap(mesh, "x == 0 or x == 1", device=device).handles, handles)


def test_every_vertex_may_be_a_handle(device):
    mesh, _, _ = load("grid")
    found = wc.Arap(mesh, "all", device=device).solve(2.0 * mesh.points)
    assert np.array_equal(found.points, 2.0 * mesh.points) and found.converged and found.iterations == 0
    # Every spoke is twice too long, in two cells: 2 Σ w l² is 4 area for each.
    assert found.energies == pytest.approx([2.0 * 2.0], rel=1e-12)


def test_edge_meshes(device):
    """A chain whose ends come nearer stays straight only by force; uniform weights, and rotations of rank 1 and 2."""
    mesh = wc.Mesh.chain(5)
    found = wc.Arap(mesh, [0, 4], weights="uniform", device=device).solve([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(found.points - mesh.points @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]).max() < 1e-14


def test_frames_reuse_factors_and_arrays(device, monkeypatch):
    mesh, handles, targets = load("grid")
    factored = []
    monkeypatch.setattr(module, "constant_factor", lambda *given: factored.append(1) or linear.constant_factor(*given))
    arap = wc.Arap(mesh, handles, device=device)
    frames = [mesh.points[handles] + part * (targets - mesh.points[handles]) for part in (0.2, 0.6, 1.0)]
    arap.solve(frames[0], initial=mesh.points)
    found = []
    assert allocated(lambda: found.extend(arap.solve(frame, initial=mesh.points) for frame in frames), device) == 0
    assert len(factored) == 1
    fresh = wc.Arap(mesh, handles, device=device).solve(frames[-1], initial=mesh.points)
    assert np.array_equal(found[-1].points, fresh.points) and np.array_equal(found[-1].energies, fresh.energies)


@pytest.mark.parametrize("offset", [0.0, 1000.0])
@pytest.mark.parametrize("energy", ["spokes", "spokes_and_rims"])
def test_float32_is_near_float64(energy, offset, device):
    mesh, handles, targets = load("bunny")
    moved = wc.Mesh(mesh.points + offset, mesh.triangles)
    exact = bend(mesh, handles, energy=energy, device=device).solve(targets, iterations=20, tolerance=0.0)
    found = bend(moved, handles, energy=energy, device=device, dtype="float32").solve(targets + offset, 20, 0.0)
    assert np.abs(found.points - offset - exact.points).max() < 1e-5
    assert found.energies == pytest.approx(exact.energies, rel=1e-4)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_size_of_a_mesh_does_not_matter(dtype, device):
    mesh, handles, targets = load("grid")
    found = wc.Arap(mesh, handles, device=device, dtype=dtype).solve(targets, iterations=3)
    for scale in (2.0**-70, 2.0**70):  # squares of lengths that float32 does not hold
        other = wc.Arap(wc.Mesh(scale * mesh.points, mesh.triangles), handles, device=device, dtype=dtype)
        other = other.solve(scale * targets, iterations=3)
        assert np.array_equal(other.points, scale * found.points)
        assert np.array_equal(other.energies, scale**2 * found.energies)


# --- weights


@pytest.mark.parametrize("weights", ["cotangent", "clamped", "intrinsic", "uniform"])
def test_rows_of_the_laplacian_sum_to_zero_and_it_is_linearly_precise(weights, device):
    mesh, handles, _ = load("irregular")
    L = bend(mesh, handles, weights=weights, device=device).laplacian
    size = np.abs(L).sum(axis=1).max()
    assert np.abs(L.sum(axis=1)).max() < 10 * EPS * size and abs(L - L.T).max() < 10 * EPS * size
    inside = np.setdiff1d(np.arange(len(mesh.points)), mesh.boundary)
    of_linear = np.abs((L @ mesh.points)[inside]).max()
    assert of_linear < 1e-12 * size if weights in ("cotangent", "intrinsic") else of_linear > 0.01
    # No flip helps an edge of the boundary.
    off = coo_matrix(L)
    off = off.data[(off.row != off.col) & (np.isin(off.row, inside) | np.isin(off.col, inside))]
    assert (off.max() > 0.1) == (weights == "cotangent") and (off.max() < 1e-12) == (weights != "cotangent")


# --- what is refused


def with_isolated():
    return wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [9.0, 9, 9], [0.0, 1, 0], [8.0, 9, 9]], [[0, 1, 3]])


@pytest.mark.parametrize(
    ("mesh", "handles", "options", "message"),
    [
        (kite(60.0), [], {}, r"handles is \[\], which names no vertex"),
        (kite(60.0), "y > 100", {}, "handles is 'y > 100', which names no vertex"),
        (kite(60.0), [0, 4], {}, r"handles\[1\] is 4; it must lie in 0 … 3"),
        (kite(60.0), [-1], {}, r"handles\[0\] is -1"),
        (kite(60.0), [2, 1, 2], {}, "handles names vertex 2 twice"),
        (kite(60.0), [0.5], {}, r"handles has shape \(1,\) and type float64; it must be a list of whole numbers"),
        (kite(60.0), [0], {"weights": "cot"}, "weights is 'cot'; it must be one of"),
        (kite(60.0), [0], {"energy": "rims"}, "energy is 'rims'; it must be one of"),
        (kite(60.0), [0], {"dtype": "float16"}, "dtype is 'float16'"),
        (kite(60.0), [0], {"weights": "intrinsic", "energy": "spokes_and_rims"}, "weights is 'intrinsic'; energy = "),
        (kite(60.0), [0], {"weights": "uniform", "energy": "spokes_and_rims"}, 'takes "cotangent"'),
        (wc.Mesh.chain(3), [0], {}, "weights is 'cotangent', which needs triangles"),
        (with_isolated(), [0], {}, r"vertex 2 is in no triangle and on no edge \(isolated vertices of the mesh: 2\)"),
        (squares(3)[0], [0], {}, "handles leave 1 of the 2 parts .* with 9 vertices, such as vertex 9"),
    ],
)
def test_what_cannot_be_bent_is_refused(mesh, handles, options, message):
    with pytest.raises(ValueError, match=message):
        wc.Arap(mesh, handles, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"positions": np.zeros((3, 3))}, r"positions has shape \(3, 3\); it must be \(2, 3\)"),
        ({"positions": [[0, 0, 0], [0, np.nan, 0]]}, r"positions\[1\] of handle 0 is \[0.0, nan, 0.0\]; it must be finite"),
        ({"positions": [[0, 0, 0], ["a", 0, 0]]}, "positions is .*not numeric"),
        ({"positions": [[0, 0, 0], [1e200, 0, 0]]}, "the energy after 0 iterations is inf; float64 does not hold"),
        ({"initial": np.full((4, 3), np.inf)}, r"initial\[0\] of vertex 0 is \[inf, inf, inf\]"),
        ({"initial": np.zeros((2, 3))}, r"initial has shape \(2, 3\); it must be \(4, 3\)"),
        ({"iterations": -1}, "iterations is -1"),
        ({"tolerance": np.nan}, "tolerance is nan"),
    ],
)
def test_arguments_of_a_solve_are_checked(options, message, device):
    arap = wc.Arap(kite(60.0), [2, 0], device=device)
    with pytest.raises(ValueError, match=message):
        arap.solve(**{"positions": np.zeros((2, 3)), **options})
    rest = kite(60.0).points
    assert np.abs(arap.solve(rest[[2, 0]]).points - rest).max() < 10 * EPS, "nothing of the failed call is left"


def test_intrinsic_weights_name_what_is_missing(monkeypatch):
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"needs libigl: pip install -e '\.\[intrinsic\]' in the checkout"):
        wc.Arap(kite(60.0), [0], weights="intrinsic")


# --- the factors


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("factor", [linear.CholeskyFactor, linear.LUFactor])
def test_constant_factors(factor, dtype, device):
    random, at = np.random.default_rng(0), wp.get_device(device)
    scalar = getattr(wp, dtype)
    A = csr_matrix(np.diag(np.full(20, 3.0)) + np.diag(np.full(19, -1.0), 1) + np.diag(np.full(19, -1.0), -1))
    sides = random.normal(size=(20, 3)).astype(dtype)
    b, x = (wp.array(sides, dtype=wp.types.vector(3, scalar), device=device) for _ in range(2))
    solver = factor(A, at, scalar)
    solver.solve(b, x)
    assert np.abs(x.numpy() - np.linalg.solve(A.toarray(), sides)).max() < 20 * np.finfo(dtype).eps
    sides[3, 1] = np.nan
    b.assign(sides)
    solver.solve(b, x)
    assert np.isnan(x.numpy()[:, 1]).any(), "NaN is not swallowed"
    for shift, message in ((-4.5, "not positive definite"), (np.nan, "entries that are not finite")):
        with pytest.raises(ValueError, match=message):
            factor(A + csr_matrix(np.diag(np.full(20, shift))), at, scalar)
    with pytest.raises(ValueError, match="not positive definite"):
        factor(csr_matrix(np.array([[1.0, -1.0], [-1.0, 1.0]])), at, scalar)


def test_scipy_solves_where_cholespy_is_missing(device, monkeypatch):
    monkeypatch.setattr(linear.importlib.util, "find_spec", lambda name: None)
    at = wp.get_device(device)
    assert type(linear.constant_factor(csr_matrix(np.eye(3)), at, wp.float64)) is linear.LUFactor


def test_intrinsic_weights_do_not_ask_how_triangles_run():
    """Those of a mesh with every second triangle turned over are the same; where nothing can be oriented they are refused."""
    mesh, handles, _ = load("irregular")
    mixed = mesh.triangles.copy()
    mixed[::2] = mixed[::2, ::-1]
    one, other = (bend(wc.Mesh(mesh.points, t), handles, weights="intrinsic").laplacian for t in (mesh.triangles, mixed))
    assert abs(one - other).max() < 1e-12
    fan = wc.Mesh([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    with pytest.raises(ValueError, match=r"needs a manifold that can be oriented, and at edge \[0, 1\]"):
        wc.Arap(fan, [0], weights="intrinsic")
    wc.Arap(fan, [0]).solve([[0, 0, 0]])


def test_thin_right_angles_have_no_negative_weights(device):
    """Cotangents of 1e6 are rounded by 1e-10."""
    thin = wc.Mesh.grid(5, 5).points * [1.0, 1.0, 1e-6] @ matrices.rotations(np.random.default_rng(0), 1)[0].T
    assert not len(wc.Arap(wc.Mesh(thin, wc.Mesh.grid(5, 5).triangles), "all", device=device).negative_edges)
