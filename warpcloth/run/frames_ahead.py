"""The frames of a run on the host, computed while earlier ones are checked and written."""

import itertools
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from ..base.turns import TURN, in_turn
from ..core.capture import on_host
from ..kernels.copy import take_vertices


class Frame(NamedTuple):
    """A frame, with the results of its stepper.

    Attributes:
        points: (B·n, 3) [m], in the order of the scene, not a view.
        velocities: (B·n, 3) [m/s], not a view.
        results: The worst :class:`warpcloth.core.status.Result` of each copy so far, (B,).
        residual: The largest residual of each copy so far, (B,).
        seconds: Time of its computation [s]; on CUDA by events of the device.
        found: Result of ``find`` of :func:`frames_of` after the frame, or None.
        state: The state of the stepper on the host, or None.
    """

    points: np.ndarray
    velocities: np.ndarray
    results: list
    residual: np.ndarray
    seconds: float
    found: object = None
    state: dict | None = None


def frames_of(stepper, count, ahead, keeps=None, find=None):
    """Yields the next ``count`` frames of a stepper, at most ``ahead`` of them computed ahead by a thread, without one if 0.

    The first is computed alone: it may capture graphs, during which the device must not do other work. Close the generator: it
    then waits for frames in work. ``keeps`` is a function (number of frames before) → whether the next frame includes the
    state, ``find`` one that is called after each frame for ``found``, or None.
    """
    numbers = itertools.count()
    with TURN:
        copies = itertools.cycle(_copies(stepper, max(min(ahead, count - 1), 1)))

    @in_turn
    def compute():
        copy = next(copies)
        copy.frame()
        found = None if find is None else find()
        state = stepper.state.to_host() if keeps is not None and keeps(next(numbers)) else None
        return copy, list(stepper.results), np.array(stepper.residual), found, state

    def taken(copy, results, residual, found, state):
        points, velocities, seconds = copy.take()
        return Frame(points, velocities, results, residual, seconds, found, state)

    first = taken(*compute())
    if ahead == 0:
        yield first
        for _ in range(count - 1):
            yield taken(*compute())
        return
    with ThreadPoolExecutor(1, thread_name_prefix="frames") as pool:
        try:
            pending = deque(pool.submit(compute) for _ in range(min(ahead, count - 1)))
            yield first
            for left in range(count - 1, 0, -1):
                found = taken(*pending.popleft().result())
                if left > ahead:
                    pending.append(pool.submit(compute))  # reuses the buffers of the frame that was taken
                yield found
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def state_of(stepper):
    """Returns copies of the present points [m] and velocities [m/s], (B·n, 3) each, in the order of the scene."""
    model = stepper.model
    on_host(model.device, "reading a frame")
    return tuple(np.array(model.in_scene_order(array.numpy())) for array in stepper.state)  # on the CPU numpy() is a view


def _copies(stepper, number):
    model = stepper.model
    if not model.device.is_cuda:
        return [_HostCopy(stepper) for _ in range(number)]
    on_host(model.device, "reading a frame")
    shape = (number, 2, model.count)
    found = wp.empty(shape, dtype=model.vec3, device=model.device)
    host = wp.empty(shape, dtype=model.vec3, device="cpu", pinned=True)
    indices = None if model.indices is None else wp.array(model.indices, dtype=wp.int32, device=model.device)
    return [_DeviceCopy(stepper, _copy_stream(str(model.device)), indices, found[k], host[k]) for k in range(number)]


@cache
def _copy_stream(device):
    """Returns the stream that copies frames from a device; it is made once and kept.

    Warp's table of streams has no lock: a stream deleted in one thread while another captures a graph would break it.
    """
    return wp.Stream(device)


class _HostCopy:
    def __init__(self, stepper):
        self.stepper = stepper

    def frame(self):
        began = time.perf_counter()
        self.stepper.frame()
        self._state = state_of(self.stepper)
        self._seconds = time.perf_counter() - began

    def take(self):
        return *self._state, self._seconds


class _DeviceCopy:
    """A buffer for a frame on a CUDA device, which a second stream copies to the host while the next frame begins."""

    def __init__(self, stepper, stream, indices, found, host):
        self.stepper, self._stream, self._indices, self._found, self._host = stepper, stream, indices, found, host
        self._began, self._ended = (wp.Event(stream.device, enable_timing=True) for _ in range(2))
        self._copied = wp.Event(stream.device)
        if indices is not None:
            self._take = stepper.model.kernel(take_vertices, stepper.model.dtype)

    def frame(self):
        model, stream = self.stepper.model, self.stepper.model.device.stream
        stream.record_event(self._began)
        self.stepper.frame()
        for k, array in enumerate(self.stepper.state):
            found = self._found[k]
            if self._indices is None:
                wp.copy(found, array)
            else:
                model.launch(self._take, model.count, [array, self._indices], [found])
        stream.record_event(self._ended)
        self._stream.wait_event(self._ended)
        wp.copy(self._host, self._found, stream=self._stream)
        self._stream.record_event(self._copied)

    def take(self):
        try:
            wp.synchronize_event(self._copied)
        except RuntimeError:  # Warp refuses to wait for an event while another thread captures a graph
            with TURN:
                wp.synchronize_event(self._copied)
        seconds = 1e-3 * wp.get_event_elapsed_time(self._began, self._ended, synchronize=False)
        return *(np.array(each) for each in self._host.numpy()), seconds
