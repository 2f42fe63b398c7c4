"""The step of an accelerated iteration d ← d − A⁻¹∇φ(d), taken if φ falls more than with the plain step."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.energy import Energy
from ..core.sums import Lanes
from ..kernels import accelerate as kernels


class AcceleratedStep:
    """The history of an iteration on the device, and the choice between the plain and the accelerated step.

    Args:
        stepper: The :class:`warpcloth.solvers.projective_dynamics.ProjectiveDynamicsStepper`.
        method: The acceleration, of :mod:`warpcloth.numerics.acceleration`.
        falls: Whether an iterate stays if φ rises with both steps; not needed if φ never rises with the plain step.
        shortens: Whether both steps are halved after an iterate that stayed; needs ``falls``.
    """

    def __init__(self, stepper, method, falls=False, shortens=False):
        model = stepper.model
        self.stepper, self.method, B, device = stepper, method, model.copies, model.device
        m = method.window
        self.s, self.y, self.z = (wp.zeros((m, model.count), dtype=model.vec3, device=device) for _ in range(3))
        self.plain, self.accelerated, self.last_gradient, self.last_w, self.unused = (model.vectors() for _ in range(5))
        self.slot = wp.zeros(1, dtype=wp.int32, device=device)
        lanes = Lanes(model, model.per_copy)
        self._lanes, self._parts = lanes, lanes.parts(4 * m)
        # The two energies and the products of each copy, which the host reads at once.
        self._found = Mirror(wp.zeros(B * (2 + 4 * m), dtype=wp.float64, device=device))
        found = self._found.array
        self._plain_energy, self._energy, self._products = found[:B], found[B : 2 * B], found[2 * B :].reshape((B, 4 * m))
        self.coefficients = Mirror(wp.zeros((B, 1 + 2 * m), dtype=wp.float64, device=device))
        self._lowest = model.scalars() if falls else None
        self._stayed = Mirror(model.scalars(wp.int32)) if falls else None
        self._part = Mirror(wp.zeros((B, 1 + 2 * m), dtype=wp.float64, device=device)) if shortens else None
        # Relative rise of φ that counts as rounding, as in a line search.
        self._noise = float(np.sqrt(np.finfo(model.numpy_dtype).eps))
        self.energy_of = Energy(model, stepper.sums, corrected=True)
        of_vertices = kernels.note_change, kernels.combine, kernels.accept
        of_copies = kernels.next_slot, *([kernels.note_lowest] if falls else [])
        self._launch = model.launcher(
            (of_vertices, model.dtype),
            (of_copies,),
            ((kernels.partial_products,), model.dtype, lanes.block),
            ((kernels.finish_products,), lanes.block),
        )
        self._note = Segment(device, self._launch_note)

    def start(self):
        """Clears the history, before the first iteration of a step."""
        self.method.start()
        self._iteration = 0
        self._step = np.ones(self.stepper.model.copies)

    def propose(self, active):
        """Sets the coefficients of the accelerated step of the ``active`` copies (B,)."""
        self._note()
        found, B = self._found.read(), len(active)
        accepted = found[B : 2 * B] <= found[:B] if self._iteration else np.ones(B, dtype=bool)
        proposed = self.method.propose(self._iteration, found[2 * B :].reshape(B, 4, -1), accepted)
        if self._part is not None:
            self._step = np.where(self.stayed(), 0.5 * self._step, np.minimum(2.0 * self._step, 1.0))
            proposed = self._step[:, None] * proposed
            plain = np.zeros_like(proposed)
            plain[:, 0] = np.where(active, self._step, 0.0)
            self._part.write(plain)
        self.coefficients.write(np.where(active[:, None], proposed, 0.0))
        self._iteration += 1

    def stayed(self):
        """Returns which copies did not move in the last iteration, (B,) booleans."""
        return self._stayed.read() == 1

    def launch_start(self):
        """Launches the start of a history: an empty first slot, and d = 0 as the lowest point."""
        self.slot.zero_()
        if self._lowest is not None:
            self._stayed.array.zero_()
            self._launch_energy(self.stepper.correction, self._lowest)

    def _launch_note(self):
        stepper, model, lanes = self.stepper, self.stepper.model, self._lanes
        given = [stepper.gradient, stepper.w, self.slot]
        self._launch(kernels.note_change, model.count, given, [self.last_gradient, self.last_w, self.y, self.z])
        given = [stepper.gradient, self.s, self.y, self.z, self.slot, model.per_copy, lanes.count]
        B, rows = self._products.shape
        self._launch(kernels.partial_products, (B, rows, lanes.count), given, [self._parts])
        self._launch(kernels.finish_products, (B, rows, lanes.of_block[1]), [self._parts], [self._products])

    def launch_move(self):
        """Launches d = the better of the plain and the accelerated step."""
        stepper, model = self.stepper, self.stepper.model
        N, n, d = model.count, model.per_copy, stepper.correction
        if self._part is None:
            stepper.launch_plain_step(self.plain)
        else:
            self._launch(kernels.combine, N, [d, stepper.w, self.s, self.z, self._part.array, n], [self.plain])
        given = [d, stepper.w, self.s, self.z, self.coefficients.array, n]
        self._launch(kernels.combine, N, given, [self.accelerated])
        if stepper.pairs is not None:
            stepper.filter.launch_look(stepper.state.x, (self.plain, self.accelerated))
            wp.capture_if(stepper.pairs.near.array, self._launch_apart)
        for end, energy in ((self.plain, self._plain_energy), (self.accelerated, self._energy)):
            stepper.filter.launch_near_trial(stepper.state.x, end)
            self._launch_energy(end, energy)
        self._launch(kernels.next_slot, 1, [self.method.window], [self.slot])
        energies = [self._plain_energy, self._energy]
        if self._lowest is not None:
            self._launch(kernels.note_lowest, model.copies, [*energies, self._noise], [self._lowest, self._stayed.array])
        given = [self.plain, self.accelerated, *energies, self._stayed and self._stayed.array, self.slot, n]
        self._launch(kernels.accept, N, given, [d, self.s])
        stepper.filter.launch_near_trial(stepper.state.x, d)

    def _launch_apart(self):
        """Shortens both steps so that pairs stay apart."""
        stepper, d = self.stepper, self.stepper.correction
        # A line search for w has listed the pairs of its trial.
        stepper.filter.launch_trial(stepper.state.x, d)
        for each in (self.plain, self.accelerated):
            stepper.filter.launch_between(d, each)

    def _launch_energy(self, d, out):
        """Launches out (B,) = φ(d) [J]."""
        stepper, model = self.stepper, self.stepper.model
        stepper.inertia.add(d, self.unused)
        stepper.sums.sum(stepper.inertia.work, model.per_copy, out)
        self.energy_of.add(stepper.state.x, out, d)
