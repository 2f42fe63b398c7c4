"""The command ``chart``: pictures and tables of measurements of many settings. Each chart is a subcommand."""

import sys
from collections import Counter
from functools import partial

from ..base.checks import number, whole
from ..base.quiet import find_device
from ..base.texts import assignments, fraction, json_text
from ..picture.figures import PICTURES
from ..run.listing import list_failures
from . import stability
from .options import HelpFormatter, add_cloth, add_import, add_scene, add_shared, add_with, solvers, values_of
from .setup import named_scene, scene_ref
from .terminal import check_outputs, measuring

TEXT = "Draw charts of accuracy against time, of stability, and of failures."
NOT_USABLE = ", not usable"
DIAGRAMS = ("time", "solver", "physics", "spectrum")

EPILOG = """\
Diagrams:
  time       error against compute time per simulated second, for many settings of every solver; the error is the RMS
             distance over vertices and frames to a reference solution of the same mesh
  solver     convergence within one step, for solvers that minimise an objective: how far it is above its minimum, relative
             to the start of the step, against iterations and time
  physics    error of equilibria relative to closed forms, against mesh size and time; for the scenes cantilever (on four
             mesh patterns, straight and rotated), chain and catenary
  spectrum   measured error of each iteration of projective dynamics, and the error that the eigenvalues of its iteration
             matrix predict; for small meshes
Settings that diverge, are refused or take too long are listed with the reason.

Measurements are stored in WARPCLOTH_CACHE, or ~/.cache/warpcloth, and reused while the code is the same; after an
interruption the same command continues. Several processes measure at the same time, one thread each, so compare times only
within a chart.

  warpcloth chart work-precision hanging -p n=16 --solvers newton xpbd -o chart.png --csv chart.csv
"""

CHEAPEST_EPILOG = """\
Each cell of the map is a scene with a value of each of the two parameters. It shows the cheapest solver and settings with at
most the error of --tolerance, the time of a frame, and the second best solver with the ratio of times. The search is that of
'warpcloth choose', and goes on up to four times the cheapest. A cell in which nothing is accurate within --limit says so, and
so does one whose reference solution is not accurate enough.

Cells are stored and reused while the code, the scene and the machine are the same; after an interruption the same command
continues. They are measured one after another, unless --workers says otherwise.

  warpcloth chart cheapest hanging --x n 16 32 64 --y stiffness 1e3 1e4 1e5 1e6 --frames 15 -o map.png --csv map.csv
"""

FAILURE_EPILOG = """\
Failures:
  locking      cloth on irregular meshes that is too stiff to bend
  isometry     quadratic bending of cloth that stretches, or is curved at rest
  slivers      gradient and largest explicit step of thin triangles and of hinges folded flat
  cotangents   deformation with negative cotangent weights
  rank         rotations fitted to points in a plane, on a line or at one position
  tunnelling   fast cloth against a thin collider, with and without the filter of contact
  friction     cloth on slopes: where it sticks, creeps and slides
  crossing     sheets that fly at each other, with and without the filter of self-contact
In the chart, points are measured and lines are closed forms. Measurements are stored and reused.

  warpcloth chart failure slivers -o slivers.png --csv slivers.csv
"""


def add_arguments(parser):
    """Adds the commands of all charts."""
    parser.set_defaults(command=lambda arguments: parser.print_help(sys.stderr) or 2, debug=False)
    charts = parser.add_subparsers(title="charts", metavar="CHART")
    _add_work_precision(charts)
    _add_cheapest(charts)
    _add_failure(charts)
    text = "Map where solvers are stable, are inaccurate, or diverge."
    stability.add_arguments(add(charts, "stability", stability.chart, text, stability.EPILOG))


def add(charts, name, command, text, epilog):
    """Adds the subcommand of a chart with the arguments of all charts, and returns its parser."""
    form = {"formatter_class": HelpFormatter, "allow_abbrev": False}
    sub = charts.add_parser(name, help=text, description=text, epilog=epilog, **form)
    sub.set_defaults(command=command)
    add_shared(sub, "device")
    sub.add_argument("--workers", type=int, metavar="N", help="number of processes (default: one per core, or one on a GPU)")
    sub.add_argument("-o", "--output", metavar="FILE", help=f"draw the chart ({', '.join(PICTURES)})")
    sub.add_argument("--csv", metavar="FILE", help="write the measurements as a table")
    add_shared(sub, "json", "debug")
    add_import(sub)
    return sub


