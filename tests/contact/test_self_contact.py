"""Contact of cloth with itself: its energy, its minimiser, and that no step ends with cloth that went through cloth."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.rows import slow_but
from support.scenes import scene
from warpcloth.contact.self_start import crossings
from warpcloth.contact.self_steps import SelfSteps
from warpcloth.core.status import Result
from warpcloth.core.sums import Sums
from warpcloth.kernels.contact.pair_blocks import BLOCK
from warpcloth.kernels.contact.self_gaps import nearest
from warpcloth.kernels.contact.self_pairs import begin_pairs
from warpcloth.numerics.contact_system import PairSystem
from warpcloth.scenes import loop

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
# Solvers of a step that minimise, as exact as they come.
MEET = {
    "newton_factorised": wc.Newton(substeps=10, tolerance=1e-13, linear="factorised"),
    "xpbd": wc.XPBD(substeps=10, iterations=4000),
    "xpbd_jacobi": wc.XPBD(substeps=10, iterations=10_000, sweep="constraint-averaged"),
    "admm": wc.ADMM(substeps=10, tolerance=1e-8, iterations=1000),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=10, tolerance=1e-11, iterations=500),
    "constrained": wc.ConstrainedDynamics(substeps=10, tolerance=1e-8, iterations=200),
    "constrained_search": wc.ConstrainedDynamics(
        substeps=10, tolerance=1e-8, iterations=200, stabilisation="line-search", linear="factorised"
    ),
    "projective_dynamics_none": wc.ProjectiveDynamics(substeps=10, tolerance=1e-12, iterations=2000, acceleration="none"),
}
# In both stages of φ; all at a tenth of r, which ends at ten times that; held at r/60 by what presses them together.
PRESSED = {
    "both_stages": {"gap": 2.2e-3},
    "flung_apart": {"gap": 5e-4},
    "deep": {"gap": 1e-4, "shrink": 0.6, "stiffness": 1e3, "speed": 0.3},
}
# One that is explicit, one that minimises and one that sweeps, for what contact does alike for all.
FEW = ("explicit", "newton", "xpbd")
each_solver = pytest.mark.parametrize("name", slow_but(FEW, SOLVERS))
few_solvers = pytest.mark.parametrize("name", FEW)


def layers(count=2, n=6, gap=0.02, speed=0.0, turn=0.0, distance=5e-3, stiffness=1e5, size=0.5, shrink=1.0, **fields):
    """Sheets above one another, each turned by some degrees more and smaller; those above the first move down, that up."""
    grid, parts = wc.Mesh.grid(n, n, size=size), []
    centre = grid.points.mean(axis=0)
    for layer in range(count):
        c, s = np.cos(np.radians(turn * layer)), np.sin(np.radians(turn * layer))
        parts.append(
            shrink**layer * (grid.points - centre) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + [0.0, gap * layer, 0.0]
        )
    triangles = np.concatenate([grid.triangles + layer * n * n for layer in range(count)])
    velocities = np.zeros((count * n * n, 3))
    velocities[:, 1] = np.where(np.arange(count * n * n) < n * n, speed, -speed)
    terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-5)]
    fields = {"gravity": np.zeros(3), "fps": 24.0, "duration": 1.0, "terms": terms, **fields}
    return wc.Scene(
        wc.Mesh(np.concatenate(parts), triangles),
        density=0.15,
        velocities=velocities,
        self_contact=wc.SelfContact(distance=distance, stiffness=stiffness),
        **fields,
    )


def folded(n=13, gap=0.02, **fields):
    """A sheet of 0.5 m folded in two about a half circle."""
    grid, radius = wc.Mesh.grid(n, n, size=0.5), 0.5 * gap + 0.03
    s, half = grid.points[:, 0] - 0.25, 0.5 * np.pi * radius
    bent = np.abs(s) < half
    x = np.where(bent, radius * np.cos(s / radius), half - np.abs(s))
    y = np.where(bent, radius * np.sin(s / radius), np.sign(s) * radius)
    fields = {"fps": 24.0, "duration": 1.0, **fields}
    return wc.Scene(
        grid,
        density=0.15,
        terms=[wc.Spring(stiffness=100.0, pairs=("structural", "shear")), wc.QuadraticBending(stiffness=1e-5)],
        positions=np.stack([x, y, grid.points[:, 2]], axis=1),
        self_contact=wc.SelfContact(distance=5e-3, stiffness=1e4),
        **fields,
    )


def steps_of(scene, device, bounded=False, h=1.0 / 24.0, copies=1):
    """The :class:`SelfSteps` of a scene in float64, in no solver, and its model."""
    model = scene.build(device=device, dtype="float64", copies=copies)
    return SelfSteps(model, wc.Explicit(substeps=1000, above_limit="allow").bind(model).state, h, 1, bounded, None), model


def crossed(points, triangles):
    """How many pairs of triangles intersect in points as stored, by the exact predicates of libigl."""
    predicates = pytest.importorskip("igl.predicates")
    stored = np.asarray(points, dtype=np.float32).astype(np.float64)
    return len(predicates.find_self_intersections(stored, triangles.astype(np.int64))[1])


@pytest.mark.parametrize(
    ("bounded", "gap", "least"),
    [(False, 4e-3, 0.0), (False, 1.2e-3, 0.0), (True, 4e-3, 0.0), (True, 1.2e-3, 0.0), (False, 1.2e-3, 1e-3)],
)
def test_forces_are_the_gradient_and_balance(bounded, gap, least, device):
    """By central differences with an error of O(η²) = 1e-10 of the third derivative, and ΣF = 0, Σ x × F = 0 to rounding.

    Along p, the force kAφ′ of a contact of a vertex grows by kAφ″ Σ wᵢn·pᵢ.
    """
    scene = layers(turn=17.0, gap=gap)
    pairs, model = steps_of(scene, device, bounded)
    pairs.contact.least = least
    rng, sums = np.random.default_rng(1), Sums(model)
    x = scene.positions + 2e-4 * rng.normal(size=scene.positions.shape)
    pairs.launch_begin(model.array(x, model.vec3))

    def energy(x):
        out = model.scalars()
        pairs.forces.launch(model.array(x, model.vec3))
        pairs.forces.add_energy(sums, out)
        return out.numpy()[0]

    def gradient(x):
        out = model.vectors()
        pairs.forces.launch(model.array(x, model.vec3))
        pairs.forces.add_gradient(out)
        return out.numpy()

    def of_contacts(x):
        """F·n and kAφ″ by slots, 0 without contact, and what a contact is: its stencil and which of its weights are not 0."""
        pairs.forces.launch(model.array(x, model.vec3))
        found, forces, n = pairs.contact, pairs.contact.forces, pairs.contact.data.normal.numpy()
        share = np.maximum(found.data.share.numpy(), 1e-300)
        acting = np.zeros(found.capacity, dtype=bool)
        acting[found.pairs.acting.numpy()[: found.pairs.number.numpy()[0]]] = True
        pull = np.where(acting, (forces.force.numpy() * n).sum(axis=1), 0.0)
        bend = np.where(acting & (found.data.stiffness.numpy() > 0.0), forces.bend.numpy()[:, 0] / share, 0.0)
        return pull, bend, n, found.data.weights.numpy(), found.pairs.stencils.numpy()

    force, size, eta = gradient(x), np.abs(gradient(x)).sum(), 1e-7
    assert size > 1.0
    of_vertices = np.ones(pairs.contact.capacity, dtype=bool)
    of_vertices[slice(*np.cumsum(pairs.proximity.counts.numpy()))] = False
    for _ in range(3):
        direction = rng.normal(size=x.shape)
        (after, *_, w1, s1), (before, *_, w0, s0) = (of_contacts(x + sign * eta * direction) for sign in (1.0, -1.0))
        _, bend, n, w, stencils = of_contacts(x)
        same = of_vertices & (after != 0.0) & (before != 0.0)
        for weights, each in ((w1, s1), (w0, s0)):
            same &= ((weights != 0.0) == (w != 0.0)).all(axis=1) & (each == stencils).all(axis=1)
        growth = bend * np.einsum("ei,ej,eij->e", w, n, direction[stencils])
        assert (same & (bend > 0.0)).sum() > 20
        assert ((after - before) / (2.0 * eta))[same & (bend > 0.0)] == pytest.approx(
            growth[same & (bend > 0.0)], abs=1e-4 * bend.max()
        )
        slope = (energy(x + eta * direction) - energy(x - eta * direction)) / (2.0 * eta)
        assert slope == pytest.approx((force * direction).sum(), abs=1e-5 * size)
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-13 * size


@pytest.mark.parametrize("count", [2, 3, 4])
def test_pressure_of_a_stack(count, device):
    """p = Σ m f(m d) on the top layer over all layers within r, f = −kφ′."""
    r, k, d = 5e-3, 1e5, 1.3e-3
    pairs, model = steps_of(layers(count, gap=d, distance=r, stiffness=k), device)
    pairs.launch_begin(model.positions)
    out = model.vectors()
    pairs.forces.launch(model.positions)
    pairs.forces.add_gradient(out)
    top = -out.numpy()[-36:, 1].sum() / 0.25

    def f(d):
        return k * (r - d if d >= 0.5 * r else 0.25 * r * r / d) * (d < r)

    assert top == pytest.approx(sum(f(m * d) for m in range(1, count)), rel=1e-9)


@pytest.mark.parametrize(
    ("solver", "turns"),
    [
        (wc.Explicit(substeps=80), True),
        (wc.Newton(substeps=10, tolerance=1e-13, integrator="midpoint", linear="factorised"), True),
        (wc.Newton(substeps=10, tolerance=1e-13, linear="factorised"), False),
        (wc.XPBD(substeps=10, iterations=4), False),
    ],
    ids=["explicit", "midpoint", "newton", "xpbd"],
)
def test_momentum_is_kept(solver, turns, device):
    """Σp of two sheets that rebound with no vertex cut; ΣL by explicit steps and midpoint. To rounding, and 1e-13 of a step.

    Euler's implicit steps, d ← (d + hḋ + Kr)/(1 + K) within r with K = 2kh²/ρ = 23, leave flat sheets 5 mm/s each of 0.2 m/s.
    """
    scene = layers(n=4, turn=17.0, gap=6e-3, speed=0.2)
    stepper = solver.bind(scene.build(device=device, dtype="float64"))
    mass, start = scene.vertex_masses[:, None], (scene.positions, scene.velocities)
    for _ in range(3):
        stepper.frame()
    end = tuple(array.numpy() for array in stepper.state)
    assert stepper.cut == 0.0 and end[1][16:, 1].mean() > (0.01 if turns else 5e-3)  # they fly apart
    linear = [(mass * v).sum(axis=0) for _, v in (start, end)]
    assert linear[1] == pytest.approx(linear[0], abs=1e-12 * (mass * np.abs(start[1])).sum())
    if turns:
        angular = [(mass * np.cross(x, v)).sum(axis=0) for x, v in (start, end)]
        assert angular[1] == pytest.approx(angular[0], abs=1e-11 * (mass * np.abs(start[1])).sum())


@pytest.mark.host
@pytest.mark.parametrize(
    ("kind", "gamma", "depth", "error"),
    [
        ("pear", 0.0, 0.424308, 1e-3),
        ("ring", 0.0, 0.318310, 1e-3),
        ("heart", 0.0, 0.133860, 2e-3),
        ("heart", 10.0, 0.139540, 4e-3),
        ("heart", 100.0, 0.184043, 4e-3),
        pytest.param("heart", 400.0, 0.275445, 4e-3, marks=SLOW),
    ],
)
def test_hanging_loops_are_elastica(kind, gamma, depth, error, device):
    """Depth over length, by shooting; the ends come as near as the contact distance, L/2000, and loops spread from there."""
    rest = wc.equilibrium(loop.scene(kind=kind, gamma=gamma, length=1.0), device=device)
    assert rest.status.ok and rest.stable, rest.status
    assert -rest.points[:, 1].min() == pytest.approx(depth, rel=error)


@pytest.mark.host
@pytest.mark.parametrize(
    ("dtype", "mesh"), slow_but([("float64", False)], [("float32", False), ("float64", False), ("float64", True)])
)
def test_a_stack_rests(dtype, mesh, device):
    """Gaps of 12 sheets on a floor that move up and down only: all within r press on one another, in both stages of φ."""
    stack = scene("stack", sheets=12, n=4, friction=0.0)
    floor = stack.colliders[0]
    if mesh:
        corners = [[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]
        floor = wc.MeshCollider(points=corners, triangles=[[0, 2, 1], [0, 3, 2]], name="floor")
    r = stack.self_contact.distance
    k = 10.0 * 0.15 * 9.81 / r
    soft = {"contact": replace(stack.contact, stiffness=k), "self_contact": replace(stack.self_contact, stiffness=k)}
    stack = replace(stack, colliders=[floor], free_axes=np.tile([False, True, False], (12 * 16, 1)), **soft)
    rest = wc.equilibrium(stack, device=device, dtype=dtype, record=("energies", "reactions"))
    assert rest.status.ok and rest.stable, rest.status
    high = rest.points[:, 1].reshape(12, 16)

    def f(d):
        return np.where(d < 0.5 * r, 0.25 * k * r * r / d, k * np.maximum(r - d, 0.0))

    at = np.concatenate([[0.0], high.mean(axis=1)])
    apart = at[:, None] - at
    # Contact with the floor is as stiff.
    pushes = np.sign(apart) * f(np.where(apart == 0.0, r, np.abs(apart)))
    # float32 rounds positions of 13 mm by 1e-9 m, a force of kε.
    tolerance = 1e-6 if dtype == "float64" else 5e-3
    assert pushes[1:].sum(axis=1) == pytest.approx(np.full(12, 0.15 * 9.81), rel=tolerance)
    assert np.diff(at).min() < 0.45 * r and np.diff(at).max() > 0.5 * r
    assert np.ptp(high, axis=1).max() < tolerance * r
    assert rest.energies["self-contact"] > 0.0
    assert rest.collider_forces["floor"][1] == pytest.approx(-9.81 * stack.vertex_masses.sum(), rel=tolerance)


@pytest.mark.host
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_sheet_rests_far_from_the_origin(dtype, device):
    """At 50 m, in float64 where it does at the origin: φ bears the weight at a third of r.

    In float32 the least gap f is 6 units in the last place, and ψ, which begins at 2f = 0.72 r, bears most of it above r/2.
    """
    r, k, w = 1e-4, 2e4, 0.15 * 9.81
    two = layers(n=4, gap=0.9 * r, distance=r, stiffness=k, gravity=(0.0, -9.81, 0.0), pins=np.arange(16))
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
    slope = k * (1.0 + 50.0 * r * r * to_f / f**2)
    assert k * (r - d + 25.0 * r * r * to_f**2 / f) == pytest.approx(np.full(16, w), abs=(ulp * slope).max())


@pytest.mark.host
def test_pins_that_cloth_holds_back(device):
    """Pins that are to go through a sheet: the rest is not called an equilibrium."""
    two = layers(turn=17.0, gap=0.02, n=4)
    keyframes = np.tile(two.positions, (2, 1, 1))
    keyframes[1, :16, 1] += 0.1
    rest = wc.equilibrium(replace(two, pins=wc.Pins(np.arange(32), keyframes)), iterations=20, device=device)
    assert rest.status.result is Result.ITERATIONS_USED_UP and not rest.stable
    assert rest.points[:16, 1].max() < 0.02


@pytest.mark.parametrize(
    ("name", "rise"),
    slow_but(
        [("xpbd", 0.06), ("pbd", 0.06), ("admm", 0.6)],
        [*((name, rise) for name in SOLVERS for rise in (0.06, 0.6)), ("midpoint", 0.06)],
    ),
)
def test_pins_that_pinned_cloth_holds_back(name, rise, device):
    """A border is to go through the pinned border of another sheet, at 0.24 or 2.4 m/s: it is held, and nothing is thrown.

    Solvers used to draw cloth after the prescribed pins, and then threw it at up to 38 m/s.
    """
    two, border = (
        layers(turn=17.0, gap=0.01, stiffness=1e4),
        np.setdiff1d(np.arange(36), np.arange(36).reshape(6, 6)[1:-1, 1:-1]),
    )
    held = np.concatenate([border, 36 + border])
    keyframes = np.tile(two.positions[held], (7, 1, 1))
    keyframes[:, :20, 1] += np.linspace(0.0, rise, 7)[:, None]
    scene = replace(two, pins=wc.Pins(held, keyframes))
    solver = wc.Newton(substeps=2, integrator="midpoint") if name == "midpoint" else SOLVERS[name]
    stepper = solver.bind(scene.build(device=device, dtype="float64"))
    for _ in range(6):
        stepper.frame()
        assert np.linalg.norm(stepper.state.v.numpy(), axis=1).max() < 1.0
        assert crossed(stepper.state.x.numpy(), two.mesh.triangles) == 0
    assert stepper.pairs.pins_held[0].farthest == pytest.approx(rise - 0.0075, abs=0.0026)


SHEET = np.arange(16).reshape(4, 4)
BORDERS = np.concatenate([np.setdiff1d(SHEET, SHEET[1:-1, 1:-1]) + first for first in (0, 16)])


@pytest.mark.parametrize(
    ("name", "gap", "held", "angles"),
    [
        *((name, gap, np.arange(32), [0.0, 0.3, 0.6, 0.9]) for name in ("newton", "pbd") for gap in (2e-3, 3e-3)),
        ("pbd", 2e-3, BORDERS, 33.3 * (np.arange(9) / 60) ** 2),
    ],
)
def test_pins_that_turn_together(name, gap, held, angles, device):
    """Two layers turn as one body, by 0.3 rad a frame, or faster and faster with free vertices that lag: no pin is held back.

    Corners of a pair move by more than its gap along its old normal.
    """
    two = layers(n=4, gap=gap, turn=17.0, distance=2e-3, size=0.15)
    turns = [np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]) for a in angles]
    keyframes = np.stack([two.positions[held] @ turn.T for turn in turns])
    scene = replace(two, pins=wc.Pins(held, keyframes))
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype="float64"))
    for expected in keyframes[1:]:
        stepper.frame()
        assert stepper.state.x.numpy()[held] == pytest.approx(expected, abs=1e-12)
    assert stepper.pairs.pins_held == []


def test_acting_contacts(device):
    """They are the slots with a stiffness, and their corners are in order at each vertex."""
    pairs, model = steps_of(layers(3, turn=17.0, gap=2e-3), device)
    contact = pairs.contact
    contact.list_corners()
    for _ in range(2):
        pairs.launch_begin(model.positions)
        contact.launch(model.positions)
        acting = np.flatnonzero(contact.data.stiffness.numpy())
        assert 0 < len(acting) < pairs.proximity.counts.numpy().sum()
        assert (np.sort(contact.pairs.acting.numpy()[: contact.pairs.number.numpy()[0]]) == acting).all()
        first, corners = contact.pairs.first.numpy(), contact.pairs.corners.numpy()[: 4 * len(acting)]
        assert (np.sort(corners) == (4 * acting[:, None] + np.arange(4)).ravel()).all()
        vertices = contact.pairs.stencils.numpy().reshape(-1)[corners]
        assert (vertices == np.repeat(np.arange(model.count), np.diff(first))).all()
        assert (np.diff(corners)[np.diff(vertices) == 0] > 0).all()


@pytest.mark.slow
@pytest.mark.host
def test_gaps_by_blocks(device):
    """They are those of the kernel that takes pairs one by one, to the bit, in full blocks and in others."""
    pairs, model = steps_of(layers(3, turn=17.0, gap=2e-3, n=10), device)
    pairs.launch_begin(model.positions)
    count = pairs.proximity.counts.numpy()
    assert (count > BLOCK).all() and (count % BLOCK > 0).any()
    arrays = pairs.begun.gap, pairs.begun.normal, pairs.begun.weights
    found = [array.numpy()[: count.sum()].copy() for array in arrays]
    for array in arrays:
        array.zero_()
    model.launch(model.kernel(begin_pairs, model.dtype), count.sum(), [pairs.pairs, model.positions], [pairs.begun])
    for array, before in zip(arrays, found, strict=True):
        assert (array.numpy()[: count.sum()] == before).all()


@cache
def minimiser(pressed, device):
    """Where a step of Newton's method ends from a scene of `PRESSED`; no vertex is cut."""
    stepper = wc.Newton(substeps=10, tolerance=1e-13).bind(
        layers(n=4, turn=17.0, **PRESSED[pressed]).build(device=device, dtype="float64")
    )
    stepper.step()
    assert stepper.cut == 0.0
    return stepper.state.x.numpy().copy()


