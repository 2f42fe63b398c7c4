"""Negative cotangent weights: w = ½(cot α + cot β) of an edge is negative iff the angles opposite it sum to more than 180°.

With "spokes", an edge of negative weight adds a negative energy, so as-rigid-as-possible deformation pulls the mesh apart.
"intrinsic" weights are positive inside (Fisher et al. 2007, *An algorithm for the construction of intrinsic Delaunay
triangulations*), though not on the boundary. "clamped" weights lose linear precision. "spokes_and_rims" has the energy of
triangles, which is never negative (Chao et al. 2010, *A simple geometric model for elastic deformations*).
"""

import importlib.util
import warnings

import numpy as np

from ..analysis.analysis import analyze
from ..deformation.arap import Arap
from ..mesh.mesh import Mesh
from .measurements import task
from .panels import Panel, point
from .strips import strip

TITLE = "12. Cotangent weights are negative where the angles opposite an edge sum to more than 180°"
CHOICES = {
    "cotangent": {},
    "clamped": {"weights": "clamped"},
    "intrinsic Delaunay": {"weights": "intrinsic"},
    "spokes and rims": {"energy": "spokes_and_rims"},
}
# Angle at the hub of the triangles beside the spoke that becomes obtuse [°].
_HUB = 60.0
_BEND = np.pi / 2


def edge_weight(degrees):
    """Returns ½(cot α + cot β) for α = β, each half of the given sum [°]."""
    return 1.0 / np.tan(np.radians(0.5 * degrees))


def lost(degrees):
    """Returns ‖Lx̄‖ at the hub without the spoke of negative weight w: |w| times its length sin α/sin(120° − α)."""
    alpha = np.radians(0.5 * degrees)
    return max(0.0, -np.cos(alpha)) / np.sin(np.pi - np.radians(_HUB) - alpha)


_EQUAL, _CLAMPED, _LOST, _EXACT = "cot((α + β)/2)", "the same, negative ones 0", "|w| × length of the edge", "0"
PANELS = (
    Panel(
        "weight",
        f"Weight of an edge of two equal triangles; of 100° each {edge_weight(200.0):.3f}".replace("-", "−"),
        "sum of the opposite angles α + β [°]",
        "weight",
        laws={_EQUAL: edge_weight, _CLAMPED: lambda d: max(0.0, edge_weight(d))},
        follows={"cotangent": _EQUAL, "clamped": _CLAMPED, "intrinsic Delaunay": _CLAMPED},
        marks={180.0: "Delaunay"},
    ),
    Panel(
        "energy",
        "Energy that two equal triangles end with, held by one vertex",
        "sum of the opposite angles α + β [°]",
        "energy over edge² (rigid: 0)",
        laws={_EXACT: lambda d: 0.0},
        follows={name: _EXACT for name in CHOICES if name != "cotangent"},
        marks={180.0: "Delaunay"},
    ),
    Panel(
        "bend",
        "An irregular sheet, squashed, whose end is bent by 90°",
        "edges of negative cotangent weight [%]",
        "largest principal stretch",
        ("linear", "log"),
    ),
    Panel(
        "precision",
        "Linear precision of a flat fan, one spoke growing",
        "sum of the angles opposite that spoke [°]",
        "‖L x̄‖ at the hub over its neighbours' distance",
        laws={_LOST: lost, _EXACT: lambda d: 0.0},
        follows={"cotangent": _EXACT, "intrinsic Delaunay": _EXACT, "clamped": _LOST},
        marks={180.0: "Delaunay"},
    ),
)


def tasks(device):
    return [task(measure, device=device, libigl=importlib.util.find_spec("igl") is not None)]


def measure(device, libigl):
    """Returns the points of all panels; those of intrinsic weights need libigl."""
    choices = {name: given for name, given in CHOICES.items() if libigl or given.get("weights") != "intrinsic"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they say is drawn here
        found = [each for part in (_weights, _kites, _bends, _fans) for each in part(choices, device)]
    reason = "needs libigl: pip install -e '.[intrinsic]' in the checkout"
    return found + [point(panel.key, "intrinsic Delaunay", 180.0, None, reason) for panel in PANELS if not libigl]


def kite(apex):
    height = 0.5 / np.tan(np.radians(0.5 * apex))
    return Mesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, height], [0.5, 0.0, -height]], [[0, 1, 2], [1, 0, 3]])


def _spokes(choices):
    return {name: given for name, given in choices.items() if "energy" not in given}


def _weights(choices, device):
    for apex in np.arange(50.0, 130.1, 5.0):
        for name, given in _spokes(choices).items():
            laplacian = Arap(kite(apex), [0, 2], device=device, **given).laplacian
            yield point("weight", name, 2.0 * apex, -laplacian[0, 1])


def _kites(choices, device):
    noise = 1e-3 * np.random.default_rng(0).normal(size=(4, 3))
    for apex in np.arange(75.0, 110.1, 2.5):
        mesh = kite(apex)
        for name, given in choices.items():
            arap = Arap(mesh, [2], device=device, **given)
            ended = arap.solve(mesh.points[[2]], iterations=2000, initial=mesh.points + noise)
            yield point("energy", name, 2.0 * apex, ended.energies[-1])


def _bends(choices, device):
    net = strip("jittered", 0.0, 0.1).mesh
    for squash in (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2):
        mesh = Mesh(net.points * [1.0, 1.0, squash], net.triangles)
        x = mesh.points[:, 0]
        held, moved = np.flatnonzero(x < 0.0), np.flatnonzero(x > 0.9)
        handles = np.concatenate([held, moved])
        c, s = np.cos(_BEND), np.sin(_BEND)
        away = mesh.points[moved] - [0.5, 0.0, 0.0]
        turned = away @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [0.5, 0.0, 0.0]
        negative = 100.0 * len(Arap(mesh, handles, device=device).negative_edges) / len(mesh.edges)
        for name, given in choices.items():
            ended = Arap(mesh, handles, device=device, **given).solve(
                np.concatenate([mesh.points[held], turned]), iterations=500
            )
            stretch = analyze(ended.points[None], mesh, measures=("stretch",))["stretch"]
            yield point("bend", name, negative, np.asarray(stretch).max())


def fan(degrees):
    """Returns a flat fan about vertex 0; the angles opposite its spoke to vertex 1 sum to ``degrees``, others have length 1."""
    alpha = np.radians(0.5 * degrees)
    length = np.sin(alpha) / np.sin(np.pi - np.radians(_HUB) - alpha)
    around = np.radians([_HUB, 140.0, -140.0, -_HUB])
    rim = np.stack([np.cos(around), np.zeros(4), np.sin(around)], axis=1)
    return Mesh(np.concatenate([[[0.0] * 3, [length, 0.0, 0.0]], rim]), [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 5, 4], [0, 1, 5]])


def _fans(choices, device):
    for angles in np.arange(120.0, 226.0, 7.5):
        mesh = fan(angles)
        for name, given in _spokes(choices).items():
            laplacian = Arap(mesh, [1], device=device, **given).laplacian
            yield point("precision", name, angles, np.linalg.norm(laplacian[0] @ mesh.points))
