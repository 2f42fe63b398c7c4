"""Explicit steps of one cloth by several threads, each with a subdomain of consecutive vertices and its elements."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import warp as wp

from ..kernels.copy import copy_chosen
from ..model.host_values import host_values
from .block_step import BlockStep, Window
from .structs import int32_array


class SubdomainSteps:
    """Steps in which each thread of a pool updates its subdomain in its own memory, by blocks (:class:`BlockStep`).

    Elements between two subdomains are computed by both, so that threads exchange only positions, through alternating arrays
    with one barrier per step. The order of sums differs from that of one subdomain, but is the same in every run. If neighbours
    have distant indices, subdomains have more elements, at worst all of them.

    Args:
        model: The :class:`warpcloth.model.model.Model`, of one copy and without refreshed terms.
        state: x and v (N,), which steps update.
        h: Step [s].
        symplectic: Whether x is updated with v after the step.
        count: Number of steps of the moved pins (1,) int32, or None.
        compensated: Whether x is updated by compensated summation.
        pool: The :class:`warpcloth.core.thread_pool.ThreadPool`.

    Attributes:
        residual: Position residual of compensated summation (N,) [m], or None.
        record: :class:`warpcloth.core.explicit_step.StepRecord`.
    """

    def __init__(self, model, state, h, symplectic, count, compensated, pool):
        self.model, self._pool, threads = model, pool, pool.threads
        self.residual = model.vectors() if compensated else None
        state = (*state, self.residual) if compensated else state
        ends = [model.count * thread // threads for thread in range(threads + 1)]
        self._subdomains = [_Subdomain(model, state, h, symplectic, count, *own) for own in pairwise(ends)]
        self.record = self._subdomains[0].steps.record._replace(threads=threads)
        shared = np.unique(np.concatenate([each.ghosts for each in self._subdomains]))
        damped = any(elements.damping is not None for elements in model.terms)
        # Some threads may pass the barrier before others, so even and odd steps use different arrays.
        each_way = 2 if damped or compensated else 1
        self._exchanged = [
            [wp.zeros(len(shared), dtype=model.vec3, device=model.device) for _ in range(each_way)] for _ in range(2)
        ]
        for each in self._subdomains:
            each.share(shared, damped)
        self._counting = next((each for each in self._subdomains if each.moves_pins), None)

    def launch(self, steps, move_pins):
        """Launches a number of steps of this thread, and ``move_pins`` (pins, keyframes, count, x, v) after each."""
        model, pool = self.model, self._pool
        own = self._subdomains[pool.thread]
        own.load()
        pool.launch_barrier(model)
        for step in range(steps):
            own.steps.launch(1, move_pins)
            if step < steps - 1:
                own.give(self._exchanged[step % 2])
                pool.launch_barrier(model)
                own.take(self._exchanged[step % 2])
        own.store(own is self._counting)
        pool.launch_barrier(model)


class _Subdomain:
    """The vertices from ``first`` to ``end``, and ghosts: other vertices of their elements, which other threads move.

    Attributes:
        ghosts: The vertices of the ghosts.
        steps: The :class:`warpcloth.fast.block_step.BlockStep` of the window from the lowest to the highest of all these.
        moves_pins: Whether moved pins are among the vertices.
    """

    def __init__(self, model, state, h, symplectic, count, first, end):
        terms, touched = [], [np.arange(first, end)]
        for elements in model.terms:
            stencil = host_values(elements.stencil)
            chosen = np.flatnonzero(((stencil >= first) & (stencil < end)).any(axis=1))
            if len(chosen):
                terms.append((elements.reordered(chosen), stencil[chosen]))
                touched.append(stencil[chosen].ravel())
        touched = np.unique(np.concatenate(touched))
        self.ghosts = touched[(touched < first) | (touched >= end)]
        self.first, self.end, self.low = first, end, int(touched[0])
        self.model, self._whole, self._whole_count = model, state, count
        vertices = slice(self.low, int(touched[-1]) + 1)
        self._parts = [array[vertices] for array in state]
        x, v = (wp.clone(array) for array in self._parts[:2])
        self._count = None if count is None else wp.clone(count)
        window = self._window(terms, vertices)
        self.moves_pins = window.pins is not None
        self.steps = BlockStep(model, (x, v), h, symplectic, self._count, len(state) > 2, window=window)
        self._state = [x, v] if self.steps.residual is None else [x, v, self.steps.residual]

    def _window(self, terms, vertices):
        """The :class:`warpcloth.fast.block_step.Window` of ``vertices``, in which ghosts are fixed."""
        model, device = self.model, self.model.device
        terms = [
            replace(elements, stencil=wp.array((stencil - self.low).astype(np.int32), device=device), per_copy=len(stencil))
            for elements, stencil in terms
        ]
        inverse_mass = np.zeros(vertices.stop - vertices.start)
        inverse_mass[self.first - self.low : self.end - self.low] = model.inverse_mass.numpy()[self.first : self.end]
        pins = keyframes = None
        if model.pins is not None:
            among = model.pins.numpy()
            chosen = (among >= self.first) & (among < self.end)
            if chosen.any():
                pins, keyframes = int32_array(among[chosen] - self.low, device), model.keyframes.numpy()[:, chosen]
                keyframes = model.array(keyframes, model.vec3)
        return Window(terms, model.array(inverse_mass, model.dtype), pins, keyframes)

    def share(self, shared, damped):
        """Finds its ghosts, and its vertices that are ghosts of others, among the ``shared`` vertices."""
        given = np.flatnonzero((shared >= self.first) & (shared < self.end))
        taken = np.searchsorted(shared, self.ghosts)
        device = self.model.device
        self._given = [int32_array(each, device) for each in (shared[given] - self.low, given)]
        self._taken = [int32_array(each, device) for each in (taken, self.ghosts - self.low)]
        x, v, *residual = self._state
        self._copy, self._arrays = self.model.kernel(copy_chosen, self.model.dtype), [x, *([v] if damped else residual)]

    def load(self):
        """Reads the state, which may have changed outside of steps."""
        for array, part in zip(self._state, self._parts, strict=True):
            wp.copy(array, part)
        if self._count is not None:
            wp.copy(self._count, self._whole_count)

    def store(self, counts):
        """Writes its vertices to the state, and the step count if it ``counts`` for all."""
        number = self.end - self.first
        for array, whole in zip(self._state, self._whole, strict=True):
            wp.copy(whole, array, dest_offset=self.first, src_offset=self.first - self.low, count=number)
        if counts:
            wp.copy(self._whole_count, self._count)

    def give(self, exchanged):
        """Writes its vertices that are ghosts of others."""
        for array, out in zip(self._arrays, exchanged, strict=True):
            self.model.launch(self._copy, len(self._given[0]), [*self._given, array], [out])

    def take(self, exchanged):
        """Reads the ghosts."""
        for source, array in zip(exchanged, self._arrays, strict=True):
            self.model.launch(self._copy, len(self._taken[0]), [*self._taken, source], [array])
