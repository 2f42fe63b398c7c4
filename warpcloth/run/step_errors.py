"""Bounds how far the last step of a frame ended from its solution, and the energy that cloth stores there.

An implicit step minimises φ(d) = 1/(2hₑ²)‖d‖²_M + U(x̃ + d). With r = ∇φ where the step ends, after contact, the distance to
the minimiser is at most hₑ² max ‖rᵢ‖/mᵢ where U is convex, and φ at most ½hₑ² rᵀM⁻¹r above its minimum. Where the bound exceeds
what is allowed, one Newton step with a semi-definite Hessian estimates the distance ‖H⁻¹r‖ (Nocedal and Wright 2006, *Numerical
Optimization*, 3.3).
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.energy import Energy
from ..core.hessian import Hessian
from ..core.sums import RowSums, Sums
from ..fast.plan import plan
from ..kernels import step_error as kernels
from ..kernels.reduce import keep_largest
from ..kernels.term import HessianPolicy
from ..kernels.terms.air import AIR
from ..model.host_values import host_values
from ..numerics.linear import ConjugateGradients

# Relative accuracy of the Newton step, in the norm of the solver; with 0.1 the largest displacement was off by up to 60 %. With
# contact, whose gaps only a Newton step tells, one is taken again when the bound has grown by this factor.
ACCURACY, GROWTH = 0.01, 4.0
# The strain of an element that no energy need explain.
STRAIN = 0.05


class StepError(NamedTuple):
    """The error of the steps of each copy at the end of a frame, (B,) arrays.

    Attributes:
        distance: The largest distance of a vertex from the solution of a step so far [m].
        solved: The bound in the last frame with a Newton step [m].
        ratio: The distance of that Newton step over the bound.
        gap: The largest normal distance of a vertex in contact that Newton steps found, over the contact distance.
        unresolved: Whether contact of a vertex is not resolved at the end of this frame and the one before.
        elastic: Elastic energy [J].
        contact: Energy of contact [J].
        largest: The largest excess of an element's energy over that of the strain :data:`STRAIN`, (√u − √u_ε)² [J].
        pushed: The energy that contact added when it changed positions [J].
        excess: The bound of φ above its minimum, before contact changed positions [J].
        he: hₑ of the step [s].
    """

    distance: np.ndarray
    solved: np.ndarray
    ratio: np.ndarray
    gap: np.ndarray
    unresolved: np.ndarray
    elastic: np.ndarray
    contact: np.ndarray
    largest: np.ndarray
    pushed: np.ndarray
    excess: np.ndarray
    he: np.ndarray


class StepErrors:
    """Finds the :class:`StepError` of each frame of a stepper.

    Args:
        near: The bound above which a Newton step estimates the distance [m].
        allowed: The distance that a Newton step must confirm if bound and last ratio predict more [m].

    Attributes:
        distance, solved, ratio, gap: As of :class:`StepError`.
        knows: Whether ``distance`` is that from the solution, not 0 or the largest gap of constraints.
    """

    def __init__(self, stepper, near, allowed):
        self._stepper, self._near, self._allowed, self._parts = stepper, near, allowed, WeakKeyDictionary()
        model = stepper.model
        self.distance, self.solved, self.ratio, self.gap = (np.zeros(model.copies) for _ in range(4))
        # For each vertex the frames in a row in which its contact was not resolved, which a checkpoint holds.
        touches = any(taker.unfiltered is not None for taker, _first, _end in stepper.takers)
        counts = wp.zeros(model.count, dtype=wp.int32, device=model.device) if touches else None
        self._counts = stepper.state.add("frames of unresolved contact", counts)
        self.knows = all(
            taker.integrator is not None and len({elements.hard for elements in taker.model.terms}) < 2
            for taker, _first, _end in stepper.takers
        )

    def find(self):
        """Returns the :class:`StepError` of the frame that ended with the last step."""
        B = len(self.distance)
        energies, unresolved, he = np.zeros((5, B)), np.zeros(B, dtype=bool), np.zeros(B)
        for taker, first, end in self._stepper.takers:
            if taker not in self._parts:
                self._parts[taker] = _measured(taker)
            part, copies = self._parts[taker], slice(first, end)
            he[copies], (bound, energies[:, copies]) = taker.he, part.measure()
            distance, solved, ratio = self.distance[copies], self.solved[copies], self.ratio[copies]
            known = ~(bound > self._near) | (not part.solves)
            distance[known] = np.fmax(distance, bound)[known]
            distance[~np.isfinite(bound)] = np.inf  # forces overflow, although positions are finite
            with np.errstate(invalid="ignore"):
                passes = (ratio * bound > self._allowed) & (distance <= self._allowed)
            grown = (part.stepper.unfiltered is not None) & (bound > GROWTH * solved)
            news = np.isfinite(bound) & ~known & ((solved == 0.0) | passes | grown)
            if news.any():
                found, gap = part.solve()
                found = np.where(found > 0.0, np.fmin(found, bound), bound)  # where the linear solve fails, the bound stays
                solved[news], ratio[news] = bound[news], found[news] / bound[news]
                self.gap[copies][news] = np.fmax(self.gap[copies], gap)[news]
            told = np.isfinite(bound) & ~known
            distance[told] = np.fmax(distance, ratio * bound)[told]
            if part.solves and taker.unfiltered is not None:
                n = taker.model.per_copy
                unresolved[copies] = part.unresolved(bound, self._counts[first * n : end * n])
        found = (each.copy() for each in (self.distance, self.solved, self.ratio, self.gap))
        return StepError(*found, unresolved, *energies, he)


def _measured(stepper):
    if stepper.integrator is None:
        return _Stored(stepper)
    return (_Gaps if any(elements.hard for elements in stepper.model.terms) else _Residuals)(stepper)


class _Stored:
    """The stored energy without contact; its steps solve nothing, as those of :class:`Explicit`.

    Attributes:
        bound: The largest acceleration ‖rᵢ‖/mᵢ of each copy, (B,) [m/s²].
        energies: The energies of :class:`StepError`, (B,) [J]; until read, ``pushed`` is the energy before contact changed
            positions, and ``excess`` Σ ‖rᵢ‖²/mᵢ.
    """

    solves = False

    def __init__(self, stepper):
        model = self.model = stepper.model
        self.stepper, self.sums = stepper, Sums(model)
        self._read = [Mirror(model.scalars()) for _ in range(6)]
        self.bound, *self.energies = (mirror.array for mirror in self._read)
        soft = [each for each in stepper.declared.terms if not each.hard and each.collider is None and each.term is not AIR]
        self.soft = tuple(soft)
        self._elastic = Energy(model, self.sums, terms=self.soft) if soft else None
        self._peaks = [
            _Peak(model, self._elastic, k) for k, each in enumerate(soft) if not each.cells and each.term.vertices > 1
        ]
        self._prepare()
        # The arrays of pairs may be replaced, which a captured graph would not notice.
        self._measure = self._launch if stepper.model.dynamic else Segment(model.device, self._launch)

    def measure(self):
        """Returns the bound (B,) [m], and the energies of :class:`StepError` in order, (5, B) [J]."""
        self._measure()
        bound, *energies = (mirror.read().copy() for mirror in self._read)
        return bound, np.array(energies)

    def _prepare(self):
        """Allocates what :meth:`_launch_bound` needs."""

    def _launch(self):
        for mirror in self._read:
            mirror.array.zero_()
        if self._elastic is not None:
            self._elastic.add(self.stepper.state.x, self.energies[0])
        for peak in self._peaks:
            peak.launch(self.energies[2])
        self._launch_bound()

    def _launch_bound(self):
        """Launches the bound, the energy of contact, and what :attr:`energies` has of the step."""


class _Peak:
    """The largest excess of an element's energy over that of the strain :data:`STRAIN`, of each copy."""

    def __init__(self, model, energy, k):
        self._model, self._values = model, energy.of_elements[k]
        self._rows = RowSums(model, energy.terms[k].per_copy)
        points = np.tile(model.rest_points, (model.copies, 1))
        energy.add(model.array((1.0 + STRAIN) * points, model.vec3), model.scalars())
        self._allowed, self._above = wp.clone(self._values), wp.zeros_like(self._values)
        self._found = model.scalars()
        self._subtract, self._keep = model.kernel(kernels.energy_above), model.kernel(keep_largest)

    def launch(self, out):
        """Launches out (B,) = max(out, the largest) [J], from the last energies of elements."""
        model = self._model
        model.launch(self._subtract, len(self._values), [self._values, self._allowed], [self._above])
        self._rows.largest(self._above, self._found)
        model.launch(self._keep, model.copies, [self._found], [out])


