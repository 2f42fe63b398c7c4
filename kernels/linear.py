"""Kernels of a sparse matrix of 3×3 blocks and of conjugate gradients in every copy.

The matrix has block compressed rows (offsets, columns, values), and a diagonal block per copy; ``active[copy]`` is 1 while a
copy iterates.

Conjugate gradients take vectors with 3×3 preconditioner blocks, or ``numbers``.

An iteration has two launches over (copies, lanes): the direction with its product, and the rest. On CUDA a ``block`` of threads
stores its part of a scalar product, which the next launch adds up; the CPU has one lane, and ``block`` 0.
"""

from functools import cache
from typing import Any

import warp as wp

from .block_rows import block_rows, lanes_of_rows, product_of_row, symmetric_product
from .memory import load
from .reduce import block_largest, block_sums, larger, sum_of_lanes
from .rotation import epsilon
from .vectors import types

MODULE = "warpcloth.conjugate_gradients"  # of the kernels over copies
# A rough solve ends when the quadratic model of φ has fallen by the fraction SHARE of a bound of its total decrease, or when an
# iteration lowers it by at most the fraction LAST of its decrease so far.
SHARE, LAST = wp.constant(wp.float64(0.7)), wp.constant(wp.float64(0.1))
# Solves are accurate if ‖b‖ is below this fraction of its largest value, in the norm of the preconditioner.
NEAR = wp.constant(wp.float64(1e-6))


