"""Crossings of cloth with itself, and with meshes among the colliders, by exact predicates."""

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.scene.colliders import turned


def crossing(points, triangles, mesh):
    """Pairs of a triangle of the cloth and one of the mesh that cross, by frames (F, n, 3), with exact predicates."""
    frames = range(len(points))
    poses, shapes = (each[np.minimum(frames, len(each) - 1)] for each in (mesh.poses, mesh.frames))
    solid = np.stack([pose[:3] + turned(pose[3:], shape) for pose, shape in zip(poses, shapes, strict=True)])
    both = np.concatenate([points, solid.astype(np.float32)], axis=1)
    found = wc.intersections(both, np.concatenate([triangles, mesh.triangles + points.shape[1]])).pairs
    return [int(((each < len(triangles)).sum(axis=1) == 1).sum()) for each in found]


def crossed(points, triangles):
    """How many pairs of triangles intersect in points as stored, by the exact predicates of libigl."""
    predicates = pytest.importorskip("igl.predicates")
    stored = np.asarray(points, dtype=np.float32).astype(np.float64)
    return len(predicates.find_self_intersections(stored, triangles.astype(np.int64))[1])
