"""The filter of self-contact: it shortens moves that would cross, in the steps of a solver and in its iterates."""

from functools import partial

import warp as wp

from ..kernels.contact import self_filter, self_planes
from ..kernels.contact.clear_elements import move_clear
from ..kernels.contact.self_advance import advances, take_advance
from ..kernels.step import count_step
from ..kernels.terms.contact import FLOOR

# A move that is longer than one list of pairs allows is made in at most ROUNDS rounds.
ROUNDS = 32
# The longest move of a vertex in a round, relative to the common motion, over the skin. The vertex may have moved as far since
# the list was made, and so may the other side of a pair: together they approach by at most the skin.
WAY = 0.25
# Vertices that cloth holds back in a collider are moved out in at most OUT_ROUNDS rounds of SWEEPS sweeps. Cloth that makes way
# keeps a gap of LEFT times the contact distance to other cloth, or its present gap if that is smaller.
OUT_ROUNDS, SWEEPS, LEFT = 128, 4, 0.1


class SelfFilter:
    """Moves cloth only as far as the pairs of a :class:`warpcloth.contact.self_steps.SelfSteps` stay apart.

    Args:
        contact: The :class:`warpcloth.contact.self_steps.SelfSteps`.
        colliders: The :class:`warpcloth.contact.collider_steps.ColliderSteps` of the solver, or None.

    Attributes:
        fraction: The fraction of the last direction that pairs left each copy, (B,); only if iterates stay apart.
        moves_together: Whether the filter measures moves relative to their mean. It does if no vertex is pinned or locked along
            an axis and there are no colliders.
    """

    def __init__(self, contact, colliders):
        self.model = model = contact.model
        self._contact, self._colliders, self._cut_before, self._iterates = contact, colliders, None, False
        device = model.device
        self._target, self._from, self._other = (model.vectors() for _ in range(3))
        self._ways = wp.zeros(model.count, dtype=wp.vec3d, device=device)
        self._share, self._least_share = (wp.zeros(model.count, dtype=wp.float64, device=device) for _ in range(2))
        self._common = wp.zeros(model.copies, dtype=wp.vec3d, device=device)
        self._cuts = model.scalars(wp.int32)
        self._rounds, self._walking = (model.scalars(wp.int32) for _ in range(2))
        self._proceed = wp.zeros(1, dtype=wp.int32, device=device)
        self._changed = wp.zeros(1, dtype=wp.int32, device=device)
        self.moves_together = not len(model.scene.fixed) and model.mobility is None and not model.scene.colliders
        made = self_planes.find_ways, self_planes.cut_by_planes, self_planes.common_move
        made += self_filter.keep_apart, self_filter.end_filter, self_filter.add_positions
        if model.keyframes is not None:
            made += self_filter.share_of_pins, self_filter.hold_pins
        declared = model.colliders
        self._lets_out = colliders is not None and (declared.meshes is not None or any(declared.moves))
        if self._lets_out:
            colliders.end_again()
            self._mobile = wp.zeros(model.count, dtype=model.dtype, device=device)
            self._within, self._turns = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
            made += self_filter.find_held, self_filter.push_pairs
        self._kernels = {factory: model.kernel(factory, model.dtype) for factory in made}
        self._count = model.kernel(count_step)

    def _launch(self, factory, dim, inputs, outputs):
        self.model.launch(self._kernels[factory], dim, inputs, outputs)

    def launch_begin(self):
        """Stores, at the start of a step, how many moves colliders have cut so far."""
        if self._cut_before is not None:
            wp.copy(self._cut_before, self._colliders.notes.cut)

    def launch_end(self, x, v, move=None, parts=1):
        """Moves the cloth from its start of the step towards x, as far as pairs stay apart; corrects x, v and ``move``, (N,).

        If the iterates of the solver stay apart, the move starts at the last iterate. But that may be inside a collider, out of
        which the filter of colliders has moved x. Then the move starts at the start of the step, which is outside.

        Pins have moved in ``parts`` equal parts of the step.
        """
        model = self.model
        if self._cut_before is not None:
            colliders = self._colliders
            given = [colliders.x_before, self._cut_before, colliders.notes.cut, model.per_copy]
            self._launch(self_filter.walk_from_start, model.count, given, [self._contact.x_before])
        if self._cut_before is not None:
            self.launch_fresh(self._contact.x_before, self._contact.relist)
        self._contact.launch_near(x, partial(self._launch_end, x, v, move, parts))
        if self._lets_out:
            self._colliders.launch_inside(x, self._from)
        model.launch(self._count, model.copies, [], [self._contact.steps])
        friction = self._contact.friction
        if friction is not None:
            wp.capture_if(friction.present, friction.launch_end, x=x)

    def _launch_end(self, x, v, move, parts):
        model = self.model
        wp.copy(self._target, x)
        wp.copy(x, self._contact.x_before)
        self._walk(x)
        if self._lets_out:
            self._turns.zero_()
            self._walking.fill_(1)
            self._launch_held(x)
            wp.capture_while(self._within, self._launch_let_out, x=x)
        given = [model.inverse_mass, model.mobility, self._target, x, self._contact.steps, model.per_copy]
        given += [self._contact.h, self._contact.h / parts]
        self._launch(self_filter.end_filter, model.count, given, [v, move, self._contact.cut, self._contact.held])

    def launch_hold(self, x, v, hard):
        """Shortens moves of pins to x that other pins are in the way of, before a solver draws cloth after them; corrects v.

        ``hard`` pairs keep the contact distance as a constraint.
        """
        wp.capture_if(self._contact.listed, self._launch_hold, x=x, v=v, hard=hard)

    def _launch_hold(self, x, v, hard):
        model, contact = self.model, self._contact
        self._share.fill_(1.0)
        given = [contact.pairs, model.inverse_mass, contact.begun, x, hard]
        self._launch(self_filter.share_of_pins, len(contact.pairs.stencils), given, [self._share])
        given = [model.inverse_mass, self._share, contact.x_before, contact.steps, model.per_copy]
        self._launch(self_filter.hold_pins, model.count, given, [x, v, contact.held])

    def launch_fresh(self, x, launch, active=None):
        """Calls ``launch`` with x if the next round might miss a pair, as a vertex has moved far since the last list.

        Copies that are not ``active`` (B,) do not count; None means that all do.
        """
        wp.capture_if(self._contact.proximity.moved(x, WAY, active), launch, x=x)

    def _walk(self, x):
        """Moves x towards the target as far as pairs stay apart. On a long move pairs are listed again."""
        self._rounds.zero_()
        self._cuts.zero_()
        self._walking.fill_(1)
        self._proceed.fill_(1)
        wp.capture_while(self._proceed, self._launch_round, x=x)

    def _launch_round(self, x):
        model = self.model
        self.launch_fresh(x, self._contact.relist, self._walking)
        self._launch_planes(x, self._target)
        self._launch_apart(x, self._target)
        self._proceed.zero_()
        noted = [self._cuts, self._rounds, self._walking, self._proceed]
        model.launch(self_filter.another_round, model.copies, [ROUNDS], noted)

    def _launch_apart(self, x, target):
        model = self.model
        wp.copy(self._from, x)
        given = [self._share, self._least_share, self._from, target, self._common, self._walking]
        given += [model.per_copy, WAY * self._contact.skin]
        self._launch(self_filter.keep_apart, model.count, given, [x, self._cuts])

    def _launch_held(self, x):
        """Finds the vertices that cloth holds back inside a collider, and the positions outside to which they must move."""
        model, out = self.model, self._other
        wp.copy(out, x)
        self._colliders.launch_out(out, self._from)
        self._within.zero_()
        given = [model.inverse_mass, x, out, self._turns, OUT_ROUNDS]
        self._launch(self_filter.find_held, model.count, given, [self._mobile, self._within])

    def _launch_let_out(self, x):
        """Moves vertices that are held back towards the outside, and other cloth out of their way."""
        model, out = self.model, self._other
        self.launch_fresh(x, self._contact.launch_list)
        self._contact.launch_sides(x)
        for _ in range(SWEEPS):
            given = [self._contact.pairs, self._mobile, self._contact.begun, x, LEFT * self._contact.declared.distance]
            self._launch(self_filter.push_pairs, 1, given, [out])
        self._launch_planes(x, out)
        self._launch_apart(x, out)
        model.launch(self._count, 1, [], [self._turns])
        self._launch_held(x)

    def _launch_planes(self, x, target):
        """Finds the fraction of each move to ``target`` that planes allow."""
        model, wanted = self.model, [x, target]
        if self.moves_together:
            self._launch(self_planes.common_move, model.copies, [*wanted, model.per_copy], [self._common])
        given = [*wanted, self._common, self._contact.begun_at, model.per_copy, WAY * self._contact.skin]
        self._launch(self_planes.find_ways, model.count, given, [self._ways, self._share, self._least_share])
        if self._colliders is not None and self._colliders.faces is not None:
            self._colliders.faces.launch_least(x, target, self._share)
        given = [self._contact.pairs, self._contact.begun.gap, *wanted, self._common, self._ways]
        self._changed.fill_(1)
        wp.capture_while(self._changed, self._launch_cuts, given=given)

    def _launch_cuts(self, given):
        """Cuts the moves of pairs that would come too near, which may leave other pairs that do."""
        model = self.model
        given = [*given, model.per_copy, FLOOR * self._contact.declared.distance]
        self._launch(self_planes.cut_by_planes, len(self._contact.pairs.stencils), given, [self._share, self._least_share])
        self._changed.zero_()
        model.launch(self_planes.note_cuts, model.count, [self._share], [self._ways, self._changed])

    # For methods whose iterates base + d stay apart too.

    def iterates(self):
        """Prepares the methods below for a solver whose iterates stay apart."""
        terms = () if self._colliders is None else self._colliders.terms
        self._touching = [elements for elements in terms if elements.term.gap]
        self._iterates, model = True, self.model
        self._contact.contact.least = FLOOR * self._contact.declared.distance
        self._kernels[self_filter.scale_directions] = model.kernel(self_filter.scale_directions, model.dtype)
        self._advances, self._advance = self._contact.proximity.searches(take_advance, "advance"), advances(model.dtype)()
        self.fraction = self._advance.fraction = model.scalars()
        self._direction = model.vectors()
        self._advance.least = FLOOR * self._contact.declared.distance
        faces = self._colliders is not None and self._colliders.faces is not None
        if self._colliders is not None and (not self._lets_out or (faces and not any(self.model.colliders.moves))):
            self._cut_before = wp.zeros_like(self._colliders.notes.cut)
            self._kernels[self_filter.walk_from_start] = model.kernel(self_filter.walk_from_start, model.dtype)

    def launch_start(self, base, d):
        """Sets d so that base + d is base if pairs stay apart on the way there, else the start of the step.

        Pins with keyframes are at base in any case: cloth follows them from the start of the step as far as pairs stay apart.
        Vertices stop at the contact distance of colliders. Inside a collider contact is so stiff that a descent would take many
        iterations to get out.
        """
        x, direction = self._contact.x_before, self._direction
        wp.copy(self._target, base)
        for elements in self._touching:
            kernel = self.model.kernel(move_clear, elements.term, self.model.dtype)
            given = [elements.stencil, elements.rest, self.model.inverse_mass]
            self.model.launch(kernel, elements.count, given, [self._target])
        if self.model.keyframes is not None:
            self._walk(x)
        self._add(self._target, x, -1.0, direction)
        self.launch_limit(direction, whole=True)
        self._add(x, base, -1.0, d)
        self._add(d, direction, 1.0, d)

    def launch_between(self, base, before, d):
        """Moves d towards ``before`` (N,), whose pairs are listed, so that pairs stay apart on the way to base + d."""
        self._add(d, before, -1.0, self._direction)
        self.launch_limit(self._direction)
        self._add(before, self._direction, 1.0, d)

    def launch_trial(self, base, d, active=None):
        """Lists the pairs at base + d again, in copies that are ``active`` (B,), if vertices have moved far enough."""
        self._add(base, d, 1.0, self._contact.x_before, active)
        self.launch_fresh(self._contact.x_before, self._contact.relist, active)

    def launch_limit(self, direction, whole=False):
        """Shortens the directions of copies from the positions of :meth:`launch_trial`, so that pairs stay apart all along.

        All vertices of a copy move by the same fraction: shortened at each vertex, a direction would stretch stiff cloth. With
        ``whole``, a direction that pairs do not leave whole becomes 0.
        """
        contact, proximity, target = self._contact, self._contact.proximity, self._other

        def shorten():
            proximity.launch_along(contact.x_before, direction, self._advances, self._advance)
            given = [self.fraction, self.model.per_copy, whole]
            self._launch(self_filter.scale_directions, self.model.count, given, [direction])

        self.fraction.fill_(1.0)
        self._advance.direction = direction
        self._add(contact.x_before, direction, 1.0, target)
        contact.launch_near(target, shorten)

    def launch_look(self, base, d, w):
        """Lists the pairs at base + d, and tests whether the way from there by −w (N,) may be near other cloth."""
        self.launch_trial(base, d)
        self._add(self._contact.x_before, w, -1.0, self._other)
        self._contact.launch_look(self._other)

    def launch_follow(self, base, d):
        """Moves the positions of the iterate towards base + d as :meth:`launch_limit` allows, and lists their pairs."""
        x, direction = self._contact.x_before, self._direction
        self._add(base, x, -1.0, direction)
        self._add(direction, d, 1.0, direction)
        self.launch_limit(direction)
        self._add(x, direction, 1.0, x)
        self.launch_fresh(x, self._contact.relist)

    def _add(self, a, b, sign, out, active=None):
        self._launch(self_filter.add_positions, self.model.count, [a, b, sign, active, self.model.per_copy], [out])
