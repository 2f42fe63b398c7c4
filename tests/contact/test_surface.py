"""Meshes as obstacles of the surface of contact: forces, pressure, meshes that move, and what does not meet."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp

import warpcloth as wc
from support.contacts import energy, gradient, hessian_times, slope_of
from support.layers import cloth, ground, positions, stack
from support.pairs import between_edges, detect, from_triangle
from support.steps import after_frames
from warpcloth.contact.proximity import MAX_MOVE, Proximity
from warpcloth.contact.surface import ContactSurface
from warpcloth.kernels.contact.obstacles import CLOTH, OBSTACLE
from warpcloth.kernels.contact.pair_potential import CLOSE

R = 3e-3


def sheet(colliders, n=6, side=0.2, height=R, layers=1, stiffness=None, **given):
    """Flat sheets above colliders, r apart."""
    mesh, contact = stack(layers, n, side, R, pattern="alternating"), wc.Contact(distance=R, stiffness=stiffness)
    fields = {"terms": [wc.Spring(stiffness=300.0)], "density": 0.2, "fps": 24.0, "contact": contact}
    itself = wc.SelfContact(distance=R) if layers > 1 else None
    mesh = wc.Mesh(mesh.points + np.array([0.0, height, 0.0]), mesh.triangles)
    return wc.Scene(mesh, colliders=colliders, self_contact=itself, **fields | given)


@pytest.mark.parametrize(("cells", "gap"), ((3, 0.7), (12, 0.7), (3, 0.15), (12, 0.15), (30, 0.15)))
def test_forces_and_matrix_are_derivatives_of_the_energy(cells, gap, device):
    """On rough meshes that are coarser and finer than the cloth, so that all kinds of features meet; edges below r/4."""
    rng, eta = np.random.default_rng(1), 1e-7
    flat = ground(0.06, cells)
    rough = wc.MeshCollider(flat.points + rng.normal(scale=0.1 * gap * R, size=flat.points.shape), flat.triangles)
    scene = sheet([rough], n=4, side=0.04, height=gap * R)
    x = scene.positions + rng.normal(scale=0.1 * gap * R, size=scene.positions.shape)
    stepper = wc.Newton(dt=1 / 24).bind(replace(scene, positions=x).build(dtype="float64", device=device))
    stepper.pairs.launch_begin(stepper.state.x)
    found = gradient(stepper.pairs, x)
    assert np.abs(found).max() > 1e-3
    for i, axis in rng.integers([len(x), 3], size=(24, 2)):
        step = np.zeros_like(x)
        step[i, axis] = 1.0
        # Third derivatives of φ are of the order of kA/r², and U is rounded.
        assert found[i, axis] == pytest.approx(slope_of(energy, stepper.pairs, x, step, eta), abs=1e-6 * np.abs(found).max())
    near = 1e-6 * gap * R
    for _ in range(3):
        p = rng.normal(size=x.shape)
        expected = slope_of(gradient, stepper.pairs, x, p, near)
        found, hessian = hessian_times(stepper.pairs, x, p)
        # The error is of (p near/d)², and of x, rounded, times the matrix over near.
        rounding = np.finfo(float).eps * np.abs(hessian.values.numpy()).max() * np.abs(x).max() / near
        assert found == pytest.approx(expected, abs=1e-7 * np.abs(expected).max() + rounding)


@pytest.mark.parametrize("cells", (2, 9, 40))
def test_pressure_on_a_plane_does_not_depend_on_its_triangles(cells):
    """A sheet rests at the gap r − p/k of the closed form, and the reaction is its weight."""
    weight, stiffness = 0.2 * 9.81, 1e4
    scene = sheet([ground(0.4, cells)], stiffness=stiffness, duration=1.0)
    run = wc.simulate(scene, wc.Newton(substeps=1), dtype="float64", record="reactions")
    # Steps end at an acceleration of 1e-3 g, which changes the gap by a thousandth of p/k.
    assert run.points[-1, :, 1] == pytest.approx(np.full(36, R - weight / stiffness), abs=2e-3 * weight / stiffness)
    assert run.collider_forces["MeshCollider"][-1] == pytest.approx([0.0, -weight * 0.04, 0.0], abs=4e-3 * weight * 0.04)


MOVES = {
    "up": lambda t: {"position": np.outer(2.0 * t, [0.0, 1.0, 0.0])},
    "turns": lambda t: {"rotation": np.stack([np.sin(t), 0 * t, 0 * t, np.cos(t)], axis=1)},
}


@pytest.mark.parametrize(("name", "layers"), (("newton", 1), ("newton", 3), ("xpbd", 1), ("explicit", 1)))
@pytest.mark.parametrize("move", MOVES)
def test_cloth_is_carried_by_a_mesh_that_moves(name, layers, move, device):
    """By many contact distances in a step. No vertex comes to the other side, and nothing is forced."""
    solver = {"newton": wc.Newton(substeps=1), "xpbd": wc.XPBD(substeps=2), "explicit": wc.Explicit(substeps=200)}[name]
    mesh = ground(0.4, 4, friction=0.3, **MOVES[move](np.maximum(np.arange(9) / 24.0 - 0.1, 0.0)))
    stepper = after_frames(sheet([mesh], layers=layers), solver, dtype="float64", device=device)
    for pose, x in zip(mesh.poses[1:9], positions(stepper, 8), strict=True):
        local = wc.scene.colliders.turned(pose[3:] * [-1.0, -1.0, -1.0, 1.0], x - pose[:3])
        assert stepper.pairs.forced == [] and local[:, 1].min() > 0.0
        assert (np.diff(local[:, 1].reshape(layers, -1), axis=0) > 0.0).all()


def test_a_mesh_that_has_no_way_is_forced():
    """Two plates close on a sheet to less than nothing: the run is not usable, and says which mesh moved through cloth."""
    t = np.arange(6)[:, None] / 24.0
    lid = ground(0.4, 4, position=np.array([0.0, 0.02, 0.0]) - t * [0.0, 0.24, 0.0], name="lid")
    run = wc.simulate(sheet([ground(0.4, 4, name="floor"), lid], duration=5 / 24), wc.Newton(substeps=1), dtype="float64")
    assert not run.status.ok and "lid" in run.status.message


def test_a_tip_stays_below_a_triangle(device):
    """The vertices of a large triangle fall beside a pyramid, which its inside meets."""
    base = [[-0.01, -0.2, -0.01], [0.01, -0.2, -0.01], [0.0, -0.2, 0.01], [0.0, 0.0, 0.0]]
    pyramid = wc.MeshCollider(base, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    corners = [[-0.1, 0.02, -0.1], [0.1, 0.02, -0.1], [0.0, 0.02, 0.13]]
    scene = replace(sheet([pyramid]), mesh=wc.Mesh(corners, [[0, 2, 1]]), positions=corners, velocities=None)
    stepper = after_frames(scene, wc.Newton(substeps=2), dtype="float64", device=device)
    for a, b, c in positions(stepper, 4):
        normal = np.cross(b - a, c - a)
        assert abs(normal @ a) / np.linalg.norm(normal) < 0.05 and normal @ -a * np.sign(normal[1]) < 0.0


def test_pins_may_be_inside_a_mesh():
    """Elements with a pin do not meet it; the others do."""
    box = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    scene = sheet([wc.MeshCollider(box.vertices, box.faces)], n=7, height=0.055, duration=0.25)
    points = scene.positions.copy()
    points[24, 1] = 0.04
    run = wc.simulate(replace(scene, positions=points, pins=wc.Pins([24])), wc.Newton(substeps=1), dtype="float64")
    assert run.status.ok and run.cut == 0.0
    around = run.points[-1, [17, 23, 25, 31]]
    assert (np.abs(around[:, [0, 2]]) < 0.05).all() and (around[:, 1] > 0.05).all()


def test_copies_have_the_bits_of_single_runs(device):
    """With a mesh that moves, and a stiffness that varies."""
    scene = sheet([ground(0.4, 4, friction=0.2, **MOVES["turns"](np.arange(7) / 24.0))], height=1.5 * R)

    def end(*stiffness):
        vary = {"Spring.stiffness": np.array(stiffness)}
        build = {"copies": len(stiffness), "vary": vary, "device": device, "dtype": "float32"}
        return after_frames(scene, wc.Newton(substeps=1), 6, **build).state.x.numpy()

    np.testing.assert_array_equal(end(100.0, 900.0), np.concatenate([end(100.0), end(900.0)]))


def test_cloth_with_a_locked_axis_meets_meshes():
    """A sheet that moves in planes falls onto a floor of two triangles as onto a plane."""
    fields, ends = {"stiffness": 1e5, "free_axes": np.tile([True, True, False], (36, 1))}, []
    for floor in (ground(1.0), wc.Plane()):
        scene, solver = sheet([floor], height=4.0 * R, **fields), wc.Newton(substeps=4, tolerance=1e-9)
        ends.append(after_frames(scene, solver, 4, dtype="float64").state.x.numpy())
    assert ends[0][:, 1].min() > 0.0
    # At 0.9 r the potential of edges has no energy; triangles of the plane are exact.
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-7)


def test_a_ball_that_grows_carries_cloth(device):
    """By less than a contact distance in a step, and from a point: moves of points of the mesh diverge."""
    ball, sizes, centre = trimesh.creation.icosphere(2, radius=0.03), np.linspace(0.5, 1.0, 6), np.array([0.0, -0.03, 0.0])
    mesh = wc.MeshCollider(ball.vertices * sizes[:, None, None] + centre, ball.faces)
    scene = sheet([mesh], n=8, side=0.1, height=R - 0.0145)
    stepper = after_frames(scene, wc.Newton(substeps=2), dtype="float64", device=device)
    for size, x in zip(sizes[1:], positions(stepper, 5), strict=True):
        assert stepper.pairs.forced == []
        distance = np.linalg.norm(x - centre, axis=1)
        assert distance.min() > 0.95 * size * 0.03  # that of the faces of the ball from its centre


def draped(n, contact, origin=0.0, **fields):
    """A sheet of 0.5 m over a ball of triangles, with its middle at the origin."""
    ball, grid = trimesh.creation.icosphere(2, radius=0.1), wc.Mesh.grid(n, n, size=0.5)
    mesh = wc.Mesh(grid.points - [0.25, 0.0, 0.25] + origin, grid.triangles)
    collider = wc.MeshCollider(ball.vertices, ball.faces, position=np.array([0.0, -0.12, 0.0]) + origin)
    return cloth(mesh, terms=[wc.Spring(stiffness=100.0)], fps=24.0, colliders=[collider], contact=contact, **fields)


@pytest.mark.parametrize("away", (1000.0, 2000.0))
def test_cloth_far_from_the_origin_drapes_or_is_not_usable(away):
    """In float32, whose positions are 0.1 mm coarse. At 2 km rounding leaves a gap at which contact has not begun."""
    scenes = [draped(8, wc.Contact(distance=5e-3, stiffness=3e3), origin, duration=0.25) for origin in (0.0, away)]
    runs = [wc.simulate(scene, wc.Newton(substeps=4), dtype="float32") for scene in scenes]
    near, far = (run.points[-1][:, 1].mean() for run in runs)
    assert near < -0.07
    if away == 1000.0:
        assert runs[1].status.ok and far - away == pytest.approx(near, abs=0.01)
    else:
        assert not runs[1].status.ok and "float32 is too coarse for the contact distance" in runs[1].status.message


def test_a_mesh_holds_cloth_whose_pin_is_drawn_into_it():
    """The pin stretches the cloth around it, which the mesh keeps from following: work that no gain of energy explains."""
    pins = wc.Pins([40], -0.01 * np.arange(13)[:, None, None] * [0.0, 1.0, 0.0])
    scene = draped(9, wc.Contact(distance=1e-3, stiffness=1.5e4), pins=pins, duration=0.5)
    run = wc.simulate(scene, wc.Newton(substeps=4), dtype="float64", record="energies")
    assert run.energies["Spring"][-1] > 0.3 and run.status.ok, run.status.message


def test_a_copy_that_needs_more_rounds_changes_no_other(device):
    """A mesh that rises meets the sheet of one copy far from its start; that of the other lies on it with a small gap."""
    scene = sheet([ground(0.4, 4, **MOVES["up"](np.arange(4) / 24.0))], height=0.01 * R, stiffness=10.0)
    both, single = (wc.Newton(substeps=1).bind(scene.build(copies=copies, dtype="float64", device=device)) for copies in (2, 1))
    both.reset(positions=np.stack([scene.positions, scene.positions + np.array([0.0, 0.05, 0.0])]))
    for _ in range(3):
        for each in (both, single):
            each.frame()
    np.testing.assert_array_equal(both.state.x.numpy()[:36], single.state.x.numpy())


@pytest.mark.parametrize("itself", [False, True])
def test_lists_have_all_pairs_of_cloth_and_meshes_and_no_others(itself, device):
    """Triangles of two sizes, which are in several levels of the grid, two copies, and pins, which meet no mesh."""
    # None is missing after cloth and meshes have moved as far as a list is kept, and cloth has then moved by a round.
    scene = sheet([ground(0.2, 14), ground(0.4, position=(0.0, -0.02, 0.0))], pins=[0, 1, 6, 7])
    model, skin = scene.build(copies=2, dtype="float64", device=device), 0.01
    surface = ContactSurface(model, itself)
    x, rng = surface.of_model(surface.rest), np.random.default_rng(0)
    x[: model.count] += rng.normal(scale=0.02, size=(model.count, 3))
    found = Proximity(surface, R, skin, R)
    stencils = np.concatenate(detect(found, x))
    listed = [tuple(s) for s in stencils if (s >= model.count).any()]
    copies = np.concatenate([np.repeat(np.arange(2), len(x) // 2) for x in np.split(x, [model.count])])
    vertices, groups = np.arange(len(x)), surface.of_model(surface.vertex_groups)
    items, edges = np.split(surface.items, [surface.triangles])
    of_items, of_edges = np.split(surface.groups, [surface.triangles])
    pairs = []
    for own, own_groups, others, other_groups, measure in (
        (vertices[:, None], groups, items[:, :3], of_items, from_triangle),
        (edges[:, :2], of_edges, edges[:, :2], of_edges, between_edges),
    ):
        meet = (own_groups[:, None] == int(CLOTH)) & (other_groups == int(OBSTACLE))
        meet |= (own_groups[:, None] == int(OBSTACLE)) & (other_groups == int(CLOTH))
        meet &= copies[own[:, :1]] == copies[others[:, 0]]
        meet = np.triu(meet) if own.shape[1] == 2 else meet
        i, j = np.nonzero(meet)
        s = np.column_stack([own[i], others[j]])
        acts = R * np.where((own.shape[1] == 2) | (s[:, 0] >= model.count), float(CLOSE), 1.0)  # above R − skin/2
        pairs.append((s, acts, measure))

    def near(x, skin=0.0):
        return [tuple(pair) for s, acts, measure in pairs for pair in s[measure(*x[s.T]) < acts + skin]]

    def ways(count):
        found = rng.normal(size=(count, 3))
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    assert len(near(x, skin)) > 1000 and sorted(listed) == sorted(near(x, skin))
    x += rng.uniform(-2.0, 2.0, 3)
    x[model.count :] += 0.02 * skin * ways(len(x) - model.count)
    x[: model.count] += (found.kept - 0.12) * skin * ways(model.count)
    assert not found.moved(wp.array(x, dtype=model.vec3, device=device), found.kept).numpy()[0]
    x[: model.count] += MAX_MOVE * skin * ways(model.count)
    assert len(near(x)) > 50 and set(near(x)) <= set(listed)


@pytest.mark.parametrize("start", [0.8, 0.6])
def test_the_gap_of_edges_is_reported_where_they_do_not_act(start, device):
    """A ridge of cloth across that of a mesh, with edges as long as r: 0.6 r apart, where pairs were listed or after a move."""
    across, up = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, 0.5, 0.5], [0, 0.5, -0.5]]), np.array([0.0, R, 0.0])
    along = wc.MeshCollider(-R * across[:, [2, 1, 0]], np.array([[0, 1, 2], [1, 0, 3]]))
    mesh = wc.Mesh(R * across + start * up, np.array([[0, 1, 2], [1, 0, 3]]))
    scene = wc.Scene(mesh, density=0.2, terms=[wc.Spring(stiffness=1.0)], colliders=[along], contact=wc.Contact(distance=R))
    pairs = wc.XPBD(substeps=1).bind(scene.build(dtype="float64", device=device)).pairs
    for height in (start, 0.6):
        pairs.launch_begin(wp.array(R * across + height * up, dtype=wp.vec3d, device=device))
        assert pairs.in_frame()[2] == pytest.approx(height * R, rel=1e-12)


@pytest.mark.parametrize("solver", [wc.PBD(), wc.XPBD()], ids=["PBD", "XPBD"])
def test_a_copy_without_pairs_does_not_follow_what_another_has(solver, device):
    """Two sheets fall on a mesh, one as fast that it has pairs first; the other moves as alone, to the bit."""
    grid, mesh = wc.Mesh.grid(8, 8, size=0.3), wc.Mesh.grid(5, 5, size=0.5)
    start = grid.points - grid.points.mean(axis=0) + [0.0, 0.03, 0.0]
    colliders = [wc.MeshCollider(mesh.points - mesh.points.mean(axis=0), mesh.triangles)]
    fields = {"colliders": colliders, "contact": wc.Contact(distance=4e-3, stiffness=1e4), "fps": 24.0}
    scene = cloth(grid, terms=[wc.Spring(stiffness=300.0)], positions=start, **fields)
    falls = np.array([[0.0, -3.0, 0.0], [1.0, -8.0, 0.0]])[:, None]
    velocities, found = 0.2 * np.random.default_rng(0).normal(size=(2, 64, 3)) + falls, []
    for copies in (1, 2):
        stepper = after_frames(scene, solver, copies=copies, dtype="float64", device=device)
        stepper.reset(None, None, velocities[:copies])
        found.append(list(positions(stepper, 2))[-1][:64])
    assert (found[0] == found[1]).all()


def test_a_copy_that_stays_apart_does_not_walk_with_another(device):
    """Two sheets approach each other, in one copy too slowly to meet; it moves as alone, to the bit, 100 m from the origin."""
    # Rounding decides it: of twelve directions of one of the sheets this one alone differed where both copies walked in rounds.
    grid = wc.Mesh.grid(8, 8, size=0.4)
    points = grid.points - grid.points.mean(axis=0)
    turned = points @ np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))[0]
    other = turned + np.array([0.0, 0.04 - turned[:, 1].min(), 0.0])
    mesh = wc.Mesh(np.concatenate([points, other]) + 100.0 * np.array([1, 1, -1]), [*grid.triangles, *(grid.triangles + 64)])
    terms, contact = [wc.Spring(stiffness=200.0)], wc.SelfContact(distance=6e-3)
    scene = wc.Scene(mesh, density=0.15, terms=terms, fps=24.0, gravity=(0, 0, 0), self_contact=contact)
    velocities, found = np.repeat([[0.0, 1.0, 0.0], [0.4, -1.0, 0.0]], 64, axis=0), []
    for speeds in ([0.7], [0.7, 1.0]):
        stepper = wc.XPBD(substeps=2).bind(scene.build(copies=len(speeds), device=device))
        stepper.reset(None, None, np.array(speeds)[:, None, None] * velocities)
        stepper.frame()
        found.append(stepper.state.x.numpy()[:128])
    assert (found[0] == found[1]).all()