@pytest.mark.parametrize(
    ("name", "pressed"),
    slow_but(
        [(name, "both_stages") for name in ("newton_factorised", "admm", "projective_dynamics", "constrained")],
        [(name, pressed) for name in MEET for pressed in PRESSED],
    ),
)
def test_minimiser_is_the_same(name, pressed, device):
    """Where no vertex is cut: the x(t + h) of Newton's method, which moves, and to 1e-8 m."""
    scene, expected = layers(n=4, turn=17.0, **PRESSED[pressed]), minimiser(pressed, device)
    stepper = MEET[name].bind(scene.build(device=device, dtype="float64"))
    stepper.step()
    assert stepper.cut == 0.0
    assert np.abs(expected - scene.positions).max() > 1e-5
    assert stepper.state.x.numpy() == pytest.approx(expected, abs=1e-8)


FREE = np.ones((32, 3), dtype=bool)
FREE[::3, 0] = FREE[::5, 1] = False


@cache
def end_with_locked_axes(name, device):
    """Where a step of a solver of `MEET`, or of Newton's method, ends with the axes that are not `FREE` locked."""
    scene, solver = layers(n=4, turn=17.0, gap=2.2e-3, free_axes=FREE), wc.Newton(substeps=10, tolerance=1e-13)
    stepper = MEET.get(name, solver).bind(scene.build(device=device, dtype="float64"))
    stepper.step()
    end = stepper.state.x.numpy().copy()
    assert stepper.cut == 0.0 and (end == scene.positions)[~FREE].all()
    assert np.abs(end - scene.positions).max() > 1e-4
    return end


