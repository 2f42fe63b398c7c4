"""Solvers against closed forms: oscillators, free fall, momentum, limits of stability, convergence."""

import gc
import re
import weakref
from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.meshes import PAIR
from support.nets import net
from support.rows import table
from support.setups import MAIN, RUNS, SOLVERS, allocated, square
from support.steps import after_frames, after_steps, hanging_mass, spring
from warpcloth.base.texts import words_of
from warpcloth.core.capture import Segment, on_host
from warpcloth.core.hessian import Hessian
from warpcloth.core.status import Result
from warpcloth.core.sums import RowSums, Sums
from warpcloth.numerics.constraints import Constraints
from warpcloth.solvers import explicit
from warpcloth.solvers.explicit import limit_in_motion, step_limits
from warpcloth.solvers.step import fewest_substeps

EPS = np.finfo(np.float64).eps


def oscillator(omega, h):
    """A unit mass at x = 1 on a linear spring to the origin; the other vertex is pinned and takes no part."""
    hold = [wc.Attachment(vertices=[1], targets=[[0.0, 0.0, 0.0]], stiffness=omega**2)]
    return replace(spring(), terms=hold, positions=PAIR.points, fps=1.0 / h, duration=200 * h)


UNLIKE = {
    "stiffness and gravity": {"Spring.stiffness": [50.0, 100.0, 200.0], "gravity": [[0, -9.81, 0], [0, -1.6, 0], [3.0, 0, 0]]},
    "density, bending and damping": {
        "density": [0.05, 0.1, 0.2],
        "QuadraticBending.stiffness": [0.0, 1e-4, 1e-3],
        "Spring.damping": [0.0, 0.01, 0.05],
    },
    "masses and start": {
        "masses": np.random.default_rng(5).uniform(0.002, 0.004, (3, 36)),
        "positions": square().mesh.points + np.random.default_rng(6).normal(scale=0.01, size=(3, 36, 3)),
        "velocities": np.random.default_rng(7).normal(scale=0.1, size=(3, 36, 3)),
    },
}


def one_of(scene, vary, copy):
    """The scene that is one of the copies."""
    for name, values in vary.items():
        label, _, field = name.rpartition(".")
        if label:
            terms = [replace(each, **{field: values[copy]}) if each.label == label else each for each in scene.terms]
            scene = replace(scene, terms=terms)
        else:
            scene = replace(scene, **{name: values[copy]}, **({"density": None} if name == "masses" else {}))
    return scene


@pytest.mark.parametrize("omega_h", [0.1, 1.0, 1.9])
@pytest.mark.parametrize("method", ["symplectic", "forward", "implicit"])
def test_oscillator_keeps_its_invariant(method, omega_h, device):
    """v² + ω²x² − hω²xv is kept; forward multiplies the energy by 1 + ω²h² a step, implicit by 1/(1 + ω²h²)."""
    h, omega, energies, solver = 0.1, omega_h / 0.1, [], wc.Newton(substeps=1, tolerance=1e-14)
    if method != "implicit":
        solver = wc.Explicit(substeps=1, scheme=method, above_limit="allow")
    stepper = solver.bind(oscillator(omega, h).build(device=device, dtype="float64"))
    for _ in range(40):
        x, v = stepper.state.x.numpy()[1, 0], stepper.state.v.numpy()[1, 0]
        mixed = -h * omega**2 * x * v if method == "symplectic" else 0.0
        energies.append(v * v + omega**2 * x * x + mixed)
        stepper.step()
    factor = {"symplectic": 1.0, "forward": 1 + omega_h**2, "implicit": 1 / (1 + omega_h**2)}[method]
    expected = energies[0] * factor ** np.arange(40)
    # A few roundings a step of terms as large as v² + ω²x².
    assert np.allclose(energies, expected, rtol=40 * 20 * EPS, atol=40 * 20 * EPS * omega**2)


@table("name, dtype", [(name, "float32") for name in MAIN], RUNS)
def test_free_fall(name, dtype, device):
    """y_n = −g h² n(n+1)/2 for every method of first order, −½g(nh)² for those of second, and no strain."""
    scene, steps = square(solver=SOLVERS[name], fps=600.0), 150
    stepper = after_frames(scene, SOLVERS[name], steps=steps, device=device, dtype=dtype)
    drop = stepper.state.x.numpy() - scene.mesh.points
    second = getattr(SOLVERS[name], "integrator", "euler") != "euler"
    exact = -9.81 * stepper.h**2 * steps * (steps + (0 if second else 1)) / 2
    # Every step rounds x to ε·|x|, |x| up to the larger of size and drop, and v to ε·|v|, which h carries into x each step.
    assert np.abs(drop - [0.0, exact, 0.0]).max() < 2 * steps * np.finfo(dtype).eps * (1.0 + abs(exact))


