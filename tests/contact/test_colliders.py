"""Colliders: their shapes and motion, the energies of contact and friction, and that no step ends inside or crosses one."""

import json
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import trimesh
import warp as wp

import warpcloth as wc
from support.energies import energies_of_elements, energy_and_gradient
from support.layers import DENSITY, GRAVITY, R, falling, ground, positions
from support.rows import table
from support.shapes import TILTED, Torus
from support.steps import after_frames, stopped_and_resumed
from warpcloth.cli import main
from warpcloth.contact.clearance import Clearance
from warpcloth.core.hessian import Hessian
from warpcloth.core.status import Result
from warpcloth.kernels.term import HessianPolicy
from warpcloth.lab.counts import launches_of
from warpcloth.usd import write_scene

SHAPES = {
    "plane": wc.Plane(normal=(0.2, 1.0, 0.1), position=(0.0, -0.11, 0.0)),
    "sphere": wc.Sphere(radius=0.1, position=(0.25, -0.12, 0.25)),
    "capsule": wc.Capsule(radius=0.05, length=0.2, axis=(1.0, 0.2, 1.0), position=(0.25, -0.15, 0.25)),
    "box": wc.Box(size=(0.2, 0.1, 0.3), position=(0.25, -0.25, 0.25), rotation=TILTED),
    "thin box": wc.Box(size=(0.3, 0.001, 0.3), position=(0.25, -0.1, 0.25)),
    "torus from outside": Torus(radius=0.15, tube=0.05, position=(0.25, -0.2, 0.25), rotation=TILTED),
}
CUBE = trimesh.creation.box((0.2, 0.1, 0.3))
each_shape = pytest.mark.parametrize("shape", SHAPES)
SOLVERS = {
    "explicit": wc.Explicit(substeps=40),
    "newton": wc.Newton(substeps=1),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1),
    "xpbd": wc.XPBD(substeps=1, iterations=30),
    "pbd": wc.PBD(substeps=1, iterations=30),
    "hierarchical pbd": wc.HierarchicalPBD(substeps=1, iterations=30),
    "admm": wc.ADMM(substeps=1, iterations=50),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, iterations=20),
}
each_solver = table("name", ("explicit", "newton", "xpbd", "pbd"), SOLVERS)


@cache
def near(shape, count=50):
    """Points about the surface of a collider, most of them within the contact distance."""
    collider, random = SHAPES[shape], np.random.default_rng(0)
    points = random.uniform(-0.4, 0.4, size=(40 * count, 3)) + collider.poses[0, :3]
    for _ in range(60):  # along the normals, by differences
        e = 1e-7
        normals = np.stack([collider.distances(points + d) - collider.distances(points - d) for d in e * np.eye(3)], axis=1)
        points = points - collider.distances(points)[:, None] * normals / (2.0 * e)
        normals /= 2.0 * e
    good = (np.abs(collider.distances(points)) < 1e-9) & (np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-5)
    gaps = random.uniform(0.01, 1.3, size=good.sum()) * R
    return (points[good] + gaps[:, None] * normals[good])[:count]


def beads(points, stiffness, mass=1e-3, **fields):
    """Points that pairs of the softest springs join, so that contact alone moves them."""
    mesh, masses = wc.Mesh(points, edges=np.arange(len(points)).reshape(-1, 2)), np.full(len(points), mass)
    contact = wc.Contact(distance=R, stiffness=stiffness)
    return wc.Scene(mesh, masses=masses, terms=[wc.Spring(stiffness=1e-9)], contact=contact, **fields)


def touching(shape):
    """A model of points about a collider, by the contact with which alone they have energy."""
    scene = beads(near(shape), 1e4, mass=1.0, colliders=[SHAPES[shape]])
    return replace(scene, terms=[]).build(dtype="float64")


@each_shape
def test_gradient_and_hessian_are_derivatives(shape):
    """By central differences of 1e-8 m, of φ′ and φ″ that change over 1e-5 m and more."""
    model, e = touching(shape), 1e-8
    x = model.positions.numpy()

    def energies(x):
        return energies_of_elements(model, x)[0]

    def gradients(x):
        return energy_and_gradient(model, x)[1]

    def slopes(f, axis):
        return np.stack([(f(x + d) - f(x - d)) / (2.0 * e) for d in e * np.eye(3)], axis=axis)

    hessian = Hessian(model, policy=HessianPolicy.RAW)
    hessian.assemble(model.positions, 0.0)
    found, blocks = gradients(x), hessian.values.numpy()[hessian.diagonal.numpy()]
    gaps = SHAPES[shape].distances(x)
    smooth = (np.abs(gaps - R) > 2.0 * e) & (np.abs(gaps - 0.5 * R) > 2.0 * e)
    assert (gaps < 0.5 * R).sum() > 10 and ((gaps > 0.5 * R) & (gaps < R)).sum() > 10
    np.testing.assert_allclose(slopes(energies, 1), found, atol=1e-4 * np.abs(found).max())
    np.testing.assert_allclose(slopes(gradients, 2)[smooth], blocks[smooth], atol=1e-4 * np.abs(blocks).max())