@pytest.mark.parametrize("name", slow_but(("newton_factorised", "constrained"), MEET))
def test_minimiser_with_locked_axes(name, device):
    """Every third vertex keeps its x, and every fifth its y, to the bit; all solvers meet as above."""
    assert end_with_locked_axes(name, device) == pytest.approx(end_with_locked_axes("newton", device), abs=1e-8)


@each_solver
def test_locked_axes(name, device):
    """Vertices on rails along y, thrown at each other, stay on them to the bit."""
    scene = layers(turn=17.0, speed=1.0, free_axes=np.tile([False, True, False], (72, 1)))
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype="float64"))
    for _ in range(2):
        stepper.frame()
    x = stepper.state.x.numpy()
    assert (x[:, [0, 2]] == scene.positions[:, [0, 2]]).all()
    assert crossed(x, scene.mesh.triangles) == 0


@pytest.mark.parametrize("name", slow_but(["pbd", "hierarchical_pbd"], ["pbd", "hierarchical_pbd", "pbd_jacobi"]))
@pytest.mark.parametrize("tilt", [1e-9, 1e-4])
def test_locked_axes_almost_along_the_normal(name, tilt, device):
    """Sheets that cannot be moved apart, at an angle to the free axes that is rounding or small, stay about where they are.

    Else moves are longer by the inverse of the angle. In a sweep vertices move by at most ten times what a pair lacks, 1 mm.
    """
    scene = layers(turn=17.0, gap=4e-3, free_axes=np.tile([True, False, True], (72, 1)))
    points = scene.mesh.points + tilt * np.outer(np.arange(72) >= 36, [0.0, 1.0, 0.0]) * scene.mesh.points[:, :1]
    stepper = SOLVERS[name].bind(replace(scene, positions=points).build(device=device))
    stepper.frame()
    assert np.abs(stepper.state.x.numpy() - points).max() < 1e-2