def _add_work_precision(charts):
    sub = add(charts, "work-precision", work_precision, "Chart the error of solvers against their compute time.", EPILOG)
    add_scene(sub)
    add_cloth(sub)
    sub.add_argument("--diagram", choices=DIAGRAMS, default="time", help="diagram to measure (default: time)")
    sub.add_argument(
        "--solvers", nargs="+", metavar="SOLVER", choices=solvers(), help="measure only these solvers (default: all)"
    )
    add_with(sub)
    text = "draw every setting of the diagram time, not each solver's best ones alone"
    sub.add_argument("--every-setting", action="store_true", help=text)
    text = (
        "frames to simulate (default: half of the scene's); for the diagrams solver and spectrum, frames to simulate "
        "before the step that is measured (default: a third)"
    )
    sub.add_argument("--frames", type=int, metavar="N", help=text)
    text = "precision (default: by device and solver for the diagram time, else float64)"
    add_shared(sub, "dtype", dtype={"help": text})
    text = "time limit of each setting (default: 20); a reference may take six times as long"
    sub.add_argument("--limit", type=float, default=20.0, metavar="SECONDS", help=text)


def _add_cheapest(charts):
    text = "Map which solver and settings are the cheapest that meet a tolerance, over two parameters of a scene."
    sub = add(charts, "cheapest", map_cheapest, text, CHEAPEST_EPILOG)
    add_scene(sub)
    add_cloth(sub)
    for of, needed in (("x", True), ("y", False)):
        text = f"parameter of the scene on the {of} axis and its values" + ("" if needed else " (default: a map of one row)")
        sub.add_argument(f"--{of}", nargs="+", required=needed, metavar=("PARAMETER", "VALUE"), help=text)
    text = "largest error allowed, as a share of the size of the cloth (default: 1%%)"
    sub.add_argument("--tolerance", default="1%", metavar="SHARE", help=text)
    sub.add_argument("--solvers", nargs="+", metavar="SOLVER", choices=solvers(), help="solvers to choose among (default: all)")
    sub.add_argument(
        "--frames", type=int, metavar="N", help="number of frames to simulate (default: those of the scene's duration)"
    )
    add_shared(sub, "dtype")
    text = "time limit of the search in each cell (default: 60); a reference may take six times as long"
    sub.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help=text)


def _add_failure(charts):
    names = list_failures()
    sub = add(
        charts,
        "failure",
        failure,
        "Chart known failures of energies, edge weights, fitted rotations and contact, and what theory predicts.",
        FAILURE_EPILOG,
    )
    sub.add_argument("failure", metavar="FAILURE", choices=names, help=f"the failure: one of {', '.join(names)}")


def map_cheapest(arguments):
    from ..chart.cheapest import plot_cheapest
    from ..lab.cheapest import cheapest_map, write_csv

    if arguments.frames is not None:
        whole("frames", arguments.frames, least=1)
    check_outputs(arguments, [arguments.scene])
    device = find_device(arguments.device)
    axes = {of: _axis(of, getattr(arguments, of)) for of in "xy"}
    scene = scene_ref(arguments)
    with measuring(arguments, device) as run:
        run["workers"] = arguments.workers or 1
        found = cheapest_map(
            scene,
            **axes,
            tolerance=fraction("tolerance", arguments.tolerance),
            device=str(device),
            **values_of(arguments, "solvers", "frames", "dtype", "limit"),
            **run,
        )
    return _write(arguments, found, plot_cheapest, write_csv, _cheapest_summary)


def _axis(of, words):
    """Returns the name of a parameter and its values.

    Raises:
        ValueError: There is no value.
    """
    if words is None:
        return None
    name, *values = words
    if not values:
        raise ValueError(f"--{of} has {name!r} alone; it must be a parameter of the scene and one value or more")
    return name, values


