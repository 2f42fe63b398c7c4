"""Hierarchical position based dynamics: PBD that first moves few vertices far, then more and more of them."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..capture import Segment
from ..checks import choice, number, whole
from ..hierarchy import levels, on_device
from ..kernels.hierarchy import follow
from ..sweeps import Sweep, refuse_unprojectable
from .solver import Step, Stepper, require_model


@dataclass(frozen=True)
class HierarchicalPBD(Step):
    iterations: int = 20
    coarse_iterations: int = 10
    levels: int | None = None
    relaxation: float = 1.0

    def bind(self, model):
        require_model(model)
        refuse_unprojectable(model, "HierarchicalPBD")
        return HierarchicalPBDStepper(self, model)


class HierarchicalPBDStepper(Stepper):
    def __init__(self, options, model):
        super().__init__(options, model)
        self.sweep = Sweep(model, self.state.x, self.h, "coloured", options.relaxation)
        self.levels = levels(model, options.levels)
        self._coarse = []
        self._follow = model.kernel(follow, model.dtype)
        for level in self.levels:
            view = on_device(model, level)
            sweep = Sweep(view, self.state.x, self.h, "coloured", options.relaxation, correction=self.sweep.correction) if any(map(len, level.bounds)) else None
            indices = [wp.array(each.astype(np.int32), dtype=wp.int32, device=model.device) for each in (level.dropped, level.offsets, level.parents)]
            self._coarse.append((sweep, len(level.dropped), [*indices, model.array(level.weights, model.dtype), model.per_copy]))
        self._start = Segment(model.device, self._launch_start)
        self._sweep = Segment(model.device, self.sweep.launch)
        self._finish = Segment(model.device, lambda: self.launch_finish(self.sweep.correction))

    def _launch_start(self):
        self.launch_prediction()
        self.sweep.launch_start()
        for sweep, count, given in reversed(self._coarse):
            if sweep:
                for _ in range(self.options.coarse_iterations):
                    sweep.launch()
            self.model.launch(self._follow, (self.model.copies, count), given, [self.sweep.correction])

    def step(self):
        self._start()
        for _ in range(self.options.iterations):
            self._sweep()
        self._finish()
