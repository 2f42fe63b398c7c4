"""Maps of where each method is stable, is inaccurate or diverges: cells over two axes, measured row by row."""

import math
import time
import warnings
from contextlib import closing
from dataclasses import asdict, dataclass

import numpy as np

from ..base.checks import choice, number
from ..base.digest import scene_digest
from ..core.status import Result
from ..run.watch import Watch, watched_frames
from ..solvers import Newton
from .axes import ACCURACY, AXES, FIXED, OPTIONS
from .cells import record_at, refined, scene_at, steps_in, together, vary
from .measurements import SceneRef, Setup, finite, task
from .stability_limits import KNOWN, limit_ratios

VERDICTS = ("stable", "unsure", "inaccurate", "stalled", "diverged", "refused", "slow")
# Steps of the reference per step of the map, and its largest total number of steps (at least one per frame). A run with half as
# many steps gives the error of the reference.
_FINER, _MAX_STEPS = 4, 2000
_FAILED = (Result.STALLED, Result.SADDLE, Result.CONTRADICTED)


@dataclass(frozen=True)
class BatchRun:
    """The result of a run of B copies; a copy is NaN from the frame in which it diverged.

    Attributes:
        points: (frames+1, B, n, 3) [m].
        good: The last good frame of each copy (B,).
        growth: Largest kinetic and potential energy in a good frame, over what the start, falling and rounding can have added,
            (B,).
        reasons: A sentence for each copy, or "".
        results: :class:`warpcloth.core.status.Result` of each copy.
        steps_per_frame: Steps per frame.
    """

    points: np.ndarray
    good: np.ndarray
    growth: np.ndarray
    reasons: list
    results: list
    steps_per_frame: int = 1


class Slow(Exception):
    """A run took longer than its limit."""


