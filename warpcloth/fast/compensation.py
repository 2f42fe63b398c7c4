"""Decides which explicit steps use compensated summation, and the unit of packed residuals."""

import numpy as np
import warp as wp

# Largest rounding of positions without compensated summation, relative to the mean edge.
ROUNDING = 4e-5
# The unit of packed residuals over the rounding of x; and how many times farther from the origin than known beforehand
# positions may get.
FINER, FARTHER = 2.0**-6, 16.0


def needs_compensation(model):
    """Whether explicit steps need compensated summation, for edge strains with errors below half a percentage point.

    In float32, the rounding of positions is comparable to the strain of a step, and nothing damps this noise. After 1 s, 1 % of
    the springs of ``hanging`` with 512 × 512 vertices have an error of 0.81 percentage points, with compensated summation 0.31,
    as in float64. With 256 × 256 vertices it is 0.33. The limit is a rounding of 4e-5 of the mean edge at the farthest vertex.
    Steps with damped or refreshed terms evaluate forces at x alone and are not compensated; their error has not been measured.
    """
    if model.dtype is not wp.float32 or any(elements.damping is not None or elements.refresh for elements in model.terms):
        return False
    lengths = model.scene.mesh.edge_lengths
    if not lengths.size or not lengths.any():
        return False
    return bool(_rounding(model.scene.positions) > ROUNDING * lengths.mean())


def packed_unit(model):
    """The unit of packed residuals [m]; None if it is above an eighth of the rounding that :func:`needs_compensation` allows.

    With a unit of 1e-4 of the mean edge, a sheet with small steps has 15 times the error of vector residuals. The unit follows
    from the start of copies, the keyframes of pins, and the distance that a scene without pins can move.
    """
    scene, far = model.scene, _size(model.positions.numpy())
    if scene.pins.keyframes is not None:
        far = max(far, _size(scene.pins.keyframes))
    if not len(scene.fixed):
        speed, g, seconds = _size(model.velocities.numpy()), _size(model.gravity.numpy()), scene.duration
        far = max(far, (speed + 0.5 * g * seconds) * seconds / FARTHER)
    unit = FINER * _rounding(far)
    return unit if unit <= 0.125 * ROUNDING * scene.mesh.edge_lengths.mean() else None


def _size(values):
    """The largest absolute value."""
    return float(np.abs(values).max(initial=0.0))


def _rounding(positions):
    """The spacing of float32 at the farthest position [m]."""
    return float(np.spacing(np.float32(_size(positions))))
