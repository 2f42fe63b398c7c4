"""A line search on the objective φ(d) = s/2‖d‖²_M + U(base + d) − load·Σ m g·d of each copy."""

import numpy as np
import warp as wp

from ..core.energy import EnergyParts
from ..core.sums import Lanes
from ..fast.plan import plan
from ..kernels import search as kernels
from ..terms.refresh import EVALUATION, Moment

# Halvings of a step before a copy counts as stuck, because 2⁻³⁰ of a Newton step moves nothing.
HALVINGS = 30


class Search:
    """A line search on φ, see :func:`warpcloth.kernels.search.check_trial`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        base: The positions at d = 0, (N,) vectors [m]; the caller's array, read only.
        sums: :class:`warpcloth.core.sums.Sums`.
        s: Weight of the inertia, 1/h² [1/s²].
        contact: The filter of contact, which gives the start, see :func:`warpcloth.contact.no_filter.filter_of`.
        correction: The array for d (N,) [m], by default its own.

    Attributes:
        correction: d (N,) [m].
        direction: Search direction p (N,) [m], set by the caller.
        gradient: ∇φ at d (N,) [N].
        inertia: The mass, gravity, s and load of φ, see :func:`warpcloth.kernels.search.inertia_struct`; load is 0 at first.
        energy, slope, step: φ [J], its slope along p [J], and the step of each copy, (B,); a step of 0 if none was found.
        acceleration: The largest ‖∇φᵢ‖/mᵢ of each copy at d, (B,) [m/s²].
        state: These and more, :class:`warpcloth.kernels.search.LineSearch`.
        lanes: The :class:`warpcloth.core.sums.Lanes` of sums over vertices.
    """

    def __init__(self, model, base, sums, s, contact, correction=None):
        self.model, self.base, self.sums, self._contact = model, base, sums, contact
        self.lanes = lanes = Lanes(model, model.per_copy)
        self.gradient_of, self.energy_of = plan(model).gradient(corrected=True), EnergyParts(model, lanes, sums)
        self.inertia = kernels.inertia_struct(model.dtype)()
        self.inertia.mass, self.inertia.inverse_mass = model.mass, model.inverse_mass
        self.inertia.gravity, self.inertia.shared = model.free_gravity
        if model.mobility is not None:
            self.inertia.mobility = model.mobility
        self.inertia.s, self.inertia.load = s, 0.0
        self.trial, self.gradient, self.direction = (model.vectors() for _ in range(3))
        self.correction = model.vectors() if correction is None else correction
        self.state = state = kernels.LineSearch()
        for name in ("energy", "before", "slope", "step", "trial_energy", "trial_slope", "square", "acceleration", "other"):
            setattr(state, name, model.scalars())
        state.searching, state.moved = (model.scalars(wp.int32) for _ in range(2))
        state.trials, state.proceed = (wp.zeros(1, dtype=wp.int32, device=model.device) for _ in range(2))
        self.energy, self.slope, self.step, self.acceleration = state.energy, state.slope, state.step, state.acceleration
        self._parts, self._slopes = lanes.parts(kernels.ROWS), lanes.parts()
        self._launch = model.launcher(
            ((kernels.set_trial, kernels.take_trial), model.dtype),
            ((kernels.begin_search, kernels.finish_gradient, kernels.work_of_guess), model.dtype, lanes.block),
            ((kernels.measure_start, kernels.bound_guess, kernels.check_guess, kernels.check_trial), lanes.block),
        )
        # Relative increase of φ that the approximate Wolfe condition counts as rounding. The energy of a spring of strain e has
        # a relative error of 2ε/e, so that √ε covers strains down to √ε; ε is that of float64, in which energies are computed.
        self.noise = float(np.sqrt(np.finfo(np.float64).eps))

    def launch_start(self):
        """Launches d = 0, φ and ∇φ."""
        self._contact.launch_start(self.base, self.correction)
        self.launch_again()

    def launch_again(self):
        """Launches φ and ∇φ at the present d."""
        self.direction.zero_()
        self.step.zero_()
        self._set_trial()
        self._launch_trial()
        self._launch_sums(kernels.measure_start)

    def launch(self, active):
        """Launches d += step·p, with the longest step of 1, ½, ¼ … that lowers φ enough, for ``active`` copies (B,).

        The first trial has launches of its own, because further ones, which a conditional loop repeats, are rare.
        """
        self._begin(active)
        self._check_trial()
        wp.capture_while(self.state.proceed, self._try_again)
        self._take_trial()

    def launch_guess(self, active):
        """Launches d += p for the ``active`` copies (B,) where that lowers φ."""
        self._begin(active)
        self._launch_sums(kernels.check_guess)
        wp.capture_if(self.state.proceed, self._return_to_start)
        self._take_trial()

    def launch_bound(self, active, hopeful, some):
        """Launches ``hopeful`` (B,) = 1 for ``active`` copies where φ may be lower at d + p, else 0; ``some`` (1,): any is.

        It lists no pairs.
        """
        some.zero_()
        given = [self.inertia, self.correction, self.direction, self.model.per_copy, self.lanes.count]
        self._launch(kernels.work_of_guess, self.lanes.dim, given, [self.trial, self._parts])
        self.energy_of.launch(self.base, self.trial)
        self.model.refresh(EVALUATION, Moment(self.base, self.correction))
        given = [self._parts, self.energy_of.parts, self.state, active]
        self._launch(kernels.bound_guess, self.lanes.of_block, given, [hopeful, some])

    def _begin(self, active):
        """Launches the first trial, with steps of 1."""
        given = [self.correction, self.direction, active, self.model.per_copy, self.lanes.count]
        self._launch(kernels.begin_search, self.lanes.dim, given, [self.gradient, self.state, self.trial, self._slopes])
        self._launch_trial(self.state.searching)

    def _try_again(self):
        self._set_trial()
        self._launch_trial(self.state.searching)
        self._check_trial()

    def _return_to_start(self):
        """Launches the trial again, after a guess that some copies rejected."""
        self._set_trial()
        self._launch_trial()
        self._launch_sums(kernels.check_guess)

    def _set_trial(self):
        given = [self.correction, self.direction, self.model.per_copy]
        self._launch(kernels.set_trial, self.model.count, given, [self.state, self.trial, self.gradient])

    def _launch_trial(self, active=None):
        """Launches ∇φ at the trial, and the parts of what a trial sums. Pairs are listed for ``active`` copies (B,), or all."""
        model, lanes = self.model, self.lanes
        self._contact.launch_trial(self.base, self.trial, active)
        self.gradient_of.add(self.base, self.gradient, self.trial)
        given = [self.inertia, self.trial, self.direction, model.per_copy, lanes.count]
        self._launch(kernels.finish_gradient, lanes.dim, given, [self.gradient, self._parts])
        self.energy_of.launch(self.base, self.trial, self.state.other)

    def _launch_sums(self, kernel):
        self._launch(kernel, self.lanes.of_block, [self._parts, self.energy_of.parts], [self.state])

    def _check_trial(self):
        given = [self._parts, self.energy_of.parts, self._slopes, self.noise, HALVINGS]
        self._launch(kernels.check_trial, self.lanes.of_block, given, [self.state])

    def _take_trial(self):
        self._launch(kernels.take_trial, self.model.count, [self.trial], [self.state, self.correction])