# What steps mean for the filter is told by all at 100 m/s, and what the speed and the precision do by few.
@pytest.mark.parametrize(
    ("name", "speed", "dtype"),
    slow_but(
        [*((name, 100.0, "float32") for name in FEW), ("xpbd", 1.0, "float32")],
        [
            *((name, 100.0, "float32") for name in SOLVERS),
            *((name, *how) for name in FEW for how in ((1.0, "float32"), (100.0, "float64"))),
        ],
    ),
)
def test_thrown_at_each_other(name, speed, dtype, device):
    """Two sheets, at ``speed`` each, with frames of 1/24 s, in which they would move 100 times as far as they are apart."""
    scene = layers(turn=17.0, speed=speed)
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype=dtype))
    for _ in range(8):
        stepper.frame()
        assert crossed(stepper.state.x.numpy(), scene.mesh.triangles) == 0


@pytest.mark.parametrize("n", [2, 8, 9, 64])
def test_the_scene_of_a_folded_sheet_starts_at_rest(n):
    """Only the edges that bend around the fold are shorter than at rest, by less than the fold is long, π/2 of the gap."""
    declared = scene("folded_sheet", n=n)
    vectors = [points[declared.mesh.edges] for points in (declared.positions, declared.mesh.points)]
    now, rest = (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) for ends in vectors)
    assert np.all(now <= rest + 1e-12) and np.all(now >= rest - 0.5 * np.pi * 1e-3)


@few_solvers
def test_folded_sheet_closes(name, device):
    """Thrown shut at 100 m/s, in frames of 1/24 s: the two halves meet, and their layers do not cross."""
    scene = folded(n=9, gravity=np.zeros(3))
    closing = -100.0 * np.sign(scene.positions[:, 1:2]) * [0.0, 1.0, 0.0]
    stepper = SOLVERS[name].bind(replace(scene, velocities=closing).build(device=device, dtype="float32"))
    for _ in range(4):
        stepper.frame()
        assert crossed(stepper.state.x.numpy(), scene.mesh.triangles) == 0


@pytest.mark.parametrize(
    ("name", "collider"),
    slow_but([*((name, "box") for name in FEW), ("xpbd", "ball")], [*((name, "box") for name in SOLVERS), ("xpbd", "ball")]),
)
def test_thrown_on_a_collider(name, collider, device):
    """The filters of colliders and of self-contact together leave no vertex inside, and no crossing."""
    shapes = {
        "ball": wc.Sphere(radius=0.3, position=(0.0, -0.31, 0.0)),
        "box": wc.Box(size=(0.3, 0.3, 0.3), position=(0.0, -0.16, 0.0)),
    }
    collider = shapes[collider]
    given = {"colliders": [collider], "contact": wc.Contact(stiffness=1e4)}
    scene = layers(count=3, n=4, stiffness=500.0, **given)
    scene = replace(scene, velocities=np.tile([1.0, -10.0, 0.5], (48, 1)))
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype="float64"))
    for _ in range(6):
        stepper.frame()
        x = stepper.state.x.numpy()
        assert collider.distances(x).min() > 0.0 and crossed(x, scene.mesh.triangles) == 0


# The corners of a cube, whose index has the bits of x, y and z, and its triangles, counter-clockwise from outside.
CORNERS = 0.3 * (np.array([[i >> 2, i >> 1 & 1, i & 1] for i in range(8)]) - 0.5)
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
UP = np.arange(7)[:, None] / 6.0 * [0.1, 0.4, 0.0]
MOVING = {
    "ball": wc.Sphere(radius=0.3, position=UP - [0.0, 0.31, 0.0]),
    "box": wc.Box(size=(0.3, 0.3, 0.3), position=UP - [0.0, 0.16, 0.0]),
    "plane": wc.Plane(position=0.5 * UP - [0.0, 0.01, 0.0]),
    "mesh": wc.MeshCollider(CORNERS, FACES, position=[0.0, -0.16, 0.0]),
    "moving mesh": wc.MeshCollider(CORNERS, FACES, position=UP - [0.0, 0.16, 0.0]),
    "swelling mesh": wc.MeshCollider(CORNERS * (1.0 + UP[:, 1:2, None]), FACES, position=[0.0, -0.2, 0.0]),
}


# The filters are the same for all, and the solvers for any collider: each kind with one that sweeps, and each solver once.
@pytest.mark.parametrize(
    ("name", "kind"),
    slow_but(
        [("xpbd", kind) for kind in MOVING],
        [*(("xpbd", kind) for kind in MOVING), *((name, "moving mesh") for name in SOLVERS if name != "xpbd")],
    ),
)
def test_thrown_on_a_collider_that_comes_towards_it(name, kind, device):
    """At 3 m/s on one that is a mesh or moves, by up to 1.6 m/s: no vertex ends a frame inside, and no cloth crosses cloth."""
    collider, given = MOVING[kind], {"contact": wc.Contact(stiffness=1e4)}
    scene = layers(count=3, n=4, stiffness=500.0, turn=17.0, colliders=[collider], **given)
    scene = replace(scene, velocities=np.tile([0.5, -3.0, 0.2], (48, 1)))
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype="float32"))
    for frame in range(1, 5):
        stepper.frame()
        x = stepper.state.x.numpy()
        assert collider.distances(x, frame=frame).min() > 0.0
        assert crossed(x, scene.mesh.triangles) == 0
    assert stepper.inside == []


