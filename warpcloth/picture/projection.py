"""The view of a still: a parallel projection, and shading."""

from dataclasses import dataclass, replace

import numpy as np

from ..base.checks import array, choice, number

# Columns and signs that rotate points to y up.
_UPRIGHT = {"Y": ([0, 1, 2], [1.0, 1.0, 1.0]), "Z": ([0, 2, 1], [1.0, 1.0, -1.0])}
_MARGIN = 0.03
# Smallest ratio of the sides of a window, so that a cloth seen edge-on has a picture.
_THINNEST = 0.2


@dataclass(frozen=True)
class View:
    """A parallel projection and its visible window.

    Attributes:
        azimuth: Angle of the viewer about the vertical [°], from +z if y is up, from −y if z is.
        elevation: Angle of the viewer above the horizontal [°].
        up_axis: "Y" or "Z".
        window: (left, right, bottom, top) [m] in the picture's plane; None until :meth:`fit`.

    Raises:
        ValueError: A number is not finite, the axis is another, or the window is empty.
    """

    azimuth: float = -38.0
    elevation: float = 24.0
    up_axis: str = "Y"
    window: tuple[float, float, float, float] | None = None

    def __post_init__(self):
        number("azimuth", self.azimuth)
        number("elevation", self.elevation)
        choice("up_axis", self.up_axis, tuple(_UPRIGHT))
        if self.window is not None:
            left, right, bottom, top = array("window", self.window, (4,))
            if not (left < right and bottom < top):
                raise ValueError(f"window is {self.window}; left must be below right and bottom below top")

    def fit(self, frames):
        """Returns this view with a window that shows all points of some frames.

        Args:
            frames: Points (n, 3) of each [m], read one at a time; ones that are not finite are ignored.

        Raises:
            ValueError: No point is finite.
        """
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for points in frames:
            seen = self.project(points)[..., :2].reshape(-1, 2)
            seen = seen[np.isfinite(seen).all(axis=1)]
            low, high = np.minimum(low, seen.min(axis=0, initial=np.inf)), np.maximum(high, seen.max(axis=0, initial=-np.inf))
        if not (low <= high).all():
            raise ValueError("no point of the frames is finite; a view must have something to show")
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        half = (1.0 + _MARGIN) * np.maximum(half, _THINNEST * half.max() or 1.0)
        (left, bottom), (right, top) = (middle - half).tolist(), (middle + half).tolist()
        return replace(self, window=(left, right, bottom, top))

    def opposite(self):
        """Returns the view from the opposite side, with the same window."""
        azimuth = (self.azimuth + 360.0) % 360.0 - 180.0
        window = self.window and (-self.window[1], -self.window[0], *self.window[2:])
        return replace(self, azimuth=azimuth, elevation=-self.elevation, window=window)

    def project(self, points):
        """Returns coordinates to the right, up and towards the viewer (…, 3)."""
        a, e = np.radians([self.azimuth, self.elevation])
        towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        right = np.array([np.cos(a), 0.0, -np.sin(a)])
        columns, signs = _UPRIGHT[self.up_axis]
        upright = np.asarray(points)[..., columns] * signs
        with np.errstate(invalid="ignore"):  # of a point that is not finite every coordinate may become NaN
            return upright @ np.stack([right, np.cross(towards, right), towards], axis=1)


def brightness(corners, least):
    """Returns the brightness (T,) of triangles (T, 3, 3) in view, from ``least`` to 1, in light from the upper left, on both
    sides.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)[:, None]
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    normals *= np.where(normals[:, 2] < 0.0, -1.0, 1.0)[:, None]
    light = np.array([-0.4, 0.6, 0.7])
    return least + (1.0 - least) * np.clip(normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
