"""Stiffness of scenes in pyPBD against that in warpcloth."""

from ..terms import CorotatedMembrane
from .calibration import calibrated
from .pbd_runs import PositionBasedDynamics

# Steps per frame that converge to the rest shape of the samples, for the strips and for the cantilever.
_COARSE, _FINE = 20, 200


def calibrate(method, iterations=1):
    """Measures the :class:`warpcloth.others.calibration.Calibration` of a method of pyPBD."""
    coarse, fine = (PositionBasedDynamics(method, substeps, iterations) for substeps in (_COARSE, _FINE))
    return calibrated(coarse, fine, CorotatedMembrane(stiffness=50.0))
