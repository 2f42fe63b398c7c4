"""Benchmarks as data, and their measurement: each row in a fresh process, one after another."""

import time
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory

from ..base.quiet import initialise_warp
from ..solvers import SOLVERS
from . import bandwidth
from .campaign import environment, sweep
from .cells import refined
from .measurements import SceneRef, Setup, task
from .setups import label, setups_of_runs
from .timing import measure


@dataclass(frozen=True)
class SolverBenchmark:
    """A solver on a scene of several sizes, in a batch of ``copies`` with ``threads`` CPU threads.

    Attributes:
        scene: The scene, of any size.
        setup: The solver; a limited solver without a step takes the fewest stable substeps of each size.
        sizes: Resolutions of the scene; if empty, the scene as it is.
        dtype: Precision, by default that of a run with the solver.
        frames: Maximum number of frames to time.
        variants: Parameters of the scene by name, one dictionary for each variant, in place of sizes.
    """

    scene: SceneRef
    setup: Setup
    sizes: tuple = ()
    device: str = "cpu"
    dtype: str | None = None
    frames: int = 20
    copies: int = 1
    threads: int = 1
    variants: tuple = ()

    def scenes(self):
        """Returns the scene of each size or variant.

        Raises:
            ValueError: The scene has no resolution.
        """
        if self.variants:
            return [replace(self.scene, parameters=self.scene.parameters | each) for each in self.variants]
        return [refined(self.scene, size) for size in self.sizes] or [self.scene]

    def setup_of(self, scene):
        solver = self.setup.solver
        if not SOLVERS[solver].limited or {"dt", "substeps"} & set(self.setup.options):
            return self.setup
        (fewest, *_) = setups_of_runs(scene, [solver], self.device, self.dtype)
        return Setup(solver, {"substeps": fewest.options["substeps"], **self.setup.options})


def standard(**given):
    """Returns benchmarks of every solver on ``hanging`` of growing size, and the others of their records."""
    kind = "cuda" if given.get("device", "cpu").startswith("cuda") else "cpu"
    listed = [(name, each) for name, record in SOLVERS.items() for each in record.facts.benchmarks]
    listed.sort(key=lambda one: one[1].scene != "hanging")
    return [SolverBenchmark(SceneRef(one.scene), Setup(name, one.options), getattr(one, kind), **given) for name, one in listed]


# Gaps of the sheet `resting` [m]: one that touches, and one so high that it falls for longer than is timed.
_GAPS = (0.9e-3, 100.0)
_SHAPES = ("plane", "sphere", "capsule", "box", "mesh")
_TRIANGLES = (1250, 5000, 20000, 80000)
_TOUCHING = {"explicit": {}, "newton": {"substeps": 4}, "xpbd": {"substeps": 4}, "projective-dynamics": {"substeps": 4}}


def contacts(**given):
    """Returns benchmarks of contact on the scene ``resting``: shapes of colliders, near and far, and meshes of growing size."""
    shapes = tuple({"collider": shape, "gap": gap} for shape in _SHAPES for gap in _GAPS)
    few = tuple(each for each in shapes if each["collider"] in ("sphere", "mesh"))
    setups = [(Setup(solver, options), shapes if solver == "explicit" else few) for solver, options in _TOUCHING.items()]
    meshes = tuple({"collider": "mesh", "triangles": count} for count in _TRIANGLES)
    setups.append((Setup("explicit"), meshes))
    return [SolverBenchmark(SceneRef("resting"), setup, variants=variants, **given) for setup, variants in setups]


# Solvers and sizes of `folded_sheet`, flat and folded in two.
_FOLDED = (
    ("explicit", {}, (32, 64, 128), (32, 64)),
    ("newton", {"substeps": 1}, (32, 64, 128), (32, 64)),
    ("xpbd", {"substeps": 4, "iterations": 10}, (32, 64, 128), (32, 64, 128)),
    ("pbd", {"substeps": 4, "iterations": 10}, (32, 64, 128), (32, 64, 128)),
)


def self_contacts(**given):
    """Returns benchmarks of self-contact on ``folded_sheet``: a sheet that falls flat, and one folded in two."""
    return [
        SolverBenchmark(SceneRef("folded_sheet", {"layers": layers}), Setup(solver, options), sizes, **given)
        for solver, options, *of in _FOLDED
        for layers, sizes in enumerate(of, 1)
    ]


class Run:
    """Measures the rows of benchmarks, all on one device; after an interrupt it has the rows so far.

    Attributes:
        total: Total number of rows.
        rows: The measured rows: the result of :func:`warpcloth.lab.timing.measure`, with what was measured, ``benchmark``
            (its index), ``share`` (``bytes_per_s`` over the bandwidth) and, in the first row of each benchmark,
            ``cold_start_s``, the time to start without compiled kernels.
        bandwidth: The result of :func:`warpcloth.lab.bandwidth.measure`.
    """

    def __init__(self, benchmarks):
        self.benchmarks, self.rows, self.bandwidth = list(benchmarks), [], None
        self.total = sum(len(each.scenes()) for each in self.benchmarks)

    def measure(self, progress=lambda done, total: None):
        """Measures all rows; ``progress`` is called with (rows, total) before the first and after each."""
        progress(0, self.total)
        initialise_warp()  # before the cache of child processes is set below
        device = self.benchmarks[0].device
        self.bandwidth = _alone(task(bandwidth.measure, device=device))
        for index, benchmark in enumerate(self.benchmarks):
            # An empty cache of kernels.
            with TemporaryDirectory(prefix="warpcloth-kernels-") as folder, environment({"WARP_CACHE_PATH": folder}):
                for i, scene in enumerate(benchmark.scenes()):
                    row = self._row(benchmark, scene, cold=i == 0, compiles=i == 0 or bool(benchmark.variants))
                    self.rows.append({**row, "benchmark": index})
                    progress(len(self.rows), self.total)

    def _row(self, benchmark, scene, cold, compiles):
        setup = benchmark.setup_of(scene)
        dtype = SOLVERS[setup.solver].precision_on(benchmark.device, benchmark.dtype)
        given = {"device": benchmark.device, "dtype": dtype, "copies": benchmark.copies, "threads": benchmark.threads}

        def measured(frames):
            return _alone(task(measure, scene=scene, setup=setup, frames=frames, started=time.time(), **given))

        started = measured(0)["start_s"] if compiles else None
        row = measured(benchmark.frames)
        share = row["bytes_per_s"] and row["bytes_per_s"] / max(self.bandwidth.values())
        named = {"scene": scene.name, "parameters": scene.parameters, "solver": setup.solver, "options": setup.options}
        named |= {"label": label(setup), **given}
        return {**named, **row, "share": share, "cold_start_s": started if cold else None}


def _alone(asked):
    ((_, result),) = sweep([asked], workers=1)
    return result
