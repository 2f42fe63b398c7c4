"""Steps of projective dynamics and ADMM with contact: a constant matrix corrected by the Hessian of contact and friction."""

import numpy as np
import warp as wp

from ..contact.no_filter import filter_of
from ..core.capture import Mirror, Segment
from ..core.dynamic import dynamic_of
from ..core.hessian import Hessian
from ..kernels.accelerate import plain_step
from ..kernels.contact.clear_elements import add_hessian
from ..kernels.term import HessianPolicy
from ..model.host_values import host_values
from .search import HALVINGS, Search

# An accurate solve ends at this residual, relative to b, in the norm of A⁻¹.
TOLERANCE = 1e-3
# A rough solve ends when the quadratic model of φ has fallen by the fraction SHARE of a bound of its total decrease, or when an
# iteration lowers it by at most the fraction LAST of its decrease so far. The projections of the next iteration change more.
SHARE, LAST = 0.7, 0.1
# Solves are accurate once ‖∇φ‖ is below this fraction of its largest value in a step, in the norm of A⁻¹, as Anderson
# acceleration needs.
NEAR = 1e-6
ITERATIONS = 200
# Change of ψ, relative to its summands, that counts as rounding.
NOISE = 1e-10


class CorrectedSystem:
    """Solves (A + D) w = b, D the semi-definite matrix of contact, by conjugate gradients with A⁻¹ as preconditioner.

    A p follows from the residuals, so that an iteration costs a solve with A and a product with D.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃ (N,) [m].
        linear: Solves with A, ``solve(b, x)``.

    Attributes:
        matrix: D, a :class:`warpcloth.core.hessian.Hessian`.
    """

    def __init__(self, model, x, linear):
        self.model, self.x, self._linear = model, x, linear
        right, self._result = model.vectors(), model.vectors()
        self._right, self._found = Mirror(right), Mirror(self._result)
        self.matrix = Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=(), dynamic=model.dynamic)
        self.matrix.prepare()
        self._p, self._q = Mirror(model.vectors()), Mirror(model.vectors())
        self._all = wp.full(model.copies, 1, dtype=wp.int32, device=model.device)
        self._free = model.coordinate_mobility().reshape(-1, 3) > 0.0

    def record(self):
        """Captures the launches of an iteration."""
        self._multiply = Segment(self.model.device, lambda: self.matrix.multiply(self._p.array, self._q.array, self._all))

    def _product(self, p):
        """Returns D p for p (N, 3)."""
        self._p.write(np.where(self._free, p, 0.0))
        self._multiply()
        return self._q.read().astype(np.float64)

    def _scaled(self, factors, array):
        """Returns the vectors (N, 3) of each copy times the factor of the copy, (B,)."""
        return (array.reshape(self.model.copies, -1) * factors[:, None]).reshape(array.shape)

    def _dot(self, one, other):
        B = self.model.copies
        return np.einsum("bi,bi->b", one.reshape(B, -1), other.reshape(B, -1))

    def _solve(self, b, z, Dz, going, closely):
        """Returns w = (A + D)⁻¹ b and A w of the copies that are ``going`` (B,).

        Args:
            b: Right-hand side.
            z: A⁻¹ b.
            Dz: D z.
            going: Which copies to solve for, (B,).
            closely: Which copies to solve accurately, (B,).
        """
        p, Ap, r, w, Aw, fall = z, b, b, 0.0, 0.0, 0.0
        rz = first = self._dot(r, z)
        for iteration in range(ITERATIONS):
            q = Ap + (Dz if iteration == 0 else self._product(p))
            step = self._over(rz, self._dot(p, q), going)
            w, Aw = w + self._scaled(step, p), Aw + self._scaled(step, Ap)
            fall = fall + step * rz
            enough = (fall >= SHARE * first) | ((step * rz <= LAST * fall) & (iteration > 0))
            going = going & (closely | ~enough)
            if not going.any():
                break
            r = r - self._scaled(step, q)
            self._right.write(r)
            self._linear.solve(self._right.array, self._result)
            z = self._found.read().astype(np.float64)
            before, rz = rz, self._dot(r, z)
            going = going & (rz > TOLERANCE**2 * first)
            if not going.any():
                break
            ratio = self._over(rz, before, going)
            p, Ap = z + self._scaled(ratio, p), r + self._scaled(ratio, Ap)
        return w, Aw

    def _over(self, one, other, where):
        return np.divide(one, other, out=np.zeros(self.model.copies), where=where & (other > 0.0))


