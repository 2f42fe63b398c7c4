"""Energies of cells with any number of vertices."""

from dataclasses import dataclass

import numpy as np

from ..kernels import sparse as kernels
from .declared import Declared, Elements
from .refresh import EVALUATION, Refresh


@dataclass(frozen=True, kw_only=True)
class Sparse(Declared):
    """An energy U = Σ_c k A u(y_c) of cells with any number of vertices, y = Dx with a sparse D.

    A subclass defines ``operator`` and ``rest``, and no ``stencil``. Its ``term`` has ``vertices`` 0 and ``weight`` None. A
    quadratic one sets ``cells``, ``project``, ``linear`` and ``quadratic``, for all solvers. Others go to Explicit and Newton,
    and with a ``curvature`` to ProjectiveDynamics and ADMM.
    """

    def operator(self, mesh):
        """Returns D, a scipy sparse matrix (C·M, n) whose rows cM to cM + M − 1 give y of cell c."""
        raise NotImplementedError  # every energy has its own

    def rest(self, mesh, positions, stencil):
        raise NotImplementedError

    def elements_on(self, mesh, positions):
        from scipy.sparse import coo_array

        D, M, n = coo_array(self.operator(mesh)), self.term.rows, len(mesh.points)
        if D.shape[1] != n or D.shape[0] % M:
            raise ValueError(
                f"{self.label}: the operator has shape {D.shape}; it must be {M} rows for each cell and {n} columns"
            )
        # One element for each vertex of a cell, with its weights in all rows.
        keys, where = np.unique(D.row.astype(np.int64) // M * n + D.col, return_inverse=True)
        weights = np.zeros((len(keys), M))
        np.add.at(weights, (where, D.row % M), D.data)
        cells = np.searchsorted(keys, np.arange(D.shape[0] // M + 1) * n)
        if not (np.diff(cells) > 0).all():
            raise ValueError(
                f"{self.label}: cell {np.flatnonzero(np.diff(cells) == 0)[0]} has no vertex; each must have one or more"
            )
        stencil, count = (keys % n).astype(np.int32)[:, None], len(cells) - 1
        return Elements(
            label=self.label,
            term=self.term,
            stencil=stencil,
            stiffness=self.of_elements("stiffness", count),
            rest=self.rest(mesh, positions, stencil),
            damping=np.zeros(()),
            cells=cells,
            weights=weights,
            refresh=Refresh(EVALUATION, _evaluate),
        )


def _evaluate(model, elements, moment):
    cells, d = elements.cells, moment.correction
    kernel = model.kernel(kernels.evaluate, cells.term, model.dtype, d is not None)
    given = [cells.offsets, elements.stencil, cells.weights, cells.rest, moment.x, d]
    model.launch(kernel, cells.count, given, [elements.rest])