def local_steps(term):
    @wp.kernel(module="unique", enable_backward=False)
    def steps(
        y: wp.array(dtype=wp.vec3d),
        rest: wp.array(dtype=wp.types.vector(13, wp.float64)),
        compliance: wp.float64,
        found: wp.array(dtype=wp.vec3d),
        residual: wp.array(dtype=wp.vec3d),
        constraints: wp.array(dtype=wp.vec2d),
    ):
        e = wp.tid()
        v = wp.matrix(shape=(1, 3), dtype=wp.float64)
        v[0] = y[e]
        p = wp.static(term.prox)(v, rest[e], compliance)
        found[e] = p[0]
        residual[e] = (p[0] - v[0]) / compliance + wp.static(term.gradient)(p, rest[e])[0]
        c = wp.static(term.constraint)(v, rest[e])
        slope = wp.static(term.gradient)(v, rest[e])[0]
        error = wp.length(c * wp.static(term.constraint_gradient)(v, rest[e])[0] - slope) / (wp.float64(1.0) + wp.length(slope))
        constraints[e] = wp.vec2d(wp.float64(0.5) * c * c - wp.static(term.energy)(v, rest[e]), error)

    return steps


@each_shape
@table("compliance", [1.0], [1e-3, 1.0, 1e3])
def test_prox_and_constraint_belong_to_the_energy(shape, compliance):
    """The prox is where (p − v)/c + ∂u/∂y is 0, from far inside too; u = ½C²."""
    model = touching(shape)
    (elements,), (_, gradient) = model.terms, energy_and_gradient(model)
    y, constraints = model.positions.numpy().copy(), wp.zeros(model.count, dtype=wp.vec2d)
    found, residual = model.vectors(), model.vectors()
    y[::3] += 5e-3 * (gradient / np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None])[::3]
    given = [model.array(y, model.vec3), elements.rest, compliance, found, residual, constraints]
    wp.launch(local_steps(elements.term), len(y), given, device="cpu")
    size = np.linalg.norm(found.numpy() - y, axis=1) / compliance
    assert (size > 0.0).sum() > 20 and np.linalg.norm(residual.numpy(), axis=1).max() < 1e-9 * max(size.max(), R)
    assert SHAPES[shape].distances(found.numpy()).min() > 0.0 or compliance < 1.0
    assert np.abs(constraints.numpy()).max() < 1e-12


BALL = trimesh.creation.icosphere(2, radius=0.1)
TORUS = trimesh.creation.torus(0.2, 0.06, major_sections=24, minor_sections=12)
BREATHING = [BALL.vertices * (1.0 + 0.3 * np.sin(180.0 * BALL.vertices[:, :1] + k)) for k in range(9)]
FLAT = wc.Mesh.grid(6, 6, size=0.3)
WAVY = FLAT.points + 0.03 * np.sin(20.0 * FLAT.points[:, :1]) * [0.0, 1.0, 0.0]
COMING = [there * BALL.vertices for there in (0, 0, 1, 1, 1, 0, 0, 1, 1)]
SPIN = [(0.0, 0.0, np.sin(0.4 * k), np.cos(0.4 * k)) for k in range(9)]
MOVING = {
    "mesh": [wc.MeshCollider(BALL.vertices, BALL.faces, position=(0.25, -0.12, 0.25), friction=0.3)],
    "concave mesh": [wc.MeshCollider(TORUS.vertices, TORUS.faces, position=(0.25, -0.25, 0.25), rotation=TILTED, friction=0.3)],
    "open mesh over a deforming one": [
        wc.MeshCollider(WAVY, FLAT.triangles, position=(0.1, -0.1, 0.1)),
        wc.MeshCollider(BREATHING, BALL.faces, position=[(0.25, -0.4 + 0.01 * k, 0.25) for k in range(9)]),
    ],
    "spinning box": [wc.Box(size=(0.6, 0.1, 0.1), position=(0.25, -0.2, 0.25), rotation=SPIN)],
    "mesh that comes and goes": [wc.MeshCollider(COMING, BALL.faces, position=(0.25, -0.12, 0.25))],
    "balls that close": [
        wc.Sphere(radius=0.1, position=[(0.25, -0.2 + 0.03 * k, 0.25) for k in range(9)]),
        wc.Sphere(radius=0.1, position=[(0.25, 0.3 - 0.005 * k, 0.25) for k in range(9)]),
    ],
    **{name: [replace(shape, friction=0.3)] for name, shape in SHAPES.items()},
}


# The filter is the same for all: explicit steps meet every kind, as does one that enters most without the filter. In float64
# margins differ, and no branch.
EVERY = [
    *product(("explicit", "projective dynamics"), MOVING, ["float32"]),
    *product(SOLVERS, ("mesh", "spinning box", "balls that close", "torus from outside"), ["float32"]),
    *product(["explicit"], ("plane", "mesh", "spinning box"), ["float64"]),
    ("projective dynamics", "balls that close", "float64"),
]


