"""The elastic energy that cloth may gain when a body pulls it from what holds it.

With w the velocity of a rigid body, the power is Σ ∇U·w over the elements between held and other vertices. For springs √U grows
by at most √(½Σk) times the body's relative way.
"""

from functools import cached_property

import numpy as np


def pulled(balance, way, held):
    """Returns the elastic energy that a body may add on its ``way`` [m] relative to ``held`` coordinates (n, 3), (B,) [J].

    ½Σk way² is the energy gained at the start if all that is not held moves by the way along these springs, summed over the
    three axes, each the mean of both senses (0.9 to 3 times too large).
    """
    model, cloth, energy = balance.model, balance.cloth, np.zeros(balance.model.copies)
    for move in way * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))]):
        points = model.scene.positions + np.where(held, 0.0, move)
        energy += (0.5 if move.any() else -3.0) * cloth.energy(cloth.put(np.tile(points, (model.copies, 1))))
    return np.maximum(energy, 0.0)


def held_coordinates(scene):
    """Returns the coordinates that forces do not move, (n, 3) booleans."""
    held = np.zeros(scene.positions.shape, dtype=bool) if scene.locked is None else scene.locked.copy()
    held[scene.fixed] = True
    return held


class Pull:
    """How a collider that moves pulls cloth.

    Pins and attachments hold their vertices. Other colliders, and the collider itself if it deforms, may hold any vertex: the
    energy is then twice that between a random half of the vertices and the rest.

    Args:
        turns: Angle of rotation in each frame, (F,).
        deforms: Maximum displacement of its points in its own frame, in each frame, (F,) [m].
    """

    def __init__(self, collider, turns, deforms, balance):
        self._balance, self._scene = balance, balance.model.scene
        self._turns, self._deforms = turns, deforms
        self._path = self._at_frames(collider.poses[:, None, :3])
        self._others = [each for each in self._scene.colliders if each is not collider]

    def energy(self, frame):
        """Returns a bound of the elastic energy added up to a frame, (B,) [J]."""
        held = held_coordinates(self._scene)
        found = pulled(self._balance, self._from_held[:frame].sum(), held)
        way = self._from_others[:frame].sum()
        if way > 0.0:
            half = np.random.default_rng(0).random((len(held), 1)) < 0.5
            found = found + 2.0 * pulled(self._balance, way, held | half)
        return found

    @cached_property
    def _from_held(self):
        """Ways relative to pins, and to other holders at their start, in each frame, (F,) [m]."""
        scene, pins = self._scene, self._scene.pins
        ways = [np.zeros(len(self._turns))]
        if len(pins.vertices):
            start = scene.positions[None, pins.vertices]
            ways.append(self._from(start if pins.keyframes is None else np.where(pins.held, pins.keyframes, start)))
        if self._balance.attached or scene.locked is not None:
            ways.append(self._from(self._box))
        return np.max(ways, axis=0)

    @cached_property
    def _from_others(self):
        """Ways relative to other colliders, where the cloth starts, (F,) [m]."""
        ways = [self._from(self._box + (poses[:, None] - poses[0])[..., :3]) for poses in (c.poses for c in self._others)]
        return np.max([self._deforms, *ways], axis=0)

    def _from(self, points):
        """Returns the largest way of its material in each frame relative to points (F or 1, m, 3) [m], (F,)."""
        points = self._at_frames(points) - self._path
        apart, radius = (np.linalg.norm(each, axis=-1) for each in (np.diff(points, axis=0), points[:-1]))
        return (apart + self._turns[:, None] * radius).max(axis=1) + self._deforms

    def _at_frames(self, keyframes):
        return keyframes[np.minimum(np.arange(len(self._turns) + 1), len(keyframes) - 1)]

    @cached_property
    def _box(self):
        ends = np.stack([self._scene.positions.min(axis=0), self._scene.positions.max(axis=0)])
        return np.stack(np.meshgrid(*ends.T), axis=-1).reshape(1, 8, 3)
