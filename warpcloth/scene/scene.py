"""The scene, which any solver that supports its terms runs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, InitVar, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import array, as_array, keep_plain, number, refuse, shown
from ..base.types import Converted, Precision, UpAxis, default
from ..kernels.coulomb import law_of
from ..mesh.mesh import Mesh
from ..mesh.selection import distinct_vertices
from ..mesh.stage_mesh import StageMesh
from ..model.model import Model
from ..terms.contact import VertexContact, VertexFriction
from ..terms.declared import Declared
from ..terms.loads import Load, Loads, checked_loads
from ..terms.triangle_air import TriangleAir
from .air import Air
from .colliders import Collider, Contact, checked_colliders, default_stiffness, refuse_inside
from .fabric import Fabric
from .joining import fields_of_cloths, pins_of_cloths
from .measured_fabrics import fabrics
from .self_contact import SelfContact
from .warp import warp_on

EARTH = 9.81  # [m/s²]
DOWN = {"Y": (0.0, -1.0, 0.0), "Z": (0.0, 0.0, -1.0)}
DISTANCE = 1e-3  # of contact, where neither it nor a fabric has one [m]
_MAX_FRAMES = 2**31 - 1  # frames are counted in int32 on the device


@dataclass(frozen=True, eq=False)
class Pins:
    """Vertices whose motion is prescribed, along all axes or some.

    Attributes:
        vertices: Indices (p,), or a selection of the mesh such as ``"x<0.01"``.
        keyframes: Positions (F, p, 3) [m] at frames 0 … F−1, in the order of ``vertices``, linear between, constant after; by
            default the start.
        axes: The axes that the pins hold, such as ``"xz"``, or one string per pin (p,): ``"y"`` is a roller along x and z.

    Examples:
        >>> import warpcloth as wc
        >>> mesh = wc.Mesh.grid(3, 3)
        >>> start = mesh.points[mesh.corners()]
        >>> pins = wc.Pins("corners", keyframes=[start, start + [0, 0.1, 0]])
        >>> wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=10)], pins=pins).pins.vertices.tolist()
        [0, 2, 6, 8]
    """

    vertices: Converted[str | ArrayLike, np.ndarray] = default(MISSING)
    keyframes: Converted[ArrayLike | None, np.ndarray | None] = default(None)
    axes: str | Sequence[str] = "xyz"

    @cached_property
    def held(self) -> np.ndarray:
        """The axes that each pin of a scene holds, (p, 3) booleans."""
        each = [self.axes] * len(self.vertices) if isinstance(self.axes, str) else self.axes
        return np.array([[axis in axes for axis in "xyz"] for axes in each], dtype=bool).reshape(-1, 3)

    @property
    def clamped(self) -> np.ndarray:
        """Vertices held along every axis, (c,)."""
        return self.vertices[self.held.all(axis=1)]

    @property
    def moves(self) -> bool:
        """Whether keyframes move pins along an axis that they hold."""
        return self.keyframes is not None and bool((self.keyframes != self.keyframes[:1])[:, self.held].any())

    def refuse_far(self, positions: np.ndarray, copy: str = "") -> None:
        """Checks that pins start at their first keyframe, from ``positions`` (n, 3) [m].

        Raises:
            ValueError: They do not; the message says by how far.
        """
        if self.keyframes is None:
            return
        gap = np.abs(self.keyframes[0] - positions[self.vertices])[self.held].max(initial=0.0)
        # Either may come from float32, whose rounding grows with the distance from the origin.
        near = 1e-6 * np.ptp(positions, axis=0).max() + 2.0 * np.finfo(np.float32).eps * np.abs(positions).max()
        if gap > near:
            raise ValueError(f"pins.keyframes[0] is {gap:.3g} m from where the pinned vertices start{copy}; it must be there")


@dataclass(frozen=True, eq=False)
class Scene:
    """A cloth, all that acts on it, and a duration, in SI units.

    Attributes:
        mesh: The :class:`Mesh`; its points are the rest shape.
        density: Mass per area [kg/m²], lumped by thirds of triangles; for an edge mesh mass per length [kg/m], by halves of
            edges.
        masses: Mass of each vertex, (n,) [kg], in place of ``density``; or None.
        positions: Positions at the start, (n, 3) [m], by default at rest.
        velocities: Velocities at the start, (n, 3) [m/s], by default 0; those of pins are ignored.
        terms: The energies.
        pins: :class:`Pins`, or indices or a selection of fixed vertices.
        gravity: Acceleration (3,) [m/s²], by default 9.81 down the up axis of the mesh, or y.
        duration: [s], a whole number of frames.
        fps: Frames per second.
        name: Name in reports and files.
        stage: The :class:`warpcloth.usd.StageMesh` of ``mesh``, over which animations are layers; or None.
        free_axes: Axes along which each vertex may move, (n, 3) booleans; by default all. Without a free axis a vertex is a
            fixed pin. Values of pins are ignored.
        loads: :class:`Force`, :class:`Traction`, :class:`Pressure`.
        colliders: Such as :class:`warpcloth.Sphere`; pins do not collide.
        contact: The :class:`warpcloth.Contact` with all colliders, by default at half of the thickness, or 1 mm without one,
            with a computed stiffness.
        self_contact: The :class:`warpcloth.SelfContact` of the cloth, by default with a computed stiffness, or None.
        air: The :class:`warpcloth.Air`, or None.
        cloths: Names of the cloths that :meth:`join` joined, each a part of the mesh and a prim in files; else empty.
        fabric: A :class:`Fabric`, or its name in ``warpcloth.fabrics``, which sets ``density``, ``terms`` and ``thickness``.
        warp: Vector along the warp of ``fabric``, (3,) or (T, 3), projected to each triangle; by default along the texture
            coordinate s, or with a warning along x at rest.
        thickness: Thickness of the cloth [m], for contact without a distance; None for none; NaN if unknown (of the fabric, or
            different cloths), which such contact refuses.

    Raises:
        ValueError: A value is not allowed; the message names it.

    Examples:
        >>> import warpcloth as wc
        >>> terms = [wc.Spring(pairs=("structural", "shear"), stiffness=1e3), wc.QuadraticBending(stiffness=1e-5)]
        >>> scene = wc.Scene(wc.Mesh.grid(3, 3), density=0.15, terms=terms, pins="corners", duration=2.0)
        >>> scene.frames, round(float(scene.vertex_masses.sum()), 3)
        (120, 0.15)
    """

    mesh: Mesh
    density: float | None = None
    masses: Converted[ArrayLike | None, np.ndarray | None] = default(None)
    positions: Converted[ArrayLike | None, np.ndarray] = default(None)
    velocities: Converted[ArrayLike | None, np.ndarray] = default(None)
    terms: Converted[Iterable[Declared], tuple[Declared, ...]] = default(())
    pins: Converted[Pins | str | ArrayLike | None, Pins] = default(None)
    gravity: Converted[ArrayLike | None, np.ndarray] = default(None)
    duration: float = 1.0
    fps: float = 60.0
    name: str = "scene"
    stage: StageMesh | None = None
    free_axes: Converted[ArrayLike | None, np.ndarray | None] = default(None)
    loads: Converted[Load | Iterable[Load], Loads] = default(())
    colliders: Converted[Iterable[Collider], tuple[Collider, ...]] = default(())
    contact: Contact | None = None
    self_contact: SelfContact | None = None
    air: Air | None = None
    cloths: tuple[str, ...] = ()
    fabric: InitVar[Fabric | str | None] = None
    warp: InitVar[ArrayLike | None] = None
    thickness: float | None = None

    @classmethod
    def join(cls, cloths: Mapping[str, "Scene"], **whole: Any) -> "Scene":
        """Joins several cloths, such as layers or pieces of a garment, into one scene.

        Each keeps its masses, terms, pins, loads, positions and velocities. Names of terms begin with that of their cloth, such
        as skirt_Spring. ``Animation.cloth(name)`` has the motion of one.

        Args:
            cloths: A scene for each name, an identifier, without colliders or contact.
            **whole: Fields of the whole scene: gravity, duration, fps and thickness, by default those that all cloths share
                (thickness: else unknown); colliders, contact, self_contact, air and name; and further terms, such as seams.

        Raises:
            ValueError: There is no cloth, a name is not an identifier, meshes cannot be joined, or a field is not allowed.

        Examples:
            >>> import warpcloth as wc
            >>> felt = wc.Scene(wc.Mesh.grid(3, 3), density=0.4, terms=[wc.Spring(stiffness=1e3)], pins="corners")
            >>> silk = wc.Scene(wc.Mesh.grid(5, 5), density=0.05, terms=[wc.Spring(stiffness=50)])
            >>> wc.Scene.join({"felt": felt, "silk": silk}).terms[1].name
            'silk_Spring'
        """
        found = fields_of_cloths(cloths, whole)
        return cls(**found, pins=Pins(*pins_of_cloths(list(cloths.values()))))

    @property
    def declared(self) -> tuple[object, ...]:
        """Pins, terms, loads and colliders."""
        return (self.pins, *self.terms, self.loads, *self.colliders, self.air)

    def __post_init__(self, fabric: Fabric | str | None, warp: ArrayLike | None) -> None:
        keep_plain(self)
        if not isinstance(self.mesh, Mesh):
            raise ValueError(f"mesh is {shown(self.mesh)}; it must be a Mesh, such as Mesh.grid(32, 32)")
        n = len(self.mesh.points)

        def keep(field, value):
            object.__setattr__(self, field, value)

        if fabric is not None:
            self._refuse_with_fabric()
            fabric = fabrics.find(fabric)
            keep("density", fabric.density)
            keep("terms", fabric.terms(warp=warp_on(self.mesh, warp)))
            keep("thickness", np.nan if fabric.thickness is None else fabric.thickness)
        elif warp is not None:
            raise ValueError("warp is given without fabric; give a fabric, or the terms a warp of their own")
        elif self.thickness is not None and not _is_nan(self.thickness):
            number("thickness", self.thickness, above=0.0)
        number("fps", self.fps, above=0.0)
        number("duration", self.duration, above=0.0)
        frames = float(self.duration) * float(self.fps)
        if not (0.5 < frames < _MAX_FRAMES and abs(frames - round(frames)) < 1e-6 * frames):
            raise ValueError(
                f"duration is {self.duration} s; at fps {self.fps} it must be a whole number of frames from 1 to {_MAX_FRAMES}"
            )
        keep("terms", self._checked_terms())
        gravity = EARTH * np.array(DOWN[self.mesh.up_axis or "Y"]) if self.gravity is None else self.gravity
        keep("gravity", array("gravity", gravity, (3,)))
        keep("positions", self.mesh.points if self.positions is None else array("positions", self.positions, (n, 3)))
        keep("velocities", np.zeros((n, 3)) if self.velocities is None else array("velocities", self.velocities, (n, 3)))
        keep("cloths", tuple(self.cloths))
        if self.cloths and self.cloths != tuple(self.mesh.parts or ()):
            raise ValueError(f"cloths is {shown(self.cloths)}; it must be the names of the parts of the mesh, in their order")
        keep("pins", checked_pins(self.pins, self.mesh))
        keep("loads", checked_loads(self.loads, self.mesh))
        keep("free_axes", _checked_axes(self.free_axes, n))
        self.pins.refuse_far(self.positions)
        if (self.density is None) == (self.masses is None):
            raise ValueError("exactly one of density and masses must be given")
        if self.masses is None:
            number("density", self.density, above=0.0)
        else:
            keep("masses", array("masses", self.masses, (n,)))
        self._check_masses()
        keep("colliders", checked_colliders(self.colliders))
        keep("contact", self._checked_contact())
        keep("self_contact", self._checked_self_contact())
        self._check_air()
        self.refuse_inside(self.positions)

    def _refuse_with_fabric(self):
        for name in ("density", "masses", "terms", "thickness"):
            value = getattr(self, name)
            if not (value is None or (isinstance(value, Sequence) and not value)):
                raise ValueError(f"fabric and {name} are given; a fabric has {name} of its own, so leave one of them out")

    def _checked_terms(self):
        rule = "it must be a list of energies, such as [Spring(stiffness=1e3)]"
        if isinstance(self.terms, Declared):
            raise ValueError(f"terms is one {type(self.terms).__name__} on its own; {rule}")
        if not isinstance(self.terms, Iterable):
            raise ValueError(f"terms is {shown(self.terms)}; {rule}")
        terms = tuple(self.terms)
        for i, term in enumerate(terms):
            if not isinstance(term, Declared):
                given = f"the class {term.__name__}" if isinstance(term, type) else shown(term)
                raise ValueError(f"terms[{i}] is {given}; it must be an energy, such as Spring(stiffness=1e3)")
        return terms

    def _checked_contact(self):
        if not (self.contact is None or isinstance(self.contact, Contact)):
            raise ValueError(f"contact is {shown(self.contact)}; it must be a Contact or None")
        if not self.colliders and (self.contact is None or _is_nan(self.thickness)):
            return self.contact  # it has no effect
        contact = self.contact or Contact(DISTANCE if _is_nan(self.thickness) else None)
        contact = self._with_distance(contact, "contact", 0.5)
        if not self.colliders:
            return contact
        for collider in (each for each in self.colliders if each.is_mesh and np.isinf(contact.stiffness or 0.0)):
            raise ValueError(
                f"contact.stiffness is infinite and the collider {collider.label} is a mesh, with which contact is soft; "
                "give a finite stiffness, or take a plane, sphere, capsule or box"
            )
        for collider in (each for each in self.colliders if each.friction and np.isinf(contact.stiffness or 0.0)):
            raise ValueError(
                f"{collider.label} has friction {collider.friction:g} and contact.stiffness is infinite, which leaves no gap "
                "that says how large the normal force is; give a finite stiffness, or leave friction at 0"
            )
        return self._with_stiffness(contact, "contact")

    def _checked_self_contact(self):
        declared = self.self_contact
        if declared is None:
            return None
        if not isinstance(declared, SelfContact):
            raise ValueError(f"self_contact is {shown(declared)}; it must be a SelfContact or None")
        if not len(self.mesh.triangles):
            raise ValueError("self_contact is given for a mesh without triangles; it must be None")
        return self._with_stiffness(self._with_distance(declared, "self_contact", 1.0), "self_contact")

    def _with_stiffness(self, contact, name):
        if contact.stiffness is not None:
            return contact
        weight = self._areal_mass * float(np.linalg.norm(self.gravity))
        if len(self.mesh.triangles):
            held = [term.held(self.mesh, self.positions)[1] for term in self.terms]
            finite = [K[np.isfinite(K)] for K in held]
            stretching, size = (
                max((float(K.mean()) for K in finite if len(K)), default=0.0),
                float(np.sqrt(self.touching_areas.sum())),
            )
        else:  # a line of edges has no width, so no force per width
            stretching, size = 0.0, float(self.mesh.vertex_lengths.sum())
        found = default_stiffness(contact.distance, weight, stretching, size)
        if not found > 0.0:
            raise ValueError(
                f"{name}.stiffness has no default without gravity and a spring or membrane of finite stiffness; give one [Pa/m]"
            )
        return replace(contact, stiffness=found)

    def _with_distance(self, contact, name, thicknesses):
        if contact.distance is not None:
            return contact
        if _is_nan(self.thickness):
            raise ValueError(
                f"{name} has no distance, and the thickness of the cloth is not known or not the same everywhere; "
                f"give {name} a distance [m]"
            )
        return replace(contact, distance=DISTANCE if self.thickness is None else thicknesses * self.thickness)

    @property
    def touching_areas(self) -> np.ndarray:
        """Areas of vertices in contact (n,) [m²]; of edges, lengths times twice the contact distance."""
        mesh = self.mesh
        if len(mesh.triangles):
            return mesh.vertex_areas
        distance = DISTANCE if self.contact is None else self.contact.distance
        return 2.0 * distance * mesh.vertex_lengths

    @property
    def _areal_mass(self):
        areas = self.touching_areas
        return float(self.vertex_masses[areas > 0.0].sum() / areas.sum())

    @property
    def contact_terms(self) -> tuple[VertexContact, ...]:
        """Contact of free vertices and friction, of all colliders but meshes."""
        if not self.colliders or self.contact is None or self.contact.stiffness is None:
            return ()
        areas, mass = self.touching_areas, self._areal_mass
        areas = np.where(areas > 0.0, areas, self.vertex_masses / mass)  # a vertex without a triangle has an area by its mass
        free = np.delete(np.arange(len(areas), dtype=np.int32), self.fixed)
        if not len(free):
            raise ValueError("pins hold every vertex; colliders need one that is free")
        given: dict[str, Any] = {"vertices": free, "areas": areas[free]}
        given |= {"stiffness": self.contact.stiffness, "distance": self.contact.distance}
        found: list[VertexContact] = []
        for c, collider in enumerate(self.colliders):
            if collider.is_mesh:
                continue
            core, radius = collider.core
            given |= {"collider": c, "pose": collider.poses[0], "core": core, "radius": radius, "solid": collider.solid}
            found.append(VertexContact(name=f"contact with {collider.label}", **given))
            if collider.friction:
                found.append(VertexFriction(name=f"friction on {collider.label}", law=law_of(collider.friction), **given))
        return tuple(found)

    def _check_air(self):
        if not (self.air is None or isinstance(self.air, Air)):
            raise ValueError(f"air is {shown(self.air)}; it must be an Air or None")
        T = len(self.mesh.triangles)
        if self.air is not None and not T:
            raise ValueError("air is given for a mesh without triangles; it must be None")
        if self.air is not None and self.air.keyframes is None and self.air.winds.shape not in ((3,), (T, 3)):
            raise ValueError(f"air.wind has shape {self.air.winds.shape}; it must be (3,), or ({T}, 3), one for each triangle")

    @property
    def air_terms(self) -> tuple[TriangleAir, ...]:
        """The term of the air, if any."""
        air = self.air
        if air is None or not air.density:
            return ()
        given: dict[str, Any] = {"keyframes" if air.keyframes is not None else "wind": air.winds}
        given |= {"normal_drag": air.normal_drag, "tangential_drag": air.tangential_drag, "blow": air.blow}
        return (TriangleAir(name="Air", stiffness=air.density, **given),)

    @property
    def rubbing(self) -> list[int]:
        """Indices of colliders with friction."""
        return [c for c, collider in enumerate(self.colliders) if collider.friction]

    @property
    def meshes(self) -> list[int]:
        """Indices of mesh colliders."""
        return [c for c, collider in enumerate(self.colliders) if collider.is_mesh]

    @property
    def has_pairs(self) -> bool:
        """Whether contact is pairs: of cloth with itself, or with a mesh."""
        return self.self_contact is not None or len(self.meshes) > 0

    def refuse_inside(self, positions: np.ndarray, copy: str = "") -> None:
        """Checks that no free vertex is inside a collider at ``positions`` (n, 3) [m].

        Raises:
            ValueError: One is.
        """
        free = np.ones(len(positions), dtype=bool)
        free[self.fixed] = False
        refuse_inside(self.colliders, positions, free, copy)

    def _check_masses(self):
        masses = self.vertex_masses
        free = np.ones(len(masses), dtype=bool)
        free[self.fixed] = False
        bad = np.flatnonzero(free & ~((masses > 0.0) & np.isfinite(masses)))
        if len(bad):
            raise ValueError(
                f"vertex {bad[0]} has mass {masses[bad[0]]} kg; a vertex that is not pinned must have a finite one above 0"
            )
        refuse("masses", masses, ~((masses >= 0.0) & np.isfinite(masses)), "must be 0 or more, pinned or not")

    @cached_property
    def vertex_masses(self) -> np.ndarray:
        """Mass of each vertex (n,) [kg], given or lumped from the density."""
        if self.masses is not None:
            return self.masses
        with np.errstate(over="ignore"):
            masses = self.density * (self.mesh.vertex_areas if len(self.mesh.triangles) else self.mesh.vertex_lengths)
        masses.setflags(write=False)
        return masses

    @cached_property
    def fixed(self) -> np.ndarray:
        """Vertices that pins hold along every axis, or without a free axis, (f,) int32."""
        axes = self._unlocked
        return self.pins.vertices if axes is None else np.flatnonzero(~axes.any(axis=1)).astype(np.int32)

    @cached_property
    def _unlocked(self) -> np.ndarray | None:
        """Axes along which each vertex moves, (n, 3) booleans; None if all but pins are free."""
        if self.free_axes is None and self.pins.held.all():
            return None
        found = np.ones((len(self.mesh.points), 3), dtype=bool) if self.free_axes is None else self.free_axes.copy()
        found[self.pins.vertices] &= ~self.pins.held
        return found

    @property
    def locked(self) -> np.ndarray | None:
        """Locked coordinates of vertices that can move along another axis, (n, 3) booleans, or None."""
        if self._unlocked is None:
            return None
        found = ~self._unlocked
        found[self.fixed] = False
        return found if found.any() else None

    @property
    def frames(self) -> int:
        """Number of frames after the start."""
        return round(self.duration * self.fps)

    @property
    def up_axis(self) -> UpAxis:
        """The axis of gravity, "Y" or "Z"; without gravity that of the mesh."""
        if not self.gravity[1:].any():
            return self.mesh.up_axis or "Y"
        return "Z" if abs(self.gravity[2]) > abs(self.gravity[1]) else "Y"

    def build(
        self,
        device: str = "cpu",
        dtype: Precision = "float32",
        copies: int = 1,
        vary: Mapping[str, ArrayLike] | None = None,
        order: ArrayLike | None = None,
        threads: int = 1,
    ) -> Model:
        """Builds the :class:`warpcloth.model.model.Model` of this scene on a device; unlike :func:`warpcloth.simulate`, in
        float32 by default.
        """
        return Model(self, device=device, dtype=dtype, copies=copies, vary=vary, order=order, threads=threads)

    def __str__(self) -> str:
        mesh, pins = self.mesh, self.pins
        lines = [
            f"{self.name}: {len(mesh.points)} vertices, {len(mesh.triangles)} triangles, {len(mesh.edges)} edges",
            f"  mass {self.vertex_masses.sum():.4g} kg, gravity {self.gravity.tolist()} m/s²",
            f"  {self.duration:g} s in {self.frames} frames of 1/{self.fps:g} s",
            f"  pins: {len(pins.vertices)}"
            + ("" if pins.held.all() else f", {len(pins.vertices) - len(pins.clamped)} of them along some axes")
            + ("" if pins.keyframes is None else f", moved by {len(pins.keyframes)} keyframes"),
        ]
        for name in self.cloths:
            first, count, _ = (mesh.parts or {})[name]
            lines.append(f"  cloth {name}: {count} vertices, mass {self.vertex_masses[first : first + count].sum():.4g} kg")
        if self.locked is not None:
            counts = ", ".join(f"{count} {axis}" for axis, count in zip("xyz", self.locked.sum(axis=0), strict=True))
            lines.append(f"  locked coordinates: {counts}")
        if self.colliders and self.contact is not None and self.contact.stiffness is not None:
            lines += [f"  {_described(collider)}" for collider in self.colliders]
            lines.append(f"  contact: distance {self.contact.distance:g} m, stiffness {self.contact.stiffness:.4g} Pa/m")
            lines += self._cuts()
        if self.self_contact is not None:
            lines.append(f"  {_described(self.self_contact)}")
        if self.air is not None:
            lines.append(f"  {_described(self.air)}")
        return "\n".join(lines + [f"  {_described(each)}" for each in (*self.terms, *self.loads)])

    def _cuts(self):
        edge = self.mesh.edge_lengths.max()
        if self.contact is None or not len(self.mesh.triangles):
            return
        shapes = [each for each in self.colliders if not each.is_mesh]
        gaps = {each.label: each.clearing_gap(edge) for each in shapes}
        found = [f"{gap:.3g} m of {name}" for name, gap in gaps.items() if gap > self.contact.distance]
        if found:
            why = f"triangles may be cut into between vertices, as edges are up to {edge:.3g} m"
            yield f"  {why}; gaps that prevent it: {', '.join(found)}"


def _is_nan(value):
    return isinstance(value, float) and np.isnan(value)


def _checked_axes(free_axes, n):
    if free_axes is None:
        return None
    found = as_array(free_axes).copy()
    if found.dtype != bool or found.shape != (n, 3):
        given = f"has shape {found.shape}" if found.dtype == bool else f"is {shown(free_axes)}"
        raise ValueError(f"free_axes {given}; it must be an array ({n}, 3) of truth values, one for each axis of each vertex")
    found.setflags(write=False)
    return found


def checked_pins(pins: Any, mesh: Mesh) -> Pins:
    """Returns `Pins` with int32 indices of a mesh; refuses repeated vertices, wrong keyframes and axes."""
    pins = pins if isinstance(pins, Pins) else Pins([] if pins is None else pins)
    vertices = distinct_vertices("pins.vertices", pins.vertices, mesh)
    keyframes = pins.keyframes
    if keyframes is not None:
        if np.ndim(keyframes) == 3 and not len(keyframes):
            raise ValueError("pins.keyframes has no frame; it must have one or more, (F, p, 3)")
        count = len(keyframes) if np.ndim(keyframes) == 3 else 1
        keyframes = array("pins.keyframes", keyframes, (count, len(vertices), 3))
    return Pins(vertices, keyframes, _checked_pin_axes(pins.axes, len(vertices)))


def _checked_pin_axes(axes, count):
    rule = "it must be some of the letters x, y and z, each once, such as 'xz'"
    each = [axes] if isinstance(axes, str) else list(axes) if isinstance(axes, Iterable) else [axes]
    for k, one in enumerate(each):
        if not isinstance(one, str) or not one or len(set(one)) < len(one) or set(one) - set("xyz"):
            raise ValueError(f"pins.axes{'' if isinstance(axes, str) else f'[{k}]'} is {shown(one)}; {rule}")
    if not isinstance(axes, str) and len(each) != count:
        raise ValueError(f"pins.axes has {len(each)} texts for {count} pins; it must be one text, or one for each pin")
    each = ["".join(sorted(one)) for one in each]
    return each[0] if len(set(each)) == 1 else tuple(each) if each else "xyz"


def _described(term):
    parts = []
    for field in fields(term):
        value = getattr(term, field.name)
        if value is not None:
            shown = f"array{np.shape(value)}" if np.ndim(value) and np.size(value) > 4 else repr(value)
            parts.append(f"{field.name}={shown}")
    return f"{type(term).__name__}({', '.join(parts)})"
