"""The potential of self-contact: its energy against sums in NumPy, its gradient on paths, and the pressure of flat sheets."""

from itertools import pairwise

import numpy as np
import pytest

import warpcloth as wc
from support.layers import begin, energy, gradient, pairs_of, stack
from support.pairs import all_pairs, from_segment, pieces
from support.rows import slow_but

STIFFNESS = 1e4


def crumpled(size, n=7, ridges=0.3, seed=0):
    """Two sheets of n² vertices, 1 m apart at rest, and where they are above one another, both with ridges and valleys."""
    rng, mesh = np.random.default_rng(seed), stack(2, n, size * (n - 1), gap=1.0, turn=0.4, pattern="alternating")
    points = mesh.points + 0.5 * size * (n - 1) * np.array([1.0, 0.0, 1.0])
    points[:, 1] = ridges * size * np.sin(2.5 / size * points[:, 0]) * np.cos(1.8 / size * points[:, 2])
    return mesh, points + rng.uniform(-0.05, 0.05, points.shape) * size


class Potential:
    """U and ∂U/∂x of the self-contact of a mesh at positions (N, 3)."""

    def __init__(self, mesh, distance, device, bounded=False):
        contact = wc.SelfContact(distance=distance, stiffness=STIFFNESS)
        scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0)], gravity=np.zeros(3), self_contact=contact)
        self.steps = pairs_of(scene, device, bounded)
        self.steps.contact.least = 0.0

    def energy(self, x):
        begin(self.steps, x)
        return energy(self.steps, x)

    def gradient(self, x):
        begin(self.steps, x)
        return gradient(self.steps, x)

    def multiplicities(self):
        """Of the contacts of vertices at the last positions, m."""
        found, (faces, _) = self.steps.contact, self.steps.proximity.counts.numpy()
        acting = found.pairs.acting.numpy()[: found.pairs.number.numpy()[0]]
        acting = acting[(acting < faces) | (acting >= found.capacity // 2)]
        areas = self.steps.model.scene.mesh.vertex_areas[found.pairs.stencils.numpy()[acting, 0]]
        return found.data.stiffness.numpy()[acting] / (0.5 * STIFFNESS * areas)


def phi(d, r):
    """φ [m²] at gaps d."""
    far, near = 0.5 * np.maximum(r - d, 0.0) ** 2, 0.25 * r * r * (0.5 + np.log(0.5 * r / np.minimum(d, r)))
    return np.where(d < 0.5 * r, near, far)


def least(f, turns=60):
    """The least values over [0, 1] of convex functions f(t) → (m,) at t (m,), by thirds."""
    low, high = 0.0, 1.0
    for _ in range(turns):
        one, other = low + (high - low) / 3.0, high - (high - low) / 3.0
        falls = f(one) > f(other)
        low, high = np.where(falls, one, low), np.where(falls, high, other)
    return np.min([f(0.5 * (low + high)), f(0.0), f(1.0)], axis=0)


def of_two_edges(a, b, c, d):
    """D = min over s and t of ‖y‖ √(1 + ⅛((2s − 1)² + (2t − 1)²))."""

    def square(s, t):
        s, t = np.broadcast_to(s, len(a))[:, None], np.broadcast_to(t, len(a))[:, None]
        y = a + s * (b - a) - c - t * (d - c)
        return (y * y).sum(axis=1) * (1.0 + 0.125 * ((2.0 * s - 1.0) ** 2 + (2.0 * t - 1.0) ** 2))[:, 0]

    return np.sqrt(least(lambda s: least(lambda t: square(s, t))))


def energies(mesh, x, r):
    """U of vertices and of pairs of edges [J]: plain sums over all faces, edges and vertices, without their cancellation."""
    area, (of_faces, of_edges) = mesh.vertex_areas, all_pairs(mesh, x)
    piece, total = pieces(mesh), 0.0
    at_edges, at_vertices = {}, {}  # the numbers of faces at each edge, and of faces minus edges at each vertex
    s, now, rest = of_faces
    acts = (piece[s[:, 0]] != piece[s[:, 1]]) | (rest >= 2.0 * r)
    for (v, *face), d in zip(s[acts], now[acts], strict=True):
        total += area[v] * phi(d, r)
        for p, q in ((0, 1), (1, 2), (2, 0)):
            key = v, *sorted((face[p], face[q]))
            at_edges[key] = at_edges.get(key, 0) + 1
            at_vertices[v, face[p]] = at_vertices.get((v, face[p]), 0) + 1
    for (v, p, q), count in at_edges.items():
        total += area[v] * (1 - count) * phi(from_segment(x[v], x[p], x[q]), r)
        for end in (p, q):
            at_vertices[v, end] -= 1
    for (v, p), more in at_vertices.items():
        total += area[v] * (1 + more) * phi(np.linalg.norm(x[v] - x[p]), r)
    s, now, rest = of_edges
    s = s[((piece[s[:, 0]] != piece[s[:, 2]]) | (rest >= 2.0 * r)) & (now < 0.25 * r)]
    share = area / np.bincount(mesh.edges.ravel(), minlength=len(x))
    b, b_other = (
        share[ends].sum(axis=1) / np.linalg.norm(mesh.points[ends[:, 1]] - mesh.points[ends[:, 0]], axis=1)
        for ends in (s[:, :2], s[:, 2:])
    )
    D = of_two_edges(*(x[s[:, i]] for i in range(4)))
    return 0.5 * STIFFNESS * total, 0.5 * np.pi * STIFFNESS * (b * b_other * phi(4.0 * D, r)).sum()


# r over the size of edges, and the gap over r: of folds that are sharp and blunt for r, with negative multiplicities.
CRUMPLED = [(0.1, 0.15), (0.5, 0.4), (1.0, 0.4), (3.0, 0.15)]
R = 0.02


def pair_of(ratio, gap):
    """:func:`crumpled` sheets whose upper one is raised by about ``gap``."""
    mesh, x = crumpled(R / ratio, n=6, seed=int(10 * gap))
    x[len(x) // 2 :, 1] += gap * R * (1.0 if ratio < 1.0 else 2.0)
    return mesh, x


@pytest.mark.parametrize(("ratio", "gap"), CRUMPLED)
def test_energy_is_the_sum(ratio, gap, device):
    """Over all faces minus edges plus vertices without cancellation, and over all pairs of edges: to rounding."""
    mesh, x = pair_of(ratio, gap)
    potential = Potential(mesh, R, device)
    found, m = potential.energy(x), potential.multiplicities()
    assert (m < 0.0).sum() > 1 and (m > 0.0).sum() > 10 and m == pytest.approx(np.round(m), rel=1e-12)
    of_faces, of_edges = energies(mesh, x, R)
    assert of_faces > 0.0 and (of_edges > 0.0 or ratio >= 1.0)
    assert found == pytest.approx(of_faces + of_edges, rel=1e-11)


@pytest.mark.parametrize("pages", [1, 2])
def test_energy_of_a_book(pages, device):
    """As above, where an edge of the lower sheet has more than two faces: pages hang from a row of its vertices."""
    mesh, x = pair_of(1.0, 0.4)
    row, triangles, points, places = np.arange(6) + 12, [mesh.triangles], [mesh.points], [x]
    for page in range(pages):
        new = len(x) + 6 * page + np.arange(6)
        triangles += [np.column_stack([row[:-1], row[1:], new[:-1]]), np.column_stack([row[1:], new[1:], new[:-1]])]
        down = R * np.array([0.0, -1.0, 0.5 - page])
        points.append(mesh.points[row] + down)
        places.append(x[row] + down)
    mesh, x = wc.Mesh(np.concatenate(points), np.concatenate(triangles)), np.concatenate(places)
    potential = Potential(mesh, R, device)
    assert potential.energy(x) == pytest.approx(sum(energies(mesh, x, R)), rel=1e-11)
    assert potential.multiplicities().min() == pytest.approx(-2.0)


def test_sheets_that_part_have_no_force(device):
    """Also where kernels gather by vertex: with an empty list they must not go on with the last contacts."""
    mesh, x = pair_of(0.1, 0.15)
    potential = Potential(mesh, R, device)
    potential.steps.contact.list_corners()
    potential.steps.contact.set_sums(scatters=False)
    assert np.abs(potential.gradient(x)).max() > 0.0
    far = mesh.points + np.where(np.arange(len(x)) < len(x) // 2, 0.0, 1.0)[:, None]  # flat, so that no neighbours are listed
    assert (potential.gradient(far) == 0.0).all() and potential.steps.proximity.counts.numpy().sum() == 0


@pytest.mark.parametrize(("ratio", "gap"), CRUMPLED)
def test_numbering(ratio, gap, device):
    """Vertices, triangles and the corners of each in another order: U to 1e-13, and ∂U/∂x to that or, where edges are longer
    than r, times their ratio, for gaps are differences of positions."""
    mesh, x = pair_of(ratio, gap)
    rng, new = np.random.default_rng(0), np.random.default_rng(1).permutation(len(x))
    old = np.argsort(new)
    triangles = [np.roll(face, rng.integers(3)) for face in old[rng.permutation(mesh.triangles)]]
    one, other = Potential(mesh, R, device), Potential(wc.Mesh(mesh.points[new], triangles), R, device)
    assert other.energy(x[new]) == pytest.approx(one.energy(x), rel=1e-13)
    expected = one.gradient(x)
    assert other.gradient(x[new])[old] == pytest.approx(expected, abs=1e-13 * max(1.0, 1.0 / ratio) * np.abs(expected).max())


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("ratio", [0.1, 1.0, 3.0])
def test_gradient_is_continuous(ratio, bounded, device):
    """On the way of a sheet that slides over ridges and valleys: it is that of U, and where it changes most it has no jump.

    Halved 24 times, an interval of 1/100 of the way is 6e-10 of it.
    """
    size = R / ratio
    mesh, x = crumpled(size, n=5, ridges=0.3 * min(ratio, 1.0))
    above = np.arange(len(x)) >= len(x) // 2
    x[above, 1] += 0.15 * R + x[~above, 1].max() - x[above, 1].min()
    way, potential = np.where(above[:, None], [1.3 * size, -0.1 * R, 0.7 * size], 0.0), Potential(mesh, R, device, bounded)
    t, eta = np.linspace(0.0, 1.0, 101), 1e-6
    gradients, negative = [], 0
    for each in t:
        gradients.append(potential.gradient(x + each * way))
        negative += (potential.multiplicities() < 0.0).sum()
    assert negative > 0
    most = max(np.abs(each).max() for each in gradients)
    for k in range(5, 100, 10):
        slope = (potential.energy(x + (t[k] + eta) * way) - potential.energy(x + (t[k] - eta) * way)) / (2.0 * eta)
        assert slope == pytest.approx((gradients[k] * way).sum(), abs=1e-6 * most * np.abs(way).max())
    changes = [np.abs(after - before).max() for before, after in pairwise(gradients)]
    assert max(changes) > 1e-3 * most
    for k in np.argsort(changes)[-4:]:
        ends = [(t[k], gradients[k]), (t[k + 1], gradients[k + 1])]
        for _ in range(24):
            middle = 0.5 * (ends[0][0] + ends[1][0])
            found = potential.gradient(x + middle * way)
            halves = [np.abs(found - gradient).max() for _, gradient in ends]
            ends[int(halves[0] > halves[1])] = middle, found
        assert np.abs(ends[1][1] - ends[0][1]).max() < 1e-7 * most


ALIGNED, SHIFTED, TURNED = (0.0, (0.0, 0.0)), (0.0, (0.31, 0.17)), (0.4, (0.31, 0.17))
PRESSED = [
    (ratio, place, *layers)
    for ratio in (0.1, 1.0, 3.0)
    for place in (ALIGNED, SHIFTED, TURNED)
    for layers in ((2, 0.3), (2, 0.7), (3, 0.4))
]


@pytest.mark.parametrize(
    ("ratio", "place", "count", "gap"),
    slow_but([row for row in PRESSED if row[0] < 3.0 or row == (3.0, TURNED, 2, 0.3)], PRESSED),
)
def test_pressure_of_flat_sheets(ratio, place, count, gap, device):
    """p = Σ −kφ′(m d) on the top of ``count`` sheets at gaps d of r/4 and more, in the mean over the middle: within 1 %.

    The mean is weighted by a smooth function, because half of the force comes at the vertices of the other sheets.
    """
    n, size, (turn, shift) = 13, R / ratio, place
    mesh = stack(count, n, size * (n - 1), gap * R, turn, pattern="alternating")
    points = mesh.points + np.arange(count).repeat(n * n)[:, None] * size * np.array([shift[0], 0.0, shift[1]])
    force = -Potential(wc.Mesh(points, mesh.triangles), R, device).gradient(points)[-n * n :, 1]
    away = (mesh.points[: n * n, [0, 2]] ** 2).sum(axis=1) / (4.0 * size) ** 2
    weights = np.maximum(1.0 - away, 0.0) ** 2
    pressure, d = weights @ force / (weights @ mesh.vertex_areas[-n * n :]), gap * R * np.arange(1, count)
    expected = STIFFNESS * np.where(d < 0.5 * R, 0.25 * R * R / d, np.maximum(R - d, 0.0)).sum()
    assert pressure == pytest.approx(expected, rel=1e-2)
