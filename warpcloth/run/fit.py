"""Fits parameters of a scene to a measured motion, by least squares with differences from one batch."""

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from ..analysis.compare import to_up_axis
from ..base.checks import numeric, shown
from ..base.types import FilePath, Precision
from ..mesh.selection import distinct_vertices
from ..mesh.sequences import Sequence, open_sequence
from ..scene.scene import Scene
from ..solvers.step import Step
from .simulate import simulate

_DIFFERENCE = 1e-3  # of the logarithm of a parameter, to both sides
_TOLERANCE = 1e-8  # of the relative change of parameters and residuals
_UNDETERMINED = 1e-5  # smallest ratio of a singular value of the Jacobian to the largest
_SAME_TIME = 1e-6  # largest distance of a measured frame from a frame of the scene, in frames


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that were fitted to a motion.

    Attributes:
        parameters: Estimates by name.
        errors: Their standard errors relative to the estimates, by name; infinite if the motion does not determine them.
        correlation: Correlation of the logarithms of the parameters, (P, P); NaN where the motion does not determine them.
        residual: RMS distance along an axis between the measured and the fitted positions [m].
        residuals: The same in each of the frames 1 … F, (F,) [m]; NaN in frames without a measured position.
        runs: Number of batches that were run.
        message: How the fit ended.
    """

    parameters: dict[str, float]
    errors: dict[str, float]
    correlation: np.ndarray
    residual: float
    residuals: np.ndarray
    runs: int
    message: str

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Intervals that contain the true values with a probability of 95 %, if errors are independent and normal."""
        limits = {name: 1.96 * self.errors[name] for name in self.parameters}
        with np.errstate(over="ignore"):
            return {
                name: (float(value * np.exp(-limits[name])), float(value * np.exp(limits[name])))
                for name, value in self.parameters.items()
            }


