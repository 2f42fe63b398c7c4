"""The energy of self-contact in the steps of a solver."""

import warp as wp

from ..base.limits import refuse_memory
from ..core.capture import Mirror
from ..core.dynamic_elements import DynamicElements
from ..core.filled import filled
from ..kernels.block_rows import LANES
from ..kernels.contact import pair_follow
from ..kernels.contact import pair_potential as potential
from ..kernels.contact import self_contact as kernels
from ..kernels.contact.self_pairs import bound_number

# Sweeps, of a hierarchy those of the finest level, find contacts anew after so many, which costs as much as 2 or 3 sweeps.
# Sooner, XPBD gains no less energy.
EVERY = 10
# Memory of a contact with friction, including forces and blocks [bytes]: up to 2153 in float64, with meshes.
BYTES_OF_A_CONTACT = 2200


class PairContact(DynamicElements):
    """Contact of cloth with itself: the potential of :mod:`warpcloth.kernels.contact.pair_potential`.

    Args:
        bounded: Whether contact is that of explicit steps, without the logarithm.
        listed: Whether there are listed pairs, (1,) int32.

    Attributes:
        obstacles: Positions (V,) [m] with the obstacles where forces are evaluated.
        least: The least gap [m] of a filter that keeps all pairs apart wherever forces are computed, otherwise 0.
        slots: Number of slots that the next :meth:`hold` allocates.
        most: The largest number of contacts so far, also of those that did not fit, a mirror of (1,) int32.
    """

    def __init__(self, surface, bounded, laws, listed):
        self.surface = surface
        model = surface.model
        super().__init__(model, kernels.CONTACT_OF_PAIRS, listed)
        self.least, self._laws, device = 0.0, laws, model.device
        self.most = Mirror(wp.zeros(1, dtype=wp.int32, device=device))
        self.slots = max(2048, min(8 * model.count, 8192), model.count // 2)  # some launches take all slots
        areas = [wp.array(surface.of_model(each), dtype=wp.float64, device=device) for each in surface.areas()]
        rest = wp.array(surface.rest, dtype=wp.vec3d, device=device)
        self._areas = filled(potential.Areas, of_vertices=areas[0], of_edges=areas[1], rest=rest)
        self.obstacles, self._goal = (surface.vectors() for _ in range(2)) if surface.obstacles else (None, None)
        self._of_edges = not bounded  # the filter alone keeps edges, and vertices of meshes, apart in explicit steps
        self._find = model.kernel(kernels.find_forces, model.dtype, bounded)
        of_vertices = potential.find_near_faces, potential.count_multiplicities, potential.find_vertex_contacts
        self._launch = model.launcher(((*of_vertices, potential.find_edge_contacts), model.dtype))
        self._corners = model.device.is_cuda

    def list_corners(self):
        if not self._corners:
            self._corners = True
            self.hold(self.lists, self._normals)

    def hold(self, lists, normals):
        """Takes the listed pairs and their normals (capacity,), and allocates contacts.

        Raises:
            ValueError: There is not enough memory.
        """
        slots, listed, device = self.slots, len(lists.stencils), self.model.device
        refuse_memory(f"the cloth needs room for {slots} contacts", BYTES_OF_A_CONTACT * slots, device)
        self.lists, self._normals = lists, normals
        pairs = self.new_pairs(slots, 2 * listed, self.surface.layout, self._corners)
        kinds = {"weights": wp.vec4d, "normal": wp.vec3d, "code": wp.int32, "touching": wp.int32}
        kinds |= dict.fromkeys(("gap", "distance", "stiffness", "share", "ratio", "fixed"), wp.float64)
        if self.surface.obstacles:
            kinds |= {"parts": wp.vec4i, "offset": wp.vec3d, "travel": wp.vec3d}
        arrays = {name: wp.zeros(slots, dtype=kind, device=device) for name, kind in kinds.items()}
        contacts = filled(potential.Contacts, **{"parts": pairs.stencils, "moves": self.surface.moves_of_step} | arrays)
        kinds = {"code": wp.int32, "near": wp.int32, "multiplicities": potential.SIX}
        arrays = {name: wp.zeros(listed, dtype=kind, device=device) for name, kind in kinds.items()}
        self._faces = filled(potential.NearFaces, counts=wp.zeros(self.surface.count, dtype=wp.vec2i, device=device), **arrays)
        contacts.followed.mode = wp.zeros(1, dtype=wp.int32, device=device)
        self.hold_pairs(pairs, contacts)
        if self._in_turn is not None:
            self._hold_followed()

    def _launch_found(self, x, correction=None, goal=None, move=None):
        """Finds the contacts with a force at x + correction, and possible ones at goal + move."""
        self.launch_none()
        x, goal = self._whole(x, self.obstacles), self._whole(goal, self._goal)
        given = {"x": x, "correction": correction, "goal": goal, "move": move}
        wp.capture_if(self.present, self._launch_listed, **given)

    def _whole(self, x, whole):
        if whole is None or x is None or len(x) == self.surface.count:
            return x
        wp.copy(whole, x, count=len(x))
        return whole

    def launch_obstacles(self, positions):
        """Takes positions of the obstacles, (B·m,) [m]."""
        for whole in (self.obstacles, self._goal):
            wp.copy(self.surface.behind(whole), positions)

    def _launch_listed(self, x, correction, goal, move):
        positions = [self._normals, x, correction, goal, move, self._laws]
        vertices = self.surface.count if self._of_edges else self.model.count
        self._launch(potential.find_near_faces, self.lists.threads, [self.lists, *positions, vertices], [self._faces])
        threads, lanes = (1, 1) if self.model.device.is_cpu else (vertices, LANES)
        self.model.launch(potential.list_near_faces, threads, [self.lists, vertices, threads], [self._faces])
        given = [self.lists, x, correction, vertices]
        self._launch(potential.count_multiplicities, self.lists.threads, given, [self._faces])
        given = [self.lists, self._areas, x, correction, self._laws, goal is not None, vertices, threads]
        self._launch(potential.find_vertex_contacts, threads, given, [self._faces, self.pairs, self.data])
        given = [self.lists, self._faces, self.pairs, vertices, lanes, lanes * threads]
        self.model.launch(potential.share_contacts, lanes * threads, given, [self.data])
        if self._of_edges:
            given = [self.lists, self._areas, *positions]
            self._launch(potential.find_edge_contacts, self.lists.threads, given, [self.pairs, self.data])
        self.model.launch(bound_number, 1, [], [self.pairs, self.most.array])
        if self._corners:
            self.launch_corners()

    def launch_rows(self, x, d=None):
        """Finds the contacts at x + d."""
        self._launch_found(x, d)

    def launch_forces(self, x, correction):
        self._launch_found(x, correction)
        given = [self.pairs, self.data, self._whole(x, self.obstacles), correction, self.least]
        self.model.launch(self._find, self.pairs.threads, given, [self.forces])

    # Sweeps, see :mod:`warpcloth.kernels.contact.pair_follow`.

    def follow(self, start, launch, positions):
        """Prepares sweeps, which take contacts at ``positions`` (V,) [m] that follow their iterates.

        ``start()`` moves meshes there, and cloth out of their way; ``launch(x, correction)`` moves them towards x + correction,
        as far as pairs stay apart.
        """
        self._start, self._follow, self._positions = start, launch, positions

    def sweeps(self, in_turn):
        super().sweeps(in_turn)
        self._hold_followed()

    def _hold_followed(self):
        followed, device = self.data.followed, self.model.device
        followed.start, followed.carried, followed.stencils = map(self.room, (wp.float64, wp.float64, wp.vec4i))
        followed.rows, followed.number = wp.zeros_like(self.lists.rows), wp.zeros_like(self.pairs.number)
        followed.keys, followed.slots = wp.zeros_like(self.pairs.keys), wp.zeros_like(self.pairs.slots)
        self.turn, self._due = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))

    def launch_sweep_start(self, x):
        self._start()
        self._launch_found(self._positions, goal=x)
        super().launch_sweep_start(x)
        self.turn.zero_()

    def launch_sweep(self, x, correction, h, adds, backward, follows):
        if follows:
            self.model.launch(pair_follow.count_sweep, 1, [EVERY, self.present], [self.turn, self._due])
            wp.capture_if(self._due, self._launch_follow, x=x, correction=correction, h=h, adds=adds)
        super().launch_sweep(x, correction, h, adds, backward, follows)

    def _launch_follow(self, x, correction, h, adds):
        followed = self.data.followed
        wp.copy(followed.rows, self.lists.rows)
        self._follow(x, correction)
        launch = self.model.launch
        if adds:
            wp.copy(followed.number, self.pairs.number)
            wp.copy(followed.slots, self.pairs.slots)
            launch(pair_follow.carry_forces, self.pairs.threads, [self.pairs, self.multipliers], [self.data])
            self._launch_all(potential.ENDING, x, correction, h)
        self._launch_found(self._positions, None, x, correction)
        if not self._in_turn:
            self.launch_corner_slots()
        if adds:
            vertices = self.surface.count
            launch(pair_follow.start_forces, self.pairs.threads, [self.lists, self.pairs, h, vertices], [self.data])
            launch(pair_follow.fix_forces, vertices, [self.lists, self.pairs, h], [self.data])
            self._launch_all(potential.STARTING, x, correction, h)

    def _launch_all(self, mode, x, correction, h):
        self.data.followed.mode.fill_(int(mode))
        super().launch_sweep(x, correction, h, True, False, False)
        self.data.followed.mode.zero_()
