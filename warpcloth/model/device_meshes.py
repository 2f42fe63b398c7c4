"""The triangle meshes among the colliders of a scene on a device."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels.contact import obstacles as kernels


class DeviceMeshes(NamedTuple):
    """The meshes of the colliders of a scene, which all copies share.

    Attributes:
        geometry: The struct :func:`warpcloth.kernels.contact.obstacles.meshes`.
    """

    geometry: object

    @property
    def arrays(self):
        return [self.geometry.points]


def meshes_on(model, colliders):
    """Returns the meshes among colliders on the device of a model, or None if there are none."""
    if not any(collider.is_mesh for collider in colliders):
        return None
    found = kernels.meshes(model.dtype)()
    frames = [collider.frames if collider.is_mesh else np.empty((0, 0, 3)) for collider in colliders]

    def numbers(values):
        return wp.array(np.array(values), dtype=wp.int32, device=model.device)

    found.points = model.array(np.concatenate([each.reshape(-1, 3) for each in frames]), model.vec3)
    found.first_point = numbers(np.cumsum([0, *(each.shape[0] * each.shape[1] for each in frames)])[:-1])
    found.size, found.frames = numbers([each.shape[1] for each in frames]), numbers([len(each) for each in frames])
    return DeviceMeshes(found)
