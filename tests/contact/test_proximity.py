"""The pairs of vertices and triangles and of edges that are near one another, against all pairs in NumPy."""

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.pairs import all_pairs, detect, pieces
from support.rows import table
from warpcloth.contact.proximity import Proximity
from warpcloth.contact.surface import ContactSurface
from warpcloth.model.model import Model


def proximity(mesh, distance, skin, device, **options):
    pins = mesh.isolated if len(mesh.isolated) else None
    model = Model(wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)], pins=pins), device=device, **options)
    return model, Proximity(ContactSurface(model), distance, skin)


def rows(stencils):
    return {tuple(row) for row in stencils.tolist()}


def check(mesh, x, distance, skin, dtype="float32", device="cpu", **options):
    """That a model finds the pairs of ``x`` and no others, in order, but those at the limit to rounding; how many there are."""
    model, found = proximity(mesh, distance, skin, device, dtype=dtype, **options)
    x, n = x.astype(model.numpy_dtype).astype(np.float64), len(x)
    order = np.arange(n) if model.order is None else model.order
    rounding = 64 * np.finfo(model.numpy_dtype).eps * (np.abs(x).max() + np.ptp(mesh.points, axis=0).max())
    piece, counts = pieces(mesh), []
    kinds = detect(found, np.tile(x[order], (model.copies, 1)))
    of_vertices = np.repeat(np.arange(model.count), np.diff(found.rows.numpy()[: model.count + 1]))
    np.testing.assert_array_equal(kinds[0][:, 0], of_vertices)
    lists = zip(kinds, np.split(found.distances.numpy()[: sum(map(len, kinds))], [len(kinds[0])]), strict=True)
    for (stencils, distances), (s, now, rest) in zip(lists, all_pairs(mesh, x), strict=True):
        cutoff = np.where(piece[s[:, 0]] == piece[s[:, 3]], np.minimum(distance, rest / 2), distance)
        gap, count = now - cutoff - skin, len(stencils) // model.copies
        copies = np.arange(model.copies)[:, None, None] * n
        np.testing.assert_array_equal(stencils, (stencils[:count] + copies).reshape(-1, 4))
        weights = float(n) ** np.arange(4)  # of a stencil, as one number
        have, want = order[stencils[:count]] @ weights, s @ weights
        index = np.argsort(want)
        index = index[np.searchsorted(want, have, sorter=index).clip(max=max(len(want) - 1, 0))]
        np.testing.assert_array_equal(want[index], have)
        assert (gap[index] < rounding).all() and np.isin(np.flatnonzero(gap < -rounding), index).all()
        np.testing.assert_allclose(distances, np.tile(cutoff[index], model.copies), rtol=1e-5, atol=rounding)
        if model.order is None:
            assert (np.diff(index) > 0).all()
        counts.append(count)
    return counts


def lists_of(found):
    """The arrays of a detection, on the host, as far as they have pairs."""
    numbers, count = [each.numpy().copy() for each in (found.counts, found.rows)], found.counts.numpy().sum()
    return numbers + [each.numpy()[:count].copy() for each in (found.stencils, found.distances)]


def assert_same(lists, others):
    for one, other in zip(lists, others, strict=True):
        assert one.tobytes() == other.tobytes()


def folded(mesh, rng, gap, times=3):
    """The points of a mesh, folded over random lines at a gap, and shaken by half of it."""
    x = mesh.points.copy()
    for _ in range(times):
        angle = rng.uniform(0, np.pi)
        along, middle = np.array([np.cos(angle), 0, np.sin(angle)]), x[rng.integers(len(x))]
        side = (x - middle) @ along
        over = side > 0
        x[over] -= 2 * side[over, None] * along
        x[over, 1] += gap
    return x + rng.uniform(-0.5, 0.5, x.shape) * gap


def scaled(mesh, scale):
    return wc.Mesh(mesh.points * scale, triangles=mesh.triangles)


GRID = wc.Mesh.grid(9, 11, pattern="alternating")
STRIPS = wc.Mesh.grid(3, 60, size=(1.0, 0.03))  # whose triangles are 1000 times as long as wide
LAYERS = wc.Mesh.join({"low": GRID, "high": wc.Mesh(GRID.points + np.array([0.013, 0.005, 0.02]), triangles=GRID.triangles)})
SMALL = wc.Mesh.grid(5, 6, size=0.3)
SHEETS = wc.Mesh.join({"one": SMALL, "other": SMALL})
UNEVEN = wc.Mesh(np.sign(GRID.points - 0.5) * np.abs(GRID.points - 0.5) ** 4 * 8 + 0.5, triangles=GRID.triangles)
# Meshes, and the gaps and options with which they are folded.
FOLDED = {
    "grid": (GRID, 0.02, {}),
    "copies": (GRID, 0.02, {"copies": 3}),
    "order": (GRID, 0.02, {"order": np.random.default_rng(0).permutation(99)}),
    "pieces": (LAYERS, 0.02, {}),
    "needles": (STRIPS, 0.02, {}),
    "uneven": (UNEVEN, 0.02, {}),
    "huge": (scaled(GRID, 1e6), 2e4, {}),
    "tiny": (scaled(GRID, 1e-6), 2e-8, {}),
    "all of one cell": (GRID, 5.0, {}),
}


