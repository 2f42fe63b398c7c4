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
PLUS = [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3), (1, 2), (0, 2), (0, 1), (1, 1)]
WINDOWS = [
    *[(0, 0), (9, 0), (9, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (5, 1), (5, 3), (7, 3), (7, 1)],
    (5, 1),
    (3, 1),
    (1, 1),
]
SHAPES = {"arrow": ARROW, "L": L, "comb": COMB, "frame": FRAME, "straight": STRAIGHT, "spiral": SPIRAL, "plus": PLUS}
DIVIDED = [(3.25, 0.75), (2.5, 0.5), (1.75, 0.25), (1, 0), (1.5, 1), (2, 2), (1.75, 2.5), (1.5, 3), (1.25, 3.5), (1, 4)]
DIVIDED += [(1.6, 3.4), (2.2, 2.8), (2.8, 2.2), (3.4, 1.6), (4, 1)]
SHAPES |= {"frame with two windows": WINDOWS, "divided sides": DIVIDED}
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
    with pytest.raises(ValueError, match=rf"a.{ending}.*: face 1 crosses or touches itself, or is not planar"):
        wc.Mesh.load(tmp_path / f"a.{ending}")


@pytest.mark.parametrize(("lift", "refused"), [(0.0, False), (0.1, False), (0.2, False), (1.0, True)])
def test_faces_far_from_planar_are_refused(lift, refused):
    angle = np.arange(6) * np.pi / 3
    points = np.stack([np.cos(angle), lift * (-1.0) ** np.arange(6), np.sin(angle)], axis=1)
    triangles, bad = cut(points, np.array([6]))
    assert bad == [0] * refused and triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]


REPEATED = {  # faces of the unit square and the triangles that they have
    "at the end": ([(0, 1, 2, 2)], [[0, 1, 2]]),
    "within": ([(0, 1, 1, 2, 3)], [[0, 1, 2], [2, 3, 0]]),
    "first and last": ([(0, 1, 2, 3, 0)], [[0, 1, 2], [2, 3, 0]]),
    "a line": ([(1, 2, 2, 2), (0, 1, 2)], [[0, 1, 2]]),
}


@pytest.mark.parametrize("ending", ["obj", "ply", "off"])
@pytest.mark.parametrize(("faces", "triangles"), REPEATED.values(), ids=REPEATED)
def test_corners_that_repeat_the_one_before_are_left_out(tmp_path, ending, faces, triangles):
    (tmp_path / f"a.{ending}").write_text(TEXTS[ending](flat([(0, 0), (1, 0), (1, 1), (0, 1)]), faces))
    assert wc.Mesh.load(tmp_path / f"a.{ending}").triangles.tolist() == triangles


def test_texture_coordinates_stay_at_their_corners_beside_repeated_ones(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 0 1\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 0\n"
    (tmp_path / "a.obj").write_text(text + "f 1/1 2/2 2/2 3/3\nf 1/5 3/3 4/4\n")
    st = wc.Mesh.load(tmp_path / "a.obj").texture_coordinates
    assert st.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0.5, 0], [1, 1], [0, 1]]]


