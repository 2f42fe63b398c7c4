"""The ray caster: silhouettes, shadows and light against exact ones, colours, scales, and what it does with bad input."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from warpcloth.picture.camera import Camera
from warpcloth.picture.colour import Scale, to_linear
from warpcloth.picture.raycast import RayCaster
from warpcloth.picture.shape import Shape

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
BLACK, WHITE = (0.0, 0.0, 0.0), np.ones(3)
# A tube of no length is a ball.
BALL = np.array([[0, 0]])


def icosphere(subdivisions):
    found = trimesh.creation.icosphere(subdivisions)
    return np.array(found.vertices), np.array(found.faces)


def linear(image):
    return to_linear(image / 255.0)


def coverage(shape, points, camera, size, device, samples=16):
    """Share (height, width) of each pixel that a shape covers, which is white before black and not shaded."""
    caster = RayCaster([shape], *size, samples=samples, contrast=0.0, background=BLACK, device=device)
    return linear(caster.image([points], camera, [np.ones((shape.count, 3))]))[..., 0]


def sampling_error(perimeter, samples):
    """Four standard deviations of an area [px] that is summed from ``samples`` a pixel, as random as they could be."""
    # A pixel on the edge is covered by any share from 0 to 1, of which ``samples`` random ones know √(1/6 / samples).
    return 4.0 * np.sqrt(perimeter / 6.0 / samples)


@pytest.mark.parametrize("target", [(0.0, 0.0, 0.0), (1.0, 0.6, 0.0)], ids=["in the middle", "aside"])
@pytest.mark.parametrize("kind", ["ball", "triangles"])
def test_silhouette_of_a_sphere_is_the_section_of_its_cone(device, kind, target):
    """A cone of half angle α with its axis at θ to the view meets the plane at distance 1 in an ellipse of known axes."""
    camera = Camera((0.0, 0.0, 5.0), target, fov=40.0)
    width, height = 240, 180
    view = np.subtract(camera.target, camera.position)
    cos = view @ [0.0, 0.0, -1.0] / np.linalg.norm(view)
    sin = 1.0 / 5.0
    scale = height / 2.0 / np.tan(np.radians(20.0))  # pixels at distance 1
    squared = cos**2 - sin**2
    a, b = scale * sin * np.sqrt(1.0 - sin**2) / squared, scale * sin / np.sqrt(squared)
    perimeter = np.pi * (a + b)
    if kind == "ball":
        shape, points, chord = Shape(1, lines=BALL, radius=1.0), np.zeros((1, 3)), 0.0
    else:
        points, triangles = icosphere(4)
        shape = Shape(len(points), triangles)
        edges = points[triangles] - points[np.roll(triangles, 1, axis=1)]
        # An outline of chords is inside by up to e²/8; of a surface of triangles, whose middles are e²/6 inside, up to that.
        chord = (edges**2).sum(axis=2).max() / 6.0
    missing = np.pi * a * b - coverage(shape, points, camera, (width, height), device).sum()
    error = sampling_error(perimeter, 16)
    assert -error < missing < error + perimeter * max(a, b) * chord
    assert error < 0.005 * np.pi * a * b


@pytest.mark.parametrize("elevation", [0.0, 35.0, 70.0])
def test_silhouette_of_a_tube_is_that_of_its_projection(device, elevation):
    """From afar, of a length L cos φ: two straight sides and two half circles."""
    length, r, fov = 1.0, 0.1, 0.2
    points = np.array([[0.0, -length / 2.0, 0.0], [0.0, length / 2.0, 0.0]])
    camera = Camera.framed([points * 1.4], 20.0, elevation, aspect=1.0, fov=fov, margin=0.2)
    distance = np.linalg.norm(np.subtract(camera.position, camera.target))
    scale = 200 / 2.0 / np.tan(np.radians(fov / 2.0)) / distance  # pixels a metre
    shape = Shape(2, lines=[[0, 1]], radius=r)
    straight = length * np.cos(np.radians(elevation))
    exact = scale**2 * (2.0 * r * straight + np.pi * r**2)
    found = coverage(shape, points, camera, (200, 200), device).sum()
    perimeter = scale * (2.0 * straight + 2.0 * np.pi * r)
    perspective = 2.0 * length / distance * exact  # what is half the length nearer is larger by this at most
    assert abs(found - exact) < sampling_error(perimeter, 16) + perspective
    assert perspective < 0.02 * exact


def test_a_tube_thinner_than_a_pixel_is_as_wide_as_one(device):
    points = np.array([[-0.4, -1.0, 0.0], [0.5, 1.0, 0.0]])
    camera = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), fov=20.0)
    rows = coverage(Shape(2, lines=[[0, 1]], radius=1e-9), points, camera, (64, 64), device).sum(axis=1)
    width = 1.0 / np.cos(np.arctan2(0.9, 2.0))
    assert abs(rows.mean() - width) < 0.03 and rows.min() > 0.7


def test_shadow_of_a_sphere_is_an_ellipse(device):
    """Of parallel light: with axes R and R/sin e, e the elevation of the sun, about where the ray through the centre lands."""
    r, size = 0.3, 200
    camera = Camera((0.0, 2.0, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0), fov=40.0)
    caster = RayCaster(
        [Shape(1, balls=[0], ball_radius=r)], size, size, 16, ground=0.0, sun_angle=0.0, background=BLACK, device=device
    )
    sun = camera.sun(np.eye(3)[1])
    centre = 4.0 * sun / sun[1]  # at a height of 4 m, behind the camera, so that its shadow is in the middle
    lit, shaded = (linear(caster.image([[p]], camera))[..., 1] for p in ([0.0, -9.0, 0.0], centre))
    lost = 1.0 - shaded / lit
    shadow = lost / np.median(lost[lost > 0.5 * lost.max()])
    pixel = 2.0 * 2.0 * np.tan(np.radians(20.0)) / size
    a, b = r / sun[1] / pixel, r / pixel
    # Eight bits of sRGB know a linear colour near 0.5 to 0.002, and the shadow is 0.35 darker than the light.
    assert abs(shadow.sum() - np.pi * a * b) < sampling_error(np.pi * (a + b), 16) + 0.006 * np.pi * a * b
    rows, columns = np.indices(shadow.shape) + 0.5 - size / 2.0
    middle = np.array([(columns * shadow).sum(), (rows * shadow).sum()]) / shadow.sum()
    assert np.abs(middle).max() < 0.1
    # Second moments are a²/4 and b²/4 along the axes; smoothing adds 2.5 px² to each, the variance of its weights.
    spread = np.stack([columns, rows]) - middle[:, None, None]
    moments = np.einsum("irc,jrc,rc->ij", spread, spread, shadow) / shadow.sum()
    expected = (np.array([b, a]) ** 2) / 4.0 + 2.5
    assert np.allclose(np.linalg.eigvalsh(moments), expected, rtol=0.01)
    along = np.linalg.eigh(moments)[1][:, 1]
    assert abs(along @ (sun[[0, 2]] / np.linalg.norm(sun[[0, 2]]))) > 0.999


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_a_patch_in_full_light_has_the_colour_of_the_map(device, up_axis):
    """Within one of 255, of which rounding to 8 bits is half."""
    scale, values = Scale(0.0, 1.0), np.linspace(0.0, 1.0, 7)
    camera = Camera.framed([SQUARE], 0.0, 20.0, up_axis, aspect=1.0)
    for contrast in (0.6, 1.0):
        caster = RayCaster([Shape(4, HALVES)], 32, 32, contrast=contrast, up_axis=up_axis, device=device)
        x, y, z = sun_axes(camera.sun(np.eye(3)["YZ".index(up_axis) + 1]))
        facing = SQUARE @ [x, y, z]
        for value in values:
            image = caster.image([facing], camera, [np.tile(scale.linear(value), (4, 1))])
            assert np.abs(image[14:18, 14:18] / 255.0 - scale.srgb(value)).max() < 1.01 / 255.0
        # What faces the viewer is darker, evenly in all channels
        view = np.subtract(camera.position, camera.target)
        facing = SQUARE @ sun_axes(view / np.linalg.norm(view))
        colour = np.array([0.5, 0.3, 0.7])
        light = linear(caster.image([facing], camera, [np.tile(colour, (4, 1))])[16, 16]) / colour
        assert 0.6 < light.mean() < 0.99 and np.ptp(light) < 0.015


def sun_axes(z):
    """Axes as rows, of which the third is given."""
    x = np.cross([0.3, 0.8, 0.5], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def light(normals, camera):
    """Light on planes with these unit normals (…, 3) that see the sun and the whole sky, over that of facing the sun."""
    # A sky, 15 % brighter from above than from the side, gives 42 % of the light there, the sun 58 %.
    up = np.array([0.0, 1.0, 0.0])
    sun = camera.sun(up)

    def of(n):
        return 0.42 * (1.0 + 0.15 * (n @ up - 1.0)) + 0.58 * np.maximum(n @ sun, 0.0)

    return of(np.asarray(normals)) / of(sun)


@pytest.mark.parametrize("elevation", [-60.0, 10.0, 60.0])
def test_a_plane_has_the_light_of_its_tilt(device, elevation):
    """From facing the sun to turned away from it, towards the ground or the sky, within one of 255."""
    camera, colour = Camera.framed([SQUARE], 0.0, elevation, aspect=1.0), 0.6
    view = np.subtract(camera.position, camera.target)
    caster = RayCaster([Shape(4, HALVES, colour=(colour,) * 3)], 16, 16, contrast=1.0, device=device)
    normals = np.random.default_rng(0).normal(size=(12, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = normals @ view / np.linalg.norm(view)
    normals = (normals * np.sign(across)[:, None])[np.abs(across) > 0.2]
    expected = light(normals, camera)
    found = [linear(caster.image([SQUARE @ sun_axes(n)], camera)[8, 8, 1]) / colour for n in normals]
    assert len(normals) > 6 and np.ptp(expected) > 0.3
    assert found == pytest.approx(expected, abs=0.01)  # 1/255 of sRGB, relative to a light of 0.4 or more


@pytest.mark.parametrize("elevation", [-20.0, 30.0])
def test_a_wall_on_a_tilted_plane_hides_its_part_of_the_sky(device, elevation):
    """Of rays with the density of cos θ about the normal, those that meet the wall within half the height of the picture."""
    # They have 0.3 of their light. The sun is behind the plane. Rays are even to one in 100.
    away, length, fov = 0.3, 10.0, 40.0
    view = np.array([0.0, np.sin(np.radians(elevation)), np.cos(np.radians(elevation))])
    camera = Camera(6.0 * view, (0.0, 0.0, 0.0), fov=fov)
    sun = camera.sun(np.eye(3)[1])
    # Seen aslant, from beside the wall, and turned away from the sun.
    n = view - 1.6 * (sun - (sun @ view) * view) / np.linalg.norm(sun - (sun @ view) * view)
    n /= np.linalg.norm(n)
    from_wall = view - (view @ n) * n
    from_wall /= np.linalg.norm(from_wall)
    along = np.cross(n, from_wall)
    assert n @ sun < 0.0 < n @ view
    edge = np.array([-length, length])[:, None] * along - away * from_wall
    points = np.concatenate([edge, edge[::-1] + length * from_wall, edge[::-1] + length * n])
    shape = Shape(6, [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 4, 5]], colour=(0.6,) * 3, back=(1.0,) * 3, smooth=False)
    caster = RayCaster([shape], 32, 32, 64, contrast=1.0, device=device)
    found = linear(caster.image([points], camera)[15:17, 15:17, 1]).mean() / 0.6
    u, turn = np.meshgrid((np.arange(400) + 0.5) / 400.0, (np.arange(400) + 0.5) / 400.0 * 2.0 * np.pi)
    towards_wall = np.sqrt(u) * np.cos(turn)  # of rays at sin²θ = u
    hidden = (towards_wall * 6.0 * np.tan(np.radians(0.5 * fov)) > away).mean()
    assert 0.3 < hidden < 0.5
    assert found == pytest.approx(light(n, camera) * (1.0 - 0.7 * hidden), abs=0.01)


@pytest.mark.parametrize("bend", [20.0, 90.0])
@pytest.mark.parametrize("smooth", [True, False])
def test_edges_that_bend_by_little_are_round_and_others_sharp(device, bend, smooth):
    """Of a roof. Its normals turn evenly from one half to the other if it bends by 20°, and are those of the halves at 90°."""
    half = np.radians(0.5 * bend)
    roof = np.array([[x, -abs(s) * np.sin(half), s * np.cos(half)] for s in (-1.0, 0.0, 1.0) for x in (-1.0, 1.0)])
    triangles = [[0, 3, 1], [0, 2, 3], [2, 5, 3], [2, 4, 5]]
    camera = Camera((0.0, 6.0, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0), fov=20.0)
    size, colour = 101, 0.6
    caster = RayCaster([Shape(6, triangles, colour=(colour,) * 3, smooth=smooth)], size, size, 1, contrast=1.0, device=device)
    found = linear(caster.image([roof], camera))[:, size // 2, 1] / colour
    s = np.linspace(-0.9, 0.9, 41)
    rows = 0.5 * size * (1.0 + s * np.cos(half) / (6.0 + np.abs(s) * np.sin(half)) / np.tan(np.radians(10.0)))
    sides = np.stack([0.0 * s, np.cos(half) + 0.0 * s, np.sign(s) * np.sin(half)], axis=1)
    middle = np.array([0.0, 1.0, 0.0])
    normals = (1.0 - np.abs(s))[:, None] * middle + np.abs(s)[:, None] * sides if smooth and bend < 70.0 else sides
    expected = light(normals / np.linalg.norm(normals, axis=1, keepdims=True), camera)
    seen = np.abs(s) > 0.05  # on either side of the ridge
    assert np.interp(rows[seen], np.arange(size) + 0.5, found) == pytest.approx(expected[seen], abs=0.015)


def test_both_sides_of_cloth_are_lit_alike_and_the_back_has_its_own_colour(device):
    camera = Camera.framed([SQUARE], aspect=1.0)
    shape = Shape(4, HALVES, colour=(0.2, 0.4, 0.6), back=(0.5, 1.0, 1.0))
    front, back = (
        linear(RayCaster([s], 32, 32, device=device).image([SQUARE], camera)[16, 16])
        for s in (shape, replace(shape, triangles=HALVES[:, ::-1]))
    )
    assert np.allclose(back / front, (0.5, 1.0, 1.0), atol=0.02)


def test_a_smooth_sphere_of_triangles_is_lit_as_an_exact_one(device):
    """The normals of an icosphere's vertices are the sphere's up to e², which is 2 % here: one or two of 255 at most."""
    points, triangles = icosphere(3)
    camera = Camera.framed([points], aspect=1.0)
    colour, size = (0.4, 0.5, 0.6), 96

    def lit(shape, x):
        return RayCaster([shape], size, size, device=device).image([x], camera).astype(int)

    exact = lit(Shape(1, lines=BALL, radius=1.0, colour=colour), np.zeros((1, 3)))
    rows, columns = np.indices((size, size)) + 0.5 - size / 2.0
    inside = np.hypot(rows, columns) < 0.38 * size  # where the edge is not in the pixel
    off = {smooth: np.abs(lit(Shape(len(points), triangles, colour=colour, smooth=smooth), points) - exact)[inside].max()
           for smooth in (True, False)}  # fmt: skip
    assert off[True] <= 2 and off[False] > 4
    # Triangles that are wound either way are lit no worse.
    turned = triangles.copy()
    turned[::3] = turned[::3, ::-1]
    shape = Shape(len(points), turned, colour=colour, back=WHITE)
    assert np.abs(lit(shape, points) - exact)[inside].max() <= 2


def scene(up_axis="Y"):
    """Points, shape and ground of a bent cloth with a ball and a tube."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 12), np.linspace(-1.0, 1.0, 12), indexing="ij")
    points = np.stack([u, 0.4 * np.cos(3.0 * u) + 0.3 * v, v], axis=-1).reshape(-1, 3)
    k = np.arange(132).reshape(11, 12)[:, :11].ravel()
    triangles = np.concatenate([np.stack([k, k + 1, k + 13], axis=1), np.stack([k, k + 13, k + 12], axis=1)])
    if up_axis == "Z":
        points = points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    return points, Shape(144, triangles, [[0, 143]], 0.03, [5], 0.1)


