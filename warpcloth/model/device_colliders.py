"""The colliders of a scene on a device."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels.contact.colliders import pose_types
from ..kernels.coulomb import COULOMB, law_of
from ..kernels.terms.contact import ROUNDED_BOX
from .device_meshes import DeviceMeshes, meshes_on
from .precision import refuse_large

# Core and radius of a shape without a point. Its distance is finite, so that differences are not NaN.
EMPTY = np.zeros(3), -1e30


class DeviceColliders(NamedTuple):
    """The C colliders of a scene, which all copies share.

    Attributes:
        keyframes: Poses of all colliders, one collider after another: position [m] and quaternion (x, y, z, w).
        firsts: Index of the first pose of each, (C + 1,) int32.
        solids: The :class:`warpcloth.kernels.terms.contact.Solid` of all, the convex ones first.
        kind: Of each, the number of the shapes after its own, (C,) int32.
        core, radius: Sizes of shapes, (C,) vectors and (C,) numbers [m], see :mod:`warpcloth.kernels.terms.contact`.
        distance: Contact distance [m].
        friction: μ of each, (C,) on the host.
        laws: The laws of friction.
        moves, half_space: Whether each has more than one pose, and whether it is a half-space, lists of C.
        is_mesh: Whether each is a triangle mesh, a list of C. Its shape here is empty.
        meshes: The meshes among them, or None.
    """

    keyframes: wp.array
    firsts: wp.array
    solids: tuple
    kind: wp.array
    core: wp.array
    radius: wp.array
    distance: float
    friction: np.ndarray
    laws: set
    moves: list
    half_space: list
    is_mesh: list
    meshes: DeviceMeshes | None

    @property
    def plain(self):
        """Whether faster explicit steps take them: those whose shape and law of friction are those of the package."""
        return self.solids == (ROUNDED_BOX,) and self.laws <= {COULOMB}

    @property
    def arrays(self):
        found = [self.keyframes, self.firsts, self.kind, self.core, self.radius]
        return found if self.meshes is None else found + self.meshes.arrays


def colliders_on(model, scene):
    """Returns the colliders of a scene, which has some, on the device of a model."""
    centred = [collider.centred() for collider in scene.colliders]
    poses = [collider.poses for collider in centred]
    cores, radii = zip(*(EMPTY if collider.is_mesh else collider.core for collider in scene.colliders), strict=True)
    solids = tuple(sorted(dict.fromkeys(each.solid for each in scene.colliders), key=lambda solid: not solid.convex))
    kinds = [len(solids) - 1 - solids.index(each.solid) for each in scene.colliders]
    refuse_large(scene, model.numpy_dtype)
    firsts = np.cumsum([0, *map(len, poses)])
    return DeviceColliders(
        keyframes=model.array(np.concatenate(poses), pose_types(model.dtype)[0]),
        firsts=wp.array(firsts.astype(np.int32), dtype=wp.int32, device=model.device),
        solids=solids,
        kind=model.array(kinds, wp.int32),
        core=model.array(np.array(cores), model.vec3),
        radius=model.array(np.array(radii), model.dtype),
        distance=float(scene.contact.distance),
        friction=np.array([collider.friction for collider in scene.colliders]),
        laws={law_of(collider.friction) for collider in scene.colliders},
        moves=[collider.moves for collider in scene.colliders],
        half_space=[bool(np.isinf(core[0])) for core in cores],
        is_mesh=[collider.is_mesh for collider in scene.colliders],
        meshes=meshes_on(model, centred),
    )
