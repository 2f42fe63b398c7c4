"""Solvers of sparse linear systems: conjugate gradients on the device, and factorisations."""

import importlib.util
import time

import numpy as np
import warp as wp

from ..base.interrupts import deferred
from ..core.capture import Mirror, on_host
from ..core.sums import Lanes
from ..kernels import linear
from ..kernels.elementwise import scale
from .constant_multigrid import CopyCycles

# Largest number of unknowns for which all eigenvalues are computed.
SMALL = 100
# Iterations of conjugate gradients in the body of a loop on CUDA, even for two directions take turns. On an H200 a turn of the
# loop costs as much as the launches of 1.5 iterations that do nothing.
AT_ONCE = 4


class ConjugateGradients:
    """Solves A x = b for each copy by conjugate gradients from x = 0, on the device; it may be captured.

    The preconditioner P is the inverse diagonal blocks, a cycle of ``multigrid``, or for each copy what a ``choice`` says. A
    copy ends when √(rᵀPr) has fallen to its tolerance times the first value, or at a direction of negative curvature. In that
    case x is a descent direction of ½xᵀAx − bᵀx, and ``negative`` is 1 (Steihaug 1983).

    Args:
        matrix: A, such as a :class:`warpcloth.core.hessian.Hessian`. Its ``block_rows`` is None if it has none.
        iterations: Maximum number of iterations of one solve.

    Attributes:
        iteration: Number of iterations of the last solve, (B,) int32.
        outdated: Copies of which the next solve computes coarse matrices again, (B,) int32; None without a choice.
    """

    capturable = True

    def __init__(self, matrix, iterations, multigrid=None, choice=None):
        model = self.model = matrix.model
        self.matrix, self.multigrid, self.choice = matrix, multigrid, choice
        self.outdated = None if choice is None else choice.outdated
        matrix.prepare()

        def per_unknown(dtype):
            return wp.zeros(matrix.count, dtype=dtype, device=model.device)

        self.r, self.z, self.p, self.q = (per_unknown(matrix.vector) for _ in range(4))
        self.preconditioner = per_unknown(matrix.block) if multigrid is None else multigrid.sweep

        self._solves = solves = linear.Solves()
        for name in ("active", "next_active", "negative", "iteration", "next_iteration"):
            setattr(solves, name, model.scalars(wp.int32))
        for name in ("rz", "next_rz", "first", "tolerance"):
            setattr(solves, name, model.scalars())
        solves.proceed = wp.zeros(1, dtype=wp.int32, device=model.device)
        solves.most = model.scalars(wp.int32)
        solves.most.fill_(iterations)
        self.active, self.negative, self.tolerance = solves.active, solves.negative, solves.tolerance
        self.iteration = solves.iteration

        lanes = Lanes(model, matrix.per_copy)
        block, self._lanes, self._dim, self._at_once = lanes.block, lanes.count, lanes.dim, AT_ONCE if lanes.block else 1
        self._parts = lanes.parts()
        of_unknowns = linear.start_solves, linear.dot_parts, linear.turn, linear.advance
        self._launch = model.launcher((of_unknowns, model.dtype, matrix.vector is model.dtype, block))
        self._turn_and_multiply, self._other = None, self.p
        if matrix.block_rows is not None:
            self._turn_and_multiply = model.kernel(linear.turn_and_multiply, model.dtype, block, matrix.terms_in_rows)
            lanes = Lanes(model, matrix.per_copy * linear.lanes_of_rows(block))
            if block:
                self._other = per_unknown(matrix.vector)
        self._row_threads, self._row_dim, self._pq_parts = lanes.count, lanes.dim, lanes.parts()

    def outdate(self):
        """Launches that the next solve with coarse matrices computes them again."""
        if self.outdated is not None:
            self.outdated.fill_(1)

    def update(self):
        """Launches the preconditioner of :meth:`solve_again` for the present A."""
        if self.multigrid is None:
            self.matrix.invert_diagonal(self.preconditioner)
        else:
            self.multigrid.update()

    def solve(self, b, x, wanted):
        """Solves to the relative ``tolerance`` (B,) for the copies that are ``wanted`` (B,); others keep x."""
        choice = self.choice
        if choice is None:
            self.update()
            self.solve_again(b, x, wanted)
            return
        self.negative.zero_()
        choice.launch_begin(self._solves, wanted)
        wp.capture_if(choice.any_blocks, self._solve_with_blocks, b=b, x=x, wanted=choice.by_blocks)
        wp.capture_if(choice.any_cycles, self._solve_with_cycles, b=b, x=x, wanted=choice.by_cycles)
        choice.launch_end(self._solves, wanted)

    def solve_again(self, b, x, wanted):
        """As :meth:`solve`, with the preconditioner of the last :meth:`update`."""
        self.negative.zero_()
        self._solve_as_updated(b, x, wanted, self.multigrid is not None)

    def _solve_with_blocks(self, b, x, wanted):
        self.matrix.invert_diagonal(self.preconditioner)
        self._solve_as_updated(b, x, wanted, False)

    def _solve_with_cycles(self, b, x, wanted):
        self.multigrid.update_sweeps()
        wp.capture_if(self.choice.any_due, self.multigrid.update_coarse, due=self.choice.due)
        self._solve_as_updated(b, x, wanted, True)

    def _solve_as_updated(self, b, x, wanted, refine):
        self._launch_start(b, x, wanted)
        count = self._at_once
        if refine:
            self._refine(wanted)
            count = min(count, 2)
        wp.capture_while(self._solves.proceed, self._iterate, x=x, count=count, refine=refine)

    def _launch_start(self, b, x, wanted):
        given = [self.preconditioner, b, wanted, self.matrix.per_copy, self._lanes]
        self._launch(linear.start_solves, self._dim, given, [x, self.r, self.z, self.p, self._parts, self._solves])

    def _refine(self, active):
        """z = P r by multigrid and the parts of rᵀz, after the sweep in which z = S r."""
        self.multigrid.refine(self.r, self.z, active)
        self._launch_dot(self.r, self.z, active, self._parts)

    def _iterate(self, x, count, refine):
        """Launches ``count`` iterations, an even number if directions have two arrays that take turns."""
        for k in range(count):
            before, p = (self._other, self.p) if k % 2 else (self.p, self._other)
            self._launch_product(before, p)
            given = [self.preconditioner, p, self.q, self._pq_parts, self.matrix.per_copy, self._lanes]
            self._launch(linear.advance, self._dim, given, [self._solves, x, self.r, self.z, self._parts])
            if refine:
                self._refine(self.active)

    def _launch_product(self, before, p):
        """p = z + ratio·``before``, q = A p and the parts of pᵀq; ``before`` may be p."""
        matrix = self.matrix
        if self._turn_and_multiply is not None:
            given = [matrix.block_rows(), self.z, before, self._parts, matrix.per_copy, self._row_threads]
            self.model.launch(self._turn_and_multiply, self._row_dim, given, [self._solves, p, self.q, self._pq_parts])
            if matrix.apart is not None:
                matrix.apart.add_products(p, self.q, self._solves.next_active)
                self._launch_dot(p, self.q, self._solves.next_active, self._pq_parts)
            return
        self._launch(linear.turn, self._dim, [self.z, self._parts, matrix.per_copy, self._lanes], [self._solves, p])
        matrix.multiply(p, self.q, self._solves.next_active)
        self._launch_dot(p, self.q, self._solves.next_active, self._pq_parts)

    def _launch_dot(self, a, b, active, parts):
        self._launch(linear.dot_parts, self._dim, [a, b, active, self.matrix.per_copy, self._lanes], [parts])