def scaled(points, shape, factor):
    return points * factor, replace(shape, radius=shape.radius * factor, ball_radius=shape.ball_radius * factor)


def picture(device, points, shape, ground=-0.8, up_axis="Y", samples=2, **options):
    camera = Camera.framed([points], up_axis=up_axis, aspect=1.5)
    return RayCaster([shape], 90, 60, samples, ground, device, up_axis, **options).image([points], camera)


def differ(one, other, by=2):
    """Share of pixels that are not nearly the same."""
    return (np.abs(one.astype(int) - other).max(axis=2) > by).mean()


def test_the_same_picture_has_the_same_bytes(device):
    points, shape = scene()
    first = picture(device, points, shape)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    assert (picture(device, points, shape) == first).all()
    camera = Camera.framed([points], aspect=1.5)
    caster = RayCaster([shape], 90, 60, 2, -0.8, device)
    caster.image([points[::-1]], camera)
    found = caster.image([points], camera)
    assert (found == first).all()
    caster.image([points[::-1]], camera)
    assert (found == first).all()  # which the next one has not written over
    if device == "cpu":
        assert (picture(device, points, shape, threads=1) == picture(device, points, shape, threads=2)).all()


def test_a_few_samples_show_what_many_do(device):
    """To 3.5 of 255 (rms), edges included; by 5.8 if they are not smoothed."""
    points, shape = scene()
    few, many = (picture(device, points, shape, samples=n, sun_angle=20.0).astype(float) for n in (4, 64))
    assert np.sqrt(((few - many) ** 2).mean()) < 4.5


