"""The frame loop: a scene and a solver in, an animation out."""

import os
import time
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..base.checks import choice, whole
from ..base.interrupts import recording
from ..base.limits import MOST_FRAMES, refuse_disk, refuse_memory
from ..base.turns import in_turn
from ..core.status import Result, Status, sentence
from ..mesh.ordering import order_of_run
from ..model.model import DTYPES
from ..usd import AnimationWriter, FrameSequence
from .balance import GAIN, STRETCHED, Balance
from .frames import frames_of, state_of
from .lines import lines_of

# Of frames that a CUDA device has computed and nobody has taken yet: bytes on either side, the share of the free memory of the
# device that these are at most, and how many.
AHEAD, SHARE, FRAMES = 2**30, 0.25, 1000


@dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """What a run left: the start and every good frame after it.

    Attributes:
        points: (frames+1, n, 3) [m]; in memory, or read from ``output`` when asked for (float32 then). Of B > 1 copies
            (frames+1, B, n, 3).
        velocities: The same shape [m/s].
        times: (frames+1,) [s].
        status: :class:`warpcloth.core.status.Status`.
        timings: ``compile`` (building the model and binding the solver, with compiling what was not in the cache),
            ``factorise`` (constant matrices, a part of it) and ``frames`` (a list) [s].
        worst_strain: Largest |l/L − 1| of any edge of the mesh in any frame; with B > 1 copies one value per copy, (B,), over
            its good frames.
        output: Path of the USD file, or None.
    """

    points: np.ndarray
    velocities: np.ndarray
    times: np.ndarray
    status: Status
    timings: dict
    worst_strain: float | np.ndarray
    output: str | None = None

    def __repr__(self):
        frames, *copies, vertices, _ = self.points.shape
        of = f"{copies[0]} copies of {vertices} vertices" if copies else f"{vertices} vertices"
        where = "" if self.output is None else f", in {self.output}"
        return f"Animation({frames} frames of {of}, {self.times[-1]:g} s, {self.status.result.value}{where})"


def simulate(
    scene,
    solver,
    output=None,
    device="cpu",
    dtype="float32",
    frames=None,
    copies=1,
    vary=None,
    single_file=False,
    progress=None,
    threads=1,
):
    """Runs a scene with a solver.

    Large meshes whose neighbours are far apart in memory are renumbered for the run, see
    :func:`warpcloth.mesh.ordering.order_of_run`; what comes out has the order of the scene. While a frame is written the next
    one is computed. Calls from several threads of a process take turns frame by frame, see :mod:`warpcloth.base.turns`.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Its options, such as ``wc.Newton(dt=1/240)``.
        output: Path of a USD file (.usd, .usda, .usdc, .usdz) to write, frame by frame; memory then stays flat. A scene that
            was read from a stage is written as a layer over it.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        frames: Number of frames, if not those of the scene.
        copies: See :class:`warpcloth.model.model.Model`; ``output`` takes one copy.
        vary: See :class:`warpcloth.model.model.Model`.
        single_file: Whether ``output`` is to be one file in the end, with nothing beside it.
        progress: Function called with (frame, frames) once each frame is kept, from 0, the start, on; or None.
        threads: See :class:`warpcloth.model.model.Model`.

    Returns:
        :class:`Animation`. A run that diverges ends with its last good frame and says so in ``status``. Of several copies the
        others go on; one that diverged is NaN from there.

    Raises:
        BlockingIOError: If another process, or thread, is writing ``output``.
        Interrupted: A KeyboardInterrupt, if the user interrupts; the message says which frames are in ``output``.
        OSError: If a file cannot be written; the message also says which frames are in ``output``.
        ValueError: If an argument breaks a rule, or the scene's stage has changed and no longer fits the frames.
    """
    frames = scene.frames if frames is None else frames
    whole("frames", frames, 1, MOST_FRAMES)
    whole("copies", copies, 1)
    choice("dtype", dtype, tuple(DTYPES))
    if output is not None and copies != 1:
        raise ValueError(f"copies is {copies}; output takes the animation of one copy")
    # First, for it refuses a wrong output before anything compiles.
    recorder = _Memory(frames, copies) if output is None else _File(scene, output, single_file)
    with recording(recorder, frames):
        _refuse_size(frames, scene, dtype, copies, output)
        start = time.perf_counter()
        model = scene.build(
            device=device, dtype=dtype, copies=copies, vary=vary, order=order_of_run(scene, solver), threads=threads
        )
        stepper = solver.bind(model)
        timings = {"compile": time.perf_counter() - start, "factorise": stepper.factorise_seconds, "frames": []}
        watch = Watch(model, stepper)
        recorder.append(*state_of(stepper))
        if progress is not None:
            progress(0, frames)
        with closing(frames_of(stepper, frames, _ahead(model, output))) as found:
            for number, frame in enumerate(found, start=1):
                timings["frames"].append(frame.seconds)
                if not watch.passes(number, frame.points, frame.velocities, frame.results):
                    break
                recorder.append(frame.points, frame.velocities)
                if progress is not None:
                    progress(number, frames)
    status = watch.status(frame.results, frame.residual, solver)
    times = np.arange(status.frame + 1) / scene.fps
    points, velocities = recorder.read()
    return Animation(points, velocities, times, status, timings, of_copies(watch.worst_strain), output)


