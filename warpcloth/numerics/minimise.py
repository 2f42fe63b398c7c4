"""Newton's method with a line search on φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d, shared by motion and equilibrium."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.hessian import Hessian
from ..core.status import Result
from ..core.sums import Sums
from ..kernels.elementwise import negate
from ..kernels.linear import rounding
from ..kernels.term import HessianPolicy
from .iterate import GravityScale, iterate
from .linear import ConjugateGradients, Factorised
from .search import Search

# Number of roundings in a force: of lengths, strain, products, and the sum over the elements of a vertex.
ROUNDINGS = 4.0
# Typical rounding of the energy relative to its worst case, because roundings add up like a random walk.
TYPICAL = 0.1

POLICIES = {
    "adaptive": HessianPolicy.RAW,
    "raw": HessianPolicy.RAW,
    "clamp": HessianPolicy.CLAMP,
    "absolute": HessianPolicy.ABSOLUTE,
}


class Minimiser:
    """Minimises φ(d) of each copy from d = 0; the docstring of the module has the equation.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        base: The positions at d = 0, (N,) vectors [m]; the caller's array, read only.
        hessian: ``"adaptive"`` (raw, but clamped in iterations whose matrix has a negative curvature), ``"raw"``, ``"clamp"``
            or ``"absolute"``.
        linear: ``"cg"`` or ``"factorised"``.
        s: Weight of the inertia, 1/h² [1/s²].
        linear_iterations: Maximum number of iterations of a conjugate gradient solve.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, whose energy is added; or None.

    Attributes:
        correction: d (N,) [m].
        residual: The largest unbalanced acceleration of each copy divided by ``scale``, (B,), after :meth:`minimise`.
        scale: The acceleration by which the residual of each copy is divided, (B,) [m/s²], after :meth:`minimise`.
        iterations: Number of Newton iterations of the last :meth:`minimise`.
    """

    def __init__(self, model, base, hessian, linear, s, linear_iterations=10_000, pairs=None):
        self.model, self.base, self.pairs = model, base, pairs
        self.adaptive = hessian == "adaptive"
        self.sums = Sums(model)
        self.search = Search(model, base, self.sums, s, pairs)
        self.correction = self.search.correction
        self.hessian = Hessian(model, POLICIES[hessian], corrected=True, pairs=pairs)
        if linear == "cg":
            self.linear = ConjugateGradients(self.hessian, self.sums, linear_iterations)
        else:
            self.linear = Factorised(self.hessian)
        if pairs is not None:
            self.hessian.prepare()
            self.preconditioner = wp.zeros(model.count, dtype=model.mat33, device=model.device)
        self.right = model.vectors()
        self.work, self.lost = (wp.zeros(model.count, dtype=wp.float64, device=model.device) for _ in range(2))

        self.square, self.rounding, self.lost_energy, self.acceleration = (model.scalars() for _ in range(4))
        self.active = model.scalars(wp.int32)
        self._active, self._policy = Mirror(self.active), Mirror(self.hessian.policy)
        search = self.search
        read = (search.energy, self.square, self.rounding, self.lost_energy, search.step, search.slope)
        self._energy, self._square, self._rounding, self._lost, self._step, self._slope = (Mirror(array) for array in read)
        self._acceleration = Mirror(self.acceleration)
        self.edge = float(np.median(model.scene.mesh.edge_lengths))
        self.resolution = 4.0 * float(np.finfo(model.numpy_dtype).eps)
        self._launch = model.launcher(((negate, rounding), model.dtype))
        self.record()
        self.gravity_scale, self._given_scale = GravityScale(model), None
        self.residual, self.iterations = np.zeros(model.copies), 0

    def record(self):
        """Records what an iteration launches."""
        device = self.model.device
        self._clear = Segment(device, self._launch_clear)
        self._assemble = Segment(device, self._launch_assemble)
        self._solve = Segment(device, self._launch_solve) if self.linear.capturable else self._launch_solve
        self._step_on = Segment(device, self._launch_search)

    def set_objective(self, s, load):
        """Sets s and load, and captures again the launches that have the old values."""
        self.search.inertia.s, self.search.inertia.load = s, load
        self.record()

    def minimise(self, tolerance, iterations, scale=None):
        """Iterates until every copy has converged, or rounding allows no further progress.

        A copy has converged if max ‖∇φᵢ‖/mᵢ ≤ ``tolerance``·a. The acceleration a is ``scale`` (B,) [m/s²], by default gravity,
        or without gravity the largest acceleration at d = 0. Rounding allows no progress if ‖∇φ‖ is within its rounding,
        4ε(Σⱼ‖Hᵢⱼ‖(‖xⱼ − xᵢ‖ + ‖dⱼ‖) + ‖Hᵢᵢ‖·edge) per vertex, and an iteration lowered φ by no more than rounding. The norm
        alone would not do, because the noise of stiff directions may hide the error of soft ones.

        Returns:
            A :class:`Result` for each copy.
        """
        self._given_scale = scale
        ended = iterate(self, tolerance, iterations)
        self.residual, self.iterations = ended.residual, ended.iterations
        return ended.results

    # The loop of `iterate`.

    def start(self):
        """Starts from d = 0."""
        self.clear()
        acceleration = self._acceleration.read()
        self.scale = self.gravity_scale.or_else(acceleration) if self._given_scale is None else self._given_scale
        # Linear systems are solved more accurately as the residual falls (Eisenstat and Walker 1996).
        self._first = np.maximum(acceleration / self.scale, 1.0)
        self._before = self._energy.read().copy()
        self._ended = {}

    def measure(self):
        """Returns the residual of each copy (B,), and which copies end for another reason."""
        self.residual = self._acceleration.read() / self.scale
        return self.residual, self._ended

    def iterate(self, active):
        """Takes a line-searched step along the Newton direction."""
        self._active.write(active)
        if self.linear.capturable:
            self.linear.tolerance.write(np.clip(self.residual / self._first, 1e-12, 0.1))
        self._find_direction()
        self._step_on()
        noisy = self._square.read() <= ROUNDINGS**2 * self._rounding.read()
        before, self._before = self._before, self._energy.read().copy()
        with np.errstate(invalid="ignore"):  # a copy may be NaN or infinite
            level = before - self._before <= self.resolution * np.abs(before) + TYPICAL * self._lost.read()
        # A copy is stuck if the search found no step, or the direction does not descend.
        stuck = (self._step.read() == 0.0) | ~(self._slope.read() < 0.0)
        self._ended = {Result.ROUNDED: noisy & (stuck | level), Result.STALLED: stuck & ~noisy}

    def _find_direction(self):
        if self.adaptive:
            self._policy.write(int(HessianPolicy.RAW))
        self._assemble()
        self._solve()
        if self.adaptive and (negative := self.linear.negative.read()).any():
            self._policy.write(negative * int(HessianPolicy.CLAMP))
            self._assemble()
            self._solve()

    def curves_down(self, tolerance):
        """Returns whether the raw Hessian at d = 0 of a copy has a negative eigenvalue that ``tolerance`` does not explain.

        An equilibrium to ``tolerance`` may have an unbalanced force of ``tolerance`` times the scale and the mass of the cloth.
        Such a force in an edge can lower an eigenvalue by the force over the edge length [N/m]. A sheet without bending
        stiffness has no other resistance to motion out of its plane.
        """
        self._assemble_raw()
        unresolved = tolerance * float((self.scale * self.model.mass.numpy().reshape(self.model.copies, -1).sum(axis=1)).max())
        return Factorised(self.hessian).curves_down(unresolved / self.edge)

    def lowest_eigenvalue(self):
        """Returns the lowest eigenvalue of the raw Hessian at d = 0 over the free vertices of the first copy [N/m]."""
        self._assemble_raw()
        return Factorised(self.hessian).lowest_eigenvalue()

    def unbalanced(self):
        """Returns Σ‖∇φᵢ‖ at d of each copy, (B,) [N]."""
        gradient = self.search.gradient.numpy().astype(np.float64).reshape(self.model.copies, -1, 3)
        return np.linalg.norm(gradient, axis=2).sum(axis=1)

    def _assemble_raw(self):
        before = self._policy.read().copy()
        self.clear()
        self._policy.write(int(HessianPolicy.RAW))
        self._active.write(1)
        self._assemble()
        self._policy.write(before)

    def clear(self):
        """Sets d = 0 and everything that depends on it."""
        self._clear()

    # What the segments record.

    def _launch_clear(self):
        self.search.launch_start()
        self._launch_norms()

    def _launch_assemble(self):
        if self.pairs is not None:
            self.pairs.filter.launch_relist(self.base, self.correction, self.active, self.search.launch_again)
        self.hessian.assemble(self.base, self.search.inertia.s, self.correction)
        hessian, model = self.hessian, self.model
        self._launch(negate, model.count, [self.search.gradient], [self.right])
        given = [hessian.offsets, hessian.columns, hessian.diagonal, hessian.values, self.base, self.correction]
        given += [np.finfo(model.numpy_dtype).eps, self.edge]
        self._launch(rounding, model.count, given, [self.work, self.lost])
        for values, total in ((self.work, self.rounding), (self.lost, self.lost_energy)):
            self.sums.sum(values, model.per_copy, total)

    def _launch_solve(self):
        self.linear.solve(self.right, self.search.direction, self.active)

    def _launch_search(self):
        if self.pairs is not None:
            self.hessian.invert_diagonal(self.preconditioner)
            given = self.search.gradient, self.preconditioner, self.right, self.search.direction, self.active
            self.pairs.filter.launch_limit(self.sums, *given)
        self.search.launch(self.active)
        self._launch_norms()

    def _launch_norms(self):
        """Launches ‖∇φ‖² and the largest unbalanced acceleration at d."""
        gradient = self.search.gradient
        self.sums.dot(gradient, gradient, self.square)
        self.sums.largest(self.model.inverse_mass, gradient, self.acceleration)
