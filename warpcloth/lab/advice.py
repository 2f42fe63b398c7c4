"""Finds out which declarations of a scene matter, by leaving out or changing each and comparing result and cost."""

from dataclasses import dataclass, replace

import numpy as np

from ..base.checks import number, whole
from ..core.status import Status
from ..mesh.distances import surface_distances
from ..run.simulate import simulate
from ..terms.woven import Woven
from .clock import mean_time

# Kinds of trials that leave something out.
_LEFT_OUT = ("term", "collider", "friction", "air", "anisotropy", "all")
# If the cost of the whole scene changed by more than this between its first and last run, costs are not compared.
_STEADY = 0.25
_FRAMES = 7  # at which surfaces of other resolutions are compared


@dataclass(frozen=True)
class Trial:
    """A run of the scene with one change, compared with the unchanged scene.

    Attributes:
        kind: Left out: a "term", a "collider", the "friction" of a collider, the "air", the "anisotropy" of a term, or "all"
            that do not matter alone; or changed: "precision", "step" or "resolution".
        name: The change, such as "without QuadraticBending" or "n=64".
        change: RMS distance of the results over vertices and frames, over the longest side of the cloth; for another
            resolution, the distance between the surfaces, both ways. NaN without a result.
        cost: Time of a frame over that of the unchanged scene.
        matters: Whether the change is above the tolerance; None without a result.
        reason: Why there is no usable result, or "".
        finer: For another resolution, whether it has more vertices; else None.
        usable: Whether the run counts as usable; None without a run.
    """

    kind: str
    name: str
    change: float
    cost: float
    matters: bool | None
    reason: str = ""
    finer: bool | None = None
    usable: bool | None = None


@dataclass(frozen=True)
class Advice:
    """The result of :func:`advise`: ``trials``, ``tolerance``, and the ``status`` of the unchanged scene.

    Attributes:
        frames: Number of frames of each run.
        declared: Number of frames of the scene.
        milliseconds: Mean time of a frame of the unchanged scene without the first frame, in its first and its last run [ms].
    """

    trials: list
    frames: int
    declared: int
    milliseconds: tuple[float, float]
    tolerance: float
    status: Status

    @property
    def steady(self):
        """Whether both runs of the unchanged scene took about as long, so that costs can be compared."""
        first, last = self.milliseconds
        return abs(first - last) <= _STEADY * max(first, last)

    @property
    def sentences(self):
        found = [] if self.status.ok else [f"the scene as it is: {self.status.message}; what follows is of runs like it"]
        step = next(trial for trial in self.trials if trial.kind == "step")
        if step.matters is not False:
            found.append(
                f"half the step changes the result by {step.change:.2%}, so that what changes it by less is not told from the "
                "step; take a smaller one"
                if step.matters
                else f"half the step: {step.reason}"
            )
        needless = [trial for trial in self.trials if trial.kind in _LEFT_OUT[:-1] and trial.matters is False]
        needless = [trial for trial in needless if trial.usable or not self.status.ok]
        # A collider is left out with its friction, and a term with its anisotropy.
        inner = {trial.name.replace("the collider", "friction on") for trial in needless if trial.kind == "collider"}
        inner |= {f"without {_anisotropy(trial.name.removeprefix('without '))}" for trial in needless if trial.kind == "term"}
        needless = [trial for trial in needless if trial.name not in inner]
        together = next((trial for trial in self.trials if trial.kind == "all"), None)
        redundant = together is not None and together.matters is not False
        for trial in needless:
            saved = f", and a frame takes {trial.cost:.2f} times as long" if self.steady else ""
            leave = "" if redundant else ": leave it out"
            found.append(f"{trial.name} changes the result by {trial.change:.2%} alone{saved}{leave}")
        if redundant:
            why = f"{together.change:.2%}" if np.isfinite(together.change) else together.reason
            found.append(f"{together.name} at once: {why}; of these leave one out, and try again")
        if needless and self.frames < self.declared:
            found.append(
                f"only {self.frames} of {self.declared} frames were run: what begins to matter later is not seen; give --frames"
            )
        for trial in self.trials:
            if trial.kind == "precision" and trial.matters is False:
                found.append(f"float32 is enough: its result and that of float64 differ by {trial.change:.2%} alone")
            elif trial.kind == "precision" and trial.matters:
                found.append(f"the results of float32 and float64 differ by {trial.change:.2%}: take float64")
        finer = [trial for trial in self.trials if trial.finer]
        coarser = [trial for trial in self.trials if trial.finer is False]
        found += [f"{trial.name}: {trial.reason}" for trial in finer if trial.matters is None]
        found += [f"{trial.name} changes the result by {trial.change:.2%}: too coarse" for trial in finer if trial.matters]
        enough = [trial for trial in coarser if trial.matters is False]
        found += [f"{trial.name} is enough: it changes the result by {trial.change:.2%} alone" for trial in enough]
        return found


