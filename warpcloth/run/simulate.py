"""The frame loop: a scene and a solver in, an animation out."""

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..base.checks import whole
from ..base.interrupts import recording
from ..base.limits import MAX_FRAMES, refuse_disk, refuse_memory
from ..base.notebooks import ShownInNotebooks
from ..base.turns import TURN
from ..base.types import FilePath, Precision, Progress
from ..core.status import Status, Stopped, millimetres
from ..mesh.ordering import order_of_run
from ..scene.scene import Scene
from ..solvers.step import Step
from .checkpoint import facts_of
from .contact_verdicts import (
    Forced,
    Inside,
    contact_faults,
    crossings_at_start,
    forced_of,
    held_pins_of,
    held_sentence,
    inside_of,
    soft_contact_of,
    unresolved_of,
)
from .frames_ahead import state_of
from .history import History, checked_record
from .recorders import File, Memory
from .watch import Watch, of_copies, watched_frames

if TYPE_CHECKING:
    from ..usd import FrameSequence

# Limits on the frames that a CUDA device computes ahead: bytes on the host and on the device, fraction of the free memory of
# the device, and number.
AHEAD, SHARE, FRAMES = 2**30, 0.25, 1000


class SelfContactSummary(NamedTuple):
    """The pairs of cloth with cloth, and with meshes among the colliders, in a run.

    Attributes:
        pairs: The largest number of pairs in a list, of all copies. A list has the pairs nearer than the contact distance plus
            0.35 of the longest edge.
        lists: Number of lists that were made.
        kept: The fraction of the moves of free vertices that the filter left whole, or (B,).
        least_gap: The smallest distance of a pair in any good frame [m], or (B,); infinite without pairs.
        too_near: A sentence about the first frame in which a gap is below 4 units in the last place of the largest float32
            coordinate of the pair; None otherwise, and for frames in float64.
        moved_apart: A sentence about the vertices that touched other cloth at the start and were moved, or None.
        held_pins: A sentence about the pins that cloth held back, with the first frame and the largest distance, or None.
    """

    pairs: int
    lists: int
    kept: float | np.ndarray
    least_gap: float | np.ndarray
    too_near: str | None
    moved_apart: str | None
    held_pins: str | None