class Factorised:
    """Solves A x = b by a sparse factorisation on the host (scipy's SuperLU in symmetric mode), for any stiffness.

    Pivots are on the diagonal, so that their signs are those of the eigenvalues (Sylvester's law of inertia): ``negative`` is 1
    for a copy with a negative one. This may fail if an indefinite matrix has two pivots near 0.
    """

    capturable, outdated = False, None

    def __init__(self, hessian):
        self.hessian, self.model = hessian, hessian.model
        model = self.model
        self.matrices = hessian.matrices()
        self.starts = np.cumsum([0, *(len(matrix.data) for matrix in self.matrices)])
        self.values = Mirror(hessian.values)
        self.negative, self.tolerance = model.scalars(wp.int32), model.scalars()
        self._mirrors = {}

    def outdate(self):
        """Does nothing: each solve factorises."""

    def solve(self, b, x, wanted):
        """Solves in float64; 0 if A is singular or not finite. Copies that are not ``wanted`` keep x."""
        right, left, wanted = (self._mirror(array) for array in (b, x, wanted))
        sides = right.read().astype(np.float64).reshape(self.model.copies, -1)
        solution, negative = left.read().astype(np.float64).reshape(sides.shape), np.zeros(self.model.copies, dtype=bool)
        values, coupling = self.values.read(), self.hessian.coupling()
        for copy in np.flatnonzero(wanted.read()):
            factor = self._factor(copy, values, coupling)
            found = None if factor is None else factor.solve(sides[copy])
            solution[copy] = 0.0
            if found is not None and np.isfinite(found).all():
                solution[copy], negative[copy] = found, (factor.U.diagonal() < 0.0).any()
        left.write(solution.reshape(-1, 3))
        self._mirror(self.negative).write(negative)

    def curves_down(self, unresolved=0.0):
        """Returns whether a copy has an eigenvalue below −(1000 ε times its largest diagonal entry + ``unresolved`` [N/m])."""
        shift = 1e3 * float(np.finfo(self.model.numpy_dtype).eps)
        given = self.values.read(), self.hessian.coupling(), shift, unresolved
        factors = (self._factor(copy, *given) for copy in range(self.model.copies))
        return any(factor is not None and bool((factor.U.diagonal() < 0.0).any()) for factor in factors)

    def lowest_eigenvalue(self, copy=0):
        """Returns the lowest eigenvalue of a copy's matrix over free coordinates [N/m]."""
        columns, n = self._columns(copy, self.values.read(), self.hessian.coupling()), 3 * self.model.per_copy
        free = np.flatnonzero(self.model.coordinate_mobility()[copy * n : (copy + 1) * n])
        return lowest_eigenvalue(columns[free][:, free])

    def _columns(self, copy, values, coupling):
        matrix = self.matrices[copy]
        matrix.data[:] = values[self.starts[copy] : self.starts[copy + 1]]
        if coupling is None:
            return matrix.tocsc()
        own = slice(copy * matrix.shape[0], (copy + 1) * matrix.shape[0])
        return matrix.tocsc() + coupling[own, own]

    def _mirror(self, array):
        if array.ptr not in self._mirrors:
            self._mirrors[array.ptr] = Mirror(array)
        return self._mirrors[array.ptr]

    def _factor(self, copy, values, coupling, shift=0.0, unresolved=0.0):
        """Returns factors of a copy's matrix + ``shift`` times its largest diagonal entry + ``unresolved`` [N/m]; or None."""
        from scipy.sparse import identity

        columns = self._columns(copy, values, coupling)
        if not np.isfinite(columns.data).all():
            return None
        if shift:
            added = shift * np.abs(columns.diagonal()).max() + unresolved
            columns = columns + added * identity(columns.shape[0], format="csc")
        try:
            return symmetric_factors(columns)
        except RuntimeError:  # exactly singular
            return None


