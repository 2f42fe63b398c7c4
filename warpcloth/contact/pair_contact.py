"""The energy of self-contact in the steps of a solver."""

import numpy as np
import warp as wp

from ..core.dynamic import DynamicElements
from ..core.scan import Scan
from ..kernels.contact import pair_follow
from ..kernels.contact import pair_potential as potential
from ..kernels.contact import self_contact as kernels
from ..kernels.contact.self_pairs import fill_corners, near_pairs, sort_corners
from .self_friction import acting_sizes

# Sweeps find contacts anew once in a step of 20 sweeps, the default.
EVERY = 10


class PairContact(DynamicElements):
    """Contact of cloth with itself: the potential of :mod:`warpcloth.kernels.contact.pair_potential`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        bounded: Whether contact is that of explicit steps, without the logarithm.
        declared: The :class:`warpcloth.SelfContact`.
        listed: Whether there are listed pairs, (1,) int32.

    Attributes:
        least: The least gap [m] of the filter if it keeps all pairs apart wherever forces are computed, otherwise 0.
        lists: The listed pairs, a :func:`warpcloth.kernels.contact.self_pairs.near_pairs`.
    """

    def __init__(self, model, bounded, declared, listed):
        super().__init__(model, kernels.CONTACT_OF_PAIRS, listed)
        self.least, self._declared = 0.0, declared
        mesh, device = model.scene.mesh, model.device
        of_vertices = mesh.vertex_areas
        of_edges = of_vertices / np.maximum(np.bincount(mesh.edges.ravel(), minlength=len(of_vertices)), 1)
        areas = np.empty((2, model.per_copy))
        areas[:, model.in_model(np.arange(model.per_copy))] = of_vertices, of_edges
        self._areas = potential.Areas()
        self._areas.of_vertices, self._areas.of_edges = (
            wp.array(np.tile(each, model.copies), dtype=wp.float64, device=device) for each in areas
        )
        self._areas.rest = wp.array(model.rest_points, dtype=wp.vec3d, device=device)
        self._of_edges = not bounded  # the filter alone keeps edges apart in explicit steps
        self._find = model.kernel(kernels.find_forces, model.dtype, bounded)
        made = potential.find_vertex_contacts, potential.find_edge_contacts, fill_corners, sort_corners
        self._launch = model.launcher((made, model.dtype))
        self._corners = model.device.is_cuda
        self._vertices = Scan(model, model.count)

    def list_corners(self):
        if not self._corners:
            self._corners = True
            self.hold(self.lists, self._normals)

    def hold(self, lists, normals):
        """Takes the listed pairs and their normals (capacity,), and allocates contacts."""
        self.lists, self._normals = lists, normals
        pairs, slots, device = near_pairs(self.model.dtype)(), 2 * len(lists.stencils), self.model.device
        pairs.stencils = wp.zeros(slots, dtype=wp.vec4i, device=device)
        for name, size in acting_sizes(self.model, slots, self._corners).items():
            setattr(pairs, name, wp.zeros(size, dtype=wp.int32, device=device))
        contacts = potential.Contacts()
        for name, kind in (("weights", wp.vec4d), ("normal", wp.vec3d), ("code", wp.int32)):
            setattr(contacts, name, wp.zeros(slots, dtype=kind, device=device))
        for name in ("gap", "distance", "stiffness", "share", "fixed"):
            setattr(contacts, name, wp.zeros(slots, dtype=wp.float64, device=device))
        contacts.followed.mode = wp.zeros(1, dtype=wp.int32, device=device)
        self.hold_pairs(pairs, contacts)
        if self._in_turn is not None:
            self._hold_followed()

    def _launch_found(self, x, correction=None, goal=None, move=None):
        """Finds the contacts with a force at x, or x + correction, and those that may have one at goal + move."""
        self.launch_none()
        self.data.stiffness.zero_()
        given = {"x": x, "correction": correction, "goal": goal, "move": move}
        wp.capture_if(self.present, self._launch_listed, **given)

    def _launch_listed(self, x, correction, goal, move):
        declared = self._declared
        given = [self.lists, self._areas, self._normals, x, correction, goal, move, declared.stiffness, declared.distance]
        self._launch(potential.find_vertex_contacts, self.model.count, given, [self.pairs, self.data])
        if self._of_edges:
            self._launch(potential.find_edge_contacts, len(self.lists.stencils), given, [self.pairs, self.data])
        if self._corners:
            self._vertices.launch(self.pairs.corner_counts, self.pairs.first)
            self._launch(fill_corners, self.capacity, [], [self.pairs])
            self._launch(sort_corners, self.model.count, [], [self.pairs])

    def launch_begin(self, x):
        """Finds the contacts at the start of a step."""
        self._launch_found(x)

    def launch_rows(self, x, d):
        self._launch_found(x, d)

    def launch_forces(self, x, correction):
        self._launch_found(x, correction)
        self.model.launch(self._find, self.capacity, [self.pairs, self.data, x, self.least], [self.forces])

    # Sweeps, see :mod:`warpcloth.kernels.contact.pair_follow`.

    def follow(self, launch, positions):
        """Prepares sweeps, which take contacts at ``positions`` (N,) that follow their iterates.

        Args:
            launch: ``launch(x, correction)`` moves the positions towards x + correction, as far as pairs stay apart.
            positions: (N,) [m].
        """
        self._follow, self._positions = launch, positions

    def sweeps(self, in_turn):
        super().sweeps(in_turn)
        made = pair_follow.carry_forces, pair_follow.start_forces, pair_follow.fix_forces
        self._take_over = self.model.launcher((made, self.model.dtype))
        self._hold_followed()

    def _hold_followed(self):
        followed, device = self.data.followed, self.model.device
        followed.start, followed.carried, followed.stencils = map(self.room, (wp.float64, wp.float64, wp.vec4i))
        followed.rows = wp.zeros_like(self.lists.rows)
        self._turn, self._due = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))

    def launch_sweep_start(self, x):
        self._launch_found(self._positions, goal=x)
        super().launch_sweep_start(x)
        self._turn.zero_()

    def launch_sweep(self, x, correction, h, adds, backward):
        self.model.launch(pair_follow.count_sweep, 1, [EVERY, self.present], [self._turn, self._due])
        wp.capture_if(self._due, self._launch_follow, x=x, correction=correction, h=h, adds=adds)
        super().launch_sweep(x, correction, h, adds, backward)

    def _launch_follow(self, x, correction, h, adds):
        """Finds the contacts where the iterate is now; those that add forces take over those of the last ones."""
        wp.copy(self.data.followed.rows, self.lists.rows)
        self._follow(x, correction)
        if adds:
            self.data.followed.carried.zero_()
            self._take_over(pair_follow.carry_forces, self.capacity, [self.pairs, self.multipliers], [self.data])
            self._launch_all(potential.ENDING, x, correction, h)
        self._launch_found(self._positions, None, x, correction)
        if not self._in_turn:
            self.launch_corner_slots()
        if adds:
            self._take_over(pair_follow.start_forces, self.capacity, [self.lists, self.pairs, h, self.model.count], [self.data])
            self._take_over(pair_follow.fix_forces, self.model.count, [self.lists, h], [self.data])
            self._launch_all(potential.STARTING, x, correction, h)

    def _launch_all(self, mode, x, correction, h):
        """Launches a sweep that removes all forces, or adds those at their start."""
        self.data.followed.mode.fill_(int(mode))
        super().launch_sweep(x, correction, h, True, False)
        self.data.followed.mode.zero_()
