"""Faults and warnings of contact: pins held back, cloth caught in colliders, meshes that move through cloth, soft contact."""

from typing import NamedTuple

import numpy as np

from ..scene.colliders import turned
from ..terms.needs import NORMAL_FORCE
from .history import collider_names


class Inside(NamedTuple):
    """A vertex that ended a step inside a collider, because it could not move out.

    Attributes:
        vertex: Its index in the mesh.
        frame: The frame in or before which it came in.
        collider: Name of the collider.
        other: For a free vertex, the obstacle on its other side: a collider, or ``"other cloth"``. None for a held vertex.
        copy: Index of its copy.
    """

    vertex: int
    frame: int
    collider: str
    other: str | None = None
    copy: int = 0

    def __str__(self) -> str:
        if self.other is None:
            return f"{self.collider} comes over vertex {self.vertex}, which is not free to move, {_where(self)}"
        return f"vertex {self.vertex} is caught between {self.collider} and {self.other} {_where(self)}"


class Forced(NamedTuple):
    """The first time that a mesh moved through cloth that could not move away.

    Attributes:
        frame: The frame in whose steps it did.
        collider: Name of the mesh, or "a mesh" if several move.
        copy: Index of the copy.
    """

    frame: int
    collider: str
    copy: int = 0

    def __str__(self) -> str:
        return f"{self.collider} moves through cloth that cannot get out of its way {_where(self)}"


class Pressed:
    """Notes the first frame in which free vertices are nearer to each collider than half the contact distance.

    Attributes:
        first: That frame, from 1, or 0, (B, C).
    """

    carried = ("first",)

    def __init__(self, model):
        self._scene, self.first = model.scene, np.zeros((model.copies, len(model.scene.colliders)), dtype=int)
        self._free = np.delete(np.arange(model.per_copy), model.scene.fixed)

    def note(self, number, points, alive):
        """Notes the colliders that are near at points (B, n, 3) of a frame of the copies ``alive`` (B,)."""
        near = 0.5 * self._scene.contact.distance
        for copy, c in np.argwhere((self.first == 0) & alive[:, None]):
            if self._scene.colliders[c].is_near(points[copy, self._free], near, number):
                self.first[copy, c] = number


def soft_contact_of(watch, stepper):
    """Returns a sentence each about the first frame in which a gap to a collider, or between cloth and cloth, is below half the
    contact distance (r/4 for edges and for vertices of meshes).
    """
    scene, found = stepper.model.scene, {}
    if watch.pressed is not None:
        names, first = collider_names(scene), watch.pressed.first
        found["contact"] = [(first[of], of[0], f"to {names[of[1]]}") for of in zip(*np.nonzero(first), strict=True)]
    pressed = ((), ()) if stepper.pairs is None else stepper.pairs.pressed
    for name, other, gaps in zip(("self_contact", "contact"), ("cloth", "a mesh"), pressed, strict=True):
        pairs = [(frame, copy, f"between cloth and {other}") for copy, frame, _vertex in gaps]
        found[name] = found.get(name, []) + [each for each in pairs if each[0] <= watch.good[each[1]]]
    sentences = []
    for name, near in found.items():
        for frame, copy, where in sorted(near, key=lambda each: each[:2])[:1]:
            in_frame = f"in frame {frame}" + (f" of copy {copy}" if stepper.model.copies > 1 else "")
            hard = NORMAL_FORCE in stepper.options.needs or np.isinf(getattr(scene, name).stiffness)
            remedy = "more iterations leave" if hard else f"a larger {name}.stiffness leaves"
            sentences.append(f"{in_frame} the gap {where} falls below half the contact distance; {remedy} a larger one")
    return sentences


def _where(found):
    return f"in frame {found.frame}" + (f" of copy {found.copy}" if found.copy else "")


def inside_of(stepper):
    """Returns the :class:`Inside` of each collider and copy in the steps so far, the first frame first."""
    names, found = collider_names(stepper.model.scene), []
    for copy, collider, step, vertex, other in stepper.inside:
        frame, other = int(step) // stepper.steps_per_frame + 1, names[other] if isinstance(other, int) else other
        found.append(Inside(_in_scene(stepper, vertex), frame, names[collider], other, copy))
    return tuple(sorted(found, key=lambda each: each.frame))


def forced_of(stepper):
    """Returns the :class:`Forced` of each mesh and copy in the steps so far, the first frame first."""
    scene = stepper.model.scene
    names, first = collider_names(scene), stepper.pairs.forced if scene.meshes else []
    return tuple(sorted(Forced(frame, "a mesh" if c is None else names[c], copy) for copy, frame, c in first))


class Unresolved(NamedTuple):
    """The first time that rounding of positions stopped cloth where its contact begins.

    Attributes:
        vertex: Index of a vertex of the pair in the mesh.
        type: Name of the scalar type of positions.
    """

    frame: int
    vertex: int
    type: str
    copy: int = 0

    def __str__(self) -> str:
        return (
            f"{self.type} is too coarse for the contact distance so far from the origin: rounding of positions stops cloth at "
            f"vertex {self.vertex} {_where(self)}"
        )


