"""The cheapest solver and settings that meet a tolerance, or the most accurate within a budget, from measurements."""

import contextlib
import itertools
import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from typing import NamedTuple

from ..base.checks import number, whole
from ..others.simulators import simulator_of
from ..solvers import SOLVERS
from . import campaign, trajectory
from .measurements import Setup, task, usable
from .own_reference import SHARE, of_own, own_facts, own_references
from .reference import reference
from .setups import setups_of_runs
from .work_precision import WITHIN

# Number of rungs by which each ladder is extended, each with twice the substeps or a quarter of the error of two steps.
_MORE = 3
# Ladders of a solver of another simulator: number of doublings, and number of doublings of its most iterations. The settings
# of one such solver, and its own reference, may each take this number of time limits.
_DOUBLINGS, _BEYOND, LIMITS = 10, 2, 6.0
# The reference must be more accurate than the tolerance by this factor.
FINER = 5.0
# The reference may take so many times the limit of one run.
_REFERENCE = 5.0
# A run ends after so many times the frames of the cheapest setting that meets the tolerance, and so many seconds.
_DEARER, _START = 3.0, 1.0


@dataclass(frozen=True)
class Measured:
    """A ``setup`` and its measurements, by a ``machine``.

    Attributes:
        error: Error of the trajectory, relative to the size of the cloth, or None.
        milliseconds: Time of a frame [ms], or None.
        spread: By how much frames differ from their neighbours, as quartiles [ms], (low, high), or None.
        reason: Why there is no error, or "".
        final: Whether finer steps would fail too: it took too long, or its method is refused.
        strain_error: Strain error of the trajectory, or None.
        own_error: Error relative to the motion to which a solver of another simulator itself converges, or None.
        seconds: Time of its frames [s].
        status: "ok", "diverged", "slow", "refused", or "left" if it was not measured.
        dtype: The precision of its run, or None if it was not measured.
        grade: The value of the :class:`warpcloth.core.status.Grade` of its run, or None.
    """

    setup: Setup
    error: float | None
    milliseconds: float | None
    spread: tuple[float, float] | None = None
    reason: str = ""
    machine: str = ""
    final: bool = False
    strain_error: float | None = None
    own_error: float | None = None
    seconds: float = 0.0
    status: str = "ok"
    dtype: str | None = None
    grade: str | None = None

    @property
    def usable(self):
        return usable({"grade": self.grade})


@dataclass(frozen=True)
class Choice:
    """The result of :func:`pick`.

    Attributes:
        chosen: The chosen :class:`Measured`, or None.
        meets: Whether it meets the tolerance and the budget.
        rivals: Others that are as good within the spread of times, the best first.
        certainty: A sentence about the certainty of the choice.
        others: By solver of another simulator, the :func:`warpcloth.lab.own_reference.own_facts`, and ``searched``, how its
            search ended.
        untried: Number of settings that :func:`climb` left out.
    """

    chosen: Measured | None
    meets: bool
    rivals: list
    certainty: str
    others: dict = field(default_factory=dict)
    untried: int = 0


class Longest(NamedTuple):
    """The longest time that :func:`choose` may take without compilation, if no ``total`` is given.

    ``limit`` is that of a run [s], ``settings`` the number of settings of warpcloth, and ``others`` that of other solvers.
    """

    limit: float
    settings: int
    others: int

    @property
    def reference(self):
        return _REFERENCE * self.limit

    @property
    def other(self):
        """Time of a solver of another simulator [s]: its search, the run by which that may end late, and its own reference.

        A run of its own reference is repeated with more iterations, which may take as long as all the others.
        """
        return (3.0 * LIMITS + 1.0) * self.limit

    @property
    def seconds(self):
        return self.reference + self.settings * self.limit + self.others * self.other


