"""Reference solutions: the motion of a scene on its mesh without the error of time steps, kept in files."""

import hashlib
import itertools
import json
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ..base.checks import number, whole
from ..base.digest import scene_digest, source_digest
from ..base.outputs import Output
from ..core.status import Result
from ..run.simulate import simulate
from ..solvers import ConstrainedDynamics, Explicit, Newton
from ..solvers.explicit import step_limits
from .campaign import cache_folder
from .clock import Clock, TooSlow

# Largest number of explicit steps per frame on the CPU and on CUDA. A Newton step takes as long as some 250 explicit ones in
# soft cloth and 5000 or more in stiff cloth, on CUDA more, and 4, 8 and 16 per frame are the fewest that may do.
_MAX_EXPLICIT, _MAX_ON_CUDA = 20000, 65536
# Tolerance of solves within a step, so small that only the error of the step itself counts.
_TOLERANCE = 1e-6
# Iterations of a step of Newton's method. If pairs of self-contact turn, a step may need over 100: the Hessian leaves this out.
_ITERATIONS = 400
_SOLVED = (Result.COMPLETED, Result.CONVERGED, Result.ROUNDED)


class NoReference(ValueError):
    """Raised if a scene has no reference solution: no method takes it, or the time was too short."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The motion of a scene on its mesh, with a bound of its error.

    Attributes:
        points: (F, n, 3) [m], the start and each frame after it, float64.
        times: (F,) [s].
        error: Bound of its :func:`position_error`.
        strain_error: Bound of its :func:`strain_error`.
        substeps: Steps per frame of the finest run.
        seconds: Time of all runs [s].
        key: A hash of scene, frames and code.
        scene: :func:`warpcloth.base.digest.scene_digest` of the scene.
        method: The solver.
        limit: Time [s] that was too short for a smaller error: 0 if none was needed, infinite if more time would not help.
    """

    points: np.ndarray
    times: np.ndarray
    error: float
    strain_error: float
    substeps: int
    seconds: float
    path: str
    key: str
    scene: str
    method: str
    limit: float

    def save(self):
        """Writes the file, under a temporary name until it is complete."""
        Path(self.path).parent.mkdir(parents=True, exist_ok=True)
        output = Output(self.path, "wb")
        try:
            np.savez(output.file, **{name: value for name, value in vars(self).items() if name != "path"})
            output.close()
        except BaseException:
            output.discard()
            raise

    @classmethod
    def load(cls, path):
        """Reads a file that :meth:`save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is broken.
        """
        names = [field.name for field in fields(cls) if field.name != "path"]
        try:
            with np.load(path, allow_pickle=False) as file:
                values = {name: file[name] if name in ("points", "times") else file[name].item() for name in names}
        except FileNotFoundError:
            raise
        except Exception as error:  # zipfile, zlib and NumPy raise errors of their own
            raise ValueError(f"{path}: is no reference solution, or broken ({error}); remove it") from None
        return cls(path=str(path), **values)


def cloth_size(mesh):
    """Returns the longest side of the bounding box of the rest shape [m], by which :func:`position_error` divides."""
    return float(np.ptp(mesh.points, axis=0).max())


def position_error(points, others, mesh):
    """Returns the RMS distance over vertices and frames of points (F, n, 3) to others, over the size of the cloth."""
    return float(np.sqrt(((points - others) ** 2).sum(axis=-1).mean()) / cloth_size(mesh))


def strain_error(points, others, mesh):
    """Returns the 99th percentile over edges and frames of the difference of strains l/L − 1, for points (F, n, 3)."""
    a, b = mesh.edges[mesh.edge_lengths > 0.0].T
    lengths = mesh.edge_lengths[mesh.edge_lengths > 0.0]
    first, other = (np.linalg.norm(x[:, b] - x[:, a], axis=-1) for x in (points, others))
    return float(np.percentile(np.abs(first - other) / lengths, 99))


def reference(scene, frames=None, tolerance=1e-3, limit=600.0, progress=None, device="cpu"):
    """Returns the :class:`Reference` of a scene, from its file if that is accurate enough; otherwise computes and stores it.

    Runs with steps h, h/2, h/4 … in float64 give e(h) = x(h) + (x(h) − x(2h))/(2ᵖ − 1) by Richardson extrapolation, with the
    order p of the method (Hairer, Nørsett and Wanner 1993, *Solving ordinary differential equations I*). The last e(h) is the
    reference. ‖e(h) − e(2h)‖ bounds its error if each halving of h at least halves the error. Where a halving moves the cloth
    by more than 0.75 of what the one before did, e(h) is x(h).

    The method is symplectic Euler if some 20 000 steps per frame are stable, on CUDA 65 000, because BDF2 damps high
    frequencies unless ωh is small. Stiffer scenes, and scenes with colliders, where contact in explicit steps is softer, use
    Newton's method with BDF2. Hard constraints use :class:`warpcloth.ConstrainedDynamics`. Friction makes BDF2 first order.

    Args:
        scene: The :class:`warpcloth.lab.measurements.SceneRef`.
        frames: Number of frames, by default those of the scene.
        tolerance: Steps are halved until ``error`` is at most this, or until two halvings did not lower it, a sign of chaotic
            motion or rounding.
        limit: Time limit [s].
        progress: Function called with (substeps, frame, frames) after each frame.
        device: A Warp device.

    Warns:
        UserWarning: Its error is above the tolerance, or a term makes it slow.

    Raises:
        NoReference: No method takes the scene, or ``limit`` is too short for any estimate.
        ValueError: An argument is not allowed.
    """
    number("tolerance", tolerance, above=0.0)
    number("limit", limit, above=0.0)
    declared = scene.load()
    frames = declared.frames if frames is None else frames
    whole("frames", frames, 1)
    digest = scene_digest(declared)
    key = hashlib.sha256(json.dumps([digest, int(frames), source_digest()]).encode()).hexdigest()[:24]
    path = cache_folder() / "references" / f"{key}.npz"
    found = kept_reference(path, key)
    if found is None or (found.error > tolerance and found.limit < limit):
        path.parent.mkdir(parents=True, exist_ok=True)  # before minutes of runs
        facts = {"path": str(path), "key": key, "scene": digest, "times": np.arange(frames + 1) / declared.fps}
        found = Reference(**facts, **_solve(declared, frames, tolerance, limit, progress, device))
        found.save()
    if found.error > tolerance:
        idle = "smaller steps make it no less, for the motion is chaotic or rounding is what is left, take fewer frames"
        why = idle if found.limit == math.inf else "give it more time, or fewer frames"
        warnings.warn(f"the reference of {scene} is known to {found.error:.1e} only, not to {tolerance:g}: {why}", stacklevel=2)
    return found