@pytest.mark.parametrize("factor", [2.0**20, 2.0**-20, 1e6, 1e-6, 1e30, 1e-30])
def test_size_does_not_matter(device, factor):
    """By a power of two no number changes but its exponent; otherwise rounding moves rays that pass an edge."""
    points, shape = scene()
    found = picture(device, *scaled(points, shape, factor), ground=-0.8 * factor)
    assert differ(found, picture(device, points, shape)) <= (0.0 if np.log2(factor).is_integer() else 0.005)


def test_position_and_the_vertical_axis_do_not_matter(device):
    points, shape = scene()
    reference = picture(device, points, shape)
    far = np.array([1e5, 1e5, -1e5])
    assert differ(picture(device, points + far, shape, ground=1e5 - 0.8), reference) < 0.005
    # Rays about a normal begin at another side of it.
    assert differ(picture(device, *scene("Z"), up_axis="Z"), reference, by=12) < 0.005


@pytest.mark.parametrize("extent", [1.0, 1e4])
@pytest.mark.parametrize("samples", [1, 3, 64])
def test_a_flat_surface_does_not_hide_itself(device, extent, samples):
    """However large its triangles are, and so their rounding: it is lit as evenly as it is flat."""
    sheet = SQUARE[:, [0, 2, 1]] * [1.3 * extent, 1.0, extent] + [0.0, 0.3, 0.0]
    tilted = sheet @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    camera = Camera((0.1, 2.0, 0.4), (0.2, 0.4, 0.1), fov=10.0)
    image = RayCaster([Shape(4, HALVES)], 48, 32, samples, device=device).image([tilted], camera)
    assert np.ptp(image.reshape(-1, 3), axis=0).max() <= 1


