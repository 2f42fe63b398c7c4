"""What charts compare, as data: methods that minimise one step, and of each solver settings that trade speed for accuracy."""

from ..solvers.explicit import fewest_substeps, step_limits
from .measurements import Setup

# Who minimises a step of implicit Euler, without step and iterations; of those that have a tolerance none ends by it.
_TO_THE_END = {"tolerance": 1e-14}
STEPS = (
    Setup("newton", _TO_THE_END),
    *(
        Setup("projective-dynamics", {"acceleration": acceleration, **_TO_THE_END})
        for acceleration in ("none", "chebyshev", "anderson", "l-bfgs")
    ),
    *(Setup("admm", {**weight, **_TO_THE_END}) for weight in ({}, {"weight": 1.0})),
    Setup("xpbd"),
    Setup("xpbd", {"sweep": "constraint-averaged"}),
    # Its linear systems are solved to a tenth of the tolerance, and none better than that costs less.
    *(
        Setup("constrained-dynamics", {"stabilisation": stabilisation, "tolerance": 1e-8})
        for stabilisation in ("geometric-stiffness", "line-search")
    ),
)


def _grid(settings, **options):
    """Options for each (substeps, iterations)."""
    return [{"substeps": substeps, "iterations": iterations, **options} for substeps, iterations in settings]


# About what no other setting of the same solver beats in both error and time on ``hanging`` with 32² and 64² vertices, and
# around it; implicit Euler by Newton; and what takes hard constraints. Substeps are of frames of 1/60 s, those of explicit
# multiples of the fewest stable ones.
RUNS = {
    "explicit": [{"fewest": factor} for factor in (1.0, 1.5, 2.0)],
    "newton": [
        *({"substeps": substeps} for substeps in (1, 4, 16)),
        *({"substeps": substeps, "integrator": "bdf2"} for substeps in (1, 2, 4, 8)),
        *({"substeps": substeps, "integrator": "midpoint"} for substeps in (4, 8)),
    ],
    "projective-dynamics": [
        *_grid([(8, 2), (16, 2), (24, 2), (48, 2), (96, 2)], integrator="midpoint", acceleration="none"),
        *_grid([(8, 5), (16, 5)], integrator="bdf2"),
        *_grid([(4, 20)]),
    ],
    "admm": [*_grid([(16, 2), (32, 2), (48, 2)], integrator="midpoint"), *_grid([(4, 20), (8, 20)], integrator="bdf2")],
    "pbd": _grid([(30, 1), (60, 1), (120, 1), (240, 1)], stiffness="per-step"),
    "hierarchical-pbd": _grid([(8, 2), (15, 2), (30, 2), (60, 2), (120, 2)]),
    "xpbd": [
        *_grid([(10, 4), (20, 2), (20, 4), (40, 1), (80, 1), (160, 1)], integrator="bdf2"),
        *_grid([(40, 2)], integrator="midpoint"),
        *_grid([(80, 1), (160, 1)]),
    ],
    "constrained-dynamics": [
        *_grid([(4, 1), (8, 1), (16, 1), (32, 1)], integrator="midpoint"),
        *_grid([(4, 1)], integrator="bdf2"),
        *_grid([(4, 1), (16, 1)]),
    ],
}


def setups_of_steps(solvers=None):
    """The :class:`Setup`\\s of :data:`STEPS`, or those of the solvers named.

    Raises:
        ValueError: A name is none of a method that minimises.
    """
    known = list(dict.fromkeys(setup.solver for setup in STEPS))
    names = _checked(solvers, known)
    return [setup for setup in STEPS if setup.solver in names]


def setups_of_runs(scene, solvers=None, device="cpu", dtype="float32"):
    """The :class:`Setup`\\s of :data:`RUNS`, or those of the solvers named, each once.

    Their steps are as long whatever the frame rate of the scene, a :class:`SceneRef`, if they are not longer than a frame; the
    substeps of explicit are multiples of its fewest stable ones on a device.

    Raises:
        ValueError: A name is no solver's.
    """
    names = _checked(solvers, list(RUNS))
    setups, fewest, fps = [], None, scene.load().fps
    for name in names:
        for options in RUNS[name]:
            if "fewest" in options:
                fewest = fewest or _fewest(scene, device, dtype)
                options = {"substeps": round(options["fewest"] * fewest)}
            else:
                options = options | {"substeps": max(round(options["substeps"] * 60.0 / fps), 1)}
            setups.append(Setup(name, options))
    return list({str(setup): setup for setup in setups}.values())


def label(setup):
    """A setup in few words, such as "xpbd bdf2 80×1"."""
    options = dict(setup.options)
    options.pop("tolerance", None)
    count = "×".join(str(options.pop(name)) for name in ("substeps", "iterations") if name in options)
    integrator = options.pop("integrator", "")
    others = (f"{name}={value:g}" if isinstance(value, float) else str(value) for name, value in options.items())
    return " ".join(filter(None, (setup.solver, integrator, count, *others)))


def _checked(names, known):
    names = known if names is None else list(dict.fromkeys(names))
    for name in names:
        if name not in known:
            raise ValueError(f"solvers has {name!r}; this diagram takes {', '.join(known)}")
    return names


def _fewest(scene, device, dtype):
    """The fewest stable substeps of explicit; 1 where hard constraints leave none, which is refused then."""
    declared = scene.load()
    try:
        return fewest_substeps(declared.fps, *step_limits(declared.build(device=device, dtype=dtype)))
    except ValueError:
        return 1
