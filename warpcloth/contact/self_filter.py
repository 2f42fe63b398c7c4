"""The filter of self-contact: it shortens moves that would cross, in steps and in iterates."""

from functools import partial

import numpy as np
import warp as wp

from ..kernels.contact import mesh_moves, piece_motion, self_filter, self_planes
from ..kernels.contact.clear_elements import move_clear
from ..kernels.contact.self_advance import advance_listed, advances, take_advance
from ..kernels.step import count_step
from .proximity import ROUND

# A move that is longer than one list of pairs allows is made in at most ROUNDS rounds.
ROUNDS = 32
# Vertices that cloth holds back in a collider are moved out in at most OUT_ROUNDS rounds of SWEEPS sweeps. Cloth that makes way
# keeps a gap of LEFT times the contact distance to other cloth, or its present gap if that is smaller.
OUT_ROUNDS, SWEEPS, LEFT = 128, 4, 0.1


class SelfFilter:
    """Moves cloth only as far as the pairs of :class:`.SelfSteps` stay apart.

    Attributes:
        back: d of the start of the step (N,) [m], after :meth:`launch_start`.
        fraction: The fraction of the last direction that pairs left each copy, (B,).
        moves_together: Whether moves are measured relative to their mean.
    """

    def __init__(self, contact, colliders):
        self.model = model = contact.model
        self._surface, self._moves = contact.surface, None
        self._contact, self._colliders, self._cut_before = contact, colliders, None
        device = model.device
        self._target, self._from, self._outside, self._other = *(model.vectors() for _ in range(3)), contact.surface.vectors()
        # Obstacles have the share 1 of no way.
        self._ways = wp.zeros(contact.surface.count, dtype=wp.vec3d, device=device)
        self._ways.fill_(wp.vec3d(0.0, 0.0, 1.0))
        self._share, self._least_share = (wp.ones(contact.surface.count, dtype=wp.float64, device=device) for _ in range(2))
        self._common = wp.zeros(model.copies, dtype=wp.vec3d, device=device)
        self._cuts, self._rounds, self._walking, self._near, self._stands = (model.scalars(wp.int32) for _ in range(5))
        self._proceed, self._changed = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self.moves_together = not len(model.scene.fixed) and model.mobility is None and not model.scene.colliders
        self._kernels = {}
        self._make(self_planes.find_ways, self_planes.cut_by_planes, self_planes.common_move)
        self._make(self_filter.keep_apart, self_filter.end_filter, piece_motion.add_positions)
        if model.keyframes is not None:
            self._make(self_filter.share_of_pins, self_filter.hold_pins, self_filter.push_pairs)
            self._pushed, self._forced = model.vectors(), model.scalars(wp.int64)
            unlocked = model.coordinate_mobility().reshape(-1, 3).all(axis=1)
            self._unlocked = model.array(np.where(unlocked, model.inverse_mass.numpy(), 0.0), model.dtype)
        self._lets_out = colliders is not None and any(each.moves and not each.is_mesh for each in model.scene.colliders)
        if self._lets_out:
            colliders.end_again()
            self._mobile = wp.zeros(model.count, dtype=model.dtype, device=device)
            self._within, self._turns = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
            self._pushed = model.vectors()
            self._make(self_filter.find_held, self_filter.push_pairs)
        self._prepare_advance()
        if contact.surface.moves:
            self._prepare_carrying()
        self._count = model.kernel(count_step)

    def _make(self, *made):
        self._kernels |= {factory: self.model.kernel(factory, self.model.dtype) for factory in made}

    def _launch(self, factory, dim, inputs, outputs):
        self.model.launch(self._kernels[factory], dim, inputs, outputs)

    def launch_begin(self):
        if self._cut_before is not None:
            wp.copy(self._cut_before, self._colliders.notes.cut)

    def launch_end(self, x, v, move=None, parts=1):
        """Moves the cloth from the start of the step towards x, as far as pairs stay apart; corrects x, v and ``move``, (N,).

        If iterates stay apart, the move starts at the last one. If a vertex left a collider, and its copy does not arrive at x,
        the copy moves again from the start of the step. Pins have moved in ``parts`` equal parts.
        """
        model = self.model
        if self._cut_before is not None and self._surface.moves:
            wp.copy(self._forced_before, self._contact.first_forced)
        self._launch_meshes(self._contact.placed[2], lists=True)
        self._put(self._other, x)
        self._add(self._other, self._contact.x_before, -1.0, self._direction)
        self._proceed.zero_()
        self._launch_fraction(self._direction, self._other, self._launch_divide)
        wp.capture_if(self._proceed, partial(self._launch_end, x, v, move, parts))
        if self._lets_out:
            self._colliders.launch_inside(x, self._from)
        model.launch(self._count, model.copies, [], [self._contact.steps])
        friction = self._contact.friction
        if friction is not None:
            wp.capture_if(friction.present, friction.launch_end, x=x)

    def _launch_end(self, x, v, move, parts):
        model, start = self.model, self._contact.x_before
        wp.copy(self._target, x)
        self._add(self._target, None, 1.0, start, self._stands)
        wp.copy(self._walking, self._near)
        self._launch_rounds(start)
        if self._cut_before is not None:
            self._launch_from_start(start)
        if self._lets_out:
            self._turns.zero_()
            wp.copy(self._walking, self._near)
            self._launch_held(start)
            wp.capture_while(self._within, self._launch_let_out, x=start)
        wp.copy(x, start, count=model.count)
        given = [model.inverse_mass, model.mobility, self._target, x, self._contact.h, self._contact.h / parts]
        self._launch(self_filter.end_filter, model.count, given, [v, move, self._contact.cut, self._contact.held])

    def _launch_divide(self):
        out = [self._near, self._stands, self._proceed]
        self.model.launch(self_filter.divide_copies, self.model.copies, [self.fraction], out)

    def _launch_from_start(self, x):
        self._walking.zero_()
        self._proceed.zero_()
        given = [x, self._target, self._cut_before, self._colliders.notes.cut, self.model.per_copy]
        self._launch(self_filter.find_short, self.model.count, given, [self._walking, self._proceed])
        wp.capture_if(self._proceed, self._launch_again, x=x)

    def _launch_again(self, x):
        layout = self._surface.layout
        self._launch(self_filter.walk_from_start, self.model.count, [self._colliders.x_before, self._walking, layout, 0], [x])
        if self._surface.moves:
            given = [self._contact.placed[0], self._walking, layout, self.model.count]
            self._launch_move(self_filter.walk_from_start, given, [self._surface.behind(x)])
            given = [self._forced_before, self._walking]
            self.model.launch(self_filter.take_back, self.model.copies, given, [self._contact.first_forced])
            wp.copy(self._again, self._walking)
            self.launch_fresh(x, self._contact.relist)
            self._launch_meshes(self._contact.placed[2], lists=True, active=self._again)
            wp.copy(self._walking, self._again)
        self._launch_rounds(x)

    def launch_hold(self, x, v, hard):
        """Shortens moves of pins to x that other pins are in the way of; corrects v. ``hard`` pairs are constraints."""
        wp.capture_if(self._contact.listed, self._launch_hold, x=x, v=v, hard=hard)

    def _launch_hold(self, x, v, hard):
        model, contact = self.model, self._contact
        self._share.fill_(1.0)
        given = [contact.pairs, model.inverse_mass, contact.begun, contact.x_before, x, hard]
        self._launch(self_filter.share_of_pins, len(contact.pairs.stencils), given, [self._share])
        given = [model.inverse_mass, self._share, contact.x_before]
        self._launch(self_filter.hold_pins, model.count, given, [x, v, contact.held])

    def launch_fresh(self, x, launch, active=None, part=None):
        """Calls ``launch`` with x if ``active`` copies (B,), or any, have moved by ``part`` of the skin.

        By default another round misses no pair; with ½ none is missing at x.
        """
        proximity = self._contact.proximity
        wp.capture_if(proximity.moved(x, part or proximity.kept, active), launch, x=x)

    def _launch_sides(self, x, active=None):
        self.launch_fresh(x, self._contact.launch_list, active)
        self._contact.launch_sides(x)

    def _launch_rounds(self, x):
        self._rounds.zero_()
        self._cuts.zero_()
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
        wp.copy(self._from, x, count=self.model.count)
        given = [self._share, self._least_share, self._from, target, self._common, self._walking]
        given += [model.per_copy, ROUND * self._contact.skin]
        self._launch(self_filter.keep_apart, model.count, given, [x, self._cuts])

    def _launch_held(self, x):
        """Finds vertices that cloth holds back inside a collider, and positions outside for them."""
        model, out = self.model, self._outside
        wp.copy(out, x, count=model.count)
        self._colliders.launch_out(out, self._from)
        self._within.zero_()
        given = [model.inverse_mass, x, out, self._turns, OUT_ROUNDS]
        self._launch(self_filter.find_held, model.count, given, [self._mobile, self._within])

    def _launch_let_out(self, x):
        model, out = self.model, self._outside
        self._launch_sides(x)
        self._add(out, x, -1.0, self._pushed)
        self._launch_pushes(self._mobile, self._pushed, opens=False)
        self._add(x, self._pushed, 1.0, out)
        self._launch_planes(x, out)
        self._launch_apart(x, out)
        model.launch(self._count, 1, [], [self._turns])
        self._launch_held(x)

    def _launch_pushes(self, mobile, p, opens):
        for _ in range(SWEEPS):
            given = [self._contact.pairs, mobile, self._contact.begun, LEFT * self._contact.distance, opens]
            self._launch(self_filter.push_pairs, 1, given, [p])

    def _launch_ways(self, x, target):
        model = self.model
        if self.moves_together:
            self._launch(self_planes.common_move, model.copies, [x, target, model.per_copy], [self._common])
        given = [x, target, self._common, self._contact.begun_at, model.per_copy, ROUND * self._contact.skin]
        given += [self._surface.obstacles == 0]
        self._launch(self_planes.find_ways, model.count, given, [self._ways, self._share, self._least_share])

    def _launch_planes(self, x, target):
        self._launch_ways(x, target)
        given = [self._contact.pairs, self._contact.begun.gap, x, target, self._common, self._ways]
        self._changed.fill_(1)
        wp.capture_while(self._changed, self._launch_cuts, given=given)

    def _launch_cuts(self, given):
        model, given = self.model, [*given, self._contact.least]
        self._launch(self_planes.cut_by_planes, len(self._contact.pairs.stencils), given, [self._share, self._least_share])
        self._changed.zero_()
        model.launch(self_planes.note_cuts, model.count, [self._share], [self._ways, self._changed])

    def _prepare_advance(self):
        model = self.model
        self._direction = model.vectors()
        self._make(self_filter.scale_directions, advance_listed)
        self._advances, self._advance = self._contact.proximity.searches(take_advance, "advance"), advances(model.dtype)()
        self.fraction = self._advance.fraction = model.scalars()
        self._advance.far, self._advance.least = self._contact.proximity.copies, self._contact.least
        self._advance.found, self._advance.alike = self._contact.proximity.found, self._contact.proximity.alike

    # Meshes that move, and cloth that they carry along, see :mod:`warpcloth.kernels.contact.mesh_moves`.

    def _prepare_carrying(self):
        model, device = self.model, self.model.device
        self._moves = self._surface.vectors()
        self._carried, self._keys = (wp.zeros(model.count, dtype=wp.int64, device=device) for _ in range(2))
        self._make(mesh_moves.aim_obstacles, mesh_moves.find_carriers, mesh_moves.carry_vertices)
        self._make(self_filter.push_pairs, piece_motion.compare_positions)

    def _launch_move(self, factory, inputs, outputs):
        self._launch(factory, self._surface.count - self.model.count, inputs, outputs)

    def launch_meshes(self):
        """Moves meshes, and cloth out of their way, to where forces are evaluated."""
        self._launch_meshes(self._contact.placed[1])

    def _launch_meshes(self, goal, lists=False, active=None):
        """Moves meshes to their ``goal`` (B·m,) [m], and cloth out of their way, in ``active`` copies (B,)."""
        if not self._surface.moves:
            return
        x = self._contact.x_before
        for array in (self._rounds, self._proceed):
            array.zero_()
        if active is None:
            self._walking.fill_(1)
        else:
            wp.copy(self._walking, active)
        self._launch_move(piece_motion.compare_positions, [goal, self._surface.behind(x)], [self._proceed])
        if lists:
            wp.capture_if(self._proceed, self._launch_sides, x=x)
        wp.capture_while(self._proceed, self._launch_meshes_on, x=x, goal=goal)

    def _launch_meshes_on(self, x, goal):
        p = self._moves
        for array in (p, self._carried, self._keys):
            array.zero_()
        self._launch_move(mesh_moves.aim_obstacles, [goal], [self._surface.behind(x), self._surface.behind(p)])
        self._launch_carriers(of_meshes=True)
        self._launch_carry_on()
        self.launch_limit(p)
        self._add(x, p, 1.0, x, self._walking)
        self.model.launch(self._count, 1, [], [self._rounds])
        self._proceed.zero_()
        self._launch_end_move()
        wp.capture_if(self._proceed, lambda: None, lambda: wp.copy(self._surface.behind(x), goal))  # also of those on their way
        self._launch_sides(x)

    def _launch_end_move(self):
        given = [self.fraction, self._rounds, self._contact.steps, ROUNDS, self._contact.per_frame]
        out = [self._walking, self._proceed, self._contact.first_forced]
        self.model.launch(self_filter.end_move, self.model.copies, given, out)

    def _launch_shapes(self):
        """Carries cloth along with shapes that move onto it."""
        model, x, colliders = self.model, self._contact.x_before, self._colliders
        for array in (self._moves, self._carried, self._keys, self._changed):
            array.zero_()
        self._walking.fill_(1)
        given = [model.inverse_mass, colliders.filter, x, model.colliders.distance]
        model.launch(self._carry_with_shapes, model.count, given, [self._moves, self._keys, self._changed])
        wp.copy(self._carried, self._keys)
        wp.capture_if(self._changed, self._launch_walk_with_shapes, x=x)

    def _launch_walk_with_shapes(self, x):
        self._launch_carry_on()
        self._add(x, self._moves, 1.0, self._target)
        self._launch_rounds(x)

    def _launch_carry_on(self):
        self._changed.fill_(1)
        wp.capture_while(self._changed, self._launch_carriers, of_meshes=False)
        self._launch_pushes(self.model.inverse_mass, self._moves, opens=True)
        self.model.lock(self._moves)

    def _launch_carriers(self, of_meshes):
        model, contact = self.model, self._contact
        self._changed.zero_()
        given = [contact.pairs, contact.begun, self._carried, of_meshes, contact.skin + contact.max_distance]
        self._launch(mesh_moves.find_carriers, len(contact.pairs.stencils), given, [self._keys, self._changed])
        given = [contact.pairs, model.inverse_mass, model.mobility, contact.begun, self._keys, self._carried]
        self._launch(mesh_moves.carry_vertices, model.count, given, [self._moves])
        wp.copy(self._carried, self._keys)

    # For methods whose iterates base + d stay apart too.

    def iterates(self):
        """Prepares the methods below."""
        self._touching = () if self._colliders is None else self._colliders.solid
        model = self.model
        self._contact.contact.least = self._contact.least
        self.back = model.vectors()
        if self._lets_out:
            if self._moves is None:
                self._prepare_carrying()
            self._carry_with_shapes = model.kernel(mesh_moves.carry_with_shapes, model.dtype, model.colliders.solids)
        self._make(self_filter.aim)
        if self._colliders is not None and not self._lets_out:
            self._cut_before = wp.zeros_like(self._colliders.notes.cut)
            self._again, self._forced_before = wp.zeros_like(self._walking), model.scalars(wp.int64)
            self._make(self_filter.find_short, self_filter.walk_from_start)

    def launch_start(self, base, d):
        """Sets d so that base + d is base if pairs stay apart on the way there, else the start of the step.

        Pins with keyframes are at base in any case. If pairs do not stay apart on the way of the pins alone, other vertices
        move towards base too, and then those in the way of pins move ahead of them. Vertices stop at the contact distance of
        colliders.
        """
        x, direction = self._contact.x_before, self._direction
        self.launch_meshes()
        self._add(x, base, -1.0, self.back)
        if self._lets_out:
            self._launch_shapes()
        wp.copy(self._target, base)
        self._launch_clear(self._target, self.model.inverse_mass)
        self._add(self._target, x, -1.0, direction)
        self.launch_limit(direction, whole=True)
        if self.model.keyframes is not None:
            self._aim(self._target, x, False, True, self.fraction, direction)
            self.launch_limit(direction, whole=True)
            self._launch_begin_push()
            wp.capture_if(self._proceed, self._launch_pins, x=x)
        self._add(x, base, -1.0, d)
        self._add(d, direction, 1.0, d)

    def _launch_clear(self, x, inverse_mass):
        for elements in self._touching:
            kernel = self.model.kernel(move_clear, elements.term, self.model.dtype)
            self.model.launch(kernel, elements.count, [elements.stencil, elements.rest, inverse_mass], [x])

    def launch_touching(self, active, touching, some):
        """Sets ``touching`` (B,): ``active`` copies (B,) near colliders or in contact; ``some``: any is."""
        model, contact, colliders = self.model, self._contact.contact, self._colliders
        near = None if colliders is None else colliders.near
        always = colliders is not None and near is None
        some.zero_()
        model.launch(self_filter.copies_near_colliders, model.copies, [near, active, always], [touching, some])

        def in_contact():
            model.launch(self_filter.copies_in_contact, contact.capacity, [contact.pairs, active], [touching, some])

        wp.capture_if(self._contact.listed, in_contact)

    def launch_aim(self, goal, d, direction):
        """Sets the direction of free vertices from d to ``goal`` (N,) [m]."""
        self._aim(goal, d, True, False, None, direction)

    def launch_whole(self, direction, wanted, some):
        """Limits the direction as :meth:`launch_limit` if it is ``whole``, and clears ``wanted`` (B,) of copies that it stops.

        ``some`` (1,) is 1 if a copy is still wanted.
        """
        self.launch_limit(direction, whole=True)
        some.zero_()
        self.model.launch(self_filter.copies_free, self.model.copies, [self.fraction], [wanted, some])

    def _aim(self, goal, x, free, pinned, fraction, p):
        model = self.model
        given = [model.inverse_mass, model.mobility, goal, x, free, pinned, fraction, model.per_copy]
        self._launch(self_filter.aim, model.count, given, [p])

    def _launch_pins(self, x):
        """Moves the cloth with its pins, then pins with cloth in their way ahead of them."""
        self._launch_rounds(x)
        self._launch_begin_push()
        wp.capture_while(self._proceed, self._launch_pins_on, x=x)
        for free, fraction in (True, None), (False, self.fraction):
            self._aim(self._target, x, free, True, fraction, self._direction)
            self.launch_limit(self._direction, whole=True)

    def _launch_pins_on(self, x):
        p = self._pushed
        self._launch_sides(x, self._walking)
        p.zero_()
        self._aim(self._target, x, False, True, self.fraction, p)
        self._launch_pushes(self._unlocked, p, opens=True)
        self._add(x, p, 1.0, p)
        self._launch_clear(p, self._unlocked)
        self._add(p, x, -1.0, p)
        self.launch_limit(p)
        self._add(x, p, 1.0, x, self._walking)
        self.model.launch(self._count, 1, [], [self._rounds])
        self._launch_end_push()

    def _launch_begin_push(self):
        self._rounds.zero_()
        self._walking.fill_(1)
        self._launch_end_push()

    def _launch_end_push(self):
        self._proceed.zero_()
        given = [self.fraction, self._rounds, self._contact.steps, ROUNDS, self._contact.per_frame]
        out = [self._walking, self._proceed, self._forced]
        self.model.launch(self_filter.end_move, self.model.copies, given, out)

    def launch_between(self, before, d):
        """Moves d towards ``before`` (N,), so that pairs stay apart on the way to d."""
        self._add(d, before, -1.0, self._direction)
        self.launch_limit(self._direction)
        self._add(before, self._direction, 1.0, d)

    def launch_trial(self, base, d, active=None):
        """Lists the pairs at base + d again, in ``active`` copies (B,), if any may be missing."""
        self._add(base, d, 1.0, self._contact.x_before, active)
        self.launch_fresh(self._contact.x_before, self._contact.relist, active, 0.5)

    def launch_limit(self, direction, whole=False):
        """Shortens the directions of copies from the positions of :meth:`launch_trial`, so that pairs stay apart all along.

        All vertices of a copy move by the same fraction; with ``whole`` it is 0 if not 1.
        """
        given = [self.fraction, self._surface.layout, whole]
        scale = partial(self._launch, self_filter.scale_directions, len(direction), given, [direction])
        self._add(self._contact.x_before, direction, 1.0, self._other)
        self._launch_fraction(direction, self._other, scale)

    def _launch_fraction(self, direction, end, then):
        """Finds the ``fraction`` of the ``direction`` to ``end`` along which pairs stay apart; calls ``then`` unless all do."""
        contact, advance = self._contact, self._advance

        def far():
            contact.proximity.launch_along(contact.x_before, direction, self._advances, advance)
            listed()

        def listed():
            given = [contact.pairs, contact.begun.gap, contact.begun_at, contact.x_before]
            self._launch(advance_listed, len(contact.pairs.stencils), given, [advance])
            then()

        self.fraction.fill_(1.0)
        advance.direction = direction
        contact.launch_far(end, direction)
        wp.capture_if(contact.far, far, lambda: wp.capture_if(contact.listed, listed))

    def launch_look(self, base, ends):
        """Sets ``near`` to 0 if no pair is listed, and none can be missing at base + d for d of ``ends``, else to 1.

        If d of the last :meth:`launch_look` or :meth:`launch_trial` was not near, pairs stay apart on the ways from there too.
        """
        near, x = self._contact.near.array, self._other
        wp.copy(near, self._contact.listed)
        self._put(x, base)
        for d in ends:
            self._contact.proximity.launch_moved_since(x, 0.5, None, near, d)

    def launch_near_trial(self, base, d):
        wp.capture_if(self._contact.near.array, self.launch_trial, base=base, d=d)

    def launch_follow(self, base, d):
        """Moves the positions of the iterate towards base + d as :meth:`launch_limit` allows, and lists their pairs.

        Copies without pairs at the start of the step stay there.
        """
        x, direction, listed = self._contact.x_before, self._direction, self._contact.with_pairs
        self._add(base, x, -1.0, direction)
        self._add(direction, d, 1.0, direction)
        self.launch_limit(direction)
        self._add(x, direction, 1.0, x, listed)
        self.launch_fresh(x, self._contact.relist, listed)

    def _put(self, out, x):
        wp.copy(out, x, count=self.model.count)
        if self._surface.obstacles:
            wp.copy(self._surface.behind(out), self._surface.behind(self._contact.x_before))

    def _add(self, a, b, sign, out, active=None):
        count = min(len(a), len(out))
        self._launch(piece_motion.add_positions, count, [a, b, sign, active, self._surface.layout], [out])