def symmetric_factors(columns):
    """Factorises a symmetric matrix in compressed columns by scipy's SuperLU, with pivots on the diagonal.

    Raises:
        RuntimeError: The matrix is exactly singular.
    """
    from scipy.sparse.linalg import splu

    return splu(columns, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True, "Equil": False})


def lowest_eigenvalue(matrix):
    """Returns the lowest eigenvalue of a sparse symmetric matrix (n, n), by Lanczos iterations with (A + σI)⁻¹.

    σ starts at 1000 ε times the largest diagonal entry and grows tenfold until A + σI has no negative pivot. Then the lowest
    eigenvalue is the one nearest to −σ (Ericsson and Ruhe 1980).

    Returns:
        float: Accurate to about 1e-10 (λ + σ), σ at most 10 |λ| or 1000 ε times the largest diagonal entry. Infinite if n is 0,
            NaN if an entry is not finite.
    """
    from scipy.sparse import identity
    from scipy.sparse.linalg import LinearOperator, eigsh

    n, columns = matrix.shape[0], matrix.tocsc().astype(np.float64)
    if n == 0:
        return np.inf
    if not np.isfinite(columns.data).all():
        return np.nan
    if n <= SMALL:
        return float(np.linalg.eigvalsh(columns.toarray())[0])
    shift = 1e3 * np.finfo(np.float64).eps * (np.abs(columns.diagonal()).max() or 1.0)
    while True:
        try:
            factor = symmetric_factors(columns + shift * identity(n, format="csc"))
            if (factor.U.diagonal() > 0.0).all():
                break
        except RuntimeError:  # exactly singular
            pass
        shift *= 10.0
    inverse = LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=n)
    (largest,) = eigsh(inverse, k=1, which="LA", v0=start, tol=1e-10, return_eigenvectors=False)
    return float(1.0 / largest - shift)


