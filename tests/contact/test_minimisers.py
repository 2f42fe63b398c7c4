"""Solvers that minimise end a step with contact at one point, with colliders, meshes, other cloth, friction and locked axes."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support.layers import GRAVITY, cloth, ground, layers, rubbing, stack
from support.rows import table
from support.steps import after_frames
from warpcloth.core.energy import Energy
from warpcloth.core.status import Result

R = 1e-3
SLOW = pytest.mark.slow


def stretched(gravity, friction):
    """A sheet in tension over a ball and on a plane. Contact alone would move a vertex beyond the middle of the ball."""
    grid = wc.Mesh.grid(8, 8, size=0.5)
    x, _, z = grid.points.T
    height = np.sqrt(np.maximum(0.2004**2 - (x - 0.25) ** 2 - (z - 0.25) ** 2, 0.0)) - 0.2
    ball = wc.Sphere(radius=0.2, position=(0.25, -0.2, 0.25), friction=friction)
    colliders = [ball, wc.Plane(position=(0.0, -0.15, 0.0), friction=friction)]
    fields = {"colliders": colliders, "contact": wc.Contact(distance=R, stiffness=1.47e4), "gravity": (0.0, -gravity, 0.0)}
    fields["positions"] = np.stack([x, np.maximum(height, -0.1494), z], axis=1)
    mesh = wc.Mesh(0.8 * grid.points, grid.triangles)
    return cloth(mesh, stiffness=20.0, velocities=np.tile([0.3, -0.2, 0.1], (64, 1)), **fields)


def roofed(gravity, friction):
    """A sheet in tension on a flat roof with two edges, where it slides by 3 mm."""
    # Over many edges, and from 300 m/s² on, φ has several minima.
    grid, slope = wc.Mesh.grid(8, 8, size=0.5), 0.1
    x, _, z = grid.points.T
    top, foot = 0.5 / 7.0 * 1.5, 1.0

    def height(x):
        return -slope * np.maximum(np.abs(x - 0.25) - top, 0.0)

    corners = [(0.25 + side, height(0.25 + side), end) for side in (-foot, -top, top, foot) for end in (-0.2, 0.7)]
    roof = trimesh.convex.convex_hull(corners)
    colliders = [wc.MeshCollider(roof.vertices, roof.faces, friction=friction)]
    colliders.append(wc.Plane(position=(0.0, height(0.0), 0.0), friction=friction))
    mesh, positions = wc.Mesh(0.99 * grid.points, grid.triangles), [x, height(x) + 0.4 * R * np.hypot(1.0, slope), z]
    return replace(stretched(gravity, friction), mesh=mesh, positions=np.stack(positions, axis=1), colliders=colliders)


def valley():
    """As :func:`rubbing`, but folded along the middle, at edges of 1.5 r, so that some vertices lie over a valley."""
    mesh = stack(2, 4, 0.09, turn=0.3, pattern="alternating")
    points = mesh.points.copy()
    points[:, 1] = 0.5 * np.abs(points[:, 0]) + np.where(np.arange(32) < 16, 0.0, 0.012)
    contact = wc.SelfContact(distance=0.02, stiffness=1e3, friction=0.3)
    return replace(rubbing(), mesh=wc.Mesh(points, mesh.triangles), positions=points, self_contact=contact)


PAIR = partial(layers, n=4, turn=17.0)
AXES = np.ones((32, 3), dtype=bool)
AXES[::3, 0] = AXES[::5, 1] = False
# Scenes and the number of steps: sheets that slide over colliders, or stick at a friction of 30; that press one another in both
# stages of φ, all at a tenth of r, which ends at ten times that, and held at r/60; and that rub.
COLLIDERS = {
    "slides": (partial(stretched, 981.0, 0.3), 1),
    "sticks": (partial(stretched, 981.0, 30.0), 1),
    "without friction": (partial(stretched, 300.0, 0.0), 1),
    "roof": (partial(roofed, 250.0, 0.3), 1),
}
PRESSED = {
    "both stages": (partial(PAIR, gap=2.2e-3), 1),
    "flung apart": (partial(PAIR, gap=5e-4), 1),
    "deep": (partial(PAIR, gap=1e-4, shrink=0.6, stiffness=1e3, speed=0.3), 1),
}
LOCKED = {"locked axes": (partial(PAIR, gap=2.2e-3, free_axes=AXES), 1)}
RUBBING = {"rubs at 4 mm": (partial(rubbing, 4e-3), 3), "rubs at 2.2 mm": (rubbing, 3), "rubs over a valley": (valley, 3)}
SCENES = COLLIDERS | PRESSED | LOCKED | RUBBING

# As exact as they come, in steps of a frame of 1/60 s, and ten in one of 1/24 s.
OF_COLLIDERS = {
    "newton": wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"),
    "newton_clamp": wc.Newton(substeps=1, tolerance=1e-12, hessian="clamp"),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-8, iterations=1000),
    "xpbd": wc.XPBD(substeps=1, iterations=30_000),
    "admm": wc.ADMM(substeps=1, tolerance=1e-9, iterations=20_000),
    "constrained": wc.ConstrainedDynamics(substeps=1, tolerance=1e-9, iterations=60, linear="factorised"),
    # Without acceleration it takes hundreds of iterations, which differ by one kernel.
    "projective_dynamics_none": wc.ProjectiveDynamics(substeps=1, tolerance=1e-8, iterations=3000, acceleration="none"),
}
SEARCHING = wc.ConstrainedDynamics(substeps=10, stabilisation="line-search", linear="factorised")
OF_CLOTH = {
    "newton": wc.Newton(substeps=10, tolerance=1e-13),
    "newton_factorised": wc.Newton(substeps=10, tolerance=1e-13, linear="factorised"),
    "xpbd": wc.XPBD(substeps=10, iterations=4000),
    "xpbd_jacobi": wc.XPBD(substeps=10, iterations=10_000, sweep="constraint-averaged"),
    "admm": wc.ADMM(substeps=10, tolerance=1e-8, iterations=1000),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=10, tolerance=1e-11, iterations=500),
    "constrained": wc.ConstrainedDynamics(substeps=10, tolerance=1e-8, iterations=500),
    "constrained_search": replace(SEARCHING, tolerance=1e-8, iterations=200),
    "projective_dynamics_none": wc.ProjectiveDynamics(substeps=10, tolerance=1e-12, iterations=2000, acceleration="none"),
}
ALL_OF_COLLIDERS = [name for name in OF_COLLIDERS if name not in ("newton", "projective_dynamics_none")]
ALL_OF_CLOTH = [name for name in OF_CLOTH if name != "newton"]
WITH_FRICTION = [name for name in ALL_OF_CLOTH if name not in ("constrained_search", "projective_dynamics_none")]


@cache
def end(what, name, device):
    """Where the last step of a solver ends; no vertex is cut, and what is pressed, rubs or is locked does so."""
    make, steps = SCENES[what]
    scene, solver = make(), (OF_COLLIDERS if what in COLLIDERS else OF_CLOTH)[name]
    stepper = after_frames(scene, solver, steps=steps, device=device, dtype="float64")
    x = stepper.state.x.numpy().copy()
    assert stepper.cut == 0.0 and np.abs(x - scene.positions).max() > (1e-4 if what in LOCKED else 1e-5)
    assert scene.free_axes is None or (x == scene.positions)[~scene.free_axes].all()
    if what in COLLIDERS and name == "newton":
        gaps = np.min([collider.distances(x) for collider in scene.colliders], axis=0)
        assert (gaps < R).sum() > (50 if what == "roof" else 30) and gaps.min() < R / 10.0
        assert stepper.results[0] in (Result.CONVERGED, Result.ROUNDED)
    if what in RUBBING:
        contact = stepper.pairs.contact
        signs = contact.data.stiffness.numpy()[: contact.pairs.number.numpy()[0]]
        assert (signs > 0.0).sum() > 10 and (signs < 0.0).any() == (what == "rubs over a valley")
        assert (stepper.pairs.friction.data.limit.numpy() > 0.0).sum() > 10
    return x


@table(
    "what, name",
    [
        *(("slides", name) for name in ("newton_clamp", "xpbd")),
        ("roof", "newton_clamp"),
        *(("both stages", name) for name in ("newton_factorised", "admm", "projective_dynamics", "constrained")),
        *(("locked axes", name) for name in ("newton_factorised", "constrained")),
        *(("rubs at 2.2 mm", name) for name in ("newton_factorised", "admm")),
        *(("rubs over a valley", name) for name in ("xpbd", "admm", "constrained")),
    ],
    [
        *((what, name) for what in COLLIDERS for name in ALL_OF_COLLIDERS),
        ("slides", "projective_dynamics_none"),
        *((what, name) for what in (*PRESSED, *LOCKED) for name in ALL_OF_CLOTH),
        *((what, name) for what in RUBBING for name in WITH_FRICTION),
    ],
)
def test_minimiser_is_the_same(what, name, device):
    """As that of Newton's method to 1e-8 m, at gaps down to r/60, deep in the logarithm."""
    assert end(what, name, device) == pytest.approx(end(what, "newton", device), abs=1e-8)