def advise(scene, solver, tolerance=0.01, frames=None, resolutions=None, device="cpu", dtype=None, progress=None):
    """Leaves out each term, each collider and its friction, and the air in turn, makes terms of fabrics isotropic, and changes
    precision, step and resolution.

    Each change is compared with the unchanged scene in a short run. Runs that are not usable are compared too. If that of the
    scene is usable, and one without a part is not, the part is not called needless.

    Args:
        scene: The :class:`warpcloth.Scene`.
        solver: The record of a solver, with its step.
        tolerance: Change of the result below which something does not matter, as a fraction of the longest side of the cloth.
        frames: Number of frames; by default those of the scene, but at most 30.
        resolutions: The scene with coarser or finer meshes by name, such as {"n=16": scene}.
        device: A Warp device.
        dtype: Precision, by default that of a run; the other precision is a trial.
        progress: Function called with (trials done, trials) after each.

    Raises:
        ValueError: An option is not allowed, or the unchanged scene diverges.
    """
    number("tolerance", tolerance, above=0.0)
    frames = min(scene.frames, 30) if frames is None else frames
    whole("frames", frames, least=1)
    dtype = solver.precision_on(device, dtype)

    def run(changed, solver=solver, dtype=dtype):
        found = simulate(changed, solver, device=device, dtype=dtype, frames=frames)
        times = found.timings["frames"]
        return found, 1e3 * mean_time(times[1:] if len(times) > 1 else times)

    base, first = run(scene)
    if not base.status.complete:
        raise ValueError(f"{scene.name} as it is: {base.status.message}; advice needs a run that does not diverge")
    size = float(np.ptp(scene.mesh.points, axis=0).max())
    other = "float64" if dtype == "float32" else "float32"
    if getattr(solver, "error", None) is None:
        finer = replace(solver, dt=None, substeps=2 * solver.per_frame(scene.fps))
        step = f"substeps={finer.substeps}"
    else:
        finer = replace(solver, error=0.5 * solver.error)
        step = f"error={finer.error:g}"
    parts = _parts(scene)
    plans = [
        *((kind, f"without {name}", {"changed": _without(scene, [(kind, k)])}) for (kind, k), name in parts.items()),
        ("precision", other, {"changed": scene, "dtype": other}),
        ("step", step, {"changed": scene, "solver": finer}),
        *(("resolution", name, {"changed": changed}) for name, changed in (resolutions or {}).items()),
    ]
    trials = []
    for done, (kind, name, options) in enumerate(plans, 1):
        trials.append(_trial(kind, name, options, run, base, first, scene, size, tolerance, device))
        if progress is not None:
            progress(done, len(plans))
        if done == len(parts):
            # If two parts can replace one another, leaving out either alone changes nothing.
            needless = [part for part, trial in zip(parts, trials, strict=True) if trial.matters is False]
            of_whole = {"friction": "collider", "anisotropy": "term"}
            needless = [(kind, k) for kind, k in needless if (of_whole.get(kind), k) not in needless]
            if len(needless) > 1:
                without = {"changed": _without(scene, needless)}
                *most, last = (parts[part] for part in needless)
                name = f"without {', '.join(most)} and {last}"
                trials.append(_trial("all", name, without, run, base, first, scene, size, tolerance, device))
    return Advice(trials, frames, scene.frames, (first, run(scene)[1]), tolerance, base.status)