class FactorisedRows:
    """Solves A x = b for A = J W Jᵀ + α̃ of constraint rows, scaled to a unit diagonal, by a sparse factorisation on the host.

    Args:
        matrix: The :class:`warpcloth.numerics.constraints.Constraints`.
        arrays: The arguments b, x and wanted of :meth:`solve`.
    """

    capturable = False

    def __init__(self, matrix, arrays):
        self.matrix, self.model = matrix, matrix.model
        self._mirrors = {array.ptr: Mirror(array) for array in arrays}
        if matrix.count:
            matrix.matrices()  # so that it allocates now

    def solve(self, b, x, wanted):
        """Solves for the copies that are ``wanted``, NaN if A or b is not finite; others get 0."""
        from scipy.sparse import diags

        right, left, wanted = (self._mirrors[array.ptr] for array in (b, x, wanted))
        sides = right.read().astype(np.float64).reshape(self.model.copies, -1)
        solution, matrices = np.zeros_like(sides), self.matrix.matrices()
        for copy in np.flatnonzero(wanted.read()):
            A, side = matrices[copy], sides[copy]
            if not (np.isfinite(A.data).all() and np.isfinite(side).all()):
                solution[copy] = np.nan
                continue
            diagonal = A.diagonal()
            scale = np.divide(1.0, np.sqrt(diagonal), out=np.zeros_like(diagonal), where=diagonal > 0.0)
            A, side = diags(scale) @ A @ diags(scale) + diags((scale == 0.0).astype(float)), scale * side
            factor = symmetric_factors(A.tocsc())
            found = factor.solve(side)
            found += factor.solve(side - A @ found)  # refined, because redundant rows make A nearly singular
            solution[copy] = scale * found
        left.write(solution.ravel())


def constant_factor(matrix, device, dtype):
    """Factorises a constant matrix: :class:`CholeskyFactor` if cholespy is installed, else :class:`LUFactor`.

    cholespy supports only the first of several CUDA devices.
    """
    if importlib.util.find_spec("cholespy") and not (device.is_cuda and device.ordinal):
        return CholeskyFactor(matrix, device, dtype)
    return LUFactor(matrix, device, dtype)


class CholeskyFactor:
    """Solves A x = b for a constant symmetric positive definite A by cholespy: CHOLMOD on the CPU, its own kernels on CUDA.

    A is factorised once, in double precision. Solves run on the device, without copies of vectors. On the CPU cholespy gets
    NumPy's views of the vectors, which cost 7 µs a solve; Warp's export of two arrays costs 40 µs.

    Args:
        matrix: A, a scipy sparse matrix (n, n), n at least 1.
        device: The Warp device of the vectors.
        dtype: ``wp.float32`` or ``wp.float64``.

    Attributes:
        seconds: Time of the factorisation [s].

    Raises:
        ValueError: A is not finite or not positive definite.
    """

    def __init__(self, matrix, device, dtype):
        import cholespy

        self.device = device
        columns = _finite_columns(matrix)
        parts = zip((columns.indptr, columns.indices, columns.data), (wp.int32, wp.int32, wp.float64), strict=True)
        compressed = [wp.array(part, dtype=kind, device=device) for part, kind in parts]
        solver = {wp.float32: cholespy.CholeskySolverF, wp.float64: cholespy.CholeskySolverD}[dtype]
        try:
            start = time.perf_counter()
            with deferred():
                self.solver = solver(columns.shape[0], *compressed, cholespy.MatrixType.CSC)
            self.seconds = time.perf_counter() - start
        except ValueError:
            raise ValueError(_INDEFINITE) from None

    def solve(self, b, x):
        """x = A⁻¹ b; both (n,) vectors or (n, k) numbers. NaN in b is NaN in x."""
        on_host(self.device, "a sparse factorisation")
        if self.device.is_cpu:  # cholespy reads NumPy's arrays without Python code, so that it can lose no interrupt
            self.solver.solve(np.asarray(b), np.asarray(x))
            return
        wp.synchronize_device(self.device)  # on CUDA cholespy has a stream of its own
        with deferred():  # an interrupt within Warp's part of the checks of arrays would become a TypeError
            self.solver.solve(b, x)
        wp.synchronize_device(self.device)


class LUFactor:
    """As :class:`CholeskyFactor`, by scipy's SuperLU on the host."""

    def __init__(self, matrix, device, dtype):
        try:
            start = time.perf_counter()
            self.factors = symmetric_factors(_finite_columns(matrix))
            self.seconds = time.perf_counter() - start
        except RuntimeError:  # exactly singular
            raise ValueError(_INDEFINITE) from None
        if not (self.factors.U.diagonal() > 0.0).all():
            raise ValueError(_INDEFINITE)
        self._mirrors = {}

    def solve(self, b, x):
        """x = A⁻¹ b; both (n,) vectors or (n, k) numbers. NaN in b is NaN in x."""
        right, left = (self._mirrors.get(array.ptr) or self._mirrors.setdefault(array.ptr, Mirror(array)) for array in (b, x))
        left.write(self.factors.solve(right.read().astype(np.float64)))