def test_what_has_a_point_that_is_not_finite_is_left_out_and_counted(device):
    points, shape = scene()
    without = replace(
        shape, count=145, triangles=[*shape.triangles, (0, 1, 144)], lines=[*shape.lines, (0, 144)], balls=[5, 144]
    )
    reference = picture(device, points, shape)
    camera = Camera.framed([points], aspect=1.5)
    caster = RayCaster([without], 90, 60, 2, -0.8, device)
    for bad in (np.nan, np.inf, -1e300):
        found = caster.image([np.vstack([points, [[bad, 0.0, 0.0]]])], camera)
        assert caster.left_out == 3 and (found == reference).all()
    assert (
        caster.image([np.full((145, 3), np.nan)], camera).shape == (60, 90, 3) and caster.left_out == len(without.triangles) + 4
    )


@pytest.mark.parametrize(
    "shape",
    [
        Shape(1),
        Shape(0),
        Shape(3, [[0, 1, 2], [0, 0, 1], [2, 2, 2]]),
        Shape(3, lines=[[0, 0]], radius=1e-9),
        Shape(3, [[0, 1, 2]], [[0, 1]], 0.1, [2], 0.1),
    ],
    ids=["a vertex", "nothing", "flat triangles", "a thin tube", "all at one point"],
)
def test_what_has_no_area_makes_a_picture(device, shape):
    """A picture of nothing is the background; points all in one position have a camera of some size."""
    points = np.outer(np.arange(shape.count) if not len(shape.balls) else np.zeros(shape.count), [1.0, 2.0, 3.0])
    camera = Camera.framed([points] if shape.count else [[[0.0, 0.0, 0.0]]])
    image = RayCaster([shape], 32, 24, device=device).image([points], camera)
    assert (len(np.unique(image.reshape(-1, 3), axis=0)) == 1) == (not len(shape.balls))