def _parts(scene):
    """Returns names of all that can be left out, by (kind, index); the only term cannot."""
    terms, colliders = _names(scene.terms), _names(scene.colliders)
    found = {("term", k): name for k, name in enumerate(terms) if len(terms) > 1}
    for k, (collider, name) in enumerate(zip(scene.colliders, colliders, strict=True)):
        found["collider", k] = f"the collider {name}"
        if collider.friction:
            found["friction", k] = f"friction on {name}"
    if scene.air is not None:
        found["air", 0] = "the air"
    for k, (term, name) in enumerate(zip(scene.terms, terms, strict=True)):
        if isinstance(term, Woven) and term.anisotropic:
            found["anisotropy", k] = _anisotropy(name)
    return found


def _anisotropy(term):
    return f"the anisotropy of {term}"


def _names(declared):
    labels = [each.label for each in declared]
    counted = [(label, labels[:k].count(label) + 1, labels.count(label)) for k, label in enumerate(labels)]
    return [f"{label} {k} of {count}" if count > 1 else label for label, k, count in counted]


def _without(scene, parts):
    terms = [
        term.isotropic() if ("anisotropy", k) in parts else term
        for k, term in enumerate(scene.terms)
        if ("term", k) not in parts
    ]
    colliders = [
        replace(collider, friction=0.0) if ("friction", k) in parts else collider
        for k, collider in enumerate(scene.colliders)
        if ("collider", k) not in parts
    ]
    air = None if ("air", 0) in parts else scene.air
    return replace(scene, terms=terms, colliders=colliders, contact=scene.contact if colliders else None, air=air)


def _trial(kind, name, options, run, base, first, scene, size, tolerance, device):
    finer = len(options["changed"].mesh.points) > len(scene.mesh.points) if kind == "resolution" else None
    try:
        found, milliseconds = run(**options)
    except ValueError as error:
        return Trial(kind, name, np.nan, np.nan, None, str(error), finer)
    cost, usable = milliseconds / first, found.status.ok
    if not found.status.complete:
        if kind not in _LEFT_OUT:
            return Trial(kind, name, np.nan, cost, None, found.status.message, finer, usable)
        # Such as a term that holds the cloth together.
        return Trial(kind, name, np.inf, cost, True, found.status.message, usable=usable)
    if kind == "resolution":
        if not (len(scene.mesh.triangles) and len(options["changed"].mesh.triangles)):
            return Trial(kind, name, np.nan, cost, None, "the mesh has edges alone, and no surface to compare", finer, usable)
        change = _surface_change(base, scene, found, options["changed"], device)
    else:
        between = np.asarray(found.points, dtype=np.float64) - np.asarray(base.points, dtype=np.float64)
        change = float(np.sqrt((between**2).sum(axis=2).mean()))
    reason = "" if usable else found.status.message
    return Trial(kind, name, change / size, cost, bool(change / size > tolerance), reason, finer, usable)


def _surface_change(one, first, other, second, device):
    """Returns the RMS distance [m] between two surfaces, from the vertices of each, over some frames."""
    frames = np.unique(np.linspace(0, len(one.points) - 1, _FRAMES).round().astype(int))
    squares = []
    for frame in frames.tolist():
        a, b = (np.asarray(found.points[frame], dtype=np.float64) for found in (one, other))
        for points, x, mesh in ((a, b, second.mesh), (b, a, first.mesh)):
            squares.append((surface_distances(points, x, mesh.triangles, device) ** 2).mean())
    return float(np.sqrt(np.mean(squares)))
