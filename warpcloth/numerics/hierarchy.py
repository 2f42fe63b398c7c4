"""A hierarchy of coarser levels of a cloth, whose constraints span many vertices (Müller 2008).

A bound is a pair of vertices with a largest distance. A level keeps an independent set of vertices of the finer level, so that
every dropped vertex is linked to a kept one; all pins are kept. A bound between kept vertices is the length of a path at rest:
over up to two dropped ones, or a shorter, straight one over triangles that keep their shape. So a cloth that meets all finer
bounds meets it too. Paths over edges alone are 4 to 14 % longer on each level of irregular meshes.
"""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ..kernels.terms.spring_limit import SPRING_LIMIT
from ..model.elements import DeviceElements
from ..model.host_values import host_values
from .unfolding import UnfoldedSurface

_HUB = 8  # a dropped vertex with more kept neighbours links them to the nearest of them, not each to each
_NEAREST = 2  # kept neighbours of a dropped vertex to which paths over two dropped ones lead
_MAX_RATIO = 4.0  # ratio of the stiffnesses of the springs of a triangle up to which it keeps its shape


@dataclass(frozen=True, eq=False)
class Bounds:
    """Pairs of vertices with the largest distance allowed.

    Attributes:
        pairs: (E, 2), each pair once.
        lengths: (E,) [m].
        compliance: 1/k of each copy, (E, B), or (E, 1) if copies do not differ [m/N].
    """

    pairs: np.ndarray
    lengths: np.ndarray
    compliance: np.ndarray

    def __len__(self):
        return len(self.pairs)

    def take(self, which):
        return Bounds(self.pairs[which], self.lengths[which], self.compliance[which])

    def shortest(self, n):
        """Returns the shortest bound of each pair, the first of equal ones, in lexicographic order, smaller index first."""
        keys = self.pairs.min(axis=1).astype(np.int64) * n + self.pairs.max(axis=1)
        order = np.lexsort((self.lengths, keys))
        unique, first = np.unique(keys[order], return_index=True)
        found = self.take(order[first])
        return replace(found, pairs=np.stack(np.divmod(unique, n), axis=1))


@dataclass(frozen=True, eq=False)
class Level:
    """A level of the vertices of one copy, and the interpolation from it to the next finer one.

    Attributes:
        bounds: The :class:`Bounds` between kept vertices, a tuple (soft, hard).
        inverse_mass: (B, n) [1/kg], 0 for pins. The mass of a kept vertex includes its weights of the dropped ones that follow
            it, so that a move of the level has the momentum of the move of all of them.
        dropped: The vertices (D,) of the finer level that this one drops.
        offsets, parents, weights: For each dropped vertex, the kept vertices that it follows, and weights with sum 1, as CSR.
    """

    bounds: tuple
    inverse_mass: np.ndarray
    dropped: np.ndarray
    offsets: np.ndarray
    parents: np.ndarray
    weights: np.ndarray


def levels(model, most=None):
    """Returns a list of :class:`Level` above the finest, finer ones first: as many as have bounds, or ``most`` of them."""
    n, inverse = model.per_copy, model.inverse_mass.numpy().reshape(model.copies, -1).astype(np.float64)
    free = inverse[0] > 0.0
    mass = np.where(free, model.mass.numpy().reshape(inverse.shape), 0.0).astype(np.float64)
    (groups, surfaces), found = _finest(model, free), []
    while most is None or len(found) < most:
        links = Bounds(
            np.concatenate([each.pairs for each in groups]),
            np.concatenate([each.lengths for each in groups]),
            np.zeros((sum(map(len, groups)), 0)),
        ).shortest(n)
        kept = _independent(links.pairs, free)
        dropped, offsets, parents, weights = _followers(links, kept)
        for copy_mass in mass:  # the kept vertices take over all mass of the dropped ones
            np.add.at(copy_mass, parents, weights * np.repeat(copy_mass[dropped], np.diff(offsets)))
            copy_mass[dropped] = 0.0
        groups = tuple(
            _scaled(_coarser(each, kept, free, surface), each, free) for each, surface in zip(groups, surfaces, strict=True)
        )
        if not any(map(len, groups)):
            break
        level = np.divide(1.0, mass, out=np.zeros_like(mass), where=free & kept)
        found.append(Level(groups, level, *(each.astype(np.int32) for each in (dropped, offsets, parents)), weights))
    return found


