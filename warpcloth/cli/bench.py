"""The command ``bench``: what frames cost, what they must move at least, and how that grows; ratios of two results."""

from datetime import datetime, timezone

from ..checks import whole
from ..outputs import Output, check_apart
from ..scene_files import assignments, options
from .run import named_scene, solver_setup
from .terminal import Interrupted, as_json, check_writable, find_device, open_bar, say

EPILOG = """\
Without SCENE every solver runs hanging of growing sizes, in a few minutes. Each row is measured in a process of its own, one
after another; where no step is given it is that of run.

ms: a warm frame with its points on the host, median and quartiles. ns: the same over elements of all terms × iterations (of
Newton's method Newton iterations) × substeps. GB/s: bytes that a step moves at least over its time; positions in and out once,
inverse masses and the arrays of all terms once an iteration, velocities in and out once. share: of what a copy moves on this
device; small scenes stay in its caches, and may have more than 100 %. launches: of a step, kernels, fills and copies. start:
from the start of a process to its first frame, with all kernels in the cache; compile: what it takes longer with none there.
factor: constant matrices. MB: most memory, of the process on a CPU, of Warp's pool on CUDA.

  warpcloth bench --json > before.json
  warpcloth bench hanging --solver xpbd -s substeps=4 iterations=20 --sizes 32 64 128
  warpcloth bench --compare before.json after.json
"""


def add_arguments(parser):
    """Adds what the command takes but for what all commands do."""
    from ..solvers import SOLVERS

    add = parser.add_argument
    add("scene", nargs="?", metavar="SCENE", help="a .py file with a function scene(), a USD stage, or a known name")
    add("-p", nargs="+", action="extend", default=[], metavar="parameter=value", help="of the scene")
    add("--solver", choices=SOLVERS, help="newton where not given")
    add("-s", nargs="+", action="extend", default=[], metavar="option=value", help="options of the solver")
    add("--sizes", nargs="+", type=int, default=[], metavar="N", help="resolutions of the scene, as its parameter says them")
    add("--frames", type=int, default=20, metavar="N", help="to time at most, 20 where not given; 3 are enough after 10 s")
    add("--csv", metavar="FILE", help="write a table")
    add("--compare", nargs=2, metavar=("OLD", "NEW"), help="print ratios of two results that --json printed")


def bench(arguments):
    if arguments.compare:
        return _compare(arguments)
    whole("frames", arguments.frames, 1)
    for size in arguments.sizes:
        whole("sizes", size, 2)
    if arguments.csv:
        check_apart([arguments.csv], [arguments.scene])
        Output(arguments.csv, "x").discard()
        check_writable(arguments.csv)
    device = find_device(arguments.device)
    from ..bench.benchmarks import Run

    run = Run(_benchmarks(arguments, device))
    progress = _Rows()
    try:
        run.measure(progress)
    except KeyboardInterrupt:
        _write(arguments, run, device)
        raise Interrupted(f"interrupted after {len(run.rows)} of {run.total} rows") from None
    except BaseException:
        _write(arguments, run, device)
        raise
    finally:
        progress.close()
    refused = [row for row in run.rows if row["status"] == "refused"]
    if len(refused) == run.total:
        raise ValueError(refused[0]["reason"])
    _write(arguments, run, device)
    diverged = [f"{row['label']} {_scene_of(row)}" for row in run.rows if row["status"] == "diverged"]
    return say(f"diverged: {', '.join(diverged)}", 1) if diverged else 0


def _benchmarks(arguments, device):
    """What the arguments ask for.

    Raises:
        ValueError: They do not go together, or one of them is wrong.
    """
    from ..bench.benchmarks import Benchmark, standard
    from ..chart.tasks import SceneRef, Setup
    from ..solvers import SOLVERS

    given = {"device": str(device), "dtype": arguments.dtype, "frames": arguments.frames}
    if arguments.scene is None:
        for name, value in {
            "-p": arguments.p,
            "--solver": arguments.solver,
            "-s": arguments.s,
            "--sizes": arguments.sizes,
        }.items():
            if value:
                raise ValueError(f"{name} is given without SCENE, which it is for")
        return standard(**given)
    _source, values, scene = named_scene(arguments)
    parameters = {name: values[name] for name in assignments(arguments.p)}
    arguments.solver = arguments.solver or "newton"
    chosen = options(SOLVERS[arguments.solver], assignments(arguments.s))
    step_given = {"dt", "substeps"} & set(chosen)
    if step_given or arguments.solver != "explicit":
        solver = solver_setup(arguments, scene, device).solver
        chosen |= {} if step_given else {"substeps": solver.substeps}
    setup = Setup(arguments.solver, chosen)
    benchmark = Benchmark(SceneRef(arguments.scene, parameters), setup, tuple(dict.fromkeys(arguments.sizes)), **given)
    for ref in benchmark.scenes():
        ref.load()  # what it refuses is said before anything is measured
    return [benchmark]