def fit(
    scene: Scene,
    solver: Step,
    start: Mapping[str, float],
    measured: ArrayLike | FilePath | Sequence,
    vertices: str | ArrayLike = "all",
    device: str = "cpu",
    dtype: Precision = "float64",
) -> Fit:
    """Finds the positive parameters with which the motion of a scene is nearest to a measured one.

    It minimises the sum of squared distances by ``scipy.optimize.least_squares`` over the logarithms of the parameters. One
    batch of 2P + 1 copies gives the motion and, by central differences of 0.1 %, its derivatives. Errors follow from the
    Jacobian J at the minimum, whose covariance is s²(JᵀJ)⁻¹, s² the mean square of the residuals. Choose a motion that is not
    chaotic: of a cloth that crumples, a short time.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Its solver, with steps so small that their error is below that of the measurement.
        start: Parameters by their name in ``vary``, such as ``"Spring.stiffness"``, and values to start from, above 0.
        measured: Positions at frames 1 … F of the scene, (F, v, 3) [m]; NaN where there is none. Or an animation of v vertices:
            a path or a sequence that `open_sequence` takes or returns, with times from the start of the scene on. Its frames at
            the times of frames of the scene are used. It is turned to the up axis of the mesh of the scene.
        vertices: The v vertices that were measured, indices or a selection, in their order in ``measured``.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.

    Returns:
        :class:`Fit`.

    Raises:
        ValueError: If an argument is not allowed, if no frame of an animation is at the time of a frame of the scene, or if a
            run with parameters on the way fails.

    Examples:
        >>> import numpy as np, warpcloth as wc
        >>> mesh = wc.Mesh.chain(2)
        >>> def hanging(k): return wc.Scene(mesh, masses=[1, 1], terms=[wc.Spring(stiffness=k)], pins=[0])
        >>> solver = wc.Newton(substeps=1, tolerance=1e-10)
        >>> seen = wc.simulate(hanging(500.0), solver, frames=20, dtype="float64").points[1:]
        >>> round(wc.fit(hanging(1.0), solver, {"Spring.stiffness": 300.0}, seen).parameters["Spring.stiffness"], 2)
        500.0
    """
    from scipy.optimize import least_squares

    names = _checked_names(start)
    chosen = distinct_vertices("vertices", vertices, scene.mesh)
    if isinstance(measured, (str, PathLike, Sequence)):
        measured = _positions(scene, measured, len(chosen))
    seen = numeric("measured", measured, f"have shape (F, {len(chosen)}, 3)")
    if seen.ndim != 3 or seen.shape[1:] != (len(chosen), 3) or not 0 < len(seen) <= scene.frames:
        raise ValueError(
            f"measured has shape {seen.shape}; it must be (F, {len(chosen)}, 3) with F from 1 to {scene.frames}, the frames of "
            "the scene"
        )
    known = np.isfinite(seen)
    if known.sum() < len(names):
        raise ValueError(f"measured has {known.sum()} numbers; it must have at least {len(names)}, one for each parameter")
    runs: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def evaluated(logs):
        """Returns residuals (m,) and their derivatives (m, P) by the logarithms of the parameters."""
        key = logs.tobytes()
        if key not in runs:
            changes = _DIFFERENCE * np.eye(len(logs))
            values = np.exp(np.vstack([logs, logs + changes, logs - changes]))
            vary = {name: values[:, k] for k, name in enumerate(names)}
            found = simulate(scene, solver, frames=len(seen), device=device, dtype=dtype, copies=len(values), vary=vary)
            if not found.status.ok:
                at = ", ".join(f"{name} {value:.6g}" for name, value in zip(names, values[0], strict=True))
                raise ValueError(f"a run with {at} failed: {found.status.message}")
            points = np.stack([np.asarray(found.points[frame]) for frame in range(1, len(seen) + 1)], axis=1)
            residuals = (points[:, :, chosen] - seen)[:, known]
            more, less = np.split(residuals[1:], 2)
            runs[key] = residuals[0], (more - less).T / (2.0 * _DIFFERENCE)
        return runs[key]

    found = least_squares(
        lambda logs: evaluated(logs)[0],
        np.log([start[name] for name in names]),
        jac=lambda logs: evaluated(logs)[1],
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=None,
    )
    residuals, jacobian = evaluated(found.x)
    errors, correlation = _errors(jacobian, residuals)
    return Fit(
        parameters=dict(zip(names, np.exp(found.x).tolist(), strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        correlation=correlation,
        residual=float(np.sqrt(np.mean(residuals**2))),
        residuals=_of_frames(residuals, known),
        runs=len(runs),
        message=found.message,
    )


def _checked_names(start):
    """Returns the names of the parameters."""
    if not (isinstance(start, Mapping) and start):
        raise ValueError(f"start is {shown(start)}; it must be a dict of parameters, such as {{'Spring.stiffness': 100.0}}")
    for name, value in start.items():
        if not (np.ndim(value) == 0 and np.isreal(value) and 0.0 < value < np.inf):
            raise ValueError(f"start[{name!r}] is {shown(value)}; it must be a finite number above 0")
    return list(start)


def _positions(scene, measured, count):
    """Returns the positions (F, count, 3) [m] of an animation at frames 1 … F of a scene, NaN where it has no such frame."""
    sequence = measured if isinstance(measured, Sequence) else open_sequence(measured)
    where = "measured" if sequence.path is None else sequence.path
    if len(sequence.mesh.points) != count:
        raise ValueError(f"{where}: has {len(sequence.mesh.points)} vertices; it must have {count}, one for each of 'vertices'")
    if sequence.times is None:
        raise ValueError(f"{where}: has no times; open it with open_sequence(path, fps=…), or give --fps on the command line")
    sequence = to_up_axis(sequence, scene.mesh.up_axis, sequence.up_axis)
    wanted = np.asarray(sequence.times) * scene.fps
    frames = np.rint(wanted).astype(int)
    used = np.flatnonzero((np.abs(wanted - frames) <= _SAME_TIME) & (frames >= 1) & (frames <= scene.frames))
    if not len(used):
        raise ValueError(
            f"{where}: has {len(wanted)} frames from {sequence.times[0]:g} to {sequence.times[-1]:g} s, none at the time of a "
            f"frame of the scene; it must have one at a multiple of 1/{scene.fps:g} s, up to {scene.frames / scene.fps:g} s"
        )
    positions = np.full((frames[used].max(), count, 3), np.nan)
    for index in used:
        positions[frames[index] - 1] = sequence[index]
    return positions


def _of_frames(residuals, known):
    """Returns the RMS of the residuals (m,) of each frame, (F,), NaN without any; ``known`` (F, v, 3) says of which numbers."""
    squares, counts = np.zeros(known.shape), known.sum(axis=(1, 2))
    squares[known] = residuals**2
    return np.sqrt(np.divide(squares.sum(axis=(1, 2)), counts, out=np.full(len(known), np.nan), where=counts > 0))


def _errors(jacobian, residuals):
    """Returns standard errors of the logarithms (P,), infinite where they are not determined, and their correlation (P, P)."""
    m, P = jacobian.shape
    _, sizes, rows = np.linalg.svd(jacobian, full_matrices=False)
    kept = sizes > _UNDETERMINED * sizes[0] if sizes[0] > 0.0 else np.zeros(len(sizes), dtype=bool)
    lost = (np.abs(rows[~kept]) > 1e-3).any(axis=0)
    variance = float(residuals @ residuals) / max(m - P, 1)
    inverse = rows[kept].T / sizes[kept]
    covariance = variance * inverse @ inverse.T
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    deviations = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(deviations, deviations)
    return np.where(lost, np.inf, deviations), correlation
