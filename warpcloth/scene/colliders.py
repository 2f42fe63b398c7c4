"""Colliders and the contact of cloth with them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import warp as wp

from ..base.checks import array, as_array, keep_plain, number, shown
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..base.types import Converted, default
from ..kernels.nearest import find_distances
from ..kernels.terms.contact import ROUNDED_BOX, Solid


@dataclass(frozen=True, eq=False)
class Contact:
    """Contact of cloth with colliders: a pressure of k(r − d) at distances r/2 ≤ d < r, and of kr²/(4d) at d < r/2.

    The energy is U = Σ kA φ(d) over the vertices, A the area of a vertex (:mod:`warpcloth.kernels.terms.contact`). Meshes meet
    vertices, edges and triangles, as in :class:`warpcloth.SelfContact`. A pressure p leaves a gap of r − p/k, or of kr²/(4p) if
    p is above kr/2. A vertex that sticks moves by up to μN/(kA) before it slides.

    Attributes:
        distance: Contact distance r [m]; by default half of the scene's thickness, or 1 mm without one.
        stiffness: k [Pa/m]; infinite for solvers that take hard constraints, without meshes. By default (2/r)(wL/r + Y/L):
            weight per area w [Pa], stiffness Y [N/m], force per width and strain, and root L of the area [m].

    Raises:
        ValueError: A value is not allowed.
    """

    distance: Converted[float | None, float] = default(None)
    stiffness: float | None = None

    def __post_init__(self) -> None:
        keep_plain(self)
        if self.distance is not None:
            number("contact.distance", self.distance, above=0.0)
        if self.stiffness is not None and (np.ndim(self.stiffness) or self.stiffness != np.inf):
            number("contact.stiffness", self.stiffness, above=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Collider:
    """A shape in a frame that moves by keyframes.

    A subclass has a ``solid``, a :class:`warpcloth.kernels.terms.contact.Solid`, which gives the signed distance d of a point
    and ∇d from the numbers in ``core``.

    Attributes:
        position: Position of its centre, (3,) or at frames 0 … F−1 (F, 3) [m].
        rotation: Unit quaternion (x, y, z, w), (4,) or at these frames (F, 4). Between frames it moves linearly and rotates
            uniformly by the smaller angle; after the last it stands.
        friction: Coefficient μ of friction.
        name: Name in messages and files.

    Raises:
        ValueError: A value is not allowed.
    """

    solid: ClassVar[Solid] = ROUNDED_BOX
    is_mesh: ClassVar[bool] = False

    position: Converted[Sequence | np.ndarray, np.ndarray] = default((0.0, 0.0, 0.0))
    rotation: Converted[Sequence | np.ndarray, np.ndarray] = default((0.0, 0.0, 0.0, 1.0))
    friction: float = 0.0
    name: str | None = None

    def __post_init__(self) -> None:
        keep_plain(self)
        if not (self.name is None or isinstance(self.name, str)):
            raise ValueError(f"{type(self).__name__}.name is {shown(self.name)}; it must be a text or None")
        number(f"{self.label}.friction", self.friction, least=0.0)
        counts = []
        for name, size in (("position", 3), ("rotation", 4)):
            given = getattr(self, name)
            frames = len(given) if as_array(given).ndim == 2 else None
            if frames == 0:
                raise ValueError(f"{self.label}.{name} has no frame; it must have one or more, (F, {size})")
            values = array(f"{self.label}.{name}", given, (size,) if frames is None else (frames, size))
            counts += [] if frames is None else [frames]
            object.__setattr__(self, name, values)
        if len(set(counts)) > 1:
            raise ValueError(f"{self.label} has {counts[0]} positions and {counts[1]} rotations; it must have as many of both")
        length = np.linalg.norm(self.rotation, axis=-1)
        if (np.abs(length - 1.0) > 1e-3).any():
            raise ValueError(f"{self.label}.rotation has length {np.ravel(length)[0]:g}; quaternions must have length 1")

    @property
    def label(self) -> str:
        return self.name or type(self).__name__

    @property
    def core(self) -> tuple[np.ndarray, float]:
        """Half sizes of a box (3,), and the radius that inflates it [m] to contain the shape."""
        raise NotImplementedError  # each shape has its own

    @property
    def bounds(self) -> tuple[np.ndarray, float]:
        """:attr:`core` of a shape that contains it at all frames."""
        return self.core

    def clearing_gap(self, edge: float) -> float:
        """Returns the gap d = √(R² + L²/3) − R of vertices [m] that keeps a triangle with the longest edge L [m] outside.

        R is the radius of rounding, 0 for a box.
        """
        half, radius = self.core
        return 0.0 if np.isinf(half[0]) else float(np.sqrt(radius**2 + edge**2 / 3.0) - radius)

    @property
    def extent(self) -> float:
        """Largest distance of its surface from ``position`` [m]."""
        half, radius = self.core
        return float(np.linalg.norm(half)) + radius

    @property
    def deforms(self) -> np.ndarray:
        """Largest displacement of a point in its frame between keyframes, (F − 1,) [m]; empty if rigid."""
        return np.zeros(0)

    @property
    def up(self) -> np.ndarray:
        """The y axis of the frame of :attr:`core` in that of ``rotation``, (3,)."""
        return np.array([0.0, 1.0, 0.0])

    @property
    def moves(self) -> bool:
        return len(self.poses) > 1

    def at_last(self) -> "Collider":
        position, rotation = np.atleast_2d(self.position)[-1], np.atleast_2d(self.rotation)[-1]
        return replace(self, position=position, rotation=rotation)

    def centred(self) -> "Collider":
        """Returns this collider with its frame at the centre of its shape, for float32."""
        return self

    @property
    def most_move(self) -> float:
        """Upper bound of the move of a point of :attr:`bounds` in a frame [m]; infinite for a plane that turns."""
        poses = self.poses
        turns = 2.0 * np.arccos(np.clip(np.einsum("fi,fi->f", poses[1:, 3:], poses[:-1, 3:]), -1.0, 1.0))
        turned = np.zeros_like(turns)  # turns of 1e-8 are rounding, and would be infinite moves of planes
        turned[turns > 1e-7] = turns[turns > 1e-7] * (np.linalg.norm(self.bounds[0]) + self.bounds[1])
        return float((np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) + turned).max(initial=0.0))

    @property
    def poses(self) -> np.ndarray:
        """Position and quaternion of the frame of :attr:`core` at each frame, (F, 7); F = 1 if static."""
        rotations = _product(np.atleast_2d(self.rotation), from_y(self.up))
        lengths = np.linalg.norm(rotations, axis=1)
        lengths[np.abs(lengths - 1.0) < 1e-15] = 1.0  # so that normalising twice changes no bit
        rotations = rotations / lengths[:, None]
        signs = np.sign(np.einsum("fi,fi->f", rotations[1:], rotations[:-1]))
        rotations[1:] *= np.cumprod(np.where(signs < 0.0, -1.0, 1.0))[:, None]  # the shorter way
        positions = np.atleast_2d(self.position)
        frames = max(len(positions), len(rotations))
        return np.column_stack([np.broadcast_to(positions, (frames, 3)), np.broadcast_to(rotations, (frames, 4))])

    def distances(self, points: np.ndarray, frame: int = 0) -> np.ndarray:
        """Returns signed distances (…,) [m] of points (…, 3) [m] to the surface at a frame, negative inside."""
        pose, (half, radius) = self.poses[min(frame, len(self.poses) - 1)], self.core
        local = turned(pose[3:] * [-1.0, -1.0, -1.0, 1.0], points - pose[:3])
        return _distances(self.solid, local.reshape(-1, 3), half, radius).reshape(local.shape[:-1])

    def is_near(self, points: np.ndarray, distance: float, frame: int = 0) -> bool:
        """Returns whether one of points (n, 3) [m] is nearer than a distance [m], or inside."""
        return bool((self.distances(points, frame) < distance).any())


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane(Collider):
    """The half-space below a plane.

    Attributes:
        normal: Normal on the side of the cloth, (3,), rotated by ``rotation``.
        position: A point on the plane, (3,) or (F, 3) [m].
    """

    normal: Converted[Sequence | np.ndarray, np.ndarray] = default((0.0, 1.0, 0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "normal", _direction(f"{self.label}.normal", self.normal))

    @property
    def core(self) -> tuple[np.ndarray, float]:
        return np.full(3, np.inf), 0.0

    @property
    def up(self) -> np.ndarray:
        return self.normal


@dataclass(frozen=True, eq=False, kw_only=True)
class Sphere(Collider):
    """A solid sphere about ``position``.

    Attributes:
        radius: Its radius [m].
    """

    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        number(f"{self.label}.radius", self.radius, above=0.0)

    @property
    def core(self) -> tuple[np.ndarray, float]:
        return np.zeros(3), float(self.radius)


@dataclass(frozen=True, eq=False, kw_only=True)
class Capsule(Collider):
    """All points within ``radius`` of a segment whose middle is ``position``.

    Attributes:
        radius: Its radius [m].
        length: Length of the segment [m], without the caps.
        axis: Direction of the segment (3,), rotated by ``rotation``.
    """

    radius: float
    length: float
    axis: Converted[Sequence | np.ndarray, np.ndarray] = default((0.0, 1.0, 0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        number(f"{self.label}.radius", self.radius, above=0.0)
        number(f"{self.label}.length", self.length, above=0.0)
        object.__setattr__(self, "axis", _direction(f"{self.label}.axis", self.axis))

    @property
    def core(self) -> tuple[np.ndarray, float]:
        return np.array([0.0, 0.5 * self.length, 0.0]), float(self.radius)

    @property
    def up(self) -> np.ndarray:
        return self.axis


@dataclass(frozen=True, eq=False, kw_only=True)
class Box(Collider):
    """A box about ``position``, with edges along the axes, rotated by ``rotation``.

    Attributes:
        size: Lengths of its edges (3,) [m].
    """

    size: Converted[Sequence | np.ndarray, np.ndarray] = default((1.0, 1.0, 1.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        size = array(f"{self.label}.size", self.size, (3,))
        if not (size > 0.0).all():
            raise ValueError(f"{self.label}.size is {size.tolist()}; each length must be above 0")
        object.__setattr__(self, "size", size)

    @property
    def core(self) -> tuple[np.ndarray, float]:
        return 0.5 * self.size, 0.0


@in_turn
def _distances(solid, points, half, radius):
    with wp.ScopedDevice(find_device("cpu")):
        out = wp.zeros(len(points), dtype=wp.float64)
        given = [wp.array(points, dtype=wp.vec3d), wp.vec3d(half), float(radius)]
        wp.launch(find_distances(solid), len(points), inputs=given, outputs=[out])
        return out.numpy()


def _direction(name, given):
    values = array(name, given, (3,))
    length = np.linalg.norm(values)
    if not length > 0.0:
        raise ValueError(f"{name} is {values.tolist()}; it must not be 0")
    return values / length


def from_y(directions):
    """Returns the quaternions (…, 4), (x, y, z, w), of the smallest rotations of the y axis to directions (…, 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    found = np.stack([z, np.zeros_like(x), -x, 1.0 + y], axis=-1)
    found[y < -1.0 + 1e-12] = [1.0, 0.0, 0.0, 0.0]
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def _product(p, q):
    u, v = p[:, :3], q[:3]
    vector = p[:, 3:] * v + q[3] * u + np.cross(u, v)
    return np.column_stack([vector, p[:, 3] * q[3] - u @ v])


def turned(q, vectors):
    t = 2.0 * np.cross(q[:3], vectors)
    return vectors + q[3] * t + np.cross(q[:3], t)


def default_stiffness(distance: float, weight: float, stiffness: float, size: float) -> float:
    """Returns k = (2/r)(wL/r + Y/L) [Pa/m], at which a gap of r/2 carries the pressures kr/2 that hold or pull a whole cloth.

    A tension T [N/m] presses on an edge of radius r by T/r: T = wL for cloth that hangs over it, Yr/L for cloth pulled over it
    until it is longer by r.

    Args:
        distance: Contact distance r [m].
        weight: Weight per area w [Pa].
        stiffness: Force per width and strain Y [N/m].
        size: Size L of the cloth [m].
    """
    return 2.0 / distance * (weight * size / distance + stiffness / size)


def checked_colliders(given: Iterable[Collider]) -> tuple[Collider, ...]:
    """Returns colliders as a tuple; refuses others."""
    if isinstance(given, Collider) or not isinstance(given, Iterable):
        raise ValueError(f"colliders is {shown(given)}; it must be a list of colliders, such as [Plane()]")
    colliders = tuple(given)
    for i, collider in enumerate(colliders):
        if not isinstance(collider, Collider):
            raise ValueError(f"colliders[{i}] is {shown(collider)}; it must be a collider, such as Plane()")
    return colliders


def refuse_inside(colliders: Sequence[Collider], positions: np.ndarray, free: np.ndarray, copy: str = "") -> None:
    """Raises ValueError with the first free vertex of positions (n, 3) [m] in a collider, and ``copy``, words or ""."""
    for collider in colliders:
        found = collider.distances(positions)
        for vertex in np.flatnonzero(free & ~(found > 0.0))[:1]:
            depth = abs(found[vertex])
            raise ValueError(
                f"vertex {vertex} starts {depth:.3g} m inside the collider {collider.label}{copy}; it must be outside"
            )
