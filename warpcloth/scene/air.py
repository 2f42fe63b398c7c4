"""The air around a cloth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..base.checks import array, keep_plain, number, numeric, refuse, shown


@dataclass(frozen=True, eq=False, kw_only=True)
class Air:
    """Air that resists the motion of the cloth and that wind moves.

    Each triangle of area A receives F = ½ρA(C_n|u_n|u_n n + C_t|u_t|u_t). u is the wind minus the velocity of the triangle, u_n
    its part along the normal n, u_t the rest. C|u| and n are those where a step begins, so F is linear in the velocity;
    implicit solvers take it at the end of the step. In still air it never adds energy.

    Attributes:
        wind: [m/s], (3,), or (T, 3) of triangles; or a Warp function of a position ``wp.vec3`` [m] and a time ``float`` [s],
            float32, that returns a ``wp.vec3``, called at the centres of triangles.
        keyframes: (F, 3) [m/s], in place of ``wind``: a uniform wind at frames 0 … F−1, linear between, constant after.
        density: ρ [kg/m³].
        normal_drag: C_n, by default that of a flat plate across the wind.
        tangential_drag: C_t, friction along the surface.
        max_speed: The largest speed of a function [m/s], for step limits; faster wind is slowed to it.

    Raises:
        ValueError: A value is not allowed.

    Examples:
        >>> import warpcloth as wc
        >>> breeze = wc.Air(wind=(3.0, 0.0, 0.0))
        >>> wc.Scene(wc.Mesh.grid(3, 3), density=0.1, terms=[wc.Spring(stiffness=1e3)], pins=[0], air=breeze).air.density
        1.2
        >>> import warp as wp
        >>> @wp.func
        ... def gusts(position: wp.vec3, time: float):
        ...     return wp.vec3(3.0 + wp.sin(6.0 * time - 2.0 * position[0]), 0.0, 0.0)
        >>> wc.Air(wind=gusts, max_speed=4.0).speed
        4.0
    """

    wind: Sequence[float] | np.ndarray | wp.Function | None = None
    keyframes: Sequence[Sequence[float]] | np.ndarray | None = None
    density: float = 1.2
    normal_drag: float = 1.2
    tangential_drag: float = 0.02
    max_speed: float | None = None

    def __post_init__(self):
        keep_plain(self)
        if callable(self.wind):
            _check_function(self.wind)
        if (self.blow is None) != (self.max_speed is None):
            raise ValueError("one of a function as air.wind and air.max_speed is given; both or none must be")
        if self.max_speed is not None:
            number("air.max_speed", self.max_speed, above=0.0)
        if self.wind is not None and self.keyframes is not None:
            raise ValueError("air.wind and air.keyframes are given; at most one of the two may be")
        for name in ("density", "normal_drag", "tangential_drag"):
            number(f"air.{name}", getattr(self, name), least=0.0)
        if self.keyframes is not None:
            frames = numeric("air.keyframes", self.keyframes, "have shape (F, 3)")
            array("air.keyframes", frames, (max(len(np.atleast_1d(frames)), 1), 3))
        else:
            wind = self.winds
            if wind.shape[-1:] != (3,) or wind.ndim > 2:
                raise ValueError(f"air.wind has shape {wind.shape}; it must be (3,), or (T, 3) with one for each triangle")
        refuse(
            "air.wind" if self.keyframes is None else "air.keyframes", self.winds, ~np.isfinite(self.winds), "must be finite"
        )

    @property
    def blow(self) -> wp.Function | None:
        """The function that gives the wind, or None."""
        return self.wind if isinstance(self.wind, wp.Function) else None

    @property
    def changes(self) -> bool:
        return self.keyframes is not None or self.blow is not None

    @property
    def winds(self) -> np.ndarray:
        """All winds, (3,), (T, 3) or (F, 3) [m/s]; of a function its largest speed, else 0."""
        if self.max_speed is not None:
            return np.array([self.max_speed, 0.0, 0.0])
        if self.keyframes is not None:
            return np.asarray(self.keyframes, dtype=np.float64)
        return np.zeros(3) if self.wind is None else numeric("air.wind", self.wind, "be a vector or an array of vectors")

    @property
    def speed(self) -> float:
        """The largest wind [m/s]."""
        return float(np.linalg.norm(self.winds, axis=-1).max(initial=0.0))


def _check_function(wind):
    if not isinstance(wind, wp.Function):
        raise ValueError(f"air.wind is {shown(wind)}, which is not a Warp function; decorate it with @wp.func")
    for overload in (*getattr(wind, "user_templates", {}).values(), *getattr(wind, "user_overloads", {}).values()):
        types = list(overload.input_types.values())
        if len(types) == 2 and types[0] in (wp.vec3, Any) and types[1] in (float, wp.float32, Any):
            return
    raise ValueError(f"air.wind is {shown(wind)}; its arguments must be a position wp.vec3 and a time float")
