"""Newton's method with a line search on φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d, shared by motion and equilibrium."""

from functools import partial

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.hessian import Hessian
from ..core.no_filter import filter_of
from ..core.status import Result
from ..core.sums import Sums
from ..kernels import minimise as kernels
from ..kernels.contact.clear_elements import move_clear
from ..kernels.contact.self_filter import aim, copies_near_colliders
from ..kernels.elementwise import mismatch
from ..kernels.linear import rounding
from ..kernels.term import HessianPolicy
from ..kernels.terms.air import AIR
from .additive_multigrid import multigrid_of
from .linear import ConjugateGradients, Factorised
from .multigrid import MIN_VERTICES
from .preconditioner_choice import PreconditionerChoice
from .search import Search

POLICIES = {
    "adaptive": HessianPolicy.RAW,
    "raw": HessianPolicy.RAW,
    "clamp": HessianPolicy.CLAMP,
    "absolute": HessianPolicy.ABSOLUTE,
}


def _resembles_the_last_step(model):
    """Whether the correction of a step is a good start of the next one.

    After an impact it is not: long midpoint steps would gain energy. In rigid clusters its rounding would hide the descent.
    """
    touches = model.scene.self_contact is not None or model.colliders is not None
    return not touches and all(elements.cells is None for elements in model.terms)


def _free_axes(model, near):
    """Returns along which axes moves of the whole cloth change no energy, (3,) booleans.

    Terms of one vertex, meshes, air, pins and locks hold the cloth, and so does contact where copies are ``near`` (None: all).
    """
    held = any(collider.is_mesh for collider in model.scene.colliders) or any(
        near is None
        if elements.collider is not None
        else elements.term is AIR or (elements.term.vertices == 1 and not elements.cells)
        for elements in model.terms
    )
    return (model.coordinate_mobility().reshape(-1, 3) > 0.0).all(axis=0) & (not held)