def pick(measurements, tolerance=None, budget=None, floor=0.0):
    r"""Chooses the cheapest setup that meets the tolerance and the budget, if there is one.

    If nothing does, or with a budget alone, it chooses the most accurate setup within the budget, if there is one. A setup
    whose run is not usable may be chosen, because the reference judges it better; of setups that are as good, the best usable
    one is.

    Args:
        measurements: :class:`Measured`\s.
        tolerance: Largest error allowed, relative to the size of the cloth; or None.
        budget: Longest time of a frame allowed [ms], or None.
        floor: Error of the reference, by which each error may be wrong.

    Raises:
        ValueError: Neither tolerance nor budget is given, or one of them is not a number above 0.
    """
    if tolerance is None and budget is None:
        raise ValueError("tolerance, budget: give one of them, or both")
    for name, value in (("tolerance", tolerance), ("budget", budget)):
        if value is not None:
            number(name, value, above=0.0)
    known = [each for each in measurements if each.error is not None and each.milliseconds is not None]
    affordable = [each for each in known if budget is None or each.milliseconds <= budget]
    accurate = [each for each in affordable if _meets(each, tolerance, floor)]
    if accurate:
        chosen = min(accurate, key=lambda each: each.milliseconds)
        rivals = _as_cheap(chosen, accurate)
        if not chosen.usable:
            chosen = next((each for each in rivals if each.usable), chosen)
            rivals = _as_cheap(chosen, accurate)
        return Choice(chosen, True, rivals, _certainty(chosen, rivals, tolerance, floor))
    if not affordable:
        why = "nothing was measured that ended well" if not known else f"the fastest takes {_least(known):.3g} ms a frame"
        return Choice(None, False, [], f"nothing is within the budget: {why}")
    chosen = min(affordable, key=lambda each: (each.error, each.milliseconds))
    if tolerance is None:
        equal = [each for each in affordable if each.error - chosen.error <= floor]
        chosen = min(equal, key=lambda each: (not each.usable, each.error, each.milliseconds))
        rivals = [each for each in affordable if each is not chosen and abs(each.error - chosen.error) <= floor]
        known = f"its error of {percent(chosen.error)} is known to {percent(floor)} of the size"
        return Choice(chosen, True, rivals, known + _grade(chosen))
    within = "" if budget is None else " within the budget"
    known = f", and the reference is known to {percent(floor)} only" if chosen.error <= tolerance else ""
    sentence = f"nothing measured{within} meets {percent(tolerance)}; the most accurate comes to {percent(chosen.error)}{known}"
    return Choice(chosen, False, [], sentence + _grade(chosen))


def climb(ladders, measure, tolerance=None, budget=None, floor=0.0, progress=None):
    r"""Measures only the setups that :func:`pick` needs: each ladder from its cheapest rung up, all ladders in parallel.

    A ladder is a list of setups from cheap and coarse to expensive and accurate. It ends when a rung meets the tolerance,
    exceeds the budget, or costs more than a setup that meets the tolerance. ``measure`` returns :class:`Measured`\s for setups;
    ``progress`` is called with all measurements so far after each round.

    Returns:
        tuple: The :class:`Choice` and the list of all :class:`Measured`.
    """
    left, found = [list(ladder) for ladder in ladders if ladder], []
    settings = sum(map(len, left))
    while left:
        round_ = measure([ladder.pop(0) for ladder in left])
        found += round_
        if progress is not None:
            progress(found)
        meeting = [each.milliseconds for each in found if _meets(each, tolerance, floor)]
        most = min([*meeting, float("inf") if budget is None else budget])
        left = [ladder for ladder, last in zip(left, round_, strict=True) if ladder and not _ends(last, tolerance, floor, most)]
    return replace(pick(found, tolerance, budget, floor), untried=settings - len(found)), found


def climb_others(ladders, measure, tolerance=None, budget=None, floor=0.0, seconds=float("inf")):
    """Measures the ladders of solvers of other simulators: of each until its own cheapest setting is found.

    Unlike in :func:`climb`, a solver is not given up because another one is cheaper. Its search ends after ``seconds`` of
    frames.

    Returns:
        tuple: The list of all :class:`Measured`, and by solver how its search ended, a sentence.
    """
    found, ended = [], {}
    for solver, same in itertools.groupby(ladders, key=lambda ladder: ladder[0].solver):
        tried, left, late = [], [], []

        def limited(setups, tried=tried, left=left, late=late):
            """Measures setups until the time is used up; the rest end their ladders."""
            results = []
            for setup in setups:
                if sum(each.seconds for each in tried) > seconds:
                    left.append(setup)
                    results.append(Measured(setup, None, None, final=True))
                else:
                    results += measure([setup])
                    (late if results[-1].status == "left" else tried).append(results[-1])
            return results

        climb(list(same), limited, tolerance, budget, floor)
        found += tried
        spent = f"{len(tried)} settings in {sum(each.seconds for each in tried):.3g} s"
        meets = any(_meets(each, tolerance, floor) for each in tried)
        why = "other settings cost more" if meets else "finer settings take too long or are refused"
        used = f"the time of {seconds:g} s is used up" if left else "the total time is used up" if late else ""
        ended[solver] = f"{spent}; {used or why}"
    return found, ended


