"""Device arrays with a copy on the host, so that binding a solver reads nothing back from the device."""

import numpy as np
import warp as wp


def keep(values, dtype, device):
    """Returns an array of values that never change, and keeps the values on the host.

    Args:
        values: NumPy array of the scalar type of ``dtype``.
        dtype: Type of an item, a scalar or a vector.
        device: The Warp device.
    """
    array = wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    if not array.device.is_cpu:
        array.kept = values
    return array


def repeat(value, count):
    """Returns an array (count,) of stride 0 that repeats the number of a kept array (1,)."""
    array = wp.array(ptr=value.ptr, shape=(count,), strides=(0,), dtype=value.dtype, device=value.device)
    array.value = value  # keeps the memory alive
    if hasattr(value, "kept"):
        array.kept = np.broadcast_to(value.kept, (count,))
    return array


def host_values(array):
    """Returns the values of an array on the host, not to be changed; those of an array that changes are read back."""
    return array.kept if hasattr(array, "kept") else array.numpy()


def release(array):
    """Drops the host copy of an array, which may then change on the device."""
    if hasattr(array, "kept"):
        del array.kept


def part(array, chosen):
    """Returns the slice ``chosen`` of an array, in the same memory."""
    found = array[chosen]
    if hasattr(array, "kept"):
        found.kept = array.kept[chosen]
    return found


def reordered(array, order):
    """Returns the items of a kept array in another ``order``; the array itself if it has stride 0."""
    return array if 0 in array.strides else keep(host_values(array)[order], array.dtype, array.device)
