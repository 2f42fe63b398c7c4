"""Implicit Euler, midpoint and BDF2 in every solver that takes them: order, energy, momentum, pins, what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import warpcloth as wc
from support.rows import table
from support.steps import after_steps, spring, strains
from warpcloth.numerics.integrators import INTEGRATORS

EPS = np.finfo(np.float64).eps
CONSTRAINED = wc.ConstrainedDynamics(substeps=1, tolerance=1e-11, iterations=200)
# So far converged that the error is that of the step.
SOLVERS = {
    "newton": wc.Newton(substeps=1, tolerance=1e-11),
    "newton factorised": wc.Newton(substeps=1, tolerance=1e-11, linear="factorised"),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-11, iterations=200),
    "constrained dynamics": CONSTRAINED,
    "constrained dynamics searching": replace(CONSTRAINED, stabilisation="line-search", linear="factorised"),
    "admm": wc.ADMM(substeps=1, tolerance=1e-10, iterations=4000, weight=1.0),
    "xpbd": wc.XPBD(substeps=1, iterations=120),
    "xpbd scalar": wc.XPBD(substeps=1, iterations=120, form="scalar"),
}
each_solver = table("name", ("newton", "projective dynamics", "xpbd"), SOLVERS)
# Systems are solved and searched along as for Euler steps, whatever the integrator.
ALIKE = ("newton factorised", "constrained dynamics searching")
each_method = table("name", ("newton", "projective dynamics", "xpbd"), [name for name in SOLVERS if name not in ALIKE])
each_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)


def bound(scene, solver, device, dtype="float64", **options):
    """``solver`` with other options, bound to ``scene``."""
    return replace(solver, **options).bind(scene.build(device=device, dtype=dtype))


def oscillator(omega, h, stretch=0.25, speed=0.5):
    """A unit mass on a spring along x of rest length 1 from a pin: u = x − 1 obeys u″ = −ω²u."""
    velocities = [[0.0, 0.0, 0.0], [speed, 0.0, 0.0]]
    return spring((1.0 + stretch, 0.0, 0.0), omega**2, velocities=velocities, fps=1.0 / h, duration=h)


def swing(stepper, steps, omega):
    """v + iωu of the start and after each step, (steps + 1,)."""
    found = []
    for step in range(steps + 1):
        if step:
            stepper.step()
        found.append(stepper.state.v.numpy()[1, 0] + 1j * omega * (stepper.state.x.numpy()[1, 0] - 1.0))
    return np.array(found)


def slopes(steps, errors):
    """d log error / d log h between neighbours."""
    return np.diff(np.log(errors)) / np.diff(np.log(steps))


@pytest.mark.host
@each_integrator
@each_solver
def test_order_on_an_oscillator(name, integrator, device):
    """The error after a time falls like h for Euler and like h² for midpoint and BDF2."""
    omega, end = 2.0, 1.0
    steps, errors = end / np.array([40, 80]), []
    for h in steps:
        w = swing(bound(oscillator(omega, h), SOLVERS[name], device, integrator=integrator), round(end / h), omega)
        errors.append(abs(w[-1] - w[0] * np.exp(1j * omega * end)))
    assert slopes(steps, errors) == pytest.approx(1 if integrator == "euler" else 2, abs=0.15)


@pytest.mark.host
@pytest.mark.parametrize("omega_h", [0.1, 1.0, 10.0])
@each_integrator
@each_method
def test_energy_of_an_oscillator(name, integrator, omega_h, device):
    """With w = v + iωu, z = iωh: Euler w/(1 − z), midpoint w(1 + z/2)/(1 − z/2), which keeps |w|, BDF2 the roots of its law."""
    # (3/2 − z)r² − 2r + 1/2 = 0, from v₋₁ and u₋₁ of two steps of Euler of 2h/3, w₀/(1 − 2z/3)ⁿ.
    h, steps = 0.1, 20
    omega, z = omega_h / h, 1j * omega_h
    scene = oscillator(omega, h, stretch=0.01, speed=0.02)  # so little that x̃ does not pass the pin
    w, n = swing(bound(scene, SOLVERS[name], device, integrator=integrator), steps, omega), np.arange(steps + 1)
    if integrator == "bdf2":
        v = (w[0] / (1.0 - z / 1.5) ** np.arange(3)).real
        before = (2.5 * v[0] - 1.5 * v[1]) + 1j * w[0].imag - z * (v[1] - 1.75 * (v[2] - v[1]))
        r = (2.0 + np.array([1.0, -1.0]) * np.sqrt(1.0 + 2.0 * z)) / (3.0 - 2.0 * z)
        parts = np.linalg.solve([[1.0, 1.0], 1.0 / r], [w[0], before])
        exact = (parts[:, None] * r[:, None] ** n).sum(axis=0)
        assert np.abs(r).max() < 1.0, "it dissipates"
    else:
        exact = w[0] * (1.0 / (1.0 - z) if integrator == "euler" else (1.0 + z / 2.0) / (1.0 - z / 2.0)) ** n
    # A step leaves at most 1e-10 of the first unbalanced acceleration or, of both residuals of ADMM, of 1 m/s²; h times that.
    tolerance = steps * 1e-10 * max(max(1.0, omega_h) * np.abs(exact).max(), 2.0 * h)
    assert np.abs(w - exact).max() < tolerance
    energy = np.abs(w) ** 2
    if integrator == "midpoint":
        assert np.abs(energy / energy[0] - 1.0).max() < 2.0 * tolerance / np.sqrt(energy[0])
    elif integrator == "euler":
        assert np.allclose(energy, energy[0] / (1.0 + omega_h**2) ** n, rtol=1e-8, atol=2.0 * tolerance * np.sqrt(energy[0]))


FPS, FRAMES = 10.0, 4


@cache
def held(damping=0.0):
    """A net of 4 × 4 in tension, thrown, in gravity, whose pinned corners are moved with a kink at every frame."""
    mesh, corners, rng = wc.Mesh.grid(4, 4), [0, 3, 12, 15], np.random.default_rng(0)
    start = 1.2 * mesh.points
    keyframes = start[corners] + np.concatenate([np.zeros((1, 4, 3)), 0.02 * rng.normal(size=(FRAMES, 4, 3))]).cumsum(axis=0)
    masses, velocities = rng.uniform(0.5, 1.5, size=16), 0.3 * rng.normal(size=(16, 3))
    terms, pins = [wc.Spring(pairs="structural", stiffness=30.0, damping=damping)], wc.Pins(corners, keyframes)
    fields = {"terms": terms, "pins": pins, "gravity": (0.0, -1.0, 0.5), "fps": FPS, "duration": FRAMES / FPS}
    return wc.Scene(mesh, masses=masses, positions=start, velocities=velocities, **fields)


@cache
def true_end(damping):
    """x and v of the free vertices of :func:`held` in the end, (2, 12, 3), to 1e-11, frame by frame and without any of Warp."""
    scene = held(damping)
    pins, pairs = scene.pins.vertices, scene.terms[0].stencil(scene.mesh)
    free = np.setdiff1d(np.arange(16), pins)
    lengths = np.linalg.norm(np.diff(scene.mesh.points[pairs], axis=1)[:, 0], axis=1)
    state = np.stack([scene.positions[free], scene.velocities[free]])
    for frame in range(FRAMES):
        here, there = scene.pins.keyframes[frame : frame + 2]

        def rate(t, y, here=here, there=there):
            x, v = np.empty((2, 16, 3))
            (x[free], v[free]), x[pins], v[pins] = y.reshape(2, -1, 3), here + t * FPS * (there - here), FPS * (there - here)
            y, change = (np.diff(values[pairs], axis=1)[:, 0] for values in (x, v))
            length = np.linalg.norm(y, axis=1)
            pull = (30.0 * (1.0 - lengths / length) + damping * (y * change).sum(axis=1) / length**2)[:, None] * y
            force = np.zeros((16, 3))
            np.add.at(force, pairs[:, 0], pull)
            np.add.at(force, pairs[:, 1], -pull)
            return np.concatenate([v[free], force[free] / scene.vertex_masses[free, None] + scene.gravity]).ravel()

        solution = solve_ivp(rate, (0.0, 1.0 / FPS), state.ravel(), method="DOP853", rtol=1e-12, atol=1e-13)
        state = solution.y[:, -1].reshape(2, -1, 3)
    return state


@pytest.mark.parametrize("damping", [0.0, pytest.param(2.0, marks=pytest.mark.host)])
@each_integrator
@each_method
def test_order_on_a_net_whose_pins_move(name, integrator, damping, device):
    """Slopes 1 and 2 of x and v against an independent integration; midpoint with pins at tₙ, not tₙ + h/2, would lose one."""
    # Damped, so would midpoint with s of the mean state taken for the mean of s; and BDF2 that knows no past of pins loses
    # both.
    scene, substeps, errors = held(damping), [8, 16] if integrator == "bdf2" else [6, 12], []
    free = np.setdiff1d(np.arange(16), scene.pins.vertices)
    for steps in substeps:
        solver = replace(SOLVERS[name], integrator=integrator, substeps=steps)
        x, stepper = after_steps(scene, solver, device, steps=FRAMES * steps)
        assert np.abs(x[scene.pins.vertices] - scene.pins.keyframes[-1]).max() < 4 * EPS
        ends = np.stack([x[free], stepper.state.v.numpy()[free]])
        errors.append(np.sqrt(((ends - true_end(damping)) ** 2).mean(axis=(1, 2))))
    found = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.abs(found - (1 if integrator == "euler" else 2)).max() < 0.15


# A net of 6 × 6, stretched at rest or its vertices in any motion: ωh of the stiffest mode 0.8 to 800, βh/m of an edge 4 to 4e5.
STARTS = {f"stretched, {k:g} N/m": (1.02, 0.0, {"stiffness": k}) for k in (1.0, 1e2, 1e4, 1e6)}
STARTS |= {f"damped by {b:g} N s/m": (1.0, 0.1, {"stiffness": 1e2, "damping": b}) for b in (1.0, 1e3, 1e5)}


@pytest.mark.parametrize("start", STARTS)
@each_method
def test_bdf2_gains_no_energy_where_it_starts(name, start, device):
    """Not out of balance by ωh·ωu of speed a step, nor damped by βh/m of it, whatever they are."""
    (stretch, speed, options), mesh = STARTS[start], wc.Mesh.grid(6, 6)
    positions, velocities = stretch * mesh.points, speed * np.random.default_rng(0).normal(size=(36, 3))
    fields = {"terms": [wc.Spring(pairs=("structural", "shear"), **options)], "gravity": (0.0, 0.0, 0.0), "fps": 60.0}
    scene = wc.Scene(mesh, density=0.1, positions=positions, velocities=velocities, **fields)
    # Such forces are not found to 1e-11 of the residual's unit.
    loose = {"iterations": 100} if "xpbd" in name else {"iterations": 100, "tolerance": 1e-6}
    stepper = bound(scene, SOLVERS[name], device, integrator="bdf2", **loose)
    pairs, energies = scene.terms[0].stencil(mesh), []
    lengths = np.linalg.norm(np.diff(mesh.points[pairs], axis=1)[:, 0], axis=1)
    for step in range(11):
        if step:
            stepper.step()
        x, v = (array.numpy() for array in stepper.state)
        strained = np.linalg.norm(np.diff(x[pairs], axis=1)[:, 0], axis=1) - lengths
        kinetic = 0.5 * (scene.vertex_masses[:, None] * v**2).sum()
        energies.append(kinetic + 0.5 * options["stiffness"] * (strained**2).sum())
    assert max(energies[1:]) < energies[0]


def test_the_start_of_bdf2_leaves_the_state(device):
    """It takes a step to learn a₀ and puts back where everything is, pins and their keyframes too."""
    scene = held(2.0)
    for name in SOLVERS:
        stepper = bound(scene, SOLVERS[name], device, integrator="bdf2", substeps=4)
        assert np.array_equal(stepper.state.x.numpy(), stepper.model.positions.numpy())
        assert np.array_equal(stepper.state.v.numpy(), stepper.model.velocities.numpy())
        assert stepper.count.numpy()[0] == 0


@pytest.mark.parametrize("iterations", [2, 6])
@pytest.mark.parametrize("sweep", ["coloured", "sequential"])
def test_sweeps_of_xpbd_give_nothing_to_midpoint(sweep, iterations, device):
    """A sheet in free fall, disturbed by 1e-6 m, keeps its strain; sweeps in one order make it grow."""
    mesh = wc.Mesh.grid(12, 12)
    points = mesh.points + 1e-6 * np.random.default_rng(0).normal(size=mesh.points.shape)
    springs = wc.Spring(pairs=("structural", "shear"), stiffness=1e4)
    scene = wc.Scene(mesh, density=0.1, terms=[springs], positions=points, fps=60.0, duration=1.0)
    x, _ = after_steps(scene, wc.XPBD(iterations=iterations, sweep=sweep, integrator="midpoint", substeps=1), device, steps=400)
    before, after = (np.abs(strains(scene, each)).max() for each in (points, x))
    assert after < 3.0 * before  # of all modes together at once, had they all the same phase


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["midpoint", "bdf2"])
def test_no_code_outside_the_class_knows_its_name(integrator, device, monkeypatch):
    """The class of another integrator in the place of Euler takes its steps, with damping, air, pins and contact."""
    mesh, k = wc.Mesh.grid(4, 4, size=0.3), np.arange(4)[:, None]
    path = mesh.points[[0, 3]] + 0.01 * k[:, :, None] * [1.0, 0.0, 1.0]
    fields = {"pins": wc.Pins([0, 3], keyframes=path), "air": wc.Air(keyframes=np.hstack([2.0 * k, 0.0 * k, -1.0 * k]))}
    colliders = [wc.Sphere(radius=0.1, position=(0.15, -0.1005, 0.15), friction=0.5)]
    scene = wc.Scene(mesh, density=0.2, terms=[wc.Spring(stiffness=100.0, damping=0.1)], colliders=colliders, **fields)

    def run(name):
        return wc.simulate(scene, wc.Newton(substeps=2, integrator=name), device=device, dtype="float64", frames=3).points

    expected, euler = run(integrator), run("euler")
    monkeypatch.setitem(INTEGRATORS, "euler", INTEGRATORS[integrator])
    assert np.array_equal(run("euler"), expected) and not np.array_equal(euler, expected)
