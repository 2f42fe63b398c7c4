"""Rigid clusters: the energy of their shape, what a projection keeps, bodies that hang together, the mobile."""

import re
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from pxr import Usd, UsdGeom

import warpcloth as wc
from support.continuum import turn
from support.energies import energy_and_gradient
from support.rows import table
from support.setups import allocated
from support.steps import after_frames, after_steps
from support.usd_validation import validate
from warpcloth.core.status import Result
from warpcloth.numerics.constraints import Constraints
from warpcloth.scene.lines import lines_of
from warpcloth.scenes import bar_twist, chain, hanging, mobile
from warpcloth.solvers.explicit import step_limits
from warpcloth.usd import FrameSequence

EPS = np.finfo(np.float64).eps
SWEEPS = ("coloured", "sequential", "constraint-averaged", "jacobi")
# Rest places of bodies of every kind.
BODIES = {
    "solid": [[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1.0, 1.0]],
    "flat": [[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [1.5, 1.0, 0]],
    "bar": [[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]],
    "pair": [[0.0, 0, 0], [1.0, 0, 0]],
}
each_body = pytest.mark.parametrize("name", BODIES)
Z = (0.0, 0.0, 1.0)


def vertices(points):
    """A mesh of vertices with an edge from each to the next, which carries nothing."""
    points = np.asarray(points, dtype=np.float64)
    return wc.Mesh(points, edges=np.stack([np.arange(len(points) - 1), np.arange(1, len(points))], axis=1))


def body(points, masses=None, **scene):
    """One body in space, without weight unless it is given."""
    masses = 1.0 + 0.5 * np.arange(len(points)) if masses is None else masses
    terms = [wc.RigidCluster(vertices=np.arange(len(points)), stiffness=scene.pop("stiffness", np.inf))]
    return wc.Scene(vertices(points), masses=masses, terms=terms, **{"gravity": (0.0, 0.0, 0.0), **scene})


def best_fit(rest, x, masses):
    """Targets c + R q by NumPy's singular values; of a body on a line the rotation of its axis is all that matters."""
    total, q = masses.sum(), rest - (masses[:, None] * rest).sum(axis=0) / masses.sum()
    c = (masses[:, None] * x).sum(axis=0) / total
    U, _S, Vt = np.linalg.svd((masses[:, None] * (x - c)).T @ q)
    return c + q @ (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T


@pytest.mark.parametrize("scale", [1.0, 0.1, 0.01, 0.001])
@each_body
def test_gradient_is_that_of_the_energy(name, scale, device):
    """Central differences, though the fit moves with the vertices; both against NumPy's fit."""
    rest = scale * np.array(BODIES[name])
    scene = body(rest, stiffness=70.0)
    model, rng = scene.build(device=device, dtype="float64"), np.random.default_rng(0)
    x, direction, delta = rest + 0.2 * scale * rng.normal(size=rest.shape), rng.normal(size=rest.shape), 1e-6 * scale
    (energy,), gradient = energy_and_gradient(model, x)
    gap = x - best_fit(rest, x, scene.vertex_masses)
    assert energy == pytest.approx(35.0 * (scene.vertex_masses[:, None] * gap**2).sum(), rel=1e-12)
    assert np.abs(gradient - 70.0 * scene.vertex_masses[:, None] * gap).max() < 1e-12 * np.abs(gradient).max()
    ahead, behind = (energy_and_gradient(model, x + way * delta * direction)[0].item() for way in (1.0, -1.0))
    slope = (ahead - behind) / 2
    assert np.abs(gradient).max() > 0.02 * scale
    assert slope / delta == pytest.approx((gradient * direction).sum(), rel=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@each_body
def test_rigid_motion_costs_nothing(name, dtype, device):
    """Turned by any angle and far away: t is rounding of the body's size, not of its place."""
    rest, eps = np.array(BODIES[name]), np.finfo(dtype).eps
    model = body(rest, stiffness=1.0).build(device=device, dtype=dtype)
    for angle in (0.1, 2.0, np.pi):
        _, gradient = energy_and_gradient(model, rest @ turn(Z, angle).T + [0.0, 0.0, 8.0])
        assert np.abs(gradient).max() < 16 * eps * 8.0 * 3.0


@pytest.mark.parametrize(
    ("solver", "stiffness"),
    [
        (wc.PBD(substeps=20), np.inf),
        (wc.XPBD(substeps=20), np.inf),
        (wc.ConstrainedDynamics(substeps=20), np.inf),
        (wc.Newton(substeps=20, integrator="midpoint", tolerance=1e-8), 1e6),
        (wc.XPBD(substeps=20, iterations=10, integrator="midpoint"), 1e6),
    ],
)
def test_a_card_that_spins(solver, stiffness, device):
    """Euler steps turn by θ(1 − θ²) after θ, so that ω = ω₀/√(1 + 2ω₀²ht); midpoint keeps momentum and energy."""
    mesh, rate = wc.Mesh.grid(5, 3, size=(0.4, 0.2)), 8.5
    x = mesh.points - mesh.points.mean(axis=0)
    spin = {"velocities": rate * np.cross([0.0, 1.0, 0.0], x), "gravity": (0.0, 0.0, 0.0), "duration": 1.0, "fps": 60}
    card = [wc.RigidCluster(vertices="all", stiffness=stiffness)]
    scene = wc.Scene(wc.Mesh(x, mesh.triangles), density=0.3, terms=card, **spin)
    found, mass = wc.simulate(scene, solver, dtype="float64", device=device), scene.vertex_masses[:, None]
    momentum = [np.linalg.norm((mass * np.cross(found.points[k], found.velocities[k])).sum(axis=0)) for k in (0, -1)]
    energy = [(mass * found.velocities[k] ** 2).sum() for k in (0, -1)]
    kept = 1.0 / np.sqrt(1.0 + 2.0 * rate**2 / 1200.0) if np.isinf(stiffness) else 1.0
    assert momentum[1] / momentum[0] == pytest.approx(kept, abs=1e-10 if kept == 1.0 else 5e-3)
    assert energy[1] / energy[0] == pytest.approx(kept**2, abs=1e-4 if kept == 1.0 else 5e-3)


@pytest.mark.parametrize("sweep", SWEEPS)
@each_body
def test_one_sweep_makes_a_body_rigid(name, sweep, device):
    """A hard body has its shape to rounding, its centre where it was, and Σ mᵢ xᵢ × Δxᵢ = 0 about it."""
    rest = np.array(BODIES[name])
    x = rest + 0.2 * np.random.default_rng(1).normal(size=rest.shape)
    scene = body(rest, positions=x)
    after, _ = after_steps(scene, wc.PBD(substeps=1, iterations=1, sweep=sweep), device)
    mass = scene.vertex_masses[:, None]
    assert np.abs(after - best_fit(rest, x, scene.vertex_masses)).max() < 32 * EPS
    assert np.abs((mass * (after - x)).sum(axis=0)).max() < 64 * EPS
    assert np.abs(np.cross(x, mass * (after - x)).sum(axis=0)).max() < 64 * EPS


@each_body
def test_rows_are_what_no_rigid_motion_takes_up(name, device):
    """J = (I − Q)√M at a turned rest shape: central differences of √m(x − c − R q), its transpose, its matrix and its rank."""
    rest = np.array(BODIES[name])
    x = rest @ turn(Z, 2.0).T + [0.0, 0.0, 8.0]
    model = body(rest, positions=x, stiffness=50.0).build(device=device, dtype="float64")
    constraints, still = Constraints(model, 1 / 60, False), model.vectors()

    def gap(places):
        constraints.launch_linearise(model.array(places, model.vec3), still)
        return constraints.gap.numpy().copy()

    rng = np.random.default_rng(0)
    v, rows, delta = rng.normal(size=rest.shape), rng.normal(size=constraints.count), 1e-6
    slope = (gap(x + delta * v) - gap(x - delta * v)) / (2.0 * delta)
    assert np.abs(gap(x)).max() < 64 * EPS * 8.0
    applied, pulled = wp.zeros(constraints.count, dtype=wp.float64, device=device), model.vectors()
    constraints.launch_apply(model.array(v, model.vec3), applied)
    assert np.abs(applied.numpy() - slope).max() < 1e-8  # ε/δ of places 10 m away
    constraints.parts[0].launch_transpose(wp.array(rows, dtype=wp.float64, device=device), pulled)
    assert (applied.numpy() * rows).sum() == pytest.approx((v * pulled.numpy()).sum(), rel=1e-12)
    values, row, column = constraints.parts[0].entries()
    J = np.zeros((constraints.count, rest.size))
    np.add.at(J, (row, column), values)
    assert np.abs(J @ v.ravel() - applied.numpy()).max() < 64 * EPS
    assert np.linalg.matrix_rank(J, tol=1e-9) == rest.size - (6 if name in ("solid", "flat") else 5)


@pytest.mark.parametrize(
    "solver",
    [wc.PBD(substeps=1), wc.XPBD(substeps=1, iterations=5), wc.ConstrainedDynamics(substeps=1, tolerance=1e-9)],
    ids=["pbd", "xpbd", "constrained-dynamics"],
)
def test_two_bars_hinge_at_a_shared_vertex(solver, device):
    """Free in space and folding: both keep their lengths, the angle changes, linear momentum stays to rounding."""
    rest = np.array([[-1.0, 0, 0], [-0.5, 0, 0], [0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    velocities, terms = np.outer(np.abs(rest[:, 0]), [0.0, 1.0, 0.0]), [wc.RigidCluster(vertices=[[0, 1, 2], [2, 3, 4]])]
    scene = replace(body(rest, np.ones(5), velocities=velocities, fps=240.0), terms=terms)
    x, stepper = after_steps(scene, replace(solver, iterations=60), device, steps=240)
    assert np.abs(np.linalg.norm(x[[0, 1, 3, 4]] - x[2], axis=1) - [1.0, 0.5, 0.5, 1.0]).max() < 1e-9
    # A move is rounded to ε|x|, and over h it is a velocity.
    assert np.abs((stepper.state.v.numpy() - velocities).sum(axis=0)).max() < 240 * 60 * EPS * 240
    a, b = x[0] - x[2], x[4] - x[2]
    assert np.dot(a, b) > -0.5, "it has folded"


@pytest.mark.parametrize("solver", [wc.XPBD(substeps=1, iterations=4), wc.ConstrainedDynamics(substeps=1, tolerance=1e-9)])
def test_a_compound_pendulum_has_its_period(solver, device):
    """ω = √(m g d/I), I = Σ m r²: the angle after 0.5 s tends to 0.05 cos ωt (a part of 0.05²/16 slower), at order 1."""
    omega = np.sqrt(9.81 * (1.0 * 0.5 + 2.0 * 1.0) / (1.0 * 0.25 + 2.0 * 1.0)) * (1.0 - 0.05**2 / 16)
    rest, errors = np.array([[0.0, 0, 0], [0, -0.5, 0], [0, -1.0, 0]]), []
    fields = {"positions": rest @ turn(Z, 0.05).T, "pins": [0], "gravity": (0.0, -9.81, 0.0), "fps": 20.0}
    for substeps in (10, 20, 40):
        scene = body(rest, masses=[0.0, 1.0, 2.0], **fields)
        x = after_steps(scene, replace(solver, substeps=substeps), device, steps=10 * substeps)[0][2]
        errors.append(abs(np.arctan2(x[0], -x[1]) - 0.05 * np.cos(omega * 0.5)))
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(1.0, abs=0.15)


KAPPA = 2000.0
HUNG = body([[0.0, 0, 0], [0, -1.0, 0]], masses=[0.0, 3.0], stiffness=KAPPA, pins=[0], gravity=(0, -9.81, 0))


@pytest.mark.parametrize(("substeps", "iterations"), [(1, 1), (4, 1), (1, 10)])
def test_a_soft_body_hangs_as_deep_as_its_stiffness_says(substeps, iterations, device):
    """XPBD, whatever step and iterations: a vertex below a pinned one of weight 1000 comes to rest 1.001 g/κ lower."""
    x, stepper = after_steps(HUNG, wc.XPBD(substeps=substeps, iterations=iterations), device, steps=600 * substeps)
    left = 1.01e-3 * 9.81 * stepper.h**2 if iterations == 1 else 1e-9  # an iteration leaves a thousandth of what it moves, gh²
    assert -1.0 - x[1, 1] == pytest.approx(1.001 * 9.81 / KAPPA, abs=left)


def test_a_soft_body_comes_to_rest_where_it_hangs(device):
    """The rest shape: a vertex below a pinned one of weight 1000 hangs 1.001 g/κ lower."""
    found = wc.equilibrium(HUNG, device=device)
    assert found.status.result is Result.CONVERGED
    assert -1.0 - found.points[1, 1] == pytest.approx(1.001 * 9.81 / KAPPA, rel=1e-7)


def test_a_soft_body_swings_with_its_frequency(device):
    """Two masses: each is κmᵢtᵢ away from its place, so that their distance obeys ë = −κe; and the explicit limit is 2/√κ."""
    kappa, h = 100.0, 1e-3
    scene = body([[0.0, 0, 0], [1.0, 0, 0]], masses=[1.0, 2.0], positions=[[0, 0, 0], [1.1, 0, 0]], stiffness=kappa, fps=1 / h)
    x, stepper = after_steps(scene, wc.Explicit(substeps=1), device, steps=1000)
    assert step_limits(stepper.model)[0] == pytest.approx(2.0 / np.sqrt(kappa), rel=1e-9)
    assert np.linalg.norm(x[1] - x[0]) - 1.0 == pytest.approx(0.1 * np.cos(np.sqrt(kappa)), abs=0.1 * np.sqrt(kappa) * h)


CONSTRAINED = wc.ConstrainedDynamics(substeps=1, tolerance=1e-11, iterations=100)
SOFT = {
    "newton": wc.Newton(substeps=1, tolerance=1e-11, iterations=10_000),
    "projective dynamics": (PD := wc.ProjectiveDynamics(substeps=1, tolerance=1e-11, iterations=10_000)),
    "projective dynamics matrix-free": replace(PD, acceleration="none", linear="jacobi"),
    **{
        f"constrained dynamics {safe} {linear}": replace(CONSTRAINED, stabilisation=safe, linear=linear)
        for safe in ("geometric-stiffness", "line-search")
        for linear in ("cg", "factorised")
    },
    "xpbd": wc.XPBD(substeps=1, iterations=3000),
    "xpbd sequential": wc.XPBD(substeps=1, iterations=3000, sweep="sequential"),
    "xpbd jacobi": wc.XPBD(substeps=1, iterations=10_000, sweep="constraint-averaged"),
}


def jelly(**scene):
    """Two soft bodies that share a vertex and a cloth's worth of springs, thrown."""
    mesh, velocities = wc.Mesh.grid(4, 4, pattern="alternating"), np.random.default_rng(3).normal(size=(16, 3))
    clusters = wc.RigidCluster(vertices=[[0, 1, 4, 5, 6], [6, 7, 10, 11, 15]], stiffness=[2e3, 5e3])
    terms = [clusters, wc.Spring(stiffness=50.0)]
    return wc.Scene(mesh, density=1.0, terms=terms, velocities=velocities, pins=[0], **scene)


@table("integrator", ["bdf2"], ["euler", "midpoint", "bdf2"])
def test_soft_bodies_meet_at_one_minimiser(integrator, device):
    """After three steps all who minimise are where Newton is, to 1e-8 m; vector XPBD as its fixed point is implicit Euler."""
    newton, _ = after_steps(jelly(), replace(SOFT["newton"], integrator=integrator), device, steps=3)
    for name, solver in SOFT.items():
        x, stepper = after_steps(jelly(), replace(solver, integrator=integrator), device, steps=3)
        assert "xpbd" in name or stepper.results == [Result.CONVERGED], name
        assert np.abs(x - newton).max() < 1e-8, name


@pytest.mark.parametrize("iterations", [1, 5, 40])
def test_pbd_per_step_moves_a_soft_body_alike(iterations, device):
    """The part 1/(1 + α̃) of the way to its shape, α̃ = 1/(κh²), whatever the iterations, and its centre not at all."""
    rest, kappa = np.array(BODIES["solid"]), 3000.0
    x = rest + 0.2 * np.random.default_rng(1).normal(size=rest.shape)
    scene, solver = body(rest, positions=x, stiffness=kappa), wc.PBD(substeps=1, iterations=iterations, correction="per-step")
    after, stepper = after_steps(scene, solver, device)
    part = 1.0 / (1.0 + 1.0 / (kappa * stepper.h**2))
    expected = x + part * (best_fit(rest, x, scene.vertex_masses) - x)
    assert np.abs(after - expected).max() < 4 * iterations * 16 * EPS


@pytest.mark.parametrize(
    "solver", [wc.PBD, wc.XPBD, wc.ConstrainedDynamics, wc.ProjectiveDynamics, wc.Newton, wc.Explicit, wc.HierarchicalPBD]
)
def test_copies_with_their_own_bodies(solver, device):
    """Three copies with other stiffness, gravity and masses are three runs, and the same run gives the same bits."""
    base, stiffness = jelly(fps=240.0), np.array([[2e3, 5e3], [1e2, 1e3], [7e3, 7e3]])
    masses = base.vertex_masses * np.array([[1.0], [2.0], [0.5]])
    setup = {"device": device, "dtype": "float64", "frames": 6}
    vary = {"RigidCluster.stiffness": stiffness, "masses": masses}
    batch = wc.simulate(base, solver(substeps=2), copies=3, vary=vary, **setup).points
    assert np.array_equal(batch, wc.simulate(base, solver(substeps=2), copies=3, vary=vary, **setup).points)
    for copy in range(3):
        terms = [replace(base.terms[0], stiffness=stiffness[copy]), base.terms[1]]
        alone = replace(base, terms=terms, masses=masses[copy], density=None)
        assert np.abs(batch[:, copy] - wc.simulate(alone, solver(substeps=2), **setup).points).max() < 1e-9


@pytest.mark.parametrize("solver", [wc.PBD, wc.XPBD, wc.ConstrainedDynamics, wc.ProjectiveDynamics, wc.Explicit])
def test_a_step_allocates_nothing(solver, device):
    stepper = after_frames(jelly(fps=240.0), solver(substeps=1), steps=1, device=device)
    assert allocated(lambda: [stepper.step() for _ in range(10)], device) == 0


def test_bodies_by_selections_are_those_by_indices(device):
    texts, found = ["x == 0", "corners", "index(5, 6, 9)"], []
    for bodies in ([jelly().mesh.select(text) for text in texts], texts, tuple(texts), np.array(texts)):
        cluster = wc.RigidCluster(vertices=bodies, stiffness=[1.0, 2.0, 3.0])
        (made,) = replace(jelly(), terms=[cluster]).build(device=device).terms
        found.append([each.numpy().tolist() for each in (made.stencil, made.cells.offsets, made.stiffness)])
    assert found[1] == found[2] == found[3] == found[0]


def test_two_cells_of_a_colour_share_no_vertex(device):
    def sweep_of(scene, copies=2):
        return wc.PBD(substeps=1).bind(scene.build(device=device, copies=copies)).sweep

    assert len(sweep_of(jelly(), 1).ranges[0]) == 2
    sharing = replace(jelly(), terms=[wc.RigidCluster(vertices=[[0, 1], [2, 3], [4, 5, 6], [0, 8]])])
    assert sweep_of(sharing).ranges == ([(0, 8)],), "they share the pin alone"
    sweep = sweep_of(replace(sharing, pins=None))
    (elements,), (ranges,) = sweep.elements, sweep.ranges
    offsets, found = elements.cells.offsets.numpy(), elements.stencil.numpy()[:, 0]
    assert sorted(map(len, np.split(found, offsets[1:-1]))) == [2] * 6 + [3] * 2
    for first, count in ranges:
        used = found[offsets[first] : offsets[first + count]]
        assert len(np.unique(used)) == len(used)


@pytest.mark.parametrize("linear", ["cg", "factorised"])
def test_a_body_without_stiffness_is_not_there(linear, device):
    """One iteration with it is the iteration without, where springs alone pull."""
    declared, rng = body(BODIES["solid"], stiffness=0.0), np.random.default_rng(0)
    spring = wc.Spring(pairs=[[0, 1], [0, 4]], stiffness=1e3, rest_lengths=0.7)
    velocities = rng.normal(size=declared.mesh.points.shape)
    solver = wc.ConstrainedDynamics(substeps=1, iterations=1, tolerance=1e-12, linear=linear)
    scenes = [replace(declared, terms=terms, velocities=velocities) for terms in ([spring], [spring, *declared.terms])]
    without, found = (after_steps(scene, solver, device)[0] for scene in scenes)
    assert np.abs(found - without).max() < (1e-9 if linear == "cg" else 8 * EPS)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_degenerate_bodies(dtype, device):
    """One vertex, coincident ones, all pinned, one in another: nothing that is not finite, and the rest moves on."""
    points = np.array([[0.0, 0, 0], [0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [2.0, 1.0, 0], [5.0, 0, 0], [6.0, 0, 0]])
    terms = [wc.RigidCluster(vertices=[[0], [0, 1], [2, 3, 4], [3, 4], [2, 3, 4, 1], [5, 6]])]
    fields = {"pins": [5, 6], "velocities": np.random.default_rng(0).normal(size=(7, 3))}
    scene = wc.Scene(wc.Mesh(points, edges=[[2, 3]]), masses=np.ones(7), terms=terms, **fields)
    for solver in (wc.PBD(substeps=2), wc.XPBD(substeps=2), wc.PBD(substeps=2, sweep="vertex-averaged")):
        x, _ = after_steps(scene, solver, device, dtype, steps=120)
        assert np.isfinite(x).all() and (x[5:] == points[5:].astype(dtype)).all()
        assert np.abs(x[:5].mean(axis=0)[1] - points[:5].mean(axis=0)[1]) > 1.0


def test_a_level_mobile_stays_level(device):
    """Its bars hang where their loads balance; strings and bars keep their lengths, a battened cloth its edge."""
    for push in (0.0, 0.4):
        scene = mobile.scene(n=5, push=push)
        points = wc.simulate(scene, wc.XPBD(substeps=20, iterations=20), device=device, dtype="float64", frames=60).points[-1]
        rest = scene.mesh.points
        pairs = np.array([[0, 1], [3, 4], [1, 2], [1, 3], [2, 3], [4, 5], [5, 6], [7, 11], [7, 9]])
        lengths = [np.linalg.norm(np.diff(place[pairs], axis=1)[:, 0], axis=1) for place in (points, rest)]
        assert np.abs(lengths[0] - lengths[1]).max() < 1e-5
        if push:
            assert np.abs(points[2, 2]) > 0.1, "it turns"
        else:
            assert np.abs(points[[2, 5], 1] - points[[3, 6], 1]).max() < 1e-3
            assert np.abs(points[1:7] - rest[1:7]).max() < 1e-2


@pytest.mark.parametrize(("ending", "single_file"), [("usda", False), ("usdc", True), ("usdz", False)])
def test_the_file_of_a_mobile_has_its_bars_and_strings(tmp_path, ending, single_file):
    path, scene = str(tmp_path / f"mobile.{ending}"), mobile.scene(n=3)
    animation = wc.simulate(scene, wc.XPBD(substeps=20), output=path, frames=12, single_file=single_file)
    stage, eps = Usd.Stage.Open(path), np.finfo(np.float32).eps
    strings = sorted(map(list, scene.terms[1].pairs))
    # Along each curve the vertices of a bar, from end to end, or the two of a string.
    for name, lines in (("bars", [[2, 1, 3], [5, 4, 6]]), ("strings", strings)):
        curves = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"/World/{name}"))
        assert list(curves.GetCurveVertexCountsAttr().Get()) == [len(line) for line in lines]
        assert 0.0 < curves.GetWidthsAttr().Get()[0] < 0.03
        assert curves.GetPointsAttr().GetTimeSamples() == list(range(13))
        for code in (0, 12):
            vertices, shown = np.concatenate(lines), np.array(curves.GetPointsAttr().Get(code))
            np.testing.assert_allclose(shown, animation.points[code][vertices], atol=eps)
            np.testing.assert_allclose(curves.GetVelocitiesAttr().Get(code), animation.velocities[code][vertices], atol=eps)
        assert np.abs(shown - np.array(curves.GetPointsAttr().Get(0))).max() > 0.05, "they move"
        low, high = np.array(curves.GetExtentAttr().Get(12))
        assert (low < shown.min(axis=0)).all() and (high > shown.max(axis=0)).all()
    # What measures the file finds the cloth, not its strings.
    assert FrameSequence(path).shape == (13, len(scene.mesh.points), 3) and validate(path) == []


def test_what_triangles_show_has_no_lines():
    for scene in (hanging.scene(n=4), chain.scene(), bar_twist.scene(cells=1)):
        assert lines_of(scene) == {}


@pytest.mark.host
def test_a_mobile_moves_alike_with_two_methods(device):
    """XPBD and constrained dynamics end 4e-5 m apart after a second, as far as XPBD with half the step does from itself."""
    scene, solvers = mobile.scene(n=5), (wc.XPBD(substeps=20, iterations=20), wc.ConstrainedDynamics(substeps=20))
    ends = [wc.simulate(scene, solver, device=device, dtype="float64", frames=60).points[-1] for solver in solvers]
    assert np.abs(ends[0][:7] - scene.mesh.points[:7]).max() > 0.1
    assert np.abs(ends[1][:7] - ends[0][:7]).max() < 1e-4


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"vertices": []}, "RigidCluster has no elements"),
        ({"vertices": [[0, 1], []]}, r"RigidCluster.sizes is \[2, 0\]; it must be 1 or more each and 2 in all"),
        ({"vertices": [[0, 1], [1, 99]]}, "RigidCluster.vertices, body 1.* is 99; it must lie in 0 … 15"),
        ({"vertices": [[0, 1], [2, 2]]}, "RigidCluster.vertices, body 1 names vertex 2 twice"),
        ({"vertices": [[0, 1], [2.5]]}, r"RigidCluster.vertices\[1\] is \[2.5\]; it must be a list of whole numbers"),
        ({"vertices": [[0, 1], "all"]}, "RigidCluster.vertices has both selections and indices"),
        ({"vertices": ["all", 3]}, "RigidCluster.vertices has both selections and indices"),
        ({"vertices": 3}, "RigidCluster.vertices is 3; it must be a list of bodies or a selection"),
        ({"vertices": [[2**32 + 1, 2, 3]]}, r"RigidCluster.vertices\[0\]\[0\] is 4294967297; it must be below 2\^31"),
        ({"vertices": [0, 1], "sizes": [2**32 + 2]}, r"RigidCluster.sizes\[0\] is 4294967298; it must be below 2\^31"),
        ({"vertices": [0, 1, 2], "sizes": [2, 2]}, r"RigidCluster.sizes is \[2, 2\]; it must be 1 or more each and 3 in all"),
        ({"vertices": [[0, 1]], "sizes": [2]}, "RigidCluster has sizes and a list for each body"),
        ({"vertices": "all", "sizes": [16]}, "RigidCluster has sizes and selections"),
        ({"vertices": "x > 9"}, "RigidCluster.vertices: 'x > 9' selects nothing"),
        ({"vertices": ["all", "x > 9"]}, "RigidCluster.vertices: 'x > 9' selects nothing"),
        ({"vertices": ["all", "z == 0"], "stiffness": [1.0, 2.0, 3.0]}, "RigidCluster.stiffness has shape"),
        ({"vertices": [[0, 1], [2, 3]], "stiffness": [1.0, 2.0, 3.0]}, "RigidCluster.stiffness has shape"),
        ({"vertices": [[0, 1]], "stiffness": -1.0}, "RigidCluster.stiffness is -1.0"),
    ],
)
def test_bad_bodies_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        wc.Scene(wc.Mesh.grid(4, 4), density=1.0, terms=[wc.RigidCluster(**fields)]).build()


@pytest.mark.parametrize(("solver", "stiffness"), [(wc.ADMM, 1.0), (wc.Newton, np.inf), (wc.ProjectiveDynamics, np.inf)])
def test_who_cannot_take_bodies_says_who_can(solver, stiffness, device):
    """All that are named can."""
    model = body(BODIES["solid"], stiffness=stiffness).build(device=device, dtype="float64")
    with pytest.raises(ValueError, match=f"{solver.__name__} cannot take RigidCluster.*; .*PBD, ") as refused:
        solver(substeps=1).bind(model)
    others = set(re.findall(r"\w+", str(refused.value).partition("; ")[2])) & set(wc.__all__)
    assert {"PBD", "HierarchicalPBD", "XPBD"} <= others
    for name in others:
        getattr(wc, name)(substeps=1).bind(model)