@table("name", ["newton_clamp", "xpbd", "admm"], ["newton_clamp", "xpbd", "admm", "projective_dynamics", "constrained"])
def test_minimiser_is_the_same_as_far_as_float32_allows(name, device):
    """0.5 m are known to 3e-8 m, a gap of r/45 and its force to 1.4e-3: 4e-4 m of the 0.27 m that gravity moves in the step."""
    iterations = {"newton_clamp": 100, "projective_dynamics": 100, "xpbd": 1000, "admm": 300, "constrained": 40}[name]
    newton, rough, ends = OF_COLLIDERS["newton"], replace(OF_COLLIDERS[name], iterations=iterations), []
    for solver, dtype in ((newton, "float64"), (newton, "float32"), (rough, "float32")):
        stepper = after_frames(stretched(981.0, 0.0), solver, steps=1, device=device, dtype=dtype)
        ends.append(stepper.state.x.numpy())
        assert dtype == "float32" or (stepper.cut == 0.0 and stepper.results[0] in (Result.CONVERGED, Result.ROUNDED))
    exact, *rounded = ends
    assert np.abs(np.array(rounded) - exact).max() < 4e-4


@table("acceleration", ["l-bfgs"], ["chebyshev", "anderson", "l-bfgs"])
def test_iterations_of_projective_dynamics_lower_the_objective(acceleration, device):
    """φ = ‖d‖²_M/2h² + U, deep in contact, where rough solutions alone raise it; to the rounding that a `Search` takes, √ε."""
    solver = wc.ProjectiveDynamics(substeps=1, iterations=40, tolerance=1e-12, acceleration=acceleration)
    stepper = after_frames(stretched(981.0, 0.3), solver, device=device, dtype="float64")
    energy_of, energy = Energy(stepper.model, stepper.sums, corrected=True), stepper.model.scalars()
    measure, found = stepper.measure, []

    def note():
        d = stepper.correction.numpy()
        energy.zero_()
        energy_of.add(stepper.state.x, energy, stepper.correction)
        found.append(energy.numpy()[0] + 0.5 * (stepper.model.mass.numpy()[:, None] * d**2).sum() / stepper.h**2)
        return measure()

    stepper.measure = note
    stepper.step()
    assert len(found) == 41 and (np.diff(found) <= 1.5e-8 * np.abs(found[:-1])).all() and found[-1] < 1e-3 * found[0]