@pytest.mark.parametrize("name", slow_but(("xpbd",), list(SOLVERS)[:4]))
def test_contact_in_a_frame_that_moves(name, device):
    """Two sheets that fall on a plane at rest, and at rest on a plane that rises as fast, move the same relative to it."""
    ends = []
    for moves in (False, True):
        rise = np.arange(4)[:, None] / 24.0 * [0.0, 0.3, 0.0] * moves
        plane, given = wc.Plane(position=rise - [0.0, 0.01, 0.0]), {"contact": wc.Contact(distance=5e-3, stiffness=1e5)}
        scene = layers(gap=8e-3, n=4, turn=17.0, colliders=[plane], duration=0.125, **given)
        scene = replace(scene, velocities=np.tile([0.0, -0.3 * (not moves), 0.0], (32, 1)))
        solver = wc.Newton(substeps=10, tolerance=1e-12) if name == "newton" else SOLVERS[name]
        stepper = solver.bind(scene.build(device=device, dtype="float64"))
        for _ in range(3):
            stepper.frame()
        ends.append(stepper.state.x.numpy() - rise[-1])
    assert np.ptp(ends[0][:, 1]) > 1e-3
    assert ends[1] == pytest.approx(ends[0], abs=1e-9)


@few_solvers
def test_what_colliders_close_on(name, device):
    """A box that presses two layers onto a pinned one: the run names a vertex that had no way out, and no layer crosses."""
    rise = np.arange(6)[:, None] * [0.0, 0.01, 0.0]
    box, given = wc.Box(size=(0.6, 0.1, 0.6), position=rise - [0.0, 0.06, 0.0]), {"contact": wc.Contact(stiffness=1e4)}
    scene = layers(count=3, n=4, gap=0.01, colliders=[box], pins=np.arange(32, 48), **given)
    animation = wc.simulate(scene, SOLVERS[name], frames=3, device=device)
    (found,) = animation.inside
    assert found.other == "other cloth"
    assert found.frame == 3
    assert found.vertex < 32
    assert f"vertex {found.vertex} is caught between Box and other cloth in frame" in str(found)
    for points in animation.points:
        assert crossed(points, scene.mesh.triangles) == 0


@pytest.mark.parametrize(
    ("name", "gap"),
    slow_but([(name, 5e-5) for name in FEW], [*((name, 5e-5) for name in SOLVERS), *((name, 2.5e-3) for name in FEW)]),
)
def test_starts_pressed_together(name, gap, device):
    """Sheets within the contact distance fly apart with the energy of contact at the start, which is no divergence."""
    animation = wc.simulate(layers(n=3, gap=gap, duration=0.125), SOLVERS[name], device=device)
    assert "diverged" not in animation.status.message
    assert np.ptp(animation.points[-1, :, 1]) > 5e-3


