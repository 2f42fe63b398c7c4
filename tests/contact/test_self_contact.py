"""Contact of cloth with itself: its forces, its rests, and that no step ends with cloth that went through cloth."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
import trimesh
import warp as wp

import warpcloth as wc
from support.contacts import begin, energy, gradient, hessian_times, pairs_of, slope_of
from support.crossings import crossed
from support.judges import barrier_slope
from support.layers import DENSITY, GRAVITY, cloth, folded, ground, layers, positions, rubbing, slope
from support.rows import table
from support.scenes import scene
from support.steps import after_frames
from warpcloth.contact.proximity import ROUND
from warpcloth.contact.self_start import crossings
from warpcloth.core.status import Result
from warpcloth.scenes import drape, knot, loop

SLOW = pytest.mark.slow
SOLVERS = {
    "explicit": wc.Explicit(substeps=80),
    "newton": wc.Newton(substeps=2, iterations=30),
    "xpbd": wc.XPBD(substeps=4, iterations=10),
    "pbd": wc.PBD(substeps=4, iterations=10),
    "hierarchical_pbd": wc.HierarchicalPBD(substeps=4, iterations=10),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=2, iterations=20),
    "admm": wc.ADMM(substeps=2, iterations=20),
    "newton_factorised": wc.Newton(substeps=2, iterations=30, linear="factorised"),
    "constrained_dynamics": wc.ConstrainedDynamics(substeps=2, iterations=3),
    "xpbd_jacobi": wc.XPBD(substeps=4, iterations=10, sweep="constraint-averaged"),
    "pbd_jacobi": wc.PBD(substeps=4, iterations=10, sweep="vertex-averaged"),
}
# One that is explicit, one that minimises and one that sweeps, for what contact does alike for all.
FEW = ("explicit", "newton", "xpbd")
each_solver = table("name", FEW, SOLVERS)
few_solvers = pytest.mark.parametrize("name", FEW)
SOFT = wc.Contact(stiffness=1e4)


def contacts_at(pairs, x):
    """F·n and kAφ″ of all keys at x, 0 without contact, their n and weights, and their stencils."""
    pairs.forces.launch(pairs.model.array(x, pairs.model.vec3))
    found, forces, n = pairs.contact, pairs.contact.forces, pairs.contact.data.normal.numpy().copy()
    keys = found.pairs.keys.numpy()[: found.pairs.number.numpy()[0]]
    pull, share = (forces.force.numpy() * n).sum(axis=1), np.maximum(found.data.share.numpy(), 1e-300)
    along = np.einsum("ei,eij,ej->e", n, forces.definite.numpy(), n)
    bend = np.where(found.data.stiffness.numpy() > 0.0, along / share, 0.0)
    values = pull, bend, n, found.data.weights.numpy(), found.pairs.stencils.numpy()
    by_key = [np.zeros((len(found.pairs.slots), *each.shape[1:]), each.dtype) for each in values]
    for each, of_slots in zip(by_key, values, strict=True):
        each[keys] = of_slots[: len(keys)]
    return by_key


@pytest.mark.parametrize(("bounded", "gap", "least"), [*product((False, True), (4e-3, 1.2e-3), [0.0]), (False, 1.2e-3, 1e-3)])
def test_forces_are_the_gradient_and_balance(bounded, gap, least, device):
    """By central differences to O(η²); ΣF = 0, Σ x × F = 0 to rounding; along p, kAφ′ of a vertex grows by kAφ″ Σ wᵢn·pᵢ."""
    scene, rng, eta = layers(turn=17.0, gap=gap), np.random.default_rng(1), 1e-7
    pairs, x = pairs_of(scene, device, bounded), scene.positions + 2e-4 * rng.normal(size=scene.positions.shape)
    pairs.contact.least = least
    begin(pairs, x)
    force = gradient(pairs, x)
    size, of_vertices = np.abs(force).sum(), np.ones(len(pairs.contact.pairs.slots), dtype=bool)
    assert size > 1.0
    of_vertices[slice(*np.cumsum(pairs.proximity.counts.numpy()))] = False
    for _ in range(3):
        direction = rng.normal(size=x.shape)
        (after, *_, w1, s1), (before, *_, w0, s0) = (contacts_at(pairs, x + each * direction) for each in (eta, -eta))
        _, bend, n, w, stencils = contacts_at(pairs, x)
        same = of_vertices & (after != 0.0) & (before != 0.0) & (bend > 0.0)
        for weights, each in ((w1, s1), (w0, s0)):
            same &= ((weights != 0.0) == (w != 0.0)).all(axis=1) & (each == stencils).all(axis=1)
        growth = bend * np.einsum("ei,ej,eij->e", w, n, direction[stencils])
        assert same.sum() > 20
        assert ((after - before) / (2.0 * eta))[same] == pytest.approx(growth[same], abs=1e-4 * bend.max())
        assert slope_of(energy, pairs, x, direction, eta) == pytest.approx((force * direction).sum(), abs=1e-5 * size)
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-13 * size


@pytest.mark.parametrize(("gap", "turn"), [(4e-3, 17.0), (1e-3, 17.0), (1e-4, 17.0), (1e-3, 0.0)])
@pytest.mark.parametrize("move", ["any", "sliding"])
def test_the_matrix_is_the_derivative_of_the_forces(gap, turn, move, device):
    """By central differences over η, with errors of (pη/d)² and, by rounding of x, ε‖H‖x/η; also of sheets that slide."""
    # Below r/4 = 1.25 mm edges act too, without a turn nearly parallel ones. With fixed weights and normals nothing resists
    # sliding.
    scene, rng, eta = layers(turn=turn, gap=gap), np.random.default_rng(1), 1e-5 * gap
    x, pairs = scene.positions + 0.1 * gap * rng.normal(size=scene.positions.shape), pairs_of(scene, device)
    begin(pairs, x)
    p = rng.normal(size=x.shape) if move == "any" else np.arange(len(x))[:, None] // 36 * [1.0, 0.0, 0.3]
    expected, (found, hessian) = slope_of(gradient, pairs, x, p, eta), hessian_times(pairs, x, p)
    dense = ((hessian.matrix() + hessian.coupling()) @ p.ravel()).reshape(-1, 3)
    rounding = np.finfo(float).eps * np.abs(hessian.values.numpy()).max()
    assert found == pytest.approx(dense, abs=1e2 * rounding)
    assert found == pytest.approx(expected, abs=1e-7 * np.abs(expected).max() + rounding * np.abs(x).max() / eta)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_pressure_of_a_stack(count, device, r=5e-3, k=1e5, d=1.3e-3):
    """p = Σ m f(m d) on the top layer over all layers within r, f = −kφ′."""
    scene = layers(count, gap=d, distance=r, stiffness=k)
    top = -gradient(pairs_of(scene, device), scene.positions)[-36:, 1].sum() / 0.25
    gaps = d * np.arange(1, count)
    assert top == pytest.approx(k * barrier_slope(gaps, r).sum(), rel=1e-9)


EXACT = wc.Newton(substeps=10, tolerance=1e-13, linear="factorised")
REBOUNDING = {"explicit": wc.Explicit(substeps=80), "midpoint": replace(EXACT, integrator="midpoint")}
REBOUNDING |= {"newton": EXACT, "xpbd": wc.XPBD(substeps=10, iterations=4)}


@pytest.mark.parametrize("name", REBOUNDING)
def test_momentum_is_kept(name, device):
    """Σp of two sheets that rebound with no vertex cut; ΣL by explicit steps and midpoint. To rounding, and 1e-13 of a step."""
    # Euler's implicit steps, d ← (d + hḋ + Kr)/(1 + K) within r with K = 2kh²/ρ = 23, leave flat sheets 5 mm/s each of 0.2 m/s.
    scene, turns = layers(n=4, turn=17.0, gap=6e-3, speed=0.2), name in ("explicit", "midpoint")
    stepper = after_frames(scene, REBOUNDING[name], 3, device=device, dtype="float64")
    x, v = (array.numpy() for array in stepper.state)
    assert stepper.cut == 0.0 and v[16:, 1].mean() > (0.01 if turns else 5e-3)  # they fly apart
    mass = scene.vertex_masses[:, None]
    size = (mass * np.abs(scene.velocities)).sum()
    assert (mass * v).sum(axis=0) == pytest.approx((mass * scene.velocities).sum(axis=0), abs=1e-12 * size)
    if turns:
        angular = [(mass * np.cross(*each)).sum(axis=0) for each in ((scene.positions, scene.velocities), (x, v))]
        assert angular[1] == pytest.approx(angular[0], abs=1e-11 * size)


LOOPS = [("pear", 0.0, 0.424308, 1e-3), ("ring", 0.0, 0.318310, 1e-3), ("heart", 0.0, 0.133860, 2e-3)]
HEAVY = [("heart", 10.0, 0.139540, 4e-3), ("heart", 100.0, 0.184043, 4e-3), ("heart", 400.0, 0.275445, 4e-3)]


@pytest.mark.host
@table("kind, gamma, depth, error", LOOPS + HEAVY[:2], LOOPS + HEAVY)
def test_hanging_loops_are_elastica(kind, gamma, depth, error, device):
    """Depth over length, by shooting; the ends come as near as the contact distance, L/2000, and loops spread from there."""
    rest = wc.equilibrium(loop.scene(kind=kind, gamma=gamma, length=1.0), device=device)
    assert rest.status.ok and rest.stable, rest.status
    assert -rest.points[:, 1].min() == pytest.approx(depth, rel=error)


@pytest.mark.host
@table("dtype, mesh", [("float64", False)], [("float32", False), ("float64", False), ("float64", True)])
def test_a_stack_rests(dtype, mesh, device):
    """Gaps of 12 sheets on a floor that move up and down only: all within r press on one another, in both stages of φ."""
    stack = scene("stack", sheets=12, n=4, friction=0.0)
    r = stack.self_contact.distance
    k = 10.0 * DENSITY * GRAVITY / r
    soft = {"contact": replace(stack.contact, stiffness=k), "self_contact": replace(stack.self_contact, stiffness=k)}
    stack = replace(stack, free_axes=np.tile([False, True, False], (12 * 16, 1)), **soft)
    if mesh:
        stack = replace(stack, colliders=[ground(2.0, name="floor")])
    rest = wc.equilibrium(stack, device=device, dtype=dtype, record=("energies", "reactions"))
    assert rest.status.ok and rest.stable, rest.status
    high = rest.points[:, 1].reshape(12, 16)
    at = np.concatenate([[0.0], high.mean(axis=1)])
    apart = at[:, None] - at
    d = np.where(apart == 0.0, r, np.abs(apart))
    # Contact with the floor is as stiff.
    pushes = k * np.sign(apart) * barrier_slope(d, r)
    # float32 rounds positions of 13 mm by 1e-9 m, a force of kε.
    tolerance = 1e-6 if dtype == "float64" else 5e-3
    assert pushes[1:].sum(axis=1) == pytest.approx(np.full(12, DENSITY * GRAVITY), rel=tolerance)
    assert np.diff(at).min() < 0.45 * r and np.diff(at).max() > 0.5 * r
    assert np.ptp(high, axis=1).max() < tolerance * r and rest.energies["self-contact"] > 0.0
    assert rest.collider_forces["floor"][1] == pytest.approx(-GRAVITY * stack.vertex_masses.sum(), rel=tolerance)


@pytest.mark.host
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_sheet_rests_far_from_the_origin(dtype, device):
    """At 50 m, in float64 where it does at the origin: φ bears the weight at a third of r."""
    # In float32 the least gap f is 6 units in the last place, and ψ, which begins at 2f = 0.72 r, bears most of it above r/2.
    r, k, w = 1e-4, 2e4, DENSITY * GRAVITY
    two = layers(n=4, gap=0.9 * r, distance=r, stiffness=k, gravity=(0.0, -GRAVITY, 0.0), pins=np.arange(16))
    two = replace(two, positions=two.positions + np.array([0.0, 50.0, 0.0]), free_axes=np.tile([False, True, False], (32, 1)))
    rest = wc.equilibrium(two, device=device, dtype=dtype)
    assert rest.status.ok and rest.stable, rest.status
    d = rest.points[16:, 1].astype(float) - rest.points[:16, 1]
    if dtype == "float64":
        assert k * r * r / (4.0 * d) == pytest.approx(np.full(16, w), rel=1e-6)
        return
    f, ulp = 6.0 * 2.0**-23 * two.positions.max(), np.spacing(np.float32(50.0))
    assert 0.5 * r < d.min() and d.max() < 2.0 * f
    to_f = 2.0 - d / f
    steepness = k * (1.0 + 50.0 * r * r * to_f / f**2)
    assert k * (r - d + 25.0 * r * r * to_f**2 / f) == pytest.approx(np.full(16, w), abs=(ulp * steepness).max())


def test_impact_far_from_the_origin_in_float32(device, n=24, edge=4e-3, far=4.0):
    """Strains are those of float64 but for the rounding of positions, ½ulp at each end and axis, in flight and after impact."""
    length = edge * (n - 1)
    mesh, radius, distance = wc.Mesh.grid(n, n, size=length, pattern="alternating"), 0.3 * length, 0.4 * edge
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)]
    positions = mesh.points + np.array([far - 0.5 * length, 2.0 * radius + 2.0 * distance, far - 0.5 * length])
    ball = wc.Sphere(radius=radius, position=(far, radius, far), friction=0.3)
    contacts = {"contact": wc.Contact(distance=distance), "self_contact": wc.SelfContact(distance=distance, friction=0.3)}
    scene = cloth(mesh, terms=terms, positions=positions, colliders=[ball], **contacts)
    run = partial(wc.simulate, scene, wc.Newton(substeps=4), frames=4, device=device)
    found = [run(dtype=dtype) for dtype in ("float32", "float64")]
    ends = [np.asarray(each.points, dtype=np.float64)[:, mesh.edges] for each in found]
    strains = [np.linalg.norm(x[:, :, 1] - x[:, :, 0], axis=2) / mesh.edge_lengths - 1.0 for x in ends]
    assert np.abs(strains[1][-1]).max() > 1e-3
    assert np.percentile(np.abs(strains[0] - strains[1]), 99) < np.sqrt(3.0) * np.spacing(np.float32(far)) / edge
    assert not any(crossed(each.points[-1], mesh.triangles) for each in found)


@pytest.mark.host
def test_pins_that_cloth_holds_back(device):
    """Pins that are to go through a sheet: the rest is not called an equilibrium."""
    two = layers(turn=17.0, gap=0.02, n=4)
    keyframes = np.tile(two.positions, (2, 1, 1))
    keyframes[1, :16, 1] += 0.1
    rest = wc.equilibrium(replace(two, pins=wc.Pins(np.arange(32), keyframes)), iterations=20, device=device)
    assert rest.status.result is Result.ITERATIONS_USED_UP and not rest.stable and rest.points[:16, 1].max() < 0.02


def borders(n):
    """The vertices at the borders of two sheets of n² vertices."""
    sheet = np.arange(n * n).reshape(n, n)
    border = np.setdiff1d(sheet, sheet[1:-1, 1:-1])
    return np.concatenate([border, n * n + border])


@table("name, rise", [("xpbd", 0.06), ("pbd", 0.06), ("admm", 0.6)], [*product(SOLVERS, (0.06, 0.6)), ("midpoint", 0.06)])
def test_pins_that_pinned_cloth_holds_back(name, rise, device):
    """A border is to go through the pinned border of another sheet, at 0.24 or 2.4 m/s: it is held, and nothing is thrown."""
    two, held = layers(turn=17.0, gap=0.01, stiffness=1e4), borders(6)
    keyframes = np.tile(two.positions[held], (7, 1, 1))
    keyframes[:, :20, 1] += np.linspace(0.0, rise, 7)[:, None]
    solver = wc.Newton(substeps=2, integrator="midpoint") if name == "midpoint" else SOLVERS[name]
    stepper = after_frames(replace(two, pins=wc.Pins(held, keyframes)), solver, device=device, dtype="float64")
    for x in positions(stepper, 6):
        assert np.linalg.norm(stepper.state.v.numpy(), axis=1).max() < 1.0 and crossed(x, two.mesh.triangles) == 0
    assert stepper.pairs.pins_held[0].farthest == pytest.approx(rise - 0.0075, abs=0.0026)


@pytest.mark.parametrize(
    ("name", "gap", "held", "angles"),
    [
        *product(("newton", "pbd"), (2e-3, 3e-3), [np.arange(32)], [[0.0, 0.3, 0.6, 0.9]]),
        ("pbd", 2e-3, borders(4), 33.3 * (np.arange(9) / 60) ** 2),
    ],
)
def test_pins_that_turn_together(name, gap, held, angles, device):
    """Two layers turn as one, by 0.3 rad a frame or ever faster with free vertices that lag: no pin is held back."""
    two = layers(n=4, gap=gap, turn=17.0, distance=2e-3, size=0.15)
    turns = [np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]) for a in angles]
    keyframes = np.stack([two.positions[held] @ turn.T for turn in turns])
    stepper = after_frames(replace(two, pins=wc.Pins(held, keyframes)), SOLVERS[name], device=device, dtype="float64")
    for x, expected in zip(positions(stepper, len(angles) - 1), keyframes[1:], strict=True):
        assert x[held] == pytest.approx(expected, abs=1e-12)
    assert stepper.pairs.pins_held == []


def test_acting_contacts(device):
    """Their keys are different and lead to their slots, and their corners are in the order of keys at each vertex."""
    pairs = pairs_of(layers(3, turn=17.0, gap=2e-3), device)
    contact, model = pairs.contact, pairs.model
    contact.list_corners()
    for _ in range(2):
        pairs.launch_begin(model.positions)
        contact.launch(model.positions)
        number = contact.pairs.number.numpy()[0]
        assert 0 < number < pairs.proximity.counts.numpy().sum()
        keys = contact.pairs.keys.numpy()[:number]
        assert (contact.pairs.slots.numpy()[keys] == np.arange(number)).all()
        first, corners = contact.pairs.first.numpy(), contact.pairs.corners.numpy()[: 4 * number]
        assert (np.sort(corners) == np.arange(4 * number)).all()
        vertices = contact.pairs.stencils.numpy().reshape(-1)[corners]
        assert (vertices == np.repeat(np.arange(model.count), np.diff(first))).all()
        assert (np.diff(4 * keys[corners // 4] + corners % 4)[np.diff(vertices) == 0] > 0).all()


@table("name", ["newton", "xpbd"], [name for name in SOLVERS if "pbd" not in name or "xpbd" in name])
def test_contacts_that_do_not_fit_at_first(name, device):
    """Steps with too many contacts are taken again with more room: the motion is the same to the bit as with enough room."""
    contact = wc.SelfContact(distance=5e-3, stiffness=1e5, friction=0.3)
    scene, found = layers(3, turn=17.0, gap=2e-3, self_contact=contact), []
    for slots in (16, 8192):
        stepper = SOLVERS[name].bind(scene.build(device=device))
        stepper.pairs.contact.slots = slots
        stepper.pairs.grow_to(0)
        stepper.record_again()
        for _ in range(2):
            stepper.frame()
        found.append(stepper.state.x.numpy())
        assert (stepper.pairs.contact.capacity > slots) == (slots == 16)
    assert (found[0] == found[1]).all() and np.abs(found[0] - scene.positions).max() > 1e-4


@table("name", ["pbd", "hierarchical_pbd"], ["pbd", "hierarchical_pbd", "pbd_jacobi"])
@pytest.mark.parametrize("tilt", [1e-9, 1e-4])
def test_locked_axes_almost_along_the_normal(name, tilt, device):
    """Sheets at an angle to the free axes that is rounding or small stay; else moves are longer by the inverse of the angle."""
    scene = layers(turn=17.0, gap=4e-3, free_axes=np.tile([True, False, True], (72, 1)))
    points = scene.mesh.points + tilt * np.outer(np.arange(72) >= 36, [0.0, 1.0, 0.0]) * scene.mesh.points[:, :1]
    stepper = after_frames(replace(scene, positions=points), SOLVERS[name], 1, device=device)
    assert np.abs(stepper.state.x.numpy() - points).max() < 1e-2


UP = np.arange(7)[:, None] / 6.0 * [0.1, 0.4, 0.0]
CUBE = trimesh.creation.box((0.3, 0.3, 0.3))
# Colliders, of which most come towards cloth at up to 1.6 m/s.
TOWARDS = {
    "ball": wc.Sphere(radius=0.3, position=UP - [0.0, 0.31, 0.0]),
    "box": wc.Box(size=(0.3, 0.3, 0.3), position=UP - [0.0, 0.16, 0.0]),
    "plane": wc.Plane(position=0.5 * UP - [0.0, 0.01, 0.0]),
    "mesh": wc.MeshCollider(CUBE.vertices, CUBE.faces, position=[0.0, -0.16, 0.0]),
    "moving mesh": wc.MeshCollider(CUBE.vertices, CUBE.faces, position=UP - [0.0, 0.16, 0.0]),
    "swelling mesh": wc.MeshCollider(CUBE.vertices * (1.0 + UP[:, 1:2, None]), CUBE.faces, position=[0.0, -0.2, 0.0]),
}


def thrown_on(collider, velocity, turn=0.0):
    velocities = np.tile(velocity, (48, 1))
    return layers(3, n=4, stiffness=500.0, turn=turn, velocities=velocities, colliders=[collider], contact=SOFT)


# What is thrown, the number of frames and the precision. At 100 m/s sheets would move 100 times as far as they are apart.
THROWN = {
    "100 m/s": (partial(layers, turn=17.0, speed=100.0), 8, "float32"),
    "1 m/s": (partial(layers, turn=17.0, speed=1.0), 8, "float32"),
    "100 m/s in float64": (partial(layers, turn=17.0, speed=100.0), 8, "float64"),
    "a fold, at 100 m/s": (partial(folded, n=9, closing=100.0, gravity=np.zeros(3)), 4, "float32"),
    "on rails": (partial(layers, turn=17.0, speed=1.0, free_axes=np.tile([False, True, False], (72, 1))), 2, "float64"),
    "on a ball": (partial(thrown_on, wc.Sphere(radius=0.3, position=(0, -0.31, 0)), [1.0, -10.0, 0.5]), 6, "float64"),
    "on a box": (partial(thrown_on, wc.Box(size=(0.3, 0.3, 0.3), position=(0, -0.16, 0)), [1.0, -10.0, 0.5]), 6, "float64"),
    **{f"towards {kind}": (partial(thrown_on, each, [0.5, -3.0, 0.2], 17.0), 4, "float32") for kind, each in TOWARDS.items()},
}


# What a step is to the filter all solvers tell, and what speed, precision and the kind of collider are few of them.
@table(
    "name, what",
    [
        *product(FEW, ("100 m/s", "a fold, at 100 m/s", "on a box", "on rails")),
        *product(["xpbd"], ("1 m/s", "on a ball", *(f"towards {kind}" for kind in TOWARDS))),
    ],
    [
        *product(SOLVERS, ("100 m/s", "on rails", "on a box", "towards moving mesh")),
        *product(FEW, ("1 m/s", "100 m/s in float64", "a fold, at 100 m/s")),
        *product(["xpbd"], ("on a ball", *(f"towards {kind}" for kind in TOWARDS if kind != "moving mesh"))),
    ],
)
def test_thrown_cloth(name, what, device):
    """No cloth crosses cloth, no vertex ends a frame inside a collider, and vertices on rails stay on them to the bit."""
    make, frames, dtype = THROWN[what]
    scene = make()
    stepper = after_frames(scene, SOLVERS[name], device=device, dtype=dtype)
    for frame, x in enumerate(positions(stepper, frames), 1):
        assert crossed(x, scene.mesh.triangles) == 0
        assert all(each.distances(x, frame=frame).min() > 0.0 for each in scene.colliders)
        assert scene.free_axes is None or (x == scene.positions)[~scene.free_axes].all()
    assert stepper.inside == []


def test_vertices_that_leave_a_collider_stop_no_others(device, speed=15.0, h=1.0 / 60.0):
    """A sheet is thrown onto a ball so soft that the filter moves vertices out of it. Its corners go on, by 0.4 of its side."""
    scene = drape.scene(n=24, self_contact=True, friction=0.0)
    contact = replace(scene.contact, stiffness=1e-4 * scene.contact.stiffness)
    scene = replace(scene, contact=contact, velocities=np.tile([0.0, -speed, 0.0], (24**2, 1)))
    stepper = wc.Newton(substeps=1).bind(scene.build(device=device, dtype="float64"))
    moved = next(iter(positions(stepper, 1))) - scene.positions
    assert stepper.colliders.notes.cut.numpy()[0] > 0
    corners = moved[[0, 23, -24, -1], 1]
    np.testing.assert_allclose(corners, -h * (speed + h * 9.81), rtol=0.01)


def test_a_copy_that_moves_again_moves_no_other(device, r=5e-3):
    """Sheets that almost touch, at rest, beside a copy of them that is thrown onto a soft ball; a mesh moves far away."""
    solid = trimesh.creation.icosahedron()
    mesh = wc.MeshCollider(0.1 * solid.vertices, solid.faces, position=np.arange(5)[:, None] * [0, 2e-3, 0] + [3, 0, 0])
    ball, contact = wc.Sphere(radius=0.1, position=[0.0, -0.12, 0.0]), wc.Contact(distance=r, stiffness=10.0)
    fields = {"fps": 60.0, "duration": 4 / 60, "colliders": [ball, mesh], "contact": contact}
    scene, velocities = layers(gap=0.06 * r, distance=r, stiffness=1e-2, **fields), np.zeros((2, 72, 3))
    velocities[1, :, 1] = -15.0

    def ends(velocities):
        build = {"device": device, "dtype": "float64", "copies": len(velocities), "vary": {"velocities": velocities}}
        stepper = after_frames(scene, wc.Newton(substeps=1), steps=3, **build)
        return stepper.state.x.numpy().reshape(len(velocities), -1, 3), stepper.colliders.notes.cut.numpy()

    both, cut = ends(velocities)
    assert cut[0] == 0 < cut[1]
    for copy in range(2):
        assert (ends(velocities[[copy]])[0][0] == both[copy]).all()


@table("name", ("xpbd",), list(SOLVERS)[:4])
def test_contact_in_a_frame_that_moves(name, device):
    """Two sheets that fall on a plane at rest, and at rest on a plane that rises as fast, move the same relative to it."""
    solver, ends = wc.Newton(substeps=10, tolerance=1e-12) if name == "newton" else SOLVERS[name], []
    for moves in (False, True):
        rise = np.arange(4)[:, None] / 24.0 * [0.0, 0.3, 0.0] * moves
        plane, contact = wc.Plane(position=rise - [0.0, 0.01, 0.0]), wc.Contact(distance=5e-3, stiffness=1e5)
        fields = {"velocities": np.tile([0.0, -0.3 * (not moves), 0.0], (32, 1)), "colliders": [plane], "contact": contact}
        scene = layers(gap=8e-3, n=4, turn=17.0, duration=0.125, **fields)
        ends.append(after_frames(scene, solver, 3, device=device, dtype="float64").state.x.numpy() - rise[-1])
    assert np.ptp(ends[0][:, 1]) > 1e-3 and ends[1] == pytest.approx(ends[0], abs=1e-9)


@few_solvers
def test_what_colliders_close_on(name, device):
    """A box that presses two layers onto a pinned one: the run names a vertex that had no way out, and no layer crosses."""
    rise = np.arange(6)[:, None] * [0.0, 0.01, 0.0]
    box = wc.Box(size=(0.6, 0.1, 0.6), position=rise - [0.0, 0.06, 0.0])
    scene = layers(count=3, n=4, gap=0.01, colliders=[box], pins=np.arange(32, 48), contact=SOFT)
    animation = wc.simulate(scene, SOLVERS[name], frames=3, device=device)
    (found,) = animation.inside
    assert found.other == "other cloth" and found.frame == 3 and found.vertex < 32
    assert f"vertex {found.vertex} is caught between Box and other cloth in frame" in str(found)
    assert all(crossed(points, scene.mesh.triangles) == 0 for points in animation.points)


@table("name, gap", [*product(FEW, [5e-5])], [*product(SOLVERS, [5e-5]), *product(FEW, [2.5e-3])])
def test_starts_pressed_together(name, gap, device):
    """Sheets within the contact distance fly apart with the energy of contact at the start, which is no divergence."""
    animation = wc.simulate(layers(n=3, gap=gap, duration=0.125), SOLVERS[name], device=device)
    assert "diverged" not in animation.status.message and np.ptp(animation.points[-1, :, 1]) > 5e-3


def diagonals():
    """A sheet that falls on a pinned one; diagonals of the two cross."""
    below = wc.Mesh.grid(4, 4, size=0.13, pattern="alternating")
    above = wc.Mesh(below.points * [-1.0, 1.0, 1.0] + [0.13, 2.5e-3, 0.0], below.triangles[:, [0, 2, 1]])
    velocities = np.repeat([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]], 16, axis=0)
    fields = {"velocities": velocities, "pins": "part(below)", "self_contact": wc.SelfContact(distance=2e-3)}
    return cloth(wc.Mesh.join({"below": below, "above": above}), stiffness=300.0, **fields)


IMPACTS = {
    "diagonals": (diagonals, 10, 3, 1e-3),
    "2 m/s": (partial(layers, turn=17.0, speed=2.0, stiffness=500.0), 1, 2, 1e-3),
    "short steps": (partial(layers, n=3, gap=2e-3, speed=2.0, stiffness=500.0), 640, 10, 1.0),
}


@pytest.mark.parametrize(("make", "substeps", "steps", "tolerance"), IMPACTS.values(), ids=IMPACTS)
def test_impact_converges(make, substeps, steps, tolerance, device):
    """Where a step presses sheets flat, so that edges cross at small gaps, and a filter at single vertices would stall."""
    # Short steps stop the sheets with a pressure of ρv/h = 4600 Pa, where φ has 250 kr = 625 Pa at the least gap of the filter.
    # They end at a residual of 0.35 m/s², 5e-6 of v/h.
    solver = wc.Newton(substeps=substeps, tolerance=tolerance)
    assert after_frames(make(), solver, steps=steps, device=device, dtype="float64").results == [Result.CONVERGED]


@each_solver
def test_free_fall(name, device):
    """A flat sheet falls as if nothing had been declared: at ½gt(t + h) in steps h, 2.6 m in 0.7 s."""
    scene = layers(1, gravity=np.array([0.0, -GRAVITY, 0.0]))
    stepper, t = after_frames(scene, SOLVERS[name], 17, device=device, dtype="float64"), 17.0 / 24.0
    assert stepper.cut == 0.0
    fallen = np.tile([0.0, -0.5 * GRAVITY * t * (t + stepper.h), 0.0], (36, 1))
    assert stepper.state.x.numpy() - scene.positions == pytest.approx(fallen, abs=1e-11)


@pytest.mark.parametrize("solver", [wc.Newton(substeps=1), wc.XPBD(substeps=1, iterations=30)], ids=["newton", "xpbd"])
def test_free_fall_of_a_stack(solver, device, fps=48):
    """Sheets that fall together at their contact distance, with a pinned piece far away, move as without the filter."""
    pinned = wc.Mesh([[5.0, 0.0, 0.0], [5.1, 0.0, 0.0], [5.0, 0.0, 0.1]], [[0, 1, 2]])
    mesh = wc.Mesh.join({"sheets": layers(3, n=5, size=0.2, gap=2e-3).mesh, "pinned": pinned})
    velocities = np.vstack([np.tile([0.0, -3.0, 0.0], (75, 1)), np.zeros((3, 3))])
    fields = {"pins": "part(pinned)", "self_contact": wc.SelfContact(distance=2e-3), "fps": fps}
    scene = cloth(mesh, velocities=velocities, terms=[wc.Spring(stiffness=100.0)], **fields)
    run = wc.simulate(scene, solver, device=device, dtype="float64", frames=8)
    fall = 3.0 * 8 / fps + GRAVITY / fps**2 * 8 * 9 / 2  # implicit Euler
    assert run.cut == 0.0 and run.points[0, :75, 1] - run.points[-1, :75, 1] == pytest.approx(fall, abs=1e-6)


@table("substeps", [200], [100, 200])
def test_energy_is_conserved(substeps, device):
    """Sheets that part at a gap of r/2, without cuts: what explicit steps lose of the energy at the start is of order h²."""
    scene = layers(n=3, gap=2.5e-3, duration=1 / 24)
    energies = wc.simulate(scene, wc.Explicit(substeps=substeps), device=device, dtype="float64", record="energies").energies
    total, of_contact = sum(energies.values()), energies["self-contact"]
    assert of_contact[0] == pytest.approx(0.5 * 1e5 * 0.25 * 2.5e-3**2) and of_contact[-1] < of_contact[0]
    assert total[-1] == pytest.approx(total[0], rel=0.05 * (100 / substeps) ** 2)


def test_pins_bear_what_lies_on_them(device):
    """Reactions of a pinned sheet are its weight and that of the sheet that rests on it, at a gap of r − ρg/k."""
    gap, fields = 5e-3 - DENSITY * GRAVITY / 1e4, {"gravity": (0.0, -GRAVITY, 0.0), "pins": np.arange(36), "duration": 1 / 12}
    scene, record = layers(gap=gap, stiffness=1e4, **fields), ("energies", "reactions")
    animation = wc.simulate(scene, wc.Newton(substeps=2, tolerance=1e-9), device=device, dtype="float64", record=record)
    weight = DENSITY * 0.25 * GRAVITY
    assert animation.reactions[:, :, 1].sum(axis=1) == pytest.approx(2.0 * weight, rel=1e-6)
    assert animation.energies["self-contact"] == pytest.approx(0.5 * weight**2 / (1e4 * 0.25), rel=1e-6)


@pytest.mark.parametrize("steps", [20, pytest.param(60, marks=SLOW)])
def test_violent_steps(steps, device):
    """Of random moves of up to a third of the sheet, from wherever the last ended, nothing crosses."""
    scene = folded(gravity=np.zeros(3))
    pairs, rng, unfiltered = pairs_of(scene, device), np.random.default_rng(2), 0
    model = pairs.model
    x, v = wp.clone(model.positions), model.vectors()
    pairs.grow_to(200_000)
    for step in range(steps):
        pairs.launch_begin(x)
        target = x.numpy() + 10.0 ** rng.uniform(-3.0, -0.8) * rng.normal(size=(model.count, 3))
        unfiltered += crossed(target, scene.mesh.triangles) > 0
        wp.copy(x, model.array(target, model.vec3))
        pairs.filter.launch_end(x, v)
        assert not pairs.overflowed and crossed(x.numpy(), scene.mesh.triangles) == 0, step
    assert unfiltered > 0.5 * steps and pairs.share > 0.5


@pytest.mark.parametrize("count", [1, 2])
def test_lists_are_kept(count, device):
    """Sheets that fall together are listed once; a list that was made elsewhere is made anew, where the state says."""
    pairs = pairs_of(layers(count), device)
    model, found = pairs.model, pairs.proximity.found
    first, listed = model.positions.numpy(), pairs.proximity.stencils.numpy().copy()
    fallen, rolled = first - np.array([0.0, 1.0, 0.0]), first * [1.0, 1.0, 0.5]
    begin(pairs, fallen)
    assert (found.numpy() == first).all()
    begin(pairs, rolled)
    assert (found.numpy() == rolled).all()
    wp.copy(found, model.positions)
    begin(pairs, fallen)
    assert (found.numpy() == first).all()
    number = pairs.proximity.counts.numpy().sum()
    assert (pairs.proximity.stencils.numpy()[:number] == listed[:number]).all()


def test_a_way_on_which_all_stay_apart_needs_no_list(device):
    pairs = pairs_of(layers(gap=6e-3), device, dtype="float32")
    model, lists = pairs.model, pairs.lists.numpy()[0]
    start = model.positions.numpy()
    x = model.array(start + 9.0 * pairs.skin * np.sign(start[:, 1:2] - start[:, 1].mean()) * [0.36, 0.48, 0.8], model.vec3)
    target = x.numpy().copy()
    pairs.filter.launch_end(x, model.vectors())
    np.testing.assert_array_equal(x.numpy(), target)
    assert pairs.lists.numpy()[0] == lists


def test_a_list_serves_for_two_rounds(device):
    """Of sheets that slide by five rounds, whose first uses the list of the start; they end where they should.

    They come nearer than pairs may in one round.
    """
    gap = 6e-3
    pairs = pairs_of(layers(gap=gap), device, dtype="float32")
    model, lists = pairs.model, pairs.lists.numpy()[0]
    start = model.positions.numpy()
    side = np.sign(start[:, 1:2] - start[:, 1].mean())
    x = model.array(start + side * (4.5 * ROUND * pairs.skin * np.array([0.6, 0.0, 0.8]) - [0.0, 0.475 * gap, 0.0]), model.vec3)
    target = x.numpy().copy()
    pairs.filter.launch_end(x, model.vectors())
    np.testing.assert_array_equal(x.numpy(), target)
    assert pairs.lists.numpy()[0] - lists == 2


@pytest.mark.parametrize("ratio", [1.5, 2.0])
def test_forces_do_not_depend_on_the_age_of_a_list(ratio, device):
    """Of thick folded cloth, where many contacts cancel: forces are the same, to the bit, with a new list."""
    scene = folded(gap=0.01)
    scene = replace(scene, self_contact=wc.SelfContact(distance=ratio * scene.mesh.edge_lengths.max(), stiffness=1e4))
    pairs, rng = pairs_of(scene, device), np.random.default_rng(0)
    for _ in range(4):
        x = scene.positions + 0.006 * rng.normal(size=scene.positions.shape) * [0.2, 1.0, 0.2]
        moves = rng.normal(size=x.shape)
        moved, forces = x + 0.1 * pairs.skin * moves / np.linalg.norm(moves, axis=1)[:, None], []
        for points, anew in ((x, True), (moved, False), (moved, True)):
            if anew:
                pairs.start_again()
            begin(pairs, points)
            assert (pairs.proximity.found.numpy() == points).all() == anew
            forces.append(gradient(pairs, points))
        assert np.abs(forces[-1]).max() > 0.0 and (forces[-1] == forces[-2]).all()


@table(
    "name, speed",
    [("explicit", 20.0), ("xpbd", 0.02), ("newton", 0.0), ("xpbd", 5.0)],
    [*product(SOLVERS, (0.0, 0.02, 5.0, 20.0))],
)
def test_steps_with_nothing_near_are_those_with_contact(name, speed, device, monkeypatch):
    """To the bit, of sheets that fall, that bend within the bounds of the list and beyond, and whose moves are long."""
    scene = layers(1, gravity=np.array([0.0, -GRAVITY, 0.0]))
    bent = replace(scene, velocities=speed * np.sin(9.0 * scene.positions[:, :1]) * [0.3, 1.0, 0.0])
    ends, skips = [], wp.capture_if

    def launch_always(flags, condition, on_true=None, on_false=None, **given):
        if any(condition is flag for flag in flags):
            on_true(**given)
        else:
            skips(condition, on_true, on_false, **given)

    for tested in (True, False):
        stepper = SOLVERS[name].bind(bent.build(device=device, copies=2))
        near = stepper.pairs.near
        if not tested:
            monkeypatch.setattr(wp, "capture_if", partial(launch_always, (stepper.pairs.listed, stepper.pairs.far, near.array)))
            monkeypatch.setattr(near, "read", lambda: np.ones(1, dtype=np.int32))
            stepper.record_again()
        for _ in range(3):
            for _ in range(stepper.steps_per_frame):
                stepper.step()
            stepper.frame()
        ends.append(stepper.state.copy())
    assert ends[0] == ends[1] and (stepper.pairs.lists.numpy() > (1 if speed > 1.0 else 0)).all()
    assert stepper.pairs.steps.numpy().tolist() == [6 * stepper.steps_per_frame] * 2


FOLLOWS = {"xpbd_that_follows": wc.XPBD(substeps=4, iterations=50)}
ENDS = {"admm_that_ends": wc.ADMM(substeps=1, iterations=200, tolerance=0.1)}  # by what each copy measures
# Where bits must repeat: sheets that meet at 3 m/s with few or many pairs, sheets that rub, and pairs that come later.
MEETING = partial(layers, n=5, turn=17.0, speed=3.0)
REPEATED = {
    "meet": MEETING,
    "many pairs": partial(MEETING, distance=0.15, stiffness=100.0),
    "3 meet": partial(MEETING, 3, n=4),
    "4 meet": partial(MEETING, 4, n=4),
    "rub": partial(slope, 0.6, layers=2),
    "come": partial(layers, n=10, gap=0.2, turn=17.0, velocities=np.repeat([[0.0, 0.0, 0.0], [0.0, -3.0, 0.0]], 100, axis=0)),
}


@table(
    "name, what",
    [
        *product(FEW, ["meet"]),
        *product(["xpbd"], ("many pairs", "rub", "come")),
        *product(("newton", "pbd"), ["come"]),
        ("newton", "rub"),
    ],
    [
        *product((*SOLVERS, *FOLLOWS), ["meet"]),
        *product(FEW, ["many pairs"]),
        *product(["constrained_dynamics"], ("3 meet", "4 meet")),
        *product((*FEW, "xpbd_jacobi"), ["rub"]),
        *product(("newton", "newton_factorised", "xpbd", "pbd", "admm_that_ends", "projective_dynamics"), ["come"]),
    ],
)
def test_bits_repeat(name, what, device):
    """Of another run, whatever room its lists have, of copies at speeds of their own, and of states that are put back."""
    scene, solver, frames = REPEATED[what](), (SOLVERS | FOLLOWS | ENDS)[name], 4 if what == "come" else 2
    speeds = np.stack([scene.velocities, scene.velocities / 30.0])
    *singles, both = (solver.bind(scene.build(device=device, copies=copies)) for copies in (1, 1, 1, 1, 1, 1, 2))
    one, slow, again, small, large, other = singles
    other.reset(positions=scene.positions[None] * [1.0, 30.0, 1.0])  # far apart, so that it has no anchors to keep
    other.frame()
    for stepper, room in ((small, 8), (large, 10_000), (other, 4)):
        stepper.pairs.grow_to(room)
        stepper.record_again()
    slow.reset(velocities=speeds[1:])
    both.reset(velocities=speeds)
    rooms = []
    for _ in range(frames):
        for stepper in (one, slow, again, small, large, both):
            stepper.frame()
        rooms.append(len(one.pairs.pairs.stencils))
    assert (rooms[-1] > rooms[0]) == (what == "come")
    assert one.pairs.friction is None or one.pairs.friction.data.limit.numpy().any()
    assert one.state == again.state == small.state == large.state

    def copies():
        return [array.numpy().reshape(2, -1, 3).copy() for array in both.state][:2]

    def assert_copy(copy, stepper):
        for found, expected in zip(copies(), stepper.state, strict=False):
            assert (found[copy] == expected.numpy()).all()

    first = copies()
    assert_copy(0, one)
    assert_copy(1, slow)
    assert all(crossed(x, scene.mesh.triangles) == 0 for x in first[0])
    large.frame()
    for stepper in (large, other):
        stepper.state.assign(one.state)
    again.state.from_host(one.state.to_host())
    both.reset([True, False], velocities=speeds)
    for stepper in (one, slow, again, large, other, both):
        stepper.frame()
    assert one.state == again.state == large.state == other.state
    assert_copy(1, slow)
    for _ in range(frames - 1):
        both.frame()
    assert all((now[0] == before[0]).all() for now, before in zip(copies(), first, strict=True))


def above_a_triangle(points):
    """Two sheets, with vertices of the upper one above the inside of triangles of the lower one."""
    return points + np.where(np.arange(72)[:, None] < 36, 0.0, [0.03, 0.0, 0.06])


@pytest.mark.parametrize("way", [0.03, 0.3, 3.0, 300.0])
def test_directions_of_one_vertex(way, device):
    """A vertex that is to go through a sheet at rest, whose triangles have boxes smaller than its own: it ends before it."""
    scene = layers(gap=0.02)
    pairs, direction = pairs_of(scene, device), np.zeros((72, 3))
    begin(pairs, above_a_triangle(scene.positions))
    direction[36 + 14, 1] = -way
    pairs.filter.launch_limit(pairs.model.array(direction, pairs.model.vec3))
    (fraction,) = pairs.filter.fraction.numpy()
    assert 0.5 * 0.02 < fraction * way < 0.02


def test_sweeps_over_coarse_levels_find_no_contacts_anew(device):
    """Only those over all terms count, where the halves of a fold are near enough to be listed."""
    stepper = after_frames(folded(gap=-0.05), wc.HierarchicalPBD(substeps=1, iterations=3), steps=1, device=device)
    assert len(stepper.levels) > 1 and stepper.pairs.contact.turn.numpy() == [3]


def start_of_step(scene, moving, rise, device):
    """Where a step starts whose pin ends at its keyframe, and others at the prediction ``rise`` [m] higher; nothing crosses."""
    pairs = pairs_of(scene, device)
    base, d = scene.positions.copy(), pairs.model.vectors()
    base[moving, 1] += rise
    base[scene.pins.vertices] = scene.pins.keyframes[-1]
    pairs.filter.launch_start(pairs.model.array(base, pairs.model.vec3), d)
    assert crossed(base + d.numpy(), scene.mesh.triangles) == 0
    return base + d.numpy()


@pytest.mark.parametrize(("way", "walks"), [(0.01, False), (-0.05, True)])
def test_where_a_step_with_moving_pins_starts(way, walks, device):
    """Where sheets would pass through one another: cloth stays as its pin moves, but follows a pin that goes through cloth."""
    pin = 36 + 14
    frames = layers().positions[[pin]] + np.array([0.0, 1.0, 0.0]) * np.array([0.0, way])[:, None, None]
    scene = layers(pins=wc.Pins([pin], frames), duration=1.0 / 24.0)
    start, stayed = start_of_step(scene, slice(36, 72), -0.05, device), scene.positions.copy()
    stayed[pin] = frames[-1]
    if walks:
        assert (np.abs(start - scene.positions).max(axis=1)[36:] > 1e-3).all()
    else:
        assert start == pytest.approx(stayed, abs=1e-15)


def test_a_pin_pushes_cloth_that_goes_the_other_way(device):
    """A sheet rises by 50 mm towards another one, whose pin moves down by 10 mm from 2 mm above it."""
    pin, scene = 36 + 14, layers(gap=2e-3)
    positions = above_a_triangle(scene.positions)
    frames = positions[[pin]] - np.array([0.0, 1.0, 0.0]) * np.array([0.0, 0.01])[:, None, None]
    scene = replace(scene, positions=positions, pins=wc.Pins([pin], frames), duration=1.0 / 24.0)
    start = start_of_step(scene, slice(36), 0.05, device)
    np.testing.assert_allclose(start[pin], frames[-1, 0], atol=1e-12)


@pytest.mark.parametrize("hard", [False, True])
def test_pins_that_move_as_one_body_are_held_by_lagging_vertices_if_pairs_are_hard(hard, device):
    """Two edges that cross, with a pin and a free vertex each; the free vertices are predicted beyond one another."""
    scene = layers(turn=17.0, gap=6e-3)
    pairs = pairs_of(scene, device)
    first, end = pairs.pairs.counts.numpy().cumsum()
    inside = np.flatnonzero((np.abs(pairs.begun.weights.numpy()[first:end]) > 0.2).all(axis=1))
    edges = pairs.pairs.stencils.numpy()[first + inside[0]]
    pins, free = edges[[0, 2]], edges[[1, 3]]
    frames = scene.positions[pins] - np.array([0.0, 1e-3, 0.0]) * np.arange(2)[:, None, None]
    scene = replace(scene, pins=wc.Pins(pins, frames), duration=1.0 / 24.0)
    pairs, x = pairs_of(scene, device), scene.positions.copy()
    x[pins, 1] -= 1e-3
    x[free, 1] += np.where(free < 36, 0.03, -0.03)
    end, v = pairs.model.array(x, pairs.model.vec3), pairs.model.vectors()
    pairs.filter.launch_hold(end, v, hard)
    moved = (end.numpy() - scene.positions)[pins, 1]
    assert (moved == pytest.approx(-1e-3, abs=1e-15)) != hard


def test_directions_by_the_list(device):
    """Along moves for which the list is kept, its pairs give the fraction that a search of all pairs gives, to the bit."""
    scene, random, found = layers(turn=17.0, gap=5e-3), np.random.default_rng(0), []
    pairs = pairs_of(scene, device)
    direction = 0.2 * pairs.skin * random.uniform(-1.0, 1.0, scene.positions.shape)
    for listed in (True, False):
        if not listed:
            pairs.proximity.found.assign(random.uniform(-1.0, 1.0, scene.positions.shape))
            pairs.pairs.counts.zero_()  # so that the search alone limits the direction
        pairs.filter.launch_limit(pairs.model.array(direction, pairs.model.vec3))
        assert pairs.proximity.copies.numpy() == [not listed]
        found.append(pairs.filter.fraction.numpy()[0])
    assert found[0] == found[1] and 0.0 < found[0] < 1.0


@few_solvers
def test_resets_that_are_refused(name, device):
    """A copy is not reset to sheets that coincide or cross; the others, and where it was, stay as they were."""
    scene = layers(n=3, turn=17.0)
    stepper = after_frames(scene, SOLVERS[name], 1, device=device, copies=2)
    before, starts = stepper.state.copy(), np.stack([scene.positions, scene.positions])
    starts[1, 9:] = starts[1, :9]
    with pytest.raises(ValueError, match=r"vertex 0 and triangle .* of copy 1 start 0 m apart; self_contact needs more than"):
        stepper.reset([False, True], positions=starts)
    starts[1, 9:] = scene.positions[9:]
    starts[1, 9:, 1] = 0.3 * (starts[1, 9:, 0] - 0.013) + 0.1 * starts[1, 9:, 2]
    with pytest.raises(ValueError, match=r"of copy 1 cross at the start"):
        stepper.reset(positions=starts)
    assert stepper.state == before
    stepper.reset([True, False], positions=starts)
    assert (stepper.state.x.numpy()[:18] == starts[0].astype(np.float32)).all()
    stepper.frame()
    assert np.isfinite(stepper.state.x.numpy()).all()


@each_solver
def test_nothing_is_there_without(name, device):
    stepper = after_frames(layers(self_contact=None), SOLVERS[name], device=device)
    assert stepper.pairs is None and not any("pairs" in kernel for kernel in stepper.model.kernels)
    if name == "newton":
        stepper = after_frames(rubbing(friction=0.0), SOLVERS[name], 1, device=device)
        assert stepper.pairs.friction is None and not stepper.state.parts
        assert not any("friction" in kernel for kernel in stepper.model.kernels)


def test_default_stiffness():
    """(2/r)(wL/r + Y/L), of both sheets: Y of the springs, L the side of a square as large."""
    weightless, Y, L = layers(stiffness=None).self_contact.stiffness, 200.0 / np.sqrt(3.0), np.sqrt(0.5)
    assert weightless == pytest.approx(2.0 / 5e-3 * Y / L)
    heavy = layers(stiffness=None, gravity=None).self_contact.stiffness
    assert heavy == pytest.approx(weightless + 2.0 / 5e-3**2 * DENSITY * GRAVITY * L)


@pytest.mark.filterwarnings("error")
def test_all_pinned(device):
    scene = layers(n=2, gap=1e-3, duration=1 / 24, pins="all")
    assert wc.simulate(scene, SOLVERS["explicit"], device=device).points[-1] == pytest.approx(scene.positions)


def test_crossings():
    """An edge through the middle of a triangle, beside it, and one with a vertex of it."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.8, 0.8, -1], [0.8, 0.8, 1]])
    edges, triangles = np.array([[3, 4], [5, 6], [0, 4]]), np.tile([[[0, 1, 2]]], (3, 1, 1))
    ((edge, triangle),) = crossings(points, edges, triangles)
    assert edge.tolist() == [3, 4] and triangle.tolist() == [0, 1, 2]


