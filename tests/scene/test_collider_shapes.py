"""The shapes of colliders: distances to meshes and their inside, gaps that keep triangles out, and the default stiffness."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support.layers import R, falling
from support.meshes import disc, joined, leaf
from support.rows import table
from support.shapes import TILTED

CUBE = trimesh.creation.box((0.2, 0.1, 0.3))


@pytest.mark.parametrize("weld", (True, False))
def test_distances_to_a_mesh_are_those_to_its_box(weld):
    """Signed, about faces, edges and corners; seams do not open it. An open one has no inside."""
    box = wc.Box(size=(0.2, 0.1, 0.3), position=(0.25, -0.25, 0.25), rotation=TILTED)
    cube = CUBE if weld else CUBE.copy()
    if not weld:
        cube.unmerge_vertices()
    mesh = wc.MeshCollider(cube.vertices, cube.faces, position=box.position, rotation=box.rotation)
    points = box.position + np.random.default_rng(0).uniform(-0.3, 0.3, size=(500, 3))
    assert mesh.closed
    np.testing.assert_allclose(mesh.distances(points), box.distances(points), atol=1e-12)
    sheet = replace(mesh, triangles=cube.faces[1:])
    assert not sheet.closed and sheet.distances(points).min() > 0.0


DOUBLED = {
    "square, other diagonal": disc(4, 1),
    "pentagon": disc(5, 0),
    "disc": disc(12, 5),
    "card": leaf(lambda x, z: 0.0 * x),
    "card, other diagonals": leaf(lambda x, z: 0.0 * x, True),
    "dome": leaf(lambda x, z: 0.4 - x**2 - z**2),
    "dome, other diagonals": leaf(lambda x, z: 0.4 - x**2 - 2.0 * z**2 + x * z**2, True),
    "leaf": leaf(lambda x, z: 0.5 * x * z),
    "leaf, other diagonals": leaf(lambda x, z: 0.5 * x * z, True),
    "leaf, other diagonals, turned": leaf(lambda x, z: -0.5 * x * z, True),
}
# A cube with a sheet beside it, and one that is there three times with other first corners.
CUBES = {
    "with a leaf": (0.1, joined((0.1 * CUBE.vertices, CUBE.faces), leaf(lambda x, z: 0.0 * x + 0.2))),
    "three times": (1.0, joined(*((CUBE.vertices, np.roll(CUBE.faces, k, axis=1)) for k in range(3)))),
}
PROBES = np.random.default_rng(0).uniform(-0.7, 0.7, size=(2000, 3))


@pytest.mark.parametrize("name", DOUBLED)
def test_front_and_back_that_coincide_are_a_sheet(name):
    """Nothing is inside, a few points between diagonals of a twisted leaf aside."""
    collider = wc.MeshCollider(*DOUBLED[name])
    distances = collider.distances(PROBES)
    assert not collider.faces_inwards and distances.min() > -0.01 and (distances < 0.0).mean() < 0.01
    assert "diagonal" in name or not collider.closed


@pytest.mark.parametrize("name", CUBES)
def test_the_inside_of_cubes(name):
    scale, mesh = CUBES[name]
    probes = np.concatenate([PROBES, PROBES * scale / 2.0])
    inside = (np.abs(probes) < scale * CUBE.vertices.max(axis=0)).all(axis=1)
    assert inside.sum() > 20
    np.testing.assert_array_equal(wc.MeshCollider(*mesh).distances(probes) < 0.0, inside)


@pytest.mark.parametrize("size", [(10, 0.1, 10), (10, 3, 10), (20, 0.02, 20)])
def test_slabs_and_rooms_whose_fronts_face_inwards(size):
    cube = CUBE.vertices * np.array(size)
    assert wc.MeshCollider(cube, CUBE.faces[:, ::-1]).faces_inwards and not wc.MeshCollider(cube, CUBE.faces).faces_inwards
    for lift in (0.1, -0.1):  # a card of two quads, whose fans have other diagonals, with a corner that is lifted
        points = [[0, 0, 0], [1, 0, 0], [1, lift, 1], [0, 0, 1]]
        assert not wc.MeshCollider(points, [[0, 1, 2], [0, 2, 3], [3, 2, 1], [3, 1, 0]]).faces_inwards


@table("name", ["square, other diagonal", "card"], DOUBLED)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_front_and_back_that_coincide_hold_cloth_on_both_sides(name, side):
    points, triangles = DOUBLED[name]
    collider = wc.MeshCollider(points - [0.0, points[:, 1].max() * (side > 0), 0.0], triangles)
    grid = wc.Mesh.grid(7, 7, size=0.3)
    mesh = wc.Mesh(grid.points + np.array([-0.15, side * 0.45, -0.15]), grid.triangles)
    fields = {"density": 0.2, "terms": [wc.Spring(stiffness=500.0)], "gravity": (0.0, -9.81 * side, 0.0)}
    run = wc.simulate(wc.Scene(mesh, colliders=[collider], **fields), wc.Newton(substeps=4), frames=40)
    assert run.status.ok and -0.45 < (side * run.points[-1][:, 1]).min() < 0.2  # 1.7 m lower without a collider


def test_the_default_stiffness_is_said():
    """(2/r)(wL/r + Y/L) on any mesh, Y of the stiffest term; ``print`` and ``info`` say it."""
    for n, given in (
        (6, {"terms": [wc.CorotatedMembrane(stiffness=300.0), wc.Spring(stiffness=100.0)]}),
        (9, {"stiffness": 150.0 * np.sqrt(3.0)}),
    ):
        scene = falling([wc.Plane()], n=n, contact=None, **given)
        assert scene.contact.stiffness == pytest.approx(2.0 / R * (0.15 * 9.81 * 0.5 / R + 300.0 / 0.5))
        assert "contact: distance 0.001 m, stiffness 2.67" in str(scene)
    hard = falling([wc.Plane()], terms=[wc.Spring(stiffness=np.inf)], contact=None)
    assert hard.contact.stiffness == pytest.approx(2.0 / R * 0.15 * 9.81 * 0.5 / R)
    mesh, fields = wc.Mesh.chain(11, length=2.0), {"density": 0.1, "terms": [wc.Spring(stiffness=1e3)]}
    chain = wc.Scene(mesh, colliders=[wc.Plane(position=(0, -3, 0))], **fields)
    assert chain.contact.stiffness == pytest.approx(2.0 / R * 0.1 * 9.81 / (2.0 * R) * 2.0 / R)  # as a strip of width 2 R


ROUND = {
    "sphere": wc.Sphere(radius=0.05),
    "capsule": wc.Capsule(radius=0.03, length=0.1),
    "box": wc.Box(size=(0.3, 0.04, 0.1), rotation=TILTED),
}


@pytest.mark.parametrize("shape", ROUND.values(), ids=ROUND)
def test_gaps_that_keep_triangles_out(shape, edge=0.2):
    """No triangle with vertices at this gap or farther is cut, of any shape."""
    random, gap = np.random.default_rng(0), shape.clearing_gap(edge)
    triangles = random.normal(scale=0.2, size=(200000, 1, 3)) + random.uniform(-0.15, 0.15, size=(200000, 3, 3))
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    triangles = triangles[(longest <= edge) & (shape.distances(triangles).min(axis=1) >= gap)]
    nearest = np.full((len(triangles), 1), np.inf)
    for _ in range(100):
        nearest = np.minimum(nearest, shape.distances(random.dirichlet(np.ones(3), len(triangles))[:, None] @ triangles))
    assert len(triangles) > 1000 and nearest.min() > 0.0


def test_gaps_of_triangles_that_touch(edge=0.2):
    """A triangle whose vertices are just as near touches a ball, or a point. ``print`` says the gaps of a scene."""
    angles = 2.0 * np.pi / 3.0 * np.arange(3)
    corners = edge / np.sqrt(3.0) * np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1)
    for touched in (wc.Sphere(radius=0.05, position=(0.0, -0.05, 0.0)), wc.Box(size=(1e-9, 1e-9, 1e-9))):
        assert touched.distances(corners) == pytest.approx(touched.clearing_gap(edge))
    assert wc.Plane().clearing_gap(edge) == 0.0
    large = wc.Sphere(radius=9.0, position=(0, -9.3, 0))
    text = str(falling([wc.Plane(position=(0, -1, 0)), wc.Box(name="chest", position=(0.0, -1.0, 0.0)), large]))
    assert "as edges are up to 0.141 m; gaps that prevent it: 0.0816 m of chest" in text