@dataclass(frozen=True, eq=False, repr=False)
class Animation(ShownInNotebooks):
    """The result of a run: the start and every good frame after it.

    Attributes:
        points: (frames+1, n, 3) [m], or (frames+1, B, n, 3) with B > 1 copies; with ``output`` float32, read from the file on
            access.
        velocities: The same shape [m/s].
        times: (frames+1,) [s].
        status: :class:`warpcloth.core.status.Status`.
        timings: Times [s]: ``compile`` (model, binding, kernels not in the cache), ``factorise`` (constant matrices, a part of
            ``compile``) and ``frames`` (a list).
        worst_strain: Largest |l/L − 1| of any edge in any good frame, or (B,).
        output: Path of the USD file, or None.
        scene: The :class:`warpcloth.Scene` of the run, or None.
        energies: With ``record="energies"``, a dictionary of arrays (frames+1,) or (frames+1, B) [J]: each term under its
            label, ``"contact with Ball"`` and ``"friction on Ball"`` for a collider called Ball, ``"kinetic"``, ``"gravity"``
            (0 at the start), and, if the scene has them, ``"work of pins"``, ``"work of loads"``, ``"work of air"``, ``"work of
            colliders"`` and ``"heat of friction"``. A copy is NaN after it diverged.
        reactions: With ``record="reactions"``, forces of the pins on the cloth along held axes, (frames+1, p, 3) or (frames+1,
            B, p, 3) [N], in the order of ``scene.pins.vertices``.
        collider_forces: With ``record="reactions"``, forces of the cloth on colliders by name, friction included, (frames+1, 3)
            or (frames+1, B, 3) [N].
        friction_forces: In that form, the friction in them, for colliders with friction.
        pairs: With ``record="pairs"``, a dictionary of arrays (frames+1,) or (frames+1, B) of self-contact at the end of each
            frame: ``"pairs in contact"`` (nearer than the contact distance), ``"pairs listed"``, ``"new lists"`` (of all
            copies), ``"moves kept"`` (the fraction of the moves of free vertices that the filter left whole) and ``"least
            gap"`` [m].
        cuts: With a record, ``cut`` of each frame.
        cut: The fraction of the moves of free vertices that the filter of colliders cut short, plus that of the filter of cloth
            with cloth, or (B,).
        inside: The first vertex inside each collider that contained one, a tuple of :class:`Inside`.
        forced: The first time that each mesh moved through cloth, a tuple of :class:`Forced`.
        self_contact: The :class:`SelfContactSummary` of a scene with self-contact or meshes among its colliders, else None.
    """

    points: "np.ndarray | FrameSequence"
    velocities: "np.ndarray | FrameSequence"
    times: np.ndarray
    status: Status
    timings: dict[str, Any]
    worst_strain: float | np.ndarray
    output: FilePath | None = None
    scene: Scene | None = None
    energies: dict[str, np.ndarray] | None = None
    reactions: np.ndarray | None = None
    cut: float | np.ndarray = 0.0
    collider_forces: dict[str, np.ndarray] | None = None
    friction_forces: dict[str, np.ndarray] | None = None
    cuts: np.ndarray | None = None
    inside: tuple[Inside, ...] = ()
    forced: tuple[Forced, ...] = ()
    pairs: dict[str, np.ndarray] | None = None
    self_contact: SelfContactSummary | None = None

    def cloth(self, name: str) -> np.ndarray:
        """Returns the positions of a cloth of the scene, or a part of its mesh, (frames+1, n, 3) or (frames+1, B, n, 3) [m].

        Raises:
            ValueError: There is no such part.
        """
        parts = (self.scene.mesh.parts or {}) if self.scene else {}
        if name not in parts:
            known = f"its cloths are {', '.join(parts)}" if parts else "Scene.join makes one of several"
            raise ValueError(f"the scene has no cloth {name!r}; {known}")
        first, count, _ = parts[name]
        return np.asarray(self.points)[..., first : first + count, :]

    def of_copy(self, copy: int) -> "Animation":
        """Returns the animation of one of several copies, whose arrays have no axis of copies.

        The message and result of the status, and pairs, lists and sentences of ``self_contact``, are those of all copies.

        Raises:
            ValueError: There is no such copy.
        """
        if self.points.ndim == 3:
            whole("copy", copy, 0, 0)
            return self
        whole("copy", copy, 0, self.points.shape[1] - 1)

        def one(values):
            return {name: each[:, copy] for name, each in values.items()} if isinstance(values, dict) else values[:, copy]

        of_frames = ("points", "velocities", "energies", "reactions", "collider_forces", "friction_forces", "cuts", "pairs")
        given = {name: one(getattr(self, name)) for name in of_frames if getattr(self, name) is not None}
        given |= {name: np.asarray(getattr(self, name))[copy].item() for name in ("worst_strain", "cut")}
        summary = self.self_contact
        if summary is not None:
            summary = summary._replace(
                kept=float(np.asarray(summary.kept)[copy]), least_gap=float(np.asarray(summary.least_gap)[copy])
            )
        of_copy: dict[str, Any] = {
            name: tuple(each for each in getattr(self, name) if each.copy == copy) for name in ("inside", "forced")
        }
        good = np.asarray(self.status.good)
        status, grade = self.status._replace(frame=int(good[copy]), good=good[copy : copy + 1]), self.status.grades[copy]
        own: dict[str, Any] = {
            name: float(np.broadcast_to(getattr(self.status, name), len(good))[copy]) for name in ("residual", "distance")
        }
        status = status._replace(grade=grade, grades=(grade,), **own)
        return replace(self, **of_copy, self_contact=summary, status=status, **given)

    def __repr__(self) -> str:
        frames, *copies, vertices, _ = self.points.shape
        of = f"{copies[0]} copies of {vertices} vertices" if copies else f"{vertices} vertices"
        where = "" if self.output is None else f", in {self.output}"
        return f"Animation({frames} frames of {of}, {self.times[-1]:g} s, {self.status.result.value}{where})"


