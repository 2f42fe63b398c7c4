"""The frame loop: a scene and a solver in, an animation out."""

import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from .capture import on_host
from .solvers.solver import Result, Status


@dataclass(frozen=True, eq=False)
class Animation:
    """What a run left: the start and every good frame after it.

    Attributes:
        points: (frames+1, n, 3) [m]; in memory, or read from ``output`` when asked for (float32 then). Of B > 1 copies
            (frames+1, B, n, 3).
        velocities: The same shape [m/s].
        times: (frames+1,) [s].
        status: :class:`warpcloth.solvers.solver.Status`.
        timings: ``compile`` (building the model and binding the solver, with compiling what was not in the cache) and
            ``frames`` (a list) [s].
        worst_strain: Largest |l/L − 1| of any edge of the mesh in any frame.
        output: Path of the USD file, or None.
    """

    points: np.ndarray
    velocities: np.ndarray
    times: np.ndarray
    status: Status
    timings: dict
    worst_strain: float
    output: str | None = None


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
):
    """Runs a scene with a solver.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Its options, such as ``wc.Newton(dt=1/240)``.
        output: Path of a USD file (.usd, .usda, .usdc, .usdz) to write, frame by frame; memory then stays flat. A scene that
            was read from a stage is written as a layer over it.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        frames: Number of frames, if not those of the scene.
        copies: See :class:`warpcloth.model.Model`; ``output`` takes one copy.
        vary: See :class:`warpcloth.model.Model`.
        single_file: Whether ``output`` is to be one file in the end, with nothing beside it.
        progress: Function called with (frame, frames) once each frame is kept, from 0, the start, on; or None.

    Returns:
        :class:`Animation`. A run that diverges ends with its last good frame and says so in ``status``.

    Raises:
        ValueError: If an argument breaks a rule.
    """
    frames = scene.frames if frames is None else frames
    if not isinstance(frames, (int, np.integer)) or frames < 1:
        raise ValueError(f"frames is {frames!r}; it must be a whole number of 1 or more")
    if output is not None and copies != 1:
        raise ValueError(f"copies is {copies}; output takes the animation of one copy")
    # First, for it refuses a wrong output before anything compiles.
    recorder = None if output is None else _File(scene, output, single_file)
    start = time.perf_counter()
    model = scene.build(device=device, dtype=dtype, copies=copies, vary=vary)
    stepper = solver.bind(model)
    timings = {"compile": time.perf_counter() - start, "frames": []}
    recorder = recorder or _Memory(model, frames)
    watch = Watch(model)
    status = None
    try:
        recorder.append(*_frame(stepper))
        if progress is not None:
            progress(0, frames)
        for frame in range(1, frames + 1):
            began = time.perf_counter()
            for _ in range(stepper.steps_per_frame):
                stepper.step()
            points, velocities = _frame(stepper)
            timings["frames"].append(time.perf_counter() - began)
            trouble = watch.trouble(frame, points, velocities)
            if trouble:
                status = Status(Result.DIVERGED, frame - 1, stepper.residual, trouble)
                break
            recorder.append(points, velocities)
            if progress is not None:
                progress(frame, frames)
    finally:
        recorder.close()
    status = status or _status(stepper, frames)
    times = np.arange(status.frame + 1) / scene.fps
    points, velocities = recorder.read()
    return Animation(points, velocities, times, status, timings, watch.worst_strain, output)


def _frame(stepper):
    """Points and velocities on the host, (B·n, 3)."""
    on_host(stepper.model.device, "reading a frame")
    return np.array(stepper.state.x.numpy()), np.array(stepper.state.v.numpy())  # on the CPU numpy() is a view


def _status(stepper, frames):
    result, residual = stepper.result, stepper.residual
    message = result.value
    if result is Result.ITERATIONS_USED_UP:
        message = f"iterations used up in a step or more, largest residual {residual:.2g}"
    elif result is Result.CONVERGED and residual > stepper.options.tolerance:
        message = f"converged as far as rounding allows, largest residual {residual:.2g}"
    return Status(result, frames, residual, message)


