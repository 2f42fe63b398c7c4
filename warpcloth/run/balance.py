"""Compares the energy of a cloth with the energy that its sources can have put in.

A cloth is judged by its kinetic energy and its height, whose sum never exceeds its total energy. Elastic energy is left out,
because sweeps that end too early store a huge ½kx² without exploding; strain is judged separately.

Symplectic Euler has its velocities half a step before its positions. For x″ = −ω²x it conserves v² + ω²x² − hω²xv, which near
the limit ωh = 2 is far below v², by a factor of up to 199 at ωh = 1.995. With the velocity at the time of the position,
u = v − ½hω²x, the conserved quantity is u² + ω²x²(1 − ω²h²/4). Below the limit u² never exceeds it, so u is judged and not v.

A :class:`Source` puts energy in. A new kind of source is an entry of :data:`SOURCES`.
"""

from functools import cached_property

import numpy as np
import warp as wp

from ..base.turns import TURN
from ..core.energy import Energy
from ..core.gradient import Gradient
from ..core.sums import Sums
from ..numerics.rotation import kabsch

# A run has diverged when it has this many times the energy that its sources can have put in. Stable runs reach up to 1.4 times
# with unconverged or large steps and 1.3 times with sweeps averaged by vertex. Single hierarchical sweeps, 16 a frame, reach
# 1.9 times on a hanging cloth and 2.9 times on a hard flag that is swung by 120°. Runs that explode pass every bound.
GAIN = 3.0
# A run has diverged when an edge has this strain and the run does not have the energy for it. The fewest sweeps that hold a
# cloth give up to 6.4 (one a step of 1/60 s, averaged by vertex); a cloth that falls as if nothing held it soon passes 10.
STRETCHED = 10.0
# More patches of pins than this are treated as one patch, whose pins move within it.
_PATCHES = 32


class Elastic:
    """Evaluates U and ∂U/∂x of the soft terms of a model, and gaps; kernels and scratch are allocated on first use."""

    def __init__(self, model):
        self.model = model
        self.soft = tuple(elements for elements in model.terms if not elements.hard)
        self.hard = tuple(elements for elements in model.terms if elements.hard)

    @cached_property
    def _sums(self):
        return Sums(self.model)

    @cached_property
    def _energy(self):
        return Energy(self.model, self._sums, terms=self.soft)

    @cached_property
    def _gradient(self):
        return Gradient(self.model, terms=self.soft)

    def energy(self, x):
        """U [J] of the soft terms of each copy at x, (B,)."""
        return self._value(self._energy, x) if self.soft else np.zeros(self.model.copies)

    def gaps(self, x, terms):
        """Computes ½Σ gap² of the constraints of terms, which is their energy with a stiffness of 1, (B,)."""
        unit = tuple(elements.with_unit_stiffness() for elements in terms)
        return self._value(Energy(self.model, self._sums, terms=unit), x) if unit else np.zeros(self.model.copies)

    def gradient(self, x):
        """∂U/∂x [N] of the soft terms at x, (B·n, 3), in the order of the scene."""
        gradient = self.model.vectors()
        self._gradient.add(x, gradient)
        return self.model.in_scene_order(gradient.numpy()).astype(np.float64)

    def put(self, points):
        """Puts points (B·n, 3) from the order of the scene into that of the model, on its device."""
        model = self.model
        if model.order is not None:
            points = points.reshape(model.copies, -1, 3)[:, model.order]
        return model.array(points.reshape(-1, 3), model.vec3)

    def _value(self, energy, x):
        found = wp.zeros(self.model.copies, dtype=wp.float64, device=self.model.device)
        energy.add(x, found)
        return found.numpy()


class Source:
    """A source of energy for a cloth. All its numbers are upper bounds.

    Attributes:
        name: Its name in messages.
    """

    name = "a source"

    def energy(self, frame, speed):
        """Energy that it has put in up to a frame, (B,) [J]; called once for each frame, in order from 1.

        Args:
            frame: Number of the frame.
            speed: Largest RMS speed of each copy in any earlier frame plus what falling adds in one frame, (B,) [m/s].
        """
        return 0.0

    def speed(self, frame):
        """Speed at which it carries the whole cloth along in a frame [m/s]; energy is counted relative to that motion."""
        return 0.0

    def stored(self, frame):
        """Further energy that it has put in, (B,) [J]; costly, so called only if everything else is not enough."""
        return 0.0


