"""Steps of projective dynamics with contact: a constant matrix corrected by the Hessian of contact and friction."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from .search import Search

# Of ‖b‖ in the norm of A⁻¹, to which systems are solved closely.
TOLERANCE = 1e-3
# Roughly: until the quadratic model of φ has fallen by this share of a bound of its whole fall, or falls in an iteration by no
# more than that part of its fall so far. The projections of the next iteration change more than what is left.
SHARE, LAST = 0.7, 0.1
# Of the largest ‖∇φ‖ of a step in the norm of A⁻¹, below which systems are solved closely, as Anderson acceleration needs.
NEAR = 1e-6
ITERATIONS = 200


class ContactSystem:
    """Solves (A + D) w = ∇φ, D the semi-definite Hessian of contact: closely where φ rose or is nearly least, else roughly.

    The curvature of contact has no bound, so that no constant matrix is above it. A⁻¹ preconditions conjugate gradients, in
    which A p follows from the residuals: an iteration is a solve with A and a product with D, whose blocks belong to vertices.
    Copies whose φ rose are ``careful`` in the next 4 iterations, after the second time in 16, and so on: w is then also
    shortened until φ falls. Without :meth:`start` all always are.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃ (N,) [m].
        linear: Solves with A, ``solve(b, x)``.
        sums: :class:`warpcloth.core.sums.Sums`.
        s: Weight of the inertia [1/s²].

    Attributes:
        careful: Which copies are, (B,) truth values.
    """

    def __init__(self, model, x, linear, sums, s):
        self.model, self.x, self._linear = model, x, linear
        touching = [elements for elements in model.terms if elements.collider is not None]
        self._hessian = Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=touching)
        self._search = Search(model, x, sums, s)
        self._diagonal = self._hessian.diagonal.numpy()
        self._free = model.inverse_mass.numpy() > 0.0
        right, self._result = model.vectors(), model.vectors()
        self._blocks, self._right, self._found = Mirror(self._hessian.values), Mirror(right), Mirror(self._result)
        self._direction, self._step = Mirror(self._search.direction), Mirror(self._search.step)
        self._assemble = Segment(model.device, lambda: self._hessian.assemble(x, 0.0, self._search.correction))
        self._begin = Segment(model.device, self._search.launch_again)
        self._active = Mirror(model.scalars(wp.int32))
        self._shorten = Segment(model.device, lambda: self._search.launch(self._active.array))
        self.careful = np.ones(model.copies, dtype=bool)
        self._left, self._more = (np.zeros(model.copies, dtype=int) for _ in range(2))
        self._start = np.zeros(model.copies)

    def start(self):
        """Before the first iteration of a step whose iterates stay where they are if φ would rise: no copy is careful."""
        self.careful[:], self._left[:], self._more[:], self._start[:] = False, 0, 1, 0.0

    def note(self, rose):
        """Notes where φ rose in the last iteration, (B,) truth values."""
        self._more = np.where(rose, 4 * self._more, self._more)
        self._left = np.where(rose, self._more, self._left - 1)
        self.careful = self._left > 0

    def correct(self, d, gradient, w, active):
        """w = (A + D)⁻¹ ∇φ at d, of careful copies t times that, from the A⁻¹ ∇φ that it is."""
        wp.copy(self._search.correction, d)
        self._assemble()
        blocks = self._blocks.read()[self._diagonal] * self._free[:, None, None]
        touching = np.flatnonzero(blocks.any(axis=(1, 2)))
        if not (len(touching) or self.careful.any()):
            return
        found = w.numpy().astype(np.float64)
        if len(touching):
            blocks = blocks[touching].astype(np.float64)
            found = self._solve(touching, blocks, gradient.numpy().astype(np.float64), found, active)
        if self.careful.any():
            self._begin()
            self._direction.write(-found)
            self._active.write(active & self.careful)
            self._shorten()
            found *= self._spread(np.where(self.careful, self._step.read(), 1.0))
        self._found.write(found)
        wp.copy(w, self._result)

    def _spread(self, values):
        return np.repeat(values, self.model.per_copy)[:, None]

    def _solve(self, touching, blocks, b, z, going):
        """(A + D)⁻¹ b of the copies that are ``going``, from z = A⁻¹ b; D has ``blocks`` at the vertices ``touching``."""
        B = self.model.copies

        def dot(one, other):
            return np.einsum("bi,bi->b", one.reshape(B, -1), other.reshape(B, -1))

        def over(one, other):
            return np.divide(one, other, out=np.zeros(B), where=going & (other > 0.0))

        w, r, p, Ap, fall = np.zeros_like(b), b.copy(), z, b.copy(), np.zeros(B)
        rz = first = dot(r, z)
        self._start = np.maximum(self._start, first)
        closely = self.careful | (first <= NEAR**2 * self._start)
        for iteration in range(ITERATIONS):
            q = Ap.copy()
            q[touching] += np.einsum("nij,nj->ni", blocks, p[touching])
            step = over(rz, dot(p, q))
            w, r = w + self._spread(step) * p, r - self._spread(step) * q
            fall += step * rz
            enough = (fall >= SHARE * first) | ((step * rz <= LAST * fall) & (iteration > 0))
            going = going & (closely | ~enough)
            if not going.any():
                break
            self._right.write(r)
            self._linear.solve(self._right.array, self._result)
            z = self._found.read().astype(np.float64)
            before, rz = rz, dot(r, z)
            going = going & (rz > TOLERANCE**2 * first)
            if not going.any():
                break
            ratio = self._spread(over(rz, before))
            p, Ap = z + ratio * p, r + ratio * Ap
        return w
