"""Elements of any number of vertices: bending by the Laplacian over the neighbours of a vertex, U = Σ kA(√(s² + ‖y‖²) − s)."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest
import warp as wp
from scipy.sparse import coo_array, diags_array

import warpcloth as wc
from support.energies import FEW, energy_and_gradient, eps, every_dtype
from support.steps import after_frames, after_steps, newton_step
from warpcloth.core.hessian import Hessian
from warpcloth.kernels.term import Term
from warpcloth.solvers import SOLVERS
from warpcloth.solvers.explicit import step_limits
from warpcloth.terms.declared import quantity
from warpcloth.terms.sparse import Sparse


@wp.func
def measure(rest: Any):
    return rest[0]


@wp.func
def energy(y: Any, rest: Any):
    return wp.sqrt(rest[1] * rest[1] + wp.dot(y[0], y[0])) - rest[1]


@wp.func
def gradient(y: Any, rest: Any):
    return y / wp.sqrt(rest[1] * rest[1] + wp.dot(y[0], y[0]))


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    q = wp.sqrt(rest[1] * rest[1] + wp.dot(y[0], y[0]))
    unit = y[0] / q
    return (wp.identity(n=3, dtype=y.dtype) - wp.outer(unit, unit)) / q


LAPLACIAN = Term("Laplacian", 0, 1, 2, None, None, measure, energy, gradient, hessian)


@dataclass(frozen=True, kw_only=True)
class Laplacian(Sparse):
    """y = Σⱼ(xⱼ − xᵢ) over the neighbours j of each vertex i, ``softness`` s [m], A the area of the vertex."""

    term: ClassVar[Term] = LAPLACIAN
    softness: float = field(default=0.1, metadata=quantity("must be above 0", lambda values: values > 0.0))

    def operator(self, mesh):
        i, j = np.concatenate([mesh.edges, mesh.edges[:, ::-1]]).T
        n = len(mesh.points)
        near = coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
        return near - diags_array(near.sum(axis=1))

    def rest(self, mesh, positions, stencil):
        count = len(mesh.points)
        return np.column_stack([mesh.vertex_areas, np.broadcast_to(self.of_elements("softness", count), count)])


def fan(count=9):
    """A fan of triangles beside a strip: vertices of 2 to ``count`` + 1 neighbours."""
    angle = np.linspace(0.0, 1.5 * np.pi, count)
    rim = 0.4 * np.stack([np.cos(angle), 0.1 * np.sin(3.0 * angle), np.sin(angle)], axis=1)
    points = np.vstack([np.zeros(3), rim, [[0.7, 0.0, 0.0], [0.7, 0.05, 0.3]]])
    triangles = [[0, i, i + 1] for i in range(1, count)] + [[1, 2, count + 1], [2, count + 2, count + 1]]
    return wc.Mesh(points, np.array(triangles))


def sheet(terms=None, **fields):
    mesh, random = fan(), np.random.default_rng(2)
    terms = [wc.Spring(stiffness=50.0), Laplacian(stiffness=20.0)] if terms is None else terms
    start = mesh.points + random.normal(scale=0.03, size=mesh.points.shape)
    return wc.Scene(mesh, **{"density": 0.3, "terms": terms, "positions": start, "pins": [0, 3]} | fields)


@every_dtype
def test_the_energy_is_that_of_the_operator(dtype, device):
    """In NumPy, U = Σ kA(√(s² + ‖Dx‖²) − s), of two unlike copies."""
    declared = sheet([Laplacian(stiffness=20.0)], pins=None)
    assert np.diff(declared.terms[0].elements(declared.mesh, None).cells).tolist()[:3] == [10, 4, 6]  # and the vertex itself
    softness = [0.1, 0.4]
    model = declared.build(device=device, dtype=dtype, copies=2, vary={"Laplacian.softness": softness})
    y = declared.terms[0].operator(declared.mesh) @ declared.positions
    for copy, s in enumerate(softness):
        expected = 20.0 * declared.mesh.vertex_areas @ (np.sqrt(s * s + (y**2).sum(axis=1)) - s)
        assert energy_and_gradient(model)[0][copy] == pytest.approx(expected, rel=10 * FEW * eps(dtype))


def test_gradient_and_hessian_are_differences(device):
    """Of central differences with a step of eps^⅓ edges; each is off by eps^⅔ of the largest, times some dozens for f‴."""
    declared = sheet([Laplacian(stiffness=20.0)])
    model = declared.build(device=device, dtype="float64")
    x, step = model.positions.numpy(), eps("float64") ** (1 / 3) * declared.mesh.edge_lengths.min()
    U, g = energy_and_gradient(model)
    hessian_ = Hessian(model)
    hessian_.assemble(model.positions, 0.0)
    H, free = hessian_.matrix().toarray(), np.repeat(model.inverse_mass.numpy() > 0.0, 3)
    found, columns = [], []
    for i in range(x.size):
        change = np.zeros(x.size)
        change[i] = step
        (above, g_above), (below, g_below) = (
            energy_and_gradient(model, x + sign * change.reshape(-1, 3)) for sign in (1.0, -1.0)
        )
        found.append((above - below)[0] / (2.0 * step))
        columns.append((g_above - g_below).ravel() / (2.0 * step))
    tolerance = 100.0 * eps("float64") ** (2 / 3)
    assert np.abs(np.array(found) - g.ravel()).max() <= tolerance * np.abs(g).max() and U[0] > 0.0
    assert np.abs(np.stack(columns, axis=1) - H)[np.ix_(free, free)].max() <= tolerance * np.abs(H).max()
    assert (H[~free][:, ~free] == np.eye((~free).sum())).all()


def test_the_hessian_of_a_copy_is_that_of_its_own_model(device):
    declared, stiffness = sheet(), [20.0, 30.0]
    hessian = Hessian(declared.build(device=device, copies=2, vary={"Laplacian.stiffness": stiffness}))
    hessian.assemble(hessian.model.positions, 1.0)
    alone = Hessian(sheet([declared.terms[0], Laplacian(stiffness=stiffness[1])]).build(device=device))
    alone.assemble(alone.model.positions, 1.0)
    assert (hessian.matrices()[1] != alone.matrix()).nnz == 0


def test_explicit_steps_end_where_newton_does(device):
    """Implicit and symplectic Euler are of first order: half the step, half of what they are apart."""
    apart = []
    for substeps in (64, 128):
        ends = []
        for solver in (wc.Newton(substeps=substeps, tolerance=1e-9), wc.Explicit(substeps=substeps)):
            stepper = after_frames(sheet(), solver, 6, device=device, dtype="float64")
            ends.append(stepper.state.x.numpy())
        apart.append(np.abs(ends[0] - ends[1]).max())
    assert apart[0] < 0.03 and apart[0] / apart[1] == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("options", [{}, {"linear": "factorised"}, {"hessian": "absolute"}], ids=str)
def test_newton_finds_the_minimum(options, device):
    """Its Hessian is that of the cells: within a few iterations at rounding, and as many copies as alone."""
    exact, solver = newton_step(sheet(), device), wc.Newton(substeps=1, tolerance=1e-10, **options)
    x, stepper = after_steps(sheet(), solver, device)
    assert np.abs(x - exact).max() < 1e-9 and stepper.iterations < 30
    both, _ = after_steps(sheet(), solver, device, copies=2, vary={"Laplacian.stiffness": [20.0, 80.0]})
    stiffer, _ = after_steps(sheet([wc.Spring(stiffness=50.0), Laplacian(stiffness=80.0)]), solver, device)
    assert np.abs(both - np.vstack([exact, stiffer])).max() < 1e-8 and np.abs(stiffer - exact).max() > 1e-4


def test_a_run_with_it_ends_well(device):
    for solver in (wc.Newton(substeps=4), wc.Explicit(substeps=64)):
        assert wc.simulate(sheet(duration=0.2), solver, device=device, dtype="float64").status.ok
    rest, motion = step_limits(sheet().build(device=device, dtype="float64"))
    assert 1.0 / 60 / 64 < motion <= rest < 1.0


def test_solvers_that_need_elements_refuse_it(device):
    model = sheet().build(device=device)
    for solver in SOLVERS.values():
        if solver not in (wc.Newton, wc.Explicit):
            with pytest.raises(ValueError, match=rf"{solver.__name__} cannot take Laplacian, .*(Newton|Explicit).* can"):
                solver(substeps=1).bind(model)
