"""The elastic energy that cloth may gain when a body pulls it from what holds it.

Let w be the velocity field of a rigid body. Its power on elastic cloth is Σ ∇U·w over the elements that join held vertices to
others, because rigid motion changes no other energy. For springs it is at most √(2U Σk) ‖w‖, so √U grows by at most √(½Σk)
times the way of the body relative to what is held, however the cloth moves meanwhile.
"""

from functools import cached_property

import numpy as np


def pulled(balance, way, held):
    """Returns the elastic energy that a body may add on its way, (B,) [J].

    ½Σk way² is the energy that the start gains if all that is not held moves by the way along these springs. As they have all
    directions, it is summed over the three axes, each the mean of both senses, which is 0.9 to 3 times as much.

    Args:
        balance: The :class:`warpcloth.run.balance.Balance` of the run.
        way: The way of the body relative to what is held [m].
        held: The coordinates that are held, (n, 3) booleans.
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

    Pins and attachments hold the vertices that they are of. Other colliders, and the collider itself if it deforms, may hold
    any vertex: the energy is then twice that of a random half of the vertices that leaves the other half, because half of all
    elements join the two.

    Args:
        collider: The collider.
        turns: The angles by which it rotates in each frame, (F,).
        deforms: How far a point of it moves in its own frame in each frame, (F,) [m].
        balance: The :class:`warpcloth.run.balance.Balance` of the run.
    """

    def __init__(self, collider, turns, deforms, balance):
        self._balance, self._scene = balance, balance.model.scene
        self._turns, self._deforms = turns, deforms
        self._path = self._at_frames(collider.poses[:, None, :3])
        self._others = [each for each in self._scene.colliders if each is not collider]

    def energy(self, frame):
        """Returns a bound of the elastic energy that it has added up to a frame, (B,) [J]."""
        held = held_coordinates(self._scene)
        found = pulled(self._balance, self._from_held[:frame].sum(), held)
        way = self._from_others[:frame].sum()
        if way > 0.0:
            half = np.random.default_rng(0).random((len(held), 1)) < 0.5
            found = found + 2.0 * pulled(self._balance, way, held | half)
        return found

    @cached_property
    def _from_held(self):
        """The ways in each frame relative to pins, and relative to what else holds the cloth, at its start, (F,) [m]."""
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
        """The ways in each frame relative to other colliders, where the cloth starts, (F,) [m]."""
        ways = [self._from(self._box + (poses[:, None] - poses[0])[..., :3]) for poses in (c.poses for c in self._others)]
        return np.max([self._deforms, *ways], axis=0)

    def _from(self, points):
        """Returns the largest way of its material in each frame relative to points (F or 1, m, 3) [m] that hold it, (F,)."""
        points = self._at_frames(points) - self._path
        apart, radius = (np.linalg.norm(each, axis=-1) for each in (np.diff(points, axis=0), points[:-1]))
        return (apart + self._turns[:, None] * radius).max(axis=1) + self._deforms

    def _at_frames(self, keyframes):
        """Returns keyframes at all frames; after the last they stay."""
        return keyframes[np.minimum(np.arange(len(self._turns) + 1), len(keyframes) - 1)]

    @cached_property
    def _box(self):
        """The corners of the box around the cloth at the start, (1, 8, 3) [m]."""
        ends = np.stack([self._scene.positions.min(axis=0), self._scene.positions.max(axis=0)])
        return np.stack(np.meshgrid(*ends.T), axis=-1).reshape(1, 8, 3)
