"""The loads of a scene on a device: forces on vertices, which are added to gravity as accelerations."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..kernels import loads as kernels
from ..terms.loads import Pressure, Traction


@dataclass(frozen=True, eq=False)
class DeviceLoads:
    """All loads of a scene.

    Attributes:
        dead: Dead loads, whose direction is fixed, and the loaded vertices, see :func:`warpcloth.kernels.loads.dead_forces`.
        pressed: Pressures, see :func:`warpcloth.kernels.loads.pressures`.
        constant: Dead loads of each vertex, (B, n, 3) [N] in the order of the model; None if loads change.
        timed: Whether values follow keyframes.
        force: Latest forces on vertices, (N,) vectors [N].
        acceleration: Gravity plus forces over masses, (N,) vectors [m/s²].
    """

    dead: object
    pressed: object
    constant: np.ndarray | None
    timed: bool
    force: wp.array
    acceleration: wp.array

    @property
    def follows(self):
        """Whether there is a pressure, whose direction follows the cloth."""
        return self.pressed.triangles is not None

    @property
    def arrays(self):
        """All arrays of the loads."""
        found = [self.dead.vertices, self.dead.keyframes, self.force, self.acceleration]
        return found + [self.pressed.triangles, self.pressed.keyframes, self.pressed.offsets, self.pressed.codes] * self.follows

    def launch(self, model, moment):
        """Launches the forces at a :class:`warpcloth.terms.refresh.Moment`, unless they never change."""
        if self.constant is None:
            self.set(model, moment)

    def set(self, model, moment):
        """Launches the forces at a moment, see :func:`warpcloth.kernels.loads.set_loads`."""
        moved = self.follows and moment.move is not None
        kernel = model.kernel(kernels.set_loads, model.dtype, moved)
        given = [self.dead, self.pressed, model.inverse_mass, model.gravity, moment.x, moment.move if moved else None]
        given += [moment.steps, moment.scale, moment.ahead, moment.per_frame]
        dim = (model.copies, len(self.dead.vertices))
        model.launch(kernel, dim, given, [self.force, self.acceleration])
        model.lock(self.acceleration)

    def part(self, model, first, count):
        """Returns the loads of copies ``first`` to ``first + count − 1``."""
        n, copies = model.per_copy, slice(first, first + count)
        dead, pressed = kernels.dead_forces(model.dtype)(), kernels.pressures(model.dtype)()
        dead.per_copy, dead.vertices, dead.keyframes = n, self.dead.vertices, self.dead.keyframes[:, copies]
        if self.follows:
            pressed.triangles, pressed.keyframes = self.pressed.triangles, self.pressed.keyframes[:, copies]
            pressed.offsets, pressed.codes = self.pressed.offsets, self.pressed.codes
        constant = None if self.constant is None else self.constant[copies]
        arrays = (array[first * n : (first + count) * n] for array in (self.force, self.acceleration))
        return DeviceLoads(dead, pressed, constant, self.timed, *arrays)


def loads_on(model, loads, vary, acceleration):
    """Returns the :class:`DeviceLoads` of a model.

    Args:
        model: The :class:`warpcloth.model.model.Model`, complete but for its loads and terms.
        loads: Loads of the scene.
        vary: :class:`warpcloth.model.vary.Vary`.
        acceleration: Gravity of each vertex along its free axes, (N,) vectors [m/s²], to which the loads are added.
    """
    mesh, B, n = model.scene.mesh, model.copies, model.per_copy
    dead, pressed, triangles = [], [], [np.empty((0, 3), dtype=np.int32)]
    for load in loads:
        found = [each.of_elements(mesh) for each in vary.load(load)]
        elements, values = found[0][0], np.stack([each for _, each in found], axis=1)  # (F, B, count, …)
        if isinstance(load, Pressure):
            pressed.append(values)
            triangles.append(elements)
        else:
            dead.append(_on_vertices(load, mesh, elements, values, n))
    triangles = model.in_model(np.concatenate(triangles)).astype(np.int32)
    total = _summed(dead) if dead else np.zeros((1, B, n, 3))
    total = total if model.order is None else total[:, :, model.order]
    vertices = np.union1d(np.flatnonzero((total != 0.0).any(axis=(0, 1, 3))), triangles).astype(np.int32)
    of_dead, of_pressed = kernels.dead_forces(model.dtype)(), kernels.pressures(model.dtype)()
    of_dead.per_copy = n
    of_dead.vertices = wp.array(vertices, dtype=wp.int32, device=model.device)
    of_dead.keyframes = model.array(total[:, :, vertices], model.vec3)
    timed = len(total) > 1
    if len(triangles):
        frames = max(map(len, pressed))
        values = np.concatenate([_held(each, frames) for each in pressed], axis=2)
        corners = triangles.ravel()
        order = np.argsort(corners, kind="stable")
        offsets = np.append(np.searchsorted(corners[order], vertices), len(corners))
        of_pressed.triangles = wp.array(triangles, dtype=wp.int32, device=model.device)
        of_pressed.keyframes = model.array(values, model.dtype)
        of_pressed.offsets = wp.array(offsets.astype(np.int32), dtype=wp.int32, device=model.device)
        of_pressed.codes = wp.array((order // 3).astype(np.int32), dtype=wp.int32, device=model.device)
        timed |= frames > 1
    constant = None if timed or len(triangles) else total[0]
    return DeviceLoads(of_dead, of_pressed, constant, timed, model.vectors(), acceleration)


def _on_vertices(load, mesh, elements, values, n):
    """Returns the forces of a dead load on all vertices, (F, B, n, 3) [N]."""
    found = np.zeros((*values.shape[:2], n, 3))
    if isinstance(load, Traction):
        lengths = np.linalg.norm(mesh.points[elements[:, 1]] - mesh.points[elements[:, 0]], axis=1)
        for end in elements.T:
            np.add.at(found, (slice(None), slice(None), end), 0.5 * lengths[:, None] * values)
    else:
        found[:, :, elements] = values
    return found


def _held(values, frames):
    """Repeats the last of some keyframes (F, …) up to a number of frames."""
    return values[np.minimum(np.arange(frames), len(values) - 1)]


def _summed(parts):
    frames = max(map(len, parts))
    return sum(_held(each, frames) for each in parts)