def _finest(model, free):
    """Returns the bounds of a model's terms, (soft, hard), and the :class:`.unfolding.UnfoldedSurface` of each, or None.

    They are apart because a hard bound must not merge with a soft one.
    """
    n, soft, hard = model.per_copy, [], []
    points, sheets = model.rest_points, ([], [])
    for elements in model.terms:
        if elements.term.max_lengths is None:
            continue
        E = elements.per_copy
        stiffness = host_values(elements.stiffness).reshape(model.copies, E).astype(np.float64).T
        if (stiffness == stiffness[:, :1]).all():
            stiffness = stiffness[:, :1]
        # All copies share the longest of their bounds; the last sweeps use the lengths of each copy.
        stencil, rest = host_values(elements.stencil)[:E], host_values(elements.rest).reshape(model.copies, E, -1)
        found = [elements.term.max_lengths(points, stencil, each) for each in (rest if (rest != rest[:1]).any() else rest[:1])]
        pairs, _, factors = found[0]
        of_copies = np.stack([lengths for _, lengths, _ in found])
        lengths = of_copies.max(axis=0)
        each = len(pairs) // E
        with np.errstate(divide="ignore"):
            compliance = 1.0 / (np.repeat(stiffness, each, axis=0) * factors[:, None])
        bounds = Bounds(pairs, lengths.astype(np.float64), compliance)
        used = np.isfinite(lengths) & free[pairs].any(axis=1) & np.isfinite(compliance).any(axis=1)
        is_hard = (compliance == 0.0).any(axis=1)
        soft.append(bounds.take(used & ~is_hard))
        hard.append(bounds.take(used & is_hard))
        triangles, sides = _keeping_shape(model, elements, of_copies, bounds)
        for sheet, which in zip(sheets, (~is_hard, is_hard), strict=True):
            of_kind = which[sides].all(axis=1)
            sheet.append((triangles[of_kind], lengths[sides[of_kind]]))
    surfaces = [_surface(points, sheet, ~free) for sheet in sheets]
    return (_parallel(soft, n, model.copies), _joined(hard, model.copies).shortest(n)), surfaces


def _keeping_shape(model, elements, lengths, bounds):
    """Returns the triangles (T, 3) that cannot shear while a term meets its bounds, and their sides (T, 3) among the bounds.

    These are triangles that are elements, and triangles of springs of like stiffness. Limits of lengths let triangles shear. In
    copies of other ``lengths`` (B, E), a triangle has another size, but the same shape.
    """
    pairs, n = bounds.pairs.astype(np.int64), model.per_copy
    if len(pairs) == 3 * elements.per_copy and elements.term.vertices == 3:
        triangles, sides = host_values(elements.stencil)[: elements.per_copy], np.arange(len(pairs)).reshape(-1, 3)
    elif len(pairs) and elements.term.vertices == 2 and not elements.term.dead_zone:
        triangles = model.in_model(model.scene.mesh.triangles)
        keys, ends = pairs.min(axis=1) * n + pairs.max(axis=1), np.roll(triangles, -1, axis=1).astype(np.int64)
        wanted = np.minimum(triangles, ends) * n + np.maximum(triangles, ends)
        order = np.argsort(keys, kind="stable")
        sides = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
        compliance = bounds.compliance[sides]
        alike = (compliance.max(axis=1) <= _MAX_RATIO * compliance.min(axis=1)).all(axis=1)
        keeps = alike & (keys[sides] == wanted).all(axis=1)
        triangles, sides = triangles[keeps], sides[keeps]
    else:
        triangles = sides = np.empty((0, 3), dtype=np.int64)
    keeps = np.isfinite(lengths[:, sides]).all(axis=(0, 2)) & (lengths[:, sides] > 0.0).all(axis=(0, 2))
    triangles, sides = triangles[keeps], sides[keeps]
    size = lengths[:, sides] / lengths.max(axis=0)[sides]
    same = (np.ptp(size, axis=2) <= 1e-9).all(axis=0)
    return triangles[same], sides[same]


def _surface(points, sheets, fixed):
    """Returns the surface of (triangles, lengths of sides) of several terms, each triangle once; None without triangles."""
    sheets = [sheet for sheet in sheets if len(sheet[0])]
    if not sheets:
        return None
    triangles, lengths = map(np.concatenate, zip(*sheets, strict=True))
    if len(sheets) > 1:
        once = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1]
        triangles, lengths = triangles[once], lengths[once]
    return UnfoldedSurface(points, triangles, lengths, fixed)


