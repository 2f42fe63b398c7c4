"""Compares the energy of a cloth with the energy that its sources can have added; docs/stability.md has the derivations.

Divergence is judged by kinetic energy and the potential energy of gravity, with u = v − ½hω²x for v in symplectic Euler.
:meth:`Balance.surplus` is stricter: elastic energy and that of contact count too. After unconverged steps elastic energy counts
beyond that of a uniform strain of 2 %, and that of a single element beyond a strain of 5 %, both in the norm √U.

Euler steps with a semi-definite Hessian never raise the sum: E₁ − E₀ = −½‖v₁ − v₀‖²_M + U(x₁) − U(x₀) − ∇U(x₁)·(x₁ − x₀). BDF2
does not raise ¼(5‖z₁‖² − 4z₁·z₀ + ‖z₀‖²) (Dahlquist 1978), with ‖z‖² twice the energy, which so stays below twice that at the
start. Midpoint conserves the energy of a quadratic U; as contact that begins within a step adds energy, it is held to the bound
of BDF2.
"""

from functools import cached_property

import numpy as np

from ..base.turns import TURN
from ..core.energy import Energy
from ..core.sums import Sums
from ..fast.plan import plan
from ..kernels.terms.air import AIR
from ..scene.colliders import Collider
from ..scene.scene import Pins
from .sources import common_velocity, source_of

# A run has diverged when it has this many times the energy that its sources can have added. Stable runs reach 1.4 times with
# unconverged or large steps, and 1.3 times with vertex-averaged sweeps. Single hierarchical sweeps, 16 a frame, reach 1.9 times
# on a hanging cloth and 2.9 times on a hard flag that is swung by 120°. Runs that diverge exceed every bound.
GAIN = 3.0
# A run has diverged when an edge has this strain and the energy of the run does not explain it. The fewest sweeps that hold a
# cloth give up to 6.4 (one vertex-averaged sweep per step of 1/60 s); a cloth that falls as if nothing held it soon passes 10.
STRETCHED = 10.0
# An error of the strain, RMS over the cloth, for which an unconverged step is not blamed.
STRAIN = 0.02
# Relative error of an energy, which sums hundreds of thousands of roundings of forces and residuals below their tolerance.
RESOLVED = 1e-3


class Elastic:
    """Evaluates U, ∂U/∂x and gaps of the soft terms of a model. Kernels and scratch are allocated on first use."""

    def __init__(self, model):
        self.model = model
        self.soft = tuple(elements for elements in model.terms if not elements.hard)
        self.hard = tuple(elements for elements in model.terms if elements.hard)

    @cached_property
    def _sums(self):
        return Sums(self.model)

    @cached_property
    def _energies(self):
        return [Energy(self.model, self._sums, terms=(elements,)) for elements in self.soft]

    @cached_property
    def _gradient(self):
        return plan(self.model).gradient(terms=self.soft)

    def energy(self, x):
        """Returns U [J] of the soft terms of each copy at x, (B,)."""
        return sum(self._energies_at(x), np.zeros(self.model.copies))

    def below_0(self, x):
        """Returns the sum of the negative energies of terms, (B,) [J]; NaN, which comes from overflow, counts as 0."""
        return sum((np.fmin(energy, 0.0) for energy in self._energies_at(x)), np.zeros(self.model.copies))

    def _energies_at(self, x):
        return self._at_start if x is self.model.positions else [self._value(energy, x) for energy in self._energies]

    @cached_property
    def _at_start(self):
        return [self._value(energy, self.model.positions) for energy in self._energies]

    def gaps(self, x, terms):
        """Returns ½Σ gap² of the constraints of terms, their energy with stiffness 1, (B,)."""
        unit = tuple(elements.with_unit_stiffness() for elements in terms)
        return self._value(Energy(self.model, self._sums, terms=unit), x) if unit else np.zeros(self.model.copies)

    def gradient(self, x):
        """Returns ∂U/∂x [N] of the soft terms at x, (B·n, 3), in the order of the scene."""
        gradient = self.model.vectors()
        self._gradient.add(x, gradient)
        return self.model.in_scene_order(gradient.numpy()).astype(np.float64)

    def put(self, points):
        """Returns points (B·n, 3) in the order of the scene as a device array in the order of the model."""
        model = self.model
        if model.order is not None:
            points = points.reshape(model.copies, -1, 3)[:, model.order]
        return model.array(points.reshape(-1, 3), model.vec3)

    def _value(self, energy, x):
        found = self.model.scalars()
        energy.add(x, found)
        return found.numpy()


