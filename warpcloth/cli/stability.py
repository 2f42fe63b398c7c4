"""The command ``chart stability``: a map of stability over two axes for each method."""

from collections import Counter

from ..base.checks import did_you_mean, number, whole
from ..base.quiet import find_device
from ..base.texts import assignments, convert, json_text, options
from ..lab.axes import ACCURACY, AXES, FIXED, SEED
from .options import DOUBLE, add_cloth, add_scene, add_shared, values_of
from .setup import scene_ref
from .terminal import check_outputs, measuring

_COUNT = 9


def _axes():
    """Returns lines of help on the axes."""
    width = max(map(len, AXES))
    return "\n".join(f"  {name:<{width}}   {axis.low:g} to {axis.high:g}: {axis.label}" for name, axis in AXES.items())


EPILOG = f"""\
Axes, with their default ranges of {_COUNT} values:
{_axes()}
Resolution is the parameter of the scene that sets it: n, links or elements.

All runs are compared over the same simulated time. A run with a large step continues until it has taken --steps steps, to
show whether it diverges. Runs with small steps cost the most. The error is the RMS distance to a reference over vertices and
frames, divided by the size of the cloth. The reference is Newton's method with BDF2 in float64, with steps of a quarter of the
size, but at most 2000 of them. Verdicts:
  stable       the run ended well, and its error is within --accuracy, even with the uncertainty of the reference added
  inaccurate   the error exceeds --accuracy, even with the uncertainty of the reference subtracted
  unsure       the reference failed, or is too uncertain to tell stable from inaccurate
  stalled      a step could not be finished: no lower energy, a saddle point, or contradictory constraints
  diverged     the run broke a bound on its energy or strain, see docs/stability.md
  refused      the solver does not take the scene or the setting
  slow         the run took longer than --limit
With hard constraints and with --accuracy 0 no errors are measured, and a run that ended well is stable. Measured rows are
stored and reused.

  warpcloth chart stability hanging -p n=8 --x stiffness --y dt -o map.png
  warpcloth chart stability net -p n=12 stiffness=inf --x resolution --y relaxation --solvers pbd:sweep=jacobi -o jacobi.png
"""


def add_arguments(parser):
    """Adds the arguments of this chart, without those of all charts."""
    add_scene(parser)
    add_cloth(parser)
    for of in "xy":
        parser.add_argument(f"--{of}", required=True, choices=AXES, metavar="AXIS", help=f"quantity on the {of} axis")
        text = (
            "lowest value, highest value and number of values, spaced logarithmically (compression: evenly; "
            "default: depends on the axis, see 'warpcloth chart stability --help')"
        )
        parser.add_argument(f"--{of}-range", nargs=3, metavar=("LOW", "HIGH", "N"), help=text)
    text = "values of axes that are not drawn, such as dt=1/60"
    parser.add_argument("--at", nargs="+", action="extend", default=[], metavar="axis=value", help=text)
    text = "solvers, each with options if wanted, such as xpbd:sweep=sequential,iterations=5 (default: all)"
    parser.add_argument("--solvers", nargs="+", metavar="SOLVER", help=text)
    parser.add_argument(
        "--duration", type=float, metavar="SECONDS", help="simulated time that is compared (default: half of the scene's)"
    )
    parser.add_argument(
        "--steps", type=int, default=120, metavar="N", help="minimum number of steps of each run (default: 120)"
    )
    text = f"runs with a larger error are inaccurate (default: {ACCURACY:g}); 0 measures no errors"
    parser.add_argument("--accuracy", type=float, default=ACCURACY, metavar="SHARE", help=text)
    parser.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help="time limit of each run (default: 60)")
    add_shared(parser, "dtype", dtype=DOUBLE)


def chart(arguments):
    from ..lab.campaign import kept_store, sweep
    from ..lab.machine import machine
    from ..lab.stability import VERDICTS

    check_outputs(arguments, [arguments.scene])
    device = find_device(arguments.device)
    survey = _survey(arguments)
    number("limit", arguments.limit, above=0.0)
    number("accuracy", arguments.accuracy, least=0.0)
    given = {"device": str(device), **values_of(arguments, "dtype", "limit", "accuracy")}
    tasks = survey.tasks(reference=arguments.accuracy > 0.0, **given)
    with measuring(arguments, device) as run:
        store = kept_store("stability")
        cells = survey.table(sweep(tasks, store=store, **run), store)
    if arguments.output or arguments.csv:
        from ..chart.maps import plot_maps, write_csv

        if arguments.csv:
            write_csv(arguments.csv, survey, cells)
        if arguments.output:
            plot_maps(arguments.output, survey, cells, arguments.accuracy, machine(device))
    methods = [str(setup) for setup in survey.setups]
    if arguments.json:
        axes = {survey.x: survey.xs, survey.y: survey.ys}
        fixed = {name: value for name, value in {**FIXED, **survey.fixed}.items() if name not in axes}
        facts = {"scene": str(survey.scene), "x": survey.x, "y": survey.y, "axes": axes, "fixed": fixed, "steps": survey.steps}
        facts["duration"] = survey.duration
        facts |= {**given, "seed": SEED, "machine": machine(device), "maps": dict(zip(methods, cells, strict=True))}
        print(json_text(facts))
        return 0
    for method, rows in zip(methods, cells, strict=True):
        counts = Counter(cell["verdict"] for row in rows for cell in row)
        print(f"{method}: " + ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict]))
        if counts["refused"]:
            print("  refused: " + next(cell["reason"] for row in rows for cell in row if cell["verdict"] == "refused"))
    return 0


def _survey(arguments):
    """Returns the :class:`Survey` of the arguments."""
    from ..lab.measurements import Setup
    from ..lab.stability import Survey
    from ..solvers import SOLVERS

    setups = []
    for text in arguments.solvers or SOLVERS:
        name, _, given = text.partition(":")
        if name not in SOLVERS:
            raise ValueError(f"solver is {name!r}; it must be one of {', '.join(SOLVERS)}{did_you_mean(name, SOLVERS)}")
        setups.append(Setup(name, options(SOLVERS[name], assignments(given.split(",") if given else []))))
    if len({str(setup) for setup in setups}) < len(setups):
        raise ValueError("a method stands twice after --solvers; each must be another")
    whole("steps", arguments.steps, 1)
    fixed = {}
    for name, text in assignments(arguments.at).items():
        if name not in AXES:
            raise ValueError(f"--at has no axis {name!r}; allowed are {', '.join(AXES)}")
        fixed[name] = convert(name, text, (int,) if AXES[name].whole else (float,))
    values = [_values(of, getattr(arguments, of), getattr(arguments, f"{of}_range")) for of in "xy"]
    scene = scene_ref(arguments)
    return Survey(
        scene, tuple(setups), arguments.x, arguments.y, *map(tuple, values), fixed, arguments.steps, arguments.duration
    )


def _values(of, name, texts):
    axis = AXES[name]
    low, high, count = texts or (str(axis.low), str(axis.high), str(_COUNT))
    ends = [convert(f"--{of}-range", text, (float,)) for text in (low, high)]
    return axis.values(*ends, convert(f"--{of}-range", count, (int,)))