def test_an_edge_in_line_with_a_triangle_does_not_cross_it():
    """Of a straight row of triangles, in which rounding decides on which side of another an edge begins and ends."""
    random, row = np.random.default_rng(0), np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 0, 0]])
    turns = np.linalg.qr(random.normal(size=(1000, 3, 3)))[0]
    points = (row @ turns + random.normal(size=(1000, 1, 3))).reshape(-1, 3)
    first = 5 * np.arange(1000)[:, None]
    assert crossings(points, first + np.array([3, 4]), (first + np.arange(3))[:, None]) == []


@pytest.mark.parametrize(("along", "across"), [(120, 10), (240, 5), (240, 10)])
def test_a_knot_of_finer_strips_starts(along, across, device):
    pairs_of(knot.scene(along=along, across=across), device)


@pytest.mark.parametrize(("stretch", "away"), [(1.0, 0.05), (3.0, 0.28)])
@pytest.mark.parametrize("crossed", [0, 1, 2])
def test_crossings_at_the_start_that_are_refused(crossed, stretch, away, device):
    """Of a mesh of three triangles at one edge, each is crossed near this edge, or far from all where it is stretched."""
    angles = 2.0 * np.pi / 3.0 * np.arange(3)
    out = np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1)
    across = 0.03 * np.cross(out[crossed], [0.0, 1.0, 0.0])
    near = away * out[crossed] + np.stack([-across, across, across + np.array([0.0, 0.03, 0.0])])
    points = np.concatenate([[[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], np.sqrt(0.75) * out, near])
    mesh = wc.Mesh(points / stretch, [[0, 1, 2], [0, 1, 3], [0, 1, 4], [5, 6, 7]])
    contact = wc.SelfContact(distance=5e-3, stiffness=1e4)
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)], positions=points, self_contact=contact)
    with pytest.raises(ValueError, match=f"edge 5–. and triangle 0–1–{crossed + 2} cross at the start"):
        pairs_of(scene, device)


