"""Stiffness of scenes in libuipc against that in warpcloth."""

from ..terms import NeoHookeanMembrane
from .calibration import calibrated
from .uipc_runs import LibUipc


def calibrate(device="cuda:0"):
    """Measures the :class:`warpcloth.others.calibration.Calibration` of libuipc on a device, of a membrane with ν = 0.3."""
    settings, membrane = LibUipc(2, 4), NeoHookeanMembrane(stiffness=50.0, poisson_ratio=0.3)
    return calibrated(settings, settings, membrane, device)
