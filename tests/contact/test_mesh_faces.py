"""Meshes whose corners and edges lie between the vertices of the cloth: they carry it, and no triangle of it crosses one."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.crossings import crossing
from warpcloth.core.status import Result
from warpcloth.kernels.contact.mesh_faces import between, first_contact

FRAMES, N, SIZE = 8, 6, 0.5
SLOW = pytest.mark.slow
EDGE = SIZE / (N - 1)
# A pyramid and a roof, both narrower than an edge of the cloth, below the middle of some triangles.
CORNERS = np.array([[-1.0, -8.0, -1.0], [1.0, -8.0, -1.0], [1.0, -8.0, 1.0], [-1.0, -8.0, 1.0], [0.0, 0.0, 0.0]]) * 0.1 * EDGE
SPIKE = CORNERS, [[1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4], [0, 1, 2], [0, 2, 3]]
ROOF = np.array([[-6.0, -8.0, -1.0], [6.0, -8.0, -1.0], [6.0, -8.0, 1.0], [-6.0, -8.0, 1.0], [-6.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
KNIFE = ROOF * 0.1 * EDGE, [[1, 0, 5], [5, 0, 4], [3, 2, 4], [4, 2, 5], [2, 1, 5], [0, 3, 4], [0, 1, 2], [0, 2, 3]]
HERE = np.array([0.27, 0.0, 0.23])
t = np.linspace(0.0, 1.0, FRAMES + 1)
UP = HERE + np.stack([0.05 * np.sin(5.0 * t), 0.3 * t - 0.1, 0.0 * t], axis=1)
ROLL = np.stack([0.0 * t, 0.0 * t, np.sin(0.5 * t), np.cos(0.5 * t)], axis=1)
TIP = np.stack([0.05 * np.sin(8.0 * t), 0.2 * t, 0.0 * t], axis=1)
GROWN = CORNERS + np.eye(5)[4][:, None] * TIP[:, None]
MESHES = {
    "spike": wc.MeshCollider(*SPIKE, position=HERE),
    "knife": wc.MeshCollider(*KNIFE, position=HERE, friction=0.3),
    "open knife": wc.MeshCollider(KNIFE[0], KNIFE[1][:4], position=HERE),
    "spike that rises": wc.MeshCollider(*SPIKE, position=UP, rotation=ROLL),
    "spike that grows": wc.MeshCollider(GROWN, SPIKE[1], position=HERE - [0.0, 0.1, 0.0]),
}


# It rises by 13 mm a frame from 1 cm below the cloth.
turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
RIM = np.stack([0.05 * np.cos(turns), 0.0 * turns - 0.2, 0.05 * np.sin(turns)], axis=1)
CONE = wc.MeshCollider(
    np.concatenate([RIM, [[0.0, 0.0, 0.0], [0.0, -0.2, 0.0]]]),
    [[(i + 1) % 12, i, 12] for i in range(12)] + [[i, (i + 1) % 12, 13] for i in range(12)],
    position=np.array([0.26, -0.01, 0.24]) + np.stack([0.0 * t, 0.1 * t, 0.0 * t], axis=1),
)
SOLVERS = {
    "explicit": wc.Explicit(substeps=40),
    "newton": wc.Newton(substeps=1),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, iterations=30),
    "xpbd": wc.XPBD(substeps=1, iterations=20),
    "pbd": wc.PBD(substeps=1, iterations=20),
    "hierarchical pbd": wc.HierarchicalPBD(substeps=1, iterations=20),
    "admm": wc.ADMM(substeps=1, iterations=30),
    # With one step in a frame its iterations do not converge on the knife, and the run gains energy.
    "constrained dynamics": wc.ConstrainedDynamics(substeps=2, iterations=20),
}


def falling(mesh, speed, fps=24.0, height=0.02, **fields):
    """A sheet that is stiff enough not to be torn to ten times its length where a point of it is stopped at 10 m/s."""
    grid = wc.Mesh.grid(N, N, size=SIZE, pattern="alternating")
    return wc.Scene(
        grid,
        density=0.15,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        positions=grid.points + np.array([0.0, height, 0.0]),
        velocities=np.tile([0.1 * speed, -speed, 0.0], (N * N, 1)),
        colliders=[mesh],
        contact=wc.Contact(distance=2e-3, stiffness=3e4, elements="triangles"),
        fps=fps,
        duration=FRAMES / fps,
        **fields,
    )


CASES = [
    pytest.param(
        name,
        what,
        dtype,
        marks=[] if (name, what, dtype) == ("newton", "spike", "float32") else SLOW,
    )
    for name in SOLVERS
    for what in MESHES
    for dtype in ("float32", "float64")[: 2 if what == "spike" and name in ("newton", "pbd") else 1]
    # The filter is the same for all.
    if what == "spike" or name in ("newton", "explicit") or (name, what) == ("constrained dynamics", "knife")
]


@pytest.mark.parametrize(("name", "what", "dtype"), CASES)
def test_nothing_pierces_cloth(name, what, dtype, device):
    """At 1 m/s in steps of 1/24 s, which are 0.04 m; without the filter of triangles a spike and a knife go through."""
    solver, mesh = SOLVERS[name], MESHES[what]
    scene = falling(mesh, 1.0)
    animation = wc.simulate(scene, solver, dtype=dtype, device=device)
    assert animation.status.result is not Result.DIVERGED
    assert crossing(animation.points, scene.mesh.triangles, mesh) == [0] * (FRAMES + 1)
    assert 0.0 < animation.cut < 1.0 and not animation.inside


@pytest.mark.slow
@pytest.mark.parametrize("speed", (10.0, 100.0))
@pytest.mark.parametrize("what", ("spike", "knife"))
def test_nothing_pierces_fast_cloth(what, speed, device):
    scene = falling(MESHES[what], speed)
    # At 100 m/s the spike tears the sheet to divergence, later.
    points = wc.simulate(scene, wc.Explicit(substeps=60), device=device).points
    assert len(points) > FRAMES // 2 and crossing(points, scene.mesh.triangles, MESHES[what]) == [0] * len(points)


@pytest.mark.parametrize("name", ["xpbd", *(pytest.param(name, marks=SLOW) for name in ("newton", "pbd"))])
@pytest.mark.parametrize(
    "what", ["cone that rises", *(pytest.param(what, marks=SLOW) for what in ("spike", "spike that rises"))]
)
def test_cloth_that_touches_itself_is_not_pierced(what, name):
    """Where other cloth holds back what a moving mesh comes over, the two filters take turns until neither moves it."""
    mesh, of_cloth = MESHES.get(what, CONE), wc.SelfContact(distance=2e-3)
    speed, height = (0.0, 0.0) if mesh is CONE else (1.0, 0.02)
    scene = falling(mesh, speed, height=height, self_contact=of_cloth)
    animation = wc.simulate(scene, SOLVERS[name])
    assert len(animation.points) == FRAMES + 1
    assert crossing(animation.points, scene.mesh.triangles, mesh) == [0] * (FRAMES + 1)
    assert not any(map(len, wc.intersections(animation.points, scene.mesh.triangles).pairs))


def lying(mesh, friction=0.0, gap=0.4, slope=0.0, n=4, **fields):
    """A stiff sheet of 0.3 m at ``gap`` times the contact distance above y = 0, as on a slope [°] down x."""
    grid, down = wc.Mesh.grid(n, n, size=0.1 * (n - 1), pattern="alternating"), np.radians(slope)
    terms = [wc.CorotatedMembrane(stiffness=1e3), wc.QuadraticBending(stiffness=1e-2)]
    return wc.Scene(
        grid,
        density=0.15,
        terms=terms,
        positions=grid.points + np.array([0.0, gap * 1e-3, 0.0]),
        gravity=9.81 * np.array([np.sin(down), -np.cos(down), 0.0]),
        colliders=[wc.MeshCollider(*mesh, friction=friction)],
        contact=wc.Contact(distance=1e-3, stiffness=3e5, **{"elements": "triangles"} | fields),
        fps=60.0,
        duration=0.3,
    )


def joined(*meshes):
    """One mesh of several."""
    firsts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    triangles = [np.array(triangles) + first for (_, triangles), first in zip(meshes, firsts, strict=False)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(triangles)


def rails(*at):
    """Knives along x at these z, turned a little so that no vertex of a grid lies on them."""
    x, y, z = (KNIFE[0] * np.array([50.0, 1.0, 0.2])).T
    return joined(*((np.stack([x, y, z + each + 0.03 * x], axis=1), KNIFE[1]) for each in at))


# A spike and a knife below the middle of triangles.
BOTH = joined((SPIKE[0] + np.array([0.23, 0.0, 0.21]), SPIKE[1]), (KNIFE[0] + np.array([0.12, 0.0, 0.083]), KNIFE[1]))
EXACT = {
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-8, iterations=1000),
    "xpbd": wc.XPBD(substeps=1, iterations=10_000),
    "admm": wc.ADMM(substeps=1, tolerance=1e-10, iterations=20_000),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, tolerance=1e-9, iterations=60, linear="factorised"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_all_meet_at_one_minimiser(name):
    """1e-8 m on a spike and a knife, sliding and in tension, where no vertex is near enough to touch them."""
    scene, found = lying(BOTH, 0.3), []
    soft = [wc.Spring(stiffness=40.0), wc.QuadraticBending(stiffness=1e-5)]
    scene = replace(
        scene,
        mesh=wc.Mesh(0.9 * scene.mesh.points, scene.mesh.triangles),
        terms=soft,
        velocities=np.tile([0.1, -0.05, 0.02], (16, 1)),
        gravity=(0.0, -20.0, 0.0),
        contact=wc.Contact(distance=1e-3, stiffness=3e4, elements="triangles"),
    )
    for solver in (wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"), EXACT[name]):
        stepper = solver.bind(scene.build(dtype="float64"))
        stepper.step()
        assert stepper.cut[0] == 0.0
        found.append(stepper.state.x.numpy())
    assert scene.colliders[0].distances(found[0]).min() > 1e-3
    fallen = scene.positions + scene.velocities / 60.0 + scene.gravity / 60.0**2
    assert np.abs(found[0] - fallen).max() > 1e-3
    assert np.abs(found[1] - found[0]).max() < 1e-8


def test_a_plane_of_triangles_presses_as_much(device):
    """Vertices carry a sheet on a plane; the triangles add nothing, also where the mesh is finer than the cloth."""
    grid, ends = wc.Mesh.grid(12, 12, size=0.7), []
    for elements in ("vertices", "triangles"):
        scene = lying((grid.points - np.array([0.21, 0.0, 0.23]), grid.triangles), elements=elements)
        stepper = wc.Newton(substeps=1, tolerance=1e-9).bind(scene.build(device=device, dtype="float64"))
        for _ in range(3):
            stepper.step()
        ends.append(stepper.state.x.numpy())
    assert np.abs(ends[1] - ends[0]).max() < 1e-9


@pytest.mark.parametrize("slope", (15.9, 30.0))
@pytest.mark.parametrize("name", ["newton", pytest.param("xpbd", marks=SLOW)])
def test_friction_on_edges(name, slope):
    """On rails down a slope, μ = 0.3: it sticks for tan θ = 0.95 μ, else a = g(sin θ − μ cos θ), as on a plane.

    The rails are turned by 0.03 against the slope; normals lag by a step.
    """
    solver = {"newton": wc.Newton(substeps=4, tolerance=1e-8), "xpbd": wc.XPBD(substeps=4, iterations=200)}[name]
    scene = lying(rails(0.05, 0.15, 0.25), 0.3, gap=0.98, slope=slope)
    animation = wc.simulate(scene, solver, dtype="float64", record="reactions")
    assert animation.cut == 0.0
    v, down = animation.velocities.mean(axis=1)[:, 0], np.radians(slope)
    if slope < 16.0:
        assert np.abs(v[9:]).max() < 1e-3
    else:
        assert (v[-1] - v[9]) / 0.15 == pytest.approx(9.81 * (np.sin(down) - 0.3 * np.cos(down)), rel=0.01)


def test_triangles_that_were_lifted_off_forget_where_they_were(device):
    """A sheet that cannot move along rails drags on them by μmg. They leave it, and come back elsewhere: then by nothing.

    Normals of the rails are turned by a few hundredths along x, so that their friction is balanced to that.
    """
    along, up = np.array([0.0, 1.0, 2.0, 3.0, 3.0, 13.0, 13.0]), np.array([0.0, 0.0, 0.0, 0.0, -20.0, -20.0, -14.0])
    at, ground = 1e-3 * np.stack([along, up, 0.0 * up], axis=1), rails(0.05, 0.15, 0.25)
    below = wc.MeshCollider(*ground, position=at, friction=0.3, name="rails")
    scene = replace(lying(ground), colliders=[below], pins=wc.Pins("all", axes="xz"), duration=10 / 60)
    run = wc.simulate(scene, wc.Newton(substeps=4), device=device, dtype="float64", record="reactions")
    assert run.cut == 0.0
    weight = 9.81 * scene.vertex_masses.sum()
    pressed, rubbed = run.collider_forces["rails"][:, 1], run.friction_forces["rails"][:, 0]
    assert rubbed[3] == pytest.approx(-0.3 * weight, rel=0.02) and pressed[5] == 0.0
    assert pressed[-1] == pytest.approx(-weight, rel=0.01) and abs(rubbed[-1]) < 0.01 * 0.3 * weight


def test_copies_are_independent(device):
    """One of two copies is hit at once, so the rounds of its filter go on where the other has none; to the bit."""
    scene, solver = falling(MESHES["spike"], 1.0), wc.XPBD(substeps=1, iterations=10)
    both = np.stack([scene.positions, scene.positions + np.array([0.0, 0.05, 0.0])])
    found = wc.simulate(scene, solver, device=device, copies=2, vary={"positions": both}).points
    for copy in range(2):
        alone = wc.simulate(scene, solver, device=device, copies=1, vary={"positions": both[copy : copy + 1]}).points
        np.testing.assert_array_equal(found[:, copy], alone.reshape(found[:, copy].shape))


def test_an_edge_mesh_is_not_cut(device):
    """A chain across a knife, with the edge of this between two of its beads; the segments are tested as flat triangles."""
    beads = np.stack([np.arange(-3.0, 4.0) * EDGE + 0.4 * EDGE, np.full(7, 0.02), np.zeros(7)], axis=1)
    across = wc.MeshCollider(KNIFE[0][:, [2, 1, 0]] * np.array([1.0, 1.0, -1.0]), KNIFE[1])
    chain = wc.Mesh(beads, edges=np.stack([np.arange(6), np.arange(1, 7)], axis=1))
    terms, contact = [wc.Spring(stiffness=300.0)], wc.Contact(distance=2e-3, stiffness=3e4, elements="triangles")
    scene = wc.Scene(chain, masses=np.full(7, 1e-3), terms=terms, colliders=[across], contact=contact, fps=24.0, duration=0.25)
    points = wc.simulate(scene, wc.Newton(substeps=2), device=device).points
    flat = np.array([[i, i + 1, i + 1] for i in range(6)])
    thick = np.concatenate([points, points + np.array([0.0, 1e-7, 0.0])], axis=1)  # as segments have no area
    flat[:, 2] += 7
    assert crossing(thick, flat, across) == [0] * len(points)


@wp.kernel(module="unique", enable_backward=False)
def search(
    p: wp.array(dtype=wp.mat33d),
    move: wp.array(dtype=wp.mat33d),
    q: wp.array(dtype=wp.mat33d),
    drift: wp.array(dtype=wp.mat33d),
    least: wp.float64,
    when: wp.array(dtype=wp.float64),
    gap: wp.array(dtype=wp.float64),
):
    e = wp.tid()
    found, _first, _n, _start = first_contact(p[e], move[e], q[e], drift[e], least)
    when[e] = found
    d, _along, apart = between(
        p[e] + wp.min(found, wp.float64(1.0)) * move[e], q[e] + wp.min(found, wp.float64(1.0)) * drift[e]
    )
    gap[e] = wp.where(apart, d, -wp.float64(1.0))


@SLOW
def test_triangles_meet_when_they_come_near():
    """Triangles that move past one another, against distances at 400 times: none is nearer than ``least`` before it meets.

    Where they meet, their distance is ``least`` up to the step at which the search ends, 2 % of it.
    """
    random, count, least = np.random.default_rng(2), 400, 1e-3
    p, q = (random.uniform(-1.0, 1.0, (count, 3, 3)) for _ in range(2))
    p[..., 1] += 2.5
    move, drift = (random.uniform(-0.4, 0.4, (count, 3, 3)) for _ in range(2))
    move[..., 1] -= 2.5
    arrays = [wp.array(each, dtype=wp.mat33d, device="cpu") for each in (p, move, q, drift)]
    when, gap = (wp.zeros(count, dtype=wp.float64, device="cpu") for _ in range(2))
    wp.launch(search, count, [*arrays, least, when, gap], device="cpu")
    when, gap = when.numpy(), gap.numpy()
    met = when <= 1.0
    assert 0.2 * count < met.sum() < count
    assert (gap[met] > 0.9 * least).all() and np.median(gap[met]) < 1.1 * least and (gap[~met] > least).all()
    for part in np.linspace(0.0, 1.0, 41):
        now = [
            wp.array(a + np.minimum(part, when)[:, None, None] * b, dtype=wp.mat33d, device="cpu")
            for a, b in ((p, move), (q, drift))
        ]
        still = [wp.zeros(count, dtype=wp.mat33d, device="cpu") for _ in range(2)]
        there, apart = (wp.zeros(count, dtype=wp.float64, device="cpu") for _ in range(2))
        wp.launch(search, count, [now[0], still[0], now[1], still[1], least, there, apart], device="cpu")
        assert (apart.numpy() > 0.9 * least).all()