# Averaging by vertex keeps neither; Jacobi steps of one matrix keep momentum in the end, not on the way.
@table("name", ("explicit", "newton", "xpbd"), [name for name in SOLVERS if "vertex" not in name and "matrix-free" not in name])
def test_momentum_is_conserved(name, device):
    """Inner forces cancel: P is kept; symplectic Euler and midpoint keep L too, the others lose it in x_new − x_old."""
    angular = name in ("explicit", "newton midpoint")
    rng = np.random.default_rng(1)
    scene = square(solver=SOLVERS[name], gravity=(0.0, 0.0, 0.0), fps=600.0, duration=1.0, velocities=rng.normal(size=(36, 3)))
    stepper = after_frames(scene, SOLVERS[name], steps=25, device=device, dtype="float64")
    mass = scene.vertex_masses[:, None]
    ends = ((scene.mesh.points, scene.velocities), [array.numpy() for array in stepper.state])
    P, L = (np.array([f(x, mass * v).sum(axis=0) for x, v in ends]) for f in (lambda x, p: p, np.cross))
    bound = 25 * 100 * EPS * np.sum(mass * np.abs(scene.velocities))
    assert np.abs(P[1] - P[0]).max() < bound and (np.abs(L[1] - L[0]).max() < bound) == angular


# Steps that end far from their minimum, by default tolerances, with few iterations or because rounding allows no more.
LOOSE = {
    "newton": wc.Newton(substeps=4),
    "newton midpoint": wc.Newton(substeps=4, integrator="midpoint"),
    "newton bdf2": wc.Newton(substeps=4, integrator="bdf2"),
    "newton factorised": wc.Newton(substeps=4, linear="factorised"),
    "newton in an iteration": wc.Newton(substeps=4, iterations=1, integrator="midpoint"),
    "newton to rounding": wc.Newton(substeps=4, tolerance=1e-30, integrator="midpoint"),
    "projective dynamics": wc.ProjectiveDynamics(substeps=4, iterations=3),
    "admm": wc.ADMM(substeps=4, iterations=3),
    "xpbd": wc.XPBD(substeps=4, iterations=2),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=4),
}
# What acts on a sheet that nothing holds along the axes that are named. At 240 vertices Newton's solves may take multigrid.
FLIGHTS = {
    "free": ({}, "xyz"),
    "before a wall": ({"colliders": [wc.Plane(normal=(1.0, 0.0, 0.0), position=(-50.0, 0.0, 0.0))]}, "xyz"),
    "on rails": ({"pins": wc.Pins("corners", axes="z")}, "xy"),
    "with itself": ({"self_contact": wc.SelfContact(distance=1e-3, stiffness=1e6)}, "xyz"),
}


@table(
    "name, flight, dtype",
    [("newton", "free", "float32"), *(("newton midpoint", flight, "float64") for flight in FLIGHTS)],
    [(name, "free", dtype) for name in LOOSE for dtype in ("float32", "float64")]
    + [("newton midpoint", flight, "float64") for flight in FLIGHTS if flight != "free"],
)
def test_free_flight_keeps_momentum_wherever_steps_end(name, flight, dtype, device):
    """Gravity and a force add g + F/M of speed each second, and crumpled cloth nothing."""
    # Of copies of unlike stiffness, which end after unlike iterations. In a step rounding changes each velocity by ε of it.
    (fields, axes), steps, rng = FLIGHTS[flight], 20, np.random.default_rng(1)
    mesh = wc.Mesh.grid(16, 15)
    velocities, push = rng.normal(size=(240, 3)) + np.array([2.0, 0.0, 0.0]), np.array([0.03, 0.0, -0.01])
    terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-4)]
    given = {"loads": [wc.Force(vertices=[7], force=push)], "velocities": velocities, "gravity": (0.0, -0.1, 0.0), **fields}
    scene = wc.Scene(mesh, density=0.1, terms=terms, duration=1.0, **given)
    build = {"device": device, "dtype": dtype, "copies": 2, "vary": {"Spring.stiffness": [10.0, 1e3]}}
    mass, momenta = scene.vertex_masses[:, None], []
    for count in (0, steps):
        stepper = after_frames(scene, LOOSE[name], steps=count, **build)
        momenta.append((mass * stepper.state.v.numpy().astype(np.float64).reshape(2, -1, 3)).sum(axis=1))
    expected = momenta[0] + steps * stepper.h * (mass.sum() * np.array([0.0, -0.1, 0.0]) + push)
    error = np.abs(momenta[1] - expected)[:, ["xyz".index(axis) for axis in axes]].max()
    assert error < 5 * steps * np.finfo(dtype).eps * (mass * np.abs(velocities)).sum()


