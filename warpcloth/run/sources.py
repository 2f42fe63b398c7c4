"""Sources of energy for a cloth: upper bounds of what the start, pins, loads and colliders add, as docs/stability.md states.

A part of a scene that adds energy registers a function for its type with ``source_of.register``.
"""

from functools import cached_property, singledispatch

import numpy as np

from ..numerics.rotation import kabsch
from ..scene.air import Air
from ..scene.colliders import Collider
from ..scene.scene import Pins
from ..solvers.solver import Stepper
from ..terms.loads import Loads
from .pulling import Pull, held_coordinates, pulled

# If there are more patches of pins than this, all pins are treated as one patch.
_PATCHES = 32
# Gaps are rounding errors if moving each coordinate by one such error adds this many times Σ gap². It adds 12 times or more
# where the cloth of a scene starts at rest, and 4.5 times to a chain of 80 springs that starts longer by 3e-6.
_ROUNDED = 8.0


class Source:
    """A source of energy for a cloth, in upper bounds.

    Attributes:
        name: Its name in messages.
        carried: Names of attributes that change from frame to frame, for checkpoints.
    """

    name = "a source"
    carried: tuple[str, ...] = ()

    def energy(self, frame, speed):
        """Returns the energy added up to a frame, (B,) [J]; called for each frame in order from 1.

        ``speed`` is the maximum RMS speed of each copy so far, plus the speed that falling adds in a frame, (B,) [m/s].
        """
        return 0.0

    def speed(self, frame):
        """Returns the speed at which it moves the whole cloth in a frame [m/s]."""
        return 0.0

    def stored(self, frame):
        """Returns further added energy, (B,) [J]; costly, so called only if the rest does not suffice."""
        return 0.0


@singledispatch
def source_of(part, balance, stepper):
    """Returns the :class:`Source` that a part of a scene is, or None."""


@source_of.register(Stepper)
class Start(Source):
    """Kinetic, elastic and contact energy at the start, and that of closing the gaps of constraints in one step.

    Soft constraints count for solvers whose sweeps may close them (``closes``). A chain of N moves its end by up to Σ gap ≤ √(N
    Σ gap²); midpoint or a relaxation of 2 doubles the speed.
    """

    name = "the start"

    def __init__(self, stepper, balance, _stepper):
        model, elastic = balance.model, balance.elastic
        closed = elastic.hard + (elastic.soft if stepper.options.closes else ())
        velocities = model.in_scene_order(model.velocities.numpy()).astype(np.float64)
        self._energy = balance.kinetic(velocities) + elastic.energy(model.positions)
        gaps = self._of_chains(model, elastic, closed)
        if stepper.pairs is not None:
            energy, of_pairs = stepper.pairs.at_start()
            self._energy += energy
            gaps = gaps + stepper.options.closes * of_pairs
        self._energy += 4.0 * balance.total * gaps / stepper.he**2

    @staticmethod
    def _of_chains(model, elastic, closed):
        """Returns ½N Σ gap² of constraints at the start (B,) [m²], with N = 1 for gaps of rounding."""
        gaps = elastic.gaps(model.positions, closed)
        points = model.in_scene_order(model.positions.numpy()).astype(np.float64)
        rounding = np.finfo(model.numpy_dtype).eps * points * np.random.default_rng(0).choice([-1.0, 1.0], points.shape)
        more = elastic.gaps(elastic.put(points + rounding), closed) - gaps
        return np.where(more > _ROUNDED * gaps, 1, sum(elements.per_copy for elements in closed)) * gaps

    def energy(self, frame, speed):
        return self._energy


