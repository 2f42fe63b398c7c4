"""Faults of contact that make a run not usable: pins held back, cloth caught in colliders, cloth that meshes pass through.

And a warning, where contact is too soft for what presses on it.
"""

from typing import NamedTuple

import numpy as np

from ..base.turns import in_turn
from ..terms.needs import NORMAL_FORCE
from .history import collider_names


class Inside(NamedTuple):
    """A vertex that ended a step inside a collider, because it could not move out.

    Attributes:
        vertex: Its index in the mesh.
        frame: The frame in or before which it came in.
        collider: Name of the collider.
        other: For a free vertex, the obstacle on its other side: the name of a collider, or ``"other cloth"`` with
            self-contact. None for a vertex that pins or locked axes hold.
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


class Pierced(NamedTuple):
    """A triangle of the cloth through which a corner or an edge of a mesh has passed, between its vertices.

    Attributes:
        triangle: Its index in the mesh of the cloth.
        frame: The frame at the end of which that was so first.
        collider: Name of the mesh.
        copy: Index of its copy.
    """

    triangle: int
    frame: int
    collider: str
    copy: int = 0

    def __str__(self) -> str:
        return f"{self.collider} has passed through triangle {self.triangle} of the cloth, between its vertices, {_where(self)}"


class Pressed:
    """Notes the first frame in which free vertices are nearer to each collider than half the contact distance.

    Args:
        model: The :class:`warpcloth.model.model.Model` of a scene with colliders.

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


@in_turn
def soft_contact_of(watch, stepper):
    """Returns a sentence each about the first frame in which a gap to a collider, and one between cloth and cloth, falls below
    half the contact distance."""
    scene, found = stepper.model.scene, {}
    if watch.pressed is not None:
        names, first = collider_names(scene), watch.pressed.first
        found["contact"] = [(first[of], of[0], f"to {names[of[1]]}") for of in zip(*np.nonzero(first), strict=True)]
    if stepper.pairs is not None:
        pairs = [(frame, copy, "between cloth and cloth") for copy, frame, _vertex in stepper.pairs.pressed]
        found["self_contact"] = [each for each in pairs if each[0] <= watch.good[each[1]]]
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


@in_turn
def inside_of(stepper):
    """Returns the :class:`Inside` of each collider and copy in the steps so far, the first frame first."""
    names, found = collider_names(stepper.model.scene), []
    for copy, collider, step, vertex, other in stepper.inside:
        frame, other = int(step) // stepper.steps_per_frame + 1, names[other] if isinstance(other, int) else other
        found.append(Inside(_in_scene(stepper, vertex), frame, names[collider], other, copy))
    return tuple(sorted(found, key=lambda each: each.frame))


def pierced_of(watch):
    """Returns the :class:`Pierced` of each mesh and copy in the good frames of a watch, the first frame first."""
    names, first = collider_names(watch.model.scene), [] if watch.piercings is None else watch.piercings.first()
    found = [Pierced(triangle, frame, names[c], copy) for copy, c, frame, triangle in first if frame <= watch.good[copy]]
    return tuple(sorted(found, key=lambda each: each.frame))


@in_turn
def held_pins_of(stepper):
    """Returns the :class:`warpcloth.contact.self_steps.PinHeld` of each copy that holds pins back, with indices in the mesh."""
    held = [] if stepper.pairs is None else stepper.pairs.pins_held
    return [pin._replace(vertex=_in_scene(stepper, pin.vertex)) for pin in held]


def held_sentence(pin, copies):
    """Returns the sentence about pins that cloth holds back, without its end, in one of several copies."""
    of_copy = f" of copy {pin.copy}" if copies > 1 else ""
    return f"cloth holds back pins from frame {pin.frame}{of_copy} on, vertex {pin.vertex} first, by up to {pin.farthest:.3g} m"


def unwanted(scene, held):
    """Returns those of the pins that cloth holds back that the scene does not allow."""
    return held if scene.self_contact is not None and scene.self_contact.held_pins != "allow" else []


def contact_faults(scene, held, inside, pierced, copies=1):
    """Returns what makes a run not usable because of contact, a list of (copy, frame, sentence), the first frame first.

    Vertices that are not free and inside a collider are no fault, as the scene puts them there.

    Args:
        scene: The :class:`warpcloth.Scene`.
        held: As of :func:`held_pins_of`.
        inside: The :class:`Inside` of the run.
        pierced: The :class:`Pierced` of the run.
        copies: Number of copies.
    """
    remedy = 'move the pins so that they do not run into cloth, or allow it by SelfContact(held_pins="allow")'
    found = [(pin.copy, pin.frame, f"{held_sentence(pin, copies)}; {remedy}") for pin in unwanted(scene, held)]
    for each in inside:
        if each.other is not None:
            found.append((each.copy, each.frame, f"{each}; leave the cloth room between the two"))
    remedy = 'take Contact(elements="triangles"), in a stage warpcloth:contact:elements, to keep meshes out of triangles too'
    found += [(each.copy, each.frame, f"{each}; {remedy}") for each in pierced]
    return sorted(found, key=lambda fault: fault[1])


def _in_scene(stepper, vertex):
    order = stepper.model.order
    return int(vertex if order is None else order[vertex])
