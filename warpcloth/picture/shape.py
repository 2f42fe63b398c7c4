"""Shapes in a picture: surfaces, tubes and balls."""

from dataclasses import dataclass, field

import numpy as np

from ..base.checks import array, number, whole

# Linear Rec. 709 of plain cloth, and factors for its back, which is greyer, to tell the sides apart.
CLOTH = (0.20, 0.43, 0.72)
BACK = (1.7, 1.12, 0.86)


@dataclass(frozen=True, eq=False)
class Shape:
    """Topology and look of a shape; positions come with each picture.

    Attributes:
        count: Number n of points.
        triangles: Vertices of triangles (T, 3), visible from both sides.
        lines: Vertices of tubes with round ends (E, 2).
        radius: Radius of tubes [m], drawn at least one pixel wide.
        balls: Vertices drawn as balls (k,).
        ball_radius: Radius of the balls [m].
        colour: Linear Rec. 709 of elements without colours of their own.
        ball_colour: Linear Rec. 709 of the balls.
        back: Factors of the colour on the back, but for measures.
        smooth: Whether to shade smoothly, but for edges that bend by more than some 70°.

    Raises:
        ValueError: A shape is another, an index has no point, or a radius is not above 0.
    """

    count: int
    triangles: np.ndarray = field(default_factory=lambda: np.empty((0, 3), int))
    lines: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    radius: float = 0.0
    balls: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    ball_radius: float = 0.0
    colour: tuple[float, float, float] = CLOTH
    ball_colour: tuple[float, float, float] = (0.60, 0.05, 0.03)
    back: tuple[float, float, float] = BACK
    smooth: bool = True

    def __post_init__(self):
        whole("count", self.count, 0)
        for name, shape in (("triangles", (3,)), ("lines", (2,)), ("balls", ())):
            found = np.asarray(getattr(self, name))
            found = found.reshape(0, *shape) if found.size == 0 else found
            if found.shape[1:] != shape or found.ndim != 1 + len(shape) or (found.size and found.dtype.kind not in "iu"):
                wanted = ", ".join(map(str, ("k", *shape)))
                raise ValueError(f"{name} has shape {found.shape} and type {found.dtype}; it must be ({wanted}), whole numbers")
            if found.size and not 0 <= found.min() <= found.max() < self.count:
                raise ValueError(f"{name} refers to vertices {found.min()} to {found.max()}; there are {self.count}")
            object.__setattr__(self, name, found.astype(np.int32))
        if len(self.lines):
            number("radius", self.radius, above=0.0)
        if len(self.balls):
            number("ball_radius", self.ball_radius, above=0.0)
        for name in ("colour", "ball_colour", "back"):
            object.__setattr__(self, name, array(name, getattr(self, name), (3,)))
