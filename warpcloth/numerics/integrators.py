"""Implicit Euler, midpoint and BDF2, which share one minimisation.

Each of their steps minimises 1/(2hₑ²)‖x − x̃‖²_M + U(x). They differ in the effective step hₑ, in x̃ and in how the new state
follows from the minimiser (Hairer and Wanner 1996, *Solving ordinary differential equations II*). Solvers minimise over the
correction d = x − x̃, so velocities follow from d/hₑ = hₑ a, with a = −∇U/m at the minimiser.

A class also has the properties that solvers and step limits need, so that they do not know integrators by name.
"""

from typing import ClassVar

import numpy as np
import warp as wp

from ..kernels import step as kernels
from ..terms.refresh import Moment


class Euler:
    """x̃ = x₀ + h v₀ + h² g; the minimiser is x₁, v₁ = (x₁ − x₀)/h. First order.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper` that it belongs to.

    Attributes:
        he: hₑ [s].
        share: hₑ/h.
        move: x₀ − x₋₁ (N,) [m], which filters change with x; None for methods that do not look back.
        parts: Number of equal parts of a step, in which pins move. Forces are those at the end of the first.
        hard: Whether it takes constraints of infinite stiffness.
        damps: Whether it damps frequencies that its steps do not resolve.
        to_and_fro: Whether Gauss–Seidel sweeps must alternate in direction, because the error of one order is not damped.
        order: Order of its global error.
        energy_bound: The most that energy can become, over that at the start, see :mod:`warpcloth.run.balance`.
        one_step: Whether a step depends on the present state alone, so that the next one may have another length.
        least_weight: Number of iterations times the smallest automatic weight of ADMM. A small weight needs many iterations.
            The remaining error of a step becomes a velocity in the next one, which midpoint keeps and Euler damps.
        least_factor: The smallest real q for which no |z| of `growth` is above 1.
    """

    share: ClassVar[float] = 1.0
    parts: ClassVar[int] = 1
    hard: ClassVar[bool] = True
    damps: ClassVar[bool] = True
    to_and_fro: ClassVar[bool] = False
    order: ClassVar[int] = 1
    energy_bound: ClassVar[float] = 1.0
    one_step: ClassVar[bool] = True
    least_weight: ClassVar[float] = 2.0
    least_factor: ClassVar[float] = -1.0 / 3.0
    move = None

    @staticmethod
    def growth(q):
        """Returns the complex amplification factors z of a step whose iterations give x = q x̃, q (n,): z² − 2qz + q = 0."""
        return _roots(q, q)

    def __init__(self, stepper):
        self.stepper, self.he = stepper, self.share * stepper.h

    def start(self):
        """Prepares the past state before the first step, for methods that need one."""

    @property
    def moment(self):
        """The :class:`warpcloth.terms.refresh.Moment` at the start of a step; (s − s̃)/hₑ is then the rate of a damped s."""
        return Moment(self.stepper.state.x, **self._time)

    @property
    def _time(self):
        """Fields of a Moment for loads with keyframes: one keyframe step ahead, of which a step has ``parts``."""
        given = {"steps": self.stepper.count, "per_frame": self.parts * self.stepper.steps_per_frame, "ahead": 1}
        return {**given, "v": self.stepper.state.v, "he": self.he}

    def launch_prediction(self):
        """Launches x = x̃, v = (x̃ − x₀)/hₑ, and the move of pins by a part of the step."""
        self._launch(kernels.predict, [*self.stepper.model.free_gravity, self.he], list(self.stepper.state))
        self.stepper.launch_pins(self.parts)

    def launch_finish(self, correction):
        """Launches the state at the end of the step, from the ``correction`` d of the minimiser (N,) [m]."""
        self._launch(kernels.finish, [correction, self.he], list(self.stepper.state))

    def _launch(self, factory, inputs, outputs):
        model = self.stepper.model
        model.launch(model.kernel(factory, model.dtype), model.count, [model.inverse_mass, *inputs], outputs)


