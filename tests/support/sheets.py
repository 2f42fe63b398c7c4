"""A disturbed sheet in motion, with each kind of term."""

from dataclasses import replace

import numpy as np

import warpcloth as wc

MESH = wc.Mesh.grid(7, 5, pattern="alternating")
N = len(MESH.points)
POSITIONS = MESH.points + np.random.default_rng(3).normal(scale=0.01, size=(N, 3))
VELOCITIES = np.random.default_rng(4).normal(size=(N, 3))
SPRINGS = wc.Spring(pairs=("structural", "shear"), stiffness=100.0)
BACKWARDS = wc.Spring(pairs=SPRINGS.stencil(MESH)[:, ::-1], stiffness=100.0 + np.arange(len(SPRINGS.stencil(MESH))))
TERMS = {
    "nothing": [],
    "springs": [SPRINGS],
    "springs, the higher vertex first, each of its own stiffness": [BACKWARDS],
    "damped springs": [replace(SPRINGS, damping=0.05)],
    "limits": [wc.SpringLimit(stiffness=100.0, least=0.99, most=1.01), wc.StrainLimit(stiffness=10.0, least=0.99, most=1.01)],
    "corotated": [wc.CorotatedMembrane(stiffness=100.0, damping=0.01)],
    "St. Venant-Kirchhoff": [wc.StVKMembrane(stiffness=100.0, damping=0.01)],
    "orthotropic": [wc.OrthotropicMembrane(stiffness=100.0, weft_ratio=2.0, poisson_ratio=0.3, damping=0.01)],
    "Neo-Hookean": [wc.NeoHookeanMembrane(stiffness=100.0)],
    "quadratic bending": [wc.QuadraticBending(stiffness=1e-3)],
    "damped quadratic bending": [wc.QuadraticBending(stiffness=1e-3, damping=1e-5)],
    "plate bending": [wc.PlateBending(stiffness=1e-3, poisson_ratio=0.3, weft_ratio=2.0)],
    "dihedral bending": [wc.DihedralBending(stiffness=1e-3, damping=1e-5)],
    "attachments": [wc.Attachment(vertices="corners", stiffness=10.0, damping=0.1)],
    "clusters": [wc.RigidCluster(vertices=[[0, 1, 2, 7], [20, 21, 28]], stiffness=1e3)],
    "several": [
        replace(BACKWARDS, damping=0.02),
        wc.RigidCluster(vertices=[[0, 1, 2, 7]], stiffness=1e3),
        wc.DihedralBending(stiffness=1e-3),
        wc.QuadraticBending(stiffness=1e-3, damping=1e-5),
        wc.Attachment(vertices=[3], stiffness=10.0),
    ],
}
# A kernel is compiled for its terms, options and precision, which takes most of the time of its tests.
FEW = ("nothing", "springs", "several")


def precisions(names):
    """Names of terms and precisions to test: all in float64, which tells more errors from rounding, and a few in float32."""
    return [(name, "float64") for name in names] + [(name, "float32") for name in names if name in FEW]


def declared(terms, **scene):
    """A disturbed sheet in motion; one pin stands still, two are led by keyframes."""
    keyframes = POSITIONS[[0, 6]] + 0.02 * np.arange(3)[:, None, None] * VELOCITIES[:2]
    pins = wc.Pins([0, 6], keyframes)
    given = {"density": 0.1, "positions": POSITIONS, "velocities": VELOCITIES, "pins": pins, "duration": 1.0}
    return wc.Scene(MESH, terms=terms, **(given | scene))
