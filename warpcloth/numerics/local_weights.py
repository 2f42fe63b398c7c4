"""The curvature of energies at rest, and the weights of ADMM, r = W²/(s k A) of each element."""

import numpy as np
import warp as wp

from ..core.constant_matrix import constant_blocks
from ..kernels.admm import stiffness_scale
from ..model.host_values import host_values


def best_weights(model, elements, he, curvature=None):
    """Returns r = 1/(2hₑω) of each element (E,), ω² the largest eigenvalue of M⁻¹ s k A DᵀD of that element; 1 if it is fixed.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: One of its terms.
        he: Effective step hₑ [s].
        curvature: s of each element (E,); None to compute it by :func:`curvatures`.
    """
    blocks = constant_blocks(model, elements.weighed(curvatures(model, elements) if curvature is None else curvature))
    root = np.sqrt(model.inverse_mass.numpy().astype(np.float64))[host_values(elements.stencil)]
    rates = np.linalg.eigvalsh(root[:, :, None] * blocks * root[:, None, :])[:, -1]
    return np.divide(0.5, he * np.sqrt(rates), out=np.ones_like(rates), where=rates > 0.0)


def curvatures(model, elements):
    """Returns s of each element (E,): 1 for a squared distance and for contact, else the curvature at rest."""
    if elements.term.project is not None or elements.term.bounded is not None:
        return np.ones(elements.count, dtype=model.numpy_dtype)
    if elements.term.whole.curvature is not None:
        return np.full(elements.count, elements.term.whole.curvature, dtype=model.numpy_dtype)
    scale = wp.zeros(elements.count, dtype=model.dtype, device=model.device)
    rest_shape = model.array(np.tile(model.rest_points, (model.copies, 1)), model.vec3)
    kernel = model.kernel(stiffness_scale, elements.term, model.dtype)
    model.launch(kernel, elements.count, [*elements.arguments, rest_shape], [scale])
    found = scale.numpy()
    # A hinge without a normal at rest has no curvature, so its weight would be 0.
    return np.where(found > 0.0, found, found.max() or 1.0)