@table("dtype", ["float32"], ["float32", "float64"])
@table("name", [name for name in FOLDED if name not in ("pieces", "needles")], FOLDED)
def test_the_pairs_are_those_among_all_pairs(name, dtype, device):
    """Of cloth at rest, folded, turned and far from the origin, and that has shrunk to a point, or was blown up."""
    mesh, gap, options = FOLDED[name]
    rng = np.random.default_rng(3)
    turn, x = np.linalg.qr(rng.normal(size=(3, 3)))[0], folded(mesh, rng, gap)
    far = x @ turn + 20.0 * np.ptp(mesh.points, axis=0).max()
    for points in (x, far):
        assert min(check(mesh, points, gap, gap / 2, dtype, device, **options)) > 20
    check(mesh, mesh.points, gap, gap / 2, dtype, device, **options)
    if options == {} and gap == 0.02:
        check(mesh, np.zeros_like(x), gap, gap / 2, dtype, device)
        check(mesh, 30.0 * x, gap, gap / 2, dtype, device)
        x[5] += 1e5
        check(mesh, x, gap, gap / 2, dtype, device)


def test_chains_have_pairs_of_edges_alone(device):
    """A chain that turns back on itself, and a second beside it; vertices of no edge take no part."""
    rng, chain = np.random.default_rng(0), wc.Mesh.chain(40)
    mesh = wc.Mesh.join({"one": chain, "other": wc.Mesh(chain.points + 0.005, edges=chain.edges)})
    x = np.cumsum(rng.uniform(-0.02, 0.02, mesh.points.shape), axis=0)
    counts = check(mesh, x, 0.01, 0.005, device=device)
    assert counts[0] == 0 and counts[1] > 20
    alone = wc.Mesh(np.concatenate([GRID.points, GRID.points[:5] + 0.001]), triangles=GRID.triangles)
    x = np.concatenate([folded(GRID, rng, 0.02), alone.points[-5:]])
    assert check(alone, x, 0.02, 0.01, device=device) == check(GRID, x[:-5], 0.02, 0.01, device=device)


def test_lists_grow_and_repeat_their_bits(device):
    """A list that is too long is known, its part within the capacity has pairs alone, and ten replays give the same lists."""
    mesh = wc.Mesh.grid(16, 16)
    model, found = proximity(mesh, 0.1, 0.05, device, copies=2)
    points = folded(mesh, np.random.default_rng(0), 0.01)
    x = model.array(np.tile(points, (2, 1)), model.vec3)
    found.launch(x)
    assert found.overflowed and found.counts.numpy().sum() > 2 * found.capacity
    counts, _, full, _ = lists_of(found)
    found.grow()
    with wp.ScopedCapture(device=device) as capture:
        found.launch(x)
    lists = []
    for _ in range(10):
        wp.capture_launch(capture.graph)
        lists.append(lists_of(found))
        assert_same(lists[0], lists[-1])
    assert not found.overflowed and (lists[0][0] == counts).all() and rows(full) <= rows(lists[0][2])


def test_lists_do_not_depend_on_the_threads_of_an_element(device):
    """To the bit with one, as on the CPU, and with eight, as on CUDA, of copies and of several pieces."""
    lists, points = [], np.tile(folded(SHEETS, np.random.default_rng(3), 0.02), (2, 1))
    for shares in (1, 8):
        _, found = proximity(SHEETS, 0.02, 0.01, device, copies=2)
        found._shares = shares
        assert sum(map(len, detect(found, points))) > 80
        lists.append(lists_of(found))
    assert_same(*lists)


