"""Flat square nets of equal masses and equal springs, and what is known of them."""

import numpy as np

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
    """J (E, 3n) of the lengths of a net's springs at rest, dense."""
    pairs = scene.terms[0].stencil(scene.mesh)
    points = scene.mesh.points
    directions = points[pairs[:, 1]] - points[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    J = np.zeros((len(pairs), len(points), 3))
    J[np.arange(len(pairs)), pairs[:, 0]] = -directions
    J[np.arange(len(pairs)), pairs[:, 1]] = directions
    return J.reshape(len(pairs), -1)
