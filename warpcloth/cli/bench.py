"""The command ``bench``: the time and minimum memory traffic of frames, their growth with size, and ratios of two results."""

from datetime import datetime, timezone

from ..base.checks import whole
from ..base.outputs import check_apart, check_replaceable
from ..base.quiet import find_device
from ..base.texts import assignments, json_text, options
from .options import CLOTH, DEFAULT, add_cloth, add_scene, add_shared, add_solver, add_values, values_of
from .setup import named_scene, solver_setup
from .terminal import Bar, Interrupted, aligned, check_writable, say

TEXT = "Measure the time and memory of frames, or compare two results."
EPILOG = """\
Without SCENE, every solver runs the scene hanging in growing sizes, and PBD also runs Jacobi sweeps over the springs of the
scene net. The scene resting then shows what contact costs, for colliders of each shape, touched and far away, and for meshes of
growing size. The scene folded_sheet shows what self-contact costs, for a sheet that falls flat and for one that is folded in
two. All of it takes many minutes. Rows are measured one after another, each in its own process. If no step is
given, by dt, substeps or error, it is chosen as by 'warpcloth run'.

Columns:
  ms a frame  time of a frame after warm-up, with its points copied to the host: median
  quartiles   of that time
  cloths/s    cloths in the batch, divided by the time of a frame
  ns          time per element, iteration and substep, counting the elements of all terms; an iteration is one of Newton's
              method for newton, and a sweep over all terms for hierarchical-pbd
  GB/s        the least memory traffic of a step, divided by its time: per iteration, positions read and written, inverse
              masses and the arrays of all terms read; per step, velocities read and written
  share       GB/s divided by the bandwidth of the device, as measured by copying memory; small scenes fit into the caches
              of the device and may exceed 100 %
  launches    kernel launches, fills and copies per step
  start s     from the start of a process to its first frame, when all kernels are in the cache
  compile s   additional time when all kernels must be compiled
  factor s    time to factorise constant matrices
  MB          peak memory: of the process on a CPU, of Warp's memory pool on CUDA
  kB/vertex   on CUDA, this memory divided by the number of vertices of all cloths
With colliders or self-contact, the last column compares the time of a frame with that of the same cloth without contact, and
divides the difference by the numbers of vertices, substeps and colliders, counting self-contact as one. With self-contact it
also has the largest number of near pairs, how often they were listed, the moves that the filter kept, and the least gap.
It says if the frames are not usable, as 'warpcloth run' does; they are taken again for that, which is not timed.

  warpcloth bench --json > before.json
  warpcloth bench hanging --solver xpbd -s substeps=4 iterations=20 --sizes 32 64 128
  warpcloth bench --compare before.json after.json
"""


_OF_A_RUN = {"frames": 20, "copies": 1, "threads": 1, "device": "cpu", "dtype": None}


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add_scene(parser, nargs="?")
    add_cloth(parser)
    add_solver(parser, "the solver (default: newton)")
    add_values(parser, "-s", "option", "options of the solver")
    text = "resolutions to measure: values of the parameter of the scene that sets it (n, links or elements)"
    add("--sizes", nargs="+", type=int, default=[], metavar="N", help=text)
    text = "frames to time (default: 20); fewer if they take over 10 s, but at least 3"
    add("--frames", type=int, default=_OF_A_RUN["frames"], metavar="N", help=text)
    add("--copies", type=int, default=_OF_A_RUN["copies"], metavar="N", help="number of cloths in a batch (default: 1)")
    text = "number of CPU threads that share out the cloths of a batch (default: 1)"
    add("--threads", type=int, default=_OF_A_RUN["threads"], metavar="N", help=text)
    add("--csv", metavar="FILE", help="write the measurements as a table")
    add("--compare", nargs=2, metavar=("OLD", "NEW"), help="compare two files saved from --json, and print the ratios")
    add_shared(parser, "device", "json", "dtype")


def bench(arguments):
    if arguments.compare:
        return _compare(arguments)
    whole("frames", arguments.frames, 1)
    whole("copies", arguments.copies, 1)
    for size in arguments.sizes:
        whole("sizes", size, 2)
    if arguments.csv:
        check_apart([arguments.csv], [arguments.scene])
        check_replaceable(arguments.csv)
        check_writable(arguments.csv)
    device = find_device(arguments.device)
    from ..lab.benchmarks import Run
    from ..model.threads import refuse_one_copy

    refuse_one_copy(arguments.threads, arguments.copies)

    run = Run(_benchmarks(arguments, device))
    progress = _Rows()
    try:
        run.measure(progress)
        if all(row["status"] == "refused" for row in run.rows):
            raise ValueError(run.rows[0]["reason"])
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(run)) from None
    finally:
        progress.close()
        _write(arguments, run, device)
    diverged = [f"{row['label']} {_scene_of(row)}" for row in run.rows if row["status"] == "diverged"]
    return say(f"diverged: {', '.join(diverged)}", 1) if diverged else 0