@pytest.mark.parametrize("mesh", [UNEVEN, wc.Mesh.chain(40)], ids=["triangles", "edges"])
def test_lists_of_what_has_moved_are_those_of_all(mesh, device):
    """To the bit, of copies in which few or all vertices move; of a list that has too little room the number is right."""
    rng, skin = np.random.default_rng(5), 0.03
    model, found = proximity(mesh, 0.02, skin, device, copies=2)
    other, lost = (Proximity(ContactSurface(model), 0.02, skin) for _ in range(2))
    x = np.concatenate([folded(mesh, rng, 0.02) + each * np.array([0.0, 1.0, 0.0]) for each in (0.0, 2.0)])
    detect(found, x)
    detect(lost, x)
    for moving in (0.05, 0.1, 1.0, 0.0, 0.1):
        x += rng.uniform(-1.0, 1.0, 3) + 0.5 * skin * (rng.random((len(x), 1)) < moving) * rng.uniform(-1.0, 1.0, x.shape)
        positions = model.array(x, model.vec3)
        lost.listed.fill_(np.nan)  # as in a run that is resumed
        for each in (found, lost):
            each.moved(positions, 0.25)
            each.launch_moved(positions)
            if each.overflowed:
                each.grow()
                each.launch(each.found)
        assert (found.found.numpy() == lost.found.numpy()).all()
        detect(other, found.found.numpy())
        assert_same(lists_of(found), lists_of(other))
        assert other.counts.numpy().sum() > 20 and not found.moved(positions, 0.25).numpy()[0]


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
def test_coordinates_that_are_lost_give_no_pairs(value, device):
    """And keep no other pair away; an edge that ends farther than any distance is still near at its other end."""
    model, found = proximity(GRID, 0.02, 0.01, device)
    points = folded(GRID, np.random.default_rng(3), 0.02)
    before = rows(np.concatenate(detect(found, points)))
    assert not found.moved(model.array(points, model.vec3)).numpy()[0]
    points[50, 1] = value
    assert found.moved(model.array(points, model.vec3)).numpy()[0]
    after = rows(np.concatenate(detect(found, points)))
    of_others = {row for row in before if 50 not in row}
    assert {row for row in after if 50 not in row} == of_others and len(of_others) < len(before)
    assert np.isfinite(value) or after == of_others


def test_no_pair_is_missing_while_nothing_has_moved(device):
    """Sheets that fall together, or far from one another, need no detection; others need one before a pair is missing."""
    rng, distance, skin = np.random.default_rng(1), 0.02, 0.03
    model, found = proximity(SHEETS, distance, skin, device, dtype="float64")
    one, flags, up = len(SMALL.points), [], np.array([0.0, 1.0, 0.0])

    def moved(y, part=0.5):
        return bool(found.moved(model.array(y, model.vec3), part).numpy()[0])

    for trial in range(40):
        x = np.concatenate([folded(SMALL, rng, 0.02), folded(SMALL, rng, 0.02) + 0.1 * (trial % 2) * up])
        listed = [rows(stencils) for stencils in detect(found, x)]
        assert not moved(x + rng.uniform(-100.0, 100.0, 3))  # float64 keeps the differences
        y = x + rng.uniform(-5.0, 5.0, 3) + rng.uniform(-0.1, 0.1, x.shape) * skin
        y[one:] += rng.uniform(-1.0, 1.0, 3) * skin
        flags.append(moved(y))
        if not flags[-1]:
            for (s, now, rest), have in zip(all_pairs(SHEETS, y), listed, strict=True):
                same = (s[:, 0] < one) == (s[:, 3] < one)
                near = now < np.where(same, np.minimum(distance, rest / 2), distance)
                assert rows(s[near]) <= have and near.any()
    assert 5 < sum(flags) < 35
    x[one:] += 3.0 * up
    found.launch(model.array(x, model.vec3))
    for rise, far in ((-2.0, False), (-1.15, True), (1.15, False)):
        x[one:] += rise * up
        assert moved(x) == far
    x[3, 0] += 0.4 * skin
    assert not moved(x) and moved(x, 0.25)
    x[3, 0] += 0.2 * skin
    assert moved(x)
    model, found = proximity(SHEETS, distance, skin, device, copies=2)
    both = np.concatenate([x, x])
    found.launch(model.array(both, model.vec3))
    both[len(x) :] += 5.0 * up
    assert not moved(both)
    both[-1, 0] += 0.6 * skin
    assert moved(both)


