"""Local steps by a term's own prox, and energies below 0: a floor that vertices never reach.

U = −Σ kL² log(d/L), d the height above the floor: below 0 from d = L on, and no squared distance to a set.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.energies import every_dtype
from support.layers import positions
from support.steps import after_frames, after_steps, newton_step
from warpcloth.kernels import term as terms
from warpcloth.kernels.terms.attachment import measure, weight
from warpcloth.terms.declared import Declared, quantity


def rest_state(points, stencil, height=0.0, scale=1.0):
    """The height of the floor and L [m] of the vertices ``stencil`` (E, 1), (E, 2)."""
    return np.tile([height, scale], (len(stencil), 1))


@wp.func
def energy(y: Any, rest: Any):
    return -rest[1] * rest[1] * wp.log((y[0, 1] - rest[0]) / rest[1])


@wp.func
def gradient(y: Any, rest: Any):
    g = wp.matrix(shape=(1, 3), dtype=y.dtype)
    g[0, 1] = -rest[1] * rest[1] / (y[0, 1] - rest[0])
    return g


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    h = wp.matrix(shape=(3, 3), dtype=y.dtype)
    h[1, 1] = rest[1] * rest[1] / ((y[0, 1] - rest[0]) * (y[0, 1] - rest[0]))
    return h


@wp.func
def prox(v: Any, rest: Any, compliance: Any):
    """d² − d(v) d = cL²."""
    half = (v[0, 1] - rest[0]) * v.dtype(0.5)
    p = v
    p[0, 1] = rest[0] + half + wp.sqrt(half * half + compliance * rest[1] * rest[1])
    return p


FLOOR = terms.Term("Floor", 1, 1, 2, rest_state, weight, measure, energy, gradient, hessian, prox=prox)


@dataclass(frozen=True, kw_only=True)
class Floor(Declared):
    """A floor at y = ``height`` [m]; ``stiffness`` k [N/m], ``scale`` L [m]."""

    term: ClassVar = FLOOR
    height: float = field(default=0.0, metadata=quantity("must be finite", np.isfinite))
    scale: float = field(default=1.0, metadata=quantity("must be above 0", lambda values: values > 0.0))

    def stencil(self, mesh):
        return np.arange(len(mesh.points), dtype=np.int32)[:, None]

    def rest(self, mesh, positions, stencil):
        return rest_state(mesh.points, stencil, self.height, self.scale)


def sheet(scale=0.01, fps=60.0, **fields):
    """A bent sheet that falls onto the floor, above which a step without forces still ends."""
    mesh = wc.Mesh.grid(6, 5, size=0.5)
    x, _, z = mesh.points.T
    terms = [wc.Spring(stiffness=100.0), Floor(stiffness=20.0, height=-0.08, scale=scale)]
    start = mesh.points + np.stack([0.02 * z, 0.05 * np.sin(7.0 * x + 2.0 * z), 0.0 * x], axis=1)
    velocities = np.tile([0.5, -1.0, 0.0], (len(start), 1))
    return wc.Scene(mesh, density=0.2, terms=terms, positions=start, velocities=velocities, fps=fps, **fields)


@every_dtype
def test_a_prox_is_the_minimum_of_its_local_problem(dtype, device):
    """c ∂u/∂y + y − v = 0 for compliances over ten orders; all differences are roundings of v and of y − v."""
    scalar = {"float32": wp.float32, "float64": wp.float64}[dtype]
    y_type, rest_type = wp.types.matrix((1, 3), scalar), wp.types.vector(2, scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        v: wp.array(dtype=y_type),
        rest: wp.array(dtype=rest_type),
        compliance: wp.array(dtype=scalar),
        out: wp.array(dtype=y_type),
        left: wp.array(dtype=y_type),
    ):
        i = wp.tid()
        out[i] = prox(v[i], rest[i], compliance[i])
        left[i] = compliance[i] * gradient(out[i], rest[i]) + out[i] - v[i]

    random, count = np.random.default_rng(1), 200
    v = random.normal(size=(count, 1, 3)).astype(dtype)
    v[:, 0, 1] = np.abs(v[:, 0, 1])
    compliance = np.geomspace(1e-8, 1e2, count).astype(dtype)
    rest = np.tile([-0.5, 0.3], (count, 1)).astype(dtype)
    out, left = (wp.zeros(count, dtype=y_type, device=device) for _ in range(2))
    given = [wp.array(v, dtype=y_type, device=device), wp.array(rest, dtype=rest_type, device=device)]
    wp.launch(evaluate, count, [*given, wp.array(compliance, dtype=scalar, device=device)], [out, left], device=device)
    size = np.abs(out.numpy()).max(axis=(1, 2)) + np.abs(v).max(axis=(1, 2))
    assert (np.abs(left.numpy()).max(axis=(1, 2)) <= 16 * np.finfo(dtype).eps * size).all()
    assert (np.abs(out.numpy() - v).max(axis=(1, 2)) > 0.0)[compliance > 1e-5].all()


SOLVERS = {
    "xpbd coloured": wc.XPBD(substeps=1, iterations=4000),
    "xpbd averaged": wc.XPBD(substeps=1, iterations=20_000, sweep="constraint-averaged"),
    "xpbd sequential": wc.XPBD(substeps=1, iterations=4000, sweep="sequential"),
    "admm": wc.ADMM(substeps=1, iterations=4000, tolerance=1e-12),
}


LOCKED = np.random.default_rng(0).random((30, 3)) < 0.1


@pytest.mark.parametrize("free_axes", [None, ~LOCKED], ids=["free", "locked"])
@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_that_take_it_end_where_newton_does(name, free_axes, device):
    """The energy of which is below 0 there; also with some locked coordinates."""
    declared = sheet(free_axes=free_axes)
    exact = newton_step(declared, device)
    found, _ = after_steps(declared, SOLVERS[name], device)
    assert np.abs(found - exact).max() < 1e-9
    few, _ = after_steps(declared, wc.XPBD(substeps=1, iterations=3), device)
    assert np.abs(few - exact).max() > 1e-5, "few sweeps are not enough to say anything"
    heights = exact[:, 1] + 0.08
    assert heights.min() > 0.0 and -np.log(heights / 0.01).sum() < 0.0


def test_pbd_keeps_above_the_floor(device):
    stepper = after_frames(sheet(duration=0.5), wc.PBD(substeps=4, iterations=10), device=device)
    assert all((x[:, 1] > -0.08).all() for x in positions(stepper, 30))


@pytest.mark.parametrize(
    "solver", [wc.Newton(substeps=2), wc.XPBD(substeps=4), wc.ADMM(substeps=2)], ids=lambda s: type(s).__name__
)
def test_an_energy_below_0_is_no_divergence(solver, device):
    animation = wc.simulate(sheet(duration=0.5, scale=0.03), solver, device=device, dtype="float64")
    assert animation.status.ok and (animation.points[-1][:, 1] > -0.08).all()


def test_solvers_that_need_more_refuse_it(device):
    model = sheet().build(device=device)
    for solver in (wc.ProjectiveDynamics(substeps=1), wc.ConstrainedDynamics(substeps=1)):
        with pytest.raises(ValueError, match=f"{type(solver).__name__} cannot take Floor, .* Newton"):
            solver.bind(model)
