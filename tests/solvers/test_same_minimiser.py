"""One state, one step, one answer: who minimises ends at the x(t + h) of Newton; who does not is listed, with the reason.

The state is that of ``hanging`` with 16² vertices at 0.3 s, h = 1/60 s; for methods that take many iterations with 8² and
h = 1/120 s, which takes them a third of the iterations. Springs of 1e3 N/m and quadratic bending of 1e-5 N·m.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import warpcloth as wc
from support.rows import table
from support.steps import after_steps, newton_step, swinging, unbalanced
from warpcloth.solvers import SOLVERS
from warpcloth.solvers.projective_dynamics import ACCELERATIONS

slow = pytest.mark.slow
# So far iterated that the gradient is rounding.
PD = wc.ProjectiveDynamics(substeps=1, tolerance=1e-11)
CONSTRAINED = wc.ConstrainedDynamics(substeps=1, tolerance=1e-12, iterations=200, linear="cg")
ON_16 = {
    **{
        f"newton {policy} {linear}": wc.Newton(substeps=1, tolerance=1e-11, hessian=policy, linear=linear)
        for policy in ("adaptive", "clamp", "absolute", "raw")
        for linear in ("cg", "factorised")
    },
    "constrained dynamics cg": CONSTRAINED,
}
ON_8 = {
    "constrained dynamics factorised": replace(CONSTRAINED, linear="factorised"),
    "projective dynamics none": replace(PD, iterations=12_000, acceleration="none"),
    "projective dynamics chebyshev": replace(PD, iterations=3_000, acceleration="chebyshev"),
    "projective dynamics anderson": replace(PD, iterations=2_000, acceleration="anderson"),
    "projective dynamics l-bfgs": replace(PD, iterations=1_000, acceleration="l-bfgs"),
    "projective dynamics chebyshev-jacobi": replace(PD, iterations=5_000, acceleration="chebyshev", linear="jacobi"),
    "projective dynamics matrix-free": replace(PD, iterations=2_000, acceleration="l-bfgs", linear="jacobi"),
    "admm": wc.ADMM(substeps=1, tolerance=1e-11, iterations=3_000, weight=0.1),
    "admm heavy": wc.ADMM(substeps=1, tolerance=1e-11, iterations=2_000),
    "xpbd coloured": wc.XPBD(substeps=1, iterations=8_000),
    "xpbd sequential": wc.XPBD(substeps=1, iterations=8_000, sweep="sequential"),
    "xpbd jacobi": wc.XPBD(substeps=1, iterations=60_000, sweep="constraint-averaged"),
}
QUICK = ("newton adaptive cg", "newton clamp factorised", "constrained dynamics cg", "projective dynamics l-bfgs")
QUICK += ("admm", "xpbd coloured")
DO_NOT = {
    wc.Explicit: "takes the forces of where the step begins and minimises nothing",
    wc.PBD: "projects onto constraints whose stiffness depends on iterations and step",
    wc.HierarchicalPBD: "does the same, after levels of constraints that the scene does not have",
}
# What runs on a device too, which waits for the host in each iteration.
SHORT = (*ON_16, "constrained dynamics factorised", "projective dynamics l-bfgs", "projective dynamics matrix-free", "admm")
each_solver = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[*[slow] * (name not in QUICK), *[pytest.mark.host] * (name not in SHORT)])
        for name in ON_16 | ON_8
    ],
)


@cache
def state(n):
    """The scene before the step."""
    return replace(swinging(n), fps={8: 120.0, 16: 60.0}[n])


@each_solver
def test_all_meet(name, device):
    """1e-8 m in float64, where the gradient falls to rounding too, and 1e-4 m in float32."""
    n, solver = (8, ON_8[name]) if name in ON_8 else (16, ON_16[name])
    declared = state(n)
    newton = newton_step(declared, device)
    x, _ = after_steps(declared, solver, device)
    # What rounding of lengths may make of the gradient: 4ε k times valence and size.
    mass = declared.vertex_masses.max()
    noise = 4.0 * np.finfo(np.float64).eps * (1e3 * 8 + mass * declared.fps**2) / mass / 9.81
    assert np.abs(x - newton).max() < 1e-8 and unbalanced(declared, x, device) < 10.0 * noise
    fewer = replace(solver, iterations=solver.iterations // 4) if name in ON_8 else solver
    x, _ = after_steps(declared, fewer, device, "float32")
    assert np.abs(x - newton).max() < 1e-4
    if not isinstance(solver, (wc.Newton, wc.ConstrainedDynamics)):  # which need fewer
        few, _ = after_steps(declared, replace(solver, iterations=10), device)
        assert np.abs(few - newton).max() > 1e-4, "ten iterations are not enough to say anything"


WITHOUT_PROJECTION = {
    "OrthotropicMembrane": wc.OrthotropicMembrane(
        stiffness=300.0, weft_ratio=2.0, poisson_ratio=0.5, shear_ratio=0.3, warp=(1.0, 0.0, 1.0)
    ),
    "StVKMembrane": wc.StVKMembrane(stiffness=300.0, poisson_ratio=0.3),
    "NeoHookeanMembrane": wc.NeoHookeanMembrane(stiffness=300.0, poisson_ratio=0.3),
    "damping": wc.StVKMembrane(stiffness=300.0, damping=0.3),
    "DihedralBending": wc.DihedralBending(stiffness=1e-3),
}
BY_NEWTON = {
    "projective dynamics": replace(PD, iterations=2_000, acceleration="l-bfgs"),
    "projective dynamics none": replace(PD, iterations=12_000, acceleration="none"),
    "xpbd": wc.XPBD(substeps=1, iterations=2_000),
    "xpbd jacobi": wc.XPBD(substeps=1, iterations=20_000, sweep="constraint-averaged"),
}


# The slow ways differ in what they do with the local steps, not in the steps, so that one energy is enough for each.
MET = [(energy, "projective dynamics") for energy in WITHOUT_PROJECTION]
MET += [(energy, "xpbd") for energy in ("OrthotropicMembrane", "StVKMembrane")]  # refuses damping; hinges: by a scalar
MET += [("StVKMembrane", "projective dynamics none"), ("OrthotropicMembrane", "xpbd jacobi")]


@cache
def without_projection(energy, device):
    """The scene of an energy, and x(t + h) of Newton."""
    declared = replace(state(8), terms=[WITHOUT_PROJECTION[energy], wc.Spring(stiffness=100.0)])
    return declared, newton_step(declared, device)


@pytest.mark.host
@table("energy, name", [("OrthotropicMembrane", "projective dynamics"), ("OrthotropicMembrane", "xpbd")], MET)
def test_energies_without_a_projection_meet_too(energy, name, device):
    declared, newton = without_projection(energy, device)
    x, _ = after_steps(declared, BY_NEWTON[name], device)
    assert np.abs(x - newton).max() < 1e-8
    few, _ = after_steps(declared, replace(BY_NEWTON[name], iterations=20), device)
    assert np.abs(few - newton).max() > 1e-5, "twenty iterations are not enough to say anything"


@pytest.mark.host
def test_scalar_xpbd_stops_short(device):
    """It neglects how ∇C turns within the step: a gap that more sweeps leave and smaller steps close, at order 2 or more."""
    gaps = []
    for substeps in (1, 2, 4, 8):
        newton = wc.Newton(substeps=substeps, tolerance=1e-12, linear="factorised")
        scalar = wc.XPBD(substeps=substeps, iterations=10_000, form="scalar")
        ends = [after_steps(swinging(8), solver, device) for solver in (newton, scalar)]
        gaps.append(np.abs(ends[1][0] - ends[0][0]).max())
        assert substeps > 1 or ends[1][1].residual[0] > 0.1
    assert gaps == pytest.approx([3.7e-4, 4.9e-5, 3.7e-6, 3.2e-7], rel=0.1)
    assert (np.log2(np.array(gaps[:-1]) / gaps[1:]) > 2.0).all()


def test_every_solver_is_named():
    named = {type(solver) for solver in (ON_16 | ON_8).values()} | set(DO_NOT)
    assert named == set(SOLVERS.values())
    assert {solver.acceleration for solver in (ON_16 | ON_8).values() if type(solver) is type(PD)} == set(ACCELERATIONS)
