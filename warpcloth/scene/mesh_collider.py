"""Triangle meshes as colliders."""

from dataclasses import MISSING, dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..base.checks import numeric
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..base.types import Converted, default
from ..kernels import nearest
from ..mesh.distances import nearest_weights
from ..mesh.mesh import Mesh, areas_of
from .colliders import Collider, turned

_FLAT = 1e-6  # volume below which a closed surface is a sheet, relative to the cube of its size
_THIN = 0.02  # thickness below which fronts that face inwards are those of a sheet, relative to a length of it


@dataclass(frozen=True, eq=False)
class MeshCollider(Collider):
    """A triangle mesh, rigid or deforming.

    A closed surface that encloses a volume is solid behind the fronts of its triangles. Any other is a sheet without thickness,
    which collides on both sides. Vertices at one position in all frames are merged; at frames with all vertices at one
    position, the collider is absent.

    Attributes:
        points: Vertices in the frame of the collider, (n, 3), or at frames 0 … F−1 (F, n, 3) [m], linear between, constant
            after.
        triangles: Vertices of each triangle (T, 3), counter-clockwise from the front.

    Raises:
        ValueError: A value is not allowed.

    Examples:
        >>> import warpcloth as wc
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> tetrahedron = wc.MeshCollider(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], friction=0.3)
        >>> tetrahedron.closed, tetrahedron.distances([[0.1, 0.1, -0.5], [0.1, 0.1, 0.05]]).tolist()
        (True, [0.5, -0.05])
    """

    is_mesh: ClassVar[bool] = True

    points: Converted[ArrayLike, np.ndarray] = default(MISSING)
    triangles: Converted[ArrayLike, np.ndarray] = default(MISSING)

    def __post_init__(self) -> None:
        super().__post_init__()
        points = numeric(f"{self.label}.points", self.points, "have shape (n, 3) or (F, n, 3)")
        if points.ndim not in (2, 3) or points.shape[-1] != 3 or not points.size:
            raise ValueError(f"{self.label}.points has shape {points.shape}; it must be (n, 3) or (F, n, 3), F and n 1 or more")
        bad = np.argwhere(~np.isfinite(points))
        if len(bad):
            index = ", ".join(map(str, bad[0]))
            raise ValueError(f"{self.label}.points[{index}] is {points[tuple(bad[0])]}; it must be finite")
        try:
            mesh = Mesh(first_extended(points), self.triangles)
        except ValueError as error:
            raise ValueError(f"{self.label}.{error}") from None
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "triangles", mesh.triangles)
        self._refuse_turned_over()

    def _refuse_turned_over(self):
        if len(self.frames) == 1 or not self.closed:
            return
        found = np.array([self._filling(vertices) for vertices in self.frames])
        sides = np.sign(found) * (np.abs(found) > _FLAT)  # flat ones have none
        first = np.argmax(sides != 0)
        for frame in np.flatnonzero(sides * sides[first] < 0)[:1]:
            raise ValueError(
                f"{self.label}.points[{frame}] is points[{first}] turned inside out; what is outside must stay outside"
            )

    def _filling(self, vertices):
        """Returns its volume over its cubed size, negative if fronts face inwards."""
        a, b, c = (vertices - vertices.mean(axis=0))[self.triangles].transpose(1, 0, 2)
        size = np.ptp(vertices, axis=0).max()
        return np.einsum("ti,ti", a, np.cross(b, c)) / (6.0 * size**3) if size else 0.0

    @property
    def frames(self) -> np.ndarray:
        """Its vertices at each keyframe, (F, n, 3) [m]; F = 1 if it is rigid."""
        return self.points.reshape(-1, *self.points.shape[-2:])

    @property
    def bounds(self) -> tuple[np.ndarray, float]:
        return np.abs(self.frames).max(axis=(0, 1)), 0.0

    @property
    def extent(self) -> float:
        return float(np.linalg.norm(self.frames, axis=-1).max())

    @property
    def deforms(self) -> np.ndarray:
        return np.linalg.norm(np.diff(self.frames, axis=0), axis=-1).max(axis=-1, initial=0.0)

    @property
    def moves(self) -> bool:
        return super().moves or len(self.frames) > 1

    def at_last(self) -> "MeshCollider":
        position, rotation = np.atleast_2d(self.position)[-1], np.atleast_2d(self.rotation)[-1]
        return replace(self, position=position, rotation=rotation, points=self.frames[-1])

    def centred(self) -> "MeshCollider":
        poses, frames = self.poses, self.frames
        centre = 0.5 * (frames.min(axis=(0, 1)) + frames.max(axis=(0, 1)))
        position = [pose[:3] + turned(pose[3:], centre) for pose in poses]
        return replace(self, points=self.points - centre, position=position, rotation=poses[:, 3:])

    @cached_property
    def welded(self) -> np.ndarray:
        """The triangles with one index for each position."""
        rows = np.ascontiguousarray(self.frames.transpose(1, 0, 2).reshape(self.frames.shape[1], -1) + 0.0)
        _, index = np.unique(rows.view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel(), return_inverse=True)
        return index.ravel()[self.triangles]

    @cached_property
    def closed(self) -> bool:
        """Whether it encloses a volume and each side of a triangle is matched by a reversed one."""
        forth, back = self._directed_sides
        return np.array_equal(forth, back) and any(abs(self._filling(vertices)) > _FLAT for vertices in self.frames)

    @cached_property
    def _directed_sides(self):
        sides = self.welded[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return [np.sort(each @ [sides.max() + 1, 1]) for each in (sides, sides[:, ::-1])]

    @cached_property
    def _doubled(self):
        return bool((np.diff(self._directed_sides[0]) == 0).any())

    @cached_property
    def faces_inwards(self) -> bool:
        """Whether it is closed with its fronts inwards, so that all else is solid.

        The thin volume between a front and a back with other diagonals does not count.
        """
        vertices = first_extended(self.frames)
        size, corners = np.ptp(vertices, axis=0).max(), vertices[self.triangles]
        thickness = -2.0 * self._filling(vertices) * size**3 / areas_of(vertices, self.triangles).sum()
        length = size if self._doubled else np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min()
        return bool(self.closed and thickness > _THIN * length)

    @cached_property
    def _uncovered(self):
        at = self.welded.argmin(axis=1)[:, None]
        second, third = (np.take_along_axis(self.welded, (at + k) % 3, axis=1)[:, 0] for k in (1, 2))
        turns = np.where(second < third, 1, -1)
        _, first, which = np.unique(np.sort(self.welded, axis=1), axis=0, return_index=True, return_inverse=True)
        times = np.bincount(which.ravel(), turns).astype(int) * turns[first]
        found = np.where((times < 0)[:, None], self.triangles[first, ::-1], self.triangles[first])
        return np.repeat(found, np.abs(times), axis=0)

    def distances(self, points: np.ndarray, frame: int = 0) -> np.ndarray:
        """Distances (…,) [m] of points (…, 3) [m] to the surface at a frame, negative inside a closed one.

        Of triangles that float32 finds equally near, it may take either.
        """
        points = np.asarray(points, dtype=np.float64)
        away, vertices, faces, weights = self._away(points.reshape(-1, 3), frame)
        found = np.linalg.norm(away, axis=1)
        if self.closed:
            behind = np.einsum("ki,ki->k", away, self._normals(vertices, faces, weights)) < 0.0
            if self._doubled and not self.faces_inwards:  # normals are of no use where a front and a back coincide
                nearest = np.einsum("kc,kci->ki", weights[behind], vertices[self.triangles[faces[behind]]])
                behind[behind] = winding_numbers(away[behind] + nearest, vertices[self._uncovered]) > 0.5
            found = np.where(behind, -found, found)  # one that has shrunk to a point has no normals, and nothing is behind
        return found.reshape(points.shape[:-1])

    def is_near(self, points: np.ndarray, distance: float, frame: int = 0) -> bool:
        """Returns whether one of points (n, 3) [m] is nearer than a distance [m] at a frame."""
        pose, vertices = (each[min(frame, len(each) - 1)] for each in (self.poses, self.frames))
        local = (points - pose[:3]) @ turned(pose[3:], np.eye(3)).T
        within = np.abs(local - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))) < 0.5 * np.ptp(vertices, axis=0) + distance
        within = within.all(axis=1)  # of its box
        return bool(within.any() and np.linalg.norm(self._away(points[within], frame)[0], axis=1).min() < distance)

    def _away(self, points, frame):
        """From the nearest points of the surface, in its frame; its vertices, and faces and weights of these."""
        pose = self.poses[min(frame, len(self.poses) - 1)]
        local = turned(pose[3:] * [-1.0, -1.0, -1.0, 1.0], points - pose[:3])
        vertices = self.frames[min(frame, len(self.frames) - 1)]
        faces, weights = nearest_points(local, vertices, self.triangles)
        return local - np.einsum("kc,kci->ki", weights, vertices[self.triangles[faces]]), vertices, faces, weights

    def _normals(self, vertices, faces, weights):
        """Normals of the face, side or corner of the nearest points of faces (k,), (k, 3).

        Sides and corners sum those of their triangles by angles (Bærentzen and Aanæs 2005, *Signed distance computation using
        the angle weighted pseudonormal*).
        """
        corners = vertices[self.triangles]
        ahead, behind = (np.roll(corners, shift, axis=1) - corners for shift in (-1, 1))
        cross = np.cross(ahead, behind)
        size = np.linalg.norm(cross, axis=2)
        angles = np.arctan2(size, np.einsum("tci,tci->tc", ahead, behind))
        flat = cross[:, 0] / np.maximum(size[:, :1], 1e-300)
        at_corners = np.zeros((self.welded.max() + 1, 3))
        np.add.at(at_corners, self.welded, angles[..., None] * flat[:, None])
        sides = np.sort(np.stack([np.roll(self.welded, -1, axis=1), np.roll(self.welded, 1, axis=1)], axis=2), axis=2)
        _, side = np.unique(sides @ [len(at_corners), 1], return_inverse=True)
        side = side.reshape(-1, 3)  # of each triangle that opposite to each corner
        at_sides = np.zeros((side.max() + 1, 3))
        np.add.at(at_sides, side, np.repeat(flat[:, None], 3, axis=1))
        zero = weights == 0.0
        at_corner, at_side = zero.sum(axis=1) == 2, zero.sum(axis=1) == 1
        found = flat[faces]
        found[at_side] = at_sides[side[faces[at_side], np.argmax(zero[at_side], axis=1)]]
        found[at_corner] = at_corners[self.welded[faces[at_corner], np.argmin(zero[at_corner], axis=1)]]
        return found


