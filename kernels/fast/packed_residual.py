"""Position residuals of compensated summation, packed: three numbers of 10 bits in an int32, from −512 to 511 units each.

Beside x in float32 these take a third of the memory of a vector, of which large cloth on a GPU never has enough. A unit is a
power of two [m]. Numbers are changed as the last bits of floats, of which the least is a unit: a GPU converts whole numbers
four times as slowly as it adds.
"""

import warp as wp

FIRST = wp.constant(8388608.0)  # 2²³, from which on the least bit of a float32 is 1
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
    """The numbers nearest to value [m], at most 511 units; NaN becomes some number, and x is NaN then as well."""
    return pack_one(value[0], unit) | (pack_one(value[1], unit) << 10) | (pack_one(value[2], unit) << 20)
