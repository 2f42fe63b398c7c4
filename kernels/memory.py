"""Device functions that read and write contiguous memory."""

import math
from functools import cache

import warp as wp


def _copied(dtype):
    """C type of a number, their count, type of the value, and C code that copies ``from`` to ``to``, number by number so that
    loops vectorise.
    """
    number = f"wp::{getattr(dtype, '_wp_scalar_type_', dtype).__name__}"
    shape = getattr(dtype, "_shape_", ())
    kind = {0: number, 1: f"wp::vec_t<{shape and shape[0]}, {number}>", 2: f"wp::mat_t<{', '.join(map(str, shape))}, {number}>"}
    numbers = math.prod(shape)
    return number, numbers, kind[len(shape)], " ".join(f"to[{n}] = from[{n}];" for n in range(numbers))


@cache
def load(dtype, ndim=1, stored=None):
    """Device function (a, i) → entry i of contiguous memory, without strides and negative indices; ``stored`` is the dtype of
    the array, if another.
    """
    number, numbers, kind, copy = _copied(dtype)

    @wp.func_native(
        f"{kind} value; {number}* to = ({number}*)&value; "
        f"const {number}* from = (const {number}*)a.data + {numbers} * size_t(i); {copy} return value;"
    )
    def load_element(a: wp.array(dtype=stored or dtype, ndim=ndim), i: int) -> dtype: ...

    return load_element


@cache
def load_shared(dtype):
    """Device function (array, i) → entry i, for any stride, such as 0."""

    @wp.func_native("return *(decltype(a.data))((char*)a.data + size_t(i) * size_t(a.strides[0]));")
    def load_strided(a: wp.array(dtype=dtype), i: int) -> dtype: ...

    return load_strided


@cache
def store(dtype, stored=None):
    """Device function (a, i, value) that sets a[i] of contiguous memory."""
    number, numbers, _kind, copy = _copied(dtype)

    @wp.func_native(
        f"{number}* to = ({number}*)a.data + {numbers} * size_t(i); const {number}* from = (const {number}*)&value; {copy}"
    )
    def store_element(a: wp.array(dtype=stored or dtype), i: int, value: dtype): ...

    return store_element


@cache
def add_to(dtype, transposed=False):
    """Device function (a, i, value) that adds a value, or a 3×3 matrix ``transposed``, to a[i] of contiguous memory."""
    number, numbers, _kind, _copy = _copied(dtype)
    order = [3 * (n % 3) + n // 3 for n in range(9)] if transposed else range(numbers)
    sums = " ".join(f"to[{n}] += from[{m}];" for n, m in enumerate(order))

    @wp.func_native(
        f"{number}* to = ({number}*)a.data + {numbers} * size_t(i); const {number}* from = (const {number}*)&value; {sums}"
    )
    def add_to_element(a: wp.array(dtype=dtype), i: int, value: dtype): ...

    return add_to_element


@cache
def prefetch(dtype):
    """Device function (a, indices, first, last) that prefetches a[indices[n]], first ≤ n < last, on a CPU."""
    number, numbers, _kind, _copy = _copied(dtype)

    @wp.func_native(
        f"for (int n = first; n < last && n < indices.shape[0]; ++n) {{ "
        f"const {number}* at = (const {number}*)a.data + {numbers} * (long long)((const int*)indices.data)[n]; "
        f"__builtin_prefetch(at, 1); __builtin_prefetch(at + {numbers - 1}, 1); }}"
    )
    def prefetch_entries(a: wp.array(dtype=dtype), indices: wp.array(dtype=wp.int32), first: int, last: int): ...

    return prefetch_entries