class ContactSystem(CorrectedSystem):
    """Solves (A + D) w = ∇φ, D the semi-definite Hessian of contact: accurately if φ rose or is near its minimum, else roughly.

    The curvature of contact has no bound, so no constant matrix is an upper bound of the Hessian. A copy where φ rose is
    ``careful`` in the next 4 iterations, after a second rise in 16, and so on: w is then also shortened until φ falls. With
    self-contact all solves are accurate, because a rough w runs into pairs, which then stop the whole copy. In other copies the
    blocks of vertices near colliders are those of :func:`warpcloth.kernels.contact.clear_elements.add_hessian`.
    Without :meth:`start`, all copies always are careful.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃ (N,) [m].
        gradient: ∇φ (N,) [N] at the d of :meth:`correct`; the caller's array, read only.
        linear: Solves with A, ``solve(b, x)``.
        sums: :class:`warpcloth.core.sums.Sums`.
        s: Weight of the inertia [1/s²].

    Attributes:
        careful: Which copies are careful, (B,) booleans.
    """

    def __init__(self, model, x, gradient, linear, sums, s, pairs):
        super().__init__(model, x, linear)
        touching = [elements for elements in model.terms if elements.collider is not None]
        self._touching = [(elements, model.kernel(add_hessian, elements.term, model.dtype)) for elements in touching]
        held = model.inverse_mass.numpy() == 0.0
        self._diagonal = wp.array(np.where(held, -1, self.matrix.diagonal.numpy()), dtype=wp.int32, device=model.device)
        self._gradient, self._inertia = gradient, model.array(s * host_values(model.mass), model.dtype) if touching else None
        self._search, self._pairs = Search(model, x, sums, s, filter_of(pairs)), pairs
        self._listed = None if pairs is None else Mirror(pairs.listed)
        self._direction, self._step = Mirror(self._search.direction), Mirror(self._search.step)
        self._active = Mirror(model.scalars(wp.int32))
        self.careful, self._marked = np.ones(model.copies, dtype=bool), np.zeros(model.copies, dtype=bool)
        self._marks = Mirror(model.scalars(wp.int32))  # the careful copies on the device
        self.record()
        self._left, self._more = (np.zeros(model.copies, dtype=int) for _ in range(2))
        self._start = np.zeros(model.copies)

    def record(self):
        super().record()
        device, search = self.model.device, self._search
        self._assemble = Segment(device, self._launch_assemble)
        self._begin = Segment(device, search.launch_again)
        self._shorten = Segment(device, self._launch_shorten)

    def _launch_shorten(self):
        filter_of(self._pairs).launch_limit(self._search.direction)
        self._search.launch(self._active.array)

    def _launch_assemble(self):
        self.matrix.assemble(self.x, 0.0, self._search.correction, self._launch_touching)

    def _launch_touching(self, values):
        """Adds the blocks of vertices near colliders."""
        for elements, kernel in self._touching:
            given = [*elements.arguments, elements.clear, self._diagonal, self.x, self._search.correction]
            given += [self._gradient, self._inertia, self._marks.array, self.model.per_copy]
            self.model.launch(kernel, elements.count, given, [values])

    def start(self):
        """Makes no copy careful, before the first iteration of a step whose iterates stay if φ would rise."""
        self.careful[:], self._left[:], self._more[:], self._start[:] = False, 0, 1, 0.0

    def note(self, rose):
        """Notes in which copies φ rose in the last iteration, (B,) booleans."""
        self._more = np.where(rose, np.minimum(4 * self._more, ITERATIONS), self._more)
        self._left = np.where(rose, self._more, self._left - 1)
        self.careful = self._left > 0

    def correct(self, d, w, active):
        """Replaces w = A⁻¹ ∇φ by (A + D)⁻¹ ∇φ at d, for careful copies times a step length."""
        if not (self._touching or self.careful.any() or self._listed.read()[0]):
            return  # D is 0
        wp.copy(self._search.correction, d)
        if (self.careful != self._marked).any():
            self._marked[:] = self.careful
            self._marks.write(self.careful)
        self._assemble()
        found = w.numpy().astype(np.float64)
        pressed = self._product(found)
        if pressed.any():
            b = self._gradient.numpy().astype(np.float64)
            first = self._dot(b, found)
            self._start = np.maximum(self._start, first)
            closely = self.careful | (first <= NEAR**2 * self._start) | (self._pairs is not None)
            found, _ = self._solve(b, found, pressed, active, closely)
        elif not self.careful.any():
            return
        if self.careful.any():
            self._begin()
            self._direction.write(-found)
            self._active.write(active & self.careful)
            self._shorten()
            step = self._step.read() if self._pairs is None else self._step.read() * self._pairs.filter.fraction.numpy()
            found = self._scaled(np.where(self.careful, step, 1.0), found)
        self._found.write(found)
        wp.copy(w, self._result)


