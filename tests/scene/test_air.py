"""Air: terminal velocity, a strip in the wind, moving frames, still air, and every solver that takes it."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import slow_but
from support.steps import after_steps, newton_step
from warpcloth.usd import read_scene, write_scene

DENSITY, GRAVITY, STILL = 0.1, 9.81, wc.Air()
TERMINAL = np.sqrt(2.0 * DENSITY * GRAVITY / (STILL.density * STILL.normal_drag))  # 1.167 m/s
# Of first order: the coefficient is that of the start of a step, too small by a step while the sheet is accelerated.
SOLVERS = {
    "newton": wc.Newton(substeps=16, tolerance=1e-8),
    "midpoint": wc.Newton(substeps=16, tolerance=1e-8, integrator="midpoint"),
    "bdf2": wc.Newton(substeps=32, tolerance=1e-8, integrator="bdf2"),
    "admm": wc.ADMM(substeps=16, tolerance=1e-6, iterations=200),
    "xpbd": wc.XPBD(substeps=16, iterations=10),
    "projective dynamics": wc.ProjectiveDynamics(substeps=16, tolerance=1e-8, iterations=200),
    "explicit": wc.Explicit(substeps=64),
}
each_solver = pytest.mark.parametrize("name", slow_but(("explicit", "newton"), SOLVERS))


def sheet(n=4, air=STILL, **scene):
    given = {"density": DENSITY, "terms": [wc.Spring(stiffness=100.0)], "duration": 0.2, "air": air}
    return wc.Scene(wc.Mesh.grid(n, n, size=0.3, pattern="alternating"), **(given | scene))


@each_solver
def test_a_sheet_that_falls_flat_has_the_closed_form(name, device):
    """v_t tanh(at/v_t), v_t² = 2ma/(ρC_n), to 0.1 %, with a = g − p/m and a pressure p from below; v_t stays, to rounding."""
    for p, a in ((0.0, GRAVITY), (0.4, GRAVITY - 0.4 / DENSITY)):
        limit = np.sqrt(a / GRAVITY) * TERMINAL
        fallen = simulated(sheet(loads=wc.Pressure(vertices="all", pressure=p) if p else ()), SOLVERS[name], device)
        assert fallen.status.ok
        v = fallen.velocities[-1]
        assert -v[:, 1] == pytest.approx(limit * np.tanh(a * 0.2 / limit), rel=1e-3)
        assert p or np.abs(v[:, [0, 2]]).max() < 1e-6
    falling = np.tile([0.0, -TERMINAL, 0.0], (16, 1))
    steady = simulated(sheet(velocities=falling, duration=0.05), SOLVERS[name], device)
    assert -steady.velocities[-1][:, 1] == pytest.approx(TERMINAL, rel=1e-5)


def simulated(scene, solver, device, **options):
    return wc.simulate(scene, solver, device=device, dtype="float64", **options)


def strip(wind, slope, n=7):
    """A strip of 0.2 m that hangs by its upper edge, at an angle ``slope`` from the vertical."""
    mesh = wc.Mesh.grid(3, n, size=(0.2 * 2 / (n - 1), 0.2), pattern="alternating")
    across, along = mesh.points[:, 0], mesh.points[:, 2]
    positions = np.stack([along * np.sin(slope), -along * np.cos(slope), across], axis=1)
    terms = [wc.StVKMembrane(stiffness=5e3, damping=5.0), wc.QuadraticBending(stiffness=1e-4)]
    air = wc.Air(wind=(wind, 0.0, 0.0), tangential_drag=0.0)
    return wc.Scene(mesh, density=DENSITY, positions=positions, terms=terms, pins="z < 0.001", air=air, duration=3.0)


def slope_in(wind, pressure=0.0):
    """sin φ = N cos²φ + P, N = ½ρC_n w²/(mg), P = p/(mg): weight and pressures balance on every part of a straight strip."""
    N, P = np.array([0.5 * STILL.density * STILL.normal_drag * wind**2, pressure]) / (DENSITY * GRAVITY)
    return np.arcsin((np.sqrt(1.0 + 4.0 * N * (N + P)) - 1.0) / (2.0 * N))


def slopes(scene, points):
    down = points[scene.mesh.points[:, 2] > 0.19] - points[scene.mesh.points[:, 2] < 0.001]
    return np.arctan2(down[:, 0], -down[:, 1])


IN_WIND = [(1.0, 0.0, 31.92), (2.0, 0.0, 57.57), (4.0, 0.0, 73.40), (2.0, -0.6, 47.36)]


@pytest.mark.parametrize(("wind", "pressure", "degrees"), slow_but(IN_WIND[1::2], IN_WIND))
def test_a_hanging_strip_rests_at_the_angle_of_the_wind(wind, pressure, degrees, device):
    """From hanging straight; the pins bear the weight, the force of the wind on all triangles, ½ρAC_n(w cos φ)², and pA."""
    angle = slope_in(wind, pressure)
    assert np.degrees(angle) == pytest.approx(degrees, abs=0.01)
    loads = wc.Pressure(vertices="all", pressure=-pressure) if pressure else ()  # normals point against the wind
    scene = replace(strip(wind, 0.0), loads=loads)
    rest = wc.equilibrium(scene, device=device, record="reactions")
    assert rest.status.ok and rest.stable
    assert slopes(scene, rest.points) == pytest.approx(angle, rel=1e-4)
    pull = 0.5 * STILL.density * STILL.normal_drag * (wind * np.cos(angle)) ** 2 + pressure
    pull *= scene.mesh.triangle_areas.sum()
    weight = scene.vertex_masses.sum() * GRAVITY
    held = [-pull * np.cos(angle), weight - pull * np.sin(angle)]
    assert rest.reactions.sum(axis=0)[:2] == pytest.approx(held, rel=1e-3)  # the membrane stretches by 2e-4


@each_solver
def test_a_hanging_strip_stays_at_the_angle_of_the_wind(name, device):
    """At 2 m/s for 0.2 s. A strip that hangs straight swings past this angle in that time."""
    # What a tolerance of 1e-5 g leaves in a step would move the lower end of 0.2 m by 2e-6 m then, 1e-5 of the angle.
    angle = slope_in(2.0)
    scene = replace(strip(2.0, angle), terms=[wc.Spring(stiffness=100.0, damping=0.01)], duration=0.2)
    solver = replace(SOLVERS[name], substeps=64 if name == "explicit" else 8)
    solver = replace(solver, tolerance=1e-5) if hasattr(solver, "tolerance") else solver
    run = simulated(scene, solver, device)
    assert run.status.ok
    assert slopes(scene, run.points[-1]) == pytest.approx(angle, rel=1e-3)


@each_solver
def test_a_moving_observer_sees_the_same(name, device):
    """Wind, start and all else faster by V: the motion is the same but for V t."""
    V, wind = np.array([3.0, 0.0, -1.0]), np.array([1.0, 2.0, 0.5])
    solver = replace(SOLVERS[name], substeps=64 if name == "explicit" else 4)
    start = np.random.default_rng(1).normal(scale=0.3, size=(16, 3))
    seen = [
        simulated(sheet(air=wc.Air(wind=wind + v), velocities=start + v, duration=0.1), solver, device) for v in (0.0 * V, V)
    ]
    assert seen[0].status.ok and seen[1].status.ok
    moved = seen[1].points[-1] - seen[0].points[-1] - 0.1 * V
    assert np.abs(moved).max() < (1e-6 if name in ("admm", "xpbd") else 1e-7)  # by what tolerances leave
    still = simulated(sheet(air=None, velocities=start, duration=0.1), solver, device)
    assert np.abs(still.points[-1] - seen[0].points[-1]).max() > 1e-3, "the air matters"


@pytest.mark.parametrize("name", slow_but(["midpoint"], SOLVERS))
def test_still_air_takes_energy(name, device):
    """Without gravity: kinetic and elastic energy never rise, and fall by far more than the solver loses by itself."""
    start = np.random.default_rng(2).normal(scale=0.5, size=(16, 3))
    scene = sheet(velocities=start, gravity=(0.0, 0.0, 0.0), pins=[0], duration=0.1, air=wc.Air(density=30.0))  # stops soon
    damped = simulated(scene, SOLVERS[name], device, record="energies")
    total = damped.energies["kinetic"] + damped.energies["Spring"]
    assert np.diff(total).max() < (1e-2 if name == "explicit" else 1e-9) * total[0]  # symplectic Euler oscillates
    none = simulated(replace(scene, air=None), SOLVERS[name], device, record="energies")
    assert total[-1] < 0.9 * (none.energies["kinetic"] + none.energies["Spring"])[-1]


@pytest.mark.parametrize("name", ["explicit", "newton", "midpoint"])
def test_the_work_of_air_is_that_of_the_change_of_momentum(name, device):
    """Of a sheet that nothing else moves, and that stays rigid: F = mΔv/h in each step, wherever a step takes its forces."""
    solver = replace(SOLVERS[name], substeps=1)
    given = {"velocities": np.tile([1.0, 0.5, -2.0], (16, 1)), "terms": [wc.Spring(stiffness=0.3)]}
    scene = sheet(gravity=(0.0, 0.0, 0.0), air=wc.Air(wind=(-1.0, 2.0, 0.5)), **given)
    run = simulated(scene, solver, device, record="energies")
    impulses = scene.vertex_masses[:, None] * np.diff(run.velocities, axis=0)
    steps = np.einsum("fij,fij->f", impulses, np.diff(run.points, axis=0)) * scene.fps
    kinetic = run.energies["kinetic"]
    assert np.ptp(kinetic) > 0.2 * kinetic[0]
    np.testing.assert_allclose(run.energies["work of air"][1:], np.cumsum(steps), rtol=0.0, atol=1e-7 * kinetic[0])


MEET = {
    "admm": wc.ADMM(substeps=1, tolerance=1e-11, iterations=8000),
    "xpbd": wc.XPBD(substeps=1, iterations=4000),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-12, iterations=2000),
}


@pytest.mark.parametrize("name", slow_but(list(MEET)[:2], MEET))
def test_solvers_that_minimise_meet(name, device):
    random = np.random.default_rng(3)
    start = sheet().mesh.points + random.normal(scale=0.01, size=(16, 3))
    scene = sheet(positions=start, velocities=random.normal(size=(16, 3)), air=wc.Air(wind=(5.0, 1.0, 2.0)), pins=[0])
    exact = newton_step(scene, device)
    assert np.abs(after_steps(scene, MEET[name], device)[0] - exact).max() < 1e-8
    assert np.abs(newton_step(replace(scene, air=None), device) - exact).max() > 1e-3


def test_wind_by_keyframes_and_by_triangles(device):
    """One keyframe is that wind; a triangle each is the wind of each; linear between frames."""
    wind, solver = (2.0, 1.0, 0.0), wc.Newton(substeps=2, tolerance=1e-10)
    triangles = len(sheet().mesh.triangles)
    airs = [wc.Air(wind=wind), wc.Air(keyframes=[wind]), wc.Air(wind=np.tile(wind, (triangles, 1)))]
    airs.append(wc.Air(keyframes=np.linspace(0.0, 2.0, 13)[:, None] * wind))
    ends = [simulated(sheet(air=air, pins=[0], duration=0.1), solver, device).points[-1] for air in airs]
    assert np.abs(ends[1] - ends[0]).max() < 1e-12 and np.abs(ends[2] - ends[0]).max() < 1e-12
    assert 1e-4 < np.abs(ends[3] - ends[0]).max() < 0.1


@wp.func
def ramp(_position: wp.vec3, time: float):
    """The wind of the keyframes (0, 0, 0), (1, 0.5, 0), …, one each 1/60 s."""
    return 60.0 * time * wp.vec3(1.0, 0.5, 0.0)


@wp.func
def sheared(position: wp.vec3, _time: float):
    """A wind that differs from triangle to triangle, in a bound of 8 m/s."""
    return wp.vec3(4.0 * position[2], 30.0 * position[0], 0.0)


@pytest.mark.parametrize("name", slow_but(("explicit", "midpoint"), SOLVERS))
def test_a_function_gives_the_wind_at_each_position_and_time(name, device):
    """As keyframes do that are the same, to float32 of the function; and as winds of triangles do that do not move."""
    keyframes = np.arange(8)[:, None] * [1.0, 0.5, 0.0]
    solver = replace(SOLVERS[name], substeps=16 if name == "explicit" else 2)
    if name == "admm":  # whose steps end by a tolerance that is relative to the largest wind that is declared
        solver = replace(solver, tolerance=1e-8, iterations=2000)
    ends = [
        simulated(sheet(air=air, pins=[0], duration=0.1), solver, device, record="reactions")
        for air in (wc.Air(keyframes=keyframes), wc.Air(wind=ramp, max_speed=10.0))
    ]
    assert np.abs(ends[1].points - ends[0].points).max() < 1e-7
    assert ends[1].reactions == pytest.approx(ends[0].reactions, abs=1e-6 * np.abs(ends[0].reactions).max())
    still = {"pins": "all", "gravity": (0.0, 0.0, 0.0), "duration": 1 / 60}
    centres = sheet().mesh.points[sheet().mesh.triangles].mean(axis=1)
    winds = np.stack([4.0 * centres[:, 2], 30.0 * centres[:, 0], 0.0 * centres[:, 0]], axis=1)
    speeds = np.linalg.norm(winds, axis=1)
    winds *= np.minimum(1.0, 8.0 / speeds)[:, None]
    assert (speeds > 8.0).any() and (speeds < 8.0).any()
    held = [
        simulated(sheet(air=air, **still), solver, device, record="reactions").reactions[-1]
        for air in (wc.Air(wind=winds), wc.Air(wind=sheared, max_speed=8.0))
    ]
    assert held[1] == pytest.approx(held[0], abs=1e-6 * np.abs(held[0]).max())


def test_equilibrium_takes_a_function_at_the_end_of_the_scene(device):
    scene = replace(strip(1.0, 0.5), duration=1 / 60)
    ends = [
        wc.equilibrium(replace(scene, air=air), device=device)
        for air in (wc.Air(wind=(1.0, 0.5, 0.0)), wc.Air(wind=ramp, max_speed=10.0))
    ]
    assert ends[0].status.ok and np.abs(ends[1].points - ends[0].points).max() < 1e-6


def test_reactions_have_the_drag_of_pins(device):
    """Of a sheet whose vertices are all pinned, at right angles to the wind: ½ρA(C_n u²)."""
    mesh = wc.Mesh.grid(4, 4, size=0.3)
    given = {"pins": "all", "gravity": (0.0, 0.0, 0.0), "air": wc.Air(wind=(0.0, 4.0, 0.0)), "duration": 0.05}
    scene = wc.Scene(mesh, density=DENSITY, terms=[wc.Spring(stiffness=10.0)], **given)
    found = simulated(scene, wc.Newton(substeps=1), device, record="reactions")
    assert found.reactions[-1].sum(axis=0) == pytest.approx([0.0, -0.5 * 1.2 * 1.2 * 16.0 * 0.09, 0.0], abs=1e-9)


def test_copies_vary_in_their_wind(device):
    winds = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    solver = wc.Newton(substeps=2, tolerance=1e-10)
    both = simulated(sheet(pins=[0], duration=0.05), solver, device, copies=2, vary={"Air.wind": winds})
    for copy, wind in enumerate(winds):
        alone = simulated(sheet(pins=[0], duration=0.05, air=wc.Air(wind=wind)), solver, device)
        assert np.abs(both.points[-1][copy] - alone.points[-1]).max() < 1e-9


@pytest.mark.parametrize("air", [wc.Air(wind=(1.0, 2.0, 3.0), normal_drag=1.0), wc.Air(keyframes=[(0, 0, 0), (4, 0, 0)])])
def test_stages_keep_it(air, tmp_path):
    write_scene(sheet(air=air), tmp_path / "air.usda")
    found = read_scene(tmp_path / "air.usda").air
    assert np.array_equal(found.winds, air.winds) and (found.keyframes is None) == (air.keyframes is None)
    assert (found.density, found.normal_drag, found.tangential_drag) == (1.2, air.normal_drag, 0.02)


@wp.func
def of_position(position: wp.vec3):
    return position


@wp.func
def of_float64(position: wp.vec3d, time: wp.float64):
    return position * time


@wp.func
def number(position: wp.vec3, time: float):
    return time


def blown(wind):
    return sheet(air=wc.Air(wind=wind, max_speed=1.0))


STRONG = wc.Air(wind=(100.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("attempt", "sentence"),
    [
        (lambda: wc.Air(wind=(1.0, 0.0)), r"air.wind has shape \(2,\)"),
        (lambda: wc.Air(wind=(1.0, 0.0, np.nan)), r"air.wind\[2\] is nan; it must be finite"),
        (lambda: wc.Air(wind=(1, 0, 0), keyframes=[(1, 0, 0)]), "air.wind and air.keyframes are given"),
        (lambda: wc.Air(wind=ramp), "one of a function as air.wind and air.max_speed is given"),
        (
            lambda: blown(lambda position, time: position),
            r"<lambda> .*, which is not a Warp function; decorate it with @wp.func",
        ),
        (lambda: blown(of_position), "its arguments must be a position wp.vec3 and a time float"),
        (lambda: blown(of_float64), "its arguments must be a position wp.vec3 and a time float"),
        (lambda: blown(wp.sin), "its arguments must be a position wp.vec3 and a time float"),
        (
            lambda: wc.simulate(blown(number), wc.Newton(substeps=1), frames=1),
            "air.wind is the function 'number', which Warp cannot compile as a wind: .* returns a value of type `float32`",
        ),
        (lambda: write_scene(sheet(air=wc.Air(wind=ramp, max_speed=1.0)), "air.usda"), "a function, which a stage cannot hold"),
        (lambda: wc.Air(density=-1.0), "air.density is -1.0; it must be a number of 0 or more"),
        (lambda: sheet(air=3), "air is 3; it must be an Air or None"),
        (lambda: sheet(air=wc.Air(wind=np.zeros((5, 3)))), r"air.wind has shape \(5, 3\); it must be \(3,\), or \(18, 3\)"),
        (lambda: wc.simulate(sheet(), wc.PBD(substeps=4)), "PBD cannot take Air, whose drag grows .*; Explicit, Newton"),
        (lambda: wc.simulate(sheet(), wc.ConstrainedDynamics(substeps=4)), "cannot take Air, whose energy is no square of"),
        (
            lambda: wc.simulate(sheet(air=STRONG), wc.Explicit(substeps=8), dtype="float64"),
            "in this wind the forces of air need steps",
        ),
    ],
)
def test_refusals(attempt, sentence):
    with pytest.raises(ValueError, match=sentence):
        attempt()
