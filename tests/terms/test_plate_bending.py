"""Plates: surfaces of constant curvature, deflections of thin plates, the heavy elastica, and all solvers at one minimum."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.sparse.linalg import spsolve

import warpcloth as wc
from support.continuum import hill, turn
from support.continuum import jittered as irregular
from support.energies import energy_and_gradient, every_dtype
from support.energies import eps as eps_of
from support.meshes import delaunay, rolled
from support.steps import after_steps, newton_step
from warpcloth.core.hessian import Hessian
from warpcloth.lab import elastica
from warpcloth.mesh.curvature import curvature_operator

EPS = eps_of("float64")


def _scattered(n, stretch=0.0):
    """Vertices of a grid moved by up to a quarter of their distances, but for the outline and the middle."""
    # With ``stretch`` s the distances at the outline are (1 + s)/(1 − s) times those in the middle.
    line = np.linspace(0.0, 1.0, n)
    line = line + stretch * np.sin(2.0 * np.pi * line) / (2.0 * np.pi)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    spacing = np.stack(np.meshgrid(np.gradient(line), np.gradient(line)), axis=-1).reshape(-1, 2)
    moved = ((points > 0.0) & (points < 1.0)).all(axis=1)
    moved[len(points) // 2] = False
    random = np.random.default_rng(1)
    return delaunay(points + np.where(moved[:, None], random.uniform(-0.25, 0.25, points.shape) * spacing, 0.0))


def _equilateral(n):
    """A square with rows of nearly equilateral triangles, a vertex in its middle."""
    rows, points = 2 * round((n - 1) / np.sqrt(0.75) / 2.0), []
    for row in range(rows + 1):
        line = np.linspace(0.0, 1.0, n)
        if (row - rows // 2) % 2:
            line = np.concatenate([[0.0], (line[1:] + line[:-1]) / 2.0, [1.0]])
        points.append(np.stack([line, np.full(len(line), row / rows)], axis=1))
    return delaunay(np.concatenate(points))


MESHES = {
    "diagonal": lambda n: wc.Mesh.grid(n, n),
    "alternating": lambda n: wc.Mesh.grid(n, n, pattern="alternating"),
    "equilateral": _equilateral,
    "jittered": _scattered,
    "graded": lambda n: _scattered(n, 0.6),
}
mesh_of = cache(lambda name, n: MESHES[name](n))
each_mesh = pytest.mark.parametrize("pattern", MESHES)
D = 0.5
ORTHOTROPIC = {"warp": D, "weft": 2.2 * D, "coupling": 0.4 * D, "twist": 0.7 * D}
MATERIALS = {
    "0": (wc.PlateBending(stiffness=D), (D, D, 0.0, 0.5 * D)),
    "0.3": (wc.PlateBending(stiffness=D, poisson_ratio=0.3), (D, D, 0.3 * D, 0.35 * D)),
    "orthotropic": (wc.PlateBending.from_stiffnesses(**ORTHOTROPIC, direction=(1.0, 0.0, 0.0)), tuple(ORTHOTROPIC.values())),
}
each_material = pytest.mark.parametrize("material", MATERIALS)
TURNS = np.radians([0.0, 30.0, 45.0, 135.0])
# Of cylinders along some directions, a twist, a saddle and a dome.
CURVATURES = [*np.stack([np.cos(TURNS) ** 2, np.sin(TURNS) ** 2, 0.5 * np.sin(2.0 * TURNS)], axis=1)]
CURVATURES += [(0.0, 0.0, 1.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0)]


def model_of(mesh, bending, device, dtype="float64", **given):
    return wc.Scene(mesh, density=1.0, terms=[bending], **given).build(device=device, dtype=dtype)


@each_material
@each_mesh
def test_a_surface_of_constant_curvature_costs_what_a_plate_does(pattern, material, device):
    """½κᵀCκ per area, whatever the mesh, boundary included: to rounding, as second derivatives of a quadratic are exact."""
    # An entry of y sums up positions over squares of lengths; the shortest altitude a has κ rounded by some ε/a².
    mesh, (bending, (D1, D2, D12, D66)) = mesh_of(pattern, 11), MATERIALS[material]
    model, (x, _, z) = model_of(mesh, bending, device), mesh.points.T
    for kx, kz, kxz in CURVATURES:
        lifted = mesh.points + np.outer(0.5 * kx * x**2 + 0.5 * kz * z**2 + kxz * x * z, [0.0, 1.0, 0.0])
        expected = 0.5 * (D1 * kx**2 + D2 * kz**2 + 2.0 * D12 * kx * kz + 4.0 * D66 * kxz**2)
        assert energy_and_gradient(model, lifted)[0][0] == pytest.approx(expected, rel=1e-8), (kx, kz, kxz)


@pytest.mark.parametrize("degrees", [0, 25, 45, 90])
@each_mesh
def test_a_sheet_rolled_up_without_stretch_is_a_cylinder(pattern, degrees, device):
    """Chords differ from arcs: a second derivative over a patch of size s, two edges, is off by (s/R)²/12."""
    mesh, radius = mesh_of(pattern, 21), 2.0
    model = model_of(mesh, MATERIALS["0.3"][0], device)
    energy = energy_and_gradient(model, rolled(mesh.points, radius, degrees))[0][0]
    assert energy == pytest.approx(0.5 * D / radius**2, rel=2.0 * (2.0 * mesh.edge_lengths.max() / radius) ** 2 / 12.0)
    assert energy == pytest.approx(0.5 * D / radius**2, rel=1.5e-3)


def stiffness_matrix(mesh, bending, device):
    """Of the displacements across the plane, (n, n) [N/m]."""
    model = model_of(mesh, bending, device)
    hessian = Hessian(model)
    hessian.assemble(model.positions, 0.0)
    return hessian.matrix().tocsr()[1::3, 1::3]


def deflection(matrix, forces, pins):
    free, found = np.setdiff1d(np.arange(len(forces)), pins), np.zeros(len(forces))
    found[free] = spsolve(matrix[free][:, free].tocsc(), forces[free])
    return found


# Of a simply supported square under uniform load q: w in the middle over qa⁴/D, and ∫w over qa⁶/D by Navier's series.
MIDDLE = 0.00406235
ODD = np.arange(1, 100, 2)[:, None]
WHOLE = 64.0 / np.pi**8 * (1.0 / (ODD**2 * ODD.T**2 * (ODD**2 + ODD.T**2) ** 2)).sum()


def supported(pattern, n, device):
    """Errors of the deflection in the middle and of that of the whole plate."""
    mesh = mesh_of(pattern, n)
    found = deflection(stiffness_matrix(mesh, MATERIALS["0.3"][0], device), mesh.vertex_areas, mesh.boundary)
    middle = np.hypot(*(mesh.points[:, [0, 2]] - 0.5).T).argmin()
    assert np.abs(mesh.points[middle] - [0.5, 0.0, 0.5]).max() < 1e-12
    return abs(found[middle] * D / MIDDLE - 1.0), abs(found @ mesh.vertex_areas * D / WHOLE - 1.0)


@each_mesh
def test_a_supported_plate_deflects_as_it_should(pattern, device):
    """Order 2 of the whole. In the middle the error may change its sign, and only its size is known."""
    (_, coarse), (middle, fine) = (supported(pattern, n, device) for n in (11, 21))
    assert middle < 0.005 and fine < 0.007 and np.log2(coarse / fine) > 1.8


@pytest.mark.slow
@each_mesh
def test_a_fine_supported_plate_deflects_as_it_should(pattern, device):
    assert max(supported(pattern, 41, device)) < 0.002


@each_mesh
def test_a_load_on_a_corner_twists_a_plate(pattern, device):
    """Pa²/2D(1 − ν) on three held corners: a surface of constant curvature, so that a mesh of any size has it."""
    mesh = mesh_of(pattern, 11)
    corners = [np.abs(mesh.points[:, [0, 2]] - at).sum(axis=1).argmin() for at in ([0, 0], [1, 0], [0, 1], [1, 1])]
    forces = np.zeros(len(mesh.points))
    forces[corners[3]] = 1.0
    found = deflection(stiffness_matrix(mesh, MATERIALS["0.3"][0], device), forces, corners[:3])
    assert found[corners[3]] == pytest.approx(1.0 / (2.0 * 0.7 * D), rel=1e-3)


def test_a_free_plate_swings_as_it_should(device):
    """ω²√(ρ/D) of the lowest modes of a free square with ν = 0.3, 13.49, 19.79, 24.43 (Leissa 1969); three of them rigid."""
    mesh = mesh_of("jittered", 21)
    K, root = stiffness_matrix(mesh, MATERIALS["0.3"][0], device).toarray() / D, np.sqrt(mesh.vertex_areas)
    values = np.linalg.eigvalsh(K / np.outer(root, root))
    assert np.abs(values[:3]).max() < 1e-6 * values[3]
    assert np.sqrt(values[3:6]) == pytest.approx([13.49, 19.79, 24.43], rel=0.025)


@every_dtype
def test_energy_gradient_and_hessian_are_those_of_one_matrix(dtype, device):
    """U = ½xᵀHx and ∂U/∂x = Hx with H semi-definite; turned and moved the same, and 0 in the plane."""
    mesh = irregular(7, lift=hill)
    bending = wc.PlateBending.from_stiffnesses(**ORTHOTROPIC, direction=(1.0, 0.0, 0.0))
    x = mesh.points + np.random.default_rng(5).normal(scale=0.02, size=mesh.points.shape)
    model = model_of(mesh, bending, device, dtype)
    U, g = energy_and_gradient(model, x)
    hessian = Hessian(model)
    hessian.assemble(model.positions, 0.0)
    H = hessian.matrix().toarray().astype(np.float64)
    values = np.linalg.eigvalsh(H)
    rounding = 100.0 * eps_of(dtype) * values[-1] * np.abs(x).max() ** 2
    assert values[0] > -rounding and U[0] > 100.0 * rounding
    assert U[0] == pytest.approx(0.5 * x.ravel() @ H @ x.ravel(), abs=rounding)
    assert np.abs(g.ravel() - H @ x.ravel()).max() < 100.0 * eps_of(dtype) * values[-1] * np.abs(x).max()
    moved = x @ turn((1.0, -2.0, 0.5), 1.1).T + [0.3, 0.1, -0.2]
    assert energy_and_gradient(model, moved)[0][0] == pytest.approx(U[0], abs=4.0 * rounding)
    flat = irregular(7)
    assert energy_and_gradient(model_of(flat, bending, device, dtype), flat.points @ turn((1, 2, 0), 2.0).T)[0][0] < rounding


def test_only_lengths_of_the_rest_shape_count():
    """A sheet folded at rest along a column has the operator of the flat one, of which it is an isometry."""
    flat = wc.Mesh.grid(7, 6, pattern="alternating")
    folded = flat.points.copy()
    beyond = folded[:, 0] > 0.5
    folded[beyond] = np.stack([np.full(beyond.sum(), 0.5), folded[beyond, 0] - 0.5, folded[beyond, 2]], axis=1)
    one, other = (MATERIALS["0.3"][0].operator(wc.Mesh(points, flat.triangles)) for points in (flat.points, folded))
    assert abs(one - other).max() < 1e3 * EPS * abs(one).max()


def test_few_triangles_bend_too():
    """Two triangles fix no quadratic function: of those that fit it is the least, which a fold has and a plane does not."""
    mesh = wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0], [1.0, 0, 1.0]], [[0, 2, 1], [1, 2, 3]])
    K = curvature_operator(mesh)
    assert np.abs(K @ (mesh.points @ [1.0, 2.0, 3.0] + 4.0)).max() < 100 * EPS
    assert np.abs(K @ np.array([0.0, 0.0, 0.0, 1.0])).max() > 0.1


# --- the heavy elastica

GAMMA, ELEMENTS = 5.0, 32
# Of a strip at 45° a plate with D₁₂ + 1 = 2D₆₆, in units of D₁ = D₂, does not curve across: its stiffness is D₁ + D₁₂.
STRIPS = {
    "warp": ({"weft_ratio": 3.0, "warp": (1.0, 0.0, 0.0)}, 1.0),
    "weft": ({"weft_ratio": 3.0, "warp": (0.0, 0.0, 1.0)}, 3.0),
    "45°": ({"poisson_ratio": 0.5, "twist_ratio": 0.75, "warp": (1.0, 0.0, 1.0)}, 1.5),
}


@pytest.mark.parametrize(
    ("strip", "pattern"), [("warp", "diagonal"), ("weft", "alternating"), ("45°", "diagonal"), ("45°", "alternating")]
)
def test_a_strip_over_a_bar_is_the_elastica(strip, pattern, device):
    """Both ends of a strip hang over a bar, where it is level by symmetry: H/W of the elastica to 0.2 %."""
    # The membrane, kL²/D = 1e6, takes 1e-5 of that.
    material, ratio = STRIPS[strip]
    given = wc.Mesh.grid(2 * ELEMENTS + 1, 5, size=(2.0, 4.0 / ELEMENTS), pattern=pattern)
    mesh = wc.Mesh(given.points - [1.0, 0.0, 0.0], given.triangles)
    terms = [wc.StVKMembrane(stiffness=1e6 * D * ratio), wc.PlateBending(stiffness=D, **material)]
    middle = np.flatnonzero(np.abs(mesh.points[:, 0]) < 1e-9)
    scene = wc.Scene(mesh, density=GAMMA * D * ratio / 9.81, terms=terms, pins=middle)
    found = wc.equilibrium(scene, device=device)
    ends = np.abs(np.abs(mesh.points[:, 0]) - 1.0) < 1e-9
    x, y, _ = np.abs(found.points.reshape(-1, 3)[ends]).mean(axis=0)
    assert y / x == pytest.approx(elastica.aspect(GAMMA), rel=0.002)


@pytest.mark.slow
def test_drapes_of_all_patterns_come_together(device):
    """A sheet of 0.3 m hangs from corners that are moved together by 15 %: each mesh continues the one of half its size."""
    # The root of the mean square distance between any two falls from 4.3 to 0.71 and 0.13 mm. With hinges it stays at 0.88 mm.
    size, patterns = 0.3, ("diagonal", "alternating", "equilateral", "jittered")
    line = np.linspace(1e-6, size - 1e-6, 9)
    at, apart = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2), {}
    for bending in (wc.PlateBending(stiffness=1e-4, poisson_ratio=0.3), wc.DihedralBending(stiffness=1e-4)):
        shapes = {}
        for n in (9, 17, 33):
            for pattern in patterns:
                mesh = mesh_of(pattern, n)
                mesh = wc.Mesh(size * mesh.points, mesh.triangles)
                centred = mesh.points - [0.5 * size, 0.0, 0.5 * size]
                held = centred * [-0.15, 0.0, -0.15]
                x, _, z = mesh.points.T / size
                moves = held - np.outer(0.16 * (x * (1.0 - x) + z * (1.0 - z)), [0.0, 1.0, 0.0])
                before = shapes.get(pattern) or shapes.get(patterns[0])
                if before is not None:
                    moves = before(mesh.points[:, [0, 2]])
                corners = mesh.corners()
                moves[corners] = held[corners]
                terms = [wc.StVKMembrane(stiffness=1e3, poisson_ratio=0.3), bending]
                scene = wc.Scene(mesh, density=0.15, terms=terms, pins=corners, positions=mesh.points + moves)
                rest = wc.equilibrium(scene, device=device)
                assert rest.status.ok and rest.stable, rest.status
                shapes[pattern] = CloughTocher2DInterpolator(mesh.points[:, [0, 2]], rest.points - mesh.points)
            found = np.array([shapes[pattern](at) for pattern in patterns])
            pairs = np.linalg.norm(found[:, None] - found, axis=-1)
            apart[bending.label, n] = float(np.sqrt((pairs**2).mean(axis=-1)).max())
    plates, hinges = ([apart[label, n] for n in (17, 33)] for label in ("PlateBending", "DihedralBending"))
    assert plates[1] < 2e-4 and plates[0] / plates[1] > 3.0 and hinges[1] > 4.0 * plates[1]


@pytest.mark.slow
@pytest.mark.parametrize("over", [0.95, 1.2])
def test_wrinkles_of_a_stretched_sheet(over, device):
    """λ = 2√π (DL²/T)^¼ to 5 % (Cerda and Mahadevan 2003, *Geometry and physics of wrinkling*)."""
    # The sheet is stretched between hinged ends L apart, and its sides are brought together by ``over`` times what buckles it,
    # a stress of N = 2π√(DT)/L, the least of Dk² + T(π/L)²/k² over the wave number k. A stress of 1.018 N also lets 5½ waves
    # buckle, which are stable too; so the shape of least energy of three starts counts.
    L, Y, stretch = 0.2, 100.0, 1.01
    T = 0.5 * Y * (stretch**2 - 1.0)
    known, width = 0.2 * L, L  # five waves
    plate = T * L**2 * (known / L / (2.0 * np.sqrt(np.pi))) ** 4
    narrow = np.sqrt(1.0 - 4.0 * over * np.pi * np.sqrt(plate * T) / L / Y)
    mesh = wc.Mesh.grid(21, 41, size=(L, width), pattern="alternating")
    x, _, z = mesh.points.T
    ends, sides = (np.minimum(at, L - at) < 1e-9 for at in (x, z))
    held = np.flatnonzero(ends | sides)
    axes = ["x" * bool(ends[i]) + "y" + "z" * bool(sides[i]) for i in held]
    terms = [wc.StVKMembrane(stiffness=Y, poisson_ratio=0.0), wc.PlateBending(stiffness=plate)]
    pins, rests = wc.Pins(held, axes=axes), []
    for seed in range(1 if over < 1.0 else 3):
        start = mesh.points * [stretch, 1.0, narrow]
        start[:, 1] = np.where(ends | sides, 0.0, 1e-5 * np.random.default_rng(seed).normal(size=len(x)))
        sheet = wc.Scene(mesh, density=0.1, terms=terms, pins=pins, positions=start, gravity=(0.0, 0.0, 0.0))
        rests.append(wc.equilibrium(sheet, device=device, tolerance=1e-9, record="energies"))
        assert rests[-1].status.ok and rests[-1].stable, rests[-1].status
    rest = min(rests, key=lambda each: sum(each.energies.values()))
    middle = rest.points.reshape(41, 21, 3)[:, 10, 1]
    if over < 1.0:
        assert np.abs(middle).max() < 1e-9
        return
    before = np.flatnonzero(middle[1:-2] * middle[2:-1] < 0.0) + 1
    nodes = (before + middle[before] / (middle[before] - middle[before + 1])) * width / 40
    assert np.abs(middle).max() > 5e-5 and 2.0 * np.diff(nodes).mean() == pytest.approx(known, rel=0.05)


# --- solvers


@cache
def swinging(n=6):
    """A sheet of springs and an orthotropic plate at 0.3 s of its fall from two corners."""
    mesh = wc.Mesh.grid(n, n, pattern="alternating")
    bending = wc.PlateBending(stiffness=1e-3, poisson_ratio=0.3, weft_ratio=2.0)
    declared = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1e3), bending], pins="corners and z == 0")
    past = wc.simulate(declared, wc.Newton(substeps=8, tolerance=1e-6), dtype="float64", frames=18)
    return replace(declared, positions=past.points[-1], velocities=past.velocities[-1], fps=100.0)


MEET = {
    "newton": wc.Newton(substeps=1, tolerance=1e-11),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-10, iterations=400),
    "constrained dynamics cg": wc.ConstrainedDynamics(substeps=1, tolerance=1e-12, iterations=200),
    "constrained dynamics factorised": wc.ConstrainedDynamics(substeps=1, tolerance=1e-12, iterations=200, linear="factorised"),
    "admm": wc.ADMM(substeps=1, tolerance=1e-10, iterations=1_500, weight=0.1),
    "xpbd coloured": wc.XPBD(substeps=1, iterations=2_000),
    "xpbd sequential": wc.XPBD(substeps=1, iterations=2_000, sweep="sequential"),
    "xpbd to and fro": wc.XPBD(substeps=1, iterations=2_000, integrator="midpoint"),
}


ELSEWHERE = {name: [pytest.mark.host] + [pytest.mark.slow] * (name != "xpbd sequential") for name in MEET if name != "newton"}


@pytest.mark.parametrize("name", [pytest.param(name, marks=ELSEWHERE.get(name, ())) for name in MEET])
def test_all_meet(name, device):
    """1e-8 m from Newton in float64, 1e-4 m in float32 with one sweep and one matrix; without the plate it is elsewhere."""
    solver, declared = MEET[name], swinging()
    newton = wc.Newton(substeps=1, tolerance=1e-12, linear="factorised", integrator=solver.integrator)
    exact, _ = after_steps(declared, newton, device)
    assert np.abs(after_steps(declared, solver, device)[0] - exact).max() < 1e-8
    if "factorised" not in name and "coloured" not in name:  # whose kernels other rows have in float32
        assert np.abs(after_steps(declared, solver, device, "float32")[0] - exact).max() < 1e-4
    assert np.abs(after_steps(replace(declared, terms=declared.terms[:1]), newton, device)[0] - exact).max() > 1e-4


@pytest.mark.parametrize("solver", [wc.ProjectiveDynamics(substeps=1), wc.ADMM(substeps=1)], ids=["pd", "admm"])
def test_a_plate_alone_takes_one_solve(solver, device):
    """All of U is in the constant matrix."""
    declared = replace(swinging(), terms=swinging().terms[1:])
    exact = newton_step(declared, device)
    found, stepper = after_steps(declared, replace(solver, tolerance=1e-9), device)
    assert np.abs(found - exact).max() < 1e-10 and stepper.iterations <= 3


def test_a_run_ends_well_with_the_others(device):
    for solver in (wc.PBD(substeps=4), wc.HierarchicalPBD(substeps=4), wc.Explicit(substeps=64)):
        assert wc.simulate(replace(swinging(), duration=0.1), solver, device=device).status.ok


def test_copies_vary_in_what_the_weights_hold(device):
    declared, solver = swinging(), wc.ProjectiveDynamics(substeps=1, iterations=50)
    vary = {"PlateBending.poisson_ratio": [0.3, -0.4], "PlateBending.stiffness": [1e-3, 2e-3]}
    both, _ = after_steps(declared, solver, device, copies=2, vary=vary)
    springs, bending = declared.terms
    both_terms = bending, replace(bending, poisson_ratio=-0.4, stiffness=2e-3)
    alone = [after_steps(replace(declared, terms=[springs, each]), solver, device)[0] for each in both_terms]
    assert np.abs(both - np.concatenate(alone)).max() < 1e-10 and np.abs(alone[1] - alone[0]).max() > 1e-5


def test_what_cannot_be_is_refused():
    mesh, bend = wc.Mesh.grid(4, 4), wc.PlateBending
    bare = wc.Mesh(mesh.points, mesh.triangles)
    for make, sentence in (
        (lambda: bend(stiffness=1.0, poisson_ratio=1.0), r"PlateBending.poisson_ratio is 1.*must be above -1 and below 1"),
        (lambda: bend(stiffness=1.0, weft_ratio=0.0), "PlateBending.weft_ratio .* must be finite and above 0"),
        (lambda: bend.from_stiffnesses(1.0, 1.0, 1.0, 0.5), "PlateBending.coupling is 1.0; its square must be below"),
        (lambda: bend.from_stiffnesses(1.0, -1.0, 0.0, 0.5), "PlateBending.weft .* must be finite and above 0"),
        (lambda: bend(stiffness=1.0, weft_ratio=2.0).operator(bare), "PlateBending.warp is None on a mesh without texture"),
        (lambda: bend(stiffness=1.0, warp=(0.0, 1.0, 0.0)).operator(bare), "PlateBending.warp has no direction in triangle 0"),
        (lambda: bend(stiffness=1.0).operator(wc.Mesh(mesh.points[[0, 1, 4]], [[0, 1, 2]])), "PlateBending has no elements"),
        (lambda: wc.PBD(substeps=1, sweep="jacobi").bind(swinging().build()), "sweep is 'jacobi' with PlateBending"),
    ):
        with pytest.raises(ValueError, match=sentence):
            make()