def _cheapest_summary(found):
    """Returns a line for each cell."""
    from ..lab.choosing import percent
    from ..lab.measurements import usable

    lines = [f"{found['scene']}: cheapest within {percent(found['tolerance'])}", f"  device   {found['machine']['device']}"]
    for cell in found["cells"]:
        at = ", ".join(f"{axis[0]}={cell[of]}" for of, axis in (("x", found["x"]), ("y", found["y"])) if axis)
        if cell["status"] != "found":
            lines.append(f"  {at}: {cell['reason']}")
            continue
        second, known = cell["second"], percent(cell["reference_error"])
        text = f"{cell['label']}, {cell['ms']:.3g} ms, error {percent(cell['error'])} (reference {known})"
        text += NOT_USABLE if not usable(cell) else ""
        text += f"; second {second['label']}, {second['ratio']:.3g} times" if second else "; no second within the search"
        text += NOT_USABLE if second and not usable(second) else ""
        lines.append(f"  {at}: {text}" + ("" if cell["complete"] else "; the search was not complete"))
    lines += [f"  measured on {name}" for name in dict.fromkeys(cell["machine"] for cell in found["cells"])]
    return "\n".join(lines)


def failure(arguments):
    from ..chart.failures import plot_failure
    from ..lab.failures import failure_chart, write_csv

    check_outputs(arguments)
    device = find_device(arguments.device)
    with measuring(arguments, device) as run:
        found = failure_chart(arguments.failure, device=str(device), **run)
    return _write(arguments, found, plot_failure, write_csv, _failure_summary)


def _write(arguments, found, plot, write_csv, summary):
    """Draws and writes a chart as the arguments ask for, and prints it; returns the exit code."""
    if arguments.output:
        plot(arguments.output, found)
    if arguments.csv:
        write_csv(arguments.csv, found)
    print(json_text(found) if arguments.json else summary(found))
    return 0


def _failure_summary(found):
    """Returns a summary: for each panel the number of points and the largest distance to their law, and missing values."""
    lines = [found["title"], f"  device        {found['machine']['device']}"]
    for key, panel in found["panels"].items():
        points = [row for row in found["rows"] if row["panel"] == key]
        followed = [row for row in points if row["expected"] is not None and row["value"] is not None]
        size = max((abs(row["expected"]) for row in followed), default=0.0)
        # Relative to the law; where that is 0 up to rounding, to its largest value.
        scales = [each if each > 1e-9 * size else size or 1.0 for each in (abs(row["expected"]) for row in followed)]
        apart = [abs(row["value"] - row["expected"]) / scale for row, scale in zip(followed, scales, strict=True)]
        met = f", {len(followed)} of them off their law by {max(apart):.1e} at most" if followed else ""
        if "value" in panel:  # a map
            met = "".join(f", {count} {series}" for series, count in Counter(row["series"] for row in points).items())
        lines.append(f"  {key:<13} {len(points)} points{met}: {panel['title']}")
    lines += [f"  no value      {row['series']}, {row['x']:.3g}: {row['reason']}" for row in found["rows"] if row["reason"]]
    return "\n".join(dict.fromkeys(lines))


def work_precision(arguments):
    from ..lab.measurements import SceneRef
    from ..lab.work_precision import write_csv

    if arguments.frames is not None:
        whole("frames", arguments.frames, least=1)
    number("limit", arguments.limit, above=0.0)
    check_outputs(arguments, [arguments.scene])
    device = find_device(arguments.device)
    _source, values, _scene = named_scene(arguments)
    given = {name: values[name] for name in assignments(arguments.p)}
    if arguments.others and arguments.diagram != "time":
        raise ValueError(f"--with is for the diagram time, not for {arguments.diagram}")
    chosen = values_of(arguments, "solvers", "frames", "dtype", "others")
    options = {name: value for name, value in chosen.items() if value is not None}
    if arguments.diagram == "physics" and (set(options) & {"solvers", "frames"}):
        raise ValueError("the diagram physics is of equilibria; --solvers and --frames are for the others")
    if arguments.every_setting and arguments.diagram != "time":
        raise ValueError(f"--every-setting is for the diagram time, not {arguments.diagram}")
    if arguments.diagram == "spectrum" and (set(options) & {"solvers", "dtype"}):
        raise ValueError("the diagram spectrum is of projective dynamics in float64; --solvers and --dtype are for the others")
    measure, plot, lines = _parts(arguments.diagram)
    with measuring(arguments, device) as run:
        watch = {"watch": run["progress"].watch} if arguments.diagram == "time" else {}
        scene = SceneRef(arguments.scene, given, arguments.pins)
        found = measure(scene, device=str(device), limit=arguments.limit, **watch, **run, **options)
    plot = partial(plot, every=True) if arguments.every_setting else plot
    return _write(arguments, found, plot, write_csv, partial(_summary, lines_of=lines))


