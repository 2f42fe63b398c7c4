"""The forces of air on triangles."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import warp as wp

from ..kernels.frozen_air import calm, set_air
from ..kernels.term import Term
from ..kernels.terms.air import AIR
from ..mesh.mesh import Mesh
from .declared import FINITE_FROM_0, Declared, Elements, quantity
from .refresh import STEP, Refresh


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangleAir(Declared):
    """Drag and lift of the air on each triangle (:mod:`warpcloth.kernels.terms.air`).

    Attributes:
        stiffness: Density of the air [kg/m³].
        wind: [m/s], (3,) or (T, 3).
        keyframes: Of a uniform wind, (F, 3) [m/s], in place of ``wind``; or None.
        blow: Warp function of position [m] and time [s] for the wind [m/s], at most ``wind``; or None.
        normal_drag, tangential_drag: C_n and C_t.
    """

    term: ClassVar[Term] = AIR

    wind: Sequence[float] | np.ndarray = field(
        default=(0.0, 0.0, 0.0), metadata=quantity("must be finite", np.isfinite, shape=(3,))
    )
    keyframes: np.ndarray | None = None
    blow: wp.Function | None = None
    normal_drag: float = field(default=1.2, metadata=FINITE_FROM_0)
    tangential_drag: float = field(default=0.02, metadata=FINITE_FROM_0)

    def stencil(self, mesh: Mesh) -> np.ndarray:
        return mesh.triangles

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        given = (self.of_elements(name, len(stencil)) for name in ("wind", "normal_drag", "tangential_drag"))
        return self.term.rest_state(mesh.points, stencil, *given)

    def elements_on(self, mesh: Mesh, positions: np.ndarray) -> Elements:
        return replace(super().elements_on(mesh, positions), refresh=Refresh(STEP, _Freeze(self.keyframes, self.blow or calm)))


class _Freeze:
    def __init__(self, keyframes, blow):
        self._keyframes, self._blow, self._held = keyframes, blow, {}

    def __call__(self, model, elements, moment):
        held = None
        if self._keyframes is not None:
            key = str(model.device), model.dtype
            if key not in self._held:
                self._held[key] = model.array(self._keyframes, model.vec3)
            held = self._held[key]
        if moment.v is None:  # of what has no velocity yet
            return
        parts = 0 if moment.move is None or moment.both else moment.parts  # with both, the changes of a position cancel
        kernel = model.kernel(set_air, model.dtype, parts, moment.explicit, self._blow)
        given = [elements.stencil, held, moment.x, moment.v, moment.move if parts else None, moment.steps]
        given += [moment.he, moment.ahead, moment.per_frame, 1.0 / model.scene.fps, model.per_copy]
        try:
            model.launch(kernel, elements.count, given, [elements.rest])
        except Exception as error:  # of generated code, Warp raises errors of several types
            said = str(error.args[0] if error.args else error)
            if self._blow is calm or "Error while parsing function" not in said:
                raise
            why = said.rpartition(";")[2].strip()
            raise ValueError(
                f"air.wind is the function {self._blow.key!r}, which Warp cannot compile as a wind: {why}"
            ) from None