def test_files_without_area_and_faces_that_touch_themselves_are_refused(tmp_path):
    points = flat([(0, 0), (1, 0), (2, 0), (1, 1)])
    (tmp_path / "a.obj").write_text(TEXTS["obj"](points, [(0, 1, 1, 1)]))
    with pytest.raises(ValueError, match=r"a.obj: has no face with three different corners"):
        wc.Mesh.load(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text(TEXTS["obj"](points, [(0, 1, 3), (0, 1, 2, 3, 1)]))
    with pytest.raises(ValueError, match=r"a.obj: face 1 crosses or touches itself"):
        wc.Mesh.load(tmp_path / "a.obj")


def test_captures_have_quads_of_any_shape(tmp_path):
    crumpled = [[0, 0, 0], [1, 0, 1], [1, 1, 0], [0, 1, 1]]
    for frame, points in enumerate([flat([(0, 0), (1, 0), (1, 1), (0, 1)]), crumpled, flat(CROSSING["bow tie"])]):
        (tmp_path / f"a.{frame}.obj").write_text(TEXTS["obj"](points, [(0, 1, 2, 3)]))
    capture = wc.open_capture(tmp_path)
    assert [capture[frame].triangles.tolist() for frame in range(3)] == [[[0, 1, 2], [2, 3, 0]]] * 3


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


OUTLINES = [*SHAPES.values(), *([(0, 0), (n, 0), (n, n), (0, n)] for n in (1, 2))]
ROUNDED = {"exact": lambda x: x, "float32": lambda x: x.astype(np.float32).astype(float), "6 digits": lambda x: x.round(6)}


def divided(corners, parts):
    """Polygon (k, 2) with corners between: each side has a number of parts, the same where sides run back along others."""
    ends = np.roll(corners, -1, axis=0)
    number = {frozenset((tuple(a), tuple(b))): n for a, b, n in zip(corners, ends, parts, strict=True)}
    sides = zip(corners, ends, strict=True)
    each = ((a, b, number[frozenset((tuple(a), tuple(b)))]) for a, b in sides)
    return np.array([a + (b - a) * k / n for a, b, n in each for k in range(n)])


@settings(deadline=None, derandomize=True, database=None, max_examples=300)
@given(st.sampled_from(OUTLINES), seeds, st.sampled_from([*ROUNDED]), st.booleans())
def test_corners_on_a_line_make_no_flat_triangles(corners, seed, rounded, turned):
    """On a lattice, along bridges to holes and across faces, from any first corner, in any plane."""
    random = np.random.default_rng(seed)
    x = flat(divided(np.array(corners, dtype=float), random.integers(1, 4, len(corners))) * 0.1)
    x = Rotation.random(random_state=int(seed)).apply(x) + random.normal(size=3) if turned else x
    x = ROUNDED[rounded](np.roll(x, random.integers(len(x)), axis=0))
    triangles = triangles_of(x, np.array([len(x)]))
    normals, sides = areas(x, triangles), x[triangles] - x[np.roll(triangles, 1, axis=1)]
    assert triangles.shape == (len(x) - 2, 3) and np.unique(triangles).tolist() == [*range(len(x))]
    assert (2 * np.linalg.norm(normals, axis=1) / (sides**2).sum(axis=2).max(axis=1)).min() > 1e-3
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum(), 0.01 * shoelace(corners), rtol=1e-4)
    assert (normals @ normals.sum(axis=0) > 0.0).all()


def left(a, b, c):
    """1 if c is left of the line from a to b, −1 if right, 0 on it; for whole numbers."""
    return int(np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])))


def crossings(p):
    """Pairs of sides of a polygon of whole numbers that cross within both, and whether any corner lies on another side."""
    sides = [(p[k], p[(k + 1) % len(p)]) for k in range(len(p))]
    pairs = [(j, k) for k in range(len(p)) for j in range(k)]
    found = [
        (j, k)
        for j, k in pairs
        if left(*sides[j], sides[k][0]) * left(*sides[j], sides[k][1]) < 0
        and left(*sides[k], sides[j][0]) * left(*sides[k], sides[j][1]) < 0
    ]
    between = [left(a, b, c) == 0 and np.dot(np.subtract(a, c), np.subtract(b, c)) < 0 for c in p for a, b in sides]
    return found, any(between)


@settings(deadline=None, derandomize=True, database=None, max_examples=400)
@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=4, max_size=12, unique=True), seeds, st.booleans())
def test_only_polygons_that_cross_or_touch_themselves_are_refused(corners, seed, untangled):
    """Random corners on a lattice, from any first corner."""
    while untangled and (found := crossings(corners)[0]):
        (j, k), *_ = found
        corners[j + 1 : k + 1] = corners[j + 1 : k + 1][::-1]
    random, count = np.random.default_rng(seed), len(corners)
    x = np.roll(0.1 * flat(corners), random.integers(count), axis=0)
    triangles, bad = cut(x, np.array([count]))
    crossed, touched = crossings(corners)
    if crossed:
        assert bad == [0]
    elif not touched:
        normals = areas(x, triangles)
        assert bad == [] and (normals @ normals.sum(axis=0) > 0.0).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum(), 0.01 * shoelace(corners), rtol=1e-9)