NO_ITERATION = wc.ProjectiveDynamics(substeps=1), wc.ADMM(substeps=1)
CONSTRAINED = [wc.ConstrainedDynamics(substeps=1, tolerance=1e-10, linear=linear) for linear in ("cg", "factorised")]
PROJECTING = wc.PBD(substeps=1), wc.PBD(substeps=1, correction="per-step"), wc.XPBD(substeps=1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("solver", [*NO_ITERATION, *CONSTRAINED, *PROJECTING], ids=repr)
def test_nothing_to_solve(solver, dtype, device):
    """No terms; no stiffness, of which the compliance is infinite; stencils of pins alone: free fall, and no NaN."""
    base, ends = replace(hanging_mass(1.0, 1.0, 0.5), pins=[]), [Result.COMPLETED if solver in PROJECTING else Result.CONVERGED]
    loose = [wc.Spring(stiffness=0.0), wc.Attachment(vertices=[1], stiffness=0.0)]
    for terms in ([], loose[:1], loose):
        x, stepper = after_steps(replace(base, terms=terms), solver, device, dtype, steps=3)
        assert np.allclose(x[:, 1], np.array([0.0, -1.5]) - 9.81 * 6 / 3600, rtol=0.0, atol=8 * np.finfo(dtype).eps)
        assert stepper.results == ends and (stepper.iterations == 0 or solver not in NO_ITERATION)
    for stiffness in (1.0, np.inf) if solver not in NO_ITERATION else (1.0,):
        pinned = replace(base, terms=[wc.Spring(stiffness=stiffness)], pins=[0, 1])
        x, stepper = after_steps(pinned, solver, device, dtype, steps=3)
        assert np.array_equal(x, pinned.positions) and stepper.results == ends


def tensioned():
    """A cloth stretched by a tenth between two pinned sides, plucked: every spring longer than at rest."""
    mesh = wc.Mesh.grid(8, 8)
    positions = 1.1 * mesh.points
    positions[:, 1] = 0.05 * np.sin(np.pi * mesh.points[:, 0]) * np.sin(np.pi * mesh.points[:, 2])
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=100.0), wc.QuadraticBending(stiffness=1e-3)]
    return wc.Scene(mesh, density=0.1, positions=positions, terms=terms, pins="x<0.01 or x>0.99")


@pytest.mark.parametrize("linear", ["cg", "factorised"])
def test_newton_converges_quadratically(linear, device):
    """Where all springs are in tension: r_{i+1} ≤ C r_i², down to 1e-12 of the residual at x̃."""
    solver = wc.Newton(substeps=2, tolerance=1e-15, linear=linear)
    stepper = solver.bind(tensioned().build(device=device, dtype="float64"))
    stepper._predict()
    residuals = []
    for iterations in range(9):
        stepper.minimiser.correction.zero_()
        stepper.minimiser.minimise(1e-15, iterations, np.ones(1))
        residuals.append(stepper.minimiser.residual[0])
    r = np.array(residuals) / residuals[0]
    assert r[-1] <= 1e-12
    # Order from three iterates in a row, log r₂/r₁ over log r₁/r₀, above rounding (2e-15). CG solves as well as r has fallen,
    # so that it keeps order 2.
    r = r[r > 1e-13]
    assert len(r) >= 4 and (np.log(r[2:] / r[1:-1]) / np.log(r[1:-1] / r[:-2]))[-1] > 1.7


REASONS = {
    "forward": "forward Euler is stable at no step",
    "symplectic": "symplectic Euler is stable below .* substeps a frame",
}


@pytest.mark.parametrize(("scheme", "message"), REASONS.items())
def test_unstable_steps_are_refused_with_the_limit(scheme, message, device):
    scene = replace(square(duration=1.0, pins="corners"), terms=[wc.Spring(pairs="structural", stiffness=1e5)])
    with pytest.raises(ValueError, match=message):
        wc.Explicit(substeps=1, scheme=scheme).bind(scene.build(device=device))


def test_steps_above_gershgorins_bound_warn(device):
    scene = net("shear", duration=1.0, fps=1.0)
    rest, motion = step_limits(scene.build(device=device))
    h = 0.5 * (rest + motion)
    scene = net("shear", duration=h, fps=1 / h)
    with pytest.warns(UserWarning, match="in motion, hinges and membranes counted as at rest"):
        wc.Explicit(substeps=1).bind(scene.build(device=device))


@table("name, dtype", [(name, "float32") for name in MAIN], RUNS)
def test_a_sheet_at_rest_stays_there(name, dtype, device):
    """Its rest shape, one pinned vertex, no gravity: it moves by no more than rounding, and does not spin about the pin."""
    pin, solver, steps = 14, SOLVERS[name], 100
    scene = square(solver=solver, gravity=(0.0, 0.0, 0.0), fps=600.0, pins=[pin])
    stepper = after_frames(scene, solver, steps=steps, device=device, dtype=dtype)
    x, v = (array.numpy().astype(np.float64) for array in stepper.state)
    arms, mass, eps = scene.mesh.points - scene.mesh.points[pin], scene.vertex_masses, np.finfo(dtype).eps
    L = np.cross(arms, mass[:, None] * v).sum(axis=0)
    inertia = np.einsum("n,nkk,ij->ij", mass, arms[:, :, None] * arms[:, None], np.eye(3))
    inertia -= np.einsum("n,ni,nj->ij", mass, arms, arms)
    # Forces are made of rounding: a step moves a position of size 1 by up to ε, to and fro or, at worst, as in a random walk.
    assert np.abs(x - scene.mesh.points).max() < 2.0 * np.sqrt(steps) * eps
    # A random walk of the velocity ends √3 times as fast as it is in the mean: of a vertex 0.5 m off that moves by that much.
    assert np.linalg.norm(np.linalg.solve(inertia, L)) * steps * stepper.h * 0.5 < np.sqrt(3.0) * 2.0 * np.sqrt(steps) * eps