def _parts(diagram):
    """Returns the functions that measure, draw and summarise a diagram."""
    from ..chart import pareto
    from ..lab import work_precision as measured

    return {
        "time": (measured.time_diagram, pareto.plot_time, _time_lines),
        "solver": (measured.solver_diagram, pareto.plot_solver, _solver_lines),
        "physics": (measured.physics_diagram, _plot_physics, _physics_lines),
        "spectrum": (measured.spectrum_diagram, pareto.plot_spectrum, _spectrum_lines),
    }[diagram]


def _plot_physics(path, found):
    from ..chart.closed_forms import plot_physics

    plot_physics(path, [(row["arguments"], row) for row in found["rows"]], found["machine"])


def _physics_lines(found):
    """Returns lines with the error of each point."""
    known = [row for row in found["rows"] if row["error"] is not None]
    return [f"  error         {100.0 * row['error']:.3g} %, {row['ms'] or 0.0:.3g} ms: {row['label']}" for row in known]


def _summary(found, lines_of):
    from ..lab.measurements import usable
    from ..lab.work_precision import without_point

    rows, device = found["rows"], found["machine"]["device"]
    counts = {status: sum(row["status"] == status for row in rows) for status in ("ok", "diverged", "slow", "refused")}
    said = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    doubted = sum(row["status"] == "ok" and not usable(row) for row in rows)
    said += f"; {doubted} of the ok are not usable" if doubted else ""
    lines = [f"{found['scene']}: {len(rows)} settings, {said}", f"  device        {device}, {found['dtype']}"]
    lines += [f"  measured on   {count} {name}" for name, count in Counter(row["machine"] for row in rows).items()]
    lines += lines_of(found)
    for label, why in without_point(found):
        status, _, reason = why.partition(": ")
        lines.append(f"  {status:<12}  {label}: {reason}")
    return "\n".join(lines)


def _time_lines(found):
    """Returns lines with the Pareto front, and the cheapest setting of each solver."""
    from ..lab.measurements import usable
    from ..lab.own_reference import words_of_own
    from ..lab.work_precision import WITHIN, cheapest
    from ..others.simulators import shown_name

    exact, rows = found["reference"], found["rows"]
    lines = [f"  reference     known to {100.0 * exact['error']:.2g} %, {exact['substeps']} steps a frame"]
    lines += [f"  {'own motion':<13} {shown_name(name)}: {words_of_own(own)}" for name, own in found.get("others", {}).items()]
    best = sorted((row for row in rows if row.get("front")), key=lambda row: row["ms_per_second"])
    for head, chosen in (("nothing beats", best), (f"within {100.0 * WITHIN:g} %", cheapest(rows, exact["error"]))):
        for row in chosen:
            error, strain = 100.0 * row["error"], 100.0 * row["strain_error"]
            numbers = f"{row['ms_per_second']:.3g} ms a second, {error:.2g} %, strain {strain:.2g} %"
            numbers += f", {100.0 * row['own_error']:.2g} % from its own" if row.get("own_error") is not None else ""
            numbers += "" if usable(row) else NOT_USABLE
            lines.append(f"  {head:<13} {numbers}: {row['label']}")
    return lines


def _solver_lines(found):
    """Returns lines with the final gap of each method."""
    lines = [f"  step          1/{found['rate']:g} s after frame {found['frame']}"]
    for row in found["rows"]:
        if row["points"]:
            last = min(row["points"], key=lambda point: point["gap"])
            gap = f"{max(last['gap'], row['floor']):.1e} after {last['iterations']} iterations, {last['ms']:.3g} ms"
            lines.append(f"  gap           {gap}: {row['label']}")
    return lines


def _spectrum_lines(found):
    """Returns lines with the slowest mode of each step, and the last factor of an iteration."""
    lines = []
    for row in found["rows"]:
        if row["measured"] is not None:
            numbers = f"slowest {row['contraction']:.6f}, measured {row['measured']:.6f}, expected {row['expected']:.6f}"
            lines.append(f"  contraction   {numbers}: {row['label']}")
    return lines
