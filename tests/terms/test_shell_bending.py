"""Shells: no energy at rest, change of curvature on any mesh, derivatives, the modes of a spherical cap, and solvers."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import eigvalsh
from scipy.spatial import Delaunay

import warpcloth as wc
from support.continuum import turn
from support.energies import energy_and_gradient
from support.energies import eps as eps_of
from support.meshes import delaunay, rolled
from support.rows import table
from support.steps import after_steps, newton_step
from warpcloth.core.hessian import Hessian
from warpcloth.kernels.term import HessianPolicy

EPS = eps_of("float64")
D, RADIUS = 0.5, 0.3


def _jittered(n):
    """A unit square in x and z, its inner vertices moved by up to a quarter of their distances."""
    line = np.linspace(0.0, 1.0, n)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    inner = ((points > 0.0) & (points < 1.0)).all(axis=1)
    points += np.where(inner[:, None], np.random.default_rng(1).uniform(-0.25, 0.25, points.shape) / (n - 1), 0.0)
    return delaunay(points)


MESHES = {
    "diagonal": lambda n: wc.Mesh.grid(n, n),
    "alternating": lambda n: wc.Mesh.grid(n, n, pattern="alternating"),
    "jittered": _jittered,
}
mesh_of = cache(lambda name, n: MESHES[name](n))


def shell(pattern, n, radius=RADIUS, **material):
    mesh = mesh_of(pattern, n)
    return wc.Mesh(rolled(mesh.points, radius, 30.0), mesh.triangles), wc.ShellBending(stiffness=D, **material)


def built(mesh, term, device="cpu", dtype="float64"):
    return wc.Scene(mesh, density=1.0, terms=[term]).build(device=device, dtype=dtype)


@pytest.mark.parametrize("material", [{}, {"poisson_ratio": 0.3, "weft_ratio": 2.0, "warp": (1.0, 0.4, 0.0)}], ids=str)
def test_the_rest_shape_has_no_energy_however_it_is_turned(material, device):
    """κ and κ̄ are rounded by ε/a² and more for each vertex, a the shortest altitude."""
    mesh, term = shell("jittered", 8, **material)
    model = built(mesh, term, device)
    for x in (mesh.points, mesh.points @ turn([1.0, 2.0, 0.5], 2.0).T + [3.0, 0.0, 1.0]):
        U, force = energy_and_gradient(model, x)
        assert U[0] < D * (1e3 * EPS / 0.05**2) ** 2 and np.abs(force).max() < 1e5 * EPS * D / RADIUS / 0.05
    assert energy_and_gradient(model, 1.1 * mesh.points)[0][0] > 1e-3


@pytest.mark.parametrize("pattern", MESHES)
def test_a_cylinder_costs_its_change_of_curvature(pattern, device):
    """½D(1/R₂ − 1/R)² per area, from R to flat, to R/2 and inside out, within the documented errors [%], as rounded."""
    flat = mesh_of(pattern, 21)
    mesh, term = shell(pattern, 21, poisson_ratio=0.3)
    model = built(mesh, term, device)
    for radius, least, most in ((1e6, -0.35, 0.35), (0.5 * RADIUS, -1.65, -0.25), (-RADIUS, -1.05, -0.35)):
        expected = 0.5 * D * (1.0 / radius - 1.0 / RADIUS) ** 2
        error = energy_and_gradient(model, rolled(flat.points, radius, 30.0))[0][0] / expected - 1.0
        assert least < 100.0 * error < most


@pytest.mark.parametrize("curved", [0.5, 20.0])
def test_a_curvature_of_1e_9_over_a_side_is_flat(curved, device):
    """Below it a sheet bent the other way costs ½D/R² per area, as a plate does; above it ½D(2/R)², within 5 % as rolled."""
    flat, radius = mesh_of("alternating", 21), np.sqrt(2.0) * 0.05 / (curved * 1e-9)
    up, down = (flat.points + np.outer(sign * flat.points[:, 0] ** 2 / radius, [0.0, 1.0, 0.0]) for sign in (0.5, -0.5))
    energy = energy_and_gradient(built(wc.Mesh(up, flat.triangles), wc.ShellBending(stiffness=D), device), down)[0][0]
    assert energy == pytest.approx(0.5 * D / radius**2 * (1.0 if curved < 1.0 else 4.0), rel=0.05, abs=0.0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@table("tilt, arch", [(0.0, 1e-30)], [(0.3, 0.0), (0.0, 1e-30)])
def test_a_flat_shell_is_a_plate(tilt, arch, dtype, device):
    """Its energy, forces and Hessian: if it is tilted, and if its curvature is 2·arch [1/m], as small as rounding can be."""
    flat = mesh_of("jittered", 6)
    points = (flat.points + np.outer(arch * flat.points[:, 0] ** 2, [0.0, 1.0, 0.0])) @ turn([0.0, 0.0, 1.0], tilt).T
    mesh = wc.Mesh(points, flat.triangles)
    material = {"stiffness": D, "poisson_ratio": 0.3, "weft_ratio": 2.0, "warp": (1.0, 0.0, 0.5)}
    x, found = mesh.points + 0.05 * np.random.default_rng(0).normal(size=mesh.points.shape), []
    for kind in (wc.ShellBending, wc.PlateBending):
        model = built(mesh, kind(**material), device, dtype)
        hessian = Hessian(model)
        hessian.assemble(model.array(x, model.vec3), 0.0)
        found.append((*energy_and_gradient(model, x), hessian.matrix().toarray()))
    for of_shell, of_plate in zip(*found, strict=True):
        assert np.abs(of_shell - of_plate).max() < 100.0 * eps_of(dtype) * np.abs(of_plate).max()


def policies(mesh, term, x):
    """The Hessian, with the negative eigenvalues of its second part dropped, and turned, (3n, 3n) each."""
    operator, rest = term.operator(mesh), term.rest(mesh, mesh.points, None)
    G = np.kron(operator.toarray(), np.eye(3)).reshape(len(mesh.triangles), 15, x.size)
    y, found = (operator @ x).reshape(-1, 5, 3), np.zeros((3, x.size, x.size))
    for (area, *c), (*kappa, f1, f2), of_cell in zip(rest, y, G, strict=True):
        c, n = np.array(c)[:, None], np.cross(f1, f2)
        slope = np.hstack([np.cross(np.eye(3), f2).T, np.cross(f1, np.eye(3)).T])  # ∂n/∂(f₁, f₂)
        J = np.hstack([np.eye(9), -np.vstack([each * slope for each in c])])
        g, second = -(c * (kappa - c * n)).sum(axis=0), np.zeros((15, 15))
        second[9:12, 12:] = np.cross(np.eye(3), g).T  # df₁ and df₂ in g·(df₁×df₂)
        second[12:, 9:12] = second[9:12, 12:].T
        values, vectors = np.linalg.eigh(second)
        for H, of_policy in zip(found, (values, np.maximum(values, 0.0), np.abs(values)), strict=True):
            H += D * area * of_cell.T @ (J.T @ J + (vectors * of_policy) @ vectors.T) @ of_cell
    return found


def test_derivatives(device):
    """Gradient and Hessian by central differences. Policies change the second part of the Hessian alone, by its eigenvalues."""
    mesh, term = shell("jittered", 5, poisson_ratio=0.3)
    model, random, delta = built(mesh, term, device), np.random.default_rng(0), 1e-5
    x, way = mesh.points + 0.1 * random.normal(size=mesh.points.shape), random.normal(size=mesh.points.shape)
    (up, g_up), (down, g_down) = (energy_and_gradient(model, x + sign * delta * way) for sign in (1.0, -1.0))
    assert (up - down)[0] / (2.0 * delta) == pytest.approx((energy_and_gradient(model, x)[1] * way).sum(), rel=1e-7)

    def hessian(policy):
        found = Hessian(model, policy)
        found.assemble(model.array(x, model.vec3), 0.0)
        return found.matrix().toarray()

    H, expected = hessian(HessianPolicy.RAW), ((g_up - g_down) / (2.0 * delta)).ravel()
    assert np.abs(H @ way.ravel() - expected).max() < 1e-7 * np.abs(expected).max()
    scale = np.linalg.eigvalsh(H)
    assert scale[0] < -1e-4 * scale[-1]
    kinds = (HessianPolicy.RAW, HessianPolicy.CLAMP, HessianPolicy.ABSOLUTE)
    for policy, expected in zip(kinds, policies(mesh, term, x), strict=True):
        assert np.abs(hessian(policy) - expected).max() < 1e-12 * scale[-1], policy


def cap(n, angle=np.pi / 3.0):
    """A spherical cap of radius 1 about y, up to an angle from the pole, of nearly equilateral triangles of size angle/n."""
    rows = np.arange(-2 * n, 2 * n + 1)
    p = np.stack([np.add.outer(0.5 * (rows % 2), rows), np.repeat(np.sqrt(0.75) * rows[:, None], len(rows), axis=1)], axis=2)
    p, rim = p.reshape(-1, 2) / n, np.linspace(0.0, 2.0 * np.pi, round(2.0 * np.pi * n), endpoint=False)
    p = np.concatenate([p[np.hypot(*p.T) < 1.0 - 0.6 / n], np.stack([np.cos(rim), np.sin(rim)], axis=1)])
    from_pole, around = angle * np.hypot(*p.T), np.arctan2(p[:, 1], p[:, 0])
    side = np.sin(from_pole)
    return wc.Mesh(np.stack([side * np.cos(around), np.cos(from_pole), side * np.sin(around)], axis=1), Delaunay(p).simplices)


def test_modes_of_a_spherical_cap(device):
    """ρω²R⁴/D of Rayleigh's modes without stretch, u ~ sin θ tanⁿ(θ/2), in a stiff membrane, in pairs for n = 2 and 3."""
    # The error is of second order in the size of edges.
    nu, angle, exact = 0.3, np.pi / 3.0, []
    for n in (2, 3):

        def motion(t, n=n):
            return np.sin(t) * (2.0 * np.sin(t) ** 2 + (n + np.cos(t)) ** 2) * np.tan(0.5 * t) ** (2 * n)

        strain, _ = quad(lambda t, n=n: np.tan(0.5 * t) ** (2 * n) / np.sin(t) ** 3, 1e-9, angle)
        exact.append(4.0 * (1.0 - nu) * (n**3 - n) ** 2 * strain / quad(motion, 0.0, angle)[0])
    found = []
    for n in (5, 8):
        mesh = cap(n, angle)
        terms = [wc.StVKMembrane(stiffness=1e6, poisson_ratio=nu), wc.ShellBending(stiffness=1.0, poisson_ratio=nu)]
        scene = wc.Scene(mesh, density=1.0, terms=terms)
        hessian = Hessian(scene.build(device=device, dtype="float64"))
        hessian.assemble(hessian.model.positions, 0.0)
        mass = np.repeat(scene.vertex_masses, 3)
        values = eigvalsh(hessian.matrix().toarray(), np.diag(mass), subset_by_index=[0, 9])
        assert np.abs(values[:6]).max() < 1e-5 * values[6]
        found.append(values[[6, 7, 8, 9]] / np.repeat(exact, 2))
    errors = 1.0 - np.array(found)
    assert errors[0, :2] == pytest.approx(errors[1, :2] * (8 / 5) ** 2, rel=0.25)
    assert (np.abs(errors[1, :2]) < 0.05).all() and (np.abs(errors[1, 2:]) < 0.15).all()