def ladders_of_others(setups):
    """Groups sorted setups of other simulators by solver and iterations, and doubles substeps and iterations further."""
    found = []
    for solver, group in itertools.groupby(setups, key=lambda setup: setup.solver):
        same = list(group)
        first = min(setup.options["substeps"] for setup in same)
        counts = sorted({setup.options["iterations"] for setup in same if "iterations" in setup.options})
        counts += [2**k * counts[-1] for k in range(1, _BEYOND + 1)] if counts else [None]
        for count in counts:
            options = {} if count is None else {"iterations": count}
            steps = {first * 2**k for k in range(_DOUBLINGS + 1)}
            steps |= {setup.options["substeps"] for setup in same if setup.options.get("iterations") == count}
            found.append([Setup(solver, {"substeps": substeps, **options}) for substeps in sorted(steps)])
    return found


def choose(
    scene,
    tolerance=None,
    budget=None,
    solvers=None,
    frames=None,
    device="cpu",
    dtype=None,
    limit=60.0,
    others=(),
    clock="wall",
    total=math.inf,
    announce=None,
    **run,
):
    """Measures setups of a scene until the choice is clear, on this machine or, with an executor, on its workers.

    The reference may take five times the limit of one run. If it is not known to the tolerance, nothing is measured. Runs of
    warpcloth end at three times the time of its cheapest setting that meets the tolerance.

    Args:
        scene: The :class:`warpcloth.lab.measurements.SceneRef`.
        tolerance: As for :func:`pick`.
        budget: As for :func:`pick`.
        solvers: Names of solvers, by default all.
        frames: Number of frames, by default those of the scene.
        device: A Warp device, also for the reference.
        dtype: Precision, by default that of a run with each solver.
        limit: Time limit of each run [s].
        others: Simulators whose solvers are measured too, each until its own cheapest setting is found, within six time limits;
            its own reference has as much time again.
        clock: One of :data:`warpcloth.lab.clock.CLOCKS`, for limits and times.
        total: Time on the wall [s] after which nothing more is measured; the reference, the searches of other simulators, and
            their own references may take a third each.
        announce: Function called with the :class:`Longest` before anything is measured.
        run: Arguments of :func:`warpcloth.lab.campaign.sweep`; by default with the store in the cache folder.

    Returns:
        tuple: :class:`Choice`, the list of :class:`Measured`, and the :class:`warpcloth.lab.reference.Reference`.

    Raises:
        ImportError: A simulator is not installed.
        ValueError: As for :func:`pick`, or there is no solver or simulator of a name.
    """
    began = time.perf_counter()
    pick([], tolerance, budget)  # checks the arguments before anything is measured
    number("limit", limit, above=0.0)
    if frames is not None:
        whole("frames", frames, 1)
    # One at a time, because parallel runs would slow one another.
    run = {"workers": 1} | run
    run = run if "store" in run else {"store": campaign.kept_store("trajectories", run.get("executor")), **run}
    setups = setups_of_runs(scene, solvers, device, dtype, others)
    rivals = [setup for setup in setups if simulator_of(setup.solver)]
    rungs = ladders([setup for setup in setups if not simulator_of(setup.solver)])
    if announce is not None:
        announce(Longest(limit, sum(map(len, rungs)), len({setup.solver for setup in rivals})))
    given = {"limit": min(_REFERENCE * limit, total / 3.0)} | ({} if tolerance is None else {"tolerance": tolerance / FINER})
    exact = reference(scene, frames, device=device, **given)
    if tolerance is not None and exact.error >= tolerance:
        return Choice(None, False, [], _unknown(exact, tolerance), untried=sum(map(len, rungs))), [], exact
    bound, own, meeting = SHARE * (tolerance or WITHIN), {}, []

    def measure(setups):
        if time.perf_counter() - began > total:
            return [Measured(setup, None, None, reason="not measured", final=True, status="left") for setup in setups]
        most = run_limit(limit, len(exact.points) - 1, meeting)
        tasks = [
            task(trajectory.measure, scene=scene, setup=setup, frames=frames, reference=str(exact.path), device=str(device),
                 dtype=dtype, limit=limit if simulator_of(setup.solver) else most, clock=clock,
                 **of_own(own.get(setup.solver), bound))
            for setup in setups
        ]  # fmt: skip
        found = [
            measured(setup, *each) for setup, each in zip(setups, campaign.collect(tasks, "trajectories", **run), strict=True)
        ]
        meeting.extend(each.milliseconds for each in found if _meets(each, tolerance, exact.error))
        return found

    with contextlib.ExitStack() as stack:
        if run.get("executor") is None:  # one for all rounds, because a process takes seconds to load Warp and its kernels
            run["executor"] = stack.enter_context(campaign.processes(run["workers"]))
        choice, found = climb(rungs, measure, tolerance, budget, exact.error)
        if not rivals:
            return choice, found, exact
        seconds = min(LIMITS * limit, total / 3.0 / len({setup.solver for setup in rivals}))
        given = len(exact.points) - 1, device, SHARE * bound, seconds, None, clock, began + total
        own |= own_references(scene, rivals, *given)
        more, ended = climb_others(ladders_of_others(rivals), measure, tolerance, budget, exact.error, seconds)
    found, mesh = found + more, scene.load().mesh
    facts = {name: (own_facts(own[name], exact, mesh, bound) or {}) | {"searched": why} for name, why in ended.items()}
    return replace(pick(found, tolerance, budget, exact.error), others=facts, untried=choice.untried), found, exact


