"""The ray caster: silhouettes and shadows against exact ones, colours, and what it does with bad input."""

import numpy as np
import pytest

from warpcloth.picture.camera import Camera
from warpcloth.picture.raycast import RayCaster, Shape

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_has_a_point_that_is_not_finite_is_left_out_and_counted(device, bad):
    points = np.vstack([SQUARE, [[bad, 0.0, 0.0]]])
    camera = Camera.framed([SQUARE], azimuth=10.0)
    whole = RayCaster([Shape(4, HALVES)], 64, 48, device=device).image([SQUARE], camera)
    caster = RayCaster([Shape(5, [*HALVES, (0, 1, 4)])], 64, 48, device=device)
    found = caster.image([points], camera)
    assert caster.left_out == 1 and (found == whole).all() and np.ptp(whole) > 0
    assert (caster.image([points], camera) == found).all()