@pytest.mark.parametrize("damping", [None, 3.0])
def test_the_limit_of_a_mass_on_a_spring(damping, device):
    """The h of ω²h² + 2hβ/m = 4, which without damping is 2/ω."""
    k, m = 50.0, 0.2
    hold = wc.Attachment(vertices=[1], targets=[[0.0, 0.0, 0.0]], stiffness=k, damping=damping)
    model = wc.Scene(PAIR, masses=[m, m], terms=[hold], pins=[0]).build(device=device, dtype="float64")
    square, c = k / m, (damping or 0.0) / m
    assert step_limits(model) == pytest.approx(2 * [(np.sqrt(c * c + 4.0 * square) - c) / square], rel=1e-9)


MOVES = {"gravity": (3,), "velocities": (36, 3)}
VARIED = {
    "nothing": (2, {}),
    "where they are": (2, {each: np.random.default_rng(8).normal(size=(2, *size)) for each, size in MOVES.items()}),
    "density": (3, {"density": [0.1, 0.3, 0.1]}),
    "stiffness": (3, {"Spring.stiffness": [100.0, 100.0, 400.0]}),
    "damping": (2, {"Spring.damping": [0.1, 0.0]}),
}


@table("name", ["density", "where they are", "damping"], VARIED)
def test_limits_of_copies_are_the_least_of_each(name, device, monkeypatch):
    """Found once for those that are alike, and the slow one only of those of which it may be the least; the quick one alone."""
    (copies, vary), built = VARIED[name], {"device": device, "dtype": "float64"}
    scene = square(solver=SOLVERS["explicit"], pins="corners", damping=0.05)
    alone = np.array([step_limits(one_of(scene, vary, copy).build(**built)) for copy in range(copies)])
    searches = []
    monkeypatch.setattr(explicit, "_at_rest", lambda *given, before=explicit._at_rest: searches.append(1) or before(*given))
    model = scene.build(copies=copies, vary=vary, **built)
    assert step_limits(model) == tuple(alone.min(axis=0))
    near = np.unique(alone[0.98 * alone[:, 1] <= alone[:, 0].min()], axis=0)
    assert len(searches) == len(near) and limit_in_motion(model) == alone[:, 1].min()
    # Below the second a step is stable about the rest shape too: no need to look for the first.
    fps = 1.0 / (0.999 * alone[:, 1].min())
    wc.Explicit(substeps=1).bind(replace(scene, fps=fps, duration=1 / fps).build(copies=copies, vary=vary, **built))
    assert len(searches) == len(near) and (alone[:, 1] <= alone[:, 0]).all()


@pytest.mark.parametrize("record", wc.solvers.SOLVERS.values(), ids=lambda record: record.name)
def test_a_solver_without_a_step_takes_about_a_240th_of_a_second_or_its_limit(record, device):
    for fps, substeps in ((24.0, 10), (60.0, 4), (1000.0, 1)):
        scene = replace(net("structural", n=4), fps=fps, duration=2.0 / fps)
        model = scene.build(device=device, dtype="float64")
        if record.limited:
            substeps = fewest_substeps(fps, *record.step_limits(model))
        assert record().bind(model).steps_per_frame == substeps
        ends = [wc.simulate(scene, each, device=device, dtype="float64") for each in (record(), record(substeps=substeps))]
        assert np.array_equal(*(each.points[-1] for each in ends))


SPRING, STVK = (kind(stiffness=np.inf) for kind in (wc.Spring, wc.StVKMembrane))
IMPLICIT = wc.Newton(substeps=1), wc.ProjectiveDynamics(substeps=1), wc.ADMM(substeps=1)
ROWS = partial(wc.ConstrainedDynamics, substeps=1)
INFINITE = "with infinite stiffness"
REFUSED = [
    *((each, SPRING, f"cannot take Spring {INFINITE}; PBD") for each in (*IMPLICIT, wc.Explicit(substeps=1))),
    *(
        (each, kind(most=1.1), f"cannot take {kind.__name__} {INFINITE}; PBD")
        for kind in (wc.SpringLimit, wc.StrainLimit)
        for each in (wc.Newton(substeps=1), wc.Explicit(substeps=1))
    ),
    *((each, STVK, f"cannot take StVKMembrane {INFINITE}, as its") for each in (wc.PBD(), wc.XPBD())),
    *(
        (wc.XPBD(integrator=way), SPRING, f"with integrator='{way}' cannot take Spring {INFINITE}")
        for way in ("midpoint", "bdf2")
    ),
    (ROWS(), wc.StVKMembrane(stiffness=1.0), "cannot take StVKMembrane, whose energy is no square of a constraint; Exp"),
    (ROWS(), wc.StrainLimit(most=1.1), f"cannot take StrainLimit {INFINITE}, as it has no scalar constraint; PBD"),
    (ROWS(integrator="bdf2"), SPRING, "with integrator='bdf2' cannot take Spring with infinite"),
    (ROWS(stabilisation="line-search"), SPRING, "with stabilisation='line-search' cannot take Spring"),
    (wc.XPBD(), wc.ShellBending(stiffness=1), "cannot take ShellBending, .*; Explicit, Newton, ProjectiveDynamics or ADMM can"),
    (wc.Explicit(), wc.Spring(stiffness=1e30), "the scene is so stiff .* is stable only below .*e-1. s; take an implicit one"),
]


