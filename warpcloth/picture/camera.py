"""A perspective camera."""

from dataclasses import dataclass

import numpy as np

from ..base.checks import array, number
from .projection import View

# Smallest half height of the picture at the nearest point of a motion, relative to the longest extent.
_CLOSEST = 0.1


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        position: Position of the camera [m].
        target: The point in the middle of the picture [m]; rays to the sky are about half as long as the picture is high there.
        up: Up direction, of any length, not along the view.
        fov: Vertical field of view [°], above 0 and below 180.
        shift: Distance of the middle of the picture to the right of the target, in heights of the picture.
        rise: That above the target.

    Raises:
        ValueError: A number is not finite or out of range, the target is at the position, or up is along the view.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fov: float = 30.0
    shift: float = 0.0
    rise: float = 0.0

    def __post_init__(self):
        for name in ("position", "target", "up"):
            object.__setattr__(self, name, tuple(array(name, getattr(self, name), (3,)).tolist()))
        number("fov", self.fov, above=0.0)
        number("shift", self.shift)
        number("rise", self.rise)
        if not self.fov < 180.0:
            raise ValueError(f"fov is {self.fov:g}; it must be below 180")
        view = np.subtract(self.target, self.position)
        if not view.any():
            raise ValueError(f"target is {self.target}, where position is; the camera must look somewhere")
        up = np.asarray(self.up)
        if not np.linalg.norm(np.cross(view, up)) > 1e-9 * np.linalg.norm(view) * np.linalg.norm(up):
            raise ValueError(f"up is {self.up}, along the view; it must point to the side of it")

    @classmethod
    def framed(cls, frames, azimuth=-38.0, elevation=24.0, up_axis="Y", aspect=16 / 9, fov=30.0, margin=0.08):
        """Returns the nearest camera from an azimuth and elevation [°], as of :class:`View`, that shows all points of some
        frames.

        Frames (n, 3) [m] are read one at a time; points that are not finite are ignored. ``aspect`` is width over height,
        ``fov`` the vertical field of view [°], ``margin`` the empty fraction on each side.

        Raises:
            ValueError: No point is finite, or a number is out of range.
        """
        number("aspect", aspect, above=0.0)
        number("fov", fov, above=0.0)
        number("margin", margin, least=0.0)
        if not (fov < 180.0 and margin < 0.5):
            raise ValueError(f"fov is {fov:g} and margin {margin:g}; they must be below 180 and 0.5")
        view = View(azimuth, elevation, up_axis)
        half = np.tan(np.radians(fov) / 2.0) * (1.0 - 2.0 * margin) * np.array([aspect, 1.0])
        # A point (x, y, z), right, up and towards a viewer at (X, Y, Z), is in the picture if |x − X| ≤ half (Z − z). So only
        # the maxima of ± x + half z over all points are needed.
        most, low, high = np.full((2, 2), -np.inf), np.full(3, np.inf), np.full(3, -np.inf)
        for points in frames:
            seen = view.project(points).reshape(-1, 3)
            seen = seen[np.isfinite(seen).all(axis=1)]
            low, high = np.minimum(low, seen.min(axis=0, initial=np.inf)), np.maximum(high, seen.max(axis=0, initial=-np.inf))
            sides = np.stack([seen[:, :2], -seen[:, :2]]) + half * seen[:, 2:]
            most = np.maximum(most, sides.max(axis=1, initial=-np.inf))
        if not (low <= high).all():
            raise ValueError("no point of the frames is finite; a camera must have something to show")
        size = (high - low).max() or 1.0
        # A motion seen along its length, or a point, must not fill the picture.
        depth = max((most.sum(axis=0) / (2.0 * half)).max(), high[2] + _CLOSEST * size / half.min())
        eye = np.append((most[0] - most[1]) / 2.0, depth)
        middle = np.append(eye[:2], (low[2] + high[2]) / 2.0)
        axes = view.project(np.eye(3))
        return cls(axes @ eye, axes @ middle, axes[:, 1], fov)

    def sun(self, up):
        """Returns the unit vector (3,) towards the sun, over the right shoulder of the camera, for ``up`` (3,) away from the
        ground.
        """
        view = np.subtract(self.target, self.position)
        right = np.cross(view, self.up)
        right /= np.linalg.norm(right)
        back = np.cross(right, up)
        if not np.linalg.norm(back) > 1e-6:  # a camera that lies on its side
            back = -view
        sun = 0.8 * right + 0.9 * back / np.linalg.norm(back) + 0.8 * np.asarray(up)
        return sun / np.linalg.norm(sun)
