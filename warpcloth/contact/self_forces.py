"""Self-contact forces in the steps of a solver."""

import numpy as np
import warp as wp

from ..kernels.contact import self_contact, self_sweeps
from .pair_sums import PairSums


class SelfForces(PairSums):
    """Energy, gradient, second derivatives and sweeps of the pairs of a :class:`warpcloth.contact.self_steps.SelfSteps`.

    They include friction.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        bounded: Whether contact is that of explicit steps, without the logarithm.

    Attributes:
        energies: Energies of pairs, summed by their first vertex, (N,) [J].
        friction: :class:`warpcloth.contact.self_friction.SelfFriction`, or None without friction.
        apart: Whether pairs never pass through one another where forces are computed.
        least: The least gap [m] of the filter if it keeps all pairs apart wherever forces are computed, otherwise 0.
    """

    def __init__(self, model, bounded):
        super().__init__(model, self_contact.CONTACT_OF_PAIRS, scatters=model.device.is_cpu)
        self.friction, self._touching, self._clearance, self._kernels = None, None, None, {}
        self.apart, self.least = False, 0.0
        self.energies = wp.zeros(model.count, dtype=wp.float64, device=model.device)
        self._find = model.kernel(self_contact.find_forces, model.dtype, bounded)

    def hold(self, pairs, begun):
        """Takes the arrays of pairs, and allocates arrays for their forces.

        Args:
            pairs: :func:`warpcloth.kernels.contact.self_pairs.near_pairs`.
            begun: :class:`warpcloth.kernels.contact.self_pairs.StepPairs`.
        """
        self.pairs, self.begun, device = pairs, begun, self.model.device

        def room(dtype):
            return wp.zeros(len(pairs.stencils), dtype=dtype, device=device)

        self.found = self_contact.PairForces()
        self.found.normal, self.found.weights = room(wp.vec3d), room(wp.vec4d)
        self.found.energy, self.found.slope, self.found.acting = (room(wp.float64) for _ in range(3))
        if device.is_cpu:
            self.found.pressing, self.found.count = room(wp.int32), wp.zeros(1, dtype=wp.int32, device=device)
        self.multipliers = room(wp.float64)
        if self._clearance is not None:
            self._clearance = room(wp.float64)
        if self._touching is not None:
            self._swept = self_sweeps.SweptPairs()
            self._swept.touches, self._swept.normal, self._swept.weights = room(wp.int32), room(wp.vec3d), room(wp.vec4d)
            self._swept.gap, self._swept.touching = room(wp.float64), self._touching
            corners = len(pairs.corners)
            self._swept.slots = wp.zeros(corners, dtype=wp.int32, device=device)
            self._swept.moves = wp.zeros(corners, dtype=wp.vec3d, device=device)

    def _launch(self, factory, dim, inputs, outputs):
        self.model.launch(self._kernels[factory], dim, inputs, outputs)

    def launch_forces(self, x, correction=None):
        """Launches the forces of the pairs at x, or at x + correction. The methods below sum them."""
        if self.model.device.is_cpu:
            self.found.count.zero_()
        given = [self.pairs, self.begun, x, correction, self.apart, self.least]
        self.model.launch(self._find, len(self.pairs.stencils), given, [self.found])
        if self.friction is not None:
            self.friction.launch_forces(x, correction)

    def add_gradient(self, out):
        super().add_gradient(out)
        if self.friction is not None:
            self.friction.add_gradient(out)

    def add_energy(self, sums, out):
        """out (B,) += U."""
        self.energies.zero_()
        self.add_energies(self.energies)
        if self.friction is not None:
            self.friction.add_energies(self.energies)
        sums.sum(self.energies, self.model.per_copy, out, accumulate=1)

    def add_stored(self, sums, out):
        """out (B,) += the energy of the friction springs."""
        if self.friction is not None:
            self.energies.zero_()
            self.friction.add_energies(self.energies)
            sums.sum(self.energies, self.model.per_copy, out, accumulate=1)

    def add_diagonal(self, diagonal, values):
        super().add_diagonal(diagonal, values)
        if self.friction is not None:
            self.friction.add_diagonal(diagonal, values)

    def add_products(self, p, q, active):
        super().add_products(p, q, active)
        if self.friction is not None:
            self.friction.add_products(p, q, active)
        self.model.lock(q)

    def rows(self):
        """The Hessian ∂²U/∂x² = JᵀDJ of the pairs in contact at the last :meth:`launch_forces`; waits for the device.

        Rows of J are wᵢn, with kAφ″ in D. Friction adds rows in the plane normal to n.

        Returns:
            J, scipy (pairs, 3N), with columns of 0 for pinned coordinates, and D, scipy diagonal (pairs, pairs) [N/m].
        """
        from scipy.sparse import csr_matrix, diags

        model, bend = self.model, self.found.acting.numpy()
        acting = np.sort(self.pairs.acting.numpy()[: self.pairs.number.numpy()[0]])
        press = acting[bend[acting] != 0.0]
        found = [array.numpy()[press] for array in (self.pairs.stencils, self.found.weights, self.found.normal)]
        found.append(bend[press])
        if self.friction is not None:
            found = [np.concatenate(each) for each in zip(found, self.friction.rows(), strict=True)]
        stencils, w, n, bend = found
        columns = 3 * stencils.astype(np.int64)[:, :, None] + np.arange(3)
        values = w[:, :, None] * n[:, None, :] * (model.coordinate_mobility() > 0.0)[columns]
        starts = 12 * np.arange(len(bend) + 1)
        J = csr_matrix((values.ravel(), columns.ravel(), starts), shape=(len(bend), 3 * model.count))
        return J, diags(bend)

    def sweeps(self, in_turn):
        """Prepares sweeps: Gauss–Seidel (``in_turn``), or Jacobi for devices with many threads."""
        model, key = self.model, (self.model.dtype, self.model.mobility is not None)
        if self.friction is not None:
            self.friction.sweeps(in_turn)
        if in_turn and model.device.is_cpu:
            self._sweep = model.kernel(self_sweeps.sweep_pairs, *key)
            self._kernels[self_sweeps.find_clearances] = model.kernel(self_sweeps.find_clearances, model.dtype)
            self._clearance = wp.zeros(len(self.pairs.stencils), dtype=wp.float64, device=model.device)
            return
        self._touching = wp.zeros(model.count, dtype=wp.int32, device=model.device)
        self._press, self._move = (
            model.kernel(factory, *key) for factory in (self_sweeps.press_pairs, self_sweeps.move_by_pairs)
        )
        for factory in (self_sweeps.number_corners, self_sweeps.touch_pairs):
            self._kernels[factory] = model.kernel(factory, model.dtype)
        self.hold(self.pairs, self.begun)

    def launch_sweep(self, x, correction, h, adds, backward=False):
        """Launches a sweep over all pairs, see :mod:`warpcloth.kernels.contact.self_sweeps`.

        Args:
            x: x̃ (N,) [m].
            correction: d (N,) [m].
            h: Step [s].
            adds: Whether multipliers accumulate over sweeps; else pairs are hard.
            backward: Whether a Gauss–Seidel sweep goes from the last pair to the first.
        """
        if self.friction is not None and backward:
            self.friction.launch_sweep(x, correction, h, backward)
        self._launch_sweep(x, correction, h, adds, backward)
        if self.friction is not None and not backward:
            self.friction.launch_sweep(x, correction, h, backward)

    def launch_sweep_start(self, x):
        """Launches λ = 0 for all pairs before the first sweep, at x̃ (N,)."""
        self.multipliers.zero_()
        if self._touching is None:
            self._launch(self_sweeps.find_clearances, len(self.pairs.stencils), [self.pairs, self.begun, x], [self._clearance])
        else:
            self._launch(self_sweeps.number_corners, len(self.pairs.corners), [self.pairs], [self._swept.slots])
        if self.friction is not None:
            self.friction.multipliers.zero_()

    def _launch_sweep(self, x, correction, h, adds, backward):
        model, mobility, multipliers = self.model, self.model.local_mobility, self.multipliers if adds else None
        if self._touching is None:
            given = [self.pairs, mobility, self.begun, self._clearance, x, h, not adds, backward]
            model.launch(self._sweep, 1, given, [multipliers, self.found, correction])
            return
        count, swept = len(self.pairs.stencils), self._swept
        self._launch(self_sweeps.touch_pairs, count, [self.pairs, self.begun, multipliers, x, correction], [swept])
        given = [self.pairs, mobility, self.begun, h, not adds]
        model.launch(self._press, count, given, [swept, multipliers, self.found])
        model.launch(self._move, model.count, [self.pairs, mobility], [swept, correction])
