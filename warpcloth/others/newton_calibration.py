"""Stiffness of scenes in Newton, the physics engine, against that in warpcloth."""

from ..terms import NeoHookeanMembrane
from .calibration import calibrated
from .newton_model import TAKES
from .newton_runs import NewtonPhysics

# Steps and iterations that converge to the rest shape of the samples, for the strips and for the cantilever.
_SETTINGS = {"semi-implicit": (10, 1), "xpbd": (4, 20), "vbd": (2, 20), "style3d": (2, 10)}
_FINER = {"semi-implicit": 5, "xpbd": 10, "vbd": 2, "style3d": 2}


def calibrate(method, device="cpu"):
    """Measures the :class:`warpcloth.others.calibration.Calibration` of a solver of Newton, of a membrane with ν = 0.3."""
    substeps, iterations = _SETTINGS[method]
    coarse, fine = (NewtonPhysics(method, factor * substeps, iterations) for factor in (1, _FINER[method]))
    membrane = NeoHookeanMembrane(stiffness=50.0, poisson_ratio=0.3)
    return calibrated(coarse, fine, membrane if isinstance(membrane, TAKES[method]) else None, device)