def _joined(bounds, copies):
    wide = copies if any(each.compliance.shape[1] > 1 for each in bounds) else 1
    empty = Bounds(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros((0, wide)))
    bounds = [empty, *bounds]
    return Bounds(
        np.concatenate([each.pairs for each in bounds]),
        np.concatenate([each.lengths for each in bounds]),
        np.concatenate([np.broadcast_to(each.compliance, (len(each), wide)) for each in bounds]),
    )


def _parallel(bounds, n, copies):
    """Merges soft bounds of one pair: their stiffnesses add up, and at its length their forces cancel in copy 0."""
    bounds = _joined(bounds, copies)
    stiffness = 1.0 / bounds.compliance
    keys = bounds.pairs.min(axis=1).astype(np.int64) * n + bounds.pairs.max(axis=1)
    unique, index = np.unique(keys, return_inverse=True)
    total = np.stack([np.bincount(index, each, len(unique)) for each in stiffness.T], axis=1)
    mean = stiffness.mean(axis=1)
    lengths = np.bincount(index, mean * bounds.lengths, len(unique)) / np.bincount(index, mean, len(unique))
    with np.errstate(divide="ignore"):
        return Bounds(np.stack(np.divmod(unique, n), axis=1), lengths, 1.0 / total)


def _independent(pairs, free):
    """Returns which vertices are kept, (n,): linked pins, then in order each linked vertex without a kept neighbour."""
    n = len(free)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    offsets = np.searchsorted(both[:, 0], np.arange(n + 1)).tolist()
    neighbours = both[:, 1].tolist()
    linked = np.diff(offsets) > 0
    kept = linked & ~free
    decided = bytearray(kept | ~linked)
    for v in both[kept[both[:, 0]], 1].tolist():
        decided[v] = 1
    for v in range(n):
        if not decided[v]:
            kept[v] = True
            for u in neighbours[offsets[v] : offsets[v + 1]]:
                decided[u] = 1
    return kept


def _followers(links, kept):
    """Returns the dropped vertices and the kept ones that each follows: its neighbours, and if that is one, those at two links.

    The weights are 1/L over Σ 1/L, with L the length of the path.
    """
    n = len(kept)
    dropped, near = _nearest(links, kept)
    count = np.bincount(dropped, minlength=n)
    between = ~kept[links.pairs].any(axis=1)
    ends, lengths = links.pairs[between], links.lengths[between]
    ends, lengths = np.concatenate([ends, ends[:, ::-1]]), np.concatenate([lengths, lengths])
    lone = count[ends[:, 0]] == 1
    ends, lengths = ends[lone], lengths[lone]
    first = np.searchsorted(dropped, np.arange(n))
    rows, entries = _spread(first[ends[:, 1]], count[ends[:, 1]])
    ways = Bounds(
        np.stack(
            [np.concatenate([dropped, ends[rows, 0]]), np.concatenate([near.pairs[:, 1], near.pairs[entries, 1]])], axis=1
        ),
        np.concatenate([near.lengths, lengths[rows] + near.lengths[entries]]),
        np.zeros((len(dropped) + len(rows), 0)),
    )
    keys = ways.pairs[:, 0] * n + ways.pairs[:, 1]
    order = np.lexsort((ways.lengths, keys))
    unique, first = np.unique(keys[order], return_index=True)
    source, parents = np.divmod(unique, n)
    lengths = ways.lengths[order[first]]
    least = 1e-6 * lengths.max(initial=0.0)
    weights = 1.0 / np.maximum(lengths, least if least > 0.0 else 1.0)
    vertices, starts = np.unique(source, return_index=True)
    offsets = np.append(starts, len(source))
    weights /= np.repeat(np.add.reduceat(weights, starts), np.diff(offsets)) if len(source) else 1.0
    return vertices, offsets, parents, weights


def _nearest(bounds, kept):
    """Returns the dropped vertices and the bounds from dropped to kept vertices, sorted by dropped vertex and length."""
    inside = kept[bounds.pairs]
    one = inside[:, 0] != inside[:, 1]
    some, inside = bounds.take(one), inside[one]
    pairs = np.where(inside[:, :1], some.pairs[:, ::-1], some.pairs)
    order = np.lexsort((pairs[:, 1], some.lengths, pairs[:, 0]))
    some = replace(some, pairs=pairs).take(order)
    return some.pairs[:, 0], some


def _spread(first, count):
    """Returns (rows, entries): entries first[i] … first[i] + count[i] − 1 of each row i, one row after another."""
    rows = np.repeat(np.arange(len(first)), count)
    return rows, np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)


