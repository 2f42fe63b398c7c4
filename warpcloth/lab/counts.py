"""Counts the work of a step: elements, minimum memory traffic, and launches."""

from contextlib import contextmanager

import warp as wp

from ..core.capture import Segment


def elements_of(model):
    """Returns the number of elements of all terms and copies."""
    return sum(elements.count for elements in model.terms)


def compulsory_bytes(model, iterations):
    """Returns the bytes that a step must at least move, without a cache between iterations.

    An iteration reads positions, inverse masses and all arrays of the terms, and writes positions, each once. A step also reads
    and writes velocities once. Pins, gravity and arrays of the solver do not count.
    """
    terms = sum(term["bytes"] for term in model.report()["terms"])
    iteration = 2 * model.positions.capacity + model.inverse_mass.capacity + terms
    return iterations * iteration + 2 * model.velocities.capacity


def launches_of(run):
    """Counts the launches of ``run()``: kernels, fills and copies within a device, including all repeats of device loops.

    Segments launch their functions directly instead of replaying graphs, so that the host runs loops.
    """
    with _one_by_one() as counted:
        run()
    return len(counted)


@contextmanager
def _one_by_one():
    counted = []  # appending is atomic, so that no launch of a thread is lost

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