class CopyFactors:
    """Solves A x = b for each copy with a constant scalar matrix; copies with equal matrices share one factorisation.

    Args:
        matrices: A of each copy, scipy matrices (n, n) of one pattern.

    Attributes:
        seconds: Time of the factorisations [s].
        error: 0.

    Raises:
        ValueError: A matrix is not finite or not positive definite.
    """

    error, capturable = 0.0, False

    def __init__(self, model, matrices):
        self.per_copy, found = model.per_copy, {}
        self.factors = []
        for matrix in matrices:
            key = matrix.data.tobytes()
            if key not in found:
                found[key] = constant_factor(matrix, model.device, model.dtype)
            self.factors.append(found[key])
        self.seconds = sum(factor.seconds for factor in found.values())
        self._parts = {}

    def solve(self, b, x):
        """x = A⁻¹ b, both (N,) vectors, from the host. NaN in b gives NaN in x of that copy."""
        for factor, right, left in zip(self.factors, self._of_copies(b), self._of_copies(x), strict=True):
            factor.solve(right, left)

    def _of_copies(self, array):
        if array.ptr not in self._parts:
            n = self.per_copy
            self._parts[array.ptr] = [array[first : first + n] for first in range(0, len(array), n)]
        return self._parts[array.ptr]


class AxisSolves:
    """Solves A x = b with locked coordinates: for each axis, over the vertices free along it.

    Args:
        model, matrices: See :class:`CopyFactors`.
        solver: Class that solves without locks.

    Attributes:
        seconds, error: The sum and the largest of those of its solvers.
    """

    def __init__(self, model, matrices, solver):
        from scipy.sparse import diags

        self.model, self._found, self._take = model, model.vectors(), model.kernel(linear.take_axes, model.dtype)
        free = (model.mobility.numpy()[: model.per_copy] > 0.0).astype(np.float64)
        self._parts, self.capturable = [], solver.capturable
        for column in np.unique(free, axis=1).T:
            kept, rest = diags(column), diags(1.0 - column)
            factors = solver(model, [(kept @ matrix @ kept + rest).tocsc() for matrix in matrices])
            self._parts.append((factors, wp.vec3i(*(free == column[:, None]).all(axis=0).astype(int).tolist())))
        self.seconds = sum(factors.seconds for factors, _ in self._parts)
        self.error = np.max([factors.error for factors, _ in self._parts], axis=0)

    def solve(self, b, x):
        """x = A⁻¹ b of free coordinates, both (N,) vectors, from the host; x = b for the others."""
        for factors, taken in self._parts:
            factors.solve(b, self._found)
            self.model.launch(self._take, self.model.count, [self._found, taken], [x])


def solve_copies(model, matrices):
    """Returns what solves A x = b for each copy with a constant scalar matrix: factors on the CPU, cycles of multigrid on CUDA.

    Factors are solved one copy after another. On an H100 that takes 4 to 35 times as long as cycles with one copy of 8² to 256²
    vertices, on a core of a CPU 0.15 to 0.3 times as long.
    """
    solver = CopyCycles if model.device.is_cuda else CopyFactors
    return solver(model, matrices) if model.mobility is None else AxisSolves(model, matrices, solver)


class DiagonalScaling:
    """Launches x = D⁻¹ b with a diagonal D (B, n) above 0; it may be captured."""

    seconds, error, capturable = 0.0, 0.0, True  # there is nothing to factorise

    def __init__(self, model, diagonal):
        self.model, self._inverse = model, model.array(1.0 / diagonal.ravel(), model.dtype)
        self._scale = model.kernel(scale, model.dtype)

    def solve(self, b, x):
        """x = D⁻¹ b, both (N,) vectors."""
        self.model.launch(self._scale, self.model.count, [self._inverse, b], [x])


_INDEFINITE = "the matrix is not positive definite, so it has no Cholesky factors"


def _finite_columns(matrix):
    """Returns a sparse matrix in sorted compressed columns of double precision, and checks that it is finite."""
    columns = matrix.tocsc().astype(np.float64)
    columns.sort_indices()
    if not np.isfinite(columns.data).all():
        raise ValueError(f"the matrix has {np.count_nonzero(~np.isfinite(columns.data))} entries that are not finite")
    return columns