class Watch:
    """Tells a run that has diverged from one that is merely fast, from frames alone and for every solver.

    No cloth that gains energy only from gravity, its start and its pins has a root mean square speed far above
    v₀ + g t + √(2 g l) + v_pins + (elastic energy at the start, as edge strain times the speed it can turn into); ten times
    that is called diverged, and so is anything that is not finite. A diverging run grows by a factor a step and passes it
    at once.
    """

    def __init__(self, model):
        scene = model.scene
        self.model, self.edges = model, scene.mesh.edges
        self.rest = np.linalg.norm(np.diff(scene.mesh.points[self.edges], axis=1)[:, 0], axis=1)
        self.worst_strain = 0.0
        points, velocities = model.positions.numpy(), model.velocities.numpy()
        self.gravity = np.linalg.norm(model.gravity.numpy(), axis=1).max()
        size = np.linalg.norm(np.ptp(points.reshape(model.copies, -1, 3), axis=1), axis=1).max()
        self.start = self._speed(velocities) + np.sqrt(2.0 * self.gravity * size) + self._stored_speed()
        if scene.pins.keyframes is not None and len(scene.pins.keyframes) > 1:
            moves = np.linalg.norm(np.diff(scene.pins.keyframes, axis=0), axis=-1)
            self.start += moves.max(initial=0.0) * scene.fps
        # A cloth that nothing moves has no speed to compare with; one length a second is then the scale.
        self.start = self.start or size

    def _speed(self, velocities):
        """Largest root mean square speed of a copy [m/s]."""
        squares = (velocities.astype(np.float64) ** 2).sum(axis=-1).reshape(self.model.copies, -1)
        return float(np.sqrt(squares.mean(axis=1)).max())

    def _stored_speed(self):
        """√(2U/m) of the start, the speed that all elastic energy would turn into [m/s]; hard terms count by their gap."""
        from .operators import Energy, Sums

        model = self.model
        if np.array_equal(
            model.positions.numpy(),
            np.tile(model.array(model.scene.mesh.points, model.vec3).numpy(), (model.copies, 1)),
        ):
            return 0.0
        if any(elements.hard for elements in model.terms):
            return np.inf
        sums = Sums(model)
        energy = wp.zeros(model.copies, dtype=wp.float64, device=model.device)
        Energy(model, sums).add(model.positions, energy)
        mass = model.mass.numpy().reshape(model.copies, -1).sum(axis=1)
        return float(np.sqrt(2.0 * energy.numpy() / mass).max())

    def trouble(self, frame, points, velocities):
        """A sentence if the frame is no result, else None; keeps the worst strain of good frames."""
        wrong = np.flatnonzero(~(np.isfinite(points).all(axis=1) & np.isfinite(velocities).all(axis=1)))
        n = self.model.per_copy
        if len(wrong):
            return f"diverged in frame {frame}: vertex {wrong[0] % n} of copy {wrong[0] // n} is not finite"
        speed, limit = self._speed(velocities), 10.0 * (self.start + self.gravity * frame / self.model.scene.fps)
        if speed > limit:
            return (
                f"diverged in frame {frame}: a mean speed of {speed:.3g} m/s, above the {limit:.3g} m/s that its energy allows"
            )
        ends = points.astype(np.float64).reshape(self.model.copies, n, 3)[:, self.edges]
        lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
        self.worst_strain = max(self.worst_strain, float(np.abs(lengths / self.rest - 1.0).max()))
        return None


class _Memory:
    """Keeps frames in memory, in the precision of the run."""

    def __init__(self, model, frames):
        n, copies = model.per_copy, model.copies
        self.frames, self.shape = 0, (copies, n, 3) if copies > 1 else (n, 3)
        self.points = np.empty((frames + 1, *self.shape), model.numpy_dtype)
        self.velocities = np.empty_like(self.points)

    def append(self, points, velocities):
        self.points[self.frames] = points.reshape(self.shape)
        self.velocities[self.frames] = velocities.reshape(self.shape)
        self.frames += 1

    def close(self):
        pass

    def read(self):
        return self.points[: self.frames], self.velocities[: self.frames]


class _File:
    """Writes frames as USD and reads them back when asked."""

    def __init__(self, scene, output, single_file):
        from .usd import AnimationWriter

        stage, self.single_file = scene.stage, single_file
        if stage is None:
            pins = {"pins": scene.pins.vertices} if len(scene.pins.vertices) else None
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, pins=pins)
        else:
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, source=stage.path, prim=stage.prim)
        self.append = self.writer.append

    def close(self):
        self.writer.close(single_file=self.single_file)

    def read(self):
        from .usd import FrameSequence

        path = self.writer.path
        return FrameSequence(path), FrameSequence(path, attribute="velocities")