class Balance:
    """Compares the energy of each copy, frame by frame, with the energy that the sources of the scene can have added.

    Potential energy counts from its lowest value so far. A free cloth is judged by its motion about its centre of mass; a cloth
    whose pins and colliders all move at one velocity is judged relative to that velocity.

    Attributes:
        mass, total: Masses of the free vertices (B, n) and their sum (B,) [kg].
        free: Whether no pin, attachment or rail holds it.
        gravity: Of each copy, (B, 3) [m/s²].
        loads: Constant loads on cloth that is held, (B, n, 3) [N], or None.
        points: Positions of the frame that is checked, (B·n, 3) [m].
        has, given: Energy of each copy, and the energy that its sources can have added, in the last checked frame, (B,) [J].
        driven: Whether the bound of the energy is only an estimate: sources beside the start add energy, or explicit steps have
            contact.
        whole, allowed: All energy of each copy, and the maximum of a correct run, after :meth:`surplus`, (B,) [J].
    """

    carried = ("_lowest", "_fastest", "_rounding", "_rounded_height", "_unbalanced")  # from frame to frame

    def __init__(self, model, stepper):
        self.model = model
        self._stepper, self._h = stepper, stepper.h
        self._staggered, self._damps = stepper.options.staggered, stepper.options.damps
        arrays = (model.positions, model.mass, model.inverse_mass)
        points, mass, inverse = (model.in_scene_order(array.numpy()).astype(np.float64) for array in arrays)
        self.mass = np.where(inverse > 0.0, mass, 0.0).reshape(model.copies, -1)
        self.total = self.mass.sum(axis=1)
        # A term with stencils of one vertex, and without cells, holds vertices in space, and so do meshes.
        held = any(elements.term.vertices == 1 and not elements.cells for elements in model.terms)
        held = held or any(each.is_mesh for each in model.scene.colliders)
        self.free = not (held or len(model.scene.fixed) or model.mobility is not None)
        self.gravity = model.gravity.numpy().astype(np.float64)
        constant = None if model.loads is None or self.free else model.loads.constant
        self.loads = None if constant is None else model.in_scene_order(constant.reshape(-1, 3)).reshape(constant.shape)
        self._start = points.reshape(model.copies, -1, 3)
        self.attached = any(each.term.vertices == 1 and each.collider is None and not each.cells for each in model.terms)
        self._velocity, self._frame = np.zeros(3) if self.attached else common_velocity(model.scene), 0
        self._moment, self._fastest = self._moments(points), np.zeros(model.copies)
        self._rounding = np.zeros(model.copies)
        self.elastic = Elastic(model)
        self._lowest = self.elastic.below_0(model.positions)
        lengths = model.scene.mesh.edge_lengths
        self._edge = np.sqrt(np.mean(lengths**2)) if lengths.any() else np.inf
        # Rounding of positions by δ = 4 ε x changes velocities by at most ω²h δ/4, δ/h for ωh = 2, and the strain of edges by
        # δ/L. In both ways it adds energy in each step, like a random walk.
        self._note_farthest(points)
        parts = [each for each in model.scene.declared if not (self._velocity.any() and isinstance(each, Pins | Collider))]
        found = (source_of(part, self, stepper) for part in (stepper, *parts))
        self.sources = [source for source in found if source is not None]
        touches = model.colliders is not None or model.scene.self_contact is not None
        # The velocities of explicit steps are not corrected for contact, see :meth:`_at_positions`.
        self.driven = len(self.sources) > 1 or (self._staggered and touches)
        integrator = stepper.takers[0][0].integrator
        self._unbalanced = np.zeros(model.copies)
        self._bound = 1.0 if integrator is None else integrator.energy_bound

    def kinetic(self, velocities):
        """Returns ½Σ m v² of each copy (B,) [J], relative to what moves at one velocity, or to the centre of a free cloth."""
        velocities = velocities.reshape(*self.mass.shape, 3) - self._velocity
        if self.free:
            velocities = velocities - (self._moments(velocities) / self.total[:, None])[:, None]
        return 0.5 * (self.mass * np.einsum("bij,bij->bi", velocities, velocities)).sum(axis=1)

    def gains(self, frame, points, velocities):
        """Returns the energy of each copy over that of its sources, (B,), in frames in order from 1, of points [m] and
        velocities [m/s], (B·n, 3).
        """
        with np.errstate(all="ignore"):
            points, velocities = points.astype(np.float64, copy=False), velocities.astype(np.float64, copy=False)
            self._frame = frame
            kinetic, height = self.kinetic(velocities), self._height(points)
            self._h = min(self._h, self._stepper.h)
            if self.free:
                self._note_farthest(points)
            self.points = points
            self._lowest = np.fmin(self._lowest, height)
            per_frame = 1.0 / self.model.scene.fps
            speed = self._fastest + np.linalg.norm(self.gravity, axis=1) * per_frame
            given = sum(source.energy(frame, speed) for source in self.sources) - self._lowest
            given = given + self._rounding * frame * per_frame / self._h + self._rounded_height
            carried = max(source.speed(frame) for source in self.sources)
            found = self._gain(kinetic, height, carried, given)
            if (found > GAIN).any():
                with TURN:
                    if self._staggered and self.elastic.soft:
                        kinetic = np.fmin(kinetic, self.kinetic(self._at_positions(points, velocities)))
                    given = given + sum(source.stored(frame) for source in self.sources)
                    height = height + self.elastic.below_0(self.elastic.put(points))
                    before, self._lowest = self._lowest, np.fmin(self._lowest, height)
                    given = given + (before - self._lowest)
                found = self._gain(kinetic, height, carried, given)
            root = np.sqrt(2.0 * kinetic / np.where(self.total > 0.0, self.total, 1.0))
            self._fastest = np.where(found <= GAIN, np.fmax(self._fastest, root), self._fastest)
        return found

    def surplus(self, frame, error, velocities, converged):
        """Returns all energy of each copy in the last checked frame, over the maximum of a correct run, (B,).

        An estimated maximum is multiplied by ``GAIN``, without the energy of contact. ``converged`` (B,) are copies whose steps
        met the tolerance so far.
        """
        contact, pushed = (np.where(self.driven, 0.0, each) for each in (error.contact, np.fmax(error.pushed, 0.0)))
        stored = error.elastic + contact
        resolved = np.where(converged, stored, contact)
        beyond = np.fmax(np.sqrt(np.fmax(error.elastic, 0.0)) - np.sqrt(self._strained), 0.0) ** 2
        explained = np.fmax(pushed + np.fmax(resolved - pushed - error.excess, 0.0), np.fmax(beyond, error.largest))
        explained = np.where(stored > 0.0, explained, stored)
        explained = np.where(np.isfinite(explained), explained, 0.0)
        given = self._bound * (1.0 + RESOLVED) * self.given + self._of_residuals(frame, error, converged)
        self.whole, self.allowed = self.has + explained, given * (GAIN if self.driven else 1.0)
        found = _over(self.whole, self.allowed)
        if (found > 1.0).any():
            with TURN:
                if self._staggered:
                    kinetic = self.kinetic(self._at_positions(self.points, velocities.astype(np.float64, copy=False)))
                    carried = max(source.speed(frame) for source in self.sources)
                    self.whole = self._relative(kinetic, carried) + self._height(self.points) - self._lowest
                    self.whole = self.whole + self._conserved * explained
                    self.allowed = self.allowed + self._kick
                more = self._bound * sum(source.stored(frame) for source in self.sources)
                self.allowed = self.allowed + more * (GAIN if self.driven else 1.0)
            found = _over(self.whole, self.allowed)
        return np.where(self.total > 0.0, found, 0.0)

    def _of_residuals(self, frame, error, converged):
        """Returns the energy that the residuals of ``converged`` steps (B,) can have added, (B,) [J].

        Those of one sign in all steps change the RMS speed by δ = t √(Σ‖rᵢ‖²/mᵢ/M), the largest so far.
        """
        self._unbalanced = np.fmax(self._unbalanced, np.where(converged, np.sqrt(2.0 * error.excess) / error.he, 0.0))
        total = np.where(self.total > 0.0, self.total, 1.0)
        with np.errstate(all="ignore"):
            speed = frame / self.model.scene.fps * self._unbalanced / np.sqrt(total)
            added = total * speed * (np.sqrt(2.0 * np.fmax(self.given, 0.0) / total) + 0.5 * speed)
        return np.where(converged, added, 0.0)

    @cached_property
    def cloth(self):
        """:class:`Elastic` of the model without contact and air."""
        terms = [each for each in self.model.terms if each.collider is None and each.term is not AIR]
        return type(self.elastic)(self.model.with_terms(terms))

    @cached_property
    def _strained(self):
        model, elastic = self.model, self.elastic
        terms = [each for each in elastic.soft if not each.cells and each.term.vertices > 1 and each.collider is None]
        if not terms:
            return np.zeros(model.copies)
        points = np.tile((1.0 + STRAIN) * model.rest_points, (model.copies, 1))
        with TURN:
            return np.fmax(type(elastic)(model.with_terms(terms)).energy(model.array(points, model.vec3)), 0.0)

    @cached_property
    def _kick(self):
        """The kinetic energy that half a step adds at the start, whose velocities are those half a step before, (B,) [J]."""
        points, velocities = self._start.reshape(-1, 3), self.model.in_scene_order(self.model.velocities.numpy())
        velocities = velocities.astype(np.float64)
        return np.fmax(self.kinetic(self._at_positions(points, velocities)) - self.kinetic(velocities), 0.0)

    @cached_property
    def _conserved(self):
        """The fraction of the elastic energy that symplectic Euler bounds, 1 − ω²h²/4."""
        return max(0.0, 1.0 - (self._h / min(self._stepper.options.step_limits(self.model))) ** 2)

    @property
    def weighs(self):
        """Whether gravity acts on each copy, (B,)."""
        return self.gravity.any(axis=1)

    def sentence(self, copy):
        """Returns the part of a message that says how much energy a copy has gained by the last frame."""
        names = [source.name for source in self.sources] + ["falling"] * bool(self.weighs[copy] and not self.free)
        names = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
        return (
            f"it has gained energy, {self.has[copy]:.3g} J of motion and height, of which {names} can have put in no more "
            f"than {self.given[copy]:.3g} J"
        ) + (
            ""
            if self._damps
            else "; midpoint adds energy where springs turn or stretch by much in a step: take a shorter one, or bdf2"
        )

    def suffices(self, copy, points, stretch):
        """Returns whether the energy that a copy can have explains an edge that is ``stretch`` [m] too long."""
        with TURN:
            x = self.elastic.put(points)
            energy, gaps = self.elastic.energy(x)[copy], self.elastic.gaps(x, self.elastic.hard)[copy]
            given = self.given + sum(source.stored(self._frame) for source in self.sources)
        return energy <= GAIN * given[copy] and gaps < 0.5 * stretch**2

    def _gain(self, kinetic, height, carried, given):
        self.has, self.given = self._relative(kinetic, carried) + height - self._lowest, given
        return _over(self.has, given)

    def _relative(self, kinetic, carried):
        return np.maximum(np.sqrt(kinetic) - carried * np.sqrt(0.5 * self.total), 0.0) ** 2

    def _note_farthest(self, points):
        farthest = np.abs(points).reshape(self.model.copies, -1).max(axis=1)
        rounded = 4.0 * np.finfo(self.model.numpy_dtype).eps * farthest
        stored = self._strained * (rounded / (STRAIN * self._edge)) ** 2
        self._rounding = np.fmax(0.5 * self.total * (rounded / self._h) ** 2 + stored, self._rounding)
        self._rounded_height = self.total * np.linalg.norm(self.gravity, axis=1) * rounded

    def _moments(self, points):
        return np.einsum("bi,bij->bj", self.mass, points.reshape(*self.mass.shape, 3))

    def _height(self, points):
        if self.free:
            return np.zeros(self.model.copies)
        moved = self._frame / self.model.scene.fps * self._velocity
        height = -((self._moments(points) - self._moment - self.total[:, None] * moved) * self.gravity).sum(axis=1)
        if self.loads is not None:
            height = height - (self.loads * (points.reshape(self.loads.shape) - self._start - moved)).sum(axis=(1, 2))
        return height

    def _at_positions(self, points, velocities):
        mass, shape = self.mass[..., None], (*self.mass.shape, 3)
        forces = mass * self.gravity[:, None] - self.elastic.gradient(self.elastic.put(points)).reshape(shape)
        if self.model.loads is not None:
            forces = forces + self.model.in_scene_order(self.model.loads.force.numpy()).reshape(shape)
        kicks = np.divide(forces, mass, out=np.zeros(shape), where=mass > 0.0)
        if self.model.mobility is not None:
            kicks[:, self.model.scene.locked] = 0.0
        return velocities + 0.5 * self._h * kicks.reshape(-1, 3)


def _over(has, given):
    with np.errstate(all="ignore"):
        return np.where(has > 0.0, has / given, np.where(has <= 0.0, 0.0, np.nan))