class Midpoint(Euler):
    """Euler by h/2 to xₘ, then x₁ = 2xₘ − x₀, v₁ = 2vₘ − v₀. Second order. xₘ has the pins at t + h/2."""

    share, parts, hard, damps, to_and_fro, least_weight, least_factor = 0.5, 2, False, False, True, 20.0, 0.0
    order, energy_bound = 2, 2.0

    @staticmethod
    def growth(q):
        """See :meth:`Euler.growth`: z² − 2(2q − 1)z + 1 = 0."""
        return _roots(2.0 * q - 1.0, 1.0)

    @property
    def moment(self):
        x, v = self.stepper.state
        return Moment(x, move=v, scale=self.he, parts=2, both=True, **self._time)

    def launch_finish(self, correction):
        gravity, each = self.stepper.model.free_gravity
        given = [gravity, correction, each, self.he]
        self._launch(kernels.finish_midpoint, given, list(self.stepper.state))
        self.stepper.launch_pins(self.parts)


class BDF2(Euler):
    """hₑ = 2h/3, x̃ = (4x₀ − x₋₁)/3 + hₑ(4v₀ − v₋₁)/3 + hₑ² g; the minimiser is x₁, v₁ = (4v₀ − v₋₁)/3 + hₑ(a₁ + g).

    Second order. Two Euler steps of hₑ from x₀, with velocities v₁ and v₂ after them, give the past state:

        v₋₁ = v₀ − h a₀, a₀ = (v₁ − v₀)/hₑ;  x₋₁ = x₀ − h v̄ + ½h²(v₂ − v₁)/hₑ, v̄ = 2v₁ − v₂

    v̄ is v₀ up to O(h²), except for modes so stiff or damped that the first step stops them; these do not move in x₋₁ either.
    Errors of O(h) in accelerations do not change the order, steps of hₑ have the matrix of all other steps, and no start gives
    energy to linear motion. Pins are at rest before the start. If the velocity of pins jumps, the past state is that before the
    jump: the damping force is then too large by half of the jump, which is exactly what (v₀ − v₋₁)/3 lacks.

    Attributes:
        v_before: v₋₁ (N,) [m/s]; not used for pins.
    """

    share, hard, least_weight, least_factor = 2.0 / 3.0, False, 4.0, -9.0 / 55.0
    order, one_step, energy_bound = 2, False, 2.0

    @staticmethod
    def growth(q):
        """See :meth:`Euler.growth`: z² = r(4z − 1)/3 with r = q ± √(q² − q)."""
        return np.concatenate([_roots(2.0 * r / 3.0, r / 3.0) for r in _roots(q, q)])

    def __init__(self, stepper):
        super().__init__(stepper)
        self.move = stepper.state.add("move before", stepper.model.vectors())
        self.v_before = stepper.state.add("v before", stepper.model.vectors())

    def start(self):
        """Computes the past state by two Euler steps of hₑ, which are steps with x₋₁ = x₀ and v₋₁ = v₀, and restores x and v.

        The results of these steps count like those of other steps.
        """
        stepper, model, (x, v) = self.stepper, self.stepper.model, self.stepper.state
        for _ in range(2):
            self.move.zero_()
            wp.copy(self.v_before, v)
            if stepper.count is not None:
                stepper.count.fill_(-1)  # pins then move to their first keyframe, where they are
            if stepper.colliders is not None:
                stepper.colliders.steps.fill_(-1)  # as for pins
            stepper.step()
        self._launch(kernels.start_bdf2, [model.velocities, v, stepper.h], [self.move, self.v_before])
        stepper.state.start_here("move before", "v before")
        if stepper.colliders is not None:
            stepper.colliders.start_again()
        if stepper.pairs is not None:
            stepper.pairs.start_again()
        wp.copy(x, model.positions)
        wp.copy(v, model.velocities)

    @property
    def moment(self):
        return Moment(self.stepper.state.x, move=self.move, parts=3, **self._time)

    def launch_prediction(self):
        given = [*self.stepper.model.free_gravity, self.he]
        self._launch(kernels.predict_bdf2, given, [*self.stepper.state, self.move, self.v_before])
        self.stepper.launch_pins()

    def launch_finish(self, correction):
        super().launch_finish(correction)
        stepper = self.stepper
        given = [stepper.model.mobility, correction, stepper.state.v, stepper.h]
        self._launch(kernels.note_move, given, [self.move])


def _roots(half, product):
    """Returns both complex roots z of z² − 2·half·z + product = 0."""
    root = np.sqrt(half * half - product + 0j)
    return np.stack([half + root, half - root])


INTEGRATORS = {"euler": Euler, "midpoint": Midpoint, "bdf2": BDF2}