@pytest.mark.host
@table("substeps", [4], [1, 4])
def test_a_sphere_that_moves_carries_two_sheets(substeps, device):
    """By 50 contact distances a frame: all steps converge, at the strain of explicit steps to the first order of h, 5 %."""
    frames, corners = 8, [0, 7, 56, 63]
    scene = layers(n=8, gap=5e-3, size=0.45, turn=20.0)
    way = np.tile(scene.positions.mean(axis=0) + np.array([0.03, 0.0, 0.0]), (frames + 1, 1))
    way[:, 1] = -0.13 + 1.3 / 24.0 * np.arange(frames + 1)
    contacts = {"contact": wc.Contact(distance=1e-3), "self_contact": wc.SelfContact(distance=1e-3, friction=0.3)}
    fields = {"colliders": [wc.Sphere(radius=0.115, position=way, friction=0.3)], "pins": corners, **contacts}
    scene = replace(scene, velocities=None, gravity=(0.0, -GRAVITY, 0.0), duration=frames / 24.0, **fields)
    solvers = wc.Newton(substeps=substeps), wc.Explicit(substeps=400)
    found, other = (wc.simulate(scene, solver, device=device, dtype="float64") for solver in solvers)
    assert found.status.result is Result.CONVERGED and found.status.ok, found.status.message
    assert found.worst_strain == pytest.approx(other.worst_strain, rel=0.05)


