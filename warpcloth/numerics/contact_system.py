"""Steps of projective dynamics and ADMM with contact: a constant matrix corrected by the Hessian of contact and friction."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.dynamic import dynamic_of
from ..core.hessian import Hessian
from ..core.no_filter import filter_of
from ..kernels import linear as kernels
from ..kernels.accelerate import plain_step
from ..kernels.contact.clear_elements import add_hessian
from ..kernels.elementwise import add_step, negate
from ..kernels.search import LineSearch, check_quadratic, set_trial
from ..kernels.term import HessianPolicy
from ..model.host_values import host_values
from .linear import ConjugateGradients
from .search import HALVINGS, Search

# An accurate solve ends at this residual, relative to b, in the norm of A⁻¹. For rough ones see kernels/linear.py.
TOLERANCE = 1e-3
ITERATIONS = 200


class CorrectedSystem(ConjugateGradients):
    """Solves (A + D) w = b, D the semi-definite matrix of contact, by conjugate gradients with A⁻¹ as preconditioner.

    A p follows from the residuals, so that an iteration costs a solve with A and a product with D. All of it is one segment if
    solves with A may be captured.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x, d: x̃ and the correction (N,) [m], at which D is found; read only.
        linear: Solves with A, ``solve(b, x)``, and says whether that is ``capturable``.
        b, w: The right-hand side (N,) [N], and A⁻¹ b (N,) [m], which is replaced.
        wanted: Which copies to solve for, (B,) int32.

    Attributes:
        matrix: D, a :class:`warpcloth.core.hessian.Hessian`.
    """

    def __init__(self, model, x, d, linear, b, w, wanted):
        super().__init__(Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=(), dynamic=model.dynamic), ITERATIONS)
        self.x, self._d, self._linear, self._b, self._w, self._wanted = x, d, linear, b, w, wanted
        self.tolerance.fill_(TOLERANCE)
        self._Ap, self._all = model.vectors(), wp.full(model.copies, 1, dtype=wp.int32, device=model.device)
        solves = self._solves
        solves.decrease, solves.largest, solves.accurate = model.scalars(), model.scalars(), self._all
        self._plus, self._minus = (wp.full(model.copies, s, dtype=wp.float64, device=model.device) for s in (1.0, -1.0))
        self._back = model.scalars()
        self._launch_on = model.launcher(((plain_step, add_step, set_trial), model.dtype), ((negate,), wp.float64))

    def record(self):
        """Captures the launches before and after solves with A."""
        self._begin, self._advance = self._part(self._launch_begin), self._part(self._launch_iteration)

    def _part(self, launch, whole=False):
        """Returns a segment; or the function itself if it is a part of a ``whole`` segment, or whole and solves on the host."""
        return Segment(self.model.device, launch) if whole == self._linear.capturable else launch

    def _launch_all(self):
        """w = (A + D)⁻¹ b, given w = A⁻¹ b."""
        self._begin()
        wp.capture_while(self._solves.proceed, self._launch_next)

    def _launch_next(self):
        self._linear.solve(self.r, self.z)
        self._advance()

    def _launch_begin(self):
        """Launches D at d, and the first iteration, with z = w."""
        self._launch_matrix()
        wp.copy(self.r, self._b)
        wp.copy(self.z, self._w)
        for array in (self._w, self.p, self._Ap, self.iteration):
            array.zero_()
        wp.copy(self.active, self._wanted)
        self._launch_iteration()

    def _launch_iteration(self):
        """Launches an iteration after z = A⁻¹ r. The diagonal blocks that advance z stay 0, and so then is z."""
        solves, size = self._solves, [self.matrix.per_copy, self._lanes]
        self._launch_dot(self.r, self.z, self.active, self._parts)
        for along, p in ((self.z, self.p), (self.r, self._Ap)):  # the second launch writes the same into ``solves``
            self._launch(kernels.turn, self._dim, [along, self._parts, *size], [solves, p])
        self.matrix.multiply(self.p, self.q, solves.next_active)
        self._add(self._plus, self._Ap, self.q)
        self._launch_dot(self.p, self.q, solves.next_active, self._pq_parts)
        given = [self.preconditioner, self.p, self.q, self._pq_parts, *size]
        self._launch(kernels.advance, self._dim, given, [solves, self._w, self.r, self.z, self._parts])

    def _add(self, step, change, out):
        """``out`` += step·``change``, with the step of the copy (B,)."""
        self._launch_on(add_step, self.model.count, [step, change, self.model.per_copy], [out])

    def _launch_back(self, direction):
        direction.zero_()
        self._add(self._minus, self._w, direction)

    def _launch_step(self, step, direction, active):
        """w = −step·``direction`` in copies that are ``active`` (B,); the step of others is 0."""
        self._launch_on(plain_step, self.model.count, [self._w, self._w, active, self.model.per_copy], [self._w])
        self._launch_on(negate, self.model.copies, [step], [self._back])
        self._add(self._back, direction, self._w)


class ContactSystem(CorrectedSystem):
    """Solves (A + D) w = ∇φ, D the semi-definite Hessian of contact: accurately if φ rose or is near its minimum, else roughly.

    The curvature of contact has no bound, so no constant matrix is an upper bound of the Hessian. A copy where φ rose is
    ``careful`` in the next 4 iterations, after a second rise in 16, and so on: w is then also shortened until φ falls. With
    self-contact all solves are accurate, because a rough w runs into pairs, which then stop the whole copy. Without
    :meth:`start`, all copies always are careful.

    Args:
        given: The arguments of :class:`CorrectedSystem`, with b = ∇φ.
        s: Weight of the inertia [1/s²].
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, or None.

    Attributes:
        careful: Which copies are careful, (B,) booleans.
    """

    def __init__(self, *given, sums, s, pairs):
        super().__init__(*given)
        model = self.model
        touching = [elements for elements in model.terms if elements.collider is not None]
        self._touching = [(elements, model.kernel(add_hessian, elements.term, model.dtype)) for elements in touching]
        held = model.inverse_mass.numpy() == 0.0
        self._diagonal = wp.array(np.where(held, -1, self.matrix.diagonal.numpy()), dtype=wp.int32, device=model.device)
        self._inertia = model.array(s * host_values(model.mass), model.dtype) if touching else None
        self._search, self._pairs = Search(model, self.x, sums, s, filter_of(pairs)), pairs
        self._listed = None if pairs is None else Mirror(pairs.listed)
        self.careful = np.ones(model.copies, dtype=bool)
        self._marks, self._searched = (Mirror(model.scalars(wp.int32)) for _ in range(2))  # careful copies, on the device
        if pairs is None:
            self._solves.accurate = self._marks.array
        self.record()
        self._left, self._more = (np.zeros(model.copies, dtype=int) for _ in range(2))

    def record(self):
        super().record()
        self._solve = self._part(self._launch_all, whole=True)
        self._shorten = Segment(self.model.device, self._launch_shorten)

    def _launch_matrix(self):
        self.matrix.assemble(self.x, 0.0, self._d, self._launch_touching)

    def _launch_touching(self, values):
        for elements, kernel in self._touching:
            given = [*elements.arguments, elements.clear, self._diagonal, self.x, self._d, self._b]
            given += [self._inertia, self._marks.array, self.model.per_copy]
            self.model.launch(kernel, elements.count, given, [values])

    def _launch_shorten(self):
        search = self._search
        wp.copy(search.correction, self._d)
        search.launch_again()
        self._launch_back(search.direction)
        filter_of(self._pairs).launch_limit(search.direction)
        search.launch(self._searched.array)
        self._launch_step(search.step, search.direction, self._searched.array)

    def start(self):
        """Makes no copy careful, before the first iteration of a step whose iterates stay if φ would rise."""
        self.careful[:], self._left[:], self._more[:] = False, 0, 1
        self._solves.largest.zero_()

    def note(self, rose):
        """Notes in which copies φ rose in the last iteration, (B,) booleans."""
        self._more = np.where(rose, np.minimum(4 * self._more, ITERATIONS), self._more)
        self._left = np.where(rose, self._more, self._left - 1)
        self.careful = self._left > 0

    def correct(self, active):
        """Replaces w = A⁻¹ ∇φ by (A + D)⁻¹ ∇φ at d, for careful copies times a step length; ``active`` are (B,) booleans."""
        some = self.careful.any()
        if not (self._touching or some or self._listed.read()[0]):
            return  # D is 0
        self._marks.update(self.careful)
        self._solve()
        if some:
            self._searched.update(active & self.careful)
            self._shorten()


class PairSystem(CorrectedSystem):
    """Lowers ψ(d) = ½(d − c)ᵀA(d − c) + U(d), U the energy of dynamic elements, by Newton's method with a line search.

    Attributes:
        correct: Function that replaces w = A⁻¹ ∇ψ by t (A + D)⁻¹ ∇ψ at d, 0 < t ≤ 1. Away from other cloth U is 0, and w stays.
    """

    def __init__(self, *given, sums, pairs):
        super().__init__(*given)
        model = self.model
        self._pairs, self._sums, self._dynamic = pairs, sums, dynamic_of(model)
        self._trial, self._pull, self._direction = (model.vectors() for _ in range(3))
        self._state = state = LineSearch()
        for name in ("energy", "other", "slope", "trial_slope", "square", "step"):
            setattr(state, name, model.scalars())
        state.searching = model.scalars(wp.int32)
        state.trials, state.proceed = (wp.zeros(1, dtype=wp.int32, device=model.device) for _ in range(2))
        self._pulled = model.scalars()
        self.record()

    def record(self):
        super().record()
        self._look, self._search = self._part(self._launch_look), self._part(self._launch_search)
        self.correct = self._part(self._launch_correct, whole=True)

    def _launch_correct(self):
        self._look()
        wp.capture_if(self._pairs.near.array, self._launch_near)

    def _launch_look(self):
        """Tests whether cloth may be near other cloth on the way from d to d − w."""
        self._launch_on(plain_step, self.model.count, [self._d, self._w, self._all, self.model.per_copy], [self._trial])
        self._pairs.filter.launch_look(self.x, (self._trial,))

    def _launch_near(self):
        self._launch_all()
        self._search()

    def _launch_matrix(self):
        for array in (self._state.step, self._direction):  # which may be NaN
            array.zero_()
        self._launch_trial()
        wp.copy(self._state.energy, self._state.other)
        self.matrix.assemble_after_gradient(self.x, 0.0, self._d)

    def _launch_trial(self):
        given = [self._d, self._direction, self.model.per_copy]
        self._launch_on(set_trial, self.model.count, given, [self._state, self._trial, self._pull])
        self._pairs.filter.launch_trial(self.x, self._trial)
        self._dynamic.launch(self.x, self._trial)
        self._dynamic.add_energy(self._sums, self._state.other)
        self._dynamic.add_gradient(self._pull)
        self.model.lock(self._pull)

    def _launch_search(self):
        """Launches the search for a step along −w, shortened so that pairs stay apart."""
        state, direction = self._state, self._direction
        self.matrix.multiply(self._w, self.q, self._wanted)
        wp.copy(self.z, self._b)
        for other in (self.r, self.q):  # A w = b − r − D w
            self._add(self._minus, other, self.z)
        self._sums.dot(self._w, self.z, state.square)
        self._launch_back(direction)
        self._pairs.filter.launch_limit(direction)
        self._sums.dot(self._b, direction, state.slope)
        self._sums.dot(self._pull, direction, self._pulled)
        state.step.fill_(1.0)
        wp.copy(state.searching, self._wanted)
        state.trials.zero_()
        self._launch_check()
        wp.capture_while(state.proceed, self._launch_check)
        self._launch_step(state.step, direction, self._all)

    def _launch_check(self):
        self._launch_trial()
        self._sums.dot(self._pull, self._direction, self._state.trial_slope)
        given = [self._pulled, self._pairs.filter.fraction, HALVINGS]
        self.model.launch(check_quadratic, self.model.copies, given, [self._state])
