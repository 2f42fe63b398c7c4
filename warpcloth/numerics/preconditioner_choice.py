"""The choice between diagonal blocks and multigrid as the preconditioner of conjugate gradients, for each copy."""

import warp as wp

from ..kernels import multigrid as kernels


class PreconditionerChoice:
    """Which preconditioner each copy uses, by what both gained for their cost in its past solves.

    Costs are counted, so a copy has the same bits in each run, alone and in a batch.

    Args:
        multigrid: The :class:`warpcloth.numerics.multigrid.Multigrid`.
        iterations: Maximum number of iterations of one solve.

    Attributes:
        kept: The arrays (B,) on which the choice depends, by name, 0 at the start.
        by_blocks, by_cycles: The copies of the present solve by preconditioner, (B,) int32.
        due: Those of which it computes the coarse matrices, (B,) int32.
        outdated: Those of which the next solve with coarse matrices computes them, (B,) int32.
        any_blocks, any_cycles, any_due: Whether there are any, (1,) int32.
    """

    def __init__(self, multigrid, iterations):
        model = self._model = multigrid.model
        self._iterations, self._cycle, self._choice = iterations, multigrid.cycle, kernels.ChoiceState()
        made = {"present": model.scalars(wp.vec4i), "past": model.scalars(wp.vec4d)}
        of_copies = "by_blocks", "by_cycles", "due", "outdated"
        made |= {name: model.scalars(wp.int32) for name in of_copies}
        flags = "any_blocks", "any_cycles", "any_due"
        made |= {name: wp.zeros(1, dtype=wp.int32, device=model.device) for name in flags}
        for name, array in made.items():
            setattr(self._choice, name, array)
        self.kept = {"preconditioner": made["present"], "gains of preconditioners": made["past"]}
        self.by_blocks, self.by_cycles, self.due, self.outdated = (made[name] for name in of_copies)
        self.any_blocks, self.any_cycles, self.any_due = (made[name] for name in flags)
        self._launch = model.launcher(((kernels.begin_choice, kernels.end_choice),))

    def launch_begin(self, solves, wanted):
        """Divides the copies that are ``wanted`` (B,) by preconditioner, and sets their largest number of iterations."""
        for flag in (self.any_blocks, self.any_cycles, self.any_due):
            flag.zero_()
        self._launch(kernels.begin_choice, self._model.copies, [wanted, self._iterations], [self._choice, solves])

    def launch_end(self, solves, wanted):
        """Chooses for the next solve, see :func:`warpcloth.kernels.multigrid.end_choice`."""
        self._launch(kernels.end_choice, self._model.copies, [solves, wanted, self._cycle], [self._choice])