class Start(Source):
    """Kinetic and elastic energy at the start.

    Hard constraints count with the energy of closing their gaps in one step. N of them in a row move what hangs on them by up
    to Σ gap ≤ √(N Σ gap²), and midpoint or a relaxation of 2 doubles the speed that hₑ gives. Soft constraints count in the
    same way for solvers whose sweeps may close them too (``closes``).
    """

    name = "the start"

    def __init__(self, balance, stepper):
        model, elastic = balance.model, balance.elastic
        closed = elastic.hard + (elastic.soft if stepper.options.closes else ())
        velocities = model.in_scene_order(model.velocities.numpy()).astype(np.float64)
        self._energy = balance.kinetic(velocities) + elastic.energy(model.positions)
        gaps = sum(elements.per_copy for elements in closed) * elastic.gaps(model.positions, closed)
        self._energy += 4.0 * balance.total * gaps / stepper.he**2

    def energy(self, frame, speed):
        return self._energy


class Pins(Source):
    """Pins that keyframes move.

    Pins that are joined by edges form a patch. If a patch moves as a rigid body, the cloth can move with it and keep its energy
    relative to that motion. A change δ of the patch's speed, taken over the whole cloth, adds at most ½δ² + δ·speed per unit
    mass, and apart from that only lifting adds energy. Patches that move against one another store at most the energy of
    deforming the start with them, each vertex by the mean of their motions with weights 1/distance².
    """

    name = "moving pins"

    def __init__(self, balance, _stepper):
        scene, self._balance = balance.model.scene, balance
        self._stored, self._seen = np.zeros(balance.model.copies), 0
        self._kicked, pins = 0.0, scene.pins
        self._points, self._frames = scene.positions, pins.keyframes
        self._patches = self._found()
        share = np.where(np.isin(np.arange(len(self._points)), pins.vertices), 0.0, scene.vertex_masses)
        share = share / share.sum() if share.any() else share
        places = np.column_stack([self._points, np.ones(len(self._points))])
        spread, middle = (share[:, None] * places).T @ places, share @ places
        speeds, kicks, rises = [], [], []
        for patch, maps in zip(self._patches, self._maps, strict=True):
            beside = self._frames[:, patch] - np.einsum("fij,pj->fpi", maps, places[pins.vertices[patch]])
            moves, own = (np.diff(each, axis=0, prepend=each[:1], append=each[-1:]) for each in (maps, beside))
            turns, own_turns = (np.diff(each, axis=0, prepend=0.0 * each[:1]) for each in (moves, own))
            for found, of_maps, of_pins in ((speeds, moves, own), (kicks, turns, own_turns)):
                mean = np.sqrt(np.maximum(np.einsum("fij,jk,fik->f", of_maps, spread, of_maps), 0.0))
                found.append(scene.fps * (mean + np.linalg.norm(of_pins, axis=-1).max(axis=1)))
            rises.append((maps - maps[0]) @ middle)
        self._speeds, self._kicks = np.max(speeds, axis=0), np.max(kicks, axis=0)
        gravity = balance.model.gravity.numpy().astype(np.float64)
        heights = np.max(-np.einsum("pfi,bi->pfb", np.array(rises), gravity), axis=0)
        self._lifted = balance.total * np.maximum.accumulate(np.maximum(heights, 0.0))

    def _found(self):
        """Indices of the pins of each patch."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        scene = self._balance.model.scene
        vertices, n = scene.pins.vertices, len(scene.mesh.points)
        place = np.full(n, -1)
        place[vertices] = np.arange(len(vertices))
        a, b = place[scene.mesh.edges.T]
        joined = (a >= 0) & (b >= 0)
        graph = coo_array((np.ones(joined.sum()), (a[joined], b[joined])), shape=(len(vertices), len(vertices)))
        count, labels = connected_components(graph, directed=False)
        return [np.arange(len(vertices))] if count > _PATCHES else [np.flatnonzero(labels == k) for k in range(count)]

    @cached_property
    def _maps(self):
        """The rigid motion of each patch since the start, as affine maps (F, 3, 4)."""
        found = []
        for patch in self._patches:
            frames = self._frames[:, patch]
            turned = np.asarray(kabsch(frames[0], frames))
            middles = frames.mean(axis=1)
            found.append(np.concatenate([turned, (middles - turned @ middles[0])[:, :, None]], axis=-1))
        return found

    @cached_property
    def _weights(self):
        """Of each vertex and patch, (n, P)."""
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
        elastic, pins = self._balance.elastic, self._balance.model.scene.pins.vertices
        while self._seen < min(frame, len(self._frames) - 1):
            self._seen += 1
            points = np.zeros_like(self._points)
            for weight, maps in zip(self._weights.T, self._maps, strict=True):
                matrix = maps[self._seen]
                points += weight[:, None] * (self._points @ matrix[:, :3].T + matrix[:, 3])
            points[pins] = self._frames[self._seen]
            x = elastic.put(np.tile(points, (self._balance.model.copies, 1)))
            self._stored = np.maximum(self._stored, elastic.energy(x))
        return self._stored


def _moving(balance, stepper):
    keyframes = balance.model.scene.pins.keyframes
    moves = keyframes is not None and keyframes.shape[1] and (keyframes != keyframes[0]).any()
    return Pins(balance, stepper) if moves else None


# Functions of (balance, stepper), each of which returns a source, or None if the scene has none of its kind.
SOURCES = [Start, _moving]


class Balance:
    """Compares the energy of each copy, frame by frame, with what the sources of the scene can have put in.

    Energies are counted from the lowest height that a copy has had, so falling is not a separate source. A cloth that no pin
    and no attachment holds is judged by its motion relative to its centre of mass, to which gravity adds nothing.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        stepper: The :class:`warpcloth.solvers.solver.Stepper` of a solver that is bound to it.

    Attributes:
        mass, total: Masses of the free vertices (B, n) and their sum (B,) [kg].
        elastic: :class:`Elastic` of the model.
        sources: The sources of the scene.
        has, given: Energy that each copy has, and that it can have been given, in the last frame that was checked, (B,) [J].
    """

    def __init__(self, model, stepper):
        self.model = model
        self._h = stepper.h
        self._staggered = stepper.options.staggered
        arrays = (model.positions, model.mass, model.inverse_mass)
        points, mass, inverse = (model.in_scene_order(array.numpy()).astype(np.float64) for array in arrays)
        self.mass = np.where(inverse > 0.0, mass, 0.0).reshape(model.copies, -1)
        self.total = self.mass.sum(axis=1)
        # A term of one vertex that is in no cell holds it where it is in space.
        held = any(elements.term.vertices == 1 and not elements.cells for elements in model.terms)
        self._free = not (held or len(model.scene.pins.vertices))
        self._gravity = model.gravity.numpy().astype(np.float64)
        self._moment, self._lowest, self._fastest = self._moments(points), np.zeros(model.copies), np.zeros(model.copies)
        self._rounding = np.zeros(model.copies)
        self.elastic = Elastic(model)
        # Rounding of positions gives a velocity of at most ω²h ε x, 4 ε x/h for ωh = 2, and adds up like a random walk.
        self._note_farthest(points)
        found = (make(self, stepper) for make in SOURCES)
        self.sources = [source for source in found if source is not None]

    def kinetic(self, velocities):
        """½Σ m v² of each copy [J], of a free cloth relative to its centre of mass."""
        velocities = velocities.reshape(*self.mass.shape, 3)
        if self._free:
            velocities = velocities - (self._moments(velocities) / self.total[:, None])[:, None]
        return 0.5 * (self.mass * np.einsum("bij,bij->bi", velocities, velocities)).sum(axis=1)

    def gains(self, frame, points, velocities):
        """Divides the energy of each copy by what it can have been given, (B,).

        Args:
            frame: Number of the frame; they come in order from 1.
            points: (B·n, 3) [m] in the order of the scene.
            velocities: (B·n, 3) [m/s].
        """
        with np.errstate(all="ignore"):
            points, velocities = points.astype(np.float64, copy=False), velocities.astype(np.float64, copy=False)
            kinetic, height = self.kinetic(velocities), self._height(points)
            if self._free:
                self._note_farthest(points)
            self._lowest = np.fmin(self._lowest, height)
            per_frame = 1.0 / self.model.scene.fps
            speed = self._fastest + np.linalg.norm(self._gravity, axis=1) * per_frame
            given = sum(source.energy(frame, speed) for source in self.sources) - self._lowest
            given = given + self._rounding * frame * per_frame / self._h + self._rounded_height
            carried = max(source.speed(frame) for source in self.sources)
            found = self._gain(kinetic, height, carried, given)
            if (found > GAIN).any():
                with TURN:
                    if self._staggered and self.elastic.soft:
                        kinetic = np.fmin(kinetic, self.kinetic(self._at_positions(points, velocities)))
                    given = given + sum(source.stored(frame) for source in self.sources)
                found = self._gain(kinetic, height, carried, given)
            root = np.sqrt(2.0 * kinetic / np.where(self.total > 0.0, self.total, 1.0))
            self._fastest = np.where(found <= GAIN, np.fmax(self._fastest, root), self._fastest)
        return found

    @property
    def weighs(self):
        """Whether each copy has gravity, (B,)."""
        return self._gravity.any(axis=1)

    def sentence(self, copy):
        """Says how much energy a copy has gained by the last frame."""
        names = [source.name for source in self.sources] + ["falling"] * bool(self.weighs[copy] and not self._free)
        names = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
        return (
            f"it has gained energy, {self.has[copy]:.3g} J of motion and height, of which {names} can have put in no more "
            f"than {self.given[copy]:.3g} J"
        )

    def suffices(self, copy, points, stretch):
        """Whether the energy that a copy can have been given by the last frame allows an edge ``stretch`` m too long."""
        with TURN:
            x = self.elastic.put(points)
            energy, gaps = self.elastic.energy(x)[copy], self.elastic.gaps(x, self.elastic.hard)[copy]
        return energy <= GAIN * self.given[copy] and gaps < 0.5 * stretch**2

    def _gain(self, kinetic, height, carried, given):
        beside = np.maximum(np.sqrt(kinetic) - carried * np.sqrt(0.5 * self.total), 0.0) ** 2
        self.has, self.given = beside + height - self._lowest, given
        return np.where(self.has > 0.0, self.has / self.given, np.where(self.has <= 0.0, 0.0, np.nan))

    def _note_farthest(self, points):
        """Bounds the energy that rounding adds in a step, and the height that it changes, by the farthest of the points."""
        farthest = np.abs(points).reshape(self.model.copies, -1).max(axis=1)
        rounded = 4.0 * np.finfo(self.model.numpy_dtype).eps * farthest
        self._rounding = np.fmax(0.5 * self.total * (rounded / self._h) ** 2, self._rounding)
        self._rounded_height = self.total * np.linalg.norm(self._gravity, axis=1) * rounded

    def _moments(self, points):
        return np.einsum("bi,bij->bj", self.mass, points.reshape(*self.mass.shape, 3))

    def _height(self, points):
        """Potential energy of gravity since the start [J], without which a free cloth is judged."""
        if self._free:
            return np.zeros(self.model.copies)
        return -((self._moments(points) - self._moment) * self._gravity).sum(axis=1)

    def _at_positions(self, points, velocities):
        """Velocities at the time of the positions, half a kick later."""
        mass, shape = self.mass[..., None], (*self.mass.shape, 3)
        forces = mass * self._gravity[:, None] - self.elastic.gradient(self.elastic.put(points)).reshape(shape)
        kicks = np.divide(forces, mass, out=np.zeros(shape), where=mass > 0.0)
        return velocities + 0.5 * self._h * kicks.reshape(-1, 3)
