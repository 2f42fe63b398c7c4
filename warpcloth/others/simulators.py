"""The simulators that ``--with`` names, a row each."""

from .newton_runs import NEWTON
from .pbd_runs import PBD
from .uipc_runs import UIPC

SIMULATORS = {"newton": NEWTON, "pbd": PBD, "uipc": UIPC}


def check_installed(names):
    """Checks that simulators are installed; raises ImportError with the names of those that are not."""
    lacking = []
    for name in names:
        try:
            SIMULATORS[name].check()
        except ImportError as error:
            lacking.append(str(error))
    if lacking:
        raise ImportError("; ".join(lacking))


def other_solvers():
    """Returns the :class:`warpcloth.others.runs.OtherSolver`\\s by their names in charts."""
    return {name: solver for each in SIMULATORS.values() for name, solver in each.solvers.items()}


def simulator_of(name):
    """Returns the :class:`warpcloth.others.runs.Simulator` of a solver, or None."""
    return next((each for each in SIMULATORS.values() if name in each.solvers), None)


def shown_name(solver):
    """Returns the name of a solver in tables and charts: "Newton engine: VBD" for newton-vbd, "newton" for our own."""
    simulator = simulator_of(solver)
    return solver if simulator is None else f"{simulator.title}: {simulator.solvers[solver].title}"