@table(
    "name, what, dtype", [("xpbd", "mesh", "float32"), ("newton", "torus from outside", "float32")], list(dict.fromkeys(EVERY))
)
def test_no_vertex_is_inside(name, what, dtype, device):
    """At 1 and 100 m/s and steps of 1/24 s, in which it moves 4 m; explicit steps are a fortieth of that."""
    colliders, solver = MOVING[what], SOLVERS[name]
    if name in ("pbd", "hierarchical pbd"):
        colliders = [replace(each, friction=0.0) for each in colliders]
    if name == "projective dynamics":  # what steps leave to be solved does not matter to the filter
        solver = replace(solver, iterations=10)
    stepper = after_frames(falling(colliders), solver, dtype=dtype, device=device)
    for speed in (1.0, 100.0):
        stepper.reset(velocities=falling(colliders, speed).velocities[None])
        for frame, x in enumerate(positions(stepper, 8), 1):
            points = x.astype(np.float64)
            for collider in colliders:
                assert collider.distances(points, frame).min() > 0.0, (speed, frame, collider.label)


@table("solver", ["midpoint"], ["explicit", "euler", "midpoint", "bdf2"])
@table("speed", [100.0], [10.0, 100.0])
def test_an_impact_without_friction_gains_no_energy(solver, speed, device):
    """Against a tilted plane, that some vertices meet long before others. With two steps a frame midpoint would add energy."""
    scene = falling([SHAPES["plane"]], speed, gravity=(0.0, 0.0, 0.0), contact=wc.Contact(distance=R, stiffness=1.47e4))
    solver = SOLVERS["explicit"] if solver == "explicit" else wc.Newton(substeps=4, integrator=solver, tolerance=1e-6)
    animation = wc.simulate(scene, solver, dtype="float64", device=device, record=("energies",))
    energies = sum(animation.energies.values())
    assert animation.status.complete and len(energies) == 9
    assert (energies < (1.0 + 1e-6) * energies[0]).all() and energies[-1] < 0.9 * energies[0]


GROOVE = [wc.Plane(normal=(side, 0.3, 0.0)) for side in (-1.0, 1.0)]
WEDGE = trimesh.Trimesh(
    [(x, y, z) for z in (-9.0, 9.0) for x, y in ((0.0, 0.0), (0.3, 1.0), (-0.3, 1.0))],
    [[0, 1, 4], [0, 4, 3], [0, 3, 5], [0, 5, 2]],
)
SLIDING = {
    "groove": GROOVE,
    "groove of triangles": [wc.MeshCollider(WEDGE.vertices * 9.0, WEDGE.faces)],
    "groove that closes": [
        replace(plane, rotation=[(0.0, 0.0, np.sin(side * k), np.cos(side * k)) for k in (0.0, 0.1)])
        for plane, side in zip(GROOVE, (-0.3, 0.3), strict=True)
    ],
    "ball on a floor": [wc.Sphere(radius=0.1, position=(0.0, -0.3, 0.0)), wc.Plane(position=(0.0, -0.4, 0.0))],
    "torus": [wc.MeshCollider(TORUS.vertices, TORUS.faces, position=(0.0, -0.3, 0.0), rotation=TILTED)],
    "torus from outside": [Torus(radius=0.2, tube=0.06, position=(0.0, -0.3, 0.0), rotation=TILTED)],
}


@table(
    "what, dtype",
    [("groove", "float32"), ("torus", "float32")],
    [*product(SLIDING, ["float32"]), *product(("groove that closes", "torus"), ["float64"])],
)
def test_what_slides_stays_outside(what, dtype, device):
    """Points that go in all directions at 100 m/s, by 0.1 m a step, so that what slides along one surface meets another."""
    random = np.random.default_rng(0)
    points, velocities = random.uniform((-0.3, -0.4, -0.3), (0.3, 1.0, 0.3), size=(2000, 3)), random.normal(size=(300, 3))
    velocities *= 100.0 / np.linalg.norm(velocities, axis=1)[:, None]
    walls = GROOVE if what == "groove of triangles" else SLIDING[what]  # an open mesh has no inside
    points = points[np.min([each.distances(points) for each in walls], axis=0) > 2.0 * R][:300]
    scene = beads(points, 1.0, velocities=velocities, colliders=SLIDING[what], fps=1000.0)
    stepper = after_frames(scene, wc.Explicit(substeps=1), dtype=dtype, device=device)
    for step, x in enumerate(positions(stepper, 40), 1):
        assert min(each.distances(x.astype(float), step).min() for each in walls) > 0.0, step
    assert stepper.inside == [] and stepper.cut[0] > (0.2 if "groove" in what else 0.001)