def simulate(
    scene: Scene,
    solver: Step,
    output: FilePath | None = None,
    device: str = "cpu",
    dtype: Precision | None = None,
    frames: int | None = None,
    copies: int = 1,
    vary: Mapping[str, ArrayLike] | None = None,
    single_file: bool = False,
    progress: Progress | None = None,
    threads: int = 1,
    resume: bool = False,
    record: str | Sequence[str] = (),
) -> Animation:
    """Runs a scene with a solver.

    If neighbours are far apart in memory, the run reorders the vertices; results keep the order of the scene. Calls from
    several threads take turns frame by frame.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: The solver with its options, such as ``wc.Newton(dt=1/240)``.
        output: USD file (.usd, .usda, .usdc, .usdz) to write frame by frame; for a scene from a stage, a layer over that stage.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``, of the computation and of frames in memory; by default that of
            :meth:`warpcloth.solvers.step.Step.precision_on`. USD files hold float32.
        frames: Number of frames after the first; by default that of the scene.
        copies: See :class:`warpcloth.model.model.Model`; ``output`` takes one copy.
        vary: See :class:`warpcloth.model.model.Model`.
        single_file: Whether ``output`` ends as one file, without a folder of frames beside it.
        progress: Function that is called with (frame, frames) after each frame is stored, from frame 0, the start; or None.
        threads: See :class:`warpcloth.model.model.Model`.
        resume: Whether to continue the interrupted run to ``output`` after its last finished chunk of frames. The result equals
            that of an uninterrupted run bit for bit. All arguments but ``frames`` and ``single_file`` must be the same.
        record: Some of ``"energies"``, ``"reactions"`` and, with self-contact, ``"pairs"``, for the :class:`Animation` and as
            primvars of ``output``. The motion keeps its bits; ``"energies"`` sums work in every step, which takes time.

    Returns:
        :class:`Animation`. A run that diverges, or has no memory for pairs, ends with its last good frame, as ``status`` says.
        A copy that diverges is NaN from then on; the others continue.

    Raises:
        BlockingIOError: Another process or thread is writing ``output``.
        Interrupted: The user interrupts; a KeyboardInterrupt whose message names the frames in ``output``.
        OSError: A file cannot be written; the message names the frames in ``output``.
        ValueError: An argument is not allowed, the scene's stage has changed and no longer fits, or ``output`` has no matching
            run to resume.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> animation = wc.simulate(scene, wc.Newton(dt=1 / 240), frames=30)
        >>> animation
        Animation(31 frames of 2 vertices, 0.5 s, converged)
        >>> animation.points.shape
        (31, 2, 3)
    """
    frames = scene.frames if frames is None else frames
    whole("frames", frames, 1, MAX_FRAMES)
    whole("copies", copies, 1)
    dtype = solver.precision_on(device, dtype)
    record = checked_record(record, scene)
    if output is not None and copies != 1:
        raise ValueError(f"copies is {copies}; output takes the animation of one copy")
    if resume and output is None:
        raise ValueError("resume is given without output, the file of the run to go on with")

    def facts():
        return facts_of(scene, solver, device, dtype, vary, record)

    # First, so that a wrong output is refused before anything compiles.
    recorder = Memory(frames, copies) if output is None else File(scene, output, single_file, facts, resume, record)
    with recording(recorder, frames):
        _refuse_size(frames, scene, dtype, copies, output)
        start = time.perf_counter()
        order = order_of_run(scene, solver)
        with TURN:
            model = scene.build(device=device, dtype=dtype, copies=copies, vary=vary, order=order, threads=threads)
            stepper = solver.bind(model)
            timings = {"compile": time.perf_counter() - start, "factorise": stepper.factorise_seconds}
            watch, first = Watch(model, stepper), 0
            history = watch.history = History(stepper, model, record) if record else None
            if resume:
                first = _resume(recorder.checkpoint, frames, stepper, watch)
            points, velocities = state_of(stepper)
        if not resume:
            recorder.append(points, velocities, recorded=history and history.keep(watch.alive))
        timings["frames"] = watch.seconds
        if progress is not None:
            progress(first, frames)
        given = history or stepper, watch, frames, _ahead(model, output), first, recorder.keeps
        with closing(watched_frames(*given)) as found:
            for number, frame in found:
                recorded = history and history.keep(watch.alive)
                recorder.append(frame.points, frame.velocities, frame.state, watch, recorded)
                if progress is not None:
                    progress(number, frames)
        recorder.finish()
    with TURN:
        held, inside, forced = held_pins_of(stepper), inside_of(stepper), forced_of(stepper)
        self_contact = _self_contact(stepper, watch, output is not None, held)  # first, as it notes the gaps of the last frame
        faults = contact_faults(scene, held, inside, forced, unresolved_of(stepper), copies)
        status = watch.status(solver, faults, [*crossings_at_start(model), *soft_contact_of(watch, stepper)])
        cut = of_copies(stepper.cut)
    times = np.arange(status.frame + 1) / scene.fps
    points, velocities = recorder.read()
    recorded = {
        "output": output,
        "scene": scene,
        "cut": cut,
        "inside": inside,
        "forced": forced,
        "self_contact": self_contact,
        **(history.by_name() if history else {}),
    }
    return Animation(points, velocities, times, status, timings, of_copies(watch.worst_strain), **recorded)


