"""Explicit steps of one cloth by several threads: a range of its vertices each, and the elements that touch it."""

from copy import copy as shallow_copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import warp as wp

from ..kernels.copy import copy_chosen
from .gather_step import Sweep


class Ranges:
    """Steps in which each thread of a pool moves its range on, in memory of its own, by a sweep as of a whole cloth.

    Elements that touch two ranges are taken by both, so that threads exchange places alone, through arrays that they fill and
    read in turns, and meet once a step. Sums are taken in another order than of one range, the same in every run. Neighbours
    that are far apart in number make a range take more elements, at worst all of them.

    Args:
        pool: The :class:`warpcloth.core.thread_pool.ThreadPool`.
        model: The :class:`warpcloth.model.model.Model`, of one copy and without cells.
        state: x and v (N,), which steps move on.
        h: Step [s].
        symplectic: Whether x moves on by the v after the step.
        count: Of the steps of keyframes (1,), or None.
        fine: As of :class:`warpcloth.fast.gather_step.Sweep`.

    Attributes:
        model: The model.
        low: What places are rounded by (N,) [m], or None.
    """

    def __init__(self, pool, model, state, h, symplectic, count, fine=False):
        self.model, self._pool, threads = model, pool, pool.threads
        self.low = model.vectors() if fine else None
        state = (*state, self.low) if fine else state
        ends = [model.count * thread // threads for thread in range(threads + 1)]
        self._ranges = [_Range(model, state, h, symplectic, count, *own) for own in pairwise(ends)]
        shared = np.unique(np.concatenate([each.ghosts for each in self._ranges]))
        damped = any(elements.damping is not None for elements in model.terms)
        # By threads that have met and threads that have not: in even steps one array, in odd ones the other.
        carried = 2 if damped or fine else 1
        self._places = [
            [wp.zeros(len(shared), dtype=model.vec3, device=model.device) for _ in range(carried)] for _ in range(2)
        ]
        for each in self._ranges:
            each.share(shared, damped)
        self._counting = next((each for each in self._ranges if each.model.pins is not None), None)

    def launch(self, steps, move_pins):
        """So many steps of the range of this thread, with a call of ``move_pins`` (model, count, x, v) after each."""
        model, pool = self.model, self._pool
        own = self._ranges[pool.thread]
        own.load()
        pool.launch_barrier(model)
        for step in range(steps):
            own.sweep.launch(1, lambda x, v: move_pins(own.model, own.count, x, v))
            if step < steps - 1:
                own.give(self._places[step % 2])
                pool.launch_barrier(model)
                own.take(self._places[step % 2])
        own.store(own is self._counting)
        pool.launch_barrier(model)


class _Range:
    """The vertices from ``first`` to ``end`` with those around them that their elements touch, which others move: ghosts.

    Attributes:
        ghosts: Their vertices.
        model: As of a cloth of the vertices from the lowest to the highest of them, ghosts pinned.
        sweep: The :class:`warpcloth.fast.gather_step.Sweep` of it.
        count: Of the steps of keyframes, of its own.
    """

    def __init__(self, model, state, h, symplectic, count, first, end):
        terms, touched = [], [np.arange(first, end)]
        for elements in model.terms:
            stencil = elements.stencil.numpy()
            chosen = np.flatnonzero(((stencil >= first) & (stencil < end)).any(axis=1))
            if len(chosen):
                terms.append((elements.reordered(chosen), stencil[chosen]))
                touched.append(stencil[chosen].ravel())
        touched = np.unique(np.concatenate(touched))
        self.ghosts = touched[(touched < first) | (touched >= end)]
        self.first, self.end, self.low = first, end, int(touched[0])
        self._whole, self._whole_count = state, count
        window = slice(self.low, int(touched[-1]) + 1)
        self._window = [array[window] for array in state]
        x, v = (wp.clone(array) for array in self._window[:2])
        self.count = None if count is None else wp.clone(count)
        self.model = self._on_window(model, terms, window, len(x))
        self.sweep = Sweep(self.model, (x, v), h, symplectic, fine=len(state) > 2)
        self._state = [x, v] if self.sweep.low is None else [x, v, self.sweep.low]

    def _on_window(self, model, terms, window, count):
        other = shallow_copy(model)
        other.terms = tuple(
            replace(elements, stencil=_indices(model, stencil - self.low), per_copy=len(stencil)) for elements, stencil in terms
        )
        other.count = other.per_copy = count
        own = np.zeros(other.count, dtype=bool)
        own[self.first - self.low : self.end - self.low] = True
        other.inverse_mass = model.array(np.where(own, model.inverse_mass[window].numpy(), 0.0), model.dtype)
        if model.pins is not None:
            pins = model.pins.numpy()
            chosen = (pins >= self.first) & (pins < self.end)
            other.pins = _indices(model, pins[chosen] - self.low) if chosen.any() else None
            other.keyframes = model.array(model.keyframes.numpy()[:, chosen], model.vec3)
        return other

    def share(self, shared, damped):
        """Finds the places of ghosts, and of what are ghosts of others, among those that are ``shared``."""
        given = np.flatnonzero((shared >= self.first) & (shared < self.end))
        taken = np.searchsorted(shared, self.ghosts)
        self._given = [_indices(self.model, each) for each in (shared[given] - self.low, given)]
        self._taken = [_indices(self.model, each) for each in (taken, self.ghosts - self.low)]
        x, v, *low = self._state
        self._carry, self._arrays = self.model.kernel(copy_chosen, self.model.dtype), [x, *([v] if damped else low)]

    def load(self):
        """Takes over the state, which others than steps may have changed."""
        for array, part in zip(self._state, self._window, strict=True):
            wp.copy(array, part)
        if self.count is not None:
            wp.copy(self.count, self._whole_count)

    def store(self, counts):
        """Puts its vertices back into the state, and the count if it ``counts`` for all."""
        number = self.end - self.first
        for array, whole in zip(self._state, self._whole, strict=True):
            wp.copy(whole, array, dest_offset=self.first, src_offset=self.first - self.low, count=number)
        if counts:
            wp.copy(self._whole_count, self.count)

    def give(self, places):
        """Writes what are ghosts of others."""
        for array, out in zip(self._arrays, places, strict=True):
            self.model.launch(self._carry, len(self._given[0]), [*self._given, array], [out])

    def take(self, places):
        """Reads the ghosts."""
        for source, array in zip(places, self._arrays, strict=True):
            self.model.launch(self._carry, len(self._taken[0]), [*self._taken, source], [array])


def _indices(model, values):
    return wp.array(values.astype(np.int32), dtype=wp.int32, device=model.device)
