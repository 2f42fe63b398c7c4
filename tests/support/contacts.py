"""What the pairs of self-contact give at any positions."""

import warp as wp

import warpcloth as wc
from warpcloth.contact.self_steps import SelfSteps
from warpcloth.core.hessian import Hessian
from warpcloth.core.sums import Sums
from warpcloth.kernels.term import HessianPolicy


def pairs_of(scene, device, bounded=False, h=1.0 / 24.0, dtype="float64", **build):
    """The :class:`SelfSteps` of a scene, in no solver; they begin at its positions."""
    model = scene.build(device=device, dtype=dtype, **build)
    state = wc.Explicit(substeps=1000, above_limit="allow").bind(model).state
    pairs = SelfSteps(model, state, h, 1, bounded, None)
    begin(pairs, scene.positions)
    return pairs


def begin(pairs, x):
    """Begins a step at x (N, 3), with as much room as its pairs take."""
    x = pairs.model.array(x, pairs.model.vec3)
    pairs.launch_begin(x)
    while pairs.overflowed:
        pairs.grow()
        pairs.launch_begin(x)


def energy(pairs, x, term=None, stored=False):
    """U [J] at x (N, 3) in the step that was begun last, with the contacts, or those of one term alone, found anew there."""
    (term or pairs.forces).launch(pairs.model.array(x, pairs.model.vec3))
    out = pairs.model.scalars()
    pairs.forces.add_energy(Sums(pairs.model), out, stored=stored)
    return out.numpy()[0]


def gradient(pairs, x, term=None):
    """∂U/∂x (N, 3) [N] at x (N, 3) in the step that was begun last, of all terms or of one."""
    (term or pairs.forces).launch(pairs.model.array(x, pairs.model.vec3))
    out = pairs.model.vectors()
    (term or pairs.forces).add_gradient(out)
    return out.numpy()


def hessian_times(pairs, x, p):
    """The raw ∂²U/∂x² times p (N, 3) at x (N, 3), and the Hessian, of the step that was begun last."""
    model = pairs.model
    hessian, out = Hessian(model, HessianPolicy.RAW, terms=[], dynamic=pairs.forces.terms), model.vectors()
    hessian.prepare()
    hessian.assemble(model.array(x, model.vec3), 0.0)
    hessian.multiply(model.array(p, model.vec3), out, wp.ones(1, dtype=wp.int32, device=model.device))
    return out.numpy(), hessian


def slope_of(f, pairs, x, direction, eta, **given):
    """The derivative of :func:`energy` or :func:`gradient` along a direction (N, 3), by central differences over η."""
    return (f(pairs, x + eta * direction, **given) - f(pairs, x - eta * direction, **given)) / (2.0 * eta)
