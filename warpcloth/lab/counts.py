"""The work of a step by counting: elements, the fewest bytes that it must move, and launches."""

from contextlib import contextmanager

import warp as wp

from ..core.capture import Segment


def elements_of(model):
    """Elements of all terms and copies."""
    return sum(elements.count for elements in model.terms)


def compulsory_bytes(model, iterations):
    """Bytes that a step moves at least, with no cache between iterations, from the arrays of the model as it declares them.

    An iteration reads positions, inverse masses and all arrays of the terms, and writes positions, each once; a step reads and
    writes velocities once besides. Pins, gravity and what a solver keeps of its own do not count.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        iterations: Of a step.
    """
    terms = sum(term["bytes"] for term in model.report()["terms"])
    iteration = 2 * model.positions.capacity + model.inverse_mass.capacity + terms
    return iterations * iteration + 2 * model.velocities.capacity


def launches_of(run):
    """Counts the launches of ``run()``: kernels, fills and copies within a device, those of loops on the device each time.

    Segments launch what they recorded one by one meanwhile, so that loops are run, and counted, by the host.

    Args:
        run: A function that steps.
    """
    with _one_by_one() as counted:
        run()
    return len(counted)


@contextmanager
def _one_by_one():
    counted = []  # to append is one operation, so that no launch of several threads is lost

    def counting(function, counts=lambda *_, **__: True):
        def call(*args, **kwargs):
            if counts(*args, **kwargs):
                counted.append(function)
            return function(*args, **kwargs)

        return call

    def within_a_device(dest, src, *_, **__):
        return dest.device == src.device

    before = wp.launch, wp.copy, wp.array.zero_, Segment.__call__
    wp.launch, wp.copy, wp.array.zero_ = counting(before[0]), counting(before[1], within_a_device), counting(before[2])
    Segment.__call__ = lambda segment: segment.record()
    try:
        yield counted
    finally:
        wp.launch, wp.copy, wp.array.zero_, Segment.__call__ = before