@table("name, open", [*product(("newton", "xpbd", "pbd"), [True])], [*product(SOLVERS, [True]), ("newton", False)])
def test_none_crosses_a_sheet_that_stands_in_the_way(name, open):
    """A sheet of 1e-6 m is as good as a thick one, and so is a mesh of no thickness."""
    wall = wc.Box(size=(40.0, 1e-6, 40.0), position=(0.25, -0.3, 0.25))
    if open:
        wall = ground(40.0, position=(0.0, -0.3, 0.0))
    animation = wc.simulate(falling([wall], 60.0), SOLVERS[name], dtype="float64")
    assert animation.points[..., 1].min() > -0.3


@table("name", ["newton", "xpbd"], ["newton", "projective dynamics", "xpbd", "admm", "constrained dynamics"])
def test_points_rest_on_a_shape_from_outside(name, device):
    """Points that move along y rest where k(r − d) n_y is their weight per area; d, from the tangent plane, is within r/500."""
    off, angle = np.linspace(-0.04, 0.04, 12), np.linspace(0.0, 6.0, 12)
    height = np.sqrt(0.05**2 - off**2)
    points = np.stack([(0.15 + off) * np.cos(angle), height + 0.8 * R, (0.15 + off) * np.sin(angle)], axis=1)
    pins, torus = wc.Pins(np.arange(12), axes="xz"), Torus(radius=0.15, tube=0.05)
    scene, upwards = beads(points, 1e6, pins=pins, colliders=[torus], fps=60.0, duration=1.0), height / 0.05
    gaps = R - 1e-3 * 9.81 / (1e6 * scene.contact_terms[0].areas * upwards)
    found = wc.simulate(scene, SOLVERS[name], dtype="float64", device=device).points[-1, :, 1]
    np.testing.assert_allclose((found - height) * upwards, gaps, atol=R / 500)


@each_solver
def test_nothing_near_changes_nothing(name):
    """Free fall with contact far away, or past a mesh that is a point, to rounding; without colliders nothing is built."""
    solver = replace(SOLVERS[name], substeps=40 if name == "explicit" else 4)
    ball = wc.MeshCollider(BALL.vertices, BALL.faces, position=(1.0, -50.0, 0.0))
    absent = wc.MeshCollider([*[0.0 * BALL.vertices] * 9, BALL.vertices], BALL.faces, position=(0.2, -0.2, 0.2))
    far = falling([wc.Sphere(radius=0.1, position=(0.0, -50.0, 0.0)), ball, absent], 0.0, contact=wc.Contact(stiffness=1e3))
    alone = replace(far, colliders=(), contact=None)
    one, other = (wc.simulate(scene, solver, dtype="float64") for scene in (far, alone))
    np.testing.assert_allclose(one.points, other.points, rtol=0.0, atol=1e-6 if name == "admm" else 1e-12)
    assert one.cut == 0.0
    stepper = solver.bind(alone.build())
    assert stepper.colliders is None and stepper.model.colliders is None
    assert not any("Contact" in kernel or "filter" in kernel for kernel in stepper.model.report()["kernels"])


@pytest.mark.parametrize("away", (2.0, 0.85))
@table("name", ("newton", "xpbd"), [name for name in SOLVERS if name != "explicit"])
def test_steps_with_nothing_near_are_those_with_contact(name, away):
    """A short spring stretches into a plane in a step for which its prediction, gravity alone, has nothing near."""
    mesh, plane = wc.Mesh.chain(2), wc.Plane(position=(0.0, -away, 0.0))
    fields = {"positions": 0.7 * mesh.points, "terms": [wc.Spring(stiffness=1e4)], "pins": [0], "fps": 24.0}
    contact = wc.Contact(distance=R, stiffness=1e6)
    scene = wc.Scene(mesh, masses=[1.0, 1.0], colliders=[plane], contact=contact, **fields)
    stepper, other = (after_frames(scene, SOLVERS[name], dtype="float64") for _ in range(2))
    other.colliders.follow()
    for each in (stepper, other, stepper, other):
        each.step()
    assert stepper.state == other.state and stepper.iterations == other.iterations
    assert (scene.colliders[0].distances(stepper.state.x.numpy()) < R).any() == (away == 0.85)
    assert stepper.colliders.steps.numpy() == [2]


@pytest.mark.parametrize("name", ("pbd", "xpbd", "newton"))
def test_a_step_with_nothing_near_has_few_launches_more(name):
    """Two tests, and how far vertices may move. Sweeps launch a list for each term, and its elements, which are none."""
    scene = falling([wc.Plane(position=(0.0, -50.0, 0.0), friction=0.0 if name == "pbd" else 0.3)])
    steppers = [SOLVERS[name].bind(each.build()) for each in (scene, replace(scene, colliders=(), contact=None))]
    with_contact, without = (launches_of(stepper.step) for stepper in steppers)
    in_sweeps = 0 if name == "newton" else 2 * SOLVERS[name].iterations * (1 if name == "pbd" else 2)
    assert without < with_contact <= without + 24 + in_sweeps