def _benchmarks(arguments, device):
    """Returns the benchmarks that the arguments ask for.

    Raises:
        ValueError: Arguments exclude one another, or one is not allowed.
    """
    from ..lab.benchmarks import SolverBenchmark, contacts, self_contacts, standard
    from ..lab.measurements import SceneRef, Setup
    from ..solvers import SOLVERS

    given = {"device": str(device), **values_of(arguments, "dtype", "frames", "copies", "threads")}
    if arguments.scene is None:
        _refuse(arguments, ("p", *CLOTH, "pins", "solver", "s", "sizes"), "without SCENE, which must stand before it")
        return [*standard(**given), *contacts(**given), *self_contacts(**given)]
    _source, values, scene = named_scene(arguments)
    parameters = {name: values[name] for name in assignments(arguments.p)}
    arguments.solver = arguments.solver or DEFAULT
    chosen = options(SOLVERS[arguments.solver], assignments(arguments.s))
    step_given = set(SOLVERS[arguments.solver].step_options) & set(chosen)
    if step_given or not SOLVERS[arguments.solver].limited:
        solver = solver_setup(arguments, scene, device).solver
        chosen |= {} if step_given else {"substeps": solver.substeps}
    sizes = tuple(sorted(set(arguments.sizes)))
    scene_of = SceneRef(arguments.scene, parameters, arguments.pins)
    benchmark = SolverBenchmark(scene_of, Setup(arguments.solver, chosen), sizes, **given)
    benchmark.scenes()[0].load()  # raises its errors before anything is measured
    return [benchmark]


def _refuse(arguments, names, why):
    """Raises ValueError if one of these options is given."""
    for name in names:
        if getattr(arguments, name):
            raise ValueError(f"{'-' * min(len(name), 2)}{name} is given {why}")


def _interrupted(run):
    """Returns a message about the results of an interrupted run."""
    if not run.rows:
        return "interrupted before the first row; nothing was measured"
    return f"interrupted after {len(run.rows)} of {run.total} rows, which are printed"


class _Rows(Bar):
    """Counts rows on a terminal."""

    def __call__(self, done, total):
        if done == 0:
            self.open(total, "measuring", "{n_fmt} of {total_fmt} rows")
        self.move(done)


def _write(arguments, run, device):
    """Writes and prints the rows so far."""
    from ..lab.machine import machine
    from ..lab.results import growth, write_csv

    if all(row["status"] == "refused" for row in run.rows):
        return
    if arguments.csv:
        write_csv(arguments.csv, run.rows)
    facts = {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": machine(device),
        "bandwidth": run.bandwidth,
        "rows": run.rows,
        "growth": growth(run.rows),
    }
    print(json_text(facts) if arguments.json else _text(facts))


_TIMES = ("start s", "compile s", "factor s")
_HEAD = ("ms a frame", "quartiles", "cloths/s", "ns", "GB/s", "share", "launches", *_TIMES, "MB", "kB/vertex", "")


def _text(facts):
    machine, copied = facts["machine"], " and ".join(f"{1e-9 * each:.3g}" for each in facts["bandwidth"].values())
    name = machine["processor"] if machine["device"] == "cpu" else machine["device"]
    table = [("", "", *_HEAD), *(_cells(row) for row in facts["rows"])]
    lines = [
        f"{name}, warp {machine['warp']}; a copy and a kernel that copies move {copied} GB/s",
        *_aligned(table),
    ]
    for each in facts["growth"]:
        words = [each["solver"], *(f"{name}={value}" for name, value in each["options"].items())]
        over = each["over"]
        powers = [f"{p:.2f}" + ("" if error is None else f" ± {error:.2f}") for p, error in (each["frame"], each["iteration"])]
        line = f"{' '.join(words)}: a frame grows as {over}^{powers[0]}, an iteration as {over}^{powers[1]}"
        if "list" in each:
            line += f", a list of near pairs as {over}^{each['list'][0]:.2f}, their contacts as {over}^{each['find'][0]:.2f}"
        lines.append(line)
    return "\n".join(lines)