class _Gaps(_Stored):
    """Steps with constraints of infinite stiffness; the bound is the largest gap."""

    def _prepare(self):
        hard = [each for each in self.stepper.declared.terms if each.hard and each.collider is None]
        units = [(Energy(self.model, self.sums, terms=(each.with_unit_stiffness(),)), each.per_copy) for each in hard]
        self._gaps = [(energy, RowSums(self.model, per_copy)) for energy, per_copy in units]
        self._largest = [self.model.scalars() for _ in hard]
        self._sum = self.model.scalars()

    def measure(self):
        bound, energies = super().measure()
        return np.sqrt(2.0 * np.max([bound, *(array.numpy() for array in self._largest)], axis=0)), energies

    def _launch_bound(self):
        for (energy, rows), largest in zip(self._gaps, self._largest, strict=True):
            energy.add(self.stepper.state.x, self._sum)
            rows.largest(energy.of_elements[0], largest)


class _Residuals(_Stored):
    solves = True

    def _prepare(self):
        stepper, model = self.stepper, self.model
        self._taken = _Step(stepper, self)
        self.residual, self.weighted, self.moved = (model.vectors() for _ in range(3))
        self.kernels = model.launcher(((kernels.add_moves, kernels.finish_residual), model.dtype))
        self.keep = model.kernel(keep_largest)
        # Midpoint has its unknown at the middle of a step, and the energy stored is that at the end.
        self._pushes = stepper.unfiltered is not None and stepper.integrator.parts == 1 and bool(self.soft)
        if self._pushes:
            self._before = Energy(model, self.sums, corrected=True, terms=self.soft)

    def measure(self):
        (bound, energies), he = super().measure(), self.stepper.he
        elastic, contact, _largest, before, excess = energies
        energies[3:] = self._pushes * (elastic + contact - before), 0.5 * he**2 * excess
        return he**2 * bound, energies

    def _launch_bound(self):
        self._taken.launch()

    def launch_sums(self, first):
        self.model.lock(self.residual)
        self.model.lock(self.weighted)
        self.sums.largest(self.model.inverse_mass, self.residual, self.bound)
        if first:
            self.sums.dot(self.weighted, self.weighted, self.energies[4])

    def launch_before(self, step, x, d):
        if self._pushes:
            self._before.add(x, self.energies[3], d)
            self.launch_contact(step, x, d, self.energies[3])

    def launch_contact(self, step, x, d, out):
        if step.contact is not None:
            step.contact.add(x, out, d)

    def solve(self):
        """Returns the distance by a Newton step, (B,) [m], and :attr:`StepError.gap` there."""
        return self._taken.solve()

    def unresolved(self, bound, counts):
        """Returns whether contact of a vertex is not resolved, (B,); updates ``counts`` (N,), the frames in a row without
        resolution.
        """
        if (bound > 0.5 * self._taken.contact_distance).any():  # no smaller residual unbalances half of such a force
            return self._taken.unresolved(counts)
        counts.zero_()
        return np.zeros(len(bound), dtype=bool)


