"""The potential of self-contact: its energy against sums in NumPy, its gradient on paths, and the pressure of flat sheets."""

from itertools import pairwise

import numpy as np
import pytest

import warpcloth as wc
from support.contacts import begin, energy, gradient, pairs_of
from support.judges import barrier_slope
from support.layers import stack
from support.pairs import energies
from support.rows import table
from warpcloth.core.hessian import Hessian
from warpcloth.kernels.term import HessianPolicy

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
        keys = found.pairs.keys.numpy()[: found.pairs.number.numpy()[0]]
        acting = np.flatnonzero((keys < faces) | (keys >= len(found.lists.stencils)))
        areas = self.steps.model.scene.mesh.vertex_areas[found.pairs.stencils.numpy()[acting, 0]]
        return found.data.stiffness.numpy()[acting] / (0.5 * STIFFNESS * areas)


# r over the size of edges, and the gap over r: of folds that are sharp and blunt for r, with negative multiplicities.
CRUMPLED = [(0.1, 0.15), (0.5, 0.4), (1.0, 0.4), (3.0, 0.15)]
R = 0.02


def pair_of(ratio, gap):
    """:func:`crumpled` sheets whose upper one is raised by about ``gap``."""
    mesh, x = crumpled(R / ratio, n=6, seed=int(10 * gap))
    x[len(x) // 2 :, 1] += gap * R * (1.0 if ratio < 1.0 else 2.0)
    return mesh, x


def places_at_a_fold():
    """Vertices near two faces at 60° that meet in the edge (0, 0, ±1): in the valley, by the edge, by its end, by a face."""
    # In the valley the vertex lies r/10 from one face and 0.6 r from the other: the edge has m = −1 on both sides.
    angle = np.arctan2(0.1 * 0.75**0.5, 0.6 + 0.05)  # sin(60° − angle) = 6 sin(angle)
    valley = 0.1 * R / np.sin(angle) * np.array([np.sin(np.pi / 6 - angle), np.cos(np.pi / 6 - angle), 0.0])
    face = np.array([0.25, 0.4330127018922193, 0.1]) + 0.3 * R * np.array([0.75**0.5, -0.5, 0.0])
    return {"valley": valley, "edge": R * np.array([0.1, -0.4, 3.0]), "end": [0.1 * R, -0.2 * R, 1.0 + 0.3 * R], "face": face}


@pytest.mark.parametrize("policy", [HessianPolicy.RAW, HessianPolicy.CLAMP])
@pytest.mark.parametrize("place", places_at_a_fold())
def test_the_hessian_is_the_derivative_of_the_force(place, policy, device):
    """By central differences with respect to the vertex; clamped, along the normal of the nearest face in the valley."""
    # Without the edge of m = −1 the clamped Hessian is 160 times smaller there. It lacks what curves across the normal.
    faces = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.5, 0.75**0.5, 0.0], [-0.5, 0.75**0.5, 0.0]])
    away = 1.0 if place == "valley" else -1.0
    vertex = places_at_a_fold()[place] + np.array([[0.0, 0.0, 0.0], [0.1, away, 0.3], [0.1, away, -0.3]])
    x = np.concatenate([faces, vertex])
    mesh = wc.Mesh(x + np.repeat([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], [4, 3], axis=0), [[0, 1, 2], [1, 0, 3], [4, 5, 6]])
    potential, eta = Potential(mesh, R, device), 1e-6 * R
    moves = eta * np.eye(7)[4][:, None] * np.eye(3)[:, None]
    slopes = [(potential.gradient(x + move)[4] - potential.gradient(x - move)[4]) / (2.0 * eta) for move in moves]
    potential.gradient(x)
    steps = potential.steps
    hessian = Hessian(steps.model, policy, terms=[], dynamic=steps.forces.terms)
    hessian.assemble(steps.model.array(x, steps.model.vec3), 0.0)
    block, size = hessian.values.numpy()[hessian.diagonal.numpy()[4]], np.abs(slopes).max()
    if policy == HessianPolicy.RAW:
        assert block == pytest.approx(np.array(slopes), abs=1e-6 * size)
        return
    assert np.linalg.eigvalsh(block).min() > -1e-12 * size
    if place == "valley":
        n = np.array([-(0.75**0.5), 0.5, 0.0])
        assert n @ block @ n == pytest.approx(n @ slopes @ n, rel=0.1)


@pytest.mark.parametrize(("ratio", "gap"), CRUMPLED)
def test_energy_is_the_sum(ratio, gap, device):
    """Over all faces minus edges plus vertices without cancellation, and over all pairs of edges: to rounding."""
    mesh, x = pair_of(ratio, gap)
    potential = Potential(mesh, R, device)
    found, m = potential.energy(x), potential.multiplicities()
    assert (m < 0.0).sum() > 1 and (m > 0.0).sum() > 10 and m == pytest.approx(np.round(m), rel=1e-12)
    of_faces, of_edges = energies(mesh, x, R, STIFFNESS)
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
    assert potential.energy(x) == pytest.approx(sum(energies(mesh, x, R, STIFFNESS)), rel=1e-11)
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
    """Vertices, triangles and corners in another order: U to 1e-13, and ∂U/∂x to that times edges over r."""
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
    """On the way of a sheet over ridges and valleys it is that of U, without a jump in 6e-10 of it, 1/100 halved 24 times."""
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


@table("ratio, place, count, gap", [row for row in PRESSED if row[0] < 3.0 or row == (3.0, TURNED, 2, 0.3)], PRESSED)
def test_pressure_of_flat_sheets(ratio, place, count, gap, device):
    """p = Σ −kφ′(m d) on the top sheet to 1 %, in a smooth mean over the middle: half of it comes at other vertices."""
    n, size, (turn, shift) = 13, R / ratio, place
    mesh = stack(count, n, size * (n - 1), gap * R, turn, pattern="alternating")
    points = mesh.points + np.arange(count).repeat(n * n)[:, None] * size * np.array([shift[0], 0.0, shift[1]])
    force = -Potential(wc.Mesh(points, mesh.triangles), R, device).gradient(points)[-n * n :, 1]
    away = (mesh.points[: n * n, [0, 2]] ** 2).sum(axis=1) / (4.0 * size) ** 2
    weights = np.maximum(1.0 - away, 0.0) ** 2
    pressure, d = weights @ force / (weights @ mesh.vertex_areas[-n * n :]), gap * R * np.arange(1, count)
    expected = STIFFNESS * barrier_slope(d, R).sum()
    assert pressure == pytest.approx(expected, rel=1e-2)
