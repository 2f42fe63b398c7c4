"""Tells whether cloth that slides on colliders with friction vibrates on its contact.

Contact has no damping, so steps that do not damp keep what friction drives. In a frame of length T that moves a vertex by Δx,
w, the deviation of its velocity at the end from Δx/T, is a vibration or an acceleration: w = ½Δx/T for a start from rest.
"""

import numpy as np

from ..scene.mesh_collider import MeshCollider

# Cloth slides if this part of its mass is in contact, and frames in a row move that by this part of the contact distance on
# average, in one direction. It flutters if it slides and vibrates faster than that in this number of frames in a row:
# acceleration and impacts last for fewer.
PART, SLIDES, FRAMES = 0.25, 0.1, 6
# Up to this coefficient of friction vibrations of the belt in `benchmarks/flutter.py` grow by less than 1/s.
STEADY = 0.2


class Flutter:
    """Follows the vertices of each copy that touch colliders with friction.

    Args:
        mass: Masses of the free vertices (B, n) [kg].

    Attributes:
        first: The first frame in which each copy flutters, from 1, or 0, (B,).
        figure: RMS speed of its vibration over that of sliding, (B,).
    """

    carried = ("first", "figure", "_rows", "_points", "_near", "_moved")  # from frame to frame

    def __init__(self, model, mass):
        scene, self._mass, self._fps = model.scene, mass, model.scene.fps
        self._distance = scene.contact.distance
        self._colliders = [each for each in scene.colliders if _rubs(each)]
        self.first, self.figure, self._rows = np.zeros(len(mass), int), np.zeros(len(mass)), np.zeros(len(mass), int)
        self._points = model.in_scene_order(model.positions.numpy()).astype(np.float64).reshape(*mass.shape, 3)
        self._near, self._moved = self._touches(self._points, 0), np.zeros_like(self._points)

    def note(self, number, points, velocities, alive):
        """Notes a frame with points (B·n, 3) [m] and velocities [m/s] of the copies ``alive`` (B,)."""
        points, velocities = (each.astype(np.float64, copy=False).reshape(self._points.shape) for each in (points, velocities))
        near, moved = self._touches(points, number), self._fps * (points - self._points)
        mass = self._mass * (near & self._near)
        with np.errstate(all="ignore"):
            shakes, slides = (
                (mass * np.einsum("bij,bij->bi", *each)).sum(axis=1)
                for each in ((velocities - moved, velocities - moved), (moved, self._moved))
            )
            far = slides > mass.sum(axis=1) * (SLIDES * self._distance * self._fps) ** 2
            far &= mass.sum(axis=1) > PART * self._mass.sum(axis=1)
            self._rows = np.where(far & (shakes > slides), self._rows + 1, 0)
            news = alive & (self.first == 0) & (self._rows >= FRAMES)
            self.first, self.figure = np.where(news, number, self.first), np.where(news, np.sqrt(shakes / slides), self.figure)
        self._points, self._near, self._moved = points, near, moved

    def faults(self):
        """Returns the reasons why copies are not usable, a list of (copy, frame, sentence)."""
        remedy, found = 'take implicit Euler or integrator="bdf2", which damp it', []
        for copy in np.flatnonzero(self.first):
            frame, of_copy = int(self.first[copy]), f" of copy {copy}" if len(self.first) > 1 else ""
            why = f"cloth that slides with friction vibrates on its contact {self.figure[copy]:.2g} times as fast as it slides"
            found.append((copy, frame, f"in frame {frame}{of_copy} {why}; {remedy}"))
        return found

    def _touches(self, points, frame):
        with np.errstate(all="ignore"):
            return np.any([each.distances(points, frame) < self._distance for each in self._colliders], axis=0)


def flutter_of(stepper, mass):
    """Returns a :class:`Flutter`, or None if steps damp vibrations or no collider but meshes has much friction."""
    scene, undamped = stepper.model.scene, stepper.options.staggered or not stepper.options.damps
    return Flutter(stepper.model, mass) if undamped and any(map(_rubs, scene.colliders)) else None


def _rubs(collider):
    return collider.friction > STEADY and not isinstance(collider, MeshCollider)
