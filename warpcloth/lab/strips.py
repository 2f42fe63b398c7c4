"""Strips cut from rotated nets, and the bending stiffness of nets."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay

from ..base.checks import choice, number
from ..kernels.terms.quadratic_bending import rest_state
from ..mesh.mesh import Mesh

PATTERNS = ("equilateral", "diagonal", "alternating", "jittered")
# Largest displacement of a vertex of a jittered net along each axis, relative to the spacing.
JITTER = 0.4
# Length of a clamp in spacings, longer than the longest hinge, so that all bending hinges are complete.
_CLAMP = 3.0


class Strip(NamedTuple):
    """A flat strip along x in the plane y = 0, with vertices of the clamp, and x where the bending part begins and ends [m]."""

    mesh: Mesh
    pins: np.ndarray
    clamp: float
    end: float

    @property
    def length(self):
        return self.end - self.clamp


def strip(pattern, angle, spacing, length=1.0, width=1.0):
    """Returns a strip whose vertices up to x = 0 are clamped.

    It has all triangles of the net that are inside length and width, because clipped ones would be slivers and lock. So the
    sides are jagged, with an error of first order in the spacing.

    ``clamp`` is where an equivalent smooth strip would begin to bend. A hinge bends if one of its vertices is free, on average
    half its length before the last pin; ``clamp`` is the mean over hinges, weighted by bending energy. The end is that of the
    rectangle with the same area, centre and second moment.

    Args:
        pattern: "equilateral", "diagonal" or "alternating" as for :meth:`warpcloth.Mesh.grid`, or "jittered": a Delaunay
            triangulation of the equilateral net with random displacements, equal in every call.
        angle: Rotation of the net about +y [rad].
        spacing: Edge length of the net [m]; for right triangles, that of the shorter edges.
        length: Length of the free part [m].
        width: Width [m].

    Raises:
        ValueError: The pattern is unknown, or the spacing is more than a quarter of length or width.
    """
    points, triangles = _net(pattern, angle, spacing, length, width)
    near = 1e-9 * length
    low, high = np.array([-_CLAMP * spacing, -width / 2]), np.array([length, width / 2])
    inside = ((points > low - near) & (points < high + near)).all(axis=1)
    triangles = triangles[inside[triangles].all(axis=1)]
    used, triangles = np.unique(triangles, return_inverse=True)
    x, z = points[used].T
    mesh = Mesh(np.stack([x, np.zeros_like(x), z], axis=1), triangles.reshape(-1, 3))
    pinned = x <= near
    energy = roll(mesh)
    extent = np.ptp(x[mesh.hinges], axis=1)
    clamp = (x[pinned].max() + x[~pinned].min()) / 2.0 - (energy * extent).sum() / energy.sum() / 2.0
    return Strip(mesh, np.flatnonzero(pinned), clamp, _end(mesh))


def rolled(pattern, angle):
    """Computes the stiffness, divided by D, of a net that is rolled to a cylinder, however fine it is.

    The curvature has the components c², s² and cs in the net's own axes. At rest a sheet may find a softer shape, which also
    twists, or in which the two kinds of vertices of "alternating" separate.
    """
    c, s = np.cos(angle), np.sin(angle)
    curvature = np.array([c * c, s * s, c * s])
    return float(curvature @ plate(pattern) @ curvature)


def plate(pattern):
    """Returns C (3, 3) of a net on a surface of curvature κ = (κ₁₁, κ₂₂, κ₁₂), with energy ½D κᵀCκ per area, however fine.

    C is AᵀA, where each row of A is the curvature that a kind of hinge measures. In an equilateral net the hinge along e
    measures κₙₙ − ⅓κₑₑ, and the three directions add up to 4/3 tr κ² − 1/3 (tr κ)²: a plate with ν = −1/3. The other nets are
    not isotropic plates.
    """
    choice("pattern", pattern, PATTERNS[:3])
    rows = {
        "equilateral": [[-1 / 3, 1, 0], [2 / 3, 0, np.sqrt(4 / 3)], [2 / 3, 0, -np.sqrt(4 / 3)]],
        "diagonal": [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        "alternating": [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
    }[pattern]
    return np.transpose(rows) @ np.array(rows, dtype=float)


def roll(mesh):
    """Returns the bending energy of each hinge of a flat mesh (H,) over D, for a curvature of 1/m along x."""
    rest = rest_state(mesh.points, mesh.hinges)
    height = 0.5 * mesh.points[:, 0] ** 2
    return 0.5 * np.einsum("ij,ij->i", rest[:, :4], height[mesh.hinges]) ** 2 * rest[:, 4]


def inner_shares(mesh):
    """Returns, for each hinge (H,), half the number of its triangles that have three hinges; and the area of these [m²]."""
    both = np.sort(mesh.hinges[:, [[0, 1, 2], [0, 1, 3]]], axis=2).reshape(-1, 3)
    triangles, of, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
    inner = count == 3
    return inner[of.reshape(-1, 2)].mean(axis=1), Mesh(mesh.points, triangles[inner]).triangle_areas.sum()


def _net(pattern, angle, spacing, length, width):
    choice("pattern", pattern, PATTERNS)
    number("angle", angle)
    number("spacing", spacing, above=0.0)
    number("length", length, above=0.0)
    number("width", width, above=0.0)
    if spacing > (1.0 + 1e-9) * min(length, width) / 4.0:
        raise ValueError(f"spacing is {spacing:g}; it must be at most a quarter of length {length:g} and width {width:g}")
    rows = int(np.ceil(np.hypot(length, width) / (np.sqrt(0.75) * spacing))) + 4
    size = 2 * rows * spacing
    grid = Mesh.grid(2 * rows + 1, 2 * rows + 1, size, "equilateral" if pattern == "jittered" else pattern)
    points = (grid.points - grid.points[rows * (2 * rows + 2)])[:, [0, 2]]
    c, s = np.cos(angle), np.sin(angle)
    points = points @ np.array([[c, -s], [s, c]])
    if pattern != "jittered":
        return points, grid.triangles
    points = points + spacing * np.random.default_rng(0).uniform(-JITTER, JITTER, points.shape)
    return points, Delaunay(points).simplices[:, ::-1]


def _end(mesh):
    x, areas = mesh.points[mesh.triangles, 0], mesh.triangle_areas / mesh.triangle_areas.sum()
    centre = areas @ x.mean(axis=1)
    second = areas @ ((x**2).sum(axis=1) + x.sum(axis=1) ** 2) / 12.0 - centre**2
    return float(centre + np.sqrt(3.0 * second))