@pytest.mark.parametrize(("solver", "term", "message"), REFUSED, ids=lambda each: getattr(each, "label", None))
def test_terms_that_a_solver_lacks_something_for_are_refused(solver, term, message, device):
    name = "" if message.startswith("the scene") else f"^{type(solver).__name__} "
    with pytest.raises(ValueError, match=name + message):
        solver.bind(wc.Scene(wc.Mesh.grid(4, 4), density=1.0, terms=[term]).build(device=device))


def wrong_options():
    """(record, option, value, start of the message) of values that the range or the words of an option do not have."""
    for record in wc.solvers.SOLVERS.values():
        for option in fields(record):
            if limits := option.metadata.get("range"):
                below = limits.least - 1 if limits.above is None else limits.above
                for value in (below, np.nan, True, "car", *([1.5] if limits.whole else [])):
                    rule = limits if value == "car" else replace(limits, word=None)
                    yield record, option.name, value, f"{option.name} is {value!r}; it must be {rule}"
        for name, words in words_of(record).items():
            yield record, name, "car", f"{name} is 'car'; it must be one of {', '.join(map(repr, words))}"


def test_options_are_checked():
    wrong = list(wrong_options())
    for record, name, value, message in wrong:
        step = {} if name in record.step_options else {"substeps": 1}
        with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
            record(**step, **{name: value})
    assert {(wc.Newton, "error"), (wc.ADMM, "weight"), (wc.Explicit, "scheme")} <= {each[:2] for each in wrong}
    wc.XPBD(iterations=5, integrator="midpoint", sweep="constraint-averaged")  # only sweeps to and fro must be even


