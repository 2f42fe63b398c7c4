"""Which explicit steps add to positions by compensated summation, and in what unit the residual is packed."""

import numpy as np
import warp as wp

# Largest rounding of positions, relative to the mean edge, without compensated summation.
ROUNDING = 4e-5
# A packed residual has units of this times the rounding of x, so that it holds the residual of positions so many times as
# far from the origin as those known beforehand.
FINER, FARTHER = 2.0**-6, 16.0


def needs_compensation(model):
    """Whether explicit steps have to keep the residual of x for the strain of edges to be right to half a point.

    In float32 positions are rounded by about the strain that a step makes, and nothing damps the noise: after a second 1 % of
    the springs of ``hanging`` with 512 × 512 vertices are 0.81 percentage points off, compensated 0.31, as in float64; of
    256 × 256 vertices 0.33. Rounding at the farthest vertex is then above 4e-5 of the mean edge. Steps of terms that are
    damped or refreshed take forces at x alone and are not compensated; how far off these are has not been measured.
    """
    if model.dtype is not wp.float32 or any(elements.damping is not None or elements.refresh for elements in model.terms):
        return False
    lengths = model.scene.mesh.edge_lengths
    if not lengths.size or not lengths.any():
        return False
    return bool(_rounding(model.scene.positions) > ROUNDING * lengths.mean())


def packed_unit(model):
    """The unit of packed residuals [m]; None if above an eighth of the rounding that :func:`needs_compensation` allows.

    A unit of 1e-4 of the mean edge leaves a sheet of small steps 15 times as far off as vectors do. It is for where copies
    start, where pins are led, and how far a scene without pins gets.
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
    """The largest magnitude of numbers."""
    return float(np.abs(values).max(initial=0.0))


def _rounding(positions):
    """The distance of neighbouring numbers of float32 at the farthest of positions [m]."""
    return float(np.spacing(np.float32(_size(positions))))
