"""Residuals of compensated summation in an int32: three 10-bit integers, −512 to 511 units, a power of two [m].

Numbers are converted through the last bits of floats, as a GPU converts integers slowly.
"""

import warp as wp

FIRST = wp.constant(8388608.0)  # 2²³, from which the last bit of a float32 is 1
MIDDLE = wp.constant(512.0)


@wp.func
def unpack_one(code: int, unit: float):
    first = FIRST * unit
    return wp.cast((code & 1023) ^ 512 ^ wp.cast(first, wp.int32), wp.float32) - (first + MIDDLE * unit)


@wp.func
def unpack_residual(code: int, unit: float):
    """The three numbers times the unit [m]."""
    return wp.vec3(unpack_one(code, unit), unpack_one(code >> 10, unit), unpack_one(code >> 20, unit))


@wp.func
def pack_one(value: float, unit: float):
    most = (MIDDLE - 1.0) * unit
    shifted = wp.clamp(value, -most, most) + (FIRST + MIDDLE) * unit
    return (wp.cast(shifted, wp.int32) & 1023) ^ 512


@wp.func
def pack_residual(value: wp.vec3, unit: float):
    """The integers nearest to value [m], at most 511 units; any for NaN, as x is NaN too."""
    return pack_one(value[0], unit) | (pack_one(value[1], unit) << 10) | (pack_one(value[2], unit) << 20)