PANEL = wc.Mesh.grid(4, 4, size=0.5, pattern="alternating")


def start_of(*panels, **fields):
    """A scene of panels, each (points, triangles) or points of :data:`PANEL`, with a contact distance of 2 mm."""
    parts = [wc.Mesh(*panel) if isinstance(panel, tuple) else wc.Mesh(panel, PANEL.triangles) for panel in panels]
    mesh = wc.Mesh.join({f"panel{k}": part for k, part in enumerate(parts)})
    contact = wc.SelfContact(distance=2e-3, stiffness=1e4)
    return cloth(mesh, terms=[wc.Spring(stiffness=100.0)], self_contact=contact, fps=24.0, **fields)


FLAT, Y = PANEL.points, np.array([0.0, 1.0, 0.0])
UPRIGHT = np.stack([FLAT[:, 0], FLAT[:, 2], 0.0 * FLAT[:, 1] + 0.2], axis=1)
SHIFTED, FLIPPED = FLAT + np.array([0.1, 0.0, 0.05]), (FLAT, PANEL.triangles[:, ::-1])
# Panels that touch, and the moves of each over the contact distance, along its y axis; None if they cannot be moved.
TOUCHING_STARTS = {
    "coinciding": ([FLAT, FLAT], [-0.5, 0.5]),
    "shifted": ([FLAT, SHIFTED], [-0.5, 0.5]),
    "facing away": ([FLIPPED, FLAT], [-0.5, 0.5]),
    "facing away, the other first": ([FLAT, FLIPPED], [0.5, -0.5]),
    "a micrometre below": ([FLAT, FLAT - 1e-6 * Y], [0.5, -0.5 - 5e-4]),
    "three": ([FLAT, FLIPPED, FLAT], [0.0, -1.0, 1.0]),
    "five": ([FLAT] * 5, [-1.0, -0.5, 0.0, 0.5, 1.0]),
    "pinned": ([FLAT, FLAT], [0.0, 1.0]),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", TOUCHING_STARTS)
def test_panels_that_touch_start_apart(name, dtype, device):
    """As layers along their normals before frame 0, by at most r, in any copy and order of vertices; the run says so."""
    panels, moves = TOUCHING_STARTS[name]
    scene = start_of(*panels, pins="part(panel0)" if name == "pinned" else ())
    run = wc.simulate(scene, wc.XPBD(substeps=2), device=device, dtype=dtype, frames=2, copies=2)
    start, expected = run.points[0], np.repeat(2e-3 * np.array(moves), 16)
    assert start[:, :, 1] == pytest.approx(np.tile(expected, (2, 1)), abs=1e-9)
    assert np.abs(start - scene.positions)[..., [0, 2]].max() <= np.finfo(dtype).eps
    count = 2 * 16 * np.count_nonzero(moves)
    assert run.self_contact.moved_apart == (
        f"{count} vertices that touched other cloth at the start were moved off it, by up to {2.0 * np.abs(moves).max():.2g} mm"
    )
    assert not wc.intersections(run.points[:, 0], scene.mesh).counts.any()
    shuffled = scene.build(device=device, dtype=dtype, order=np.random.default_rng(0).permutation(len(scene.positions)))
    stepper = wc.XPBD(substeps=2).bind(shuffled)
    found = shuffled.in_scene_order(stepper.state.x.numpy())
    assert found == pytest.approx(start[0], abs=1e-9)
    stepper.frame()
    stepper.reset()
    assert (shuffled.in_scene_order(stepper.state.x.numpy()) == found).all()


def test_a_panel_that_stands_on_another_starts_above_it(device):
    """Only the triangles that it touches are moved."""
    scene = start_of(FLAT, UPRIGHT)
    moves = after_frames(scene, wc.XPBD(substeps=2), device=device, dtype="float64").state.x.numpy() - scene.positions
    assert moves.any(axis=1).reshape(2, 16).sum(axis=1).tolist() == [8, 8] and moves[:16, 1].min() == pytest.approx(-1e-3)
    plain = wc.simulate(start_of(FLAT, UPRIGHT + 1e-3 * Y), wc.XPBD(substeps=2), device=device, frames=1)
    assert plain.self_contact.moved_apart is None


class Other(wc.Newton):
    touches_itself = False


def one_through_another():
    scene = layers(turn=17.0)
    through = scene.positions.copy()
    through[40, 1] -= 0.04
    return replace(scene, positions=through)


APART = "start 0 m apart; self_contact needs more than"
NO_FRICTION = r"PBD cannot take friction of self_contact, whose .*XPBD.* can, or leave friction at 0"
NO_DEFAULT = r"self_contact\.stiffness has no default without gravity and a spring or membrane"
NEAR = "vertex 0 and triangle .* start 1e-06 m apart; self_contact needs more than"
BELOW_0 = r"self_contact\.friction is -1; it must be a number of 0 or more"
MANY_SHAPES = r"self_contact\.friction is 0\.3, with which there are many rest shapes"
ON_FLOOR = r"starts 0\.0005 m inside the collider Plane, after it was moved off other cloth"
FLOOR, NEWTON, SWEEPS = wc.Plane(position=(0.0, -5e-4, 0.0)), wc.Newton(substeps=1), wc.XPBD(substeps=2)
# A record or scene that cannot be declared, or scenes that a solver refuses.
REFUSED = {
    "weightless": (partial(layers, stiffness=None, terms=[]), None, NO_DEFAULT),
    "a chain": (lambda: wc.Scene(wc.Mesh.chain(3), density=1.0, self_contact=wc.SelfContact()), None, "mesh without triangles"),
    "held pins": (lambda: wc.SelfContact(held_pins="run"), None, r"self_contact\.held_pins is 'run'"),
    "friction below 0": (lambda: wc.SelfContact(friction=-1), None, BELOW_0),
    "no record": (partial(layers, self_contact=1), None, "self_contact is 1; it must be a SelfContact or None"),
    "friction at rest": (lambda: wc.equilibrium(rubbing()), None, MANY_SHAPES),
    "stiff": (partial(layers, stiffness=1e7), wc.Explicit(substeps=1), "symplectic Euler is stable below"),
    "no contact": (layers, Other(substeps=1), r"Other cannot take self_contact; .* can"),
    "friction of PBD": (rubbing, wc.PBD(substeps=4), NO_FRICTION),
    "friction of hierarchical PBD": (rubbing, wc.HierarchicalPBD(substeps=4), NO_FRICTION),
    "a micrometre": (partial(layers, gap=1e-6, pins="all"), NEWTON, NEAR),
    "crossing": (one_through_another, NEWTON, "edge .* and triangle .* cross at the start"),
    "crossing at 90 degrees": (partial(start_of, FLAT, UPRIGHT - 0.25 * Y), SWEEPS, "cross at the start; self_contact needs"),
    "both pinned": (partial(start_of, FLAT, FLAT, pins="all"), SWEEPS, APART),
    "one piece": (partial(start_of, FLAT, positions=np.abs(FLAT - [0.25, 0.0, 0.0])), SWEEPS, APART),
    "over a floor": (partial(start_of, FLAT, FLAT, colliders=[FLOOR]), SWEEPS, ON_FLOOR),
}


@pytest.mark.parametrize(("declare", "solver", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(declare, solver, message, device):
    with pytest.raises(ValueError, match=message):
        scene = declare()
        solver.bind(scene.build(device=device))