@pytest.mark.slow
def test_a_record_does_not_change_friction_on_a_mesh():
    """A recorded run refreshes contact in every step, and no more than once where contact begins, on a mesh that deforms."""
    corners = np.array([[-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]])
    widening = [corners * [1.0 + 0.02 * frame, 1.0, 1.0] for frame in range(13)]
    floor, contact = wc.MeshCollider(widening, [[0, 2, 1], [0, 3, 2]], friction=0.5), wc.Contact(distance=R, stiffness=1e5)
    scene = falling([floor], speed=0.0, height=0.03, n=4, fps=60.0, duration=0.2, contact=contact)
    solver = wc.XPBD(substeps=4, iterations=5)
    plain, recorded = (wc.simulate(scene, solver, record=record) for record in ((), "energies"))
    assert (plain.points == recorded.points).all() and plain.points[-1, :, 1].max() < 0.03


@pytest.mark.parametrize("name", ("newton", "xpbd"))
def test_what_falls_again_leaves_its_anchors(name, monkeypatch):
    """To the bit as if all steps had contact, and as a run that is recorded, for which all steps refresh contact."""
    plane = wc.Plane(friction=0.5, position=[(0.0, y, 0.0) for y in (*[0.03] * 4, *[-0.3] * 15)])
    scene = falling([plane], n=4, contact=wc.Contact(distance=R, stiffness=1e5), duration=0.75)
    solver = replace(SOLVERS[name], substeps=4)
    runs = [wc.simulate(scene, solver, dtype="float64", record=record) for record in ((), ("energies",))]
    monkeypatch.setattr(Clearance, "launch_refresh", lambda clearance, launch: launch())
    monkeypatch.setattr(Clearance, "launch_end", lambda clearance, x, end, launch: launch())
    runs.append(wc.simulate(scene, solver, dtype="float64", record=("energies",)))
    gaps = np.array([plane.distances(points, frame).min() for frame, points in enumerate(runs[0].points)])
    assert (np.diff((gaps < R).astype(int)) == 1).sum() > 1
    assert all((run.points == runs[0].points).all() for run in runs)
    assert all((runs[1].energies[name] == energies).all() for name, energies in runs[2].energies.items())


@table("integrator", ["bdf2"], ["euler", "midpoint", "bdf2"])
def test_a_plane_that_moves_carries_a_sheet(integrator):
    """After half a second by 0.2 m/s the sheet goes as fast as the plane, and has not left it."""
    moving = wc.Plane(friction=0.5, position=[(0.2 * k / 60.0, 0.0, 0.0) for k in range(61)])
    scene = falling([moving], speed=0.0, height=0.9e-3, n=3, stiffness=1000.0, fps=60.0, duration=1.0)
    run = wc.simulate(scene, wc.Newton(substeps=4, integrator=integrator, tolerance=1e-6), dtype="float64")
    assert run.status.ok
    np.testing.assert_allclose((run.points[-1] - run.points[30]).mean(axis=0) / 0.5, [0.2, 0.0, 0.0], atol=2e-3)


@each_solver
def test_copies_resets_and_states(name):
    """A batch is its copies; a reset repeats the first steps bit for bit; so does a state that was copied."""
    friction = 0.0 if name in ("pbd", "hierarchical pbd") else 0.3
    colliders = [
        wc.Sphere(radius=0.1, position=[(0.25, -0.08 + 0.02 * k, 0.25) for k in range(9)], friction=friction),
        wc.MeshCollider(BREATHING, BALL.faces, position=(0.0, -0.12, 0.0), friction=friction),
    ]
    # A stiffness that coarse explicit steps bear.
    scene = falling(colliders, n=4, contact=wc.Contact(distance=R, stiffness=1.5e4))
    single, batch = (after_frames(scene, SOLVERS[name], 3, dtype="float64", copies=copies) for copies in (1, 2))
    x, kept = single.state.x.numpy().copy(), single.state.copy()
    np.testing.assert_allclose(batch.state.x.numpy().reshape(2, -1, 3), [x, x], rtol=0.0, atol=1e-9)
    single.frame()
    after = single.state.copy()
    single.state.assign(kept)
    single.frame()
    assert single.state == after
    single.reset()
    assert (list(positions(single, 3))[-1] == x).all()


@pytest.mark.parametrize("solver", (wc.PBD(substeps=4), wc.HierarchicalPBD(substeps=4), wc.XPBD(substeps=4)))
def test_hard_contact_keeps_its_distance(solver):
    scene = falling([wc.Plane()], contact=wc.Contact(distance=R, stiffness=np.inf), duration=0.5)
    np.testing.assert_allclose(wc.simulate(scene, solver, dtype="float64").points[-1][:, 1], R, rtol=1e-9)


