"""Lengths of straight paths over a surface, found by unfolding its triangles one after another into the plane.

Where triangles keep their shape, so does each path over them. The length of a path at rest thus bounds the distance of its ends
in any shape. A straight path is the shortest of those that cross the same triangles. Only paths in flat parts of the rest shape
are found: cloth that is curved at rest, as the body of an animal, is compressed where it moves, so that its triangles shear.
"""

import numpy as np

_FLAT = 1e-6  # ratio of height to longest side below which a triangle is left out, because rounding decides its shape
_EQUAL = 1e-9  # relative difference of lengths that are equal up to rounding
_WORTH = 1e-6  # relative gain below which no straight path is looked for; rest lengths may be rounded to float32


class UnfoldedSurface:
    """Triangles that keep their shape, each given by the lengths of its sides.

    Side 3t + k of triangle t runs from its corner k to the next one. A path crosses a side of exactly two triangles that give
    it the same length.

    Args:
        points: Rest shape (n, 3) [m]. A path leaves a vertex towards the position of its other end, as far as the triangles
            there allow. The lengths alone decide whether it gets there.
        triangles: Their vertices (T, 3).
        lengths: Lengths of their sides (T, 3) [m].
        closed: Vertices (n,); no path crosses a side between two of them.
    """

    def __init__(self, points, triangles, lengths, closed):
        c, a, b = lengths, np.roll(lengths, 1, axis=1), np.roll(lengths, -1, axis=1)
        sixteenth = 4.0 * (a * c) ** 2 - (a**2 + c**2 - b**2) ** 2  # 16 A², by Heron
        proper = (sixteenth > (2.0 * _FLAT * lengths.max(axis=1, initial=0.0)[:, None] ** 2) ** 2).all(axis=1)
        triangles, c, a, b = (each[proper] for each in (triangles, c, a, b))
        self.points, self.triangles, self._sides = points, triangles, c.ravel()
        # Where the third corner is from the start of a side, along it and across, relative to its length.
        along = 0.5 * (1.0 + (a**2 - b**2) / c**2)
        self._along, self._across = along.ravel(), np.sqrt(np.maximum((a / c) ** 2 - along**2, 0.0)).ravel()
        self._start, self._third = triangles.ravel(), np.roll(triangles, 1, axis=1).ravel()
        end = np.roll(triangles, -1, axis=1).ravel()
        self._other = self._other_sides(end, closed)
        self._corners = np.argsort(self._start, kind="stable")
        self._first = np.searchsorted(self._start[self._corners], np.arange(len(points) + 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            self._scale = np.nanmin(self._sides / self._distance(self._start, end), initial=np.inf)

    def _distance(self, a, b):
        return np.linalg.norm(self.points[b] - self.points[a], axis=1)

    def _other_sides(self, end, closed):
        """Returns the side of the triangle beyond each side (3T,), −1 where no path crosses it."""
        start = self._start
        keys = np.minimum(start, end).astype(np.int64) * len(self.points) + np.maximum(start, end)
        order = np.argsort(keys, kind="stable")
        _, first, count = np.unique(keys[order], return_index=True, return_counts=True)
        one, two = order[first[count == 2]], order[first[count == 2] + 1]
        crossed = np.abs(self._sides[one] - self._sides[two]) <= _EQUAL * self._sides[one]
        crossed &= ~(closed[start[one]] & closed[end[one]])
        other = np.full(len(start), -1)
        other[one[crossed]], other[two[crossed]] = two[crossed], one[crossed]
        return other

    def shortened(self, pairs, lengths):
        """Returns the ``lengths`` (P,) of paths between ``pairs`` (P, 2), or of straight paths if found and shorter [m]."""
        found = lengths.copy()
        longer = np.flatnonzero(lengths > (1.0 + _WORTH) * self._scale * self._distance(*pairs.T))
        rows, sides, aims = self._aims(pairs[longer])
        rows = longer[rows]
        found[rows] = np.minimum(found[rows], self._march(sides, aims, pairs[rows, 1], found[rows]))
        return found

    def _wedge(self, sides):
        """Returns the third corner (P, 2), if the side runs from the origin along the first axis."""
        return self._sides[sides, None] * np.stack([self._along[sides], self._across[sides]], axis=1)

    def _aims(self, pairs):
        """Returns (rows, sides, aims): pairs whose first vertex has triangles, the side of one where the path starts, and the
        direction (R, 2) towards the second vertex in its plane, with the side along the first axis."""
        start, end = pairs.T
        count = self._first[start + 1] - self._first[start]
        rows = np.repeat(np.arange(len(pairs)), count)
        sides = self._corners[np.arange(count.sum()) + np.repeat(self._first[start] - np.cumsum(count) + count, count)]
        x = self.points[np.roll(self.triangles, -1, axis=1).ravel()[sides]] - self.points[start[rows]]
        y = self.points[self._third[sides]] - self.points[start[rows]]
        aim = self.points[end[rows]] - self.points[start[rows]]
        xx, xy, yy, x_aim, y_aim = (np.einsum("ij,ij->i", *each) for each in ((x, x), (x, y), (y, y), (x, aim), (y, aim)))
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = np.stack([yy * x_aim - xy * y_aim, xx * y_aim - xy * x_aim], axis=1) / (xx * yy - xy**2)[:, None]
        # The triangle into which the direction points: its smaller part is the largest.
        inside = np.nan_to_num((parts * np.sqrt(np.stack([xx, yy], axis=1))).min(axis=1), nan=-np.inf)
        best = np.lexsort((-inside, rows))
        best = best[np.unique(rows[best], return_index=True)[1]]
        parts = np.maximum(parts[best], 0.0)
        rows, sides = rows[best], sides[best]
        aims = parts[:, 1:] * self._wedge(sides)
        aims[:, 0] += parts[:, 0] * self._sides[sides]
        aimed = np.isfinite(aims).all(axis=1) & aims.any(axis=1)
        return rows[aimed], sides[aimed], aims[aimed]

    def _march(self, sides, aims, targets, limits):
        """Returns the lengths (P,) of paths in the directions of the aims, infinite where they miss the target or the limit."""
        ways = np.full(len(sides), np.inf)
        left, right = self._wedge(sides), np.stack([self._sides[sides], np.zeros(len(sides))], axis=1)
        t, k = np.divmod(sides, 3)
        side = 3 * t + (k + 1) % 3
        # The vertex at the right end of the side that is crossed next.
        state = np.arange(len(sides)), self._other[side], left, right, self._start[side], aims
        while len(state[0]):
            rows, side, left, right, vertex, aim = (each[state[1] >= 0] for each in state)
            across = left - right
            with np.errstate(divide="ignore", invalid="ignore"):
                hit = right + np.clip(_turn(right, aim) / _turn(aim, across), 0.0, 1.0)[:, None] * across
            way = np.hypot(*hit.T)
            near = way < limits[rows]
            rows, side, left, right, vertex, aim, across, hit, way = (
                each[near] for each in (rows, side, left, right, vertex, aim, across, hit, way)
            )
            forward = self._start[side] == vertex
            along = np.where(forward, self._along[side], 1.0 - self._along[side])
            outward = np.stack([across[:, 1], -across[:, 0]], axis=1)
            third = right + along[:, None] * across + self._across[side, None] * outward
            there = self._third[side] == targets[rows]
            bent, straight = way + np.hypot(*(third - hit).T), np.hypot(*third.T)
            meets = there & (bent <= (1.0 + _EQUAL) * straight)
            ways[rows[meets]] = bent[meets]
            on_left = _turn(aim, third) > 0.0
            t, k = np.divmod(side, 3)
            beyond = self._other[3 * t + np.where(on_left == forward, k + 2, k + 1) % 3]
            left, right = np.where(on_left[:, None], third, left), np.where(on_left[:, None], right, third)
            vertex = np.where(on_left, vertex, self._third[side])
            state = tuple(each[~there] for each in (rows, beyond, left, right, vertex, aim))
        return ways


def _turn(a, b):
    """Returns a × b of vectors (P, 2), positive if b is on the left of a."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