def test_the_ground_hides_what_is_below_it_and_is_not_seen_from_below(device):
    below, shape = np.array([[0.0, -0.2, 0.0]]), Shape(1, balls=[0], ball_radius=0.1)
    for elevation in (30.0, -30.0):
        camera = Camera.framed([SQUARE], elevation=elevation)
        caster = RayCaster([shape], 32, 24, ground=0.0, device=device)
        with_ball, without = (caster.image([p], camera) for p in (below, [[np.nan, 0.0, 0.0]]))
        assert (differ(with_ball, without) > 0.0) == (elevation < 0.0)


def test_a_camera_may_be_inside(device):
    """All around it is the back of a sphere."""
    points, triangles = icosphere(2)
    for shape, x in ((Shape(len(points), triangles), points), (Shape(1, lines=BALL, radius=1.0), np.zeros((1, 3)))):
        image = RayCaster([shape], 32, 24, background=BLACK, device=device).image([x], Camera((0.1, 0.0, 0.2), (0.3, 0.1, 1.0)))
        assert (image.max() > 0) == (len(shape.triangles) > 0)  # from inside a tube is not seen


@pytest.mark.parametrize(("azimuth", "elevation", "up_axis"), [(-38.0, 24.0, "Y"), (100.0, -50.0, "Z"), (0.0, 90.0, "Y")])
def test_a_framed_camera_sees_all_of_a_motion_and_no_more(azimuth, elevation, up_axis):
    frames = np.random.default_rng(3).normal(size=(4, 50, 3)) * [3.0, 1.0, 0.5]
    frames[2, 7] = np.nan
    camera = Camera.framed(frames, azimuth, elevation, up_axis, aspect=1.5, fov=50.0, margin=0.1)
    x = np.concatenate(frames) - camera.position
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    tangent = np.tan(np.radians(25.0))
    seen = np.stack([x @ right / 1.5, x @ np.cross(right, forward)]) / (x @ forward) / tangent
    assert abs(np.nanmax(np.abs(seen)) - 0.8) < 1e-9 and abs(np.nanmax(seen, axis=1) + np.nanmin(seen, axis=1)).min() < 1e-9


