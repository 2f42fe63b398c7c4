"""The constraint rows of rigid clusters, for :mod:`warpcloth.numerics.constraints`."""

from itertools import pairwise

import numpy as np
import warp as wp

from ..core.capture import Mirror
from ..kernels import cluster_rows as kernels
from ..kernels.transpose import stored
from ..model.host_values import host_values


class ClusterRows:
    """The rows of one term of rigid clusters, see :mod:`warpcloth.kernels.cluster_rows`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        elements: The :class:`warpcloth.model.elements.DeviceElements`, of cells.

    Attributes:
        count: Number of rows of one copy.
    """

    def __init__(self, model, elements):
        self.model, self.elements, self.cells = model, elements, elements.cells
        self.count = 3 * elements.per_copy
        factories = kernels.linearise_clusters, kernels.apply_cluster_rows, kernels.pull_clusters
        self._launch = model.launcher((factories, model.dtype))
        self._stencil, self._offsets = host_values(elements.stencil)[:, 0], host_values(self.cells.offsets)
        self._mass = elements.rest.numpy()[:, 3].astype(np.float64)
        self._rest = host_values(self.cells.shape).astype(np.float64)
        self._inverses = np.stack([np.linalg.pinv(each, 1e-12, True) for each in self._inertias()])
        self._inertia = model.array(self._inverses, model.mat33)
        self._rotations = wp.zeros(self.cells.count, dtype=model.mat33, device=model.device)
        self._turned = Mirror(self._rotations)
        self._gather_pulls = model.kernel(kernels.gather_pulls, elements.term, model.dtype)
        self._incidences = elements.incidences  # built now, because during a capture it would only be recorded
        self._pulls = stored(elements.term, model.dtype).data()
        self._pulls.z = wp.zeros(elements.count, dtype=wp.types.matrix((1, 3), model.dtype), device=model.device)

    def _inertias(self):
        """Returns the inertia tensor Σ m(q²I − qqᵀ) of each cell at rest, (C, 3, 3) [kg·m²]."""
        mass, q = self._mass, self._rest
        each = mass[:, None, None] * ((q**2).sum(axis=1)[:, None, None] * np.eye(3) - q[:, :, None] * q[:, None, :])
        return np.add.reduceat(each, self._offsets[:-1], axis=0)

    def set_layout(self, layout):
        """Sets the layout of its rows, a :class:`warpcloth.kernels.constraint_rows.RowLayout`."""
        self.layout = layout

    def launch_linearise(self, x, d, h, least, values):
        """As :meth:`warpcloth.numerics.constraints.TermRows.launch_linearise`."""
        cells = self.cells
        given = [cells.offsets, cells.shape, *self.elements.arguments, x, d, h, least, self.layout]
        self._launch(kernels.linearise_clusters, cells.count, given, [self._rotations, values])

    def launch_apply(self, v, out, active=None):
        """Launches out += J v, of all copies."""
        given = [*self._shape(), self.elements.stencil, self.elements.rest, v, self.layout]
        self._launch(kernels.apply_cluster_rows, self.cells.count, given, [out])

    def launch_transpose(self, rows, out, active=None):
        """Launches out += Jᵀ rows, of all copies."""
        given = [*self._shape(), self.elements.rest, rows, self.layout]
        self._launch(kernels.pull_clusters, self.cells.count, given, [self._pulls.z])
        given = [*self._incidences, self.elements.rest, self._pulls]
        self.model.launch(self._gather_pulls, len(self._incidences[0]) - 1, given, [out])

    def entries(self):
        """Returns J on the host: values, rows and columns."""
        mass, q, R, found = self._mass, self._rest, self._turned.read().astype(np.float64), []
        for cell, (start, stop) in enumerate(pairwise(self._offsets)):
            if not R[cell].any():
                continue
            elements = np.arange(start, stop)
            root, r = np.sqrt(mass[elements]), q[elements] @ R[cell].T
            turns = np.stack([np.cross(r, axis) for axis in np.eye(3)], axis=2)  # r × v as a matrix
            linear = np.kron(root[:, None], np.eye(3))  # (3E, 3)
            angular = (root[:, None, None] * turns).reshape(-1, 3, 3)
            moments = np.concatenate(list(angular), axis=1)  # Σ √m r × v, (3, 3E)
            world = R[cell] @ self._inverses[cell] @ R[cell].T
            Q = linear @ linear.T / mass[elements].sum() + moments.T @ world @ moments
            block = (np.eye(len(Q)) - Q) * np.repeat(root, 3)
            copy, e = np.divmod(elements, self.layout.per_copy)
            rows = ((copy * self.layout.rows_per_copy + self.layout.first + 3 * e)[:, None] + np.arange(3)).ravel()
            columns = (3 * self._stencil[elements][:, None] + np.arange(3)).ravel()
            found.append((block.ravel(), np.repeat(rows, len(columns)), np.tile(columns, len(rows))))
        if not found:
            return np.zeros(0), np.zeros(0, dtype=int), np.zeros(0, dtype=int)
        return tuple(np.concatenate(each) for each in zip(*found, strict=True))

    def _shape(self):
        return [self.cells.offsets, self.cells.shape, self._inertia, self._rotations]