# Moves of sheet 0, of sheet 1, and of one vertex of each beside them, in metres along y, and the part that a copy may make.
APPROACH, COMMON = 0.3, (3.0, -2.0, 1.0)
MOVES = {
    "sheets approach": (0.0, -APPROACH, None),
    "sheets approach in common motion": (0.0, -APPROACH, COMMON),
    "one vertex moves": ((4, APPROACH), 0.0, None),
    "another vertex moves in common motion": (0.0, (4, -APPROACH), COMMON),
    "one vertex and a sheet approach": ((4, 0.5 * APPROACH), -0.5 * APPROACH, None),
    "two vertices meet": ((4, 0.5 * APPROACH), (4, -0.5 * APPROACH), None),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", MOVES)
def test_moves_stop_at_pairs_that_were_far_apart(name, dtype, device):
    """Two sheets of 3 × 3 vertices, 0.2 m apart, keep a tenth; another sheet, and a copy without moves, change nothing."""
    # The first is smaller and below the inside of a triangle of the second, so that no edges cross.
    gap, few = 0.2, wc.Mesh.grid(3, 3, size=0.02)
    starts, scales = np.array([[0.004, 0.0, 0.001], [0.0, gap, 0.0], [5.0, 0.0, 0.0]]), np.array([0.1, 1.0, 1.0])
    points = few.points * scales[:, None, None] + starts[:, None]
    mesh = wc.Mesh(points.reshape(-1, 3), np.concatenate([few.triangles + 9 * k for k in range(3)]))
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)], self_contact=wc.SelfContact(distance=1e-3))
    *moves, common = MOVES[name]
    p = np.zeros((27, 3))
    for k, move in enumerate(moves):
        at, height = (9 * k + move[0], move[1]) if isinstance(move, tuple) else (slice(9 * k, 9 * k + 9), move)
        p[at, 1] += height
    p[:18] += common or 0.0
    stepper = wc.Newton().bind(scene.build(copies=2, dtype=dtype, device=device))
    model, pairs = stepper.model, stepper.pairs
    order = np.arange(27) if model.order is None else model.order
    pairs.launch_begin(stepper.state.x)
    direction = model.array(np.concatenate([0.0 * p, p[order]]), model.vec3)
    pairs.filter.launch_limit(direction)
    # To rounding of the positions and of the gap.
    bound = 64 * np.finfo(model.numpy_dtype).eps * (np.abs(mesh.points).max() + np.abs(p).max()) / APPROACH + 2e-6 / gap
    np.testing.assert_allclose(pairs.filter.fraction.numpy(), [1.0, 0.9 * gap / APPROACH], rtol=0, atol=bound)


def fraction_of(scene, p, device, dtype="float64"):
    """The fraction of moves p (N, 3) [m], in the order of the scene, that its only copy may make from its start."""
    stepper = wc.Newton().bind(scene.build(dtype=dtype, device=device))
    model, pairs = stepper.model, stepper.pairs
    pairs.launch_begin(stepper.state.x)
    pairs.filter.launch_limit(model.array(p if model.order is None else p[model.order], model.vec3))
    return pairs.filter.fraction.numpy()[0]


TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.02]])


@pytest.mark.parametrize("stretch", [100.0, 150.0])
def test_moves_stop_at_triangles_whose_vertices_are_far_away(stretch, device):
    """A triangle that is stretched, with one below its middle. A sheet far away is there for the size of the hash table."""
    sheet, middle = wc.Mesh.grid(30, 30, size=0.58), TRIANGLE.mean(axis=0)
    points = np.concatenate([TRIANGLE, TRIANGLE + np.array([0.1, 0.0, 0.0]), sheet.points + np.array([1.0, 0.0, 0.0])])
    mesh = wc.Mesh(points, np.concatenate([[[0, 1, 2], [3, 4, 5]], sheet.triangles + 6]))
    below = TRIANGLE + (stretch - 1.0) * middle - [0.0, 0.02, 0.0]
    x = np.concatenate([stretch * TRIANGLE, below, 0.02 * sheet.points + [0.5, 2.0, 0.5]])
    settings = {"density": 0.1, "terms": [wc.Spring(stiffness=1.0)], "self_contact": wc.SelfContact(distance=1e-3)}
    p = np.zeros_like(points)
    p[3:6, 1] = 0.06
    assert fraction_of(wc.Scene(mesh, positions=x, **settings), p, device) == pytest.approx(0.3, abs=1e-4)


def test_moves_of_cloth_alone_stop_at_a_vertex_of_a_mesh(device):
    """A sheet falls by 0.6 m onto the tip of a needle, 0.3 m below the inside of a triangle, which keeps a tenth of this."""
    sheet = wc.Mesh.grid(5, 5, size=0.1)
    tip = sheet.points[sheet.triangles[12]].mean(axis=0) - [0.0, 0.3, 0.0]
    points = tip + 1e-3 * np.array([[0.0, 0.0, 0.0], [1.0, -300.0, 0.0], [-1.0, -300.0, 1.0], [0.0, -300.0, -1.0]])
    needle = wc.MeshCollider(points, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 2, 3]])
    settings = {"density": 0.1, "terms": [wc.Spring(stiffness=1.0)], "self_contact": wc.SelfContact(distance=1e-3)}
    scene = wc.Scene(sheet, contact=wc.Contact(distance=1e-3), colliders=[needle], **settings)
    p = np.tile([0.0, -0.6, 0.0], (25, 1))
    assert fraction_of(scene, p, device) == pytest.approx(0.45, abs=1e-5)