def above(corner, height, collider, **fields):
    """A sheet above a collider, with its first corner at (corner, height, corner)."""
    contact, sheet = wc.Contact(distance=3e-3, stiffness=1.5e4), wc.Mesh.grid(5, 5, size=0.25)
    at = sheet.points + np.array([corner, height, corner])
    return cloth(sheet, bending=1e-4, positions=at, colliders=[collider], contact=contact, fps=24.0, **fields)


@pytest.mark.parametrize("of_mesh", [False, True])
def test_a_slope_below_the_tolerance_moves_cloth(of_mesh, device):
    """½g tan θ t² without friction, but for the first of 48 steps, 1 − (47/48)², where the tolerance is 2g tan θ."""
    below = ground(4.0, 3) if of_mesh else wc.Plane()
    scene = above(-0.125, 2.9e-3, below, gravity=(5e-4 * GRAVITY, -GRAVITY, 0.0))
    stepper = after_frames(scene, wc.Newton(substeps=1, tolerance=1e-3), 48, dtype="float64", device=device)
    way = stepper.state.x.numpy()[:, 0].mean() - scene.positions[:, 0].mean()
    assert way == pytest.approx(0.5 * 5e-4 * GRAVITY * 2.0**2, rel=1.0 - (47.0 / 48.0) ** 2)


def test_a_step_far_from_colliders_is_as_at_first(device):
    """After a reset, a sheet that had touched a plane takes no iteration in free fall, and has the bits of its first step."""
    scene, found = above(0.0, 0.05, wc.Plane()), []
    stepper = after_frames(scene, wc.Newton(substeps=4), dtype="float64", device=device)
    for frames in (12, 0):
        stepper.step()
        found.append((stepper.minimiser.iterations, stepper.state.x.numpy()))
        for _ in range(frames):
            stepper.frame()
        stepper.reset()
    assert found[0][0] == found[1][0] == 0 and np.array_equal(found[0][1], found[1][1])


@pytest.mark.parametrize("linear", ["cg", "factorised"])
def test_a_descent_ends_where_lists_have_lost_pairs(linear, device):
    """The step will be repeated; without, a descent went on to its last iteration."""
    solver = wc.Newton(substeps=10, tolerance=1e-13, linear=linear)
    stepper = after_frames(PAIR(gap=2.2e-3), solver, steps=1, device=device, dtype="float64")
    minimiser, listed = stepper.minimiser, stepper.pairs.most_listed
    minimiser.minimise(1e-13, 10, minimiser.scale)
    assert minimiser.iterations > 1
    listed.fill_(len(stepper.pairs.pairs.stencils) + 1)
    minimiser.minimise(1e-13, 10, minimiser.scale)
    assert minimiser.iterations == 1
