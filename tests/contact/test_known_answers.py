"""Contact with planes, of closed form and of triangles, and with prisms against known answers."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import warpcloth as wc
from support.laws import EXTRA, SOFTNESS, Sticky
from support.layers import cloth
from support.random_scenes import random_case, run_case
from support.rows import table
from support.scenes import incline, scene
from warpcloth.core.status import Grade, Result
from warpcloth.scenes import ring

G, DENSITY = 9.81, 0.15
SLOW = pytest.mark.slow
# Steps a frame are added; what is tested has little else that moves.
SOLVERS = {
    "explicit": wc.Explicit(substeps=1),
    "newton": wc.Newton(substeps=1, tolerance=1e-9),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-9, iterations=500),
    "xpbd": wc.XPBD(substeps=1, iterations=100),
    "admm": wc.ADMM(substeps=1, tolerance=1e-7, iterations=1000),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, tolerance=1e-9, iterations=100),
}
HOST = {"admm": pytest.mark.host}  # test_colliders.py and test_forces.py have it on other devices


def of_solvers(*left_out):
    names = [name for name in SOLVERS if name not in left_out]
    return pytest.mark.parametrize("name", [pytest.param(name, marks=HOST.get(name, ())) for name in names])


def methods(*slow, **solvers):
    """Runs a test with solvers, of which those that are named take long."""
    marks = HOST | dict.fromkeys(slow, SLOW)
    rows = [pytest.param(each, id=name, marks=marks.get(name, ())) for name, each in solvers.items()]
    return pytest.mark.parametrize("solver", rows)


each_solver, sticky, implicit = of_solvers(), of_solvers("constrained dynamics"), of_solvers("explicit")


def of_triangles(plane):
    """An open mesh in a plane through the origin."""
    grid = wc.Mesh.grid(14, 14, size=8.0, pattern="alternating")
    along = np.array([plane.normal[1], -plane.normal[0], 0.0])
    frame = np.array([along, plane.normal, np.cross(along, plane.normal)])
    return wc.MeshCollider((grid.points - [3.9, 0.0, 3.95]) @ frame, grid.triangles, friction=plane.friction)


def sheet(gap, stiffness=1000.0, **fields):
    """A square of nine vertices at a distance ``gap`` [m] above a plane."""
    grid = wc.Mesh.grid(3, 3, size=0.1)
    mesh = wc.Mesh(grid.points + np.array([0.0, gap, 0.0]), grid.triangles)
    return cloth(mesh, terms=[wc.Spring(stiffness=stiffness)], colliders=[wc.Plane()], **fields)


def run(scene, name, substeps, device, mesh=False):
    """With the plane of a scene, or an open mesh in it."""
    scene = replace(scene, colliders=[of_triangles(scene.colliders[0])]) if mesh else scene
    return wc.simulate(scene, replace(SOLVERS[name], substeps=substeps), dtype="float64", device=device)


@sticky
@table(
    "law, friction, mesh",
    [(float, 0.3, False), (Sticky, 0.1, False)],
    [(float, 0.1, False), (float, 0.3, False), (float, 0.3, True), (Sticky, 0.1, False), (Sticky, 0.1, True)],
)
def test_a_sheet_slides_down_a_slope(name, law, friction, mesh, device):
    """a = g(sin θ − μ cos θ), of the second half, when anchors are dragged along; less ke/ρ if each spring bears e more."""
    scene, _, down = incline(30.0, law(friction), duration=0.5)
    animation = run(scene, name, 60 if name == "explicit" else 2, device, mesh)
    along = (animation.velocities @ down).mean(axis=1)
    expected = G * (0.5 - friction * np.sqrt(0.75)) - (law is Sticky) * 10.0 * G / 1e-3 * EXTRA
    assert (along[-1] - along[15]) / 0.25 == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("friction", (0.0, 0.02))
@table("dtype", ["float32"], ["float64", "float32"])
def test_what_only_the_filter_holds_slides_down_a_slope(friction, dtype, device):
    """Pressed by p = 12 w, of which contact bears kr = 10 w: a = g sin θ − μ(g cos θ + p/ρ). float32 rounds springs."""
    loads = [wc.Pressure(vertices="all", pressure=-12.0 * DENSITY * G)]
    scene, _, down = incline(30.0, friction, duration=1.0, loads=loads)
    animation = wc.simulate(scene, wc.Explicit(substeps=80), device=device, dtype=dtype)
    along = (animation.velocities.astype(float) @ down).mean(axis=1)
    expected = G * (0.5 - friction * (np.sqrt(0.75) + 12.0))
    assert (along[-1] - along[30]) / 0.5 == pytest.approx(expected, rel=1e-4 if dtype == "float64" else 2e-3)
    assert animation.cut > 0.5 and scene.colliders[0].distances(animation.points[-1].astype(float)).min() > 0.0


@pytest.mark.parametrize("friction", (0.0, 0.3))
def test_what_hits_a_ball_slides_off(friction, device):
    """At 100 m/s, along the tangent by v(sin φ − μ cos φ), to the 2 % by which the way of a step turns the normal."""
    grid, ball = wc.Mesh.grid(2, 2, size=0.1), wc.Sphere(radius=0.1, friction=friction)
    mesh = wc.Mesh(grid.points + np.array([-0.05, 0.105, -0.05]), grid.triangles)
    fields = {"terms": [wc.Spring(stiffness=1e-3)], "velocities": np.tile([0.0, -100.0, 0.0], (4, 1)), "colliders": [ball]}
    animation = wc.simulate(cloth(mesh, **fields, fps=960.0), wc.Explicit(substeps=20), device=device, frames=2)
    sine = np.sqrt(0.005) / (0.1 + 1e-4)
    expected = 100.0 * (sine - friction * np.sqrt(1.0 - sine**2))
    np.testing.assert_allclose(np.linalg.norm(animation.velocities[-1], axis=1), expected, rtol=0.02)


@sticky
@table(
    "law, tangent, mesh",
    [(float, 0.95 * 0.3, False), (Sticky, 0.45, False)],
    [(float, 0.95 * 0.3, False), (float, 0.95 * 0.3, True), (Sticky, 0.45, False)],
)
def test_a_sheet_sticks_to_a_slope(name, law, tangent, mesh, device):
    """Friction does not creep; explicit steps swing by ε = μN/(kA), springs of the outside law stretch by ρg sin θ/(ks)."""
    scene, _, down = incline(np.degrees(np.arctan(tangent)), law(0.3), duration=1.0)
    animation = run(scene, name, 60 if name == "explicit" else 2, device, mesh)
    along = ((animation.points - animation.points[0]) @ down).mean(axis=1)
    held, swings = ((0.3e-4 + EXTRA) / SOFTNESS, 1e-4) if law is Sticky else (0.3e-4, 0.3e-4)
    assert abs(along[-1] - along[30]) < (swings if name == "explicit" else 1e-9) and 0.0 < along[-1] < 20.0 * held


@each_solver
@table(
    "pressure, gap, mesh",
    [(147.15, 0.98529e-3, False), (14715.0, 0.16989e-3, False)],
    [(1.4715, 0.99985e-3, False), (147.15, 0.98529e-3, False), (14715.0, 0.16989e-3, False), (147.15, 0.98529e-3, True)],
)
def test_the_gap_under_a_pressure(name, pressure, gap, mesh, device):
    """r − p/k above half of r, r²k/(4p) below, at r = 1 mm and k = 1e7 Pa/m."""
    if name == "explicit" and pressure > 5e3:
        pytest.skip("explicit steps have the first of the two stages alone")
    start = gap if name == "explicit" else 1e-3  # what nothing damps does not come to rest
    contact = wc.Contact(distance=1e-3, stiffness=1e7)
    scene = sheet(start, contact=contact, gravity=(0.0, -pressure / DENSITY, 0.0), duration=0.25)
    animation = run(scene, name, 100 if name == "explicit" else 2, device, mesh)
    np.testing.assert_allclose(animation.points[-1][:, 1], gap, rtol=1e-3)
    assert animation.cut == 0.0


@pytest.mark.parametrize("gravity", (0.0, 1e-3))
@methods(
    # As users run them, with iterations that suffice.
    newton=wc.Newton(substeps=4),
    newton_bdf2=wc.Newton(substeps=4, integrator="bdf2"),
    newton_midpoint=wc.Newton(substeps=4, integrator="midpoint"),
    projective_dynamics=wc.ProjectiveDynamics(substeps=4),
    admm=wc.ADMM(substeps=4, iterations=500),
    xpbd=wc.XPBD(substeps=4),
    constrained_dynamics=wc.ConstrainedDynamics(substeps=4),
)
def test_a_pressure_holds_a_sheet_where_it_balances(solver, gravity, device, pressure=14.715, k=1e7, r=1e-3):
    """The gap r − p/k and the force pA, with hardly any gravity or none."""
    # x̃ is 0.7 mm deep in the plane, where contact gives 1e7 m/s², but the residual is relative to p/ρ. The stiffness k/ρ is
    # above the inertia 1/h², so that a residual of 1e-3 p/ρ leaves 1e-3 p/k at the most, and as much again of velocity from the
    # step before.
    fields = {"gravity": (0.0, -gravity, 0.0), "loads": [wc.Pressure(vertices="all", pressure=-pressure)], "duration": 0.2}
    scene = sheet(r - pressure / k, contact=wc.Contact(distance=r, stiffness=k), **fields)
    animation = wc.simulate(scene, solver, dtype="float64", device=device, record="reactions")
    whole = pressure + DENSITY * gravity
    np.testing.assert_allclose(r - animation.points[1:, :, 1], whole / k, rtol=2e-3)
    (force,) = animation.collider_forces.values()
    assert force[-1] == pytest.approx([0.0, -whole * 0.01, 0.0], rel=2e-3, abs=1e-12)
    assert animation.status.ok, animation.status.message


def bounce(name, rate, phase, device):
    """Speeds after an impact over that before, without gravity: ω = √(k/ρ), ωh = ``rate``, from d = r + ``phase`` steps."""
    h = 1.0 / 240.0
    omega = rate / h
    speed = 0.05 * omega * 1e-3 / max(rate, 1.0)
    fields = {"gravity": (0.0, 0.0, 0.0), "velocities": np.tile([0.0, -speed, 0.0], (9, 1)), "stiffness": 0.1}
    contact, duration = wc.Contact(distance=1e-3, stiffness=DENSITY * omega**2), np.ceil((8.0 / omega + 4.0 * h) * 60.0) / 60.0
    scene = sheet(1e-3 + phase * h * speed, contact=contact, duration=duration, **fields)
    return run(scene, name, 4, device).velocities[-1][:, 1].mean() / speed


@implicit
@table("rate, left", [(0.3, 0.63)], [(0.05, 0.92), (0.3, 0.63), (1.0, 0.25), (10.0, 0.01)])
def test_restitution_of_implicit_euler(name, rate, left, device):
    assert bounce(name, rate, 0.0, device) == pytest.approx(left, abs=0.005)


@table("rate", [0.3], [0.05, 0.3, 1.0])
@pytest.mark.parametrize("phase", (0.0, 0.3, 0.7))
def test_restitution_of_symplectic_euler(rate, phase, device):
    """Between √(1 − ω²h²/4) and its inverse, by the phase in which it enters."""
    least = np.sqrt(1.0 - 0.25 * rate**2)
    assert least - 1e-3 < bounce("explicit", rate, phase, device) < 1.0 / least + 1e-3


def tensions(capstan, points):
    """Of the belt at each edge, mean of both sides (…, edges) [N/m]."""
    threads = points.reshape(*points.shape[:-2], 2, -1, 3)
    lengths = np.linalg.norm(np.diff(threads, axis=-2), axis=-1).mean(axis=-2)
    rest = capstan.mesh.points[1, 0] - capstan.mesh.points[0, 0]
    return 2.0 * capstan.terms[0].stiffness * (lengths - rest) / np.ptp(capstan.mesh.points[:, 2])


BELTS = {"explicit": wc.Explicit(substeps=600), "newton": wc.Newton(substeps=1, linear="factorised")}
BELTS |= {"xpbd": wc.XPBD(substeps=150, iterations=10), "newton-triangles": BELTS["newton"]}


@table("name", ["explicit"], BELTS)
def test_a_belt_slides_over_a_drum(name, device, friction=0.3):
    """e^{μφ}, of which a belt of 12 edges differs by 0.6 %. The watch of energy knows that it is pressed on at the start."""
    mesh = name == "newton-triangles"
    capstan = scene("capstan", friction=friction, turns=12, duration=0.35 if mesh else 0.25)
    if mesh:
        drum = trimesh.creation.cylinder(radius=0.1, height=0.4, sections=512)
        points = drum.vertices[:, [1, 2, 0]] + [0.0, 0.05, 0.0]
        capstan = replace(capstan, colliders=[wc.MeshCollider(points, drum.faces, friction=friction)])
    animation = wc.simulate(capstan, BELTS[name], dtype="float64", device=device)
    found = tensions(capstan, animation.points[11:]).mean(axis=0)
    assert found[-1] / found[0] == pytest.approx(np.exp(np.pi * friction), rel=0.012 if mesh else 0.01)
    assert animation.status.ok if mesh else found[0] == pytest.approx(20.0, rel=0.01)


@SLOW
def test_a_belt_slides_over_a_polygon(device, friction=0.3):
    """The exact ratio at the vertices between the first and the last on the drum, to 1e-4 of all six of them."""
    capstan = scene("capstan", friction=friction, turns=8, speed=0.005, stretching=5e4, distance=1e-4, duration=0.5)
    solver = wc.Newton(substeps=2, tolerance=1e-5, linear="factorised")
    points = wc.simulate(capstan, solver, dtype="float64", device=device).points[16:]
    edges = np.diff(points[:, : points.shape[1] // 2], axis=1)
    turns, middle = np.diff(np.unwrap(np.arctan2(edges[..., 2], edges[..., 0])), axis=1), edges.shape[1] // 2
    inner = slice(middle - 3, middle + 3)  # vertex i + 1 is between the edges i and i + 1
    half, found = friction * np.tan(0.5 * turns[:, inner]), tensions(capstan, points)
    ratio = found[:, inner.stop] / found[:, inner.start] / np.prod((1.0 + half) / (1.0 - half), axis=1)
    assert (turns[:, inner] > 0.99 * np.pi / 8).all() and np.mean(ratio) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("softer", (1.0, 20.0))
def test_a_belt_presses_on_a_drum(softer, device):
    """T/R, to 1 %: an overlap of T/(Rk) where that is below r/2, beyond it the gap kr²R/(4T)."""
    capstan = scene("capstan", friction=0.0)
    contact = replace(capstan.contact, stiffness=capstan.contact.stiffness / softer)
    capstan = replace(capstan, contact=contact, pins=capstan.pins.vertices)
    points = wc.equilibrium(capstan, tolerance=1e-10, device=device).points
    edge = np.linalg.norm(points[0] - points[1])
    inner = points[:, 2] < -0.05
    turn = 2.0 * np.arcsin(0.5 * edge / np.linalg.norm(points[inner][:, [0, 2]], axis=1))
    radius, gaps = 0.5 * edge / np.sin(0.5 * turn), capstan.colliders[0].distances(points[inner])
    k, r, pressure = contact.stiffness, contact.distance, 20.0 / radius
    expected = r - pressure / k if softer == 1.0 else k * r**2 / (4.0 * pressure)
    np.testing.assert_allclose(r - gaps if softer == 1.0 else gaps, r - expected if softer == 1.0 else expected, rtol=0.01)


def critical(friction, radius, length=1.0):
    """The overhang of a limp sheet beyond the flat top at which it slips off a round edge [m], of any radius."""
    # Along the edge dT/dθ = μ(T + R cos θ) − R sin θ, with T over the weight per area, from μ times what lies on the top.

    def slope(at, T):
        return friction * (T + radius * np.cos(at)) - radius * np.sin(at)

    def pulls(over):
        along = solve_ivp(slope, (0.0, 0.5 * np.pi), [friction * (length - over)], rtol=1e-9)
        return over - 0.5 * np.pi * radius - along.y[0, -1]

    return brentq(pulls, 0.0, length)


OVER = {"explicit": wc.Explicit(substeps=200), "newton": wc.Newton(substeps=2, tolerance=1e-4)}


@methods("explicit", "newton", xpbd=wc.XPBD(substeps=20, iterations=10), **OVER)
def test_an_overhang_slips_or_sticks(solver, device):
    """One edge more than what the friction holds slips, one edge less sticks."""
    friction, elements, radius = 0.3, 40, 0.031
    m = friction * np.exp(0.5 * np.pi * friction)
    thin, held = m / (1.0 + m), critical(friction, radius)
    assert critical(friction, 1e-6) == pytest.approx(thin, rel=1e-4)
    for more, slips in ((-1.0, False), (1.0, True)):
        part = (held + more / elements) / thin
        overhang = scene("overhang", friction=friction, part=part, elements=elements, width=0.025, duration=0.4)
        points = wc.simulate(overhang, solver, dtype="float64", device=device).points
        moved = points[-1, :: elements + 1, 0].mean() - points[15, :: elements + 1, 0].mean()
        assert moved > 0.02 if slips else abs(moved) < 0.005, more


def deeper(solver, duration, device, **fields):
    """How deep the tip of a chain over an edge is in the end, over what it should be, a₀ cosh(t√(g/L))."""
    animation = wc.simulate(scene("chain_over_edge", duration=duration, **fields), solver, dtype="float64", device=device)
    assert animation.status.result is not Result.ITERATIONS_USED_UP, animation.status.message
    depths = animation.points[0, :, 1].max() - animation.points[:, -1, 1]
    return depths[-1] / (depths[0] * np.cosh(duration * np.sqrt(G)))


PD = wc.ProjectiveDynamics(substeps=4, integrator="bdf2", tolerance=1e-2, iterations=200, acceleration="l-bfgs")


@methods(
    *("projective_dynamics", "explicit", "xpbd"),
    explicit=wc.Explicit(substeps=300),
    newton=wc.Newton(substeps=4, integrator="bdf2", tolerance=1e-6),
    projective_dynamics=PD,
    xpbd=wc.XPBD(substeps=50, iterations=10),
)
def test_a_chain_slides_over_an_edge(solver, device):
    """To 0.5 %. At 100 N projective dynamics converges in each step; else the motion depends on rounding, and the processor."""
    assert deeper(solver, 0.7, device, links=30, stretching=100.0) == pytest.approx(1.0, abs=0.005)


@pytest.mark.slow
def test_a_chain_slides_over_an_edge_with_first_order(device):
    """Of steps of implicit Euler; links leave the rest."""
    found = [deeper(wc.Newton(substeps=2**k, tolerance=1e-6), 0.4, device, links=60) for k in (1, 2, 3)]
    assert (found[0] - found[1]) / (found[1] - found[2]) == pytest.approx(2.0, abs=0.2)


def beads_on_a_ball(friction):
    """Two beads joined by a spring that slide over the top of a ball, pressed in by their weight from the start."""
    radius, r, mass = 0.2, 1e-2, 0.01
    angles = np.array([0.05, 0.25])
    normal = np.stack([np.sin(angles), np.cos(angles), 0.0 * angles], axis=1)
    along = np.stack([np.cos(angles), -np.sin(angles), 0.0 * angles], axis=1)
    mesh, ball = wc.Mesh((radius + 0.9 * r) * normal, edges=[[0, 1]]), wc.Sphere(radius=radius, friction=friction)
    contact = wc.Contact(distance=r, stiffness=10.0 * mass * G / (2.0 * r * mesh.vertex_lengths[0]) / r)
    fields = {"terms": [wc.Spring(stiffness=5.0)], "velocities": 0.6 * along, "duration": 0.2}
    return wc.Scene(mesh, masses=[mass, mass], colliders=[ball], contact=contact, **fields)


@table(
    "integrator, friction, order",
    [(None, 0.0, 1), (None, 0.3, 1), ("midpoint", 0.0, 2)],
    [(None, 0.0, 1), (None, 0.3, 1), ("midpoint", 0.0, 2), ("bdf2", 0.0, 2), ("euler", 0.0, 1), ("euler", 0.3, 1)],
)
def test_order_of_convergence_on_a_curve(integrator, friction, order, device):
    """Contact keeps the order of the integrator; friction, whose N and n are lagged, has the first, and BDF2 a little more."""
    newton = wc.Newton(substeps=1, integrator=integrator or "euler", tolerance=1e-11, linear="factorised")
    solver = wc.Explicit(substeps=1) if integrator is None else newton
    steppers = [replace(solver, substeps=substeps) for substeps in ((32, 64, 128) if friction else (12, 24, 48))]
    runs = [wc.simulate(beads_on_a_ball(friction), each, device=device, dtype="float64").points for each in steppers]
    coarse, fine = (np.abs(one - other).max() for one, other in pairwise(runs))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.6 if friction else 0.25)


def borne(declared, points):
    """PR²/D of a ring on its first plate, and H/2R."""
    plate, contact, width = declared.colliders[0], declared.contact, np.ptp(declared.mesh.points[:, 1])
    pressure = contact.stiffness * np.maximum(contact.distance - plate.distances(points), 0.0)  # above r/2
    return (declared.mesh.vertex_areas * pressure).sum() / width * 0.1**2, np.ptp(points[:, 2]) / 0.2


@table("load", [4.0], [1.0, 2.0, 4.0])
def test_a_ring_bears_a_load_between_plates(load, device):
    """H of the load that it bears, to 0.5 %, and the load of H, to 1 %, touching along a line and flat."""
    declared, part = ring.scene(load, elements=64), ring.height(load)
    fixed, moving = declared.colliders
    plates = [fixed, replace(moving, position=moving.position[-1])]
    start = declared.mesh.points * [2.0 - part, 1.0, part] - [0.0, 0.0, 0.1 * (1.0 - part)]
    squeezed = replace(declared, colliders=plates, positions=start)
    rest = wc.equilibrium(squeezed, device=device)
    assert rest.status.ok
    found, high = borne(squeezed, rest.points)
    assert high == pytest.approx(ring.height(found), rel=5e-3)
    assert found == pytest.approx(brentq(lambda each: ring.height(each) - high, 0.1, 10.0), rel=0.01)


# The load, of 24 edges, which are wrong by 2 %, and half a second; and the errors of the load and of H.
COARSE = 2.0, {"elements": 24, "duration": 0.5}, (0.03, 2e-3)
RINGS = {
    **{f"{load}": (wc.Newton(substeps=2), load, {}, (5e-3, 2e-4)) for load in (0.5, 2.0, 8.0)},
    "newton": (wc.Newton(substeps=2), *COARSE),
    "explicit": (wc.Explicit(substeps=2500), *COARSE),
    "projective_dynamics": (wc.ProjectiveDynamics(substeps=1, tolerance=3.0, iterations=100), *COARSE),
    "xpbd": (wc.XPBD(substeps=200, iterations=10), *COARSE),
}


@table("name", ["2.0", "newton"], RINGS)
def test_a_ring_bears_its_load(name, device):
    """The load and H when a plate has pressed it, whether it touches along a line or lies flat on the plates."""
    solver, load, fields, errors = RINGS[name]
    declared = ring.scene(load, **fields)
    found, high = borne(declared, wc.simulate(declared, solver, dtype="float64", device=device).points[-1])
    assert found == pytest.approx(load, rel=errors[0]) and high == pytest.approx(ring.height(load), rel=errors[1])


def test_the_answers_of_a_ring():
    """The quadrature against elliptic integrals: where the ring begins to lie flat, and beyond."""
    assert [*map(ring.height, (1.0, 2.0, 2.786408))] == pytest.approx([0.9165281, 0.8132354, 0.717770], abs=1e-6)
    assert 4.0 * ring.height(4.0) ** 2 == pytest.approx(5.7421601 / 4.0, rel=1e-6)


@pytest.mark.parametrize(("soft", "gap", "held"), [(True, 1e-3, False), (False, 3e-3, True), (False, 1e-3, True)])
def test_pads_hold_what_they_pinch(soft, gap, held, device):
    """A sheet between two pads hangs on three vertices with the default k; 10 w/r lets it fall. Gaps of r/4 are named."""
    grid, r = wc.Mesh.grid(17, 17, size=0.3), 2e-3
    mesh = wc.Mesh(np.stack([grid.points[:, 0], -grid.points[:, 2], 0.0 * grid.points[:, 0]], axis=1), grid.triangles)
    pad, z = wc.Box(size=(0.06, 0.03, 0.02), friction=0.3), 0.01 + 0.5 * gap
    pads = [replace(pad, position=(0.15, -0.02, at), name=name) for name, at in (("front", z), ("back", -z))]
    contact = wc.Contact(distance=r, stiffness=10.0 * DENSITY * G / r if soft else None)
    scene = cloth(mesh, stiffness=300.0, bending=2e-5, colliders=pads, contact=contact)
    run = wc.simulate(scene, wc.Newton(substeps=4), frames=30, dtype="float64", device=device)
    assert run.status.grade is Grade.CONVERGED, run.status
    assert ("in frame 1 the gap to front falls below half the contact distance" in run.status.message) == (gap < r)
    pinched = (np.abs(mesh.points - [0.15, -0.02, 0.0]) < [0.03, 0.015, 1.0]).all(axis=1)
    slipped = np.abs(run.points[-1] - mesh.points)[pinched].max()
    assert pinched.sum() == 3 and (slipped < 1e-4 if held else slipped > 0.1)


def test_a_pressed_sheet_stays_at_rest(device):
    """A pressure p at r − p/k, predicted 3.8 m inside the plane. Vertices move by at most the tolerance times p h²/ρ."""
    case = random_case(416)
    moved = np.asarray(run_case(case, device)[0].points) - case.scene.positions
    reach = np.abs(case.scene.loads[0].force).max(axis=0).max() / case.scene.vertex_masses.max() / case.scene.fps**2
    assert case.dtype == "float32" and reach > 3.0 and np.abs(moved).max() < case.solver.tolerance * reach
