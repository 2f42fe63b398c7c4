"""Kernels that solve for multipliers through positions.

Rows are those of :mod:`.constraint_rows`, ``per_copy`` each; D is the inverse diagonal of J W Jᵀ + α̃; ``active[copy]`` is 1
while a copy iterates.
"""

from functools import cache

import warp as wp

from .vectors import types

MODULE = "warpcloth.primal"
# The largest penalty of a row, as a multiple of D. With more, rounding in float32 and the condition of JᵀDJ prevail.
STIFFEST = 1e5
# Tolerance of the first conjugate gradients for positions, and the smallest; passes that gain less than GAIN in r² make it so
# many times smaller.
INNER, TIGHTEST, GAIN, TIGHTER = 1e-6, 1e-9, 0.1, 0.1
# Passes at most, and the fraction of r² that must go in a pass with the smallest tolerance, or no pass follows.
PASSES, MIN_GAIN = 12, 0.2


@wp.struct
class Passes:
    """The passes of each copy, (B,), and of all, (1,).

    ``left`` is rᵀDr, ``first`` its first value, ``tolerance`` relative to √first, ``inner`` that of the conjugate gradients of
    a pass. ``along`` is rᵀDq, ``length`` qᵀDq, q = (J W Jᵀ + α̃)z for the change z. ``softened`` is 1 if a row's penalty is
    below 1/α̃; passes may then leave copies ``open``, ``rest`` the tolerance relative to what they left.
    """

    active: wp.array(dtype=wp.int32)
    left: wp.array(dtype=wp.float64)
    first: wp.array(dtype=wp.float64)
    square: wp.array(dtype=wp.float64)
    along: wp.array(dtype=wp.float64)
    length: wp.array(dtype=wp.float64)
    tolerance: wp.array(dtype=wp.float64)
    inner: wp.array(dtype=wp.float64)
    rest: wp.array(dtype=wp.float64)
    open: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    proceed: wp.array(dtype=wp.int32)
    softened: wp.array(dtype=wp.int32)
    finish: wp.array(dtype=wp.int32)


def _module(dtype):
    return f"{MODULE}.{dtype.__name__}"


