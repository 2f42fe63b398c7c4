"""The properties that a solver may need of every term."""

from collections.abc import Callable
from dataclasses import dataclass

from ..kernels.terms.air import AIR


@dataclass(frozen=True)
class Need:
    """A property that a solver needs of every term.

    Attributes:
        met: (elements) → whether a term has it; ``elements`` has ``term``, ``hard`` and ``damping`` (or None).
        lack: Words for a term without it, with {label}.
        remedy: A change that helps, or "".
    """

    met: Callable
    lack: str
    remedy: str = ""


FINITE = Need(lambda elements: not elements.hard, "{label} with infinite stiffness", "give a finite stiffness")
ELEMENTS = Need(
    lambda elements: not elements.term.cells or elements.term.whole.quadratic or elements.term.whole.curvature is not None,
    "{label}, whose bodies are no elements by themselves",
)
PROJECTION = Need(
    lambda elements: elements.term.whole.project is not None, "{label}, whose energy is no squared distance to a set"
)
# A projection, contact, whose Hessian is added to the matrix, a curvature at rest, or air, whose curvature is small.
CONSTANT_MATRIX = Need(
    lambda elements: (
        elements.term.whole.project is not None
        or elements.term.bounded is not None
        or elements.term.whole.curvature is not None
        or elements.term is AIR
        or (elements.term.whole.prox is None and elements.term.whole.vertices > 0)
    ),
    "{label}, whose curvature is not known in advance",
)
NORMAL_FORCE = Need(
    lambda elements: elements.term.law is None,
    "{label}, whose normal force does not follow from positions",
    "leave friction at 0",
)
NO_AIR = Need(
    lambda elements: elements.term is not AIR,
    "{label}, whose drag grows with the number of its sweeps",
)
LOCAL_STEP = Need(
    lambda elements: elements.term.whole.moves or elements.term.whole.vertices > 0,
    "{label}, whose cells have no local step",
)
# Newton's method finds the local step of other energies, if the stiffness is finite.
CLOSED_STEP = Need(
    lambda elements: elements.term.whole.moves or not elements.hard,
    "{label} with infinite stiffness, as its energy is no distance to a constraint",
    "give a finite stiffness",
)
ROWS = Need(
    lambda elements: (
        elements.term.whole.quadratic
        if elements.term.whole.vertices == 0
        else elements.term.project is not None or elements.term.constraint is not None
    ),
    "{label}, whose energy is no square of a constraint",
)
# With a projection that changes between iterations, λ would keep components along earlier directions.
STEADY_ROWS = Need(
    lambda elements: not elements.hard or elements.term.constraint is not None or elements.term.linear or elements.term.cells,
    "{label} with infinite stiffness, as it has no scalar constraint",
    "give a finite stiffness",
)
MERGED_DAMPING = Need(
    lambda elements: elements.damping is None or elements.term.dissipation.merges,
    "the damping of {label}, which no projection has in it",
    "leave the damping out",
)


def lacks(elements, needs):
    """Returns the first need that a term does not meet, or None."""
    return next((need for need in needs if not need.met(elements)), None)


def listed(names):
    """Joins names by commas and "or"."""
    return ", ".join(names[:-1]) + " or " * (len(names) > 1) + "".join(names[-1:])


def refuse_unmet(terms, solver, needs, others):
    """Checks that every term meets the needs of a solver.

    Raises:
        ValueError: A term does not. The message names the term, the need, and solvers of ``others`` or changes that work.
    """
    for elements in terms:
        need = lacks(elements, needs)
        if need is not None:
            able = [name for name, theirs in others if lacks(elements, theirs) is None]
            # If another solver takes the term as it is, name the remedy only if it is enough: no other need is unmet.
            suffices = need.remedy and (not able or sum(not each.met(elements) for each in needs) == 1)
            instead = [f"{listed(able)} can"] * bool(able) + [need.remedy] * bool(suffices)
            raise ValueError(
                f"{solver} cannot take {need.lack.format(label=elements.label)}; {', or '.join(instead) or 'no solver can'}"
            )
