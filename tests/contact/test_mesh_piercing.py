"""Meshes that pass through triangles of the cloth are named; those that triangles only cut into are not."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support.crossings import crossing
from warpcloth.run.contact_verdicts import contact_faults

FPS, LEG, HEIGHT = 25.0, 0.1, 0.013
SOLVER = wc.Explicit(substeps=16)
LONGEST = np.sqrt(2.0) * LEG
CORNERS = np.array([[-0.3, 0.0, -0.3], [0.7, 0.0, -0.3], [-0.3, 0.0, 0.7]]) * LEG
TURNS = np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)


def needle(height, radius=1e-3, name=None, **fields):
    """A cone with its tip at the origin, down to −``height``."""
    rim = np.stack([radius * np.cos(TURNS), 0.0 * TURNS - height, radius * np.sin(TURNS)], axis=1)
    triangles = [[(i + 1) % 6, i, 6] for i in range(6)] + [[i, (i + 1) % 6, 7] for i in range(6)]
    return wc.MeshCollider(np.concatenate([rim, [[0.0, 0.0, 0.0], [0.0, -height, 0.0]]]), triangles, name=name, **fields)


def box(x, height, z):
    """A box from the plane through the origin down to −``height``."""
    mesh = trimesh.creation.box((x, height, z))
    return wc.MeshCollider(mesh.vertices - [0.0, 0.5 * height, 0.0], mesh.faces)


def rail(height):
    """A beam that is far longer than the triangle, so that only its edges meet it."""
    return box(2e-3, height, 2.0)


def flying(collider, speed, frames=20, elements="vertices", **fields):
    """A triangle that flies down at ``speed`` from HEIGHT above the origin, and meets nothing with its vertices."""
    return wc.Scene(
        wc.Mesh(CORNERS, [[0, 2, 1]]),
        density=0.1,
        terms=[wc.Spring(stiffness=0.1)],
        gravity=(0.0, 0.0, 0.0),
        positions=CORNERS + np.array([0.0, HEIGHT, 0.0]),
        velocities=np.tile([0.0, -speed, 0.0], (3, 1)),
        colliders=[collider],
        contact=wc.Contact(distance=1e-3, stiffness=1e4, elements=elements),
        fps=FPS,
        duration=frames / FPS,
        **fields,
    )


def depth_in(frame, speed):
    """How far the triangle is below the tip at the end of a frame."""
    return frame * speed / FPS - HEIGHT


def first_frame(height, speed):
    """The frame in which a body from 0 down to −``height`` counts as passed, by the rule of the kernel.

    It stands in the triangle if it goes on by more than L/2 to both sides. It went through if it is farther than L above the
    triangle, or than L/2 if no more of it is in the triangle. L is the longest edge.
    """
    for frame in range(1, 100):
        depth = depth_in(frame, speed)
        stands = LONGEST / 2.0 < depth < height - LONGEST / 2.0
        if stands or depth > (LONGEST if depth < height else LONGEST / 2.0):
            return frame
    raise AssertionError("it never passes")


CASES = [  # body, its height, speed
    (needle, 0.5, 0.25),  # stands in the triangle for many frames
    (needle, 0.08, 0.25),  # shorter than the longest edge, so that it never stands
    (needle, 0.03, 0.25),
    (needle, 0.3, 5.0),  # slower through than a frame, and faster
    (needle, 0.05, 5.0),
    (rail, 0.5, 0.25),
    (rail, 0.03, 0.5),
    (needle, 0.5, 0.05),  # which ends 0.027 m deep, as cloth that bends between its vertices may
]


@pytest.mark.parametrize(("body", "height", "speed"), CASES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_passes_through_a_triangle(body, height, speed, dtype, device):
    """Nothing but the motion decides in which frame: depth and heights are known in closed form."""
    found = wc.simulate(flying(body(height), speed), SOLVER, dtype=dtype, device=device)
    expected = first_frame(height, speed)
    assert [each.frame for each in found.pierced] == [expected] * (expected <= 20)
    assert found.cut == 0.0 and not found.inside
    assert found.points[-1][:, 1] == pytest.approx(-depth_in(20, speed), abs=1e-4)  # 320 additions of float32 to up to 4 m


def test_the_report(device):
    scene = flying(needle(0.5, name="Needle"), 0.25)
    found = wc.simulate(scene, SOLVER, device=device)
    (pierced,) = found.pierced
    assert str(pierced) == "Needle has passed through triangle 0 of the cloth, between its vertices, in frame 9"
    ((copy, frame, sentence),) = contact_faults(scene, [], found.inside, found.pierced)
    assert (copy, frame) == (0, 9) and 'Contact(elements="triangles")' in sentence


def test_no_triangle_is_named_that_is_not_free_or_kept_out(device):
    """Of a triangle with a pinned vertex, which may be inside; nor with the filter of triangles; nor beside a needle."""
    for scene in (
        flying(needle(0.5), 0.25, pins=[0]),
        flying(needle(0.5), 0.25, elements="triangles"),
        flying(needle(0.5, position=(0.5 * LEG, 0.0, 0.5 * LEG)), 0.25),
    ):
        assert wc.simulate(scene, SOLVER, device=device).pierced == ()


@pytest.mark.parametrize(("angle", "named"), [(90.0, False), (60.0, False), (40.0, True)])
def test_a_border_beside_a_post(angle, named, device):
    """The upright edge of a tall post goes 2 cm into a side of the triangle, which its faces cut at 4, 2.3 and 1.5 cm.

    With 4 and 2.3 cm the side cuts off a corner; what is deeper than it is wide has passed through.
    """
    half, depth = 0.5 * np.tan(np.radians(0.5 * angle)), 0.02
    section = np.array([[0.0, 0.0], [half, -0.5], [-half, -0.5]]) + np.array([0.2 * LEG, CORNERS[0, 2] + depth])
    points = np.concatenate([np.column_stack([section[:, 0], np.full(3, y), section[:, 1]]) for y in (-1.0, 1.0)])
    sides = [[[i, (i + 1) % 3, i + 3], [(i + 1) % 3, (i + 1) % 3 + 3, i + 3]] for i in range(3)]
    post = wc.MeshCollider(points, [*np.concatenate(sides), [0, 2, 1], [3, 4, 5]])
    found = wc.simulate(flying(post, 0.0), SOLVER, device=device, frames=1)
    assert bool(found.pierced) == named


def test_each_copy_has_its_own(device):
    """Three speeds, of which the slowest passes in no frame."""
    speeds = np.array([0.25, 0.05, 0.5])
    velocities = np.stack([0.0 * speeds, -speeds, 0.0 * speeds], axis=1)[:, None].repeat(3, axis=1)
    given = {"copies": 3, "vary": {"velocities": velocities}, "device": device}
    found = wc.simulate(flying(needle(0.5), 0.25), SOLVER, **given)
    assert {each.copy: each.frame for each in found.pierced} == {0: first_frame(0.5, 0.25), 2: first_frame(0.5, 0.5)}
    assert found.of_copy(1).pierced == () and len(found.of_copy(2).pierced) == 1


def test_a_needle_that_moves_and_one_that_grows(device):
    """As through a triangle that flies: one rises from below, one grows from a point of its keyframes."""
    frames, speed = 20, 0.25
    up = speed * np.arange(frames + 1) / FPS
    rises = needle(0.5, position=np.stack([0.0 * up, up, 0.0 * up], axis=1))
    grows = needle(0.5).points + np.multiply.outer(up, np.eye(8)[6])[:, :, None] * [0.0, 1.0, 0.0]
    for mesh in (rises, replace(needle(0.5), points=grows)):
        found = wc.simulate(flying(mesh, 0.0), SOLVER, device=device)
        assert [each.frame for each in found.pierced] == [first_frame(0.5, speed)]


def test_resume(tmp_path, device):
    """A needle shorter than the longest edge passes where the run is interrupted, so the verdict needs the frames before."""
    scene, output = flying(needle(0.03), 0.1, frames=24), tmp_path / "out.usdc"
    expected = first_frame(0.03, 0.1)
    assert 13 < expected < 24

    def stop(frame, _frames):
        if frame == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wc.simulate(scene, SOLVER, output, device=device, progress=stop)
    resumed = wc.simulate(scene, SOLVER, output, device=device, resume=True)
    assert [each.frame for each in resumed.pierced] == [expected]


def ball(radius=0.15):
    """A ball of triangles below the origin, whose corners are on the sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return wc.MeshCollider(mesh.vertices - [0.0, radius, 0.0], mesh.faces)


