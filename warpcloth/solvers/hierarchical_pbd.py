"""Hierarchical position based dynamics: PBD that sweeps over coarse levels before fine ones."""

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

    A sweep of :class:`warpcloth.PBD` carries information over one or a few constraints, so that finer cloth stretches more.
    Here a step first sweeps over levels with fewer vertices, the coarsest first. The vertices that a level leaves out then
    follow by dᵢ = Σ (dⱼ/Lᵢⱼ) / Σ (1/Lᵢⱼ) over the vertices j of the level that they are linked to, d = x − x̃. The sweeps of
    PBD over all terms come last. Each level costs a quarter of the next finer one in a sheet, a half in a chain.

    The constraints of a level are one-sided: ‖xᵢ − xⱼ‖ ≤ L with L the length of a path at rest: the shortest over finer bounds,
    or a shorter, straight one over triangles that keep their shape, where the rest shape is flat. These are the triangles of
    membranes and ``StrainLimit``, and those of springs whose stiffnesses differ by a factor of 4 at most. So cloth that meets
    its constraints is not moved, and the levels do not resist folding, or shear of a net. Springs, limits with
    σ_max and membranes give bounds; bending, attachments and damping take part in the last sweeps only. Without bounds the
    solver is PBD. The stiffness of a bound is that of its path in series, scaled so that a level keeps Σ kL² of the finer one;
    it is infinite if that of the cloth is. A vertex of a level has the mass of the vertices that follow it too, Mⱼ = mⱼ + Σ wᵢⱼ
    mᵢ, so that linear momentum is conserved; angular momentum is not.

    It has drawbacks. Soft cloth is stiffer than with PBD, because the corrections of all levels add up: a chain of 80 springs
    whose exact stretch is 40 % stretches by 4.7 % with PBD (4 × 20 sweeps a frame) and by 1.1 % here. Cloth that starts with
    large stretch is flung, because one step corrects all of it. Stiff cloth is flung too if steps are much shorter than it
    needs, because the levels then add energy. Vertices that follow a level move unevenly, most of all near pins, and the last
    sweeps must smooth that. So levels help if large errors extend over many vertices. If x̃ already nearly meets the
    constraints, PBD alone leaves smaller errors. Repeating the levels in a step was no better in the same time.

    Attributes:
        dt, substeps: See :class:`Step`.
        iterations: Sweeps over all terms a step, Gauss–Seidel by colour.
        coarse_iterations: Sweeps over each level.
        levels: Maximum number of levels above the finest; 0 is PBD, None means all levels that have bounds.
        relaxation: ω > 0, a factor on every move of a sweep.

    Raises:
        ValueError: If an option is not allowed.
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
        """Binds the solver to ``model`` and allocates all arrays that steps need.

        Raises:
            ValueError: A term has infinite stiffness and neither projection, scalar constraint nor ``prox``.
        """
        self.refuse(model)
        return self._on(HierarchicalPBDStepper, model)


class HierarchicalPBDStepper(LaunchedStepper):
    """:class:`HierarchicalPBD` on a model.

    Attributes:
        levels: The :class:`warpcloth.numerics.hierarchy.Level` of each level above the finest, finer ones first.
        sweep: The :class:`warpcloth.numerics.sweeps.GaussSeidelSweep` over all terms, with x − x̃ of the last step.
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
        """Returns the sweep over a level, and the arguments of the launch that interpolates to the vertices that it drops."""
        model, d = self.model, self.sweep.correction
        given = on_device(model, level), self.state.x, self.h, "coloured", self.options.relaxation
        sweep = GaussSeidelSweep(*given, correction=d, follows=False)
        dropped, offsets, parents = (
            wp.array(each, dtype=wp.int32, device=model.device) for each in (level.dropped, level.offsets, level.parents)
        )
        given = [dropped, offsets, parents, model.array(level.weights, model.dtype), model.per_copy]
        return sweep, (model.kernel(follow, model.dtype), (model.copies, len(dropped)), given, [d])

    def _launch_start(self):
        """Launches the prediction, and the sweeps over the levels, the coarsest first."""
        self.launch_prediction()
        self.sweep.launch_start()
        for sweep, followers in reversed(self._coarse):
            for _ in range(self.options.coarse_iterations):
                sweep.launch()
            self.model.launch(*followers)
            self.model.lock(self.sweep.correction)

    def _launch_last(self):
        self.launch_finish(self.sweep.correction)