@pytest.mark.slow
def test_solvers_that_take_it_meet(device):
    """A bent strip that starts flat: solvers end where Newton does, and its rest shape is an equilibrium."""
    flat = wc.Mesh.grid(7, 3, size=(0.15, 0.05), pattern="alternating")
    mesh = wc.Mesh(rolled(flat.points, 0.1, 0.0), flat.triangles)
    terms = [wc.StVKMembrane(stiffness=100.0), wc.ShellBending(stiffness=1e-3)]
    scene = wc.Scene(mesh, density=0.1, terms=terms, pins=[0, 7, 14], positions=flat.points, gravity=(0.0, 0.0, 0.0))
    exact = newton_step(scene, device)
    for solver in (
        wc.ProjectiveDynamics(substeps=1, tolerance=1e-11, iterations=3000, acceleration="l-bfgs"),
        wc.ADMM(substeps=1, tolerance=1e-10, iterations=2000),
    ):
        assert np.abs(after_steps(scene, solver, device)[0] - exact).max() < 1e-8
    assert np.abs(exact - flat.points).max() > 1e-3
    rest = wc.equilibrium(scene, device=device).points
    sides = np.diff(rest[mesh.edges], axis=1)[:, 0], np.diff(mesh.points[mesh.edges], axis=1)[:, 0]
    assert np.linalg.norm(sides[0], axis=1) == pytest.approx(np.linalg.norm(sides[1], axis=1), rel=1e-6)
