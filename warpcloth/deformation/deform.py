"""As-rigid-as-possible deformation by keyframes."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import number, refuse, shown, whole
from ..base.interrupts import recording
from ..base.notebooks import ShownInNotebooks
from ..base.types import FilePath, Precision, Progress, UpAxis
from ..mesh.mesh import Mesh
from ..mesh.stage_mesh import StageMesh
from ..scene.scene import Pins, checked_pins
from ..usd import AnimationWriter, FrameSequence
from .arap import Arap, CellEnergy, Weights

PRIMVAR = "rotationAngle"


@dataclass(frozen=True, eq=False, repr=False)
class Deformation(ShownInNotebooks):
    """The result of a deformation: a frame for each keyframe.

    Attributes:
        points: (F, n, 3) [m]; with ``output`` float32, read from the file.
        largest_angles: Largest angle in each frame (F,) [rad].
        angles: Rotation angle of each vertex's neighbourhood from rest, (F, n) [rad], 0 to π; in files
            ``primvars:rotationAngle`` [°].
        energies: Final energies (F,) [m²].
        iterations: Numbers of iterations (F,).
        converged: Whether frames reached the tolerance (F,).
        times: (F,) [s].
        timings: ``factorise`` and ``frames`` (a list) [s].
        output: Path of the USD file, or None.
        mesh: The :class:`warpcloth.Mesh` at rest, or None.
        pins: Vertices of the handles, or None.
    """

    points: np.ndarray | FrameSequence
    angles: np.ndarray | FrameSequence
    largest_angles: np.ndarray
    energies: np.ndarray
    iterations: np.ndarray
    converged: np.ndarray
    times: np.ndarray
    timings: dict[str, Any]
    output: FilePath | None = None
    mesh: Mesh | None = None
    pins: np.ndarray | None = None

    def __repr__(self) -> str:
        frames, vertices, _ = self.points.shape
        late = np.count_nonzero(~self.converged)
        result = f"{late} frames did not converge" if late else "converged"
        where = "" if self.output is None else f", in {self.output}"
        return f"Deformation({frames} frames of {vertices} vertices, {self.times[-1]:g} s, {result}{where})"


def deform(
    mesh: Mesh,
    pins: Pins,
    fps: float = 24.0,
    weights: Weights = "cotangent",
    energy: CellEnergy = "spokes",
    iterations: int = 500,
    tolerance: float = 1e-6,
    device: str = "cpu",
    dtype: Precision = "float64",
    output: FilePath | None = None,
    single_file: bool = False,
    progress: Progress | None = None,
    stage: StageMesh | None = None,
    up_axis: UpAxis | None = None,
) -> Deformation:
    """Deforms a mesh as rigidly as its moved handles allow (Sorkine & Alexa 2007).

    Each solve starts from the previous frame, moved along with the handles (:meth:`warpcloth.Arap.carry`), so handles may
    rotate by up to half a turn per frame. For a scene with moved pins: ``deform(scene.mesh, scene.pins, fps=scene.fps,
    stage=scene.stage)``.

    Args:
        mesh: The mesh at rest.
        pins: Handles and their keyframes (F, p, 3), a frame each.
        fps: Frames per second.
        weights: As of :class:`warpcloth.Arap`.
        energy: Likewise.
        iterations: Maximum per frame.
        tolerance: As of :meth:`warpcloth.Arap.solve`.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        output: USD file (.usd, .usda, .usdc, .usdz) to write frame by frame; velocities are differences from the previous
            frame.
        single_file: Whether ``output`` ends as one file.
        progress: Function called with (frame, frames), ``frames`` being those after the first; or None.
        stage: The :class:`warpcloth.usd.StageMesh` of ``mesh``, over which ``output`` is a layer.
        up_axis: Up axis of an output that is not a layer; by default that of the mesh.

    Returns:
        :class:`Deformation`.

    Raises:
        BlockingIOError, Interrupted, OSError: As for :func:`warpcloth.simulate`.
        ValueError: An argument is not allowed, or a frame overflows; frames before it are in ``output``.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> start = mesh.points[mesh.corners()]
        >>> wc.deform(mesh, wc.Pins("corners", keyframes=[start, start + [0, 1, 0]]))
        Deformation(2 frames of 9 vertices, 0.0416667 s, converged)
    """
    if not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is {shown(mesh)}; it must be a Mesh, such as Mesh.load(path)")
    number("fps", fps, above=0.0)
    whole("iterations", iterations, least=0)
    number("tolerance", tolerance, least=0.0)
    pins = checked_pins(pins, mesh)
    if not pins.held.all():
        raise ValueError("pins.axes leaves some axes of a handle free; deform takes handles that hold all three")
    if pins.keyframes is None:
        raise ValueError("pins.keyframes is None; a deformation needs positions of its handles, (F, p, 3), in each frame")
    frames = len(pins.keyframes)
    if output is not None:  # before it replaces an earlier result
        _refuse_beyond_float32(pins.keyframes, fps)
    # First, so that a wrong output is refused before the factorisation.
    recorder = _Memory(mesh, frames) if output is None else _File(mesh, pins, fps, output, single_file, stage, up_axis)
    results, points = [], None
    with recording(recorder, frames - 1):
        start = time.perf_counter()
        arap = Arap(mesh, pins.vertices, weights=weights, energy=energy, device=device, dtype=dtype)
        timings = {"factorise": time.perf_counter() - start, "frames": []}
        for frame, targets in enumerate(pins.keyframes):
            start = time.perf_counter()
            initial = None if points is None else arap.carry(points, pins.keyframes[frame - 1], targets)
            try:
                result = arap.solve(targets, iterations=iterations, tolerance=tolerance, initial=initial)
            except ValueError as error:
                raise ValueError(f"frame {frame}: {error}") from error
            velocities = np.zeros_like(result.points) if points is None else (result.points - points) * fps
            points = result.points
            timings["frames"].append(time.perf_counter() - start)
            angles = rotation_angles(result.rotations)
            recorder.append(points, velocities, angles)
            results.append((result.energies[-1], result.iterations, result.converged, angles.max()))
            if progress is not None:
                progress(frame, frames - 1)
    energies, iterations, converged, largest = (np.array(values) for values in zip(*results, strict=True))
    points, angles = recorder.read()
    times = np.arange(frames) / fps
    return Deformation(points, angles, largest, energies, iterations, converged, times, timings, output, mesh, pins.vertices)


def _refuse_beyond_float32(keyframes, fps):
    limit = np.finfo(np.float32).max
    rule = f"cannot be written: a file holds float32, up to {limit:.2g}"
    refuse("pins.keyframes", keyframes, ~(np.abs(keyframes) <= limit), rule)
    with np.errstate(over="ignore"):
        velocities = np.diff(keyframes, axis=0) * fps
    refuse("velocities of pins.keyframes", velocities, ~(np.abs(velocities) <= limit), rule)


def rotation_angles(rotations: np.ndarray) -> np.ndarray:
    """Returns the angles (n,) [rad] of rotation matrices (n, 3, 3), precise near 0 and π."""
    R = rotations
    axial = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    return np.arctan2(np.linalg.norm(axial, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)  # 2 sin, 2 cos


class _Memory:
    def __init__(self, mesh, frames):
        self.points, self.angles = np.empty((frames, len(mesh.points), 3)), np.empty((frames, len(mesh.points)))
        self.frames = 0

    def append(self, points, velocities, angles):
        self.points[self.frames], self.angles[self.frames] = points, angles
        self.frames += 1

    def close(self):
        pass

    def saved(self):
        return "nothing was saved"

    def read(self):
        return self.points, self.angles


class _File:
    def __init__(self, mesh, pins, fps, output, single_file, stage, up_axis):
        self.single_file, primvars = single_file, {PRIMVAR: "vertex"}
        if stage is None:
            handles = {"handles": pins.vertices}
            self.writer = AnimationWriter(output, mesh, fps, pins=handles, up_axis=up_axis, primvars=primvars)
        else:
            self.writer = AnimationWriter(output, mesh, fps, source=stage.path, prim=stage.prim, primvars=primvars)

    def append(self, points, velocities, angles):
        self.writer.append(points, velocities, {PRIMVAR: np.degrees(angles)})

    @property
    def frames(self):
        return self.writer.frames

    def saved(self):
        return self.writer.saved()

    def close(self):
        self.writer.close(single_file=self.single_file)

    def read(self):
        path = self.writer.path
        return FrameSequence(path), FrameSequence(path, attribute=f"primvars:{PRIMVAR}", scale=np.pi / 180.0)