def run_limit(limit, frames, meeting):
    """Returns the time limit of a run [s]: ``limit`` halved as often as leaves enough for a setting that may be chosen.

    ``meeting`` has the times of a frame of settings that meet the tolerance [ms]. Halves, so that stored measurements are found
    again where times differ a little.
    """
    if not meeting:
        return limit
    enough = _START + _DEARER * 1e-3 * min(meeting) * frames
    return limit / 2 ** max(0, math.floor(math.log2(limit / enough)))


def ladders(setups):
    """Groups setups that differ only in substeps, or in the error of steps, from cheap to expensive, and extends each group."""
    found = {}
    for setup in setups:
        fixed = {name: value for name, value in setup.options.items() if name not in ("substeps", "error")}
        step = "error" if "error" in setup.options else "substeps"
        found.setdefault((step, json.dumps([setup.solver, fixed], sort_keys=True)), []).append(setup)
    for (step, _), ladder in found.items():
        factor = 0.25 if step == "error" else 2
        ladder.sort(key=lambda setup, step=step: setup.options[step], reverse=step == "error")
        for _ in range(_MORE):
            last = ladder[-1]
            ladder.append(Setup(last.solver, last.options | {step: factor * last.options[step]}))
    return list(found.values())


def measured(setup, result, machine):
    """Returns the :class:`Measured` of a result of :func:`warpcloth.lab.trajectory.measure`."""
    spread = None if result["spread"] is None else tuple(result["spread"])
    # Only a limited solver may accept a finer step after it refused one.
    limited = setup.solver in SOLVERS and SOLVERS[setup.solver].limited
    final = result["status"] == "slow" or (result["status"] == "refused" and not limited)
    seconds = 1e-3 * (result["ms"] or 0.0) * result["frames"]
    own = result.get("own_error")
    strain, status = result["strain_error"], result["status"]
    of_run = strain, own, seconds, status, result["dtype"], result.get("grade")
    return Measured(setup, result["error"], result["ms"], spread, result["reason"], machine, final, *of_run)


def as_json(choice, found, exact):
    """Returns the choice and its reasons as JSON values."""
    rows = [asdict(each) | {"label": str(each.setup)} for each in found]
    chosen = None if choice.chosen is None else asdict(choice.chosen)
    facts = {"chosen": chosen, "meets": choice.meets, "certainty": choice.certainty, "others": choice.others}
    facts |= {"rivals": [str(each.setup) for each in choice.rivals], "untried": choice.untried}
    return facts | {"reference_error": exact.error, "reference": str(exact.path), "measured": rows}


def _ends(last, tolerance, floor, most):
    if last.final or (last.milliseconds is not None and last.milliseconds > most):
        return True
    return _meets(last, tolerance, floor)  # after divergence, a finer step may work


def _meets(each, tolerance, floor):
    return each.error is not None and tolerance is not None and each.error + floor <= tolerance


def _as_cheap(chosen, accurate):
    if chosen.spread is None:
        return []
    others = [each for each in accurate if each is not chosen and each.spread and each.spread[0] <= chosen.spread[1]]
    return sorted(others, key=lambda each: each.milliseconds)


def _certainty(chosen, rivals, tolerance, floor):
    margin = f"its error of {percent(chosen.error)} is {tolerance / max(chosen.error, 1e-30):.3g} times below the tolerance"
    known = f", known to {percent(floor)}" if floor else ""
    if not rivals:
        return f"{margin}{known}; nothing else that meets it is as cheap{_grade(chosen)}"
    names = ", ".join(f"{each.setup} ({each.milliseconds:.3g} ms)" for each in rivals[:3])
    return f"{margin}{known}; within the spread of the times as cheap: {names}{_grade(chosen)}"


def _grade(chosen):
    return "" if chosen.usable else "; without the reference its run is not usable, so 'warpcloth run' ends with exit code 1"


def _unknown(exact, tolerance):
    why = "smaller steps make it no less" if exact.limit == math.inf else f"its steps were halved for {exact.limit:g} s"
    known = f"the reference is known to {percent(exact.error)} only ({exact.method}, {exact.substeps} substeps; {why})"
    return f"{known}, so nothing can be said to meet {percent(tolerance)}"


def percent(share):
    return f"{100.0 * share:.3g}%"


def _least(known):
    return min(each.milliseconds for each in known)
