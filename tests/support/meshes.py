"""Small meshes that several tests need."""

import numpy as np
from scipy.spatial import Delaunay

import warpcloth as wc

PAIR = wc.Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), edges=[[0, 1]])


def kite(apex):
    """Two triangles with that angle [°] opposite the edge (0, 1) that they share."""
    height = 0.5 / np.tan(np.radians(apex / 2))
    return wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [0.5, height, 0], [0.5, -height, 0]], [[0, 1, 2], [1, 0, 3]])


def leaf(height, other_diagonals=False, n=6):
    """A grid whose height is given by a function, with a back at the same points."""
    front = wc.Mesh.grid(n, n, pattern="diagonal")
    points = np.array(front.points) - [0.5, 0.0, 0.5]
    points[:, 1] = height(points[:, 0], points[:, 2])
    back = np.array(front.triangles)[:, ::-1]
    if other_diagonals:
        quads = back.reshape(-1, 2, 3)
        a, c, d, b = quads[:, 0, 2], quads[:, 0, 1], quads[:, 0, 0], quads[:, 1, 0]
        back = np.stack([a, b, c, b, d, c], axis=1).reshape(-1, 3)
    return np.concatenate([points, points]), np.concatenate([front.triangles, back + len(points)])


def disc(n, first):
    """A disc of n corners whose front and back are fans, from the corners 0 and ``first``."""
    angles, around = 2.0 * np.pi * np.arange(n) / n, np.roll(np.arange(n), -first)
    points = 0.4 * np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1)
    fan = np.array([(0, k + 1, k) for k in range(1, n - 1)])
    return np.concatenate([points, points]), np.concatenate([fan, around[fan][:, ::-1] + n])


def joined(*parts):
    """Several meshes as one, each (points, triangles)."""
    firsts = np.cumsum([0, *(len(points) for points, _ in parts)])
    triangles = [triangles + first for (_, triangles), first in zip(parts, firsts, strict=False)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


def delaunay(points):
    """A flat mesh of points (n, 2) in x and z, without the slivers on the outline."""
    triangles = Delaunay(points).simplices
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    areas = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    return wc.Mesh(np.insert(points, 1, 0.0, axis=1), triangles[areas > 1e-3 * np.median(areas)])


def rolled(points, radius, degrees=0.0):
    """Rolled up along the direction at an angle to x, (n, 3): an isometry of the plane y = 0."""
    across, up = np.array([np.cos(np.radians(degrees)), 0.0, np.sin(np.radians(degrees))]), np.array([0.0, 1.0, 0.0])
    along, arc = np.cross(across, up), (points @ across)[:, None]
    return radius * (np.sin(arc / radius) * across + (1.0 - np.cos(arc / radius)) * up) + (points @ along)[:, None] * along


def irregular(nx=7, ny=6, size=1.0):
    """A flat jittered sheet in the plane y = 0; its outline stays a rectangle."""
    grid = wc.Mesh.grid(nx, ny, size=size, pattern="alternating")
    jitter = np.random.default_rng(0).uniform(-0.25, 0.25, (nx * ny, 3)) * np.divide(size, (nx - 1, ny - 1)).mean()
    jitter[:, 1] = 0.0
    jitter[grid.boundary] = 0.0
    return wc.Mesh(grid.points + jitter, grid.triangles)
