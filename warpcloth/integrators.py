"""Implicit Euler, midpoint and BDF2, as what comes before and after one and the same minimisation.

Each step of each of them minimises 1/(2hₑ²)‖x − x̃‖²_M + U(x); they differ in the effective step hₑ, in x̃ and in what the
minimiser is taken for (Hairer and Wanner 1996, *Solving ordinary differential equations II*). As solvers minimise over the
correction d = x − x̃, velocities follow from d/hₑ = hₑ a with a = −∇U/m at the minimiser.
"""

from .damping import Forces
from .kernels import step as kernels


class Euler:
    """x̃ = x₀ + h v₀ + h² g; the minimiser is x₁, v₁ = (x₁ − x₀)/h. Of first order.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper` that it belongs to.

    Attributes:
        he: hₑ [s].
    """

    part = 1.0  # hₑ/h

    def __init__(self, stepper):
        self.stepper, self.he = stepper, self.part * stepper.h

    def launch_past(self, past):
        """Where a step begins, what its damping needs: (s − s̃)/hₑ is the rate of s then."""
        past.launch(self.stepper.state.x)

    def launch_prediction(self):
        """x = x̃, v = (x̃ − x₀)/hₑ; pins where they are then."""
        self._launch(kernels.predict, [self._gravity, self._n, self.he], list(self.stepper.state))
        self.stepper.launch_pins()

    def launch_finish(self, correction):
        """The state at the end of the step."""
        self._launch(kernels.finish, [correction, self.he], list(self.stepper.state))

    @property
    def _gravity(self):
        return self.stepper.model.gravity

    @property
    def _n(self):
        return self.stepper.model.per_copy

    def _launch(self, factory, inputs, outputs):
        model = self.stepper.model
        model.launch(model.kernel(factory, model.dtype), model.count, [model.inverse_mass, *inputs], outputs)


class Midpoint(Euler):
    """Euler by h/2 to xₘ, then x₁ = 2xₘ − x₀, v₁ = 2vₘ − v₀. Of second order. Pins of xₘ are those of t + h/2."""

    part = 0.5

    def launch_past(self, past):
        x, v = self.stepper.state
        past.launch(x, v, self.he, midpoint=True)

    def launch_prediction(self):
        self._launch(kernels.predict, [self._gravity, self._n, self.he], list(self.stepper.state))
        self.stepper.launch_pins(parts=2)

    def launch_finish(self, correction):
        given = [self._gravity, correction, self._n, self.he]
        self._launch(kernels.finish_midpoint, given, list(self.stepper.state))
        self.stepper.launch_pins(parts=2)


class BDF2(Euler):
    """hₑ = 2h/3, x̃ = (4x₀ − x₋₁)/3 + hₑ(4v₀ − v₋₁)/3 + hₑ² g; the minimiser is x₁, v₁ = (4v₀ − v₋₁)/3 + hₑ(a₁ + g).

    Of second order. It starts as if from a motion of constant a₀ = −∇(U + D)/m + g: x₋₁ = x₀ − h v₀ + ½h²a₀, v₋₁ = v₀ − h a₀.
    That keeps the order, and one hₑ for all steps. Pins stand still before the start. Damping looks back over kinks of their
    motion: right after one its force has half of the jump too much, which is just what (v₀ − v₋₁)/3 lacks.

    Attributes:
        move: x₀ − x₋₁ (N,) [m].
        v_before: v₋₁ (N,) [m/s]; unused of pins.
    """

    part = 2.0 / 3.0

    def __init__(self, stepper):
        super().__init__(stepper)
        model = stepper.model
        self.move, self.v_before, gradient = (model.vectors() for _ in range(3))
        Forces(model, stepper.h).add(*stepper.state, gradient)
        given = [self._gravity, self._n, stepper.h, gradient, stepper.state.v]
        self._launch(kernels.start_bdf2, given, [self.move, self.v_before])

    def launch_past(self, past):
        past.launch(self.stepper.state.x, self.move, bdf2=True)

    def launch_prediction(self):
        given = [self._gravity, self._n, self.he]
        self._launch(kernels.predict_bdf2, given, [*self.stepper.state, self.move, self.v_before])
        self.stepper.launch_pins()

    def launch_finish(self, correction):
        super().launch_finish(correction)
        self._launch(kernels.note_move, [correction, self.stepper.state.v, self.stepper.h], [self.move])


INTEGRATORS = {"euler": Euler, "midpoint": Midpoint, "bdf2": BDF2}