def first_extended(points):
    """The first of points (F, n, 3) not all at one position, or points (n, 3)."""
    frames = points.reshape(-1, *points.shape[-2:])
    return frames[np.argmax(np.ptp(frames, axis=1).any(axis=1))]


def winding_numbers(points, corners):
    """How often triangles (T, 3, 3) enclose points (k, 3), (k,): their solid angles over 4π (van Oosterom and Strackee 1983,
    *The solid angle of a plane triangle*).
    """
    found = np.empty(len(points))
    rows = max(1, 1_000_000 // len(corners))
    for first in range(0, len(points), rows):
        a, b, c = (corners - points[first : first + rows, None, None]).transpose(2, 0, 1, 3)
        la, lb, lc = (np.linalg.norm(each, axis=2) for each in (a, b, c))
        ab, bc, ca = (np.einsum("kti,kti->kt", *each) for each in ((a, b), (b, c), (c, a)))
        triple = np.einsum("kti,kti->kt", a, np.cross(b, c))
        found[first : first + rows] = np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2.0 * np.pi)
    return found


def nearest_points(points, vertices, triangles):
    """The nearest triangle (k,) to points (k, 3), in float32, and weights (k, 3) of the nearest point."""
    faces = _nearest_faces(points, vertices, triangles)
    return faces, nearest_weights(points, vertices[triangles[faces]])


@in_turn
def _nearest_faces(points, vertices, triangles):
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    scale = 1.0 / max(np.abs(vertices - centre).max(), np.abs(points - centre).max(initial=0.0))
    with wp.ScopedDevice(find_device("cpu")):
        mesh = wp.Mesh(wp.array((vertices - centre) * scale, dtype=wp.vec3), wp.array(triangles.ravel(), dtype=wp.int32))
        out = wp.zeros(len(points), dtype=wp.int32)
        local: wp.array = wp.array((points - centre) * scale, dtype=wp.vec3)
        wp.launch(nearest.faces(), len(points), inputs=[mesh.id, local], outputs=[out])
        return out.numpy()