def _coarser(bounds, kept, free, surface):
    """Returns bounds between kept vertices: direct, over one dropped vertex, and over two by the nearest kept ones of each.

    Those with a shorter, straight path over the ``surface`` have its length.
    """
    n = len(kept)
    inside = kept[bounds.pairs]
    own = bounds.take(inside.all(axis=1))
    dropped, near = _nearest(bounds, kept)
    first = np.searchsorted(dropped, np.arange(n))
    count = np.bincount(dropped, minlength=n)
    # Each path to a kept vertex continues to those before it in the list, or at a hub to the nearest one.
    before = np.arange(len(dropped)) - first[dropped]
    back, other = _spread(first[dropped], np.where(count[dropped] > _HUB, np.minimum(before, 1), before))
    over_one = Bounds(
        np.stack([near.pairs[back, 1], near.pairs[other, 1]], axis=1),
        near.lengths[back] + near.lengths[other],
        near.compliance[back] + near.compliance[other],
    )
    between = bounds.take(~inside.any(axis=1) & (count[bounds.pairs] > 0).all(axis=1))
    ends = np.minimum(count[between.pairs], _NEAREST)
    middle, which = _spread(np.zeros(len(between), dtype=np.int64), ends.prod(axis=1))
    between = between.take(middle)
    a, b = (first[between.pairs] + np.stack(np.divmod(which, ends[middle, 1]), axis=1)).T
    over_two = Bounds(
        np.stack([near.pairs[a, 1], near.pairs[b, 1]], axis=1),
        near.lengths[a] + between.lengths + near.lengths[b],
        near.compliance[a] + between.compliance + near.compliance[b],
    )
    ways = _joined([own, over_one, over_two], bounds.compliance.shape[1])
    different = ways.pairs[:, 0] != ways.pairs[:, 1]
    found = ways.take(different & free[ways.pairs].any(axis=1)).shortest(n)
    return found if surface is None else replace(found, lengths=surface.shortened(found.pairs, found.lengths))


def _scaled(coarse, fine, free):
    """Scales the stiffness of ``coarse`` so that Σ kL², twice the energy of a unit stretch, of each connected piece is kept.

    In a chain, the stiffness of paths in series already keeps it. In a sheet, a level also drops parallel paths.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(coarse):
        return coarse
    n = len(free)
    loose = fine.pairs[free[fine.pairs].all(axis=1)]
    _, label = connected_components(coo_array((np.ones(len(loose)), loose.T), shape=(n, n)), directed=False)

    def energy(bounds):
        part = label[np.where(free[bounds.pairs[:, 0]], bounds.pairs[:, 0], bounds.pairs[:, 1])]
        with np.errstate(divide="ignore"):
            stiffness = 1.0 / bounds.compliance
        given = np.where(np.isfinite(stiffness), stiffness, 0.0) * bounds.lengths[:, None] ** 2
        return part, np.stack([np.bincount(part, each, n) for each in given.T], axis=1)

    _, before = energy(fine)
    part, after = energy(coarse)
    factor = np.divide(after, before, out=np.ones_like(after), where=(before > 0.0) & (after > 0.0))
    return replace(coarse, compliance=coarse.compliance * factor[part])


def on_device(model, level):
    """Returns the model of a level: the same vertices and kernels, with its masses and bounds."""
    bounds = _joined(level.bounds, model.copies)
    E, B = len(bounds), model.copies
    with np.errstate(divide="ignore"):
        stiffness = np.broadcast_to(1.0 / bounds.compliance.T, (B, E))
    stencil = bounds.pairs[None] + (np.arange(B) * model.per_copy)[:, None, None]
    rest = np.tile(np.stack([np.zeros(E), bounds.lengths], axis=1), (B, 1))
    view = model.with_terms(
        [
            DeviceElements(
                label="bounds",
                term=SPRING_LIMIT,
                per_copy=E,
                stencil=wp.array(stencil.reshape(-1, 2).astype(np.int32), dtype=wp.int32, device=model.device),
                stiffness=model.array(stiffness.ravel(), model.dtype),
                rest=model.array(rest, wp.types.vector(2, model.dtype)),
                hard=bool(np.isinf(stiffness).any()),
            ),
        ]
    )
    view.inverse_mass = model.array(level.inverse_mass.ravel(), model.dtype)
    if model.mobility is not None:
        free = model.mobility.numpy() > 0.0
        view.mobility = model.array(level.inverse_mass.reshape(-1, 1) * free, model.vec3)
    return view
