"""Arrays on a device whose values the host keeps, so that building from them copies nothing back from the device."""

import numpy as np
import warp as wp


def keep(values, dtype, device):
    """An array of these values, which do not change from here on and which the host keeps; on the CPU the array is on the host.

    Args:
        values: NumPy, of the scalar type of ``dtype``.
        dtype: The type of an item, a scalar or a vector.
        device: The Warp device.
    """
    array = wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    if not array.device.is_cpu:
        array.kept = values
    return array


def repeat(value, count):
    """An array (count,) of stride 0 of the one number of a kept array (1,)."""
    array = wp.array(ptr=value.ptr, shape=(count,), strides=(0,), dtype=value.dtype, device=value.device)
    array.value = value  # keeps the memory alive
    if hasattr(value, "kept"):
        array.kept = np.broadcast_to(value.kept, (count,))
    return array


def host_values(array):
    """The values of an array on the host, to be read: as they were built, or of what changes on the device as they are now."""
    return array.kept if hasattr(array, "kept") else array.numpy()


def release(array):
    """Lets an array change on the device: the host keeps its values no longer."""
    if hasattr(array, "kept"):
        del array.kept


def part(array, chosen):
    """The part of an array that is the slice ``chosen``, in the same memory."""
    found = array[chosen]
    if hasattr(array, "kept"):
        found.kept = array.kept[chosen]
    return found


def reordered(array, order):
    """A kept array of the items of index ``order``; the array itself where all items are one."""
    return array if 0 in array.strides else keep(host_values(array)[order], array.dtype, array.device)