class _Step:
    """φ of the steps of a stepper, in the arrays of the :class:`_Residuals` ``of``."""

    def __init__(self, stepper, of):
        self.stepper, self._of, self._newton = stepper, of, None
        self.model, terms = stepper.model, stepper.model.terms
        self._gradient, dynamic = plan(self.model).gradient(corrected=True), self.model.dynamic
        touching = tuple(each for each in terms if each.collider is not None)
        self.contact = None
        if touching or dynamic:
            self.contact = Energy(self.model, of.sums, corrected=True, terms=touching, dynamic=dynamic)
        # The forces of contact that is terms, without friction, and of pairs, each with its contact distance.
        pushing = tuple(each for each in touching if each.term.law is None)
        kinds = (pushing, ()), ((), dynamic)
        self._pushes = [plan(self.model).gradient(True, *kind) if any(kind) else None for kind in kinds]
        self._distances = _contact_distances(self.model.scene)
        present = zip(self._pushes, self._distances, strict=True)
        distances = [distance for pushes, distance in present if pushes is not None]
        self.contact_distance, self._wrong, self._forces = min(distances, default=np.inf), None, None
        if distances:
            self._forces = self.model.vectors(), self.model.vectors() if dynamic else None

    def launch(self):
        stepper, of, d = self.stepper, self._of, self.stepper.correction
        self._launch_residual(d)
        of.launch_sums(True)
        of.launch_before(self, stepper.predicted, d)
        if stepper.unfiltered is not None:
            part = stepper.he / stepper.h if stepper.integrator.parts > 1 else 1.0
            of.kernels(kernels.add_moves, self.model.count, [d, stepper.state.x, stepper.unfiltered, part], [of.moved])
            d = of.moved
            self._launch_residual(d)
            of.launch_sums(False)
        of.launch_contact(self, stepper.predicted, d, of.energies[1])

    def _launch_residual(self, d):
        stepper, of, model = self.stepper, self._of, self.model
        of.residual.zero_()
        self._gradient.add(stepper.predicted, of.residual, d)
        given = [model.mass, model.inverse_mass, d, 1.0 / stepper.he**2]
        of.kernels(kernels.finish_residual, model.count, given, [of.residual, of.weighted])

    def solve(self):
        model = self.model
        if self._newton is None:
            terms, dynamic = self._copy_by_copy(), model.dynamic
            self._hessian = Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=terms, dynamic=dynamic)
            self._linear = ConjugateGradients(self._hessian, model.per_copy)
            self._linear.tolerance.fill_(ACCURACY)
            self._direction = model.vectors()
            self._largest = [Mirror(model.scalars()) for _ in range(3)]
            self._ones, self._all = (
                model.constant(1.0, model.count),
                wp.full(model.copies, 1, dtype=wp.int32, device=model.device),
            )
            self._project = model.kernel(kernels.normal_moves, model.dtype)
            self._newton = self._launch_newton if dynamic else Segment(model.device, self._launch_newton)
        self._newton()
        distance, *gaps = (mirror.read().copy() for mirror in self._largest)
        return distance, np.max(gaps, axis=0)

    def _copy_by_copy(self):
        """Returns the elements in the order of copies, which a Hessian needs."""
        present, sorted_ones = self.stepper.elements, self.model.terms
        if self.model.copies == 1:
            return sorted_ones
        pairs = zip(sorted_ones, present, strict=True)
        return tuple(a if np.array_equal(host_values(a.stencil), host_values(b.stencil)) else b for a, b in pairs)

    def unresolved(self, counts):
        model = self.model
        if self._wrong is None:
            self._count, self._ones = model.kernel(kernels.unresolved_contact, model.dtype), model.constant(1.0, model.count)
            self._wrong = Mirror(model.scalars())
        self._launch_unresolved(counts)
        return self._wrong.read() > 0.0

    def _launch_unresolved(self, counts):
        of, model = self._of, self.model
        given = [model.inverse_mass, *self._launch_pushes(), of.residual, self.stepper.he**2, *self._distances]
        model.launch(self._count, model.count, given, [counts, of.weighted])
        of.sums.largest(self._ones, of.weighted, self._wrong.array)

    def _launch_pushes(self):
        """Launches the forces of contact of terms and of pairs, and returns both; those of pairs may be None."""
        for pushes, force in zip(self._pushes, self._forces, strict=True):
            if pushes is not None:
                force.zero_()
                pushes.add(self.stepper.predicted, force, self._moved)
        return self._forces

    @property
    def _moved(self):
        return self.stepper.correction if self.stepper.unfiltered is None else self._of.moved

    def _launch_newton(self):
        of, model = self._of, self.model
        self._hessian.assemble(self.stepper.predicted, 1.0 / self.stepper.he**2, self._moved)
        self._linear.solve(of.residual, self._direction, self._all)
        distance, *gaps = (mirror.array for mirror in self._largest)
        of.sums.largest(self._ones, self._direction, distance)
        if self._forces is None:
            return
        for force, distance, gap in zip(self._launch_pushes(), self._distances, gaps, strict=True):
            if force is not None and distance:
                model.launch(self._project, model.count, [force, self._direction, distance], [of.weighted])
                of.sums.largest(self._ones, of.weighted, gap)


def _contact_distances(scene):
    """Returns the contact distance of colliders that are not meshes, and that of pairs [m]; 0 for what the scene does not have.

    A vertex in both kinds of pairs has the larger distance.
    """
    of_pairs = [scene.contact] * bool(scene.meshes) + [scene.self_contact] * (scene.self_contact is not None)
    of_terms = scene.contact.distance if scene.colliders else 0.0
    return of_terms, max((each.distance for each in of_pairs), default=0.0)
