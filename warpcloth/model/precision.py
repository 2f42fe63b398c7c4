"""Checks that the precision of a model represents all values, and resolves the cloth and the surface of colliders."""

import numpy as np
import warp as wp

DTYPES = {"float32": (wp.float32, np.float32), "float64": (wp.float64, np.float64)}


def cast(name, unit, values, dtype, label, infinite=False):
    """Casts ``values`` to the precision of a model, and checks that none overflows and that no number underflows.

    Args:
        name: What the values are, for the error message.
        unit: Their unit, for the error message.
        values: (B, count) numbers, or (B, count, …) components of vectors, in double precision.
        dtype: ``np.float32`` or ``np.float64``.
        label: Function (copy, index) → words that name a value, or "".
        infinite: Whether values may be infinite.

    Returns:
        np.ndarray: Of the same shape.

    Raises:
        ValueError: A value overflows or underflows. The message names it and its index.
    """
    limits = np.finfo(dtype)
    with np.errstate(over="ignore", under="ignore"):
        held = np.asarray(values).astype(dtype)
    lost = ~np.isfinite(held)
    if infinite:
        lost &= ~np.isinf(values)
    if np.ndim(values) == 2:  # a component of a vector may underflow
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
    """Checks that a precision resolves the cloth: ε·|x| is at most 1 % of the median rest edge, and edges can be squared.

    Args:
        mesh: The :class:`warpcloth.Mesh`.
        positions: (B, n, 3) [m].
        dtype: ``np.float32`` or ``np.float64``.
        label: Function (b, i) → words that name a position.

    Raises:
        ValueError: It does not. The message names the edge or the largest coordinate.
    """
    limits = np.finfo(dtype)
    edges = mesh.edge_lengths
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
    """Checks that a precision resolves the surface of colliders.

    ε·size is at most a fifth of the contact distance, or 1e-4 of the median edge. The size is the radius plus the shortest half
    size of a box.

    Raises:
        ValueError: It does not. The message names the collider.
    """
    mesh, limits = scene.mesh, np.finfo(dtype)
    edge = np.median(np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1), axis=2))
    for collider in scene.colliders:
        if collider.is_mesh:
            continue
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
