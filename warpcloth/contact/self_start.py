"""Checks that cloth with self-contact does not start with intersections or gaps that are too small.

Everything is computed in float64, without exact predicates.
"""

import numpy as np
import warp as wp

from ..kernels.terms.contact import FLOOR
from .tangles import Tangles


def check_start(contact, state):
    """Checks that cloth does not start with intersections, or with gaps below the smallest gap of the filter.

    Args:
        contact: The :class:`warpcloth.contact.self_steps.SelfSteps`.
        state: The :class:`warpcloth.core.state.State` of the solver, with the positions; tangles add their own arrays to it.

    Returns:
        With ``crossing_start="run"``, the :class:`warpcloth.contact.tangles.Tangles` of such a start; else None.

    Raises:
        ValueError: Such a pair exists, without ``crossing_start="run"``. The message names the first.
    """
    near, split, gap, through, least = _too_near(contact, state.x)
    if not len(near) and not through:
        return None
    crossing = [np.array([each[k] for each in through], dtype=np.int64).reshape(-1, 2 + k) for k in (0, 1)]
    tangles = Tangles(contact.model, state, *crossing, (near[:split], near[split:]), least)
    if contact.declared.crossing_start == "run":
        return tangles
    rule = f'; {len(tangles)} pairs of triangles cross or are too near, crossing_start="run" takes these'
    return _refuse_pairs(contact.model, near, split, gap, through, least, rule)


def check_reset(contact, mask, x):
    """Checks the positions of a reset of copies, as :func:`check_start`.

    Args:
        contact: The :class:`warpcloth.contact.self_steps.SelfSteps`.
        mask: Copies that are reset, (B,).
        x: Positions (B·n, 3) [m].

    Raises:
        ValueError: Cloth intersects or nearly touches cloth; the message names the first pair.
    """
    model = contact.model
    x = np.where(np.repeat(mask, model.per_copy)[:, None], x, np.nan)  # NaN has no pairs
    tangles, contact.tangles = contact.tangles, None
    with contact.looking():
        found = _too_near(contact, wp.array(x, dtype=model.vec3, device=model.device))
    contact.tangles = tangles
    if len(found[0]) or found[3]:
        _refuse_pairs(model, *found, "")


def _refuse_pairs(model, near, split, gap, through, least, rule):
    for stencil in near[:1]:
        parts = (stencil[:1], stencil[1:]) if split else (stencil[:2], stencil[2:])
        wanted = f"more than {least:.3g} m, a thousandth of its distance and rounding"
        _refuse_pair(model, parts, f"start {gap:.3g} m apart; self_contact needs {wanted}{rule}")
    _refuse_pair(model, through[0], f"cross at the start; self_contact needs a start without crossings{rule}")


def _refuse_pair(model, parts, why):
    named = []
    for part in parts:
        vertices = [int(v % model.per_copy if model.order is None else model.order[v % model.per_copy]) for v in part]
        named.append(f"{('vertex', 'edge', 'triangle')[len(part) - 1]} {'–'.join(map(str, vertices))}")
    copy = f" of copy {parts[0][0] // model.per_copy}" if model.copies > 1 else ""
    raise ValueError(f"{named[0]} and {named[1]}{copy} {why}")


def _too_near(contact, x):
    """Lists the pairs at x (N,), and finds those that are too near, and edges that intersect triangles.

    An edge that intersects a triangle is near one of its edges, so that this pair is listed.

    Returns:
        Pairs below the smallest distance, the number of vertex–triangle pairs among them, the gap of the first [m], edges that
        intersect triangles, and the smallest distance [m].
    """
    points = x.numpy().astype(np.float64)
    contact.launch_begin_at_start(x, _longest_edge(contact.model, points))
    of_vertices, of_edges = contact.proximity.counts.numpy()
    stencils = contact.proximity.stencils.numpy()[: of_vertices + of_edges]
    found, least = contact.begun.gap.numpy()[: len(stencils)], FLOOR * contact.declared.distance
    ulps = 6.0 * float(np.finfo(contact.model.numpy_dtype).eps) * np.abs(points).max(initial=0.0, where=np.isfinite(points))
    least += ulps
    near = stencils[found < least]
    split = int(np.count_nonzero(found[:of_vertices] < least))
    edges = stencils[of_vertices:]
    through = [
        each
        for own, other in ((edges[:, :2], edges[:, 2:]), (edges[:, 2:], edges[:, :2]))
        for each in crossings(points, own, _triangles_of(contact.model, other))
    ]
    gap = found[np.argmax(found < least)] if len(near) else np.inf
    return near, split, gap, through, least


def _longest_edge(model, points):
    """Length [m] of the longest edge of all copies at the start, which may be longer than at rest."""
    points = points.reshape(model.copies, -1, 3)[:, model.in_model(model.scene.mesh.edges)]
    lengths = np.linalg.norm(points[:, :, 1] - points[:, :, 0], axis=2)
    return lengths.max(initial=0.0, where=np.isfinite(lengths))


def _triangles_of(model, edges):
    """The triangles (E, m, 3) that contain the edges (E, 2); the last is repeated if there are fewer than m."""
    mesh, n = model.scene.mesh, model.per_copy
    triangles = np.asarray(model.in_model(mesh.triangles), dtype=np.int64)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = sides[:, 0] * n + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    local = np.sort(edges % n, axis=1).astype(np.int64)
    wanted = local[:, 0] * n + local[:, 1]
    first, last = (np.searchsorted(keys[order], wanted, side) for side in ("left", "right"))
    most = np.arange((last - first).max(initial=1))
    at = np.minimum(first[:, None] + most, last[:, None] - 1)
    return triangles[order[at] // 3] + (edges[:, :1] // n * n)[:, :, None]


def crossings(points, edges, triangles):
    """Finds the edges that intersect triangles.

    Args:
        points: (N, 3) [m].
        edges: (E, 2).
        triangles: (E, m, 3), the triangles to test with each edge.

    Returns:
        List of (edge (2,), triangle (3,)).
    """
    edges = np.repeat(edges, triangles.shape[1], axis=0)
    triangles = triangles.reshape(-1, 3)
    apart = ~(edges[:, :, None] == triangles[:, None, :]).any(axis=(1, 2))
    edges, triangles = edges[apart], triangles[apart]
    (p, q), (a, b, c) = points[edges].swapaxes(0, 1), points[triangles].swapaxes(0, 1)

    def volume(a, b, c, d):
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)

    through = volume(a, b, c, p) * volume(a, b, c, q) < 0.0
    sides = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    through &= (sides >= 0.0).all(axis=0) | (sides <= 0.0).all(axis=0)
    return list(zip(edges[through], triangles[through], strict=True))