class MovingPins(Source):
    """Pins that keyframes move; those joined by edges form a patch, with which the cloth may move as a rigid body.

    A change δ of the speed of a patch adds at most ½δ² + δ·speed per unit mass. Patches that move relative to one another store
    at most the energy of the start deformed by the mean of their motions, with weights 1/distance².
    """

    name = "moving pins"
    carried = ("_stored", "_seen", "_kicked")

    def __init__(self, balance):
        scene, self._balance = balance.model.scene, balance
        self._stored, self._seen = np.zeros(balance.model.copies), 0
        self._kicked, pins = 0.0, scene.pins
        self._points, self._frames = scene.positions, np.where(pins.held, pins.keyframes, pins.keyframes[:1])
        self._patches = self._found()
        share = np.where(np.isin(np.arange(len(self._points)), pins.clamped), 0.0, scene.vertex_masses)
        share = share / share.sum() if share.any() else share
        points = np.column_stack([self._points, np.ones(len(self._points))])
        spread, middle = (share[:, None] * points).T @ points, share @ points
        speeds, kicks, rises = [], [], []
        for patch, maps in zip(self._patches, self._maps, strict=True):
            beside = self._frames[:, patch] - np.einsum("fij,pj->fpi", maps, points[pins.vertices[patch]])
            moves, own = (np.diff(each, axis=0, prepend=each[:1], append=each[-1:]) for each in (maps, beside))
            turns, own_turns = (np.diff(each, axis=0, prepend=0.0 * each[:1]) for each in (moves, own))
            for found, of_maps, of_pins in ((speeds, moves, own), (kicks, turns, own_turns)):
                mean = np.sqrt(np.maximum(np.einsum("fij,jk,fik->f", of_maps, spread, of_maps), 0.0))
                found.append(scene.fps * (mean + np.linalg.norm(of_pins, axis=-1).max(axis=1)))
            rises.append(maps - maps[0])
        self._speeds, self._kicks = np.max(speeds, axis=0), np.max(kicks, axis=0)
        pull = np.einsum("b,bi,j->bij", balance.total, balance.gravity, middle)
        if balance.loads is not None:
            pull = pull + np.einsum("bni,nj->bij", balance.loads, points)
        heights = np.max(-np.einsum("pfij,bij->pfb", np.array(rises), pull), axis=0)
        self._lifted = np.maximum.accumulate(np.maximum(heights, 0.0))

    def _found(self):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        scene = self._balance.model.scene
        vertices, n = scene.pins.vertices, len(scene.mesh.points)
        pin = np.full(n, -1)
        pin[vertices] = np.arange(len(vertices))
        a, b = pin[scene.mesh.edges.T]
        joined = (a >= 0) & (b >= 0)
        graph = coo_array((np.ones(joined.sum()), (a[joined], b[joined])), shape=(len(vertices), len(vertices)))
        count, labels = connected_components(graph, directed=False)
        return [np.arange(len(vertices))] if count > _PATCHES else [np.flatnonzero(labels == k) for k in range(count)]

    @cached_property
    def _maps(self):
        """Rigid motion of each patch since the start, as affine maps (F, 3, 4)."""
        found = []
        for patch in self._patches:
            frames = self._frames[:, patch]
            turned = np.asarray(kabsch(frames[0], frames))
            middles = frames.mean(axis=1)
            found.append(np.concatenate([turned, (middles - turned @ middles[0])[:, :, None]], axis=-1))
        return found

    @cached_property
    def _weights(self):
        from scipy.spatial import cKDTree

        pins = self._points[self._balance.model.scene.pins.vertices]
        distances = np.stack([cKDTree(pins[patch]).query(self._points)[0] for patch in self._patches], axis=1)
        weights = np.maximum(distances, 1e-9 * np.ptp(self._points, axis=0).max()) ** -2.0
        return weights / weights.sum(axis=1, keepdims=True)

    def energy(self, frame, speed):
        kick, total = self._kicks[frame] if frame < len(self._kicks) else 0.0, self._balance.total
        self._kicked = self._kicked + total * kick * (speed + self.speed(frame) + 0.5 * kick)
        return self._kicked + self._lifted[min(frame, len(self._lifted) - 1)]

    def speed(self, frame):
        return self._speeds[frame] if frame < len(self._speeds) else 0.0

    def stored(self, frame):
        cloth, scene, pins = self._balance.cloth, self._balance.model.scene, self._balance.model.scene.pins.vertices
        while self._seen < min(frame, len(self._frames) - 1):
            self._seen += 1
            moved = np.zeros_like(self._points)
            for weight, maps in zip(self._weights.T, self._maps, strict=True):
                matrix = maps[self._seen]
                moved += weight[:, None] * (self._points @ matrix[:, :3].T + matrix[:, 3])
            moved[pins] = self._frames[self._seen]
            x = cloth.put(np.tile(moved, (self._balance.model.copies, 1)))
            self._stored = np.maximum(self._stored, cloth.energy(x))
        if not scene.colliders:
            return self._stored
        way = np.linalg.norm(np.diff(self._frames[: frame + 1], axis=0), axis=-1).max(axis=1).sum()
        return np.maximum(self._stored, pulled(self._balance, way, held_coordinates(scene)))


class DrivenLoads(Source):
    """Loads that change or follow the cloth, and all loads on a free cloth: in a frame at most ½δ² + δ·speed per unit mass, δ =
    (Σ f²/m / Σ m)^½/fps.
    """

    name = "loads"
    carried = ("_given",)

    def __init__(self, balance):
        model, loads = balance.model, balance.model.loads
        self._balance, self._given = balance, np.zeros(model.copies)
        vertices = loads.dead.vertices.numpy()
        vertices = vertices if model.order is None else model.order[vertices]
        self._dead = np.linalg.norm(loads.dead.keyframes.numpy().astype(np.float64), axis=-1)
        self._vertices, mass = vertices, balance.mass[:, vertices]
        self._inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0)
        self._triangles = self._pressure = None
        if loads.follows:
            triangles = loads.pressed.triangles.numpy()
            self._triangles = triangles if model.order is None else model.order[triangles]
            self._pressure = np.abs(loads.pressed.keyframes.numpy().astype(np.float64))

    def energy(self, frame, speed):
        balance = self._balance
        force = self._during(self._dead, frame)
        if self._triangles is not None:
            a, b, c = np.moveaxis(balance.points.reshape(*balance.mass.shape, 3)[:, self._triangles], 2, 0)
            pull = self._during(self._pressure, frame) * np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6.0
            at = np.zeros(balance.mass.shape)
            for corner in self._triangles.T:
                np.add.at(at, (slice(None), corner), pull)
            force = force + at[:, self._vertices]
        total = np.where(balance.total > 0.0, balance.total, 1.0)
        kick = np.sqrt((force**2 * self._inverse).sum(axis=1) / total) / balance.model.scene.fps
        self._given = self._given + balance.total * kick * (speed + 0.5 * kick)
        return self._given

    @staticmethod
    def _during(values, frame):
        last = len(values) - 1
        return np.maximum(values[min(frame - 1, last)], values[min(frame, last)])


