"""The simulators that ``--with`` names. A row adds one to charts, choices and tables."""

from .newton_runs import NEWTON
from .pbd_runs import PBD

SIMULATORS = {"newton": NEWTON, "pbd": PBD}


def other_solvers():
    """Returns the :class:`warpcloth.others.runs.OtherSolver`\\s of all simulators by their names in charts."""
    return {name: solver for each in SIMULATORS.values() for name, solver in each.solvers.items()}


def simulator_of(name):
    """Returns the :class:`warpcloth.others.runs.Simulator` of a solver, or None for a solver of warpcloth."""
    return next((each for each in SIMULATORS.values() if name in each.solvers), None)
