"""Limits of a model's precision: values that it would turn into 0 or infinity, and positions where it loses the cloth."""

import numpy as np
import warp as wp

DTYPES = {"float32": (wp.float32, np.float32), "float64": (wp.float64, np.float64)}


def cast(name, unit, values, dtype, label, infinite=False):
    """``values`` in the precision of a model, each finite there, and single numbers 0 only where they were.

    Args:
        name: What they are, for the error.
        unit: Their unit, likewise.
        values: (B, count) numbers, or (B, count, …) components of vectors, in double precision.
        dtype: ``np.float32`` or ``np.float64``.
        label: Function (copy, index) → the words that name a value, which may be none.
        infinite: Whether a value may be infinite if it was so.

    Returns:
        np.ndarray: Of the same shape.

    Raises:
        ValueError: Naming the first value that is lost and its index.
    """
    limits = np.finfo(dtype)
    with np.errstate(over="ignore", under="ignore"):
        held = np.asarray(values).astype(dtype)
    lost = ~np.isfinite(held)
    if infinite:
        lost &= ~np.isinf(values)
    if np.ndim(values) == 2:  # of a vector, a component that is next to nothing may be lost
        lost |= (np.abs(held) < limits.tiny) & (values != 0.0)
    for index in np.argwhere(lost)[:1]:
        words = [name, label(*index[:2])] if label(*index[:2]) else [name]
        value = f"{values[tuple(index)]:.3g} {unit}".strip()
        raise ValueError(
            f"{' of '.join(words)} is {value}; {limits.dtype} ends at {limits.max:.2g}, and towards 0 at {limits.tiny:.2g}; "
            f"{_instead('use other units', dtype)}"
        )
    return held


def refuse_coarse(mesh, positions, dtype, label):
    """Refuses positions so far from the origin, or a mesh so large or small, that a precision loses the cloth.

    ε·|x| may be 1 % of the median edge of the rest shape, and the square of every edge must be a normal number.

    Args:
        mesh: The :class:`warpcloth.Mesh`.
        positions: (B, n, 3) [m].
        dtype: ``np.float32`` or ``np.float64``.
        label: Function (b, i) → the words that name a position.

    Raises:
        ValueError: Naming the edge, or the largest coordinate.
    """
    limits = np.finfo(dtype)
    edges = np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1)[:, 0], axis=1)
    least, most = np.sqrt(limits.tiny), np.sqrt(limits.max)
    for edge in (edges.min(), edges.max()):
        if not least < edge < most:
            raise ValueError(
                f"an edge of the mesh is {edge:.3g} m long; {limits.dtype} holds the squares of lengths from {least:.2g} to "
                f"{most:.2g} m; {_instead('use other units', dtype)}"
            )
    if not positions.size:
        return
    b, i, axis = np.unravel_index(np.abs(positions).argmax(), positions.shape)
    x, edge = positions[b, i, axis], np.median(edges)
    resolved = limits.eps * abs(x)
    if resolved > 0.01 * edge:
        raise ValueError(
            f"{label(b, i)} is at {'xyz'[axis]} = {x:.6g} m, where {limits.dtype} resolves {resolved:.2g} m, "
            f"and the median edge is {edge:.3g} m, which must be 100 times that; {_instead('move it to the origin', dtype)}"
        )


def refuse_large(scene, dtype):
    """Refuses colliders so large that a precision loses their surface.

    ε·size may be a fifth of the contact distance, or 1e-4 of the median edge, which is what the cloth has anyway; the size is
    the radius, or the shortest half of a box.

    Raises:
        ValueError: Naming the collider.
    """
    mesh, limits = scene.mesh, np.finfo(dtype)
    edge = np.median(np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1), axis=2))
    for collider in scene.colliders:
        half, radius = collider.core
        size = half.min() + radius
        if np.isfinite(size) and limits.eps * size > max(0.2 * scene.contact.distance, 1e-4 * edge):
            raise ValueError(
                f"the surface of the collider {collider.label} is {size:.6g} m from its centre, where {limits.dtype} resolves "
                f"{limits.eps * size:.2g} m, and the contact distance is {scene.contact.distance:g} m, which must be 5 times "
                f"that; {_instead('take a plane', dtype)}"
            )


def _instead(advice, dtype):
    return advice if dtype is np.float64 else f"{advice} or use float64"