@pytest.mark.parametrize("threads", [1, 2])
def test_resets_into_colliders_are_refused(threads, device):
    """By vertex, copy and collider; of copies that are reset only, and pins may start anywhere."""
    scene = falling([wc.Plane(name="floor"), wc.Sphere(radius=0.1, position=(0.0, 1.0, 0.0), name="ball")], pins=[2])
    model = scene.build(copies=3, device=device, threads=threads if device == "cpu" else 1)
    stepper, start = wc.Newton(substeps=2).bind(model), np.tile(scene.positions, (3, 1, 1))
    start[:, 2, 1] = -0.5
    start[1, 4], start[2, 5, 1] = [0.0, 1.0, 0.0], -0.25
    before = stepper.state.x.numpy().copy()
    for given in (start, wp.array(start.reshape(-1, 3), dtype=model.vec3, device=device)):
        with pytest.raises(ValueError, match=r"^vertex 4 starts 0.1 m inside the collider ball in copy 1; it"):
            stepper.reset(positions=given)
        with pytest.raises(ValueError, match=r"^vertex 5 starts 0.25 m inside the collider floor in copy 2; it"):
            stepper.reset([True, False, True], given)
        assert (stepper.state.x.numpy() == before).all()
    stepper.reset([True, False, False], start)
    stepper.frame()
    assert not stepper.inside and np.isfinite(stepper.state.x.numpy()).all()


# Shapes, and points and triangles of them.
GRID, FINE = wc.Mesh.grid(5, 5, size=4.0), trimesh.creation.icosphere(subdivisions=4, radius=0.2)
MESHED = {
    "plane": (wc.Plane(), GRID.points - [1.75, 0.0, 1.75], GRID.triangles),
    "box": (wc.Box(size=(0.2, 0.1, 0.3), position=(0.25, -0.1, 0.25)), CUBE.vertices, CUBE.faces),
    "ball": (wc.Sphere(radius=0.2, position=(0.25, -0.205, 0.25)), FINE.vertices, FINE.faces),
}


@pytest.mark.parametrize("name", MESHED)
def test_an_equilibrium_on_a_mesh_is_that_on_its_shape(name):
    """A sheet that lies on it, at r − w/k, or hangs over it by its corners."""
    # By contact of vertices alone, the middles of flat triangles of this size dip 2 mm into the ball and more; those of its
    # mesh lie deeper than the ball by the sagitta of a circumscribed circle, L/√3 in radius.
    shape, *mesh = MESHED[name]
    fields = {"height": 0.02} if name == "plane" else {"height": 0.0, "pins": [0, 6, 42, 48]}
    scenes = [falling([each], n=7, **fields) for each in (shape, wc.MeshCollider(*mesh, position=shape.position))]
    one, two = (wc.equilibrium(scene) for scene in scenes)
    assert all(each.status.result is Result.CONVERGED and each.stable for each in (one, two))
    if name == "ball":
        dips, out = (shape.distances(each.points[scenes[0].mesh.triangles].mean(axis=1)).min() for each in (one, two))
        assert dips < -2e-3 and out > -(FINE.edges_unique_length.max() ** 2) / (6.0 * 0.2)
    else:
        assert all((shape.distances(each.points) < R).sum() >= 3 for each in (one, two))
        assert np.abs(one.points - two.points).max() < 1e-9
    if name == "plane":
        np.testing.assert_allclose(one.points[:, 1], R - DENSITY * GRAVITY / scenes[0].contact.stiffness, rtol=1e-6)


