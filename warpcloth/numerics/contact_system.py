"""Steps of projective dynamics with contact: a constant matrix corrected by the Hessian of contact and friction."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.hessian import Hessian
from ..kernels.term import HessianPolicy
from .search import Search

# Of ‖b‖ in the norm of A⁻¹, to which systems are solved: contact changes from iteration to iteration.
TOLERANCE = 1e-3
ITERATIONS = 200


class ContactSystem:
    """Solves (A + D) w = ∇φ, D the semi-definite Hessian of contact, and shortens w until φ falls.

    The curvature of contact has no bound, so that no constant matrix is above it. A⁻¹ preconditions conjugate gradients, in
    which A p follows from the residuals: an iteration is a solve with A and a product with D, whose blocks belong to vertices.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        x: x̃ (N,) [m].
        linear: Solves with A, ``solve(b, x)``.
        sums: :class:`warpcloth.core.sums.Sums`.
        s: Weight of the inertia [1/s²].
    """

    def __init__(self, model, x, linear, sums, s):
        self.model, self.x, self._linear = model, x, linear
        touching = [elements for elements in model.terms if elements.collider is not None]
        self._hessian = Hessian(model, HessianPolicy.CLAMP, corrected=True, terms=touching)
        self._search = Search(model, x, sums, s)
        self._diagonal = self._hessian.diagonal.numpy()
        self._free = model.inverse_mass.numpy() > 0.0
        right, self._left = model.vectors(), model.vectors()
        self._blocks, self._right, self._found = Mirror(self._hessian.values), Mirror(right), Mirror(self._left)
        self._direction, self._step = Mirror(self._search.direction), Mirror(self._search.step)
        self._assemble = Segment(model.device, lambda: self._hessian.assemble(x, 0.0, self._search.correction))
        self._begin = Segment(model.device, self._search.launch_again)
        self._active = Mirror(model.scalars(wp.int32))
        self._shorten = Segment(model.device, lambda: self._search.launch(self._active.array))

    def correct(self, d, gradient, w, active):
        """w = t (A + D)⁻¹ ∇φ at d, from the A⁻¹ ∇φ that it is; where nothing is in contact it stays."""
        wp.copy(self._search.correction, d)
        self._assemble()
        blocks = self._blocks.read()[self._diagonal].astype(np.float64) * self._free[:, None, None]
        if not blocks.any():
            return
        found = self._solve(blocks, gradient.numpy().astype(np.float64), w.numpy().astype(np.float64))
        self._begin()
        self._direction.write(-found)
        self._active.write(active)
        self._shorten()
        steps = np.repeat(self._step.read(), self.model.per_copy)[:, None]
        self._found.write(steps * found)
        wp.copy(w, self._left)

    def _solve(self, blocks, b, z):
        """(A + D)⁻¹ b, from z = A⁻¹ b."""
        B = self.model.copies

        def dot(one, other):
            return np.einsum("bi,bi->b", one.reshape(B, -1), other.reshape(B, -1))

        def spread(values):
            return np.repeat(values, self.model.per_copy)[:, None]

        def over(one, other):
            return np.divide(one, other, out=np.zeros(B), where=other > 0.0)

        w, r, p, Ap = np.zeros_like(b), b.copy(), z, b.copy()
        rz = first = dot(r, z)
        for _ in range(ITERATIONS):
            q = Ap + np.einsum("nij,nj->ni", blocks, p)
            step = spread(over(rz, dot(p, q)))
            w, r = w + step * p, r - step * q
            self._right.write(r)
            self._linear.solve(self._right.array, self._left)
            z = self._found.read().astype(np.float64)
            before, rz = rz, dot(r, z)
            if not (rz > TOLERANCE**2 * first).any():
                break
            ratio = spread(over(rz, before))
            p, Ap = z + ratio * p, r + ratio * Ap
        return w