def draped(mesh, speed=1.0, n=8, size=0.6, elements="vertices"):
    grid = wc.Mesh.grid(n, n, size=size, pattern="alternating")
    return wc.Scene(
        grid,
        density=0.15,
        terms=[wc.Spring(pairs=("structural", "shear"), stiffness=300.0), wc.QuadraticBending(stiffness=1e-5)],
        positions=grid.points + np.array([-0.5 * size, 0.02, -0.5 * size]),
        velocities=np.tile([0.1 * speed, -speed, 0.0], (n * n, 1)),
        colliders=[mesh],
        contact=wc.Contact(distance=2e-3, elements=elements),
        fps=24.0,
        duration=0.5,
    )


@pytest.mark.parametrize("speed", [1.0, 10.0])
@pytest.mark.parametrize("mesh", [ball(), box(0.3, 0.2, 0.3)], ids=["ball", "box"])
def test_cloth_that_only_cuts_into_a_mesh(mesh, speed, device):
    """Flat triangles of 9 and 12 cm cut into a ball and over the edges of a box, as exact predicates say."""
    scene = draped(mesh, speed)
    found = wc.simulate(scene, wc.XPBD(substeps=4, iterations=10), device=device)
    assert max(crossing(found.points, scene.mesh.triangles, mesh)) > 10
    assert found.pierced == ()


@pytest.mark.parametrize(
    "mesh",
    [box(0.04, 0.3, 0.04), box(1.2, 0.02, 0.02), box(0.004, 0.4, 0.4)],
    ids=["post", "rail", "wall"],
)
def test_cloth_that_falls_through(mesh, device):
    """What is narrower than a triangle, so that the sheet ends below it, is named."""
    scene = draped(mesh)
    found = wc.simulate(scene, wc.XPBD(substeps=4, iterations=10), device=device)
    assert found.points[-1][:, 1].max() < found.points[0][:, 1].min() - 0.5
    assert len(found.pierced) == 1