class _Rows:
    """Counts rows on a terminal."""

    def __init__(self):
        self.bar = None

    def __call__(self, done, total):
        if done == 0:
            self.bar = open_bar(total, "measuring", "{n_fmt} of {total_fmt} rows")
        elif self.bar is not None:
            self.bar.update(done - self.bar.n)

    def close(self):
        if self.bar is not None:
            self.bar.close()


def _write(arguments, run, device):
    """Writes and prints what rows there are."""
    from ..bench.results import growth, write_csv
    from ..chart.machine import machine

    if not run.rows:
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
    print(as_json(facts) if arguments.json else _text(facts))


_HEAD = ("ms a frame", "quartiles", "ns", "GB/s", "share", "launches", "start", "compile", "factor", "MB")


def _text(facts):
    machine, copied = facts["machine"], max(facts["bandwidth"].values())
    name = machine["processor"] if machine["device"] == "cpu" else machine["device"]
    lines, table = [f"{name}, warp {machine['warp']}; a copy moves {1e-9 * copied:.3g} GB/s"], [("", "", *_HEAD)]
    for row in facts["rows"]:
        if row["status"] == "refused":
            table.append((_scene_of(row), row["label"], f"refused: {row['reason']}"))
            continue
        low, high = row["spread"]
        cold = None if row["cold_start_s"] is None else row["cold_start_s"] - row["start_s"]
        numbers = [f"{low:.3g}–{high:.3g}", *map(_number, (row["ns"], row["bytes_per_s"] * 1e-9))]
        numbers += [f"{100.0 * row['share']:.2g} %", f"{row['launches']:.4g}"]
        numbers += [
            *map(_number, (row["start_s"], cold, row["factorise_s"] or None)),
            _number(row["memory"] and row["memory"] / 1e6),
        ]
        table.append((_scene_of(row), row["label"], f"{row['ms']:.3g}", *numbers, row["reason"]))
    lines += _aligned(table)
    for each in facts["growth"]:
        shared = " ".join(f"{name}={value}" for name, value in each["options"].items())
        frame, iteration = (
            f"{p:.2f}" + ("" if error is None else f" ± {error:.2f}") for p, error in (each["frame"], each["iteration"])
        )
        lines.append(f"{each['solver']} {shared}: a frame grows as vertices^{frame}, an iteration as vertices^{iteration}")
    return "\n".join(lines)


def _scene_of(row):
    return " ".join([row["scene"], *(f"{name}={value}" for name, value in row["parameters"].items())])


def _number(value):
    return "–" if value is None else f"{value:.3g}"


def _aligned(table):
    """Rows of texts as lines, the first two columns to the left; one of three columns is a name and a sentence."""
    whole = [row for row in table if len(row) > 3]
    widths = [max(len(row[i]) for row in whole if i < len(row)) for i in range(max(map(len, whole)))]
    widths[:2] = [max(len(row[i]) for row in table) for i in range(2)]
    lines = []
    for row in table:
        cells = [
            text.ljust(width) if i < 2 or len(row) == 3 else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines


def _compare(arguments):
    """Prints the ratios of two results.

    Raises:
        ValueError: A file is none, or the two have no row in common.
    """
    from ..bench.results import ratios, read

    for name, value in {"SCENE": arguments.scene, "--csv": arguments.csv}.items():
        if value:
            raise ValueError(f"{name} is given beside --compare, which measures nothing; leave one out")
    old, new = (read(path) for path in arguments.compare)
    found = ratios(old, new)
    if not found:
        raise ValueError(f"{arguments.compare[0]} and {arguments.compare[1]} have no row in common that was measured in both")
    differ = [name for name in ("processor", "device") if old["machine"][name] != new["machine"][name]]
    if arguments.json:
        print(as_json({"old": old["machine"], "new": new["machine"], "rows": found}))
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