def _refuse_size(frames, scene, dtype, copies, output):
    """Refuses frames whose positions and velocities exceed the free memory or, with an output, the free disk."""
    of = f" of {copies:,} copies" if copies > 1 else ""
    what, numbers = f"frames is {frames:,}{of}", 6 * len(scene.mesh.points) * (int(frames) + 1)
    if output is None:
        refuse_memory(what, np.dtype(dtype).itemsize * int(copies) * numbers)
    else:
        refuse_disk(what, 4 * numbers, os.path.dirname(os.path.realpath(output)))


def _ahead(model, output):
    """How many frames are computed beyond the one that is watched and written.

    On CUDA so many that the device waits for nobody until they fill ``AHEAD`` bytes, or a share of what is free. On the CPU
    one, where there is a file to write and a core to spare; frames in memory are only watched.
    """
    if model.device.is_cuda:
        room = min(AHEAD, int(SHARE * model.device.free_memory))
        return min(max(room // (2 * model.count * wp.types.type_size_in_bytes(model.vec3)), 2), FRAMES)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(output is not None and cores > 1)


def of_copies(values):
    """Returns one value per copy, (B,), or a float if there is one copy."""
    return np.array(values) if len(values) > 1 else float(values[0])


class Watch:
    """Tells a copy that has diverged from one that is merely fast, from frames alone and for every solver.

    A run has diverged if a value is not finite, a step of the solver says so, the energy has grown beyond what its sources put
    in, or an edge is longer than the energy of the run allows; see :mod:`warpcloth.run.balance`.

    Frames come in the order of the scene.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        stepper: The :class:`warpcloth.solvers.solver.Stepper`.
        stretched: Strain of an edge above which its energy is checked.

    Attributes:
        good: The last good frame of each copy (B,).
        alive: Whether a copy is still good (B,).
        growth: Largest energy of motion and height in a good frame, divided by what the sources can have put in, (B,).
        worst_strain: Largest |l/L − 1| of an edge of the mesh in a good frame of each copy, (B,).
    """

    @in_turn
    def __init__(self, model, stepper, stretched=STRETCHED):
        scene = model.scene
        self._stretched = stretched
        self.model, self.rest = model, scene.mesh.edge_lengths[scene.mesh.edge_lengths > 0.0]
        self.ends = scene.mesh.edges[scene.mesh.edge_lengths > 0.0].T.astype(np.intp)
        self.worst_strain, self.messages = np.zeros(model.copies), {}
        self.good, self.alive = np.zeros(model.copies, dtype=int), np.ones(model.copies, dtype=bool)
        self.growth, self.balance = np.zeros(model.copies), Balance(model, stepper)

    def passes(self, frame, points, velocities, results):
        """Whether any copy is still good; marks those that no longer are, and puts NaN in their place."""
        B, n = self.model.copies, self.model.per_copy
        finite = (np.isfinite(points) & np.isfinite(velocities)).reshape(B, 3 * n)
        gains, strain = self.balance.gains(frame, points, velocities), self._strain(points.reshape(B, n, 3))
        stepped = np.array([result is not Result.DIVERGED for result in results])
        good = finite.all(axis=1) & stepped & (gains <= GAIN)
        long = np.flatnonzero(self.alive & good & (strain > self._stretched))
        long = [copy for copy in long if not self.balance.suffices(copy, points, self._stretched * self.rest.min())]
        good[long] = False
        for copy in np.flatnonzero(self.alive & ~good):
            self.alive[copy] = False
            where = f"diverged in frame {frame}" + (f", copy {copy}" if B > 1 else "")
            wrong = np.flatnonzero(~finite[copy])
            if len(wrong):
                self.messages[copy] = f"{where}: vertex {wrong[0] // 3} is not finite"
            elif not stepped[copy]:
                self.messages[copy] = f"{where}: the forces of a step are not finite"
            elif copy in long:
                self.messages[copy] = (
                    f"{where}: an edge has a strain of {100.0 * strain[copy]:.3g} %, for which the energy of the run "
                    "does not suffice"
                )
            else:
                self.messages[copy] = f"{where}: {self.balance.sentence(copy)}"
        self.good[self.alive] = frame
        self.growth = np.where(self.alive, np.fmax(self.growth, gains), self.growth)
        self.worst_strain = np.where(self.alive, np.fmax(self.worst_strain, strain), self.worst_strain)
        for array in (points, velocities):
            array.reshape(B, n, 3)[~self.alive] = np.nan
        return bool(self.alive.any())

    def _strain(self, points):
        """Largest |l/L − 1| of an edge of each copy, for points (B, n, 3); NaN for copies that are no longer good."""
        squares = np.zeros((int(self.alive.sum()), len(self.rest)))
        with np.errstate(over="ignore", invalid="ignore"):
            for column in np.moveaxis(points[self.alive], -1, 0):  # a fifteenth of the time of rows of three
                column = column.astype(np.float64)
                squares += (column.take(self.ends[1], axis=1) - column.take(self.ends[0], axis=1)) ** 2
            found = np.full(self.model.copies, np.nan)
            found[self.alive] = np.abs(np.sqrt(squares) / self.rest - 1.0).max(axis=1, initial=0.0)
        return found

    def status(self, results, residual, solver):
        """Returns the :class:`Status` of a run with a solver from the results of its copies."""
        results = [Result.DIVERGED if copy in self.messages else result for copy, result in enumerate(results)]
        result = max(results, key=list(Result).index)
        kind, measure, unit = solver.residual_on(self.model), None, None
        copy = int(np.argmax(residual))  # the first that is NaN, if any
        if kind is not None:
            measure, unit = kind.measure, kind.unit if self.balance.weighs[copy] else kind.weightless
        if self.messages:
            message = "; ".join(self.messages[copy] for copy in sorted(self.messages))
        else:
            dtype, tolerance = self.model.numpy_dtype.__name__, getattr(solver, "tolerance", None)
            which = copy if len(residual) > 1 else None
            message = sentence(result, dtype, residual[copy], measure, unit, tolerance, which)
        return Status(result, int(self.good.max()), of_copies(residual), message, self.good, measure, unit)


class _Memory:
    """Keeps frames in memory, in the precision of the run."""

    def __init__(self, frames, copies):
        self.frames, self._most, self._copies = 0, frames + 1, copies

    def append(self, points, velocities):
        if self.frames == 0:
            self.shape = (self._copies, len(points) // self._copies, 3) if self._copies > 1 else points.shape
            self.points, self.velocities = (np.empty((self._most, *self.shape), points.dtype) for _ in range(2))
        self.points[self.frames] = points.reshape(self.shape)
        self.velocities[self.frames] = velocities.reshape(self.shape)
        self.frames += 1

    def close(self):
        pass

    def saved(self):
        return "nothing was saved"

    def read(self):
        return self.points[: self.frames], self.velocities[: self.frames]


class _File:
    """Writes frames as USD and reads them back when asked."""

    def __init__(self, scene, output, single_file):
        stage, self.single_file = scene.stage, single_file
        if stage is None:
            pins = {"pins": scene.pins.vertices} if len(scene.pins.vertices) else None
            lines = lines_of(scene)
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, pins=pins, up_axis=scene.up_axis, lines=lines)
        else:
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, source=stage.path, prim=stage.prim)
        self.append, self.saved = self.writer.append, self.writer.saved

    @property
    def frames(self):
        return self.writer.frames

    def close(self):
        self.writer.close(single_file=self.single_file)

    def read(self):
        path = self.writer.path
        return FrameSequence(path), FrameSequence(path, attribute="velocities")
