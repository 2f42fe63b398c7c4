"""Moves pieces of cloth that touch at the start apart."""

import itertools

import numpy as np


def apart(points, triangles, sides, gaps, piece, fixed, r):
    """Returns positions (N, 3) [m] at which pieces that touched are apart, or None.

    Touching pieces become layers, r apart or, if there are more than three, as far as moves of at most r allow. A piece lies
    above another where its touching vertices are, or the vertices beside them, if these are farther than r from the other.
    Pieces that coincide with opposite normals move to the sides that they face; of those with equal normals the later one lies
    above. Vertices of touching elements move along their normals; those of pieces with a fixed one stay.

    It is None if a piece touches itself, if touching pieces cannot be layers, if two that must stay touch, or if a normal is
    not defined.

    Args:
        points: (N, 3) [m].
        triangles: (T, 3).
        sides: Vertices of the two sides of each touching pair, (m, 2, 3); that of an edge or vertex repeats one.
        gaps: Vectors from the second side to the first, (m, 3) [m].
        piece: The piece of each vertex, (N,).
        fixed: Whether a vertex must stay, (N,).
        r: The contact distance [m].
    """
    pairs = piece[sides[:, :, 0]]
    if (pairs[:, 0] == pairs[:, 1]).any():
        return None
    normals, around = _normals(points, triangles), _around(points, triangles)
    moved = np.unique(sides)
    if not normals[moved].any(axis=1).all():
        return None
    # Of the second piece above the first, along the normal of the first.
    n, middle, beside = (each[sides].mean(axis=2) for each in (normals, points, around))
    turned = np.einsum("mi,mi->m", n[:, 0], n[:, 1])
    height = np.einsum("mi,mi->m", n[:, 0], beside[:, 1] - beside[:, 0] - middle[:, 1] + middle[:, 0])
    gap = -np.einsum("mi,mi->m", n[:, 0], gaps)
    above, turns = {}, {}
    for first, second in np.unique(np.sort(pairs, axis=1), axis=0):
        forth, back = ((pairs == each).all(axis=1) for each in ((first, second), (second, first)))
        turn = 1.0 if turned[forth | back].sum() >= 0.0 else -1.0
        found = turn
        for heights, least in ((height, r), (gap, 0.0)):
            mean = np.concatenate([heights[forth], -turn * heights[back]]).mean()
            found = np.sign(mean) if abs(mean) > least else found
        turns[first, second], above[first, second] = turn, found
    offsets = _offsets(turns, above, {int(each) for each in piece[moved][fixed[moved]]})
    if offsets is None:
        return None
    found = points.copy()
    found[moved] += r * np.array([offsets[each] for each in piece[moved]])[:, None] * normals[moved]
    return found


def _offsets(turns, above, stay):
    """Returns the move of each piece along its own normals, over the contact distance; 0 of those that ``stay``; or None.

    By pairs, ``turns`` is 1 for like normals, else −1, and ``above`` is 1 if the second is above the first, else −1.
    """
    offsets, beside = {}, {}
    for first, second in turns:
        beside.setdefault(first, []).append((second, turns[first, second]))
        beside.setdefault(second, []).append((first, turns[first, second]))
    for start in beside:
        if start in offsets:
            continue
        facing, queue = {start: 1.0}, [start]
        for each in queue:  # it grows
            for other, turn in beside[each]:
                if facing.setdefault(other, turn * facing[each]) != turn * facing[each]:
                    return None
                queue += [other] * (other not in queue)
        order = [(a, b) if above[a, b] * facing[a] > 0.0 else (b, a) for a, b in turns if a in facing]
        layer = dict.fromkeys(queue, 0)
        for _, (low, high) in itertools.product(queue, order):
            layer[high] = max(layer[high], layer[low] + 1)
        if any(layer[high] <= layer[low] for low, high in order):
            return None
        kept = {layer[each] for each in queue if each in stay}
        if len(kept) > 1:
            return None
        base = kept.pop() if kept else 0.5 * max(layer.values())
        spacing = 1.0 / max(1.0, *(abs(each - base) for each in layer.values()))
        offsets |= {each: spacing * (layer[each] - base) * facing[each] for each in queue}
        offsets |= dict.fromkeys(stay & set(queue), 0.0)
    return offsets


def _normals(points, triangles):
    a, b, c = points[triangles].swapaxes(0, 1)
    found = _sums(np.cross(b - a, c - a), triangles, len(points))
    return found / np.maximum(np.linalg.norm(found, axis=1), 1e-300)[:, None]


def _around(points, triangles):
    counts = np.bincount(triangles.ravel(), minlength=len(points))
    return _sums(points[triangles].mean(axis=1), triangles, len(points)) / np.maximum(counts, 1)[:, None]


def _sums(values, triangles, n):
    found = np.zeros((n, 3))
    np.add.at(found, triangles, values[:, None])
    return found
