"""Batches whose copies are divided among threads."""

from itertools import pairwise

import numpy as np
import warp as wp

from ..core.reset import Reset
from ..core.state import State
from ..core.thread_pool import ThreadPool
from .solver import Stepper


class ThreadedStepper(Stepper):
    """A batch that several threads share, each with a stepper for a range of copies.

    Attributes:
        model, declared: The model as it was bound; each part has its own model of the steps.
        parts: The stepper of each thread. Its state is a view of ``state``.
    """

    def __init__(self, options, stepper, model):
        self.options, self.model, self.declared, self._reset = options, model, model, None
        self.pairs = None  # scenes with self-contact refuse threads
        motion = wp.clone(model.positions), wp.clone(model.velocities)
        self.pool = ThreadPool(min(model.threads, model.copies))
        threads = self.pool.threads
        self._copies = list(pairwise(model.copies * thread // threads for thread in range(threads + 1)))
        self.parts = [stepper(options, model.part(first, end - first, motion)) for first, end in self._copies]
        self.state = State(*motion, model.copies, [part.state for part in self.parts])
        first = self.parts[0]
        self.steps_per_frame, self.h, self.he, self.uniform = first.steps_per_frame, first.h, first.he, first.uniform
        self.factorise_seconds = sum(part.factorise_seconds for part in self.parts)

    @property
    def iterations(self):
        return max(part.iterations for part in self.parts)

    @property
    def loads_at_end(self):
        return self.parts[0].loads_at_end

    @property
    def shares(self):
        return [(part, *copies) for part, copies in zip(self.parts, self._copies, strict=True)]

    def constraint_forces(self, collider=None):
        n, launches = self.model.per_copy, [part.constraint_forces(collider) for part in self.parts]

        def launch(out):
            for of_part, (first, end) in zip(launches, self._copies, strict=True):
                of_part(out[first * n : end * n])

        return launch

    def follow_contact(self):
        for part in self.parts:
            part.follow_contact()

    @property
    def cut(self):
        return np.concatenate([part.cut for part in self.parts])

    @property
    def inside(self):
        found = zip(self.parts, self._copies, strict=True)
        return [(first + copy, *rest) for part, (first, _end) in found for copy, *rest in part.inside]

    def step(self):
        self.pool.run([part.step for part in self.parts])

    def frame(self):
        for part in self.parts:
            part.prepare_frame()
        self.pool.run([part.frame for part in self.parts])

    def reset(self, mask=None, positions=None, velocities=None):
        if self._reset is None:
            self._reset = Reset(self)
        mask, positions, velocities = self._reset.on_device(mask, positions, velocities)
        n = self.model.per_copy
        for part, (first, end) in zip(self.parts, self._copies, strict=True):
            of_part = [None if given is None else given[first * n : end * n] for given in (positions, velocities)]
            part.reset(mask[first:end], *of_part)
