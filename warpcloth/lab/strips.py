"""Strips cut from nets that are turned by any angle, and what a net makes of the bending stiffness."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay

from ..base.checks import choice, number
from ..kernels.terms.quadratic_bending import rest_state
from ..mesh.mesh import Mesh

PATTERNS = ("equilateral", "diagonal", "alternating", "jittered")
# Of the spacing: how far a vertex of a jittered net is moved at most, along either axis.
JITTER = 0.4
# Rows of a clamp, in spacings: more than the longest hinge, so that each one that bends is whole.
_CLAMP = 3.0


class Strip(NamedTuple):
    """A flat strip along x in the plane y = 0.

    Attributes:
        mesh: The :class:`warpcloth.Mesh`.
        pins: Vertices of the clamp.
        clamp: Where along x the part that bends begins [m].
        end: Where it ends [m].
    """

    mesh: Mesh
    pins: np.ndarray
    clamp: float
    end: float

    @property
    def length(self):
        """Free length [m]."""
        return self.end - self.clamp


def strip(pattern, angle, spacing, length=1.0, width=1.0):
    """A strip whose vertices up to x = 0 are clamped.

    It has the whole triangles of the net that lie within length and width. Clipped ones would be slivers and would make a
    regular net irregular, which locks; so the sides are jagged, and what a side lacks is of first order in the spacing.

    The clamp begins where the strip of a smooth cylinder that is flat as far as the pins hold it would. A hinge bends as soon
    as one of its vertices is free, so on average half its length before the last pin: the mean over hinges, weighted by their
    share in the bending energy. The end is that of the rectangle with the same area, centre and second moment.

    Args:
        pattern: "equilateral", "diagonal" or "alternating" as of :meth:`warpcloth.Mesh.grid`, or "jittered": a Delaunay
            triangulation of the equilateral net after its vertices are moved at random, the same at every call.
        angle: By which the net is turned about +y [rad]; at 45° the diagonals of "diagonal" run along the strip.
        spacing: Edge of the net [m]; of right triangles the shorter ones.
        length: Of what is not pinned [m].
        width: [m].

    Raises:
        ValueError: The pattern is unknown, or the spacing more than a quarter of length or width, where it might
            hang together by a vertex.
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

    With c and s the cosine and sine of the angle, the curvature has the components c², s² and cs in the net's own axes. At rest
    a sheet may find a softer shape: one that also twists, or in which the two kinds of vertices of "alternating" separate.
    """
    c, s = np.cos(angle), np.sin(angle)
    curvature = np.array([c * c, s * s, c * s])
    return float(curvature @ plate(pattern) @ curvature)


def plate(pattern):
    """Returns C (3, 3) of a net on a surface of curvature κ = (κ₁₁, κ₂₂, κ₁₂), with energy ½D κᵀCκ per area, however fine.

    C is AᵀA, where each row of A is the curvature that a kind of hinge measures. In an equilateral net the hinge along e
    measures κₙₙ − ⅓κₑₑ, and the three directions add up to 4/3 tr κ² − 1/3 (tr κ)²: a plate with a Poisson's ratio of −1/3. The
    other nets are not isotropic plates.
    """
    choice("pattern", pattern, PATTERNS[:3])
    rows = {
        "equilateral": [[-1 / 3, 1, 0], [2 / 3, 0, np.sqrt(4 / 3)], [2 / 3, 0, -np.sqrt(4 / 3)]],
        "diagonal": [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        "alternating": [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
    }[pattern]
    return np.transpose(rows) @ np.array(rows, dtype=float)


def roll(mesh):
    """Bending energy of each hinge of a flat mesh (H,) over D where it is curved by 1 along x."""
    rest = rest_state(mesh.points, mesh.hinges)
    height = 0.5 * mesh.points[:, 0] ** 2
    return 0.5 * np.einsum("ij,ij->i", rest[:, :4], height[mesh.hinges]) ** 2 * rest[:, 4]


def inner_shares(mesh):
    """Of each hinge (H,) how many of its two triangles have three hinges, by half; and the area of all these [m²]."""
    both = np.sort(mesh.hinges[:, [[0, 1, 2], [0, 1, 3]]], axis=2).reshape(-1, 3)
    triangles, of, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
    inner = count == 3
    return inner[of.reshape(-1, 2)].mean(axis=1), Mesh(mesh.points, triangles[inner]).triangle_areas.sum()


def _net(pattern, angle, spacing, length, width):
    """Points (n, 2) in x and z and triangles of a net that covers the strip, a vertex at the origin."""
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
    """Far end of the rectangle along x that has the area, centre and second moment of a mesh."""
    x, areas = mesh.points[mesh.triangles, 0], mesh.triangle_areas / mesh.triangle_areas.sum()
    centre = areas @ x.mean(axis=1)
    second = areas @ ((x**2).sum(axis=1) + x.sum(axis=1) ** 2) / 12.0 - centre**2
    return float(centre + np.sqrt(3.0 * second))
