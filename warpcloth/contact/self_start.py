"""Checks, in float64, that cloth with self-contact does not start with intersections or too small gaps."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels.contact.start_crossings import Fans, find_crossings
from .start_layers import apart


def check_start(contact, state):
    """Checks that cloth does not start with intersections, or with gaps below the least gap of the filter.

    Pieces that only touch or coincide are moved apart in the state and in the model of :class:`.SelfSteps`.

    Raises:
        ValueError: Cloth intersects cloth, or touches it and cannot be moved apart.
    """
    start = _too_near(contact, state.x)
    moved = _moved(contact, state.x, start) if len(start.near) else None
    if moved is not None and not _too_near(contact, moved).bad:
        contact.model.move_start(moved)
        wp.copy(state.x, moved)
        for points in contact.model.in_scene_order(moved.numpy()).reshape(contact.model.copies, -1, 3):
            contact.model.scene.refuse_inside(points.astype(np.float64), ", after it was moved off other cloth")
    elif start.bad:
        _refuse_pairs(contact.model, start)


def check_reset(contact, mask, x):
    """Checks the positions x (B·n, 3) [m] of copies in ``mask`` (B,), but moves nothing.

    Raises:
        ValueError: Cloth intersects or nearly touches cloth.
    """
    model = contact.model
    x = np.where(np.repeat(mask, model.per_copy)[:, None], x, np.nan)  # NaN has no pairs
    with contact.looking():
        found = _too_near(contact, wp.array(x, dtype=model.vec3, device=model.device))
    if found.bad:
        _refuse_pairs(model, found)


class _Start(NamedTuple):
    """Pairs (m, 4) that are too near at a start, the ``split`` vertex–triangle pairs first, and intersections.

    Attributes:
        gaps: Vectors from the second side to the first, (m, 3) [m]; 0 within rounding.
        through: Edges that intersect triangles, or touch them at a side.
        least: The smallest distance [m].
    """

    near: np.ndarray
    split: int
    gaps: np.ndarray
    through: list
    least: float

    @property
    def bad(self):
        return len(self.near) > 0 or len(self.through) > 0


def _moved(contact, x, start):
    model, mesh = contact.model, contact.model.scene.mesh
    n, copies, pieces = model.per_copy, np.arange(model.copies), contact.proximity.pieces
    first = np.full(pieces.max() + 2, n)  # vertex of each piece in the scene, by which pieces are in order
    np.minimum.at(first, pieces, np.arange(n) if model.order is None else model.order)
    near, split = start.near, start.split
    sides = np.stack([near[:, [0, 0, 0]], near[:, 1:]], axis=1)
    sides[split:] = near[split:][:, [[0, 1, 1], [2, 3, 3]]]
    triangles = (model.in_model(mesh.triangles) + n * copies[:, None, None]).reshape(-1, 3)
    piece = (first[pieces] + n * copies[:, None]).ravel()
    fixed = (model.coordinate_mobility().reshape(-1, 3) == 0.0).any(axis=1)
    found = apart(x.numpy().astype(np.float64), triangles, sides, start.gaps, piece, fixed, contact.distance)
    return None if found is None else wp.array(found, dtype=model.vec3, device=model.device)


def _refuse_pairs(model, start):
    for parts in start.through[:1]:
        _refuse_pair(model, parts, "cross at the start; self_contact needs a start without crossings")
    for stencil, gap in zip(start.near[:1], start.gaps, strict=False):
        parts = (stencil[:1], stencil[1:]) if start.split else (stencil[:2], stencil[2:])
        wanted = f"more than {start.least:.3g} m, a thousandth of its distance and rounding"
        _refuse_pair(model, parts, f"start {np.linalg.norm(gap):.3g} m apart; self_contact needs {wanted}")


def _refuse_pair(model, parts, why):
    raise ValueError(f"{_named(model, parts[0])} and {_named(model, parts[1])}{_of_copy(model, parts[0][0])} {why}")


def _named(model, part):
    vertices = [str(int(v % model.per_copy if model.order is None else model.order[v % model.per_copy])) for v in part]
    return f"{('vertex', 'edge', 'triangle')[len(part) - 1]} {'–'.join(vertices)}"


def _of_copy(model, vertex):
    return f" of copy {vertex // model.per_copy}" if model.copies > 1 else ""


def _too_near(contact, x):
    """Returns the :class:`_Start` at x (N,)."""
    points = x.numpy().astype(np.float64)
    contact.launch_begin_at_start(x, _longest_edge(contact.model, points))
    of_vertices, of_edges = contact.proximity.counts.numpy()
    stencils = contact.proximity.stencils.numpy()[: of_vertices + of_edges]
    found, least = contact.begun.gap.numpy()[: len(stencils)], contact.least
    ulps = 6.0 * float(np.finfo(contact.model.numpy_dtype).eps) * np.abs(points).max(initial=0.0, where=np.isfinite(points))
    least += ulps
    _refuse_meshes(contact, stencils, found, least)
    own = (stencils < contact.model.count).all(axis=1)  # pairs of cloth with cloth
    bits = _may_cross(contact, x)[own]
    of_vertices, stencils, found = int(own[:of_vertices].sum()), stencils[own], found[own]
    near, y = stencils[found < least], contact.begun.normal.numpy()[: len(own)][own] * found[:, None]
    split = int(np.count_nonzero(found[:of_vertices] < least))
    through = [
        each
        for bit, ends, others in ((1, [0, 1], [2, 3]), (2, [2, 3], [0, 1]))
        for edges in [stencils[bits & bit > 0]]
        for each in crossings(points, edges[:, ends], _triangles_of(contact.model, edges[:, others]))
    ]
    return _Start(near, split, np.where(found > ulps, y.T, 0.0).T[found < least], through, least)


def _may_cross(contact, x):
    model, pairs = contact.model, contact.pairs
    triangles = np.asarray(model.in_model(model.scene.mesh.triangles), dtype=np.int32)
    order = np.argsort(triangles, axis=None, kind="stable")
    first = np.searchsorted(triangles.ravel()[order], np.arange(model.per_copy + 1))
    fans = Fans()
    fans.first = wp.array(first, dtype=wp.int32, device=model.device)
    fans.triangles = wp.array(triangles[order // 3], dtype=wp.vec3i, device=model.device)
    found = wp.zeros(int(contact.proximity.counts.numpy().sum()), dtype=wp.uint8, device=model.device)
    model.launch(model.kernel(find_crossings, model.dtype), pairs.threads, [pairs, fans, x], [found])
    return found.numpy()


def _refuse_meshes(contact, stencils, gaps, least):
    model, surface = contact.model, contact.surface
    for k in np.flatnonzero((gaps < least) & (stencils >= model.count).any(axis=1))[:1]:
        s = stencils[k]
        behind, own = s[s >= model.count], s[s < model.count][:1]
        mesh = model.scene.colliders[surface.colliders[(behind[0] - model.count) % surface.obstacles]].label
        raise ValueError(
            f"{_named(model, own)}{_of_copy(model, own[0])}, or an element at it, starts {gaps[k]:.3g} m from {mesh}; it must "
            f"start more than {least:.3g} m away, a thousandth of the contact distance and rounding"
        )


def _longest_edge(model, points):
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
    """Returns the edges (E, 2) that intersect one of the ``triangles`` (E, m, 3) of each, with that: [(edge, triangle), …].

    An edge that crosses the plane of a triangle does so at a point of its own, so rounding does not count it in several
    triangles of a row.
    """
    edges = np.repeat(edges, triangles.shape[1], axis=0)
    triangles = triangles.reshape(-1, 3)
    apart = ~(edges[:, :, None] == triangles[:, None, :]).any(axis=(1, 2))
    edges, triangles = edges[apart], triangles[apart]
    (p, q), corners = points[edges].swapaxes(0, 1), points[triangles].swapaxes(0, 1)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    above, below = (np.einsum("ij,ij->i", normal, end - corners[0]) for end in (p, q))
    through = above * below < 0.0
    at = p + np.divide(above, above - below, out=np.zeros_like(above), where=through)[:, None] * (q - p)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        through &= np.einsum("ij,ij->i", normal, np.cross(end - start, at - start)) >= 0.0
    return list(zip(edges[through], triangles[through], strict=True))