def run(scene, record, copies=1, varied=None, device="cpu", dtype="float64", limit=60.0):
    """Runs a scene like `simulate`, with its criteria of divergence except strain, which the reference covers.

    Raises:
        Slow: The run took more than ``limit`` seconds, which is checked at each frame.
        ValueError: The solver refuses the scene.
    """
    began = time.perf_counter()
    model = scene.build(device=device, dtype=dtype, copies=copies, vary=varied)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large steps, which are the subject
        stepper = record.bind(model)
    frames, B = scene.frames, copies
    watch = Watch(model, stepper, stretched=np.inf, grades=False)
    points = np.full((frames + 1, B, model.per_copy, 3), np.nan)
    points[0] = model.positions.numpy().reshape(B, -1, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        with closing(watched_frames(stepper, watch, frames)) as found:
            for number, frame in found:
                points[number, watch.alive] = frame.points.reshape(B, -1, 3)[watch.alive]
                if time.perf_counter() - began > limit:
                    raise Slow(f"stopped after {limit:g} s, in frame {number} of {frames}")
    said = [watch.messages.get(copy, each.value if each in _FAILED else "") for copy, each in enumerate(stepper.results)]
    said = [text.replace(f", copy {copy}:", ":") for copy, text in enumerate(said)]  # copies mean nothing in the map
    return BatchRun(points, watch.good, watch.growth, said, list(stepper.results), stepper.steps_per_frame)


def measure(
    scene,
    setups,
    fixed,
    axis,
    values,
    steps,
    accuracy=ACCURACY,
    device="cpu",
    dtype="float64",
    limit=60.0,
    reference=True,
    digests=None,
    duration=None,
):
    """Measures cells that differ in one value, for each setup, in one run of several copies if possible.

    Arguments and results are JSON values. ``values`` are those of ``axis``; ``fixed`` has those of others that all cells share.
    Runs have at least ``steps`` steps, so that instabilities have time to grow. ``accuracy`` is the RMS distance to the
    reference over vertices and frames, over the size of the cloth, above which a run is inaccurate. Motion is compared for
    ``duration`` [s], by default that of ``steps``. The reference is Newton with BDF2 in float64 at a quarter of the step, but
    at most 2000 steps; there is none if Newton refuses the scene. ``limit`` [s] is that of each run. With ``digests`` a changed
    scene has another key.

    Returns:
        list: For each setup a list of cells, dictionaries with ``verdict``, of :data:`VERDICTS` ("stalled": a step ended in
        no minimum; "unsure": the reference does not tell), ``status`` ("ok", "diverged", "slow" or "refused"), ``reason``,
        ``step`` (that of divergence, or None), ``steps``, ``growth`` of :class:`BatchRun`, ``error`` (or None), ``floor``, the
        distance of the reference to a run of twice its step, which bounds its own error if each halving at least halves that
        (or None), and ``rules`` of :func:`warpcloth.lab.stability_limits.limit_ratios`, where :data:`KNOWN` is ``floor`` over
        ``accuracy``.
    """
    ref, setups = SceneRef(**scene), [Setup(**setup) for setup in setups]
    groups = [values]
    if not together(scene_at(ref, {"dt": FIXED["dt"], **fixed}, 1), axis):
        groups = [[value] for value in values]
    rows, answer, length = [[] for _ in setups], None, (steps, duration)
    for nth, group in enumerate(groups):
        if reference and (nth == 0 or axis not in OPTIONS):  # the axis is not an option of the method
            answer = _reference(ref, fixed, axis, group, length, device, limit)
        for row, setup in zip(rows, setups, strict=True):
            try:
                record = record_at(setup, fixed if len(group) > 1 else {**fixed, axis: group[0]})
            except ValueError as error:
                row += [_cell("refused", str(error)) for _ in group]
                continue
            found = _attempt(ref, record, fixed, axis, group, length, device, dtype, limit)
            for copy, value in enumerate(group):
                cell = found if isinstance(found, dict) else _judge(found, copy, answer, accuracy)
                if cell["status"] != "refused":
                    of_cell = scene_at(ref, {**fixed, axis: value}, *length)
                    run_for = of_cell.frames * record.per_frame(of_cell.fps)
                    known = {name: finite(ratio) for name, ratio in limit_ratios(of_cell, record, run_for).items()}
                    cell = cell | {"steps": run_for, "rules": known}
                    if cell["floor"] is not None and accuracy > 0.0:
                        cell["rules"][KNOWN] = cell["floor"] / accuracy
                row.append(cell)
    return rows


def _attempt(ref, record, fixed, axis, group, length, device, dtype, limit):
    """Returns the :class:`BatchRun` of a group, or the cell of all its copies if the run failed."""
    try:
        if len(group) == 1:
            scene = scene_at(ref, {**fixed, axis: group[0]}, *length)
            return run(scene, record, device=device, dtype=dtype, limit=limit)
        scene = scene_at(ref, fixed, *length)
        return run(scene, record, len(group), vary(scene, axis, group), device, dtype, limit)
    except Slow as slow:
        return _cell("slow", str(slow))
    except ValueError as error:
        return _cell("refused", str(error))


def _reference(ref, fixed, axis, group, length, device, limit):
    """Returns a :class:`BatchRun` of the coarser run and of the reference, or why there is none; or None."""
    dt = {**fixed, axis: group[0]}["dt"]
    steps, duration = length
    steps = steps if duration is None else steps_in(duration, dt)
    scene = scene_at(ref, {**fixed, axis: group[0]}, steps)
    half = min(_FINER // 2 * round(1.0 / (scene.fps * dt)), -(-_MAX_STEPS // (2 * scene.frames)))
    found = []
    for substeps in (half, 2 * half):
        record = Newton(substeps=substeps, integrator="bdf2", tolerance=1e-6)
        found.append(_attempt(ref, record, fixed, axis, group, (steps, None), device, "float64", limit))
        if isinstance(found[-1], dict):
            return None if found[-1]["status"] == "refused" else f"no reference: {found[-1]['reason']}"
    return found


def _apart(first, other, copy):
    """Returns the RMS distance of a copy in two runs over the size of the cloth; None if one did not end."""
    frames = len(other.points)
    if min(each.good[copy] for each in (first, other)) < frames - 1:
        return None
    squares = ((first.points[:frames, copy] - other.points[:, copy]) ** 2).sum(axis=-1)
    return finite(math.sqrt(squares.mean()) / np.ptp(other.points[0, copy], axis=0).max())


def _judge(trial, copy, answer, accuracy):
    growth, reason = finite(trial.growth[copy]), trial.reasons[copy]
    floor = _apart(*answer, copy) if isinstance(answer, list) else None
    if trial.good[copy] < len(trial.points) - 1:
        step = int(trial.good[copy] + 1) * trial.steps_per_frame
        return _cell("diverged", reason, step=step, growth=growth, floor=floor)
    error = None if floor is None else _apart(trial, answer[-1], copy)
    known = {"growth": growth, "error": error, "floor": floor}
    if trial.results[copy] in _FAILED:
        return _cell("stalled", reason, **known)
    if answer is None:
        return _cell("stable", "", **known)
    if error is None:
        return _cell("unsure", answer if isinstance(answer, str) else "no reference: it diverges", **known)
    reason = f"RMS distance to the reference {100.0 * error:.3g} % of the size, which is known to {100.0 * floor:.2g} %"
    if error - floor > accuracy:
        return _cell("inaccurate", reason, **known)
    return _cell("stable", "", **known) if error + floor <= accuracy else _cell("unsure", reason, **known)


def _cell(verdict, reason, **more):
    status = "ok" if verdict in VERDICTS[:4] else verdict
    unknown = dict.fromkeys(("step", "steps", "growth", "error", "floor"))
    return {"verdict": verdict, "status": status, "reason": reason, **unknown, "rules": {}} | more


@dataclass(frozen=True)
class Survey:
    """A map to be measured: methods without steps, over two axes with values ``xs`` and ``ys``, and ``fixed`` values of others.

    ``steps`` and ``duration`` are as for :func:`measure`; the default duration is half of the scene's.

    Raises:
        ValueError: The axes are equal or unknown, or a method has a step of its own.
    """

    scene: SceneRef
    setups: tuple
    x: str
    y: str
    xs: tuple
    ys: tuple
    fixed: dict
    steps: int = 120
    duration: float | None = None

    def __post_init__(self):
        for name in (self.x, self.y, *self.fixed):
            choice("axis", name, tuple(AXES))
        if self.x == self.y or {self.x, self.y} & set(self.fixed):
            raise ValueError(f"axes are {self.x}, {self.y} and at fixed values {', '.join(self.fixed)}; each must be another")
        for setup in self.setups:
            if {"dt", "substeps", "error"} & set(setup.options):
                raise ValueError(f"{setup}: the map sets the step; leave dt, substeps and error out")
        if self.duration is None:
            object.__setattr__(self, "duration", 0.5 * self.scene.load().duration)
        number("duration", self.duration, above=0.0)

    def tasks(self, **options):
        """Returns one :class:`warpcloth.lab.measurements.Task` for each row, along an axis where copies can differ if any."""
        scene = scene_at(self.scene, {**FIXED, **self.fixed} | self._first(), 1)
        along = self.y if together(scene, self.y) and not together(scene, self.x) else self.x
        other, others = (self.x, self.xs) if along == self.y else (self.y, self.ys)
        values = self.ys if along == self.y else self.xs
        rest = {name: value for name, value in {**FIXED, **self.fixed}.items() if name != along}
        setups = [asdict(setup) for setup in self.setups]
        given = {"setups": setups, "axis": along, "values": list(values), **options}
        given |= {"steps": self.steps, "duration": self.duration}
        given["digests"] = self._digests()
        return [task(measure, scene=self.scene, fixed={**rest, other: value}, **given) for value in others]

    def _digests(self):
        values = {self.x: self.xs, self.y: self.ys}.get("resolution", [])
        refs = [refined(self.scene, value) for value in values] or [self.scene]
        return [scene_digest(ref.load()) for ref in refs]

    def _first(self):
        return {self.x: self.xs[0], self.y: self.ys[0]}

    def table(self, results, store=None):
        """Returns cells (setup, y, x) as nested lists, None if missing, from (task, result) pairs in any order.

        A ``store`` gives the ``machine`` of each cell.
        """
        cells = [[[None] * len(self.xs) for _ in self.ys] for _ in self.setups]
        for done, rows in results:
            axis, fixed = done.arguments["axis"], done.arguments["fixed"]
            for row, of_setup in zip(rows, cells, strict=True):
                for k, cell in enumerate(row):
                    cell = cell if store is None else cell | {"machine": store.machine(done)}
                    if axis == self.x:
                        of_setup[self.ys.index(fixed[self.y])][k] = cell
                    else:
                        of_setup[k][self.xs.index(fixed[self.x])] = cell
        return cells


def boundary(scene, setup, axis, low, high, steps=200, fixed=None, accuracy=1e-3, **options):
    """Returns the value of an axis at which runs begin or cease to diverge, by bisection of its logarithm.

    Exactly one of ``low`` and ``high`` must diverge. ``accuracy`` is the relative width at which to stop.

    Raises:
        ValueError: Neither end diverges, or both do.
    """

    def diverges(value):
        values = {**FIXED, **(fixed or {}), axis: value}
        found = run(scene_at(scene, values, steps), record_at(setup, values), **options)
        return bool(found.good[0] < len(found.points) - 1)

    before = diverges(low)
    if diverges(high) == before:
        raise ValueError(f"{axis} from {low:g} to {high:g}: both ends {'diverge' if before else 'hold'}")
    while high / low > 1.0 + accuracy:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if diverges(middle) == before else (low, middle)
    return math.sqrt(low * high)
