"""Fits parameters of a scene to what was measured, by least squares with differences from one batch."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as List
from dataclasses import dataclass
from os import PathLike, fspath

import numpy as np
from numpy.typing import ArrayLike

from ..analysis.compare import to_up_axis
from ..base.checks import number, shown
from ..base.types import FilePath, Precision
from ..core.status import Status
from ..mesh.captures import Capture
from ..mesh.selection import distinct_vertices
from ..mesh.sequences import Sequence, open_sequence
from ..scene.scene import Scene
from ..solvers.step import Step
from .equilibrium import Equilibrium, equilibrium
from .readings import CapturePoints, Markers, Reading, frames_at, no_common_frame
from .simulate import Animation, simulate

Measurement = Markers | Reading | CapturePoints
_DIFFERENCE = 1e-3  # of the logarithm of a parameter, to both sides
_TOLERANCE = 1e-8  # of the relative change of parameters and residuals
_UNDETERMINED = 1e-5  # smallest ratio of a singular value of the Jacobian to the largest


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that were fitted to what was measured.

    Attributes:
        parameters: Estimates by name.
        errors: Standard errors over the estimates, by name; infinite if the data do not determine them, NaN if neither a sigma
            nor surplus numbers give the noise.
        correlation: Correlation of the logarithms of the parameters, (P, P); NaN where undetermined.
        freedom: Degrees of freedom of the noise; infinite with a sigma.
        residual: RMS of the residuals [m]; divided by sigma, where given, so that it should be about 1.
        residuals: That RMS in each of the frames 1 … F, (F,), over markers; NaN in frames without any.
        runs: Number of batches, or of sets of equilibria.
        message: How the fit ended.
        status: The :class:`warpcloth.core.status.Status` with the estimates.
    """

    parameters: dict[str, float]
    errors: dict[str, float]
    correlation: np.ndarray
    freedom: float
    residual: float
    residuals: np.ndarray
    runs: int
    message: str
    status: Status

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % confidence intervals, if errors are independent and normal."""
        from scipy.stats import t

        limits = {
            name: (t.ppf(0.975, self.freedom) if self.freedom else np.nan) * self.errors[name] for name in self.parameters
        }
        with np.errstate(over="ignore"):
            return {
                name: (float(value * np.exp(-limits[name])), float(value * np.exp(limits[name])))
                for name, value in self.parameters.items()
            }


def fit(
    scene: Scene,
    solver: Step | None,
    start: Mapping[str, float],
    measured: ArrayLike | FilePath | Sequence | Capture | Measurement | List[Measurement],
    vertices: str | ArrayLike = "all",
    device: str = "cpu",
    dtype: Precision = "float64",
    record: str | List[str] = (),
) -> Fit:
    """Finds the positive parameters with which a scene moves, or rests, most nearly as measured.

    Minimises Σr² by ``scipy.optimize.least_squares`` over the logarithms of the parameters. One batch of 2P + 1 copies gives
    the residuals and their central differences of 0.1 %. The covariance is (JᵀJ)⁻¹ if residuals are divided by a sigma, else
    s²(JᵀJ)⁻¹ with s² = Σr²/(m − P). The motion must not be chaotic: of cloth that crumples, take a short time. Without a
    solver, shapes at rest are fitted, by :func:`warpcloth.equilibrium` from the shape before.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: Its solver, with an error of steps below that of the measurement; None for the equilibrium.
        start: Start values above 0 by names in ``vary``, such as ``"Spring.stiffness"``.
        measured: :class:`warpcloth.Markers`, :class:`warpcloth.Reading`, :class:`warpcloth.CapturePoints` or a list of these,
            each with a sigma; a :class:`warpcloth.Capture`; the path of a .csv file of markers; positions of ``vertices`` at
            frames 1 … F, (F, v, 3) [m], NaN where missing; or an animation of v vertices (path or sequence), whose frames at
            times of frames of the scene are used, turned to its up axis.
        vertices: The v measured vertices, indices or a selection, in the order of ``measured``.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        record: Records that readings need, such as ``"reactions"``.

    Returns:
        :class:`Fit`.

    Raises:
        ValueError: An argument is not allowed, no frame of an animation is at the time of a frame of the scene, nothing
            measured depends on a parameter at the start, or a run fails.

    Examples:
        >>> import numpy as np, warpcloth as wc
        >>> mesh = wc.Mesh.chain(2)
        >>> def hanging(k): return wc.Scene(mesh, masses=[1, 1], terms=[wc.Spring(stiffness=k)], pins=[0])
        >>> solver = wc.Newton(substeps=1, tolerance=1e-10)
        >>> seen = wc.simulate(hanging(500.0), solver, frames=20, dtype="float64").points[1:]
        >>> round(wc.fit(hanging(1.0), solver, {"Spring.stiffness": 300.0}, seen).parameters["Spring.stiffness"], 2)
        500.0
        >>> length = wc.Reading(lambda rest: -rest.points[1, 1], value=1.00981, sigma=1e-5)  # the weight over the stiffness
        >>> found = wc.fit(hanging(1.0), None, {"Spring.stiffness": 300.0}, length)
        >>> round(found.parameters["Spring.stiffness"]), round(found.errors["Spring.stiffness"], 4)
        (1000, 0.001)
    """
    from scipy.optimize import least_squares

    names, most = _checked_names(start, scene), 1 if solver is None else scene.frames
    data = _bound_data(scene, measured, vertices, most, solver is None)
    frames = most if any(each.last is None for each in data) else max(each.last for each in data)
    of_frames = np.concatenate([each.frames for each in data])
    if len(of_frames) < len(names):
        raise ValueError(f"measured has {len(of_frames)} numbers; it must have at least {len(names)}, one for each parameter")
    known_noise = data[0].sigma is not None
    scale = np.concatenate([np.broadcast_to(each.sigma if known_noise else 1.0, len(each.frames)) for each in data])
    options = {"device": device, "dtype": dtype, "record": record}
    runs: dict[bytes, tuple[np.ndarray, np.ndarray, Status]] = {}
    rest = None

    def evaluated(logs):
        nonlocal rest
        key = logs.tobytes()
        if key not in runs:
            changes = _DIFFERENCE * np.eye(len(logs))
            vary = dict(zip(names, np.exp(np.vstack([logs, logs + changes, logs - changes])).T, strict=True))
            if solver is None:
                found = _rests(scene, vary, rest, options)
                rest, status = found[0].points, found[0].status
            else:
                found, status = _motions(scene, solver, vary, frames, options)
            residuals = np.concatenate([each.residuals(found) for each in data], axis=1) / scale
            more, less = np.split(residuals[1:], 2)
            runs[key] = residuals[0], (more - less).T / (2.0 * _DIFFERENCE), status
        return runs[key]

    logs = np.log([start[name] for name in names])
    residuals, jacobian, _ = evaluated(logs)
    with np.errstate(over="ignore"):
        if not np.isfinite(residuals @ residuals):
            raise ValueError(f"measured: a residual is {np.abs(residuals).max():.3g} at the start; its square must be finite")
    for name in [name for name, slope in zip(names, jacobian.T, strict=True) if not slope.any()]:
        raise ValueError(f"measured does not depend on {name} near its start, {start[name]:g}; leave it out, or measure more")
    found = least_squares(
        lambda logs: evaluated(logs)[0],
        logs,
        jac=lambda logs: evaluated(logs)[1],
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=None,
    )
    residuals, jacobian, status = evaluated(found.x)
    freedom = np.inf if known_noise else float(len(residuals) - len(names))
    with np.errstate(invalid="ignore"):
        variance = 1.0 if known_noise else float(np.divide(residuals @ residuals, freedom)) if freedom else np.nan
    errors, correlation = _errors(jacobian, variance)
    return Fit(
        parameters=dict(zip(names, np.exp(found.x).tolist(), strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        correlation=correlation,
        freedom=freedom,
        residual=float(np.sqrt(np.mean(residuals**2))),
        residuals=_of_frames(residuals, of_frames, frames),
        runs=len(runs),
        message=found.message,
        status=status,
    )


def _checked_names(start, scene):
    if not (isinstance(start, Mapping) and start):
        raise ValueError(f"start is {shown(start)}; it must be a dict of parameters, such as {{'Spring.stiffness': 100.0}}")
    listed, taken = _parameters_of(scene)
    for name, value in start.items():
        if name not in taken:
            raise ValueError(f"start[{shown(name)}] names no number of this scene; allowed are {', '.join(listed) or 'none'}")
        number(f"start[{name!r}]", value, above=0.0)
    return list(start)


def _parameters_of(scene):
    quantities = [
        (term, field)
        for term in (*scene.terms, *scene.contact_terms, *scene.air_terms)
        for field, each in term.quantities().items()
        if not each.shape
    ]
    quantities += [(load, load.quantity) for load in scene.loads if not load.shape]
    density = [] if scene.density is None else ["density"]
    listed = list(dict.fromkeys([*density, *(f"{each.label}.{field}" for each, field in quantities)]))
    return listed, {*listed, *(f"{type(each).__name__}.{field}" for each, field in quantities)}


def _bound_data(scene, measured, vertices, most, resting):
    if isinstance(measured, Capture):
        measured = CapturePoints(measured)
    kinds = (Markers, Reading, CapturePoints)
    if isinstance(measured, kinds):
        measured = [measured]
    if isinstance(measured, List) and measured and all(isinstance(each, kinds) for each in measured):
        if not (isinstance(vertices, str) and vertices == "all"):
            raise ValueError(f"vertices is {shown(vertices)}; it is for animations and arrays; leave it out")
        named = [(f"measured[{k}]", each) for k, each in enumerate(measured)]
    else:
        named = [("measured", _of_vertices(scene, measured, vertices, resting))]
    data = [each.bind(name, scene, most, resting) for name, each in named]
    for (name, _), each in zip(named, data, strict=True):
        if not len(each.frames):
            raise ValueError(f"{name} has 0 numbers; it must have at least 1 that is finite")
    for (name, _), each in zip(named[1:], data[1:], strict=True):
        if each.sigma is None or data[0].sigma is None:
            lacking = name if each.sigma is None else named[0][0]
            raise ValueError(f"{lacking} has no sigma; each of several data must have one")
    return data


def _of_vertices(scene, measured, vertices, resting):
    if isinstance(measured, (str, PathLike)) and fspath(measured).lower().endswith(".csv"):
        if not (isinstance(vertices, str) and vertices == "all"):
            raise ValueError(f"vertices is {shown(vertices)} and measured is a file of markers; leave vertices out")
        return Markers.read(measured, scene, resting=resting)
    chosen = distinct_vertices("vertices", vertices, scene.mesh)
    if not len(chosen):
        raise ValueError(f"vertices is {shown(vertices)}, which names no vertex; it must name one at least")
    if isinstance(measured, (str, PathLike, Sequence)):
        measured = _positions(scene, measured, len(chosen))
    return Markers(positions=measured, vertices=chosen)


def _positions(scene, measured, count):
    sequence = measured if isinstance(measured, Sequence) else open_sequence(measured)
    where = "measured" if sequence.path is None else sequence.path
    if len(sequence.mesh.points) != count:
        raise ValueError(f"{where}: has {len(sequence.mesh.points)} vertices; it must have {count}, one for each of 'vertices'")
    if sequence.times is None:
        raise ValueError(f"{where}: has no times; open it with open_sequence(path, fps=…), or give --fps on the command line")
    sequence = to_up_axis(sequence, scene.mesh.up_axis, sequence.up_axis)
    frames, used = frames_at(sequence.times, scene)
    used = np.flatnonzero(used & (frames >= 1))
    if not len(used):
        raise ValueError(no_common_frame(str(where), sequence.times, scene))
    positions = np.full((frames[used].max(), count, 3), np.nan)
    for index in used:
        positions[frames[index] - 1] = sequence[index]
    return positions


def _motions(scene, solver, vary, frames, options) -> tuple[list[Animation], Status]:
    count = len(next(iter(vary.values())))
    found = simulate(scene, solver, frames=frames, copies=count, vary=vary, **options)
    if not found.status.complete:
        raise ValueError(f"a run with {_listed(vary, 0)} failed: {found.status.message}")
    return [found.of_copy(copy) for copy in range(count)], found.status


def _rests(scene, vary, rest, options) -> list[Equilibrium]:
    """Finds the equilibrium with each of the values (R,), each from the one before."""
    found = []
    for k in range(len(next(iter(vary.values())))):
        one = {name: values[k : k + 1] for name, values in vary.items()}
        found.append(equilibrium(scene, vary=one, start=rest, **options))
        if not found[-1].status.ok:
            raise ValueError(f"the equilibrium with {_listed(vary, k)} failed: {found[-1].status.message}")
        rest = found[0].points
    return found


def _listed(vary, k):
    return ", ".join(f"{name} {values[k]:.6g}" for name, values in vary.items())


def _of_frames(residuals, frames, count):
    squares = np.bincount(frames[frames >= 0], residuals[frames >= 0] ** 2, count)
    numbers = np.bincount(frames[frames >= 0], minlength=count)
    return np.sqrt(np.divide(squares, numbers, out=np.full(count, np.nan), where=numbers > 0))


def _errors(jacobian, variance):
    """Returns standard errors of the logarithms (P,), infinite where undetermined, and their correlation (P, P)."""
    _, sizes, rows = np.linalg.svd(jacobian, full_matrices=False)
    kept = sizes > _UNDETERMINED * sizes[0] if sizes[0] > 0.0 else np.zeros(len(sizes), dtype=bool)
    lost = (np.abs(rows[~kept]) > 1e-3).any(axis=0)
    inverse = rows[kept].T / sizes[kept]
    covariance = variance * inverse @ inverse.T
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    deviations = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(deviations, deviations)
    return np.where(lost, np.inf, deviations), correlation