def _self_contact(stepper, watch, in_file, held):
    pairs, model = stepper.pairs, stepper.model
    if pairs is None:
        return None
    with suppress(Stopped):  # the summary is then without the gaps of the last frame
        while watch.alive.any() and not watch.stopped:
            pairs.launch_present(stepper.state.x)
            if not pairs.overflowed:
                break
            pairs.grow()

    gaps, near = np.where(watch.alive, pairs.least_gap, watch.least_gap), []
    coarse, other = in_file or model.numpy_dtype == np.float32, "itself" + " or a mesh" * bool(model.scene.meshes)
    for copy, frame, vertex in (each for each in pairs.too_near if coarse and each.frame <= watch.good[each.copy]):
        vertex, of_copy = vertex if model.order is None else model.order[vertex], f" of copy {copy}" if model.copies > 1 else ""
        near.append(
            f"in frame {frame}{of_copy} first, at vertex {vertex}, cloth is nearer to {other} than 4 units in the last place "
            f"of float32 coordinates, in which frames are stored; the least gap is {gaps[copy]:.3g} m"
        )
    held = [f"{held_sentence(pin, model.copies)}; no cloth may pass through cloth" for pin in held]
    moved = model.moved_at_start[model.moved_at_start > 0.0]
    apart = f"{len(moved)} vertices that touched other cloth at the start were moved off it, by up to "
    apart = apart + millimetres(moved.max()) if len(moved) else None
    of_run = of_copies(1.0 - pairs.share), of_copies(gaps), "; ".join(near) or None, apart, "; ".join(held) or None
    return SelfContactSummary(pairs.most, int(pairs.lists.numpy().max()), *of_run)


def _resume(checkpoint, frames, stepper, watch):
    if frames < checkpoint.frame:
        raise ValueError(f"frames is {frames}; the run to be resumed has {checkpoint.frame} already, and this must be no less")
    stepper.state.from_host(checkpoint.state)
    watch.from_host(checkpoint.watch, stepper.state)
    if watch.history:
        watch.history.go_on()
    return checkpoint.frame


def _refuse_size(frames, scene, dtype, copies, output):
    of = f" of {copies:,} copies" if copies > 1 else ""
    what, numbers = f"frames is {frames:,}{of}", 6 * len(scene.mesh.points) * (int(frames) + 1)
    if output is None:
        refuse_memory(what, np.dtype(dtype).itemsize * int(copies) * numbers)
    else:
        refuse_disk(what, 4 * numbers, os.path.dirname(os.path.realpath(output)))


def _ahead(model, output):
    """Returns the number of frames to compute ahead.

    On CUDA, as many as fill ``AHEAD`` bytes or a fraction of the free memory; on the CPU one if a file is written and a core is
    free.
    """
    if model.device.is_cuda:
        room = min(AHEAD, int(SHARE * model.device.free_memory))
        return min(max(room // (2 * model.count * wp.types.type_size_in_bytes(model.vec3)), 2), FRAMES)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(output is not None and cores > 1)
