"""Several copies shared out among threads."""

from itertools import pairwise

import numpy as np
import warp as wp

from ..core.reset import Reset
from ..core.state import State
from ..core.thread_pool import ThreadPool
from .solver import Stepper


class ThreadedStepper(Stepper):
    """Several copies for several threads: a stepper of its own, on neighbouring copies, in each.

    Args:
        options: Of the solver.
        stepper: The type of its steppers.
        model: The model.

    Attributes:
        shares: The stepper of each thread, whose state is a part of ``state``.
    """

    def __init__(self, options, stepper, model):
        self.options, self.model, self._reset = options, model, None
        motion = wp.clone(model.positions), wp.clone(model.velocities)
        self.pool = ThreadPool(min(model.threads, model.copies))
        shares = self.pool.threads
        ends = [model.copies * share // shares for share in range(shares + 1)]
        self._copies = list(pairwise(ends))
        self.shares = [stepper(options, model.share(first, end - first, motion)) for first, end in self._copies]
        self.state = State(*motion, model.copies, [share.state for share in self.shares])
        first = self.shares[0]
        self.steps_per_frame, self.h, self.he, self.uniform = first.steps_per_frame, first.h, first.he, first.uniform
        self.factorise_seconds = sum(share.factorise_seconds for share in self.shares)

    @property
    def results(self):
        return [result for share in self.shares for result in share.results]

    @property
    def residual(self):
        return np.concatenate([share.residual for share in self.shares])

    @property
    def iterations(self):
        return max(share.iterations for share in self.shares)

    def step(self):
        self.pool.run([share.step for share in self.shares])

    def frame(self):
        for share in self.shares:
            share.prepare_frame()
        self.pool.run([share.frame for share in self.shares])

    def reset(self, mask=None, positions=None, velocities=None):
        if self._reset is None:
            self._reset = Reset(self)
        mask, positions, velocities = self._reset.on_device(mask, positions, velocities)
        n = self.model.per_copy
        for share, (first, end) in zip(self.shares, self._copies, strict=True):
            places = [None if given is None else given[first * n : end * n] for given in (positions, velocities)]
            share.reset(mask[first:end], *places)
