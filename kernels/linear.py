"""Factories of the kernels of a sparse matrix of 3×3 blocks and of conjugate gradients in every copy.

The matrix has block compressed rows (offsets, columns, values). Every copy is a diagonal block of it, so only sums depend on
copies. ``active[copy]`` is 1 while that copy iterates.

Kernels that always run together share a module, which compiles faster. Conjugate gradients take vector unknowns with 3×3
preconditioner blocks, or with ``numbers`` scalar ones.
"""

from functools import cache
from typing import Any

import warp as wp

from .vectors import types

MODULE = "warpcloth.conjugate_gradients"  # of the kernels over copies


@cache
def set_inertia(dtype):
    """Kernel over vertices: values[diagonal] = scale·m I, or I for a pinned vertex."""
    _, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_diagonal(
        # elements
        diagonal: wp.array(dtype=wp.int32),
        mass: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        # parameters
        scale: dtype,
        # out
        values: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        entry = wp.where(inverse_mass[i] > dtype(0.0), scale * mass[i], dtype(1.0))
        values[diagonal[i]] = entry * wp.identity(n=3, dtype=dtype)

    return set_diagonal


@cache
def add_blocks(dtype):
    """Kernel over the blocks of the matrix: values[s] += Σ blocks[sources[offsets[s] : offsets[s+1]]], in a fixed order."""
    _, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_blocks(
        # elements
        offsets: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        # state in
        blocks: wp.array(dtype=mat33),
        # in and out
        values: wp.array(dtype=mat33),
    ):
        s = wp.tid()
        total = values[s]
        for n in range(offsets[s], offsets[s + 1]):
            total += blocks[sources[n]]
        values[s] = total

    return gather_blocks


@cache
def lock_blocks(dtype):
    """Kernel over the blocks of the matrix: sets rows and columns of locked coordinates to 0, except the diagonal.

    A diagonal entry of 0 or less becomes 1. Others stay, for they have the scale of the matrix; so do entries that are not
    finite.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def lock(
        # elements
        rows: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        mobility: wp.array(dtype=vec3),
        # in and out
        values: wp.array(dtype=mat33),
    ):
        s = wp.tid()
        i = rows[s]
        j = columns[s]
        block = values[s]
        for a in range(3):
            for b in range(3):
                if mobility[i][a] == dtype(0.0) or mobility[j][b] == dtype(0.0):
                    entry = dtype(0.0)
                    if i == j and a == b:
                        entry = wp.where(block[a, b] <= dtype(0.0), dtype(1.0), block[a, b])
                    block[a, b] = entry
        values[s] = block

    return lock


@cache
def take_axes(dtype):
    """Kernel over vertices: out = a along the axes where ``taken`` is 1; the others stay."""
    vec3, _ = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def take(
        # state in
        a: wp.array(dtype=vec3),
        # parameters
        taken: wp.vec3i,
        # in and out
        out: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        for axis in range(3):
            if taken[axis] == 1:
                out[i][axis] = a[i][axis]

    return take


@cache
def multiply(dtype):
    """Kernel over block rows: q = A p in active copies."""
    vec3, mat33 = types(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def multiply_rows(
        # elements
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        # state in
        values: wp.array(dtype=mat33),
        p: wp.array(dtype=vec3),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        q: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if active[i // per_copy] == 0:
            return
        total = vec3()
        for s in range(offsets[i], offsets[i + 1]):
            total += values[s] * p[columns[s]]
        q[i] = total

    return multiply_rows


@cache
def rounding(dtype):
    """Kernel over block rows: estimates of the rounding errors of the force and of the energy.

    ρ = ε Σⱼ ‖A[i, j]‖(‖xⱼ − xᵢ‖ + ‖dⱼ‖);  energy[i] = ½ρ²/‖A[i, i]‖ [J],  force[i] = (ρ + ε‖A[i, i]‖ edge)² [N²]. The typical
    edge length stands for pinned neighbours, which are not in the matrix.
    """
    vec3, mat33 = types(dtype)

    @wp.kernel(module=f"warpcloth.minimise.{dtype.__name__}", enable_backward=False)
    def rounding_of_rows(
        # elements
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        values: wp.array(dtype=mat33),
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        epsilon: dtype,
        edge: dtype,
        # out
        force: wp.array(dtype=wp.float64),
        energy: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = dtype(0.0)
        for s in range(offsets[i], offsets[i + 1]):
            j = columns[s]
            total += wp.sqrt(wp.ddot(values[s], values[s])) * (wp.length(x[j] - x[i]) + wp.length(d[j]))
        block = values[diagonal[i]]
        size = wp.sqrt(wp.ddot(block, block))
        rho = wp.float64(epsilon * (total + size * edge))
        force[i] = rho * rho
        rho = wp.float64(epsilon * total)
        energy[i] = wp.float64(0.5) * rho * rho / wp.float64(size)

    return rounding_of_rows


@cache
def invert_diagonal(dtype):
    """Kernel over block rows: inverse[i] = A[i, i]⁻¹, the block Jacobi preconditioner; I/‖A[i, i]‖ if A[i, i] is indefinite.

    Conjugate gradients need a definite preconditioner even for an indefinite matrix; leading minors decide (Sylvester). The
    block of a vertex deep in contact has a condition number of 1e5 and more, and its minors cancel. If the determinant of
    A[i, i]/‖A[i, i]‖ is below ``lost``, the inverse is computed in float64; else conjugate gradients would find no direction.
    """
    _, mat33 = types(dtype)

    @wp.func
    def indefinite(block: Any):
        zero = block.dtype(0.0)
        minor = block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0]
        return block[0, 0] <= zero or minor <= zero or wp.determinant(block) <= zero

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}", enable_backward=False)
    def invert_blocks(
        # elements
        diagonal: wp.array(dtype=wp.int32),
        # state in
        values: wp.array(dtype=mat33),
        # parameters
        lost: dtype,
        # out
        inverse: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        block = values[diagonal[i]]
        size = wp.sqrt(wp.ddot(block, block))
        found = wp.identity(n=3, dtype=dtype)
        exact = wp.mat33d(block) / wp.float64(size)
        block = block / size
        if wp.abs(wp.determinant(block)) < lost:
            if not indefinite(exact):
                found = mat33(wp.inverse(exact))
        elif not indefinite(block):
            found = wp.inverse(block)
        inverse[i] = found / size

    return invert_blocks


def _unknowns(dtype, numbers):
    """Type of an unknown, type of a diagonal block, name of the module."""
    vec3, mat33 = types(dtype)
    name = f"{MODULE}.{dtype.__name__}"
    return (dtype, dtype, f"{name}.numbers") if numbers else (vec3, mat33, name)


@cache
def start_iteration(dtype, numbers: bool = False):
    """Kernel over unknowns: x = 0, r = b, z = P r, p = z in the copies that are ``wanted``."""
    vector, block, module = _unknowns(dtype, numbers)

    @wp.kernel(module=module, enable_backward=False)
    def start(
        # state in
        preconditioner: wp.array(dtype=block),
        b: wp.array(dtype=vector),
        # parameters
        wanted: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        x: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        z: wp.array(dtype=vector),
        p: wp.array(dtype=vector),
    ):
        i = wp.tid()
        if wanted[i // per_copy] == 0:
            return
        if wp.static(numbers):
            x[i] = dtype(0.0)
        else:
            x[i] = vector()
        r[i] = b[i]
        z[i] = preconditioner[i] * b[i]
        p[i] = z[i]

    return start


@cache
def start_copies():
    """Kernel over copies: active = 1 for wanted copies with rᵀz > 0; stores their rᵀz; resets the iteration count."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def start(
        # state in
        rz: wp.array(dtype=wp.float64),
        # parameters
        wanted: wp.array(dtype=wp.int32),
        # out
        first: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        iteration: wp.array(dtype=wp.int32),
        proceed: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        first[copy] = rz[copy]
        active[copy] = wp.where(rz[copy] > wp.float64(0.0), wanted[copy], 0)
        iteration[0] = 0
        proceed[0] = 1

    return start


@cache
def advance(dtype, numbers: bool = False):
    """Kernel over unknowns: x += a p, r −= a q, z = P r with a = rᵀz/pᵀq of the copy.

    If pᵀq ≤ 0, the first step sets x = p, and a later step leaves x. Both give a descent direction (Steihaug 1983).
    """
    vector, block, module = _unknowns(dtype, numbers)

    @wp.kernel(module=module, enable_backward=False)
    def advance_unknowns(
        # state in
        preconditioner: wp.array(dtype=block),
        p: wp.array(dtype=vector),
        q: wp.array(dtype=vector),
        rz: wp.array(dtype=wp.float64),
        pq: wp.array(dtype=wp.float64),
        # parameters
        active: wp.array(dtype=wp.int32),
        iteration: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        x: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        # out
        z: wp.array(dtype=vector),
    ):
        i = wp.tid()
        copy = i // per_copy
        if active[copy] == 1:
            if pq[copy] <= wp.float64(0.0):
                if iteration[0] == 0:
                    x[i] = p[i]
            else:
                a = dtype(rz[copy] / pq[copy])
                x[i] = x[i] + a * p[i]
                r[i] = r[i] - a * q[i]
                z[i] = preconditioner[i] * r[i]

    return advance_unknowns


@cache
def check_copies():
    """Kernel over copies: deactivates those that are done; ratio = new rᵀz / old rᵀz; proceed = 1 if any is active."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def check(
        # state in
        new_rz: wp.array(dtype=wp.float64),
        pq: wp.array(dtype=wp.float64),
        first: wp.array(dtype=wp.float64),
        # parameters
        tolerance: wp.array(dtype=wp.float64),
        # in and out
        rz: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        negative: wp.array(dtype=wp.int32),
        # out
        ratio: wp.array(dtype=wp.float64),
        proceed: wp.array(dtype=wp.int32),
    ):
        copy = wp.tid()
        if active[copy] == 1:
            ratio[copy] = new_rz[copy] / rz[copy]
            rz[copy] = new_rz[copy]
            if pq[copy] <= wp.float64(0.0):
                negative[copy] = 1
                active[copy] = 0
            # NaN also ends the iteration; the caller finds it in the result.
            if not (new_rz[copy] > tolerance[copy] * tolerance[copy] * first[copy]):
                active[copy] = 0
            if active[copy] == 1:
                proceed[0] = 1

    return check


@cache
def new_direction(dtype, numbers: bool = False):
    """Kernel over unknowns: p = z + ratio p."""
    vector, _block, module = _unknowns(dtype, numbers)

    @wp.kernel(module=module, enable_backward=False)
    def turn(
        # state in
        z: wp.array(dtype=vector),
        ratio: wp.array(dtype=wp.float64),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        p: wp.array(dtype=vector),
    ):
        i = wp.tid()
        copy = i // per_copy
        if active[copy] == 1:
            p[i] = z[i] + dtype(ratio[copy]) * p[i]

    return turn
