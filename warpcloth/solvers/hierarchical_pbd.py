"""Hierarchical position based dynamics."""

from dataclasses import dataclass

import warp as wp

from ..base.checks import ranged
from ..kernels.hierarchy import follow
from ..model.model import Model
from ..numerics.hierarchy import levels, on_device
from ..numerics.sweeps import GaussSeidelSweep
from ..terms.needs import CLOSED_STEP, LOCAL_STEP, MERGED_DAMPING, NO_AIR, NORMAL_FORCE
from .facts import Benchmark, Facts, grid
from .solver import LaunchedStepper, Stepper
from .step import Step


@dataclass(frozen=True)
class HierarchicalPBD(Step):
    """Hierarchical position based dynamics (Müller 2008, *Hierarchical position based dynamics*).

    A step first sweeps over levels with fewer vertices, the coarsest first, so that fine cloth stretches less than with
    :class:`warpcloth.PBD`. The vertices that a level leaves out follow by dᵢ = Σ (dⱼ/Lᵢⱼ) / Σ (1/Lᵢⱼ) over the vertices j of
    the level that they are linked to, d = x − x̃. The sweeps of PBD over all terms come last.

    The constraints of a level are ‖xᵢ − xⱼ‖ ≤ L with L the length of a path at rest: the shortest over finer bounds, or a
    straight one over triangles of membranes, strain limits or springs of like stiffness, where the rest shape is flat. So
    levels do not resist folding, or shear of a net. Springs, limits with σ_max and membranes give bounds; without bounds the
    solver is PBD. The stiffness of a bound is that of its path, scaled so that a level keeps Σ kL² of the finer one. A vertex
    of a level has the mass Mⱼ = mⱼ + Σ wᵢⱼ mᵢ, so linear momentum is conserved; angular momentum is not.

    Soft cloth is stiffer than with PBD. Cloth that starts with large stretch is flung, and so is stiff cloth if steps are much
    shorter than it needs.

    Attributes:
        dt, substeps: See :class:`Step`.
        iterations: Sweeps over all terms a step, Gauss–Seidel by colour.
        coarse_iterations: Sweeps over each level.
        levels: Maximum number of levels above the finest; 0 is PBD, None means all levels that have bounds.
        relaxation: ω > 0, a factor on every move of a sweep.
    """

    name = "hierarchical-pbd"
    needs, locks = (MERGED_DAMPING, LOCAL_STEP, CLOSED_STEP, NORMAL_FORCE, NO_AIR), True
    ordered = closes = touches_itself = double_on_cpu = True
    facts = Facts(
        method="PBD that also sweeps over coarser levels of the mesh, so that fine cloth stretches less",
        suits="hard, fine cloth far from rest: one sweep of 6 ms leaves less strain than 2.8 s of `PBD` (n = 256)",
        weakness="less exact than `PBD` once the constraints are nearly met; makes soft cloth stiffer",
        benchmarks=(Benchmark({"substeps": 4, "iterations": 20}, cpu=(16, 32, 64, 128), cuda=(64, 128, 256, 512, 1024)),),
        runs=grid([(4, 1), (8, 1), (15, 1), (30, 1), (8, 2), (15, 2), (30, 2), (60, 2), (120, 2)]),
    )

    iterations: int = ranged(20, whole=True, least=1)
    coarse_iterations: int = ranged(5, whole=True, least=1)
    levels: int | None = ranged(None, whole=True, least=0)
    relaxation: float = ranged(1.0, above=0.0)

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Raises:
            ValueError: A term has infinite stiffness and neither projection, scalar constraint nor ``prox``.
        """
        self.refuse(model)
        return self._on(HierarchicalPBDStepper, model)


class HierarchicalPBDStepper(LaunchedStepper):
    """:class:`HierarchicalPBD` on a model.

    Attributes:
        levels: The :class:`warpcloth.numerics.hierarchy.Level` above the finest, finer ones first.
        sweep: The sweep over all terms, with x − x̃ of the last step.
    """

    hard_pairs = True

    def __init__(self, options, model):
        super().__init__(options, model, "euler")
        self.iterations = options.iterations
        self.levels = levels(model, options.levels)
        self._coarse = [self._on_level(level) for level in self.levels]
        self.record((self._launch_start, 1), (self.sweep.launch, options.iterations), (self._launch_last, 1))

    def arranged(self, model):
        self.sweep = GaussSeidelSweep(model, self.state.x, self.h, "coloured", self.options.relaxation)
        return model.with_terms(self.sweep.elements)

    def _on_level(self, level):
        """Returns the sweep over a level, and the launch that interpolates to the vertices left out."""
        model, d = self.model, self.sweep.correction
        given = on_device(model, level), self.state.x, self.h, "coloured", self.options.relaxation
        sweep = GaussSeidelSweep(*given, correction=d, follows=False)
        dropped, offsets, parents = (
            wp.array(each, dtype=wp.int32, device=model.device) for each in (level.dropped, level.offsets, level.parents)
        )
        given = [dropped, offsets, parents, model.array(level.weights, model.dtype), model.per_copy]
        return sweep, (model.kernel(follow, model.dtype), (model.copies, len(dropped)), given, [d])

    def _launch_start(self):
        self.launch_prediction()
        self.sweep.launch_start()
        for sweep, followers in reversed(self._coarse):
            for _ in range(self.options.coarse_iterations):
                sweep.launch()
            self.model.launch(*followers)
            self.model.lock(self.sweep.correction)

    def _launch_last(self):
        self.launch_finish(self.sweep.correction)
