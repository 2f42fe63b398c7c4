"""Polygons of all files, cut into triangles that cover them once; and those that cannot be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import warpcloth as wc
from support.mesh_texts import TEXTS
from warpcloth.mesh.polygons import cut, triangles_of
from warpcloth.usd import read_scene

ARROW = [(0, 0), (1, 0.5), (0, 1), (0.35, 0.5)]
L = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 1.5), (1, 2), (0.5, 2), (0, 2)]  # with straight corners, which neighbours may share
COMB = [(0, 0), (7, 0), *((7 - k, 1 + 2 * (k // 2 % 2 == 0)) for k in range(0, 7)), (0, 3)]
FRAME = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]  # a hole, joined by a slit
STRAIGHT = [(0, 0), (0.5, 0), (1, 0), (1, 1), (0, 1)]
SPIRAL = [(0, 0), (5, 0), (5, 5), (1, 5), (1, 2), (3, 2), (3, 3), (2, 3), (2, 4), (4, 4), (4, 1), (0, 1)]
SHAPES = {"arrow": ARROW, "L": L, "comb": COMB, "frame": FRAME, "straight": STRAIGHT, "spiral": SPIRAL}
CROSSING = {
    "bow tie": [(0, 0), (1, 1), (1, 0), (0, 1)],
    "uneven bow tie": [(0, 0), (2, 1), (2, 0), (0, 1.5)],
    "star": [(np.cos(0.8 * np.pi * k), np.sin(0.8 * np.pi * k)) for k in range(5)],
    "strip over itself": [(0, 0), (9, 0), (9, 9), (4, 9), (4, -2), (5, -2), (5, 8), (8, 8), (8, 1), (0, 1)],
    "spike through a side": [(0, 0), (4, 0), (4, 4), (2, -1), (0, 4)],
}


def flat(corners):
    """Corners (k, 2) as points in the plane y = 0, whose normal is +y if they turn clockwise in x and z."""
    return np.insert(np.array(corners, dtype=float), 1, 0.0, axis=1)


def areas(points, triangles):
    return 0.5 * np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]])


def shoelace(corners):
    x, y = np.array(corners, dtype=float).T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def check(points, area):
    """The triangles of one face cover it once, from each first corner, with all corners."""
    for first in range(len(points)):
        x = np.roll(points, first, axis=0)
        triangles = triangles_of(x, np.array([len(x)]))
        normals = areas(x, triangles)
        assert triangles.shape == (len(x) - 2, 3) and np.unique(triangles).tolist() == [*range(len(x))]
        np.testing.assert_allclose(np.linalg.norm(normals.sum(axis=0)), area, rtol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum(), area, rtol=1e-9)


@pytest.mark.parametrize("ending", TEXTS)
@pytest.mark.parametrize("name", SHAPES)
def test_concave_faces_keep_their_area_in_all_files(tmp_path, ending, name):
    corners = SHAPES[name]
    for first in range(len(corners)):
        points = np.roll(flat(corners), first, axis=0)
        (tmp_path / f"a.{ending}").write_text(TEXTS[ending](points, [range(len(points))]))
        mesh = wc.Mesh.load(tmp_path / f"a.{ending}")
        normals = areas(mesh.points, mesh.triangles)[:, 1]
        np.testing.assert_allclose([mesh.triangle_areas.sum(), abs(normals.sum())], shoelace(corners), rtol=1e-6)
        assert np.ptp(np.sign(normals)) == 0


@pytest.mark.parametrize("ending", TEXTS)
@pytest.mark.parametrize("name", CROSSING)
def test_faces_that_cross_themselves_are_refused_by_number(tmp_path, ending, name):
    points = np.concatenate([flat([(9, 9), (9, 8), (8, 8)]), flat(CROSSING[name])])
    (tmp_path / f"a.{ending}").write_text(TEXTS[ending](points, [(0, 1, 2), range(3, len(points))]))
    with pytest.raises(ValueError, match=rf"a.{ending}.*: face 1 crosses itself or is far from planar; it must have a simple"):
        wc.Mesh.load(tmp_path / f"a.{ending}")


@pytest.mark.parametrize(("lift", "refused"), [(0.0, False), (0.1, False), (0.2, False), (1.0, True)])
def test_faces_far_from_planar_are_refused(lift, refused):
    angle = np.arange(6) * np.pi / 3
    points = np.stack([np.cos(angle), lift * (-1.0) ** np.arange(6), np.sin(angle)], axis=1)
    triangles, bad = cut(points, np.array([6]))
    assert bad == [0] * refused and triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]


def test_colliders_have_no_triangles_over_notches(tmp_path):
    sheet = TEXTS["usda"](flat(L), [range(len(L))], schemas='(prepend apiSchemas = ["PhysicsCollisionAPI"])')
    springs = 'double warpcloth:density = 0.1\ntoken warpcloth:terms:a:type = "Spring"\ndouble warpcloth:terms:a:stiffness = 9'
    cloth = TEXTS["usda"](flat(ARROW) + np.array([0, 1, 0]), [range(4)], springs).replace("Sheet", "Cloth")
    (tmp_path / "a.usda").write_text(cloth + sheet[sheet.index("def Mesh") :])
    (collider,) = read_scene(tmp_path / "a.usda").colliders
    assert areas(collider.points, collider.triangles)[:, 1].sum() == pytest.approx(-3.0)
    assert np.abs(areas(collider.points, collider.triangles)[:, 1]).sum() == pytest.approx(3.0)


sides = st.integers(3, 14)
seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, derandomize=True, database=None)
@given(sides, seeds, st.floats(0.05, 1.0), st.booleans())
def test_random_faces_are_covered_once(count, seed, least, straight):
    """Their corners lie around a point in random directions and distances; some lie on a straight side; in any plane."""
    random = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(count) + random.uniform(0, 0.8, count)) / count
    corners = random.uniform(least, 1.0, (count, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if straight:
        corners = np.insert(corners, 1, corners[0] + random.uniform(0.1, 0.9) * (corners[1] - corners[0]), axis=0)
    turn = Rotation.random(random_state=int(seed))
    scale = 10.0 ** random.integers(-3, 4)
    check(scale * turn.apply(flat(corners)), scale**2 * shoelace(corners))


@settings(deadline=None, derandomize=True, database=None)
@given(st.lists(sides, min_size=1, max_size=5), seeds)
def test_convex_faces_are_fans(counts, seed):
    random, faces = np.random.default_rng(seed), []
    for count in counts:
        angles = np.sort(2 * np.pi * (np.arange(count) + random.uniform(0, 0.5, count)) / count)
        circle = np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
        faces.append(Rotation.random(random_state=int(seed)).apply(circle) * random.uniform(0.1, 10, 3))
    fans, start = [], 0
    for count in counts:
        fans += [(start, start + k, start + k + 1) for k in range(1, count - 1)]
        start += count
    assert triangles_of(np.concatenate(faces), np.array(counts)).tolist() == [list(row) for row in fans]
