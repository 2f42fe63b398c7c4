"""Second derivatives κ of a function on a mesh, a symmetric 2×2 matrix for each triangle.

For a function f of the vertices and a triangle T of area A,

    κ_T = 1/A Σ_e l_e sym(n_e ⊗ g_e)

over the edges e of T, with length l_e and outward normal n_e. g_e, the gradient of f at the midpoint of e, is common to both
triangles. Along e it is the difference of f over l_e, across e the mean over the two triangles. Each takes it from the
quadratic function through its corners and the opposite vertices of its neighbours; where these do not determine one, as at the
boundary, from a least-squares fit to surrounding vertices. So quadratic functions are exact on flat meshes. Neighbours are
unfolded into the plane of T, so a curved mesh counts by its edge lengths.
"""

import numpy as np

from ..kernels.membrane import inverse_edges, side_axes

_RANK = 1e-2  # ratio of the smallest to the largest singular value below which vertices do not determine a quadratic function
_RINGS = 4  # largest number of rings of triangles to fit to


def curvature_operator(mesh):
    """Returns K (3T, n), sparse: rows 3t to 3t + 2 of K f are κ₁₁, κ₂₂, κ₁₂ of triangle t [unit of f/m²], in axes of
    :func:`warpcloth.kernels.membrane.side_axes`.
    """
    from scipy.sparse import csr_array

    p = np.einsum(
        "tai,tki->tka", side_axes(mesh.points, mesh.triangles), mesh.points[mesh.triangles] - mesh.points[mesh.triangles[:, :1]]
    )
    area, T, n = mesh.triangle_areas, len(p), len(mesh.points)
    partner = _partners(mesh)
    side = np.roll(p, -1, axis=1) - p  # from corner k to k + 1
    length = np.linalg.norm(side, axis=2)
    along = side / length[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=2)
    inner = np.flatnonzero(partner.ravel() >= 0)
    own = np.ones(3 * T)
    own[inner] = 0.5
    rows, columns = np.append(np.arange(3 * T), inner), np.append(np.arange(3 * T), partner.ravel()[inner])
    # The outward normal of one triangle is the inward one of the other.
    mean = csr_array((np.append(own, np.full(len(inner), -0.5)), (rows, columns)), shape=(3 * T, 3 * T))
    across = mean @ _normal_derivatives(mesh, p, outward, length, partner)
    ends = np.stack([mesh.triangles, np.roll(mesh.triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    slopes = np.stack([-1.0 / length, 1.0 / length], axis=2).ravel()
    tangential = csr_array((slopes, (np.repeat(np.arange(3 * T), 2), ends.ravel())), shape=(3 * T, n))

    def summed(direction):
        both = outward[..., :, None] * direction[..., None, :]
        both = (both + both.swapaxes(2, 3)) * (0.5 * length / area[:, None])[..., None, None]
        entries = both[:, :, [0, 1, 0], [0, 1, 1]].swapaxes(1, 2)  # (T, 3 entries, 3 sides)
        columns = np.broadcast_to(3 * np.arange(T)[:, None, None] + np.arange(3), entries.shape)
        return csr_array((entries.ravel(), columns.ravel(), np.arange(0, 9 * T + 1, 3)), shape=(3 * T, 3 * T))

    return summed(outward) @ across + summed(along) @ tangential


def covariant_operator(mesh):
    """Returns second and first covariant derivatives on a mesh that may be curved, (3T, n) and (2T, n) [1/m², 1/m].

    Rows 2t and 2t + 1 of the second are the gradient on triangle t. The first is :func:`curvature_operator` less the
    combination of these that makes second derivatives of the mesh's points normal to triangles.
    """
    from scipy.sparse import csr_array

    T, n = len(mesh.triangles), len(mesh.points)
    r = inverse_edges(mesh.points, mesh.triangles)
    weights = np.zeros((T, 2, 3))  # the first row of the gradient, then the second, at the three corners
    weights[:, 0, 0], weights[:, 0, 1] = -r[:, 0], r[:, 0]
    weights[:, 1] = np.stack([-r[:, 1] - r[:, 2], r[:, 1], r[:, 2]], axis=1)
    columns = np.broadcast_to(mesh.triangles[:, None], weights.shape)
    first = csr_array((weights.ravel(), columns.ravel(), np.arange(0, 6 * T + 1, 3)), shape=(2 * T, n))
    second = curvature_operator(mesh)
    along = np.einsum("tmi,tai->tma", (second @ mesh.points).reshape(T, 3, 3), (first @ mesh.points).reshape(T, 2, 3))
    columns = np.broadcast_to(2 * np.arange(T)[:, None, None] + np.arange(2), along.shape)
    tangential = csr_array((along.ravel(), columns.ravel(), np.arange(0, 6 * T + 1, 2)), shape=(3 * T, 2 * T))
    return second - tangential @ first, first


def _partners(mesh):
    """Returns the side 3t + k that coincides with each side (T, 3), from corner k to k + 1; −1 at the boundary."""
    order, first, count = mesh._sides
    if len(mesh.hinges):  # raises for edges of three triangles
        shared = first[count == 2]
        one, two = order[shared], order[shared + 1]
    else:
        one = two = np.zeros(0, dtype=int)
    partner = np.full(3 * len(mesh.triangles), -1)
    partner[one], partner[two] = two, one
    return partner.reshape(-1, 3)


def _beyond(a, b, inside, ab, ac, bc):
    """Returns the points c of the plane at distances ac and bc from a and b (…, 2), across ab from ``inside``."""
    along = (b - a) / np.asarray(ab)[..., None]
    s = np.asarray((ac**2 - bc**2 + ab**2) / (2.0 * ab))
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normal = normal * -np.sign(np.einsum("...i,...i", normal, inside - a))[..., None]
    return a + s[..., None] * along + np.sqrt(np.maximum(ac**2 - s**2, 0.0))[..., None] * normal


def _bubbles(points, origin, slope):
    """Returns barycentric coordinates λ_k of points (…, J, 2), and bubble functions λ_k λ_{k+1}, both (…, J, 3), 0 for NaN."""
    there = np.isfinite(points[..., :1])
    of_corners = np.einsum("...ji,...ki->...jk", points - origin[..., None, :], slope)
    of_corners[..., 0] += 1.0
    of_corners = np.where(there, of_corners, 0.0)
    return of_corners, of_corners * np.roll(of_corners, -1, axis=-1)


def _fixes(bubbles):
    """Whether values at these points and at the corners determine a quadratic function, (…,)."""
    sizes = np.linalg.svd(bubbles, compute_uv=False)
    return sizes[..., 2:].sum(axis=-1) > _RANK * sizes[..., 0]


def _normal_derivatives(mesh, p, outward, length, partner):
    """Returns the matrix (3T, n) of outward derivatives at the midpoints of sides, of the quadratic of their triangle: linear
    through the corners, plus three bubbles fitted to other vertices.
    """
    from scipy.sparse import coo_array

    corners, T = mesh.triangles.astype(np.int64), len(p)
    height = 2.0 * mesh.triangle_areas[:, None] / np.roll(length, -1, axis=1)
    slope = -np.roll(outward, -1, axis=1) / height[..., None]  # λ_k falls to 0 on side k + 1
    linear = np.einsum("tki,tji->tkj", outward, slope)  # ∂λ_j/∂n on side k
    ends = 0.5 * (np.eye(3) + np.roll(np.eye(3), 1, axis=1))  # λ_j in the middle of side k
    bubble = ends * np.roll(linear, -1, axis=2) + np.roll(ends, -1, axis=1) * linear  # ∂(λ_m λ_{m+1})/∂n
    rows, columns, values = [], [], []

    def add(triangles, vertices, points):
        of_corners, bubbles = _bubbles(points, p[triangles, 0], slope[triangles])
        fit = bubble[triangles] @ np.linalg.pinv(bubbles, rcond=1e-8)  # (t, 3, J)
        sides = (3 * triangles[:, None] + np.arange(3))[..., None]
        for of, given in ((vertices, fit), (corners[triangles], linear[triangles] - fit @ of_corners)):
            used = np.broadcast_to(np.isfinite(points[:, None, :, 0]), given.shape) if of is vertices else slice(None)
            rows.append(np.broadcast_to(sides, given.shape)[used].ravel())
            columns.append(np.broadcast_to(of[:, None], given.shape)[used].ravel())
            values.append(given[used].ravel())

    inner = np.flatnonzero((partner >= 0).all(axis=1))
    other, side = np.divmod(partner[inner], 3)
    third, x, here = corners[other, (side + 2) % 3], mesh.points, p[inner]
    to_third = [np.linalg.norm(x[third] - x[np.roll(corners[inner], turn, axis=1)], axis=2) for turn in (0, -1)]
    points = _beyond(here, np.roll(here, -1, axis=1), np.roll(here, -2, axis=1), length[inner], *to_third)
    fixed = _fixes(_bubbles(points, here[:, 0], slope[inner])[1])
    if fixed.any():
        add(inner[fixed], third[fixed], points[fixed])
    rest = np.setdiff1d(np.arange(T), inner[fixed])
    if len(rest):
        patches = [_unfolded(mesh, p[t], t, partner, slope[t]) for t in rest.tolist()]
        most = max(map(len, patches))
        vertices, points = np.zeros((len(rest), most), dtype=np.int64), np.full((len(rest), most, 2), np.nan)
        for i, patch in enumerate(patches):
            if patch:
                vertices[i, : len(patch)], points[i, : len(patch)] = list(patch), list(patch.values())
        add(rest, vertices, points)
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(entries, shape=(3 * T, len(mesh.points))).tocsr()


def _unfolded(mesh, p, t, partner, slope):
    """Unfolds rings of triangles around t until they determine a quadratic: {vertex: (2,)}."""
    triangles, x = mesh.triangles, mesh.points
    own = triangles[t].tolist()
    found = dict(zip(own, p, strict=True))
    for _ring in range(_RINGS):
        core, queue, seen = set(found), [t], {t}
        for at in queue:
            for k in range(3):
                beyond, side = divmod(int(partner[at, k]), 3)
                if partner[at, k] < 0 or beyond in seen or core.isdisjoint(triangles[beyond].tolist()):
                    continue
                seen.add(beyond)
                queue.append(beyond)
                c = int(triangles[beyond, (side + 2) % 3])
                if c not in found:
                    a, b, inside = np.roll(triangles[at], -k).tolist()
                    ab, ac, bc = (np.linalg.norm(x[i] - x[j]) for i, j in ((a, b), (a, c), (b, c)))
                    found[c] = _beyond(found[a], found[b], found[inside], ab, ac, bc)
        around = {vertex: point for vertex, point in found.items() if vertex not in own}
        if len(around) > 2 and _fixes(_bubbles(np.array(list(around.values())), p[0], slope)[1]):
            break
    return around
