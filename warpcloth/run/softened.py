"""Cloth that stretches more easily, whose rest shape is a start for that of stiff cloth.

Newton's method turns a stiff sheet little in an iteration, because straight moves stretch its edges. Cloth soft enough for a
noticeable strain under gravity takes a few long steps, and the rest shape of cloth 10 times as stiff is near.
"""

import numpy as np

from ..core.energy import Energy
from ..core.sums import Sums

# Strain under gravity that the softest cloth has about, and the factor from one stiffness to the next.
STRAIN, FACTOR = 8e-3, 10.0
# Cloth with a larger softest factor is left alone: it wrinkles as it stiffens, which may take more iterations than it saves.
SOFT = 1e-3
# Relative expansion at which the stiffness of a cloth is measured.
EXPANSION = 1e-2


def softening(model):
    """Returns factors of the stiffness against stretch, ascending, all below 0.3; none for soft cloth.

    The strain under gravity is estimated as WL/(2S): weight W, diagonal L of the cloth, S = ∂²U/∂ε² for its expansion by ε.
    """
    terms = [each for each in model.terms if _stretches(each)]
    weight = float(np.linalg.norm(model.gravity.numpy()[0])) * float(model.mass.numpy()[model.inverse_mass.numpy() > 0.0].sum())
    if not terms or weight == 0.0:
        return []
    stretched, points = model.with_terms(terms), model.rest_points
    total, at, energy, found = Energy(stretched, Sums(stretched)), model.vectors(), model.scalars(), []
    for k in range(3):  # the second difference, because cloth may be tense in its rest shape
        at.assign(points + k * EXPANSION * (points - points.mean(axis=0)))
        energy.zero_()
        total.add(at, energy)
        found.append(float(energy.numpy()[0]))
    stiffness = (found[0] - 2.0 * found[1] + found[2]) / EXPANSION**2
    softest = weight * float(np.linalg.norm(np.ptp(points, axis=0))) / (2.0 * STRAIN * stiffness) if stiffness > 0.0 else 1.0
    count = int(np.ceil(np.log(0.3 / softest) / np.log(FACTOR))) if softest < SOFT else 0
    return [softest * FACTOR**k for k in range(count)]


def softened(model, factor):
    """Returns the model with ``factor`` times the stiffness of springs and membranes."""
    return model.with_terms(each.weighed(factor) if _stretches(each) else each for each in model.terms)


def _stretches(elements):
    term = elements.term
    return term.vertices in (2, 3) and term.rows == term.vertices - 1 and elements.refresh is None and elements.cells is None