def unresolved_of(stepper):
    """Returns the :class:`Unresolved` of each copy in the steps so far, the first frame first."""
    found, name = [] if stepper.pairs is None else stepper.pairs.unresolved, stepper.model.numpy_dtype.__name__
    found = [Unresolved(frame, _in_scene(stepper, vertex), name, copy) for copy, frame, vertex in found]
    return tuple(sorted(found, key=lambda each: each.frame))


def crossings_at_start(model):
    """Returns a sentence about the triangles of free cloth that cross each mesh at the start of the first copy where some do.

    Triangles with a held vertex are left out: they may be inside a mesh.
    """
    scene, sentences, n = model.scene, [], model.per_copy
    if not scene.meshes:
        return sentences
    free = model.in_scene_order((model.coordinate_mobility().reshape(-1, 3) > 0.0).all(axis=1)).reshape(-1, n)[0]
    triangles = scene.mesh.triangles[free[scene.mesh.triangles].all(axis=1)]
    points = model.in_scene_order(model.positions.numpy()).astype(np.float64).reshape(-1, n, 3)
    _, first = np.unique(points.reshape(len(points), -1), axis=0, return_index=True)  # copies that start alike are tested once
    names = collider_names(scene)
    for c in scene.meshes:
        mesh = scene.colliders[c]
        corners = (turned(mesh.poses[0, 3:], mesh.frames[0]) + mesh.poses[0, :3])[mesh.triangles]
        for copy in np.sort(first):
            count = _count_crossing(points[copy, triangles], corners)
            if count:
                what, stays = f"{count} triangles of the cloth cross", "they stay hooked"
                if count == 1:
                    what, stays = "1 triangle of the cloth crosses", "it stays hooked"
                of_copy = f" of copy {copy}" if model.copies > 1 else ""
                sentences.append(f"{what} the collider {names[c]} at the start{of_copy}; {stays}")
                break
    return sentences


def _count_crossing(own, others):
    from scipy.spatial import cKDTree

    if not len(own):
        return 0
    others = others[_boxes_meet(others, own.reshape(1, -1, 3))]
    (centres, radii), (other_centres, other_radii) = _balls(own), _balls(others)
    near = cKDTree(centres).query_ball_point(other_centres, other_radii + radii.max(), return_sorted=False)
    second = np.repeat(np.arange(len(others)), [len(each) for each in near])
    first = np.concatenate([*near, []]).astype(np.int64)
    meet = _boxes_meet(own[first], others[second])
    first, second = first[meet], second[meet]
    crosses = np.zeros(len(first), dtype=bool)
    for one, other in ((own[first], others[second]), (others[second], own[first])):
        for k in range(3):
            crosses |= _passes_through(one[:, k], one[:, k - 1], *other.swapaxes(0, 1))
    return len(np.unique(first[crosses]))


def _boxes_meet(one, other):
    return ((one.min(axis=1) <= other.max(axis=1)) & (other.min(axis=1) <= one.max(axis=1))).all(axis=1)


def _balls(corners):
    centres = corners.mean(axis=1)
    return centres, np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)


def _passes_through(p, q, a, b, c):
    def volume(a, b, c, d):
        return np.einsum("ki,ki->k", np.cross(b - a, c - a), d - a)

    sides = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    within = (sides >= 0.0).all(axis=0) | (sides <= 0.0).all(axis=0)
    return within & (volume(a, b, c, p) * volume(a, b, c, q) < 0.0)


def held_pins_of(stepper):
    """Returns the :class:`warpcloth.contact.self_steps.PinHeld` of each copy that holds pins back, with indices in the mesh."""
    held = [] if stepper.pairs is None else stepper.pairs.pins_held
    return [pin._replace(vertex=_in_scene(stepper, pin.vertex)) for pin in held]


def held_sentence(pin, copies):
    """Returns the sentence, without its end, about pins that cloth holds back."""
    of_copy = f" of copy {pin.copy}" if copies > 1 else ""
    return f"cloth holds back pins from frame {pin.frame}{of_copy} on, vertex {pin.vertex} first, by up to {pin.farthest:.3g} m"


def unwanted(scene, held):
    """Returns the held pins that the scene does not allow."""
    return held if scene.self_contact is None or scene.self_contact.held_pins != "allow" else []


def contact_faults(scene, held, inside, forced, unresolved, copies=1):
    """Returns the faults of contact that make a run not usable, (copy, frame, sentence), sorted by frame.

    Held vertices inside a collider are no fault: the scene puts them there.
    """
    remedy = 'move the pins so that they do not run into cloth, or allow it by SelfContact(held_pins="allow")'
    found = [(pin.copy, pin.frame, f"{held_sentence(pin, copies)}; {remedy}") for pin in unwanted(scene, held)]
    for each in inside:
        if each.other is not None:
            found.append((each.copy, each.frame, f"{each}; leave the cloth room between the two"))
    for each in forced:
        found.append((each.copy, each.frame, f"{each}; take more steps a frame, or move {each.collider} more slowly"))
    for each in unresolved:
        remedy = "move the scene to the origin, compute in float64, or allow a larger contact distance"
        found.append((each.copy, each.frame, f"{each}; {remedy}"))
    return sorted(found, key=lambda fault: fault[1])


def _in_scene(stepper, vertex):
    order = stepper.model.order
    return int(vertex if order is None else order[vertex])