@cache
def add_masses(dtype):
    """Kernel over vertices: values[diagonal] += scale·m I, or I for a pinned vertex."""
    _, mat33 = types(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_diagonal(
        # elements
        diagonal: wp.array(dtype=wp.int32),
        mass: wp.array(dtype=dtype),
        inverse_mass: wp.array(dtype=dtype),
        # parameters
        scale: dtype,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        i = wp.tid()
        entry = wp.where(inverse_mass[i] > dtype(0.0), scale * mass[i], dtype(1.0))
        s = diagonal[i]
        values[s] = values[s] + entry * wp.identity(n=3, dtype=dtype)

    return add_to_diagonal


@cache
def add_blocks(dtype):
    """Kernel over blocks s of the matrix: values[s] += Σ blocks[sources[offsets[s] : offsets[s+1]]], in a fixed order."""
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
        first = offsets[s]
        end = offsets[s + 1]
        if first < end:  # colliders add to blocks on the diagonal only
            total = values[s]
            for n in range(first, end):
                total += blocks[sources[n]]
            values[s] = total

    return gather_blocks


@cache
def lock_blocks(dtype):
    """Kernel over blocks of the matrix: sets rows and columns of locked coordinates to 0, and diagonal entries ≤ 0 there to 1.

    Positive ones keep the scale of the matrix; NaN stays.
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
    """Kernel over vertices: out = a along axes where ``taken`` is 1."""
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
def rounding(dtype, block: int):
    """Kernel over (copies, lanes): b = −∇φ, and parts of estimates of rounding errors of force and energy.

    They are Σ(ρ + ε‖A[i, i]‖ edge)² [N²] and Σ½ρ²/‖A[i, i]‖ [J], ρ = ε Σⱼ ‖A[i, j]‖(‖xⱼ − xᵢ‖ + ‖dⱼ‖), where the typical
    ``edge`` stands for pinned neighbours. In float32 the parts with ‖xⱼ − xᵢ‖ and the edge are 0: elements are evaluated in
    float64.

    The third is max 2ε²‖A[i, i]‖ [N/m]; times φ it estimates Σ(εF)² of the elements' forces, as F² ≤ 2‖A‖u.
    """
    vec3, mat33 = types(dtype)
    column, block_at, vector = load(wp.int32), load(mat33), load(vec3)
    (store, _add_up), (store_largest, _find) = block_sums(block), block_largest(block)
    apart = dtype(float(dtype is wp.float64))

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
        gradient: wp.array(dtype=vec3),
        # parameters
        edge: dtype,
        per_copy: int,
        lanes: int,
        # out
        b: wp.array(dtype=vec3),
        parts: wp.array3d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        force, energy, largest = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        for k in range(lane, per_copy, lanes):
            i = copy * per_copy + k
            b[i] = -gradient[i]
            total = dtype(0.0)
            for s in range(offsets[i], offsets[i + 1]):
                j, each = column(columns, s), block_at(values, s)
                total += wp.sqrt(wp.ddot(each, each)) * (apart * wp.length(vector(x, j) - x[i]) + wp.length(vector(d, j)))
            own = values[diagonal[i]]
            size = wp.sqrt(wp.ddot(own, own))
            rho = wp.float64(epsilon(edge) * (total + apart * size * edge))
            force += rho * rho
            rho = wp.float64(epsilon(edge) * total)
            energy += wp.float64(0.5) * rho * rho / wp.float64(size)
            largest = larger(largest, wp.float64(dtype(2.0) * epsilon(edge) * epsilon(edge) * size))
        store(lane, force, parts[0], copy)
        store(lane, energy, parts[1], copy)
        store_largest(lane, largest, parts[2], copy)

    return rounding_of_rows


@cache
def invert_diagonal(dtype):
    """Kernel over block rows: inverse[i] = A[i, i]⁻¹, or I/‖A[i, i]‖ if indefinite, by leading minors (Sylvester).

    If the determinant of A[i, i]/‖A[i, i]‖ is below ``lost``, as deep in contact, the inverse is computed in float64.
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
    vec3, mat33 = types(dtype)
    name = f"{MODULE}.{dtype.__name__}"
    return (dtype, dtype, f"{name}.numbers") if numbers else (vec3, mat33, name)


@wp.struct
class Solves:
    """The conjugate gradients of each copy, (B,) arrays.

    ``rz`` is rᵀz, ``first`` its first value; ``negative`` is 1 after negative curvature; ``iteration`` counts from 1 up to
    ``most``; ``proceed`` (1,) is 1 if a copy is active; the last three are those of :func:`is_enough`, or None.
    """

    active: wp.array(dtype=wp.int32)
    next_active: wp.array(dtype=wp.int32)
    negative: wp.array(dtype=wp.int32)
    rz: wp.array(dtype=wp.float64)
    next_rz: wp.array(dtype=wp.float64)
    first: wp.array(dtype=wp.float64)
    tolerance: wp.array(dtype=wp.float64)
    iteration: wp.array(dtype=wp.int32)
    next_iteration: wp.array(dtype=wp.int32)
    most: wp.array(dtype=wp.int32)
    proceed: wp.array(dtype=wp.int32)
    decrease: wp.array(dtype=wp.float64)
    largest: wp.array(dtype=wp.float64)
    accurate: wp.array(dtype=wp.int32)


@cache
def scalar_product(numbers: bool):
    @wp.func
    def multiplied(a: Any, b: Any):
        if wp.static(numbers):
            return wp.float64(a) * wp.float64(b)
        else:
            return wp.float64(wp.dot(a, b))

    return multiplied


@wp.func
def begin_iteration(solves: Solves, copy: int, lane: int, rz: wp.float64):
    """Begins an iteration of an active copy: returns the ratio of rᵀz to that before, or −1 if the copy has ended.

    It ends if √(rᵀz) is at its tolerance or NaN, or after ``most`` iterations.
    """
    if copy == 0 and lane == 0:
        solves.proceed[0] = 0
    if solves.active[copy] == 0:
        if lane == 0:
            solves.next_active[copy] = 0
        return wp.float64(-1.0)
    done = solves.iteration[copy]
    ratio = wp.float64(0.0)
    going = rz > wp.float64(0.0)
    if done > 0:
        ratio = rz / solves.rz[copy]
        left = solves.tolerance[copy] * solves.tolerance[copy] * solves.first[copy]
        going = rz > left and done < solves.most[copy]
    if lane == 0:
        if done == 0:
            solves.first[copy] = rz
        solves.next_rz[copy] = rz
        solves.next_active[copy] = wp.where(going, 1, 0)
        solves.next_iteration[copy] = wp.where(going, done + 1, done)
    return wp.where(going, ratio, wp.float64(-1.0))


@cache
def start_solves(dtype, numbers: bool, block: int):
    """Kernel over (copies, lanes): x = 0, r = b, z = P r, p = 0 in ``wanted`` copies; parts of rᵀz."""
    vector, matrix, module = _unknowns(dtype, numbers)
    store, _add_up = block_sums(block)
    multiplied = scalar_product(numbers)

    @wp.kernel(module=module, enable_backward=False)
    def start(
        # state in
        preconditioner: wp.array(dtype=matrix),
        b: wp.array(dtype=vector),
        # parameters
        wanted: wp.array(dtype=wp.int32),
        per_copy: int,
        lanes: int,
        # out
        x: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        z: wp.array(dtype=vector),
        p: wp.array(dtype=vector),
        parts: wp.array2d(dtype=wp.float64),
        solves: Solves,
    ):
        copy, lane = wp.tid()
        total = wp.float64(0.0)
        if wanted[copy] == 1:
            for j in range(lane, per_copy, lanes):
                i = copy * per_copy + j
                if wp.static(numbers):
                    x[i] = dtype(0.0)
                    p[i] = dtype(0.0)
                else:
                    x[i] = vector()
                    p[i] = vector()
                r[i] = b[i]
                z[i] = preconditioner[i] * b[i]
                total += multiplied(r[i], z[i])
        store(lane, total, parts, copy)
        if lane == 0:
            solves.active[copy] = wanted[copy]
            if wanted[copy] == 1:
                solves.iteration[copy] = 0
                solves.next_iteration[copy] = 0
                solves.first[copy] = wp.float64(0.0)
                solves.next_rz[copy] = wp.float64(0.0)
                solves.proceed[0] = 1  # it is 0 after a solve

    return start


@cache
def dot_parts(dtype, numbers: bool, block: int):
    """Kernel over (copies, lanes): parts of aᵀb in active copies."""
    vector, _matrix, module = _unknowns(dtype, numbers)
    store, _add_up = block_sums(block)
    multiplied = scalar_product(numbers)

    @wp.kernel(module=module, enable_backward=False)
    def dot(
        # state in
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        # parameters
        active: wp.array(dtype=wp.int32),
        per_copy: int,
        lanes: int,
        # out
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        total = wp.float64(0.0)
        if active[copy] == 1:
            for j in range(lane, per_copy, lanes):
                i = copy * per_copy + j
                total += multiplied(a[i], b[i])
        store(lane, total, parts, copy)

    return dot


@cache
def turn(dtype, numbers: bool, block: int):
    """Kernel over (copies, lanes): p = z + ratio·p in copies that begin an iteration."""
    vector, _matrix, module = _unknowns(dtype, numbers)
    _store, add_up = block_sums(block)

    @wp.kernel(module=module, enable_backward=False)
    def turn_directions(
        # state in
        z: wp.array(dtype=vector),
        parts: wp.array2d(dtype=wp.float64),
        # parameters
        per_copy: int,
        lanes: int,
        # in and out
        solves: Solves,
        p: wp.array(dtype=vector),
    ):
        copy, lane = wp.tid()
        ratio = dtype(begin_iteration(solves, copy, lane, add_up(lane, parts, copy)))
        if ratio >= dtype(0.0):
            for j in range(lane, per_copy, lanes):
                i = copy * per_copy + j
                p[i] = z[i] + ratio * p[i]

    return turn_directions


@cache
def turn_and_multiply(dtype, block: int, terms: int = 0):
    """:func:`turn` from ``before`` to p, with q = A p and the parts of pᵀq."""
    vec3, _ = types(dtype)
    store, add_up = block_sums(block)
    multiplied, lanes = scalar_product(False), lanes_of_rows(block)
    product, sum_over = product_of_row(dtype, lanes, terms, True), sum_of_lanes(dtype, lanes)
    symmetric = symmetric_product(dtype)

    @wp.kernel(module=f"{MODULE}.{dtype.__name__}.{terms}", enable_backward=False)
    def turn_directions_and_multiply(
        # elements
        matrix: block_rows(dtype),
        # state in
        z: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        parts: wp.array2d(dtype=wp.float64),
        # parameters
        per_copy: int,
        threads: int,
        # in and out
        solves: Solves,
        # out
        p: wp.array(dtype=vec3),
        q: wp.array(dtype=vec3),
        pq_parts: wp.array2d(dtype=wp.float64),
    ):
        copy, thread = wp.tid()
        ratio = dtype(begin_iteration(solves, copy, thread, add_up(thread, parts, copy)))
        total = wp.float64(0.0)
        if ratio >= dtype(0.0):
            if wp.static(block == 0):
                for j in range(per_copy):
                    i = copy * per_copy + j
                    p[i] = z[i] + ratio * before[i]
                symmetric(matrix, copy * per_copy, (copy + 1) * per_copy, p, q)
                for j in range(per_copy):
                    i = copy * per_copy + j
                    total += multiplied(p[i], q[i])
            else:
                lane = thread % wp.static(lanes)
                for j in range(thread // wp.static(lanes), per_copy, threads // wp.static(lanes)):
                    i = copy * per_copy + j
                    row = sum_over(product(matrix, i, lane, z, before, ratio))
                    if lane == 0:
                        own = z[i] + ratio * before[i]
                        p[i] = own
                        q[i] = row
                        total += multiplied(own, row)
        store(thread, total, pq_parts, copy)

    return turn_directions_and_multiply


@wp.func
def is_enough(solves: Solves, copy: int, pq: wp.float64):
    """Whether x = P b of the first iteration suffices, as A − P⁻¹ has no part in P b, or a solve that is not ``accurate`` is
    done.

    ``decrease`` is twice the decrease of ½xᵀAx − bᵀx, at most bᵀPb if A ≥ P⁻¹; ``largest`` is the largest bᵀPb of solves.
    """
    rz, bound, first = solves.next_rz[copy], solves.first[copy], solves.next_iteration[copy] == 1
    fall = rz * rz / pq
    decrease = wp.where(first, fall, solves.decrease[copy] + fall)
    solves.decrease[copy] = decrease
    if first:
        if pq <= rz:
            return True
        solves.largest[copy] = wp.max(solves.largest[copy], bound)
    if solves.accurate[copy] == 1 or bound <= NEAR * NEAR * solves.largest[copy]:
        return False
    return decrease >= SHARE * bound or (fall <= LAST * decrease and not first)


@cache
def advance(dtype, numbers: bool, block: int):
    """Kernel over (copies, lanes): x += a p, r −= a q, z = P r with a = rᵀz/pᵀq; parts of rᵀz.

    If pᵀq ≤ 0, the copy ends, with x = p in its first iteration, else with x: descent directions (Steihaug 1983).
    """
    vector, matrix, module = _unknowns(dtype, numbers)
    store, add_up = block_sums(block)
    multiplied = scalar_product(numbers)

    @wp.kernel(module=module, enable_backward=False)
    def advance_unknowns(
        # state in
        preconditioner: wp.array(dtype=matrix),
        p: wp.array(dtype=vector),
        q: wp.array(dtype=vector),
        pq_parts: wp.array2d(dtype=wp.float64),
        # parameters
        per_copy: int,
        lanes: int,
        # in and out
        solves: Solves,
        x: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        # out
        z: wp.array(dtype=vector),
        parts: wp.array2d(dtype=wp.float64),
    ):
        copy, lane = wp.tid()
        pq = add_up(lane, pq_parts, copy)
        total = wp.float64(0.0)
        going = solves.next_active[copy] == 1
        if going:
            if pq <= wp.float64(0.0):
                going = False
                if solves.next_iteration[copy] == 1:
                    for j in range(lane, per_copy, lanes):
                        i = copy * per_copy + j
                        x[i] = p[i]
                if lane == 0:
                    solves.negative[copy] = 1
            else:
                a = dtype(solves.next_rz[copy] / pq)
                for j in range(lane, per_copy, lanes):
                    i = copy * per_copy + j
                    x[i] = x[i] + a * p[i]
                    r[i] = r[i] - a * q[i]
                    z[i] = preconditioner[i] * r[i]
                    total += multiplied(r[i], z[i])
        store(lane, total, parts, copy)
        if lane == 0:
            if going and solves.accurate:
                going = not is_enough(solves, copy, pq)
            solves.active[copy] = wp.where(going, 1, 0)
            solves.rz[copy] = solves.next_rz[copy]
            solves.iteration[copy] = solves.next_iteration[copy]
            if going:
                solves.proceed[0] = 1

    return advance_unknowns
