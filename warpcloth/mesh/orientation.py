"""Orients triangles so that neighbours wind in the same direction."""

import numpy as np


def turned_over(triangles, chosen):
    """Returns which of the ``chosen`` triangles (t,) of (T, 3) must be turned over to wind like their neighbours, (t,).

    In each piece the fewer are turned over; neighbours share an edge that no third triangle has. A piece with one side only
    raises ValueError.
    """
    from scipy.sparse import coo_array  # loaded late, as importing this package stays light
    from scipy.sparse.csgraph import connected_components

    count = len(triangles)
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    keys = np.minimum(start, end).astype(np.int64) * (int(triangles.max()) + 1) + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    _, first, sides = np.unique(keys[order], return_index=True, return_counts=True)
    one, two = order[first[sides == 2]], order[first[sides == 2] + 1]
    # Each triangle is two nodes, t as it is and t + T turned over; edges join those that wind in the same direction.
    opposed = np.where(start[one] == start[two], count, 0)
    one, two = one // 3, two // 3
    pairs = np.concatenate([[one, two + opposed], [one + count, (two + opposed + count) % (2 * count)]], axis=1)
    nodes = coo_array((np.ones(pairs.shape[1], dtype=bool), pairs), shape=(2 * count, 2 * count))
    piece = connected_components(nodes, directed=False)[1]
    kept, turned = piece[chosen], piece[count + chosen]
    one_sided = chosen[kept == turned]
    if len(one_sided):
        raise ValueError(f"triangle {one_sided[0]} belongs to a surface with one side, like a Möbius strip")
    as_they_are = np.bincount(kept, minlength=2 * count)
    more = as_they_are[turned] - as_they_are[kept]
    return (more > 0) | ((more == 0) & (turned < kept))
