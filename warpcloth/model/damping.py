"""Damping, as an energy whose rest state is set at the start of each step."""

from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..kernels import damping as kernels
from ..terms.refresh import STEP, Moment, Refresh
from .host_values import host_values


def damped_terms(model, he):
    """Returns the elements of a model for a step hₑ [s], with damping merged into them or, where that cannot be, added."""
    terms = []
    for elements in model.terms:
        if elements.damping is None:
            terms.append(elements)
        elif elements.term.dissipation.merges:
            terms.append(_dissipation(model, elements, he, host_values(elements.stiffness)))
        else:
            terms += [elements, _dissipation(model, elements, he, 0.0)]
    return terms


def dissipations(model, he):
    """Returns the elements of the dissipation alone, for a step hₑ [s]."""
    return [_dissipation(model, elements, he, 0.0) for elements in model.terms if elements.damping is not None]


def _dissipation(model, elements, he, stiffness):
    """Returns the elements of the dissipation, merged with an energy of a given stiffness, or alone if that is 0."""
    dissipation, count = elements.term.dissipation, elements.count
    viscous = host_values(elements.damping).astype(np.float64) / he
    both = stiffness + viscous
    share = np.divide(viscous, both, out=np.zeros(count), where=both > 0.0)
    term = dissipation.term or elements.term
    damped = replace(
        elements,
        term=term,
        stiffness=model.per_element(both),
        rest=wp.zeros(count, dtype=wp.types.vector(term.parameters, model.dtype), device=model.device),
        damping=None,
        refresh=Refresh(STEP, partial(_set_rest, elements.term), (elements.rest, model.per_element(share))),
    )
    model.refresh(STEP, Moment(model.positions), [damped])  # some solvers read weights and measures before the first step
    return damped


def _set_rest(damped, model, elements, moment):
    """Sets the rest states of dissipation at the start of a step, from those of the term that is ``damped``."""
    parts = 0 if moment.move is None else moment.parts
    kernel = model.kernel(kernels.set_damped_rest, damped, model.dtype, parts, moment.both)
    rest, share = elements.refresh.arrays
    given = [elements.stencil, rest, share, moment.x, moment.move, moment.scale]
    model.launch(kernel, elements.count, given, [elements.rest])
