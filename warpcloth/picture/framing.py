"""The camera and the ground of a motion."""

from dataclasses import replace

import numpy as np

from .camera import Camera
from .subjects import are_located, located

# Surroundings that are larger than this, relative to the cloth, are not fitted into the picture.
_LARGE = 1.5
# Distance of the ground below the motion, relative to its size, so that cloth that lies on it is visible.
_BELOW = 1e-3
_NOTHING = "no triangle, line or pin has positions that are finite and below 1e100 m; there is nothing to draw"


def frame_motion(subjects, pictures, view, aspect):
    """Returns the camera that shows all of a motion of :class:`Subject`\\s, side by side, and the height of the ground [m].

    ``pictures`` are lists, by subject, of positions (n, 3) [m] of shapes; ``view`` is azimuth and elevation [°] and zoom.
    Raises ValueError if nothing has finite positions near enough.
    """
    azimuth, elevation, zoom = view
    up_axis = subjects[0].up_axis
    up = "YZ".index(up_axis) + 1
    lowest, span = np.inf, [np.full(3, np.inf), np.full(3, -np.inf)]
    fitted = [_fitted(each) for each in subjects]
    seen = [[seen_points(shape) for shape in each.shapes] for each in subjects]

    def frames():
        nonlocal lowest
        for picture in pictures:
            for subject, points, chosen, drawn in zip(subjects, picture, fitted, seen, strict=True):
                for index, (shape, found) in enumerate(zip(subject.shapes, points, strict=True)):
                    finite = drawn_points(shape, found, drawn[index])[0]
                    if not len(finite):
                        continue
                    lowest = min(lowest, finite[:, up].min() - (shape.radius if len(shape.lines) else 0.0))
                    if index in chosen:
                        span[0], span[1] = np.minimum(span[0], finite.min(axis=0)), np.maximum(span[1], finite.max(axis=0))
                        yield finite
        if lowest == np.inf:
            raise ValueError(f"{subjects[0].name}: {_NOTHING}")

    camera = Camera.framed(frames(), azimuth, elevation, up_axis, aspect)
    position, target = np.array(camera.position), np.array(camera.target)
    camera = replace(camera, position=tuple(target + (position - target) / zoom))
    return camera, float(lowest - _BELOW * np.linalg.norm(span[1] - span[0]))


def _fitted(subject):
    drawn = [each[seen_points(shape)] for shape, each in zip(subject.shapes, subject.read(0), strict=True)]
    finite = [located(each) for each in drawn]
    sizes = [np.linalg.norm(np.ptp(each, axis=0)) if len(each) else 0.0 for each in finite]
    return [k for k, size in enumerate(sizes) if k == subject.coloured or size <= _LARGE * sizes[subject.coloured]]


def seen_points(shape):
    """Returns the points of a shape in a triangle, line or ball."""
    return np.unique(np.concatenate([shape.triangles.ravel(), shape.lines.ravel(), shape.balls]))


def drawn_points(shape, points, seen):
    """Returns the points (m, 3) of elements of a shape whose points are all :func:`located`, and the number of others."""
    known = are_located(points)
    if known[seen].all():
        return points[seen], 0
    rows = (shape.triangles, shape.lines, shape.balls[:, None])
    kept = [each[known[each].all(axis=1)] for each in rows]
    used = np.unique(np.concatenate([each.ravel() for each in kept]))
    return points[used], sum(map(len, rows)) - sum(map(len, kept))
