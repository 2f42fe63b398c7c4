"""Contact with colliders of closed form against known answers."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc

G, DENSITY = 9.81, 0.15
# Steps a frame are added; what is tested has little else that moves.
SOLVERS = {
    "explicit": wc.Explicit(substeps=1),
    "newton": wc.Newton(substeps=1, tolerance=1e-9),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-9, iterations=500),
    "xpbd": wc.XPBD(substeps=1, iterations=100),
    "admm": wc.ADMM(substeps=1, tolerance=1e-7, iterations=1000),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, tolerance=1e-9, iterations=100),
}
each_solver = pytest.mark.parametrize("name", SOLVERS)
sticky = pytest.mark.parametrize("name", [name for name in SOLVERS if name != "constrained dynamics"])
implicit = pytest.mark.parametrize("name", [name for name in SOLVERS if name != "explicit"])


def sheet(gap, collider=None, stiffness=1000.0, size=0.1, turn=None, **fields):
    """A square of nine vertices at a distance ``gap`` [m] above a plane, turned by a matrix with it."""
    grid = wc.Mesh.grid(3, 3, size=size)
    turn = np.eye(3) if turn is None else turn
    mesh = wc.Mesh((grid.points + np.array([0.0, gap, 0.0])) @ turn.T, grid.triangles)
    terms = [wc.Spring(stiffness=stiffness)]
    return wc.Scene(mesh, density=DENSITY, terms=terms, colliders=[collider or wc.Plane()], **fields)


def run(scene, name, substeps):
    return wc.simulate(scene, replace(SOLVERS[name], substeps=substeps), dtype="float64")


def incline(degrees, friction, duration=1.0):
    """A sheet at rest on a slope, pressed in by its weight, and the direction down the slope."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    plane = wc.Plane(normal=turn[:, 1], friction=friction)
    return sheet(1e-3 - 1e-4 * c, plane, turn=turn, duration=duration), turn[:, 0]


@sticky
@pytest.mark.parametrize("friction", (0.1, 0.3, 0.5))
def test_a_sheet_slides_down_a_slope(name, friction):
    """a = g(sin θ − μ cos θ), of the second half, when anchors are dragged along."""
    scene, down = incline(30.0, friction)
    animation = run(scene, name, 60 if name == "explicit" else 2)
    along = (animation.velocities @ down).mean(axis=1)
    expected = G * (0.5 - friction * np.sqrt(0.75))
    assert (along[-1] - along[30]) / 0.5 == pytest.approx(expected, rel=1e-4)


@sticky
def test_a_sheet_sticks_to_a_slope(name):
    """tan θ = 0.95 μ. Anchored friction does not creep; explicit steps swing about the anchor, and no farther than it holds."""
    scene, down = incline(np.degrees(np.arctan(0.95 * 0.3)), 0.3, duration=2.0)
    animation = run(scene, name, 60 if name == "explicit" else 2)
    along = ((animation.points - animation.points[0]) @ down).mean(axis=1)
    held = 0.3 * 1e-4  # ε = μN/(kA) with N = wA and w = k r/10
    assert abs(along[-1] - along[60]) < (held if name == "explicit" else 1e-9)
    assert 0.0 < along[-1] < 20.0 * held


@each_solver
@pytest.mark.parametrize("pressure, gap", ((1.4715, 0.99985e-3), (147.15, 0.98529e-3), (14715.0, 0.16989e-3)))
def test_the_gap_under_a_pressure(name, pressure, gap):
    """r − p/k above half of r, r²k/(4p) below, at r = 1 mm and k = 1e7 Pa/m."""
    if name == "explicit" and pressure > 5e3:
        pytest.skip("explicit steps have the first of the two stages alone")
    contact, gravity = wc.Contact(distance=1e-3, stiffness=1e7), (0.0, -pressure / DENSITY, 0.0)
    start = gap if name == "explicit" else 1e-3  # what nothing damps does not come to rest
    scene = sheet(start, contact=contact, gravity=gravity, duration=0.25)
    animation = run(scene, name, 100 if name == "explicit" else 2)
    np.testing.assert_allclose(animation.points[-1][:, 1], gap, rtol=1e-3)
    assert animation.cut == 0.0


RESTITUTION = {0.05: 0.92, 0.3: 0.63, 1.0: 0.25, 10.0: 0.01}


def bounce(name, rate, phase):
    """Speeds after an impact over that before, without gravity: ω = √(k/ρ), ωh = ``rate``, from d = r + ``phase`` steps."""
    h = 1.0 / 240.0
    omega = rate / h
    speed = 0.05 * omega * 1e-3 / max(rate, 1.0)
    contact = wc.Contact(distance=1e-3, stiffness=DENSITY * omega**2)
    velocities = np.tile([0.0, -speed, 0.0], (9, 1))
    frames = int(np.ceil((8.0 / omega + 4.0 * h) * 60.0))
    scene = sheet(
        1e-3 + phase * h * speed,
        contact=contact,
        gravity=(0.0, 0.0, 0.0),
        velocities=velocities,
        duration=frames / 60.0,
        stiffness=0.1,
    )
    animation = run(scene, name, 4)
    return animation.velocities[-1][:, 1].mean() / speed


@implicit
@pytest.mark.parametrize("rate", RESTITUTION)
def test_restitution_of_implicit_euler(name, rate):
    assert bounce(name, rate, 0.0) == pytest.approx(RESTITUTION[rate], abs=0.005)


@pytest.mark.parametrize("rate", (0.05, 0.3, 1.0))
@pytest.mark.parametrize("phase", (0.0, 0.3, 0.7))
def test_restitution_of_symplectic_euler(rate, phase):
    """Between √(1 − ω²h²/4) and its inverse, by the phase in which it enters."""
    least = np.sqrt(1.0 - 0.25 * rate**2)
    assert least - 1e-3 < bounce("explicit", rate, phase) < 1.0 / least + 1e-3
