"""A line search on the objective φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d of each copy."""

import numpy as np
import warp as wp

from ..core.energy import Energy
from ..fast.plan import plan
from ..kernels import minimise as kernels
from .inertia import Inertia

# Halvings of a step before a copy counts as stuck, because 2⁻³⁰ of a Newton step moves nothing.
HALVINGS = 30


class Search:
    """A backtracking line search on φ (Armijo; the approximate Wolfe condition of Hager and Zhang 2005 if rounding hides the
    decrease).

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        base: The positions at d = 0, (N,) vectors [m]; the caller's array, read only.
        sums: :class:`warpcloth.core.sums.Sums`.
        s: See :class:`warpcloth.numerics.inertia.Inertia`.
        pairs: :class:`warpcloth.contact.self_steps.SelfSteps`, whose energy is added; or None.
        correction: The array for d (N,) [m], by default its own.

    Attributes:
        correction: d (N,) [m].
        direction: Search direction p (N,) [m], set by the caller.
        gradient: ∇φ at d (N,) [N].
        energy, slope, step: φ [J], its slope along p [J], and the step of each copy, (B,); a step of 0 if none was found.
    """

    def __init__(self, model, base, sums, s, pairs=None, correction=None):
        self.model, self.base, self.sums, self.inertia = model, base, sums, Inertia(model, s)
        self.pairs = pairs
        self.gradient_of, self.energy_of = plan(model).gradient(corrected=True), Energy(model, sums, corrected=True)
        self.trial, self.gradient, self.direction = (model.vectors() for _ in range(3))
        self.correction = model.vectors() if correction is None else correction
        self.energy, self.trial_energy, self.slope, self.trial_slope, self.step = (model.scalars() for _ in range(5))
        self.searching = model.scalars(wp.int32)
        self.trials, self.proceed = (wp.zeros(1, dtype=wp.int32, device=model.device) for _ in range(2))
        self._launch = model.launcher(
            ((kernels.set_trial,), model.dtype),
            ((kernels.begin_search, kernels.check_guess, kernels.check_trial),),
        )
        # Relative increase of φ that the approximate Wolfe condition counts as rounding. The energy of a spring of strain e has
        # a relative error of 2ε/e, so that √ε covers strains down to √ε.
        self.noise = float(np.sqrt(np.finfo(model.numpy_dtype).eps))

    def launch_start(self):
        """Launches d = 0, φ and ∇φ."""
        if self.pairs is None:
            self.correction.zero_()
        else:
            self.pairs.filter.launch_first(self.base, self.correction)
        self.launch_again()

    def launch_again(self):
        """Launches φ and ∇φ at the present d."""
        self.direction.zero_()
        self.step.zero_()
        self._launch_trial()
        wp.copy(self.energy, self.trial_energy)

    def launch(self, active):
        """Launches d += step·p with the longest step of 1, ½, ¼ … that lowers φ, for the copies that are ``active`` (B,)."""
        self.sums.dot(self.gradient, self.direction, self.slope)
        started = [self.step, self.searching, self.trials, self.proceed]
        self._launch(kernels.begin_search, self.model.copies, [active], started)
        wp.capture_while(self.proceed, self._try_step)
        self._take_trial()

    def launch_guess(self, guess, active):
        """Launches d = ``guess`` (N,) [m] for the ``active`` copies (B,), from d = 0, where that lowers φ."""
        wp.copy(self.direction, guess)
        started = [self.step, self.searching, self.trials, self.proceed]
        self._launch(kernels.begin_search, self.model.copies, [active], started)
        self._launch_trial()
        self._launch(
            kernels.check_guess, self.model.copies, [self.energy, self.trial_energy, active], [self.step, self.proceed]
        )
        wp.capture_if(self.proceed, self._launch_trial)
        self._take_trial()

    def _take_trial(self):
        wp.copy(self.correction, self.trial)
        wp.copy(self.energy, self.trial_energy)

    def _launch_trial(self):
        """Launches trial = d + step·p, with its φ, ∇φ and slope φ′."""
        model = self.model
        N, n = model.count, model.per_copy
        given = [self.correction, self.direction, self.step, n]
        self._launch(kernels.set_trial, N, given, [self.trials, self.proceed, self.trial, self.gradient])
        self.gradient_of.add(self.base, self.gradient, self.trial)
        if self.pairs is not None:
            self.pairs.forces.launch_forces(self.base, self.trial)
            self.pairs.forces.add_gradient(self.gradient)
        self.inertia.add(self.trial, self.gradient)
        self.sums.sum(self.inertia.work, n, self.trial_energy)
        self.energy_of.add(self.base, self.trial_energy, self.trial)
        if self.pairs is not None:
            self.pairs.forces.add_energy(self.sums, self.trial_energy)
        self.sums.dot(self.gradient, self.direction, self.trial_slope)

    def _try_step(self):
        self._launch_trial()
        given = [self.energy, self.trial_energy, self.slope, self.trial_slope, self.noise, self.trials, HALVINGS]
        self._launch(kernels.check_trial, self.model.copies, given, [self.step, self.searching, self.proceed])
