"""Flat square nets of equal masses and equal springs, and what is known of them."""

import numpy as np
from scipy.sparse import csr_array

import warpcloth as wc

# Springs of the net, ω²_max·m/k of its small oscillations and λ_max of D⁻¹JWJᵀ, both for 40×40 vertices.
NETS = {
    "structural": (("structural",), 3.99, 1.997),
    "shear": (("structural", "shear"), 7.98, 3.99),
    "bending": (("structural", "shear", "bending"), 10.09, 5.05),
    "triangles": ("edges", 6.82, 3.41),
}


def net(kind, n=40, stiffness=1.0, **scene):
    """A net of n² unit masses that floats: no pins, no gravity."""
    mesh = wc.Mesh.grid(n, n, size=float(n - 1))
    terms = [wc.Spring(pairs=NETS[kind][0], stiffness=stiffness)]
    return wc.Scene(mesh, masses=np.ones(n * n), terms=terms, gravity=(0.0, 0.0, 0.0), **scene)


def jacobian(scene):
    """J (E, 3n) of the lengths of a net's springs at rest."""
    pairs, points = scene.terms[0].stencil(scene.mesh), scene.mesh.points
    directions = points[pairs[:, 1]] - points[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    columns = 3 * pairs[:, :, None] + np.arange(3)
    values = np.stack([-directions, directions], axis=1)
    return csr_array((values.ravel(), columns.ravel(), np.arange(len(pairs) + 1) * 6), shape=(len(pairs), 3 * len(points)))
