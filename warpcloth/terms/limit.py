"""The base class of limits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..base.checks import refuse
from ..mesh.mesh import Mesh
from .declared import FROM_0, Declared, quantity

FINITE_ABOVE_0 = quantity("must be finite, above 0", lambda values: (values > 0.0) & np.isfinite(values))


@dataclass(frozen=True, kw_only=True)
class Limit(Declared):
    """An energy that is 0 in a range about the rest shape.

    Attributes:
        least, most: Ends of the range, σ_min and σ_max, as ratios to the rest shape, each one or (E,); at least one.
        stiffness: k beyond the range, one or (E,), by default infinite.
    """

    stiffness: float | Sequence[float] | np.ndarray = field(default=math.inf, metadata=FROM_0)
    least: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=FINITE_ABOVE_0)
    most: float | Sequence[float] | np.ndarray | None = field(default=None, metadata=FINITE_ABOVE_0)

    def __post_init__(self):
        super().__post_init__()
        given = [self._numeric(name) for name in ("least", "most") if getattr(self, name) is not None]
        if not given:
            raise ValueError(f"{self.label} has neither least nor most; at least one of the two must be given")
        if len(given) == 2 and len({values.shape for values in given if values.ndim}) < 2:
            least, most = np.broadcast_arrays(*given)
            refuse(f"{self.label}.least", least, ~(least <= most), "must be no more than most")

    def rest(self, mesh: Mesh, positions: np.ndarray, stencil: np.ndarray) -> np.ndarray:
        given = {name: self.of_elements(name, len(stencil)) for name in ("least", "most") if getattr(self, name) is not None}
        return self.term.rest_state(mesh.points, stencil, **given)
