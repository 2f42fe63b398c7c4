"""Dynamic elements: those of four vertices and one row whose number and stencils change on the device, as pairs in contact."""

import numpy as np
import warp as wp

from ..kernels.contact import pair_sums, pair_sweeps
from ..kernels.contact.self_pairs import fill_corners, forget_forces, sort_corners
from ..kernels.pairs import Pairs, pair_blocks
from .filled import filled
from .scan import Scan

SUMS = pair_sums.pair_forces, pair_sums.pair_energies, pair_sums.pair_diagonal, pair_sums.pair_products


class DynamicElements:
    """The base class of an energy of pairs. Sums are gathered by vertices, or scattered by one thread on the CPU.

    A subclass has a method ``launch_forces(x, correction)``, which finds ``forces`` at x or x + correction, and calls
    :meth:`hold_pairs`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        term: The :class:`warpcloth.kernels.term.PairTerm`.
        present: Whether there may be pairs, (1,) int32 on the device. Without, nothing is launched for them.

    Attributes:
        present: As given.
        pairs: :class:`warpcloth.kernels.pairs.Pairs`.
        data: The ``data`` of the term.
        forces: :class:`warpcloth.kernels.contact.pair_sums.PairForces`.
        blocks: :func:`warpcloth.kernels.pairs.pair_blocks`, empty if sums are scattered.
        multipliers: λ of sweeps [kg·m], 0 in empty slots; None without sweeps.
        stored: Whether its energy is not a function of positions alone, but stored in the state.
        scatters: Whether sums are scattered.
    """

    stored = False

    def __init__(self, model, term, present):
        self.model, self.term, self.present = model, term, present
        self._swept, self._in_turn, self.pairs, self.multipliers = None, None, None, None
        self._vertices = Scan(model, model.count)
        self.set_sums(model.device.is_cpu)

    def set_sums(self, scatters):
        """Sets whether sums are scattered."""
        model, self.scatters = self.model, scatters
        self._sums_over = 1 if scatters else model.count
        self._forces, self._energies, self._diagonal, self._products = (
            model.kernel(factory, self.term, model.dtype, scatters) for factory in SUMS
        )
        self._set_blocks = model.kernel(pair_sums.set_pair_blocks, self.term, model.dtype, scatters)
        if self.pairs is not None:
            self._hold_blocks()

    def new_pairs(self, slots, keys, layout, corners=True):
        """Returns pairs with a number of slots, and with lists of ``corners`` at each vertex if kernels sum over vertices.

        Keys are below ``keys``.
        """
        sizes, device = {"number": 1, "keys": slots, "slots": keys}, self.model.device
        if corners:
            sizes |= {"corner_counts": self.model.count, "first": self.model.count + 1, "corners": 4 * slots}
        lists = {name: wp.zeros(size, dtype=wp.int32, device=device) for name, size in sizes.items()}
        return filled(Pairs, layout=layout, stencils=wp.zeros(slots, dtype=wp.vec4i, device=device), **lists)

    def hold_pairs(self, pairs, data):
        """Takes the arrays of pairs, and allocates those of forces and sweeps."""
        self.pairs, self.data = pairs, data
        pairs.threads = 1 if self.model.device.is_cpu else self.capacity
        model, room = self.model, self.room
        kinds = {"weights": wp.vec4d, "energy": wp.float64, "force": wp.vec3d}
        kinds |= dict.fromkeys(("definite", "rest", "block"), wp.mat33d)
        if self.term.turns:
            kinds |= {"turns": wp.types.matrix((4, 2), wp.float64), "ways": wp.types.matrix((2, 3), wp.float64)}
            kinds |= dict.fromkeys(("twist", "twisted"), wp.vec2d)
        kinds |= dict.fromkeys(("pressing", "joining"), wp.int32) if model.device.is_cpu else {}
        self.forces = filled(pair_sums.PairForces, **{name: room(kind) for name, kind in kinds.items()})
        if self.term.turns:
            self.forces.normal = data.normal
        if model.device.is_cpu:
            self.forces.count = wp.zeros(2, dtype=wp.int32, device=model.device)
        self._hold_blocks()
        if self._in_turn is not None:
            self.multipliers = room(wp.vec3d)
        if self._in_turn is False:
            corners, device = len(pairs.corners), model.device
            self._swept = filled(
                pair_sweeps.SweptPairs,
                **{"touches": room(wp.int32), "v": room(wp.vec3d), "normal": room(wp.vec3d), "weights": room(wp.vec4d)},
                slots=wp.zeros(corners, dtype=wp.int32, device=device),
                moves=wp.zeros(corners, dtype=wp.vec3d, device=device),
                touching=wp.zeros(model.count, dtype=wp.int32, device=device),
            )

    def _hold_blocks(self):
        self.blocks, model = pair_blocks(self.model.dtype)(), self.model
        if not self.scatters:
            kinds = {"weights": wp.types.vector(4, model.dtype), "blocks": model.mat33}
            if self.term.turns:
                kinds |= {"turns": wp.types.matrix((4, 2), model.dtype), "ways": wp.types.matrix((2, 3), model.dtype)}
                kinds |= {"normal": model.vec3, "twisted": wp.types.vector(2, model.dtype)}
            for name, kind in kinds.items():
                setattr(self.blocks, name, self.room(kind))

    @property
    def capacity(self):
        """The number of pairs that fit."""
        return len(self.pairs.stencils)

    def room(self, dtype):
        """Returns an array of zeros, one for each pair that fits."""
        return wp.zeros(self.capacity, dtype=dtype, device=self.model.device)

    def list_corners(self):
        """Prepares the lists of the corners of pairs at each vertex, which sweeps and rows need, if they are not there."""

    def launch_none(self):
        """Empties the list of pairs."""
        self._forget()
        self.pairs.number.zero_()
        if self.pairs.first:
            self.pairs.first.zero_()

    def _forget(self):
        if self.multipliers is not None:
            self.model.launch(forget_forces, self.pairs.threads, [self.pairs], [self.multipliers])

    def launch_corners(self):
        """Lists the corners of pairs at each vertex."""
        self._vertices.launch(self.pairs.corner_counts, self.pairs.first)
        self.model.launch(fill_corners, self.pairs.threads, [], [self.pairs])
        self.model.launch(sort_corners, self.model.count, [], [self.pairs])

    def launch(self, x, correction=None):
        """Launches the forces of the pairs at x, or at x + correction. The methods below sum them."""
        if self.model.device.is_cpu:
            self.forces.count.zero_()
        self.launch_forces(x, correction)

    def add_gradient(self, out):
        """out (N,) += ∂U/∂x."""
        self.model.launch(self._forces, self._sums_over, [self.pairs, self.forces], [out])

    def add_energies(self, out):
        """Adds the energies of the pairs to those of their first vertices, (N,) [J]."""
        self.model.launch(self._energies, self._sums_over, [self.pairs, self.forces], [out])

    def add_diagonal(self, diagonal, values, policy):
        """Adds to the diagonal blocks of a :class:`warpcloth.core.hessian.Hessian`, and sets those for its products."""
        model, pairs, forces = self.model, self.pairs, self.forces
        model.launch(self._set_blocks, pairs.threads, [pairs, model.inverse_mass, policy], [forces, self.blocks])
        model.launch(self._diagonal, self._sums_over, [pairs, model.inverse_mass, diagonal, forces], [values])

    def add_products(self, p, q, active):
        """q += A p for the off-diagonal blocks A, in ``active`` copies (B,)."""
        given = [self.pairs, self.model.inverse_mass, self.forces, p, active]
        self.model.launch(self._products, self._sums_over, given, [q])

    def matrix(self):
        """Returns ∂²U/∂x² as last added to a Hessian, scipy CSR (3N, 3N), 0 along pinned coordinates; waits for the device."""
        from scipy.sparse import csr_matrix

        acting = np.argsort(self.pairs.keys.numpy()[: self.pairs.number.numpy()[0]])
        arrays = self.pairs.stencils, self.forces.weights, self.forces.block
        stencils, w, block = (array.numpy()[acting] for array in arrays)
        columns = 3 * stencils.astype(np.int64)[:, :, None] + np.arange(3)
        values = np.einsum("pi,pac,pj->piajc", w, block, w)
        if self.term.turns:
            names = "turns", "ways", "normal", "twisted"
            t, ways, n, twisted = (getattr(self.forces, name).numpy()[acting] for name in names)
            mixed = np.einsum("p,pi,pjk,pka,pc->piajc", twisted[:, 0], w, t, ways, n)
            values += mixed + mixed.transpose(0, 3, 4, 1, 2)
            values += np.einsum("p,pik,pjk,pa,pc->piajc", twisted[:, 1], t, t, n, n)
        free = (self.model.coordinate_mobility() > 0.0)[columns]
        values *= free[:, :, :, None, None] & free[:, None, None]
        rows = np.broadcast_to(columns[:, :, :, None, None], values.shape)
        indices = rows.ravel(), np.broadcast_to(columns[:, None, None], values.shape).ravel()
        return csr_matrix((values.ravel(), indices), shape=(3 * self.model.count,) * 2)

    def launch_rows(self, x, d):
        """Prepares constraint rows at x + d."""

    # Sweeps, see :mod:`warpcloth.kernels.contact.pair_sweeps`.

    def sweeps(self, in_turn):
        """Prepares sweeps: Gauss–Seidel (``in_turn``), or Jacobi for devices with many threads."""
        model, axes = self.model, self.model.mobility is not None
        self._in_turn = in_turn and model.device.is_cpu
        if not self._in_turn:
            self.list_corners()
        if self._in_turn:
            self._sweep = model.kernel(pair_sweeps.sweep_pairs, self.term, model.dtype, axes)
        else:
            self._touch = model.kernel(pair_sweeps.touch_pairs, self.term, model.dtype)
            self._press = model.kernel(pair_sweeps.press_pairs, self.term, model.dtype, axes)
            self._move = model.kernel(pair_sweeps.move_by_pairs, model.dtype, axes)
        self.hold_pairs(self.pairs, self.data)

    def launch_sweep_start(self, x):
        """Launches λ = 0 for all pairs before the first sweep, at x̃ (N,)."""
        self._forget()
        if not self._in_turn:
            self.launch_corner_slots()

    def launch_corner_slots(self):
        """Launches the search of the index of each corner in the lists of vertices, for Jacobi sweeps."""
        self.model.launch(pair_sweeps.number_corners, len(self.pairs.corners), [self.pairs], [self._swept.slots])

    def launch_sweep(self, x, correction, h, adds, backward, follows):
        """See :meth:`warpcloth.core.dynamic.Dynamic.launch_sweep`."""
        model, mobility, multipliers = self.model, self.model.local_mobility, self.multipliers if adds else None
        if self._in_turn:
            given = [self.pairs, mobility, self.data, x, h, not adds, backward]
            model.launch(self._sweep, 1, given, [multipliers, self.forces, correction])
            return
        swept = self._swept
        model.launch(self._touch, self.capacity, [self.pairs, self.data, multipliers, x, correction], [swept])
        model.launch(
            self._press, self.capacity, [self.pairs, mobility, self.data, h, not adds], [swept, multipliers, self.forces]
        )
        model.launch(self._move, model.count, [self.pairs, mobility], [swept, correction])