def kept_reference(path, key):
    """Returns the reference in a file, or None if there is none or it is broken."""
    try:
        found = Reference.load(path)
    except (FileNotFoundError, ValueError):
        return None
    return found if found.key == key else None


@dataclass(frozen=True)
class _Method:
    """The method of a reference: (substeps) → ``record``, the smallest number of substeps, and its order p."""

    record: Callable
    first: int
    order: int


def _method(scene, device):
    model = scene.build(device=device, dtype="float64")
    if any(elements.hard for elements in model.terms):
        method = _Method(lambda s: ConstrainedDynamics(substeps=s, iterations=100, tolerance=_TOLERANCE), 4, 1)
        try:
            method.record(method.first).bind(model)
        except ValueError as error:
            raise NoReference(f"there is no reference solution of {scene.name}: {error}") from None
        return method
    if scene.colliders:
        return _Method(lambda s: Newton(substeps=s, tolerance=_TOLERANCE, iterations=_ITERATIONS, integrator="bdf2"), 4, 1)
    fewest = 1.0 / (scene.fps * min(step_limits(model)))
    most = _MAX_ON_CUDA if model.device.is_cuda else _MAX_EXPLICIT
    if fewest < most:
        return _Method(lambda s: Explicit(substeps=s), max(4, int(fewest) + 1), 1)
    for elements in model.terms:
        if elements.cells and not elements.term.whole.quadratic:
            warnings.warn(
                f"{elements.label} makes the reference of {scene.name} slow: Newton's method takes many iterations for bodies; "
                f"with less stiffness, below {most} explicit steps a frame, it is faster",
                stacklevel=4,
            )
    return _Method(lambda s: Newton(substeps=s, tolerance=_TOLERANCE, iterations=_ITERATIONS, integrator="bdf2"), 4, 2)


def _solve(scene, frames, tolerance, limit, progress, device):
    method = _method(scene, device)
    started, substeps = time.perf_counter(), method.first
    runs, errors, best, trouble = [], [], None, ""  # points of up to three runs, each with half the step of the one before
    while True:
        before = time.perf_counter()
        clock = Clock(limit - (before - started), progress and (lambda *at, s=substeps: progress(s, *at)))
        try:
            run = simulate(scene, method.record(substeps), device=device, dtype="float64", frames=frames, progress=clock)
        except TooSlow:
            break
        if run.status.result in _SOLVED:
            runs = [*runs[-2:], run.points]
        else:  # the step is too large, so coarser runs cannot be extrapolated
            runs, errors, best, trouble = [], [], None, f"; with {substeps} substeps: {run.status.message}"
        if len(runs) == 3:
            first, second = (position_error(b[1:], a[1:], scene.mesh) for a, b in itertools.pairwise(runs))
            if second > 0.75 * first:  # no power of h, which an extrapolation could continue
                coarse, fine = runs[1:]
            else:
                coarse, fine = (b + (b - a) / (2**method.order - 1) for a, b in itertools.pairwise(runs))
            errors.append(position_error(fine[1:], coarse[1:], scene.mesh))
            best = {
                "points": fine,
                "error": errors[-1],
                "strain_error": strain_error(fine[1:], coarse[1:], scene.mesh),
                "substeps": substeps,
            }
            now = time.perf_counter()
            if errors[-1] <= tolerance or _idle(errors) or now - started + 2.0 * (now - before) > limit:
                break
        substeps *= 2
    if best is None:
        sentence = f"the reference of {scene.name} needs more than {limit:g} s{trouble}"
        raise NoReference(f"{sentence}; give it more time, fewer frames or a coarser mesh")
    name = type(method.record(substeps)).__name__
    used_up = 0.0 if errors[-1] <= tolerance else math.inf if _idle(errors) else limit
    return best | {"method": name, "limit": used_up, "seconds": time.perf_counter() - started}


def _idle(errors):
    return len(errors) > 2 and errors[-1] > 0.9 * errors[-3]
