"""Solves for the multipliers of constraint rows through positions, so that the cost grows with the number of vertices.

(J W Jᵀ + α̃)Δλ = r has as many unknowns as rows, several times the number of coordinates, and the condition of stiff cloth.
With D = α̃⁻¹ its inverse is D − D J A⁻¹JᵀD, A = M + JᵀDJ (Sherman, Morrison and Woodbury). A is a matrix over vertices, such
as that of Newton's method, which conjugate gradients solve with multigrid. α̃ of hard rows is too small for this; they take a
larger one here, and passes r → r − (J W Jᵀ + α̃)Δλ correct what it leaves (the method of multipliers, Hestenes 1969). They
also correct what rounding loses in the difference D(r − J y). Redundant hard rows leave a residual almost in the null space of
Jᵀ; conjugate gradients over rows remove it.
"""

import warp as wp

from ..core.hessian import BlockMatrix, BlockSum, ElementBlocks, pattern_of
from ..core.sums import RowSums
from ..kernels import constraint_jacobian as jacobian
from ..kernels import primal as kernels
from .additive_multigrid import multigrid_of
from .linear import ConjugateGradients


class _Products(ElementBlocks):
    """The blocks of JᵀDJ of the elements of one term."""

    factories = jacobian.product_blocks, jacobian.scatter_products

    def __init__(self, model, rows):
        super().__init__(model, rows.elements)
        self._rows = rows

    def launch(self, kernel, penalties, out, slots=None):
        rows, elements = self._rows, self.elements
        given = [elements.rest, rows.slopes, penalties, rows.layout]
        if slots is not None:
            given = [elements.stencil, *given[:2], *slots, *given[2:]]
        self.model.launch(kernel, self.count, given, [out])


class PrimalMatrix(BlockMatrix):
    """A = M + JᵀDJ over vertices, J the rows of the terms, D their ``penalties``. Pins and locks are those of a Hessian.

    Args:
        constraints: The :class:`warpcloth.numerics.constraints.Constraints`, all rows of which belong to terms.

    Attributes:
        penalties: D, one number for each row.
    """

    def __init__(self, constraints):
        model = constraints.model
        found = pattern_of(model, model.terms)
        super().__init__(model, found, any(elements.collider is not None for elements in model.terms))
        self.penalties = wp.zeros(constraints.count, dtype=model.dtype, device=model.device)
        self._sums = [
            BlockSum(_Products(model, part), sums, *part.key) for part, sums in zip(constraints.parts, found.sums, strict=True)
        ]

    def assemble(self):
        """Launches the assembly of ``values`` for the present J and D."""
        self.values.zero_()
        self.launch_masses(1.0)
        for one in self._sums:
            one.add(self.values, self.penalties)
        self.launch_locks()


class PrimalSolver:
    """Solves (J W Jᵀ + α̃)x = b of each copy, see the module.

    It runs on the device from x = 0 and may be captured. A copy ends when √(rᵀr/diagonal) has fallen to its tolerance times the
    first value, as with :class:`warpcloth.numerics.linear.ConjugateGradients` and diagonal entries, or if passes gain nothing.

    Args:
        constraints: The :class:`warpcloth.numerics.constraints.Constraints`.
        iterations: Maximum number of iterations of the conjugate gradients of a pass.

    Attributes:
        tolerance: (B,) float64.
    """

    capturable = True

    def __init__(self, constraints, iterations):
        model, self._constraints = constraints.model, constraints
        self.model, self._matrix = model, PrimalMatrix(constraints)
        self._linear = ConjugateGradients(self._matrix, iterations, multigrid_of(self._matrix))
        self._sums = RowSums(model, constraints.per_copy)

        def rows(dtype=model.dtype):
            return wp.zeros(constraints.count, dtype=dtype, device=model.device)

        self._r, self._z, self._q, self._opposite = (rows() for _ in range(4))
        self._one, self._other = rows(wp.float64), rows(wp.float64)
        self._force, self._y = model.vectors(), model.vectors()
        self._passes = passes = kernels.Passes()
        for name in ("left", "first", "square", "along", "length", "tolerance"):
            setattr(passes, name, model.scalars())
        passes.active, passes.open, passes.inner = model.scalars(wp.int32), model.scalars(wp.int32), self._linear.tolerance
        for name in ("count", "proceed", "softened", "finish"):
            setattr(passes, name, wp.zeros(1, dtype=wp.int32, device=model.device))
        self._rows = ConjugateGradients(constraints, iterations)
        passes.rest = self._rows.tolerance
        self.tolerance = passes.tolerance
        of_rows = kernels.push_rows, kernels.pull_rows, kernels.weigh_rows, kernels.advance_rows, kernels.add_rows
        self._launch = model.launcher(
            ((kernels.set_penalties, kernels.begin_rows, kernels.clear_pins, *of_rows), model.dtype),
            ((kernels.begin_copies, kernels.end_pass),),
        )

    def solve(self, b, x, wanted):
        """Solves for x to the relative ``tolerance`` (B,), for the copies that are ``wanted`` (B,); others keep x."""
        constraints, passes = self._constraints, self._passes
        given = [constraints.compliance, constraints.inverse]
        passes.softened.zero_()
        self._launch(kernels.set_penalties, constraints.count, given, [self._matrix.penalties, passes])
        self._matrix.assemble()
        self._linear.update()
        given = [constraints.inverse, b, wanted, constraints.per_copy]
        self._launch(kernels.begin_rows, constraints.count, given, [x, self._r, self._one, passes])
        self._sums.sum(self._one, constraints.per_copy, passes.square)
        self._launch(kernels.begin_copies, self.model.copies, [wanted], [passes])
        wp.capture_while(passes.proceed, self._pass, x=x)
        wp.capture_if(passes.finish, self._finish, x=x)

    def _finish(self, x):
        """Launches the solution for what passes left open."""
        self._rows.solve(self._r, self._z, self._passes.open)
        given = [self._z, self._constraints.per_copy, self._passes]
        self._launch(kernels.add_rows, self._constraints.count, given, [x])

    def _pass(self, x):
        model, constraints, passes, penalties = self.model, self._constraints, self._passes, self._matrix.penalties
        count, per_copy, active = constraints.count, constraints.per_copy, passes.active
        r, z, q, opposite, force, y = self._r, self._z, self._q, self._opposite, self._force, self._y
        self._launch(kernels.push_rows, count, [penalties, r, per_copy], [passes, z, opposite])
        force.zero_()
        for part in constraints.parts:
            part.launch_transpose(z, force, active)
        self._launch(kernels.clear_pins, model.count, [model.inverse_mass], [force])
        model.lock(force)
        self._linear.solve_again(force, y, active)
        constraints.launch_apply(y, opposite, active)
        self._launch(kernels.pull_rows, count, [penalties, opposite, per_copy, passes], [z])
        constraints.multiply(z, q, active)
        given = [constraints.inverse, r, q, per_copy, passes]
        self._launch(kernels.weigh_rows, count, given, [self._one, self._other])
        self._sums.sum(self._one, per_copy, passes.along)
        self._sums.sum(self._other, per_copy, passes.length)
        given = [constraints.inverse, z, q, per_copy, passes]
        self._launch(kernels.advance_rows, count, given, [x, r, self._one])
        self._sums.sum(self._one, per_copy, passes.square)
        self._launch(kernels.end_pass, model.copies, [], [passes])