class PairSystem(CorrectedSystem):
    """Lowers ψ(d) = ½(d − c)ᵀA(d − c) + U(d), U the energy of dynamic elements, by Newton's method with a line search.

    Args:
        model, x, linear: See :class:`CorrectedSystem`.
        sums: :class:`warpcloth.core.sums.Sums`.
        d, w: d and A⁻¹∇ψ there (N,) [m], the caller's arrays.
    """

    def __init__(self, model, x, linear, sums, pairs, d, w):
        super().__init__(model, x, linear)
        self._pairs, self._d, self._w, self._plain_step = pairs, d, w, model.kernel(plain_step, model.dtype)
        self._sums, self._dynamic = sums, dynamic_of(model)
        trial, pull = model.vectors(), model.vectors()
        self._trial, self._pull, self._energy = Mirror(trial), Mirror(pull), Mirror(model.scalars())
        self.record()

    def record(self):
        super().record()
        device, trial = self.model.device, self._trial.array
        self._press = Segment(device, self._launch_press)
        self._bound = Segment(device, lambda: self._pairs.filter.launch_limit(self._pull.array))
        self._look = Segment(device, self._launch_look)
        self._assemble = Segment(device, lambda: self.matrix.assemble_after_gradient(self.x, 0.0, trial))

    def _launch_press(self):
        """Launches U and ∂U/∂x at the trial."""
        self._pairs.filter.launch_trial(self.x, self._trial.array, part=0.5)
        self._dynamic.launch(self.x, self._trial.array)
        self._energy.array.zero_()
        self._dynamic.add_energy(self._sums, self._energy.array)
        self._pull.array.zero_()
        self._dynamic.add_gradient(self._pull.array)
        self.model.lock(self._pull.array)

    def _launch_look(self):
        """Tests whether cloth may be near other cloth on the way from d to d − w."""
        given = [self._d, self._w, self._all, self.model.per_copy]
        self.model.launch(self._plain_step, self.model.count, given, [self._trial.array])
        self._pairs.filter.launch_look(self.x, (self._trial.array,))

    def _pressed(self, d):
        self._trial.write(d)
        self._press()
        return self._energy.read().copy(), self._pull.read().astype(np.float64)

    def _limited(self, *vectors):
        """Returns ``vectors`` times the fraction for which pairs stay apart while d moves by minus the first of them."""
        self._pull.write(-vectors[0])
        self._bound()
        return (self._scaled(self._pairs.filter.fraction.numpy(), each) for each in vectors)

    def correct(self, gradient, active):
        """Replaces w = A⁻¹ ∇ψ by t (A + D)⁻¹ ∇ψ at d, 0 < t ≤ 1. Away from other cloth w minimises ψ as it is."""
        self._look()
        if not self._pairs.near.read()[0]:
            return
        d, b, found = (array.numpy().astype(np.float64) for array in (self._d, gradient, self._w))
        energy, pull = self._pressed(d)
        self._assemble()
        Aw, pressed = b, self._product(found)
        if pressed.any():
            found, Aw = self._solve(b, found, pressed, active, True)
        found, Aw = self._limited(found, Aw)
        slope, linear, square = (self._dot(one, found) for one in (b, b - pull, Aw))
        step, wanted = np.ones(self.model.copies), active & (slope > 0.0)
        for _ in range(HALVINGS):
            after, now = self._pressed(d - self._scaled(step, found))
            change = after - energy - step * linear + 0.5 * step**2 * square
            with np.errstate(invalid="ignore"):
                level = np.abs(change) <= NOISE * (np.abs(energy) + step * np.abs(linear))
                rises = step * square - linear - self._dot(now, found)
                lower = (change <= -1e-4 * step * slope) | (level & (rises <= 0.8 * slope))
            wanted = wanted & ~lower
            if not wanted.any():
                break
            step = np.where(wanted, 0.5 * step, step)
        self._found.write(self._scaled(step, found))
        wp.copy(self._w, self._result)