def test_an_equilibrium_in_a_groove():
    """Of an open mesh of two slopes, which a sheet falls into from above: the nearest triangles change on its way."""
    points = np.array([[-2, 2, -2], [-2, 2, 2], [0, 0, -2], [0, 0, 2], [2, 2, -2], [2, 2, 2]])
    groove = wc.MeshCollider(points * [0.25, 0.1, 0.25] + [0.25, -0.15, 0.25], [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    rest = wc.equilibrium(falling([groove], n=5, height=0.08), record="reactions")
    assert rest.status.result is Result.CONVERGED and rest.stable and groove.distances(rest.points).min() > 0.5 * R
    (force,) = rest.collider_forces.values()
    np.testing.assert_allclose(force, [0.0, -9.81 * 0.15 * 0.5**2, 0.0], atol=1e-7)


def cube(*sizes, **given):
    """A cube of triangles, of these sizes in its keyframes."""
    return wc.MeshCollider([size * np.asarray(CUBE.vertices) for size in sizes], CUBE.faces, **given)


HARD, STIFF, RUBBING = wc.Contact(stiffness=np.inf), wc.Contact(stiffness=1e7), wc.Plane(friction=0.1)
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
HARD_MESH = "contact.stiffness is infinite and the collider MeshCollider is a mesh, with which contact is soft; give a finite"
NO_DEFAULT = "contact.stiffness has no default without gravity and a spring or membrane of finite stiffness"
TOO_LARGE = "the surface of the collider Sphere is 1e+06 m from its centre, where float32 resolves 0.12 m"
NONE_FREE = "pins hold every vertex; colliders need one that is free"
OF_PBD = "PBD cannot take friction on Plane, whose normal force does not follow from positions"
HARD_OF_NEWTON = "Newton cannot take contact with Plane with infinite stiffness"
NO_INDICES = "ball.triangles[0] is [0, 1, 3]; it must be indices"
STABLE_BELOW = "symplectic Euler is stable below 0.0002"
MANY_SHAPES = (
    "the collider Plane has friction 0.1, with which there are many rest shapes and the motion decides among them; set it "
    "to 0, or run the scene with damping until it rests"
)
REFUSED = {
    "inside": (lambda: falling([wc.Plane(position=(0.0, 0.1, 0.0))]), "vertex 0 starts 0.05 m inside the collider Plane"),
    "no collider": (lambda: falling(["ball"]), "colliders[0] is 'ball'; it must be a collider"),
    "one": (lambda: falling(wc.Plane()), "it must be a list of colliders"),
    "radius": (lambda: wc.Sphere(radius=0.0), "Sphere.radius is 0.0; it must be a number above 0"),
    "normal": (lambda: wc.Plane(normal=(0, 0, 0)), "Plane.normal is [0.0, 0.0, 0.0]; it must not be 0"),
    "size": (lambda: wc.Box(size=(1, 1, 0)), "Box.size is [1.0, 1.0, 0.0]; each length must be above 0"),
    "quaternion": (lambda: wc.Plane(rotation=(0, 0, 0, 2)), "Plane.rotation has length 2; quaternions must have length 1"),
    "keyframes": (lambda: wc.Plane(position=np.zeros((3, 3)), rotation=STILL), "Plane has 3 positions and 2 rotations"),
    "friction": (lambda: wc.Plane(friction=-0.1), "Plane.friction is -0.1; it must be a number of 0 or more"),
    "distance": (lambda: wc.Contact(distance=0.0), "contact.distance is 0.0"),
    "stiffness": (lambda: wc.Contact(stiffness=0.0), "contact.stiffness is 0.0; it must be a number above 0"),
    "stiffness as a text": (lambda: wc.Contact(stiffness="a"), "contact.stiffness is 'a'; it must be a number above 0"),
    "ragged": (lambda: wc.Plane(position=[[0, 0, 0], [1, 2]]), "Plane.position is [[0, 0, 0], [1, 2]], which is not numeric"),
    "on it": (lambda: falling([wc.Plane(position=(0.0, 0.05, 0.0))]), "vertex 0 starts 0 m inside the collider Plane"),
    "turned inside out": (lambda: cube(1, 0, -1, name="ball"), "ball.points[2] is points[0] turned inside out"),
    "inside out once it is there": (lambda: cube(0, 1, -1, name="ball"), "ball.points[2] is points[1] turned inside out"),
    "large": (lambda: falling([wc.Sphere(radius=1e6, position=(0, -1e6, 0))]).build(), TOO_LARGE),
    "weightless": (lambda: falling([wc.Plane()], gravity=(0, 0, 0), terms=[], contact=None), NO_DEFAULT),
    "hard contact with a mesh": (lambda: falling([cube(1)], contact=HARD), HARD_MESH),
    "all pinned": (lambda: wc.simulate(falling([wc.Plane()], pins=range(36)), wc.XPBD(substeps=1)), NONE_FREE),
    "points": (lambda: wc.MeshCollider(np.full((3, 3), np.nan), [[0, 1, 2]]), "MeshCollider.points[0, 0] is nan"),
    "no points": (lambda: wc.MeshCollider(np.zeros((0, 3)), [[0, 1, 2]]), "MeshCollider.points has shape (0, 3)"),
    "index": (lambda: wc.MeshCollider(np.eye(3), [[0, 1, 3]], name="ball"), NO_INDICES),
    "no triangles": (lambda: wc.MeshCollider(np.eye(3), np.zeros((0, 3), int)), "MeshCollider.triangles: has shape (0, 3)"),
    "flat triangle": (lambda: wc.MeshCollider(np.tile(np.eye(3)[:1], (3, 1)), [[0, 1, 2]]), "it must be higher than 1e-07"),
    "inside a mesh": (lambda: falling([cube(1, position=(0.2, 0.05, 0.2))]), "inside the collider MeshCollider"),
    "hard friction": (lambda: falling([RUBBING], contact=HARD), "Plane has friction 0.1 and contact.stiffness is infinite"),
    "friction of PBD": (lambda: wc.simulate(falling([RUBBING]), wc.PBD(substeps=1)), OF_PBD),
    "hard contact": (lambda: wc.simulate(falling([wc.Plane()], contact=HARD), wc.Newton(substeps=1)), HARD_OF_NEWTON),
    "explicit": (lambda: wc.simulate(falling([wc.Plane()], contact=STIFF), SOLVERS["explicit"]), STABLE_BELOW),
    "equilibrium": (lambda: wc.equilibrium(falling([RUBBING])), MANY_SHAPES),
}


@pytest.mark.parametrize(("declare", "message"), REFUSED.values(), ids=REFUSED)
def test_refused_in_a_sentence(declare, message):
    with pytest.raises(ValueError) as error:
        declare()
    assert message in str(error.value) and "\n" not in str(error.value)


@table("name", ["newton"], ["explicit", "newton"])
def test_a_resumed_run_has_its_anchors(name, tmp_path):
    colliders = [wc.Sphere(radius=0.1, position=[(0.25, -0.08 + 0.002 * k, 0.25) for k in range(25)], friction=0.3)]
    scene, record = falling(colliders, fps=120.0, n=4, duration=0.2), ("energies", "reactions")
    whole = wc.simulate(scene, SOLVERS[name], output=str(tmp_path / "whole.usdc"), record=record)
    resumed = stopped_and_resumed(13, scene, SOLVERS[name], output=str(tmp_path / "resumed.usdc"), record=record)
    assert np.asarray(resumed.points).tobytes() == np.asarray(whole.points).tobytes()
    assert resumed.cut == whole.cut == pytest.approx(whole.cuts.mean() * len(whole.cuts) / (len(whole.cuts) - 1))
    assert (resumed.cuts == whole.cuts).all()
    for part in ("energies", "collider_forces", "friction_forces"):
        np.testing.assert_equal(getattr(resumed, part), getattr(whole, part))


def closing(between):
    """A sheet of which one side is pinned, or its axis y, and a plate that comes over it; or two plates on the other side."""
    k = np.arange(9)[:, None]
    lower = [0.3 if between == "free" else 0.0, 0.0, 0.15] + (np.minimum(0.01 * k, 0.05) - 0.09) * [0.0, 1.0, 0.0]
    plates = [wc.Box(size=(0.1, 0.1, 0.5), position=lower, name="lower")]
    pins = None if between == "free" else wc.Pins([0, 4, 8, 12], axes="xyz" if between == "pins" else "y")
    if between == "free":
        plates.append(wc.Box(size=(0.1, 0.1, 0.5), position=lower * [1.0, -1.0, 1.0], name="upper"))
    fields = {"speed": 0.0, "height": 0.0, "n": 4, "fps": 60.0, "gravity": (0.0, 0.0, 0.0)}
    return falling(plates, pins=pins, contact=wc.Contact(stiffness=1e4), **fields)


CLOSING = {"explicit": wc.Explicit(substeps=80), "newton": wc.Newton(substeps=4), "by error": wc.Newton(error=0.01)}


@pytest.mark.parametrize("solver", CLOSING.values(), ids=CLOSING)
@pytest.mark.parametrize("between", ("pins", "rollers", "free"))
def test_what_has_nowhere_to_go_is_named(solver, between, device):
    """Plates touch the sheet where frame 4 ends, after 0.04 m by 0.01 m a frame. By error frame 1 has 8 steps, the next 2."""
    run = wc.simulate(closing(between), solver, device=device, copies=2)
    found = [(each.frame, each.collider, each.other, each.copy) for each in run.inside]
    if between != "free":
        assert (run.points[..., [0, 4, 8, 12], 1] == 0.0).all()
        assert found == [(5, "lower", None, copy) for copy in (0, 1)] and run.inside[0].vertex == 0
        assert str(run.inside[0]) == "lower comes over vertex 0, which is not free to move, in frame 5"
    else:
        assert {frozenset(each[1:3]) for each in found} == {frozenset(("lower", "upper"))}
        assert {each[0] for each in found} <= {4, 5} and {each[3] for each in found} == {0, 1}
        assert "is caught between" in str(run.inside[0])
    assert wc.simulate(falling([SHAPES["plane"]]), wc.Newton(substeps=1), device=device).inside == ()


def test_pins_that_pass_through_are_named(device, tmp_path, capsys):
    """A thin plate, which the pins cross from one step to the next; the command line says so too."""
    plate = wc.Box(size=(1.0, 1e-4, 1.0), position=(0.0, -0.05, 0.0), name="plate")
    sheet = falling([plate], speed=0.0, height=0.0, n=3, fps=60.0, duration=0.1, contact=None)
    ends = sheet.positions[[0, 1, 2]] - 0.02 * np.arange(5)[:, None, None] * [0.0, 1.0, 0.0]
    stage = write_scene(replace(sheet, pins=wc.Pins([0, 1, 2], ends)), tmp_path / "sinking.usda")
    command = ["run", str(stage), "-s", "substeps=1", "--solver", "newton", "--frames", "4", "--device", device]
    assert main([*command, "-o", str(tmp_path / "a.usda")]) == 0
    assert "inside        plate comes over vertex 0, which is not free to move, in frame 3" in capsys.readouterr().out
    assert main([*command, "-o", str(tmp_path / "b.usda"), "--json"]) == 0
    expected = {"vertex": 0, "frame": 3, "collider": "plate", "other": None, "copy": 0}
    assert json.loads(capsys.readouterr().out)["inside"] == [expected]