def drawn(shape, *points, colours=None):
    return RayCaster([shape], 4, 4).image(points, Camera((0, 0, 1), (0, 0, 0)), colours)


COLOURS = r"colours\[0\] has shape \(3, 3\); it must be \(4, 3\) of vertices, \(2, 3, 3\) of corners"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Camera((0, 0, 1), (0, 0, 1)), "target is .*the camera must look somewhere"),
        (lambda: Camera((0, 1, 0), (0, 0, 0)), "up is .*along the view"),
        (lambda: Camera((0, 0, 1), (0, 0, 0), fov=180), "fov is 180; it must be below 180"),
        (lambda: Camera((0, np.nan, 1), (0, 0, 0)), r"position\[1\] is nan"),
        (lambda: Camera.framed([np.full((2, 3), np.nan)]), "no point of the frames is finite"),
        (lambda: Camera.framed([SQUARE], margin=0.5), "margin 0.5; they must be below"),
        (lambda: Shape(3, HALVES), "triangles refers to vertices 0 to 3; there are 3"),
        (lambda: Shape(4, SQUARE), r"triangles has shape \(4, 3\) and type float64; it must be \(k, 3\), whole numbers"),
        (lambda: Shape(4, lines=[[0, 1]]), "radius is 0.0; it must be a number above 0"),
        (lambda: Shape(4, balls=[0], ball_radius=-1.0), "ball_radius is -1.0; it must be a number above 0"),
        (lambda: RayCaster([], 0, 4), "width is 0; it must be a whole number of 1 or more"),
        (lambda: RayCaster([], 4, 4, samples=0), "samples is 0"),
        (lambda: RayCaster([], 4, 4, ground=np.inf), "ground is inf"),
        (lambda: RayCaster([], 4, 4, contrast=2.0), "contrast is 2.0; it must be a number from 0 to 1"),
        (lambda: drawn(Shape(4)), "points has 0 arrays; there are 1 shapes"),
        (lambda: drawn(Shape(4), SQUARE[:3]), r"points\[0\] has shape \(3, 3\); it must be \(4, 3\)"),
        (lambda: drawn(Shape(4, HALVES), SQUARE, colours=[np.ones((3, 3))]), COLOURS),
        (
            lambda: drawn(Shape(4, HALVES), SQUARE, colours=[np.full((4, 3), np.nan)]),
            r"colours\[0\]\[0, 0\] is nan; it must be finite",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
