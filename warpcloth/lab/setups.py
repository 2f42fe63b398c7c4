"""Settings that charts compare: those that minimise one step, and those of runs, which trade speed for accuracy."""

from ..others.simulators import SIMULATORS, check_installed, shown_name
from ..solvers import SOLVERS, Explicit
from ..solvers.step import fewest_substeps
from .measurements import Setup

# Tolerances of :attr:`warpcloth.solvers.facts.Facts.one_step` are below this.
_NEVER = 1e-6


def setups_of_steps(solvers=None):
    """Returns the :class:`Setup`\\s that minimise one step, of all solvers or of those named.

    Raises:
        ValueError: A name is not that of a solver that minimises.
    """
    names = _checked(solvers, [name for name, record in SOLVERS.items() if record.facts.one_step])
    return [Setup(name, options) for name in names for options in SOLVERS[name].facts.one_step]


def setups_of_runs(scene, solvers=None, device="cpu", dtype=None, others=()):
    r"""Returns the :class:`Setup`\s of runs of a :class:`SceneRef`, of all solvers or of those named, each once.

    Those of ``others``, simulators, come last. Steps do not depend on the frame rate of the scene, unless they would be longer
    than a frame. The substeps of a limited solver are multiples of its fewest stable substeps on a device.

    Raises:
        ImportError: A simulator is not installed.
        ValueError: There is no solver or simulator of a name.
    """
    setups, fps = [], None
    runs = {name: SOLVERS[name].facts.runs for name in _checked(solvers, list(SOLVERS))}
    others = _checked(others, list(SIMULATORS))
    check_installed(others)
    for other in others:
        runs |= {name: solver.runs for name, solver in SIMULATORS[other].solvers.items()}
    for name, each in runs.items():
        record = SOLVERS.get(name, Explicit)
        fewest = _fewest(record, scene, device, dtype) if record.limited else None
        for options in each:
            if "fewest" in options:
                factor, options = options["fewest"], {key: value for key, value in options.items() if key != "fewest"}
                substeps = round(factor * fewest)
            elif "substeps" in options:
                fps = fps or scene.load().fps
                substeps = max(round(options["substeps"] * 60.0 / fps), 1)
            else:  # steps by error
                setups.append(Setup(name, options))
                continue
            setups.append(Setup(name, options | {"substeps": substeps}))
    return list({str(setup): setup for setup in setups}.values())


def precisions(setups, device, dtype=None):
    """Returns the precisions of the runs of setups, such as "float32 and float64"."""
    return " and ".join(sorted({setup.precision_on(device, dtype) for setup in setups}))


def label(setup):
    """Returns a setup in a few words, such as "xpbd bdf2 80×1", without tolerances that never end a step."""
    options = dict(setup.options)
    if options.get("tolerance", 1.0) < _NEVER:
        del options["tolerance"]
    count = "×".join(str(options.pop(name)) for name in ("substeps", "iterations") if name in options)
    integrator = options.pop("integrator", "")
    others = (f"{name}={value:g}" if isinstance(value, float) else str(value) for name, value in options.items())
    return " ".join(filter(None, (shown_name(setup.solver), integrator, count, *others)))


def grid_in_words(options):
    """Returns options of settings in words: the substeps for each number of iterations."""
    found = {}
    for each in options:
        found.setdefault(each.get("iterations", 0), set()).add(each["substeps"])
    return "; ".join(
        ", ".join(map(str, sorted(steps))) + (f" × {count}" if count else "") for count, steps in sorted(found.items())
    )


def _checked(names, known):
    names = known if names is None else list(dict.fromkeys(names))
    for name in names:
        if name not in known:
            raise ValueError(f"solvers has {name!r}; this diagram takes {', '.join(known)}")
    return names


def _fewest(record, scene, device, dtype):
    """Returns the fewest stable substeps; 1 with hard constraints, which a limited solver refuses."""
    declared, dtype = scene.load(), record.precision_on(device, dtype)
    try:
        return fewest_substeps(declared.fps, *record.step_limits(declared.build(device=device, dtype=dtype)))
    except ValueError:
        return 1
