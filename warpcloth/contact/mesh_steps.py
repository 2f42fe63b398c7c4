"""Mesh colliders in the steps of a solver."""

import numpy as np
import warp as wp

from ..kernels.contact import mesh_facets
from ..kernels.contact.anchors import anchor_on_mesh
from ..kernels.contact.mesh_geometry import motions
from ..kernels.contact.mesh_queries import LISTED, bound_triangles, near_lists
from ..kernels.terms.contact import AREA


class MeshSteps:
    """The bounding volume hierarchies of mesh colliders, the facets of vertices and the friction anchors, for one solver.

    Args:
        model: The :class:`warpcloth.model.model.Model` of a scene with mesh colliders.
        poses: Poses of the step, a :func:`warpcloth.kernels.contact.colliders.step_poses`.
        bounded: Whether the method is explicit.
        resting: Whether the solver finds an equilibrium, where vertices may move any distance.
        **given: The numbers and ``steps`` of :func:`warpcloth.kernels.contact.mesh_geometry.motions`.

    Attributes:
        geometry: See :class:`warpcloth.model.device_meshes.DeviceMeshes`.
        motion: Struct :func:`warpcloth.kernels.contact.mesh_geometry.motions`.
        given: The numbers and ``steps``, by name.
    """

    def __init__(self, model, poses, bounded, resting=False, **given):
        self.model, self._bounded, self._resting, self._facets = model, bounded, resting, {}
        self._meshes = model.colliders.meshes.own(model)
        self.geometry, self.motion = self._meshes.geometry, motions(model.dtype)()
        self.given = given
        for name, value in (given | {name: getattr(poses, name) for name in ("before", "at", "after")}).items():
            setattr(self.motion, name, value)
        self.lists = near_lists(model.dtype)()
        if self.motion.ahead == 0:
            self._set_lists()
        if self._meshes.deform:
            self._bound = model.kernel(bound_triangles, model.dtype)

    def _set_lists(self):
        """Allocates lists of the triangles near vertices, for explicit steps, in which vertices move little."""
        model, scene = self.model, self.model.scene
        meshes = [c for c, tree in enumerate(self._meshes.trees) if tree is not None]
        dim, rows = (len(meshes), model.count), np.full(len(scene.colliders), -1, np.int32)
        rows[meshes] = np.arange(len(meshes))
        balls = np.zeros((*dim, 4))
        balls[..., 3] = -1.0
        steps = self.motion.per_frame / 2
        self._kept = {  # the struct holds no references
            "row": wp.array(rows, dtype=wp.int32, device=model.device),
            "drift": model.array([scene.colliders[c].deforms.max(initial=0.0) / steps for c in meshes], model.dtype),
            "ball": model.array(balls, wp.types.vector(4, model.dtype)),
            "built": wp.zeros(dim, dtype=wp.int32, device=model.device),
            "count": wp.zeros(dim, dtype=wp.int32, device=model.device),
            "triangles": wp.zeros((*dim, LISTED), dtype=wp.int32, device=model.device),
        }
        for name, value in self._kept.items():
            setattr(self.lists, name, value)

    def launch_trees(self):
        """Launches the refit of the hierarchies of deforming meshes to the step."""
        for c in self._meshes.deform:
            tree = self._meshes.trees[c]
            given = [self.geometry, c, self.motion.steps, self.motion.per_frame]
            self.model.launch(self._bound, len(tree.lowers), given, [tree.lowers, tree.uppers])
            tree.refit()

    def contact(self, elements):
        """Function (elements, x, v) that launches the rest states of contact with one facet at the start of a step.

        Args:
            elements: The contact elements of the model, in the order of their facets.
        """
        model, c = self.model, elements.collider
        pose = model.kernel(mesh_facets.pose_facets, model.dtype)
        areas = model.array(elements.rest.numpy()[:, AREA], model.dtype)
        if elements.facet == 0:
            most = 1 + max(each.facet for each in model.terms if each.collider == c)
            facet_type = mesh_facets.facet_type(model.dtype)
            self._facets[c] = wp.zeros((model.count, most), dtype=facet_type, device=model.device)
            find = model.kernel(mesh_facets.find_facets, model.dtype, self.motion.ahead == 0, self._resting)
        facets = self._facets[c]

        def launch(elements, x, v):
            if elements.facet == 0:
                given = [elements.stencil, self.geometry, *model.free_gravity, x, v, self.motion, c, elements.per_copy]
                model.launch(find, elements.count, given, [self.lists, facets])
            model.launch(pose, elements.count, [elements.stencil, areas, facets, elements.facet], [elements.rest])

        return launch

    def friction(self, elements, friction, anchors):
        """Function (elements, x, v) that launches the friction anchors of a step on one mesh.

        Args:
            elements: The friction elements of the model.
            friction: μ.
            anchors: The array of anchors (N,).
        """
        model, c = self.model, elements.collider
        anchor = model.kernel(anchor_on_mesh, model.dtype, elements.term.law, self._bounded)
        most = self._facets[c].shape[1]

        def launch(elements, x, _v):
            given = [elements.stencil, self.geometry, x, self.motion, c, elements.per_copy, most, friction, self.lists]
            model.launch(anchor, elements.count, given, [anchors, elements.rest])

        return launch
