"""The settings of a solver for benchmarks, charts and `choose`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Benchmark:
    """A scene of several sizes that `warpcloth bench` runs with a solver.

    Attributes:
        options: Options of the solver; a limited one takes the fewest stable substeps if they have none.
        cpu, cuda: Resolutions at which a frame takes less than about a second on one core, and on a GPU.
        scene: Name of the scene.
    """

    options: dict
    cpu: tuple = (16, 32, 64)
    cuda: tuple = (32, 64, 128)
    scene: str = "hanging"


@dataclass(frozen=True)
class Facts:
    """Settings by which a solver is measured.

    Attributes:
        method, suits, weakness: Words for tables.
        benchmarks: The :class:`Benchmark` settings.
        runs: Options near the Pareto front of error and time on ``hanging``. Substeps are per 1/60 s; for a limited solver
            ``fewest``, a multiple of the fewest stable substeps, replaces them.
        one_step: Options, without step and iterations, of the settings that minimise one step of implicit Euler.
        limits: Names of the :data:`warpcloth.lab.stability_limits.LIMITS` that maps of stability draw.
    """

    method: str = ""
    suits: str = ""
    weakness: str = ""
    benchmarks: tuple = (Benchmark({"substeps": 4}),)
    runs: tuple = tuple({"substeps": substeps} for substeps in (1, 4, 16, 64))
    one_step: tuple = ()
    limits: tuple = ()


def grid(settings, **options):
    """Returns options for each (substeps, iterations)."""
    return tuple({"substeps": substeps, "iterations": iterations, **options} for substeps, iterations in settings)