@cache
def set_penalties(dtype):
    """Kernel over rows: penalty = 1/α̃, at most ``STIFFEST``/(J W Jᵀ), and 0 for a row that moves nothing."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def penalise(
        # state in
        compliance: wp.array(dtype=dtype),
        inverse: wp.array(dtype=dtype),
        # out
        penalty: wp.array(dtype=dtype),
        passes: Passes,
    ):
        i = wp.tid()
        found = dtype(0.0)
        if inverse[i] != dtype(0.0):
            softest = (dtype(1.0) / inverse[i] - compliance[i]) / dtype(STIFFEST)
            if softest > compliance[i]:
                passes.softened[0] = 1
            found = dtype(1.0) / wp.max(compliance[i], softest)
        penalty[i] = found

    return penalise


@cache
def begin_rows(dtype):
    """Kernel over rows: x = 0, r = b in ``wanted`` copies, square = D r²."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def begin(
        # state in
        inverse: wp.array(dtype=dtype),
        b: wp.array(dtype=dtype),
        # parameters
        wanted: wp.array(dtype=wp.int32),
        per_copy: int,
        # out
        x: wp.array(dtype=dtype),
        r: wp.array(dtype=dtype),
        square: wp.array(dtype=wp.float64),
        passes: Passes,
    ):
        i = wp.tid()
        if wanted[i // per_copy] == 1:
            x[i] = dtype(0.0)
            r[i] = b[i]
            square[i] = wp.float64(inverse[i]) * wp.float64(b[i]) * wp.float64(b[i])
        if i == 0:
            passes.count[0] = 0
            passes.proceed[0] = 0
            passes.finish[0] = 0

    return begin


@cache
def begin_copies():
    """Kernel over copies: activates ``wanted`` ones with a residual."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def begin(
        # parameters
        wanted: wp.array(dtype=wp.int32),
        # in and out
        passes: Passes,
    ):
        copy = wp.tid()
        square = passes.square[copy]
        going = wp.where(square > wp.float64(0.0), wanted[copy], 0)
        passes.first[copy] = square
        passes.left[copy] = square
        passes.active[copy] = going
        passes.open[copy] = 0
        passes.inner[copy] = wp.float64(INNER)
        if going == 1:
            passes.proceed[0] = 1

    return begin


@cache
def push_rows(dtype):
    """Kernel over rows of active copies: force = penalty·r, opposite = −r; counts the pass."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def push(
        # state in
        penalty: wp.array(dtype=dtype),
        r: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        # in and out
        passes: Passes,
        # out
        force: wp.array(dtype=dtype),
        opposite: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        if passes.active[i // per_copy] == 1:
            force[i] = penalty[i] * r[i]
            opposite[i] = -r[i]
        if i == 0:
            passes.count[0] = passes.count[0] + 1
            passes.proceed[0] = 0

    return push


@cache
def clear_pins(dtype):
    vec3, _ = types(dtype)

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def clear(
        # elements
        inverse_mass: wp.array(dtype=dtype),
        # in and out
        force: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        if inverse_mass[i] == dtype(0.0):
            force[i] = vec3()

    return clear


@cache
def pull_rows(dtype):
    """Kernel over rows of active copies: z = penalty·(r − J y), ``opposite`` = J y − r."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def pull(
        # state in
        penalty: wp.array(dtype=dtype),
        opposite: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        passes: Passes,
        # out
        z: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        if passes.active[i // per_copy] == 1:
            z[i] = -penalty[i] * opposite[i]

    return pull


@cache
def weigh_rows(dtype):
    """Kernel over rows of active copies: along = D r q, length = D q²."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def weigh(
        # state in
        inverse: wp.array(dtype=dtype),
        r: wp.array(dtype=dtype),
        q: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        passes: Passes,
        # out
        along: wp.array(dtype=wp.float64),
        length: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        if passes.active[i // per_copy] == 1:
            weighed = wp.float64(inverse[i]) * wp.float64(q[i])
            along[i] = weighed * wp.float64(r[i])
            length[i] = weighed * wp.float64(q[i])

    return weigh


@cache
def advance_rows(dtype):
    """Kernel over rows of active copies: x += a z, r −= a q with a = rᵀDq/qᵀDq, square = D r²."""

    @wp.kernel(module=_module(dtype), enable_backward=False)
    def advance(
        # state in
        inverse: wp.array(dtype=dtype),
        z: wp.array(dtype=dtype),
        q: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        passes: Passes,
        # in and out
        x: wp.array(dtype=dtype),
        r: wp.array(dtype=dtype),
        # out
        square: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        copy = i // per_copy
        if passes.active[copy] == 1:
            a = dtype(0.0)
            if passes.length[copy] != wp.float64(0.0):
                a = dtype(passes.along[copy] / passes.length[copy])
            x[i] = x[i] + a * z[i]
            left = r[i] - a * q[i]
            r[i] = left
            square[i] = wp.float64(inverse[i]) * wp.float64(left) * wp.float64(left)

    return advance


@cache
def end_pass():
    """Kernel over copies: ends those that are solved or NaN, and those that a pass with the smallest inner tolerance did not
    help.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def end(
        # in and out
        passes: Passes,
    ):
        copy = wp.tid()
        if passes.active[copy] == 1:
            now = passes.square[copy]
            before = passes.left[copy]
            wanted = passes.tolerance[copy] * passes.tolerance[copy] * passes.first[copy]
            going = now > wanted and passes.count[0] < wp.static(PASSES)
            if now > wp.float64(GAIN) * before:
                if passes.inner[copy] > wp.float64(1.01 * TIGHTEST):
                    passes.inner[copy] = wp.float64(TIGHTER) * passes.inner[copy]
                elif now > wp.float64(1.0 - MIN_GAIN) * before:
                    going = False
            passes.left[copy] = now
            passes.active[copy] = wp.where(going, 1, 0)
            if going:
                passes.proceed[0] = 1
            elif now > wanted and passes.softened[0] == 1:
                passes.open[copy] = 1
                passes.rest[copy] = wp.sqrt(wanted / now)
                passes.finish[0] = 1

    return end


@cache
def add_rows(dtype):
    @wp.kernel(module=_module(dtype), enable_backward=False)
    def add(
        # state in
        z: wp.array(dtype=dtype),
        # parameters
        per_copy: int,
        passes: Passes,
        # in and out
        x: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        if passes.open[i // per_copy] == 1:
            x[i] = x[i] + z[i]

    return add