class Minimiser:
    """Minimises φ(d) of each copy.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        base: The positions at d = 0, (N,) vectors [m]; read only.
        hessian: ``"adaptive"`` (raw, its negative part reduced where the matrix is indefinite), ``"raw"``, ``"clamp"`` or
            ``"absolute"``.
        linear: ``"cg"`` or ``"factorised"``.
        s: Weight of the inertia, 1/h² [1/s²].
        linear_iterations: Maximum number of iterations of a conjugate gradient solve.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, whose filter bounds steps; or None. A descent then starts at the
            start of the step or at the last d.
        last: The array for d (N,) [m], which holds that of the last step. Without contact a descent starts there if φ is lower
            than at d = 0. None: every descent starts from d = 0.
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps`, or None. Near them a descent without pairs
            starts from d = 0, their contact distance, the start of the step or the last d, wherever φ is lowest. d = 0 may be
            so deep inside that rounding of the way out moves cloth along the collider.

    Attributes:
        correction: d (N,) [m].
        residual: The largest unbalanced acceleration of each copy divided by ``scale``, (B,), after :meth:`minimise`.
        kept: Arrays (B,) by name that one :meth:`minimise` passes to the next, besides ``last``.
        scale: The acceleration by which residuals are divided, (B,) [m/s²].
        iterations: Number of Newton iterations of the last :meth:`minimise`.
    """

    def __init__(self, model, base, hessian, linear, s, linear_iterations=10_000, pairs=None, last=None, colliders=None):
        self.model, self.base, self.pairs, self._colliders = model, base, pairs, colliders
        self._near = near = None if colliders is None else colliders.near
        self._solid = () if pairs is not None or colliders is None else colliders.solid
        self._last = last is not None
        self.warm = self._last and _resembles_the_last_step(model)
        self.adaptive = hessian == "adaptive"
        self.sums = Sums(model)
        self.filter = filter_of(pairs)
        self.search = Search(model, base, self.sums, s, self.filter, last)
        self.correction = self.search.correction
        self.hessian = Hessian(model, POLICIES[hessian], corrected=True)
        if linear == "cg":
            multigrid = multigrid_of(self.hessian) if model.per_copy >= MIN_VERTICES else None
            choice = multigrid and PreconditionerChoice(multigrid, linear_iterations)
            self.linear = ConjugateGradients(self.hessian, linear_iterations, multigrid, choice)
            self.kept = choice.kept if choice else {}
        else:
            self.linear, self.kept = Factorised(self.hessian), {}
        self.right = model.vectors()
        lanes = self.search.lanes
        self._roundings = lanes.parts(3)
        self.edge = float(np.median(model.scene.mesh.edge_lengths))
        self.resolution = 4.0 * float(np.finfo(np.float64).eps)  # of energies, whatever the precision of the model
        self._allocate_progress()
        self._inverse_total = None
        axes = _free_axes(model, near)
        if axes.any():
            total = model.mass.numpy().astype(np.float64).reshape(model.copies, -1).sum(axis=1)
            self._inverse_total = wp.array(axes / total[:, None], dtype=wp.vec3d, device=model.device)
            self._moments = lanes.parts(3)
        of_means = (kernels.mean_parts, kernels.take_mean) if axes.any() else ()
        of_copies = kernels.begin_descent, kernels.note_stay, kernels.begin_newton, kernels.find_indefinite
        self._launch = model.launcher(
            ((rounding, *of_means), model.dtype, lanes.block),
            (of_copies,),
            ((kernels.end_newton,), lanes.block),
        )
        self.record()
        self.residual, self.iterations = np.zeros(model.copies), 0

    def _allocate_progress(self):
        model, flag = self.model, partial(wp.zeros, 1, dtype=wp.int32, device=self.model.device)
        self._progress, self._limits = kernels.DescentState(), kernels.Limits()
        for name in ("active", "stays", "end", "iterations"):
            setattr(self._progress, name, model.scalars(wp.int32))
        for name in ("residual", "previous"):
            setattr(self._progress, name, model.scalars())
        self._progress.proceed, self._progress.more = flag(), flag()
        self._limits.tolerance, self._limits.scale = wp.zeros(1, dtype=wp.float64, device=model.device), model.scalars()
        self._limits.iterations = flag()
        self.active, self._unsolved = self._progress.active, flag()
        self._wanted, self._hopeful = model.scalars(wp.int32), model.scalars(wp.int32)
        read = ("end", "iterations", "residual", "proceed")
        self._read = {name: Mirror(getattr(self._progress, name)) for name in read}
        self._given = {name: Mirror(getattr(self._limits, name)) for name in ("tolerance", "iterations", "scale")}
        self._left = Mirror(self._unsolved)
        self.scale, self._present = None, None

    def record(self):
        """Captures what :meth:`minimise` launches."""
        device = self.model.device
        self._start = Segment(device, self._launch_start)
        if self.linear.capturable:
            self._go_on = Segment(device, self._launch_iterations)
            return
        launches = self._launch_begin, self._launch_assemble, self._launch_find, self._launch_end
        self._begin, self._assemble, self._find, self._end = (Segment(device, launch) for launch in launches)
        self._go_on = self._iterate

    def set_objective(self, s, load):
        """Sets s and load, and captures again the launches that have the old values."""
        self.search.inertia.s, self.search.inertia.load = s, load
        self.record()

    def minimise(self, tolerance, iterations, scale):
        """Iterates until every copy has converged, or rounding allows no further progress.

        A copy has converged if max ‖∇φᵢ‖/mᵢ ≤ ``tolerance``·a, a = ``scale`` (B,) [m/s²], above 0. Rounding allows no progress
        if ‖∇φ‖ is within four times its rounding, and an iteration lowered φ by no more than rounding. The norm alone would not
        do, because the noise of stiff directions may hide the error of soft ones.

        If the linear solver runs on the device, so does the loop: the host waits once in ``AT_ONCE`` iterations.

        Returns:
            A :class:`Result` for each copy.
        """
        self.scale = scale
        self._set_limits(tolerance, iterations, scale)
        self._start()
        self._go_on()
        while self._read["proceed"].read()[0]:
            self._go_on()
        self.residual = self._read["residual"].read().copy()
        self.iterations = int(self._read["iterations"].read().max())
        return [Result[kernels.End(end).name] for end in self._read["end"].read()]

    def _set_limits(self, tolerance, iterations, scale):
        present = tolerance, iterations, scale.tobytes()
        if present != self._present:
            for name, value in (("tolerance", tolerance), ("iterations", iterations), ("scale", scale)):
                self._given[name].write(value)
            self._present = present

    def _iterate(self):
        """Iterates with a linear solver of the host."""
        while self._read["proceed"].read()[0]:
            self._begin()
            while self._left.read()[0]:
                self._assemble()
                self._launch_solve(self._wanted)
                self._find()
            self._end()

    def curves_down(self, tolerance):
        """Returns whether the raw Hessian at d = 0 of a copy has a negative eigenvalue that ``tolerance`` does not explain.

        An equilibrium may have an unbalanced force of ``tolerance`` times the scale and the mass of the cloth. In an edge it
        can lower an eigenvalue by the force over the edge length [N/m].
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
        policy, before = self.hessian.policy, self.hessian.policy.numpy()
        self.clear()
        policy.fill_(float(HessianPolicy.RAW))
        self.active.fill_(1)
        self._launch_assemble()
        policy.assign(before)

    def clear(self):
        """Launches d = 0 and everything that depends on it."""
        self.search.launch_start()

    # What the segments record.

    def _launch_start(self):
        """Launches the start where φ is lowest."""
        if self._last:
            wp.copy(self.right, self.correction)
        self.clear()
        self.linear.outdate()
        self.active.fill_(1)
        self._progress.stays.zero_()
        if self.warm:
            self._launch_mean(self.right)
            wp.copy(self.search.direction, self.right)
            self.search.launch_guess(self.active)
        elif self._solid:
            self._unsolved.zero_()
            given = [self._near, self.active, self._near is None]
            self.model.launch(copies_near_colliders, self.model.copies, given, [self._wanted, self._unsolved])
            wp.capture_if(self._unsolved, self._launch_beside)
        elif self.pairs is not None and self._last:
            self._note_stay(1, self.filter.fraction)
            self.filter.launch_touching(self.active, self._wanted, self._unsolved)
            wp.capture_if(self._unsolved, self._launch_apart)
        self._progress.proceed.zero_()
        given = [self.search.acceleration, self._limits]
        self._launch(kernels.begin_descent, self.model.copies, given, [self._progress])

    def _launch_apart(self):
        """Launches the start from the start of the step or from the last d, as far as pairs stay apart.

        Cloth at rest is almost in balance at the start of the step, while contact would push it back from x̃, h²g below. Cloth
        that slides is so at the last d.
        """
        for goal, stays in (self.filter.back, 1), (self.right, 0):
            self.filter.launch_aim(goal, self.correction, self.search.direction)
            self.search.launch_bound(self._wanted, self._hopeful, self._unsolved)
            wp.capture_if(self._unsolved, self._launch_if_apart, stays=stays)

    def _launch_if_apart(self, stays):
        self.filter.launch_whole(self.search.direction, self._hopeful, self._unsolved)
        wp.capture_if(self._unsolved, self._launch_guess, stays=stays)

    def _launch_guess(self, stays):
        self.search.launch_guess(self._hopeful)
        self._note_stay(stays)

    def _launch_beside(self):
        """Launches the start of vertices near colliders at the contact distance, at the start of the step, or at the last d."""
        model, x, direction = self.model, self.search.trial, self.search.direction
        wp.copy(x, self.base)
        for elements in self._solid:
            given = [elements.stencil, elements.rest, model.inverse_mass]
            model.launch(model.kernel(move_clear, elements.term, model.dtype), elements.count, given, [x])
        for goal, stays in (x, 0), (self._colliders.x_before, 1), (None, 0):
            if goal is not None:
                model.launch(model.kernel(mismatch, model.dtype), model.count, [goal, self.base], [direction])
            given = [model.inverse_mass, model.mobility, self.right if goal is None else direction, self.correction]
            model.launch(model.kernel(aim, model.dtype), model.count, [*given, True, False, None, model.per_copy], [direction])
            self.search.launch_guess(self._wanted)
            self._note_stay(stays)

    def _note_stay(self, value, fraction=None):
        given = [self.search.state.moved, fraction, value]
        self._launch(kernels.note_stay, self.model.copies, given, [self._progress])

    def _launch_iterations(self):
        """Launches iterations until no copy is active, but at most ``AT_ONCE``."""
        wp.copy(self._progress.more, self._progress.proceed)
        wp.capture_while(self._progress.more, self._launch_iteration)

    def _launch_iteration(self):
        self._launch_begin()
        if self.adaptive:
            wp.capture_while(self._unsolved, self._launch_direction)
        else:
            self._launch_direction()
        self._launch_end()

    def _launch_direction(self):
        """Launches assembly and solution for the copies that are ``_wanted``, and finds those to be solved clamped."""
        self._launch_assemble()
        self._launch_solve(self._wanted)
        self._launch_find()

    def _launch_begin(self):
        out = [self._progress, self.hessian.policy, self.linear.tolerance, self._wanted, self._unsolved]
        self._launch(kernels.begin_newton, self.model.copies, [int(self.adaptive), self._limits], out)

    def _launch_find(self):
        """Launches the choice of the copies that are solved again, with a clamped Hessian."""
        self._unsolved.zero_()
        if self.adaptive:
            out = [self.hessian.policy, self.linear.outdated, self._wanted, self._unsolved]
            self._launch(kernels.find_indefinite, self.model.copies, [self.linear.negative], out)

    def _launch_end(self):
        """Launches the line search, and finds the copies that have ended."""
        self._launch_search()
        given = [self.search.state, self._roundings, *self._of_pairs(), self.resolution, self._limits]
        self._launch(kernels.end_newton, self.search.lanes.of_block, given, [self._progress])

    def _of_pairs(self):
        """Returns the fraction that pairs leave, the most pairs of a list so far, and the room of lists."""
        pairs = self.pairs
        return (None, None, 0) if pairs is None else (self.filter.fraction, pairs.most_listed, len(pairs.pairs.stencils))

    def _launch_assemble(self):
        self.hessian.assemble_after_gradient(self.base, self.search.inertia.s, self.correction)
        hessian, search, lanes = self.hessian, self.search, self.search.lanes
        given = [hessian.offsets, hessian.columns, hessian.diagonal, hessian.values, self.base, self.correction]
        given += [search.gradient, self.edge, self.model.per_copy, lanes.count]
        self._launch(rounding, lanes.dim, given, [self.right, self._roundings])

    def _launch_solve(self, wanted):
        self.linear.solve(self.right, self.search.direction, wanted)

    def _launch_mean(self, direction):
        """Launches p −= Σ m(d + p)/Σ m for a direction p of steps of free cloth.

        Only inertia changes with a move of the whole cloth, so that Σ∇φ = s Σ m d, and Σ m d = 0 at the minimum: the momentum
        of the cloth. A conjugate gradient solve leaves an error of it. Without it φ at d + p is lower.
        """
        inertia, search, lanes = self.search.inertia, self.search, self.search.lanes
        if self._inverse_total is None or inertia.s == 0.0 or inertia.load != 0.0:
            return
        size = [self.model.per_copy, lanes.count]
        given = [self.model.mass, search.correction, direction, *size]
        self._launch(kernels.mean_parts, lanes.dim, given, [self._moments])
        self._launch(kernels.take_mean, lanes.dim, [self._inverse_total, self._near, self._moments, *size], [direction])

    def _launch_search(self):
        self._launch_mean(self.search.direction)
        self.filter.launch_limit(self.search.direction)
        self.search.launch(self.active)