@pytest.mark.parametrize(
    ("record", "options", "message"),
    [
        (wc.Newton, {"dt": 0.01, "substeps": 2}, "only one of dt, substeps and error"),
        (wc.PBD, {"dt": 0.01, "substeps": 2}, "only one of dt and substeps may be given"),
        (wc.Newton, {"error": 1e-3, "substeps": 2}, "only one of dt, substeps and error"),
        (wc.Newton, {"error": 1e-3, "integrator": "bdf2"}, "bdf2', whose steps must all have one length; take 'euler' or 'mid"),
        (wc.PBD, {"alpha": 1.0}, "alpha is 1; it belongs to sweep='vertex-averaged'"),
        (wc.XPBD, {"sweep": "vertex-averaged"}, "sweep is 'vertex-averaged'; it must be one of 'coloured'"),
        (
            wc.XPBD,
            {"iterations": 5, "integrator": "midpoint"},
            "sweeps go forward and backward in turn, so .* must be even",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(record, options, message):
    with pytest.raises(ValueError, match=message):
        record(**options)


@pytest.mark.parametrize("kind", ["hessian", "constraints"])
def test_copies_that_are_done_are_left_out(kind, device):
    """Of a product with the matrix, and of its sums: those that are active have theirs, what the others hold is as it was."""
    random, scene = np.random.default_rng(10), square()
    scene = replace(scene, positions=scene.mesh.points + random.normal(scale=0.01, size=(36, 3)))
    model = scene.build(device=device, dtype="float64", copies=3)
    if kind == "hessian":
        matrix, sums = Hessian(model), Sums(model)
        matrix.assemble(model.positions, 1.0)
    else:
        matrix = Constraints(model, 0.01, curved=False)
        matrix.launch_linearise(model.positions, model.vectors())
        sums = RowSums(model, matrix.per_copy)
    matrix.prepare()
    p = random.normal(size=(3, *np.shape(matrix.matrices()[0])[:1]))
    given = wp.array(p.reshape(matrix.count, -1).squeeze(), dtype=matrix.vector, device=device)
    product, active = wp.zeros_like(given), wp.array([1, 0, 1], dtype=wp.int32, device=device)
    matrix.multiply(given, product, active)
    exact = np.array([each @ one for each, one in zip(matrix.matrices(), p, strict=True)])
    found = product.numpy().reshape(3, -1)
    # Rounding of sums of up to 100 terms.
    assert np.allclose(found[[0, 2]], exact[[0, 2]], rtol=0.0, atol=100 * EPS * np.abs(exact).max())
    assert not np.allclose(found[1], exact[1], rtol=1e-3, atol=0.0)
    out = wp.full(3, np.nan, dtype=wp.float64, device=device)
    sums.dot(given, given, out, active)
    assert np.allclose(out.numpy()[[0, 2]], (p**2).sum(axis=1)[[0, 2]], rtol=100 * EPS)
    assert not np.isclose(out.numpy()[1], (p[1] ** 2).sum())


def test_a_frame_is_a_whole_number_of_steps(device):
    with pytest.raises(ValueError, match="a frame must be a whole number of steps"):
        wc.Newton(dt=0.01).bind(square().build(device=device))


@table("name", ("explicit", "newton", "xpbd"), SOLVERS)
def test_a_step_allocates_nothing(name, device):
    """Of arrays of Warp; what scipy allocates to factorise on the host is outside the tracker's sight."""
    solver = replace(SOLVERS[name], substeps=5)
    scene = square(solver=solver, damping=0.01, fps=120.0, pins="corners")
    stepper = after_frames(scene, solver, frames=1, steps=5, device=device, dtype="float64")
    assert allocated(lambda: [stepper.step() for _ in range(10)], device) == 0
    assert allocated(lambda: [stepper.frame() for _ in range(3)], device) == 0


@table("name, dtype", [(name, "float32") for name in MAIN], RUNS)
def test_the_same_run_gives_the_same_bits(name, dtype, device):
    def run():
        scene = square(solver=SOLVERS[name], damping=0.01, fps=600.0, pins="corners")
        return wc.simulate(scene, SOLVERS[name], device=device, dtype=dtype, frames=5).points

    assert np.array_equal(run(), run())


@table(
    "name, unlike",
    [(name, "masses and start") for name in ("explicit", "newton", "xpbd")],
    [(name, unlike) for name in SOLVERS for unlike in UNLIKE if name in MAIN or unlike == "density, bending and damping"],
)
def test_copies_run_as_if_alone(name, unlike, device):
    """Every reduction is per copy: copies that differ do not notice one another."""
    vary, solver = UNLIKE[unlike], SOLVERS[name]
    velocities = np.random.default_rng(6).normal(scale=0.1, size=(36, 3))
    base = square(solver=solver, fps=600.0, pins="corners", velocities=velocities)
    kept = {"device": device, "dtype": "float64", "frames": 5}
    batch = wc.simulate(base, solver, copies=3, vary=vary, **kept).points
    for copy in range(3):
        points = wc.simulate(one_of(base, vary, copy), solver, **kept).points
        # Factorising all copies at once eliminates in another order, hence not the same bits there.
        assert np.abs(batch[:, copy] - points).max() < 1e-9
    assert np.ptp(batch[-1], axis=0).max() > 1e-5, "the copies are not alike"


def led(solver, copies=3, device="cpu", dtype="float64", **vary):
    """Copies of a damped cloth whose corners are led away, of different stiffness and gravity, bound."""
    corners = [0, 5]
    keyframes = square().mesh.points[corners] + np.linspace(0.0, 0.02, 5)[:, None, None] * [0.0, 1.0, 0.5]
    scene = square(solver=solver, damping=0.01, fps=1200.0, pins=wc.Pins(corners, keyframes))
    vary |= {"Spring.stiffness": [50.0, 100.0, 200.0], "gravity": [[0, -9.81, 0], [0, -1.6, 0], [3.0, 0, 0]]}
    return solver.bind(scene.build(device=device, dtype=dtype, copies=copies, vary=vary))


def seen(stepper):
    """x and v of all copies, (2, B, n, 3), of its own."""
    return np.array([array.numpy() for array in stepper.state]).reshape(2, stepper.model.copies, -1, 3)


def stepped(stepper, steps):
    """The states after each of so many steps, (steps, 2, B, n, 3)."""
    states = []
    for _ in range(steps):
        stepper.step()
        states.append(seen(stepper))
    return np.array(states)


@table("name", ("explicit", "newton bdf2", "xpbd", "projective dynamics"), SOLVERS)
def test_a_copy_put_back_starts_again(name, device):
    """To the bit, though it has become NaN, and the other copies notice neither; keyframes start again as well."""
    states, stepper = stepped(led(SOLVERS[name], device=device), 10), led(SOLVERS[name], device=device)
    start = seen(stepper)
    assert np.array_equal(stepped(stepper, 3), states[:3])
    spoilt = stepper.state.x.numpy()
    spoilt[stepper.model.per_copy + 7] = np.nan
    stepper.state.x.assign(spoilt)
    others = stepped(stepper, 2)
    assert np.isnan(others[:, :, 1]).any()
    stepper.reset([False, True, False])
    assert np.array_equal(seen(stepper)[:, 1], start[:, 1]) and stepper.results[1] is Result.COMPLETED
    assert stepper.residual[1] == 0.0
    again = stepped(stepper, 5)
    assert np.array_equal(again[:, :, 1], states[:5, :, 1])
    assert np.array_equal(np.concatenate([others, again])[:, :, [0, 2]], states[3:, :, [0, 2]])
    assert Result.DIVERGED not in stepper.results and np.isfinite(stepper.residual).all()


def test_a_residual_starts_again_where_it_is_kept(device):
    """XPBD keeps the largest on the device: what comes after is that of a fresh run."""
    fresh, stepper = (led(SOLVERS["xpbd"], device=device) for _ in range(2))
    stepped(fresh, 2), stepped(stepper, 9)
    kept = stepper.residual.copy()
    stepper.reset([False, True, False])
    stepped(stepper, 2)
    assert kept[1] > fresh.residual[1] == stepper.residual[1] and (stepper.residual[[0, 2]] >= kept[[0, 2]]).all()


@pytest.mark.parametrize("kind", ["numpy", "warp", "vectors", "Warp's own vectors"])
@pytest.mark.parametrize("name", ["explicit", "newton midpoint", "xpbd"])
def test_copies_start_where_one_says(name, kind, device):
    """As a model does whose copies vary so; pins stay with their keyframes and have no velocity."""
    rng = np.random.default_rng(2)
    positions = np.array(square().mesh.points + 0.01 * rng.normal(size=(3, 36, 3)))
    velocities, stepper = rng.normal(size=(3, 36, 3)), led(SOLVERS[name], device=device)
    model, held = stepper.model, positions.copy()
    held[:, [0, 5]] = square().mesh.points[[0, 5]]
    expected = stepped(led(SOLVERS[name], device=device, positions=held, velocities=velocities), 4)
    stepped(stepper, 6)
    given, mask = [positions, velocities], np.ones(3, dtype=bool)
    if kind == "warp":
        given = [wp.array(each, dtype=wp.float64, device=device) for each in given]
    elif kind == "vectors":
        given = [model.array(each.reshape(-1, 3), model.vec3) for each in given]
    elif kind != "numpy":
        given = [wp.array(each, dtype=wp.vec3d, device=device) for each in given]
    stepper.reset(mask if kind == "numpy" else wp.array(mask, dtype=wp.bool, device=device), *given)
    assert np.array_equal(stepped(stepper, 4), expected)
    stepper.reset()
    assert np.array_equal(stepped(stepper, 4), stepped(led(SOLVERS[name], device=device), 4))


def test_putting_copies_back_allocates_nothing(device):
    """After the first time, with arrays of the host and of the device."""
    stepper = led(SOLVERS["xpbd"], device=device)
    positions, mask = np.zeros((3, 36, 3)), np.array([True, False, True])
    arrays = [wp.array(mask, dtype=wp.bool, device=device), *(wp.array(positions, dtype=wp.float64, device=device),) * 2]
    stepper.reset(mask, positions, positions)
    assert allocated(lambda: [stepper.reset(), stepper.reset(mask, positions, positions)], device) == 0
    assert allocated(lambda: stepper.reset(*arrays), device) == 0


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("pbd", {"mask": [True, False]}, r"mask is .*; it must be an array \(3,\) of truth values"),
        ("pbd", {"mask": [0, 1, 0]}, "mask is .* of truth values, one for each copy"),
        ("pbd", {"mask": [[True], [True, False], True]}, "mask is .* of truth values, one for each copy"),
        ("pbd", {"positions": [[1.0], [1.0, 2.0]]}, r"positions is .* not numeric; it must have shape \(3, 36, 3\)"),
        ("pbd", {"mask": wp.int32}, r"mask is an array \(3,\) of int32; on the device"),
        ("pbd", {"positions": np.zeros((36, 3))}, r"positions has shape \(36, 3\); it must be \(3, 36, 3\)"),
        ("pbd", {"velocities": np.full((3, 36, 3), np.nan)}, "velocities.* must be finite"),
        ("pbd", {"positions": wp.float32}, r"positions is an array .* of float32; on the device .* \(3, 36, 3\) of float64"),
        ("newton bdf2", {"positions": np.zeros((3, 36, 3))}, "reset takes no positions or velocities with integrator='bdf2'"),
    ],
)
def test_what_copies_are_put_back_by_is_checked(name, given, message, device):
    ((each, value),) = given.items()
    if isinstance(value, type):
        value = wp.zeros({"mask": 3, "positions": (3, 36, 3)}[each], dtype=value, device=device)
    with pytest.raises(ValueError, match=message):
        led(SOLVERS[name], device=device).reset(**{each: value})


@pytest.mark.parametrize("module", ["numpy", "numpy.from_dlpack", "torch", "jax.dlpack"])
def test_the_state_is_shared_without_copies(module, device):
    """Arrays taken over before the steps show what they move, as (B, n, 3) numbers; NumPy sees memory of the CPU alone."""
    of_numpy = {"numpy": np.asarray, "numpy.from_dlpack": np.from_dlpack}
    over = of_numpy.get(module) or pytest.importorskip(module).from_dlpack
    if module in of_numpy and not wp.get_device(device).is_cpu:
        pytest.skip("NumPy has arrays of the host alone")
    stepper = led(SOLVERS["explicit"], device=device, dtype="float32")  # JAX makes float32 of float64 if not told otherwise
    points, before = over(stepper.state.x), seen(stepper)[0]
    stepper.step()
    wp.synchronize_device(device)
    points = points.reshape(3, 36, 3)
    after = np.asarray(points.cpu() if hasattr(points, "cpu") else points)
    assert np.array_equal(after, seen(stepper)[0]) and not np.array_equal(after, before)


def test_the_array_interface_names_the_memory(device):
    """As (B·n, 3) numbers that may be written, on CUDA as on the CPU."""
    for array in led(SOLVERS["explicit"], device=device, dtype="float32").state:
        found = array.__array_interface__ if array.device.is_cpu else array.__cuda_array_interface__
        assert found["data"] == (array.ptr, False) and found["shape"] == (3 * 36, 3) and found["typestr"] == "<f4"


def test_what_numpy_writes_is_the_state(device):
    """Both ways: the next step starts there."""
    if not wp.get_device(device).is_cpu:
        pytest.skip("NumPy has arrays of the host alone")
    stepper, other = (led(SOLVERS["explicit"], device=device) for _ in range(2))
    velocities = np.random.default_rng(3).normal(size=(3, 36, 3))
    np.asarray(stepper.state.v).reshape(3, 36, 3)[...] = velocities
    other.state.v.assign(velocities.reshape(-1, 3))
    assert np.array_equal(stepped(stepper, 2), stepped(other, 2))


def test_moving_pins_follow_their_keyframes(device):
    """Linear between keyframes within a frame's steps, at rest after the last, for every solver."""
    keyframes = np.array([[[0.0, 0, 0]], [[0.1, 0, 0]], [[0.1, 0.2, 0]]])
    fields = {"terms": [wc.Spring(stiffness=10.0)], "pins": wc.Pins([0], keyframes), "duration": 1.0}
    scene = wc.Scene(wc.Mesh.chain(3, direction=(1, 0, 0)), masses=np.ones(3), **fields)
    exact = [np.interp(np.minimum(np.arange(1, 13) / 4, 2), range(3), keyframes[:, 0, i]) for i in range(3)]
    solvers = [record(substeps=4) for record in wc.solvers.SOLVERS.values()]
    for solver in (*solvers, *(wc.Newton(substeps=4, integrator=integrator) for integrator in ("midpoint", "bdf2"))):
        states = stepped(solver.bind(scene.build(device=device, dtype="float64")), 12)
        assert np.allclose(states[:, 0, 0, 0], np.transpose(exact), atol=4 * EPS)
        assert np.allclose(states[-1, 1, 0, 0], 0.0)


# Defaults on the CPU; where float64 takes over 15 % longer, in benchmarks/precision.py, it is float32.
PRECISIONS = dict.fromkeys(["explicit", "constrained dynamics"], "float32")
PRECISIONS |= dict.fromkeys(["newton", "projective dynamics", "admm", "pbd", "hierarchical pbd", "xpbd"], "float64")


@pytest.mark.parametrize("name", MAIN)
def test_the_default_precision_follows_from_device_and_solver(name, device):
    """Of the record and its class; one that is given wins, and what is no precision is refused."""
    solver = SOLVERS[name]
    for asked in (solver, type(solver)):
        assert asked.precision_on(device) == (PRECISIONS[name] if device == "cpu" else "float32")
        assert [asked.precision_on(device, dtype) for dtype in ("float32", "float64")] == ["float32", "float64"]
        with pytest.raises(ValueError, match="dtype is 'float16'; it must be one of 'float32', 'float64'"):
            asked.precision_on(device, "float16")


@pytest.mark.parametrize("name", ["explicit", "xpbd"])
def test_runs_have_the_default_precision_and_models_without_a_solver_float32(name, device):
    scene, solver = square(solver=SOLVERS[name], fps=600.0), SOLVERS[name]
    expected = PRECISIONS[name] if device == "cpu" else "float32"
    for dtype in (None, "float32", "float64"):
        found = wc.simulate(scene, solver, frames=1, device=device, dtype=dtype)
        assert found.points.dtype == found.velocities.dtype == (dtype or expected)
    assert scene.build(device=device).numpy_dtype is np.float32


def test_a_host_call_inside_a_captured_segment_raises(device):
    """A recorded host call would read what nothing has computed and be missing from every replay."""
    at = wp.get_device(device)
    with pytest.raises(RuntimeError, match="cannot be part of a captured segment"):
        Segment(at, lambda: on_host(at, "reading a frame"))


def test_a_segment_keeps_what_its_launches_read(device):
    """A graph holds addresses only: on CUDA an array that nobody else refers to would be freed and its memory used again."""
    at = wp.get_device(device)

    def recorded():
        source, target = wp.zeros(4, device=at), wp.zeros(4, device=at)
        return Segment(at, lambda: wp.copy(target, source)), weakref.ref(source)

    segment, source = recorded()
    gc.collect()
    assert source() is not None
    segment()