def diagonals():
    """A sheet that falls on a pinned one; diagonals of the two cross."""
    below = wc.Mesh.grid(4, 4, size=0.13, pattern="alternating")
    above = wc.Mesh(below.points * [-1.0, 1.0, 1.0] + [0.13, 2.5e-3, 0.0], below.triangles[:, [0, 2, 1]])
    return wc.Scene(
        wc.Mesh.join({"below": below, "above": above}),
        density=0.15,
        terms=[wc.Spring(stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        velocities=np.repeat([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]], 16, axis=0),
        pins="part(below)",
        self_contact=wc.SelfContact(distance=2e-3),
    )


IMPACTS = {
    "diagonals": (diagonals, {}, 10, 3, 1e-3),
    "2 m/s": (layers, {"turn": 17.0, "speed": 2.0, "stiffness": 500.0}, 1, 2, 1e-3),
    "short steps": (layers, {"n": 3, "gap": 2e-3, "speed": 2.0, "stiffness": 500.0}, 640, 10, 1.0),
}


@pytest.mark.parametrize("meet", IMPACTS)
def test_impact_converges(meet, device):
    """Where a step presses sheets flat, so that edges cross at small gaps. `Newton` used to use up its iterations
    there, held by the filter: it shortened directions at single vertices, so that the line search hardly made a step. Short
    steps stop the sheets with a pressure of ρv/h = 4600 Pa, where φ has 250 kr = 625 Pa at the least gap of the filter. They
    end at a residual of 0.35 m/s², 5e-6 of v/h."""
    make, given, substeps, steps, tolerance = IMPACTS[meet]
    scene = make(**given)
    stepper = wc.Newton(substeps=substeps, tolerance=tolerance).bind(scene.build(device=device, dtype="float64"))
    for _ in range(steps):
        stepper.step()
    assert stepper.results == [Result.CONVERGED]


@each_solver
def test_free_fall(name, device):
    """A flat sheet falls as if nothing had been declared: at ½gt(t + h) in steps h, 2.6 m in 0.7 s."""
    scene = replace(layers(1), gravity=np.array([0.0, -9.81, 0.0]))
    stepper = SOLVERS[name].bind(scene.build(device=device, dtype="float64"))
    for _ in range(17):
        stepper.frame()
    t = 17.0 / 24.0
    moved = stepper.state.x.numpy() - scene.positions
    assert stepper.cut == 0.0
    assert moved == pytest.approx(np.tile([0.0, -0.5 * 9.81 * t * (t + stepper.h), 0.0], (36, 1)), abs=1e-11)


@pytest.mark.parametrize("substeps", slow_but([200], [100, 200]))
def test_energy_is_conserved(substeps, device):
    """Sheets that part at a gap of r/2, without cuts: what explicit steps lose of the energy at the start is of order h²."""
    scene = layers(n=3, gap=2.5e-3, duration=1 / 24)
    energies = wc.simulate(scene, wc.Explicit(substeps=substeps), device=device, dtype="float64", record="energies").energies
    total = sum(energies.values())
    print(substeps, total, energies)
    assert energies["self-contact"][0] == pytest.approx(0.5 * 1e5 * 0.25 * 2.5e-3**2)
    assert energies["self-contact"][-1] < energies["self-contact"][0]
    assert total[-1] == pytest.approx(total[0], rel=0.05 * (100 / substeps) ** 2)


def test_pins_bear_what_lies_on_them(device):
    """Reactions of a pinned sheet are its weight and that of the sheet that rests on it, at a gap of r − ρg/k."""
    scene = layers(gap=5e-3 - 0.15 * 9.81 / 1e4, stiffness=1e4, gravity=(0.0, -9.81, 0.0), pins=np.arange(36), duration=1 / 12)
    given = {"device": device, "dtype": "float64", "record": ("energies", "reactions")}
    animation = wc.simulate(scene, wc.Newton(substeps=2, tolerance=1e-9), **given)
    weight = 0.15 * 0.25 * 9.81
    assert animation.reactions[:, :, 1].sum(axis=1) == pytest.approx(2.0 * weight, rel=1e-6)
    assert animation.energies["self-contact"] == pytest.approx(0.5 * weight**2 / (1e4 * 0.25), rel=1e-6)


@pytest.mark.parametrize("steps", [20, pytest.param(60, marks=SLOW)])
def test_violent_steps(steps, device):
    """Of random moves of up to a third of the sheet, from wherever the last ended, nothing crosses."""
    scene = folded(gravity=np.zeros(3))
    pairs, model = steps_of(scene, device)
    rng, x, v = np.random.default_rng(2), wp.clone(model.positions), model.vectors()
    unfiltered = 0
    pairs.grow_to(200_000)
    for step in range(steps):
        pairs.launch_begin(x)
        target = x.numpy() + 10.0 ** rng.uniform(-3.0, -0.8) * rng.normal(size=(model.count, 3))
        unfiltered += crossed(target, scene.mesh.triangles) > 0
        wp.copy(x, model.array(target, model.vec3))
        pairs.filter.launch_end(x, v)
        assert not pairs.overflowed
        assert crossed(x.numpy(), scene.mesh.triangles) == 0, step
    assert unfiltered > 0.5 * steps
    assert pairs.share > 0.5


@each_solver
def test_more_pairs_than_there_is_room_for(name, device):
    """A list that overflows in the middle of a run changes no bit, nor does another run."""
    scene, ends = layers(turn=17.0, speed=1.0, n=4), []
    model = scene.build(device=device)
    first, small = (SOLVERS[name].bind(model) for _ in range(2))
    small.pairs.grow_to(8)
    small.record_again()
    for stepper in (first, first, small):
        stepper.reset()
        for _ in range(3):
            stepper.frame()
        ends.append(stepper.state.copy())
    assert ends[0] == ends[1]
    assert ends[0] == ends[2]


@each_solver
def test_list_of_a_state(name, device):
    """Steps after a state was taken are the same, to the bit, whatever the stepper that takes them has listed before."""
    scene = layers(turn=17.0, speed=1.0)
    one, other = (SOLVERS[name].bind(scene.build(device=device)) for _ in range(2))
    for _ in range(2):
        one.frame()
    other.frame()
    other.state.assign(one.state)
    for stepper in (one, other):
        stepper.frame()
    assert one.state == other.state


@pytest.mark.parametrize("count", [1, 2])
def test_lists_are_kept(count, device):
    """Sheets that fall together are listed once; a list that was made elsewhere is made anew, where the state says."""
    pairs, model = steps_of(layers(count), device)
    pairs.launch_begin(model.positions)
    first, listed = model.positions.numpy(), pairs.proximity.stencils.numpy()
    fallen = model.array(first - np.array([0.0, 1.0, 0.0]), model.vec3)
    pairs.launch_begin(fallen)
    assert (pairs.proximity.found.numpy() == first).all()
    rolled = model.array(first * [1.0, 1.0, 0.5], model.vec3)
    pairs.launch_begin(rolled)
    assert (pairs.proximity.found.numpy() == rolled.numpy()).all()
    wp.copy(pairs.proximity.found, model.positions)
    pairs.launch_begin(fallen)
    assert (pairs.proximity.found.numpy() == first).all()
    number = pairs.proximity.counts.numpy().sum()
    assert (pairs.proximity.stencils.numpy()[:number] == listed[:number]).all()


@pytest.mark.parametrize("ratio", [1.5, 2.0])
def test_forces_do_not_depend_on_the_age_of_a_list(ratio, device):
    """Of thick folded cloth, where many contacts cancel: forces are the same, to the bit, with a new list."""
    scene = folded(gap=0.01)
    scene = replace(scene, self_contact=wc.SelfContact(distance=ratio * scene.mesh.edge_lengths.max(), stiffness=1e4))
    pairs, model = steps_of(scene, device)
    rng, forces = np.random.default_rng(0), []
    for _ in range(4):
        x = scene.positions + 0.006 * rng.normal(size=scene.positions.shape) * [0.2, 1.0, 0.2]
        moves = rng.normal(size=x.shape)
        moved = x + 0.1 * pairs.skin * moves / np.linalg.norm(moves, axis=1)[:, None]
        for points in (x, moved, moved):
            if len(forces) % 3 != 1:
                pairs.start_again()
            points, out = model.array(points, model.vec3), model.vectors()
            pairs.launch_begin(points)
            while pairs.overflowed:
                pairs.grow()
                pairs.launch_begin(points)
            assert ((pairs.proximity.found.numpy() == points.numpy()).all()) == (len(forces) % 3 != 1)
            pairs.forces.launch(points)
            pairs.forces.add_gradient(out)
            forces.append(out.numpy())
        assert np.abs(forces[-1]).max() > 0.0
        assert (forces[-1] == forces[-2]).all()


@pytest.mark.parametrize(
    ("name", "speed"),
    slow_but(
        [("explicit", 20.0), ("xpbd", 0.02), ("newton", 0.0), ("xpbd", 5.0)],
        [(name, v) for name in SOLVERS for v in (0.0, 0.02, 5.0, 20.0)],
    ),
)
def test_steps_with_nothing_near_are_those_with_contact(name, speed, device, monkeypatch):
    """To the bit, of sheets that fall, that bend within the bounds of the list and beyond, and whose moves are long."""
    scene = layers(1, gravity=np.array([0.0, -9.81, 0.0]))
    bent = speed * np.sin(9.0 * scene.positions[:, :1]) * [0.3, 1.0, 0.0]
    ends, skips, meets = [], wp.capture_if, PairSystem._meets
    for tested in (True, False):
        stepper = SOLVERS[name].bind(replace(scene, velocities=bent).build(device=device, copies=2))
        if not tested:
            flags = stepper.pairs.listed, stepper.pairs.near.array
            always = partial(_launch_always, skips, flags)
            monkeypatch.setattr(wp, "capture_if", always)
            monkeypatch.setattr(PairSystem, "_meets", lambda system, d, w: meets(system, d, w) or True)
            stepper.record_again()
        for _ in range(3):
            for _ in range(stepper.steps_per_frame):
                stepper.step()
            stepper.frame()
        ends.append(stepper.state.copy())
    assert ends[0] == ends[1]
    assert (stepper.pairs.lists.numpy() > (1 if speed > 1.0 else 0)).all()
    assert stepper.pairs.steps.numpy().tolist() == [6 * stepper.steps_per_frame] * 2


def _launch_always(skips, flags, condition, on_true=None, on_false=None, **given):
    """Calls ``on_true`` for a condition that is one of ``flags``."""
    if any(condition is flag for flag in flags):
        on_true(**given)
    else:
        skips(condition, on_true, on_false, **given)


@pytest.mark.parametrize(
    ("name", "distance", "count"),
    slow_but(
        [("explicit", 5e-3, 2), ("newton", 5e-3, 2), ("xpbd", 0.15, 2)],
        [
            *((name, 5e-3, 2) for name in SOLVERS),
            *((name, 0.15, 2) for name in FEW),
            *(("constrained_dynamics", 5e-3, count) for count in (3, 4)),
            ("xpbd_that_follows", 5e-3, 2),
        ],
    ),
)
def test_copies(name, distance, count, device):
    """Each of two copies, at speeds of their own, moves as one alone, to the bit, and again after it was put back.

    Of these the filter cuts one and not the other, and lists are made anew at other times, also within a step.
    """
    solver = wc.XPBD(substeps=4, iterations=50) if name == "xpbd_that_follows" else SOLVERS[name]
    n = 5 if count == 2 else 4
    scene = layers(count, turn=17.0, speed=1.0, n=n, distance=distance, stiffness=1e5 if distance < 0.1 else 100.0)
    velocities = np.stack([3.0 * scene.velocities, 0.1 * scene.velocities])
    steppers = [solver.bind(scene.build(device=device, copies=copies)) for copies in (1, 1, 2)]
    for stepper, given in zip(steppers, (velocities[:1], velocities[1:], velocities), strict=True):
        stepper.reset(velocities=given)
    both = steppers.pop()
    for again in (False, True):
        if again:
            both.reset([True, False], velocities=velocities)
        for _ in range(2):
            both.frame()
            for stepper in steppers[again:]:
                stepper.frame()
        for found, stepper in zip(both.state.x.numpy().reshape(2, -1, 3), steppers, strict=True):
            assert (found == stepper.state.x.numpy()).all()
            assert crossed(found, scene.mesh.triangles) == 0


@pytest.mark.parametrize("way", [0.03, 0.3, 3.0, 300.0])
def test_directions_of_one_vertex(way, device):
    """A vertex that is to go through a sheet at rest, whose triangles have boxes smaller than its own: it ends before it."""
    scene = layers(gap=0.02)
    pairs, model = steps_of(scene, device)
    x = scene.positions + np.where(np.arange(72)[:, None] < 36, 0.0, [0.03, 0.0, 0.06])  # above the inside of a triangle
    pairs.launch_begin(model.array(x, model.vec3))
    direction = np.zeros((72, 3))
    direction[36 + 14, 1] = -way
    pairs.filter.launch_limit(model.array(direction, model.vec3))
    (fraction,) = pairs.filter.fraction.numpy()
    assert 0.5 * 0.02 < fraction * way < 0.02


def test_sweeps_over_coarse_levels_find_no_contacts_anew(device):
    """Only those over all terms count, where the halves of a fold are near enough to be listed."""
    stepper = wc.HierarchicalPBD(substeps=1, iterations=3).bind(folded(gap=-0.05).build(device=device))
    stepper.step()
    assert len(stepper.levels) > 1 and stepper.pairs.contact.turn.numpy() == [3]


@pytest.mark.parametrize(("way", "walks"), [(0.01, False), (-0.05, True)])
def test_where_a_step_with_moving_pins_starts(way, walks, device):
    """Sheets that would pass through one another, whose pin moves: cloth stays, but follows a pin that itself meets cloth.

    The pin is of the upper sheet, and goes through the lower one too in the second case.
    """
    pin = 36 + 14
    frames = layers().positions[[pin]] + np.array([0.0, 1.0, 0.0]) * np.array([0.0, way])[:, None, None]
    scene = layers(pins=wc.Pins([pin], frames), duration=1.0 / 24.0)
    pairs, model = steps_of(scene, device)
    pairs.launch_begin(model.positions)
    base, d = scene.positions.copy(), model.vectors()
    base[36:, 1] -= 0.05
    base[pin] = frames[-1]
    pairs.filter.launch_start(model.array(base, model.vec3), d)
    start = base + d.numpy()
    free = np.arange(72) != pin
    assert crossed(start, scene.mesh.triangles) == 0
    if walks:
        assert (np.abs(start - scene.positions).max(axis=1)[36:] > 1e-3).all()
    else:
        assert start[pin] == pytest.approx(base[pin], abs=1e-15)
        assert start[free] == pytest.approx(scene.positions[free], abs=1e-15)


def test_directions_by_the_list(device):
    """Along moves for which the list is kept, its pairs give the fraction that a search of all pairs gives, to the bit."""
    scene = layers(turn=17.0, gap=5e-3)
    pairs, model = steps_of(scene, device)
    pairs.launch_begin(model.positions)
    random, found = np.random.default_rng(0), []
    direction = 0.2 * pairs.skin * random.uniform(-1.0, 1.0, scene.positions.shape)
    for listed in (True, False):
        if not listed:
            pairs.proximity.found.assign(random.uniform(-1.0, 1.0, scene.positions.shape))
        pairs.filter.launch_limit(model.array(direction, model.vec3))
        assert pairs.proximity.copies.numpy() == [not listed]
        found.append(pairs.filter.fraction.numpy()[0])
    assert found[0] == found[1] and 0.0 < found[0] < 1.0


@pytest.mark.parametrize("length", [0.1, 1.0, 14.0])
def test_planes_between_edges_that_are_nearly_parallel(length, device):
    """Edges at 1e-8 to 1e-2 rad with a gap of 5 µm: y separates all vertices by nine tenths of it."""
    rng, gap, count = np.random.default_rng(3), 5e-6, 600
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    angle = 10.0 ** rng.uniform(-8.0, -2.0, (count, 1))
    first, second = q[:, 0], np.cos(angle) * q[:, 0] + np.sin(angle) * q[:, 1]
    ends = length * rng.uniform(0.1, 1.0, (4, count, 1))
    points = np.stack([-ends[0] * first, ends[1] * first, -ends[2] * second - gap * q[:, 2], ends[3] * second - gap * q[:, 2]])
    out = wp.zeros(count, dtype=wp.vec3d, device=device)
    wp.launch(nearest_of_edges, count, [wp.array(each, dtype=wp.vec3d, device=device) for each in points], [out], device=device)
    y = out.numpy()
    n = y / np.linalg.norm(y, axis=1)[:, None]
    a, b, c, d = (np.einsum("ij,ij->i", n, each - points[0]) for each in points)
    assert (np.minimum(a, b) - np.maximum(c, d) > 0.9 * gap).all()


@pytest.mark.parametrize("angle", [1e-5, 1e-3, 0.1])
def test_planes_of_a_vertex_above_a_thin_triangle(angle, device):
    """Triangles 10 m long with such an angle, and a vertex 5 µm above their inside: y separates all as above."""
    rng, gap, count = np.random.default_rng(4), 5e-6, 600
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    length = rng.uniform(5.0, 10.0, (2, count, 1))
    a, b = np.zeros((count, 3)), length[0] * q[:, 0]
    c = length[1] * (np.cos(angle) * q[:, 0] + np.sin(angle) * q[:, 1])
    w = 0.05 + 0.85 * rng.dirichlet([1.0, 1.0, 1.0], count)
    w /= w.sum(axis=1)[:, None]
    p = w[:, :1] * a + w[:, 1:2] * b + w[:, 2:] * c + gap * q[:, 2]
    points, out = np.stack([p, a, b, c]), wp.zeros(count, dtype=wp.vec3d, device=device)
    given = [wp.array(each, dtype=wp.vec3d, device=device) for each in points]
    wp.launch(nearest_of_triangle, count, given, [out], device=device)
    y = out.numpy()
    n = y / np.linalg.norm(y, axis=1)[:, None]
    a, b, c = (np.einsum("ij,ij->i", n, each - p) for each in points[1:])
    assert (-np.maximum(np.maximum(a, b), c) > 0.9 * gap).all()


@wp.kernel(module="unique", enable_backward=False)
def nearest_of_triangle(
    a: wp.array(dtype=wp.vec3d),
    b: wp.array(dtype=wp.vec3d),
    c: wp.array(dtype=wp.vec3d),
    d: wp.array(dtype=wp.vec3d),
    out: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    _w, y, _inside = nearest(True, a[i], b[i], c[i], d[i])
    out[i] = y


@wp.kernel(module="unique", enable_backward=False)
def nearest_of_edges(
    a: wp.array(dtype=wp.vec3d),
    b: wp.array(dtype=wp.vec3d),
    c: wp.array(dtype=wp.vec3d),
    d: wp.array(dtype=wp.vec3d),
    out: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    _w, y, _inside = nearest(False, a[i], b[i], c[i], d[i])
    out[i] = y


@few_solvers
def test_resets_that_are_refused(name, device):
    """A copy is not reset to sheets that coincide or cross; the others, and where it was, stay as they were."""
    scene = layers(n=3, turn=17.0)
    stepper = SOLVERS[name].bind(scene.build(device=device, copies=2))
    stepper.frame()
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
    stepper = SOLVERS[name].bind(replace(layers(), self_contact=None).build(device=device))
    assert stepper.pairs is None
    assert not any("pairs" in kernel for kernel in stepper.model.kernels)


def test_solvers_that_refuse(device):
    class Other(wc.Newton):
        touches_itself = False

    with pytest.raises(ValueError, match=r"Other cannot take self_contact; .* can"):
        Other(substeps=1).bind(layers().build(device=device))


def test_what_is_refused(device):
    with pytest.raises(ValueError, match=r"self_contact\.stiffness has no default without gravity and a spring or membrane"):
        layers(stiffness=None, terms=[])
    with pytest.raises(ValueError, match="mesh without triangles"):
        wc.Scene(wc.Mesh.chain(3), density=1.0, self_contact=wc.SelfContact())
    with pytest.raises(ValueError, match=r"self_contact\.held_pins is 'run'"):
        wc.SelfContact(held_pins="run")
    with pytest.raises(ValueError, match="self_contact is 1; it must be a SelfContact or None"):
        wc.Scene(wc.Mesh.grid(3, 3), density=1.0, self_contact=1)
    with pytest.raises(ValueError, match="symplectic Euler is stable below"):
        wc.Explicit(substeps=1).bind(layers(stiffness=1e7).build(device=device))
    weightless, K, L = layers(stiffness=None).self_contact.stiffness, 200.0 / np.sqrt(3.0), np.sqrt(0.5)  # of both sheets
    assert weightless == pytest.approx(2.0 / 5e-3 * K / L)
    heavy = layers(stiffness=None, gravity=None).self_contact.stiffness
    assert heavy == pytest.approx(weightless + 2.0 / 5e-3**2 * 0.15 * 9.81 * L)


@pytest.mark.filterwarnings("error")
def test_all_pinned(device):
    scene = layers(n=2, gap=1e-3, duration=1 / 24, pins="all")
    assert wc.simulate(scene, SOLVERS["explicit"], device=device).points[-1] == pytest.approx(scene.positions)


def test_starts_that_are_refused(device):
    with pytest.raises(ValueError, match=r"vertex 0 and triangle .* start 1e-06 m apart; self_contact needs more than"):
        wc.Newton(substeps=1).bind(layers(gap=1e-6, pins="all").build(device=device))
    scene = layers(turn=17.0)
    through = scene.positions.copy()
    through[40, 1] -= 0.04
    with pytest.raises(ValueError, match=r"edge .* and triangle .* cross at the start"):
        wc.Newton(substeps=1).bind(replace(scene, positions=through).build(device=device))


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
        steps_of(scene, device)


def test_crossings():
    """An edge through the middle of a triangle, beside it, and one with a vertex of it."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.8, 0.8, -1], [0.8, 0.8, 1]])
    edges, triangles = np.array([[3, 4], [5, 6], [0, 4]]), np.tile([[[0, 1, 2]]], (3, 1, 1))
    ((edge, triangle),) = crossings(points, edges, triangles)
    assert edge.tolist() == [3, 4]
    assert triangle.tolist() == [0, 1, 2]


STACK = wc.Mesh.grid(4, 4, size=0.5, pattern="alternating")


def start_of(*panels, **fields):
    """A scene of panels, each (points, triangles) or points of :data:`STACK`, with a contact distance of 2 mm."""
    parts = [wc.Mesh(*panel) if isinstance(panel, tuple) else wc.Mesh(panel, STACK.triangles) for panel in panels]
    return wc.Scene(
        wc.Mesh.join({f"panel{k}": part for k, part in enumerate(parts)}),
        density=0.15,
        terms=[wc.Spring(stiffness=100.0)],
        self_contact=wc.SelfContact(distance=2e-3, stiffness=1e4),
        fps=24.0,
        **fields,
    )


FLAT, UP = STACK.points, np.array([0.0, 1.0, 0.0])
UPRIGHT = np.stack([FLAT[:, 0], FLAT[:, 2], 0.0 * FLAT[:, 1] + 0.2], axis=1)
SHIFTED, FLIPPED = FLAT + np.array([0.1, 0.0, 0.05]), (FLAT, STACK.triangles[:, ::-1])
# Panels that touch, and the moves of each over the contact distance, along its y axis; None if they cannot be moved.
TOUCHING_STARTS = {
    "coinciding": ([FLAT, FLAT], [-0.5, 0.5]),
    "shifted": ([FLAT, SHIFTED], [-0.5, 0.5]),
    "facing away": ([FLIPPED, FLAT], [-0.5, 0.5]),
    "facing away, the other first": ([FLAT, FLIPPED], [0.5, -0.5]),
    "a micrometre below": ([FLAT, FLAT - 1e-6 * UP], [0.5, -0.5 - 5e-4]),
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
    expected = np.repeat(2e-3 * np.array(moves), 16)
    for copy in range(2):
        assert run.points[0, copy, :, 1] == pytest.approx(expected, abs=1e-9)
        assert np.abs(run.points[0, copy] - scene.positions)[:, [0, 2]].max() <= np.finfo(dtype).eps
    count = 2 * 16 * np.count_nonzero(moves)
    assert run.self_contact.moved_apart == (
        f"{count} vertices that touched other cloth at the start were moved off it, by up to {2.0 * np.abs(moves).max():.2g} mm"
    )
    assert not wc.intersections(run.points[:, 0], scene.mesh).counts.any()
    shuffled = scene.build(device=device, dtype=dtype, order=np.random.default_rng(0).permutation(len(scene.positions)))
    stepper = wc.XPBD(substeps=2).bind(shuffled)
    found = shuffled.in_scene_order(stepper.state.x.numpy())
    assert found == pytest.approx(run.points[0, 0], abs=1e-9)
    stepper.frame()
    stepper.reset()
    assert (shuffled.in_scene_order(stepper.state.x.numpy()) == found).all()


def test_a_panel_that_stands_on_another_starts_above_it(device):
    """Only the triangles that it touches are moved."""
    scene = start_of(FLAT, UPRIGHT)
    start = wc.XPBD(substeps=2).bind(scene.build(device=device, dtype="float64")).state.x.numpy() - scene.positions
    moved = np.linalg.norm(start, axis=1) > 0.0
    assert moved[:16].sum() == 8 and moved[16:].sum() == 8 and start[:16, 1].min() == pytest.approx(-1e-3)
    plain = wc.simulate(start_of(FLAT, UPRIGHT + 1e-3 * UP), wc.XPBD(substeps=2), device=device, frames=1)
    assert plain.self_contact.moved_apart is None


STAYING = {
    "crossing at 90 degrees": (lambda: start_of(FLAT, UPRIGHT - [0.0, 0.25, 0.0]), "cross at the start; self_contact needs"),
    "both pinned": (lambda: start_of(FLAT, FLAT, pins="all"), "start 0 m apart; self_contact needs more than"),
    "one piece": (lambda: start_of(FLAT, positions=np.abs(FLAT - [0.25, 0.0, 0.0])), "start 0 m apart"),
    "over a floor": (
        lambda: start_of(FLAT, FLAT, colliders=[wc.Plane(position=(0.0, -5e-4, 0.0))]),
        "starts 0.0005 m inside the collider Plane, after it was moved off other cloth",
    ),
}


@pytest.mark.parametrize("name", STAYING)
def test_starts_that_stay_refused(name, device):
    make, message = STAYING[name]
    with pytest.raises(ValueError, match=message):
        wc.XPBD(substeps=2).bind(make().build(device=device))