def _cells(row):
    """Returns a row as texts."""
    from ..core.status import Grade
    from ..lab.measurements import usable

    if row["status"] == "refused":
        return (_scene_of(row), row["label"], *[""] * (len(_HEAD) - 1), f"refused: {row['reason']}")
    low, high = row["spread"]
    compiling = None if row["cold_start_s"] is None else max(row["cold_start_s"] - row["start_s"], 0.0)
    of_vertex = None if row["device"] == "cpu" or row["memory"] is None else 1e-3 * row["memory"] / row["vertices"]
    numbers = (row["start_s"], compiling, row["factorise_s"] or None, row["memory"] and 1e-6 * row["memory"], of_vertex)
    return (
        *(_scene_of(row), row["label"], _number(row["ms"]), f"{low:.3g}–{high:.3g}"),
        *(
            _number(row["cloths_per_s"]),
            _number(row["ns"]),
            _number(1e-9 * row["bytes_per_s"]),
            f"{100.0 * row['share']:.2g} %",
            f"{row['launches']:.4g}",
        ),
        *map(_number, numbers),
        row["reason"] or "; ".join(filter(None, ["" if usable(row) else Grade.NOT_USABLE.value, _contact(row)])),
    )


def _contact(row):
    """Describes the cost of contact and the counts of self-contact; "" without contact."""
    said = []
    if row.get("ms_without") is not None:
        ratio = row["ms"] / row["ms_without"]
        said.append(f"{ratio:.2f} of the time without contact, {row['contact_ns']:.3g} ns a vertex and substep")
    if row.get("pairs") is not None:
        gap = "none" if row["least_gap"] is None else f"{row['least_gap']:.2g} m"
        kept = f"{100.0 * row['kept']:.4g} % of moves kept, least gap {gap}"
        said.append(f"{row['pairs']:,} pairs, {row['lists']:.2g} lists a substep, {kept}")
    if row.get("list_ns") is not None:
        said.append(f"a list takes {row['list_ns']:.3g} ns a vertex, its contacts {row['find_ns']:.3g}")
    return "; ".join(said)


def _scene_of(row):
    copies = [f"×{row['copies']}"] if row["copies"] > 1 else []
    copies += [f"{row['threads']} threads"] if row["threads"] > 1 else []
    return " ".join([row["scene"], *(f"{name}={value}" for name, value in row["parameters"].items()), *copies])


def _number(value):
    return "–" if value is None else f"{value:.3g}"


def _aligned(table):
    """Returns lines with two left-aligned columns, right-aligned numbers, and a remark."""
    return aligned(table, range(2, len(table[0]) - 1))


def _compare(arguments):
    """Prints the ratios of two results.

    Raises:
        ValueError: A file has no result, or the two have no row in common.
    """
    from ..lab.results import ratios, read

    if arguments.scene:
        raise ValueError("SCENE is given beside --compare, which measures nothing")
    _refuse(arguments, ("p", "solver", "s", "sizes", "csv"), "beside --compare, which measures nothing")
    for name, default in _OF_A_RUN.items():
        if getattr(arguments, name) != default:
            raise ValueError(f"--{name} is given beside --compare, which measures nothing")
    old, new = (read(path) for path in arguments.compare)
    found = ratios(old, new)
    if not found:
        raise ValueError(f"{arguments.compare[0]} and {arguments.compare[1]} have no row in common that was measured in both")
    differ = [name for name in ("processor", "device") if old["machine"][name] != new["machine"][name]]
    if arguments.json:
        print(json_text({"old": old["machine"], "new": new["machine"], "rows": found}))
        return 0
    for name in differ:
        print(f"{name}: {old['machine'][name]} and {new['machine'][name]}, so that times say little of the code")
    table = [("", "", "ms before", "after", "ratio", "within", "launches", "bytes", "start", "memory", "")]
    for row in found:
        low, high = row["spread"]
        numbers = [*map(_number, (*row["ms"], row["ratio"])), f"{low:.3g}–{high:.3g}"]
        numbers += [_number(row[name]) for name in ("launches", "bytes", "start", "memory")]
        table.append((_scene_of(row), row["label"], *numbers, row["verdict"]))
    print("\n".join(_aligned(table)))
    for verdict in ("slower", "faster"):
        names = [f"{row['label']} {_scene_of(row)}" for row in found if row["verdict"] == verdict]
        if names:
            print(f"{verdict} by more than the spread: {', '.join(names)}")
    left = len(old["rows"]) + len(new["rows"]) - 2 * len(found)
    if left:
        print(f"{left} rows have no partner that was measured")
    return 0
