"""Damping: within a step an energy whose rest state is set where the step begins."""

from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from ..kernels import damping as kernels
from ..terms.refresh import STEP, Moment, Refresh
from .host_values import host_values


def damped_terms(model, he):
    """The elements of a step of hₑ [s]: the model's, those with damping merged with it or followed by it."""
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
    """The elements of the dissipation alone."""
    return [_dissipation(model, elements, he, 0.0) for elements in model.terms if elements.damping is not None]


def _dissipation(model, elements, he, stiffness):
    """The elements of D, or with their ``stiffness`` those of both."""
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
    model.refresh(STEP, Moment(model.positions), [damped])  # for those who ask for weights and measures before the first step
    return damped


def _set_rest(damped, model, elements, moment):
    """Sets the rest state of elements where a step begins, from that of the term that is ``damped`` and from its share."""
    rule = moment.integrator
    kernel = model.kernel(kernels.set_damped_rest, damped, model.dtype, rule == "bdf2", rule == "midpoint")
    rest, share = elements.refresh.arrays
    given = [elements.stencil, rest, share, moment.x, moment.move, moment.scale]
    model.launch(kernel, elements.count, given, [elements.rest])