@source_of.register
def _loaded(loads: Loads, balance, _stepper):
    held = loads and balance.model.loads.constant is not None and not balance.free
    return DrivenLoads(balance) if loads and not held else None


def common_velocity(scene):
    """Returns the common velocity (3,) [m/s] of all pins and colliders; 0 if there is none."""
    moves, frames = [], scene.frames
    for collider in scene.colliders:
        poses = collider.poses
        if np.ptp(poses[:, 3:], axis=0).any() or collider.deforms.any() or 1 < len(poses) <= frames:
            return np.zeros(3)
        moves.append(np.diff(poses[: frames + 1, :3], axis=0) if len(poses) > 1 else np.zeros((1, 3)))
    if len(scene.pins.vertices):
        keyframes = scene.pins.keyframes
        if keyframes is not None and (len(keyframes) <= frames or not scene.pins.held.all()):
            return np.zeros(3)
        moves.append(np.zeros((1, 3)) if keyframes is None else np.diff(keyframes[: frames + 1], axis=0).reshape(-1, 3))
    if not moves or scene.air_terms:
        return np.zeros(3)
    velocities = scene.fps * np.concatenate(moves)
    mean = velocities.mean(axis=0)
    # Keyframes are sums or products of doubles, and lose some units in the last place of the largest position.
    lost = 16.0 * np.finfo(np.float64).eps * np.abs(velocities).max() * (frames + 1)
    return mean if np.abs(velocities - mean).max() <= lost else np.zeros(3)


@source_of.register
def _moving(pins: Pins, balance, _stepper):
    return MovingPins(balance) if pins.moves else None


@source_of.register(Collider)
def moving_collider(collider, balance, stepper):
    return MovingCollider(collider, balance) if collider.moves else None


class MovingCollider(Source):
    """A collider that keyframes move: at a surface speed V it may give each vertex 2V, move it by V over the frame rate, and
    pull the cloth.
    """

    name = "moving colliders"

    def __init__(self, collider, balance):
        scene, self._balance = balance.model.scene, balance
        poses, extent = collider.poses, collider.extent
        if not np.isfinite(extent):
            extent = np.linalg.norm(scene.positions - poses[0, :3], axis=1).max() + np.ptp(scene.positions, axis=0).max()
        turns = 2.0 * np.arccos(np.clip(np.abs((poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1)), 0.0, 1.0))
        moves = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) + extent * turns
        frames = max(scene.frames, len(moves), len(collider.deforms))
        moves, turns, deforms = (np.append(each, np.zeros(frames - len(each))) for each in (moves, turns, collider.deforms))
        moves += deforms
        self._pull = Pull(collider, turns, deforms, balance)
        self._speeds = np.append(0.0, scene.fps * moves)
        self._lifts = np.cumsum(np.append(0.0, moves))
        self._weight = balance.total * np.linalg.norm(balance.gravity, axis=1)
        if balance.loads is not None:
            self._weight = self._weight + np.linalg.norm(balance.loads, axis=2).sum(axis=1)

    def energy(self, frame, speed):
        speeds = 2.0 * self._speeds[: frame + 1]
        lifted = self._weight * self._lifts[min(frame, len(self._lifts) - 1)]
        return self._balance.total * (0.5 * (speeds**2).sum() + speeds.sum() * speed) + lifted

    def stored(self, frame):
        return self._pull.energy(frame)


@source_of.register
def _blowing(air: Air, balance, _stepper):
    return Wind(air, balance) if air.speed or balance.free else None


class Wind(Source):
    """Wind w on a cloth of area A, of at most the power Σ ½ρA(C_n + C_t)(w + |v|)w²; for free cloth relative to its centre of
    mass.
    """

    name = "wind"
    carried = ("_given",)

    def __init__(self, air, balance):
        model = balance.model
        self._given, self._fps, self._wind, self._faster = np.zeros(model.copies), model.scene.fps, air.speed, 0.0
        if balance.free:
            self._wind += np.linalg.norm(model.velocities.numpy(), axis=1).max(initial=0.0)
            self._faster = np.linalg.norm(model.gravity.numpy(), axis=1) / self._fps
        area = model.scene.mesh.triangle_areas.sum()
        self._factor = 0.5 * air.density * area * (air.normal_drag + air.tangential_drag) / self._fps

    def energy(self, frame, speed):
        wind = self._wind + frame * self._faster
        self._given = self._given + self._factor * (wind + speed) * wind**2
        return self._given
