"""Quadratic bending of stretched sheets and of curved rest shapes, compared with dihedral angles (Bergou et al. 2006, *A
quadratic bending model for inextensible surfaces*; Grinspun et al. 2003, *Discrete shells*).

Its energy per area is ½D‖Δx‖², with the Laplacian Δ of a flat rest shape: non-uniform stretch counts as bending, and any rest
shape as flat. Plate bending does the same. On isometries of a flat sheet, for which they are made, all agree.
"""

import numpy as np

from ..mesh.mesh import Mesh
from .measurements import task
from .panels import Panel, point
from .physics import BENDING, bending_density, rolled_up
from .strips import strip

TITLE = "10. Quadratic and plate bending hold on isometries of sheets that are flat at rest"
REST = 1.0  # κ̄ [1/m]
_H = 0.1  # edge of the net [m]

_STRETCHED, _NONE = "½(2ε)²", "0"
_FLAT, _CURVED = "½κ²", "½(κ − κ̄)²"
PANELS = (
    Panel(
        "stretch",
        "A flat sheet stretched in its plane, x → x + εx²",
        "ε [1/m]",
        "bending energy an area, over D [1/m²]",
        laws={_STRETCHED: lambda e: 0.5 * (2.0 * e) ** 2, _NONE: lambda e: 0.0},
        follows={"quadratic": _STRETCHED, "plate": _STRETCHED, "dihedral": _NONE},
    ),
    Panel(
        "flat",
        "A sheet flat at rest, rolled to a cylinder: all hold",
        "curvature κ [1/m]",
        "bending energy an area, over D [1/m²]",
        laws={_FLAT: lambda k: 0.5 * k**2},
        follows=dict.fromkeys(BENDING, _FLAT),
    ),
    Panel(
        "curved",
        f"A shell curved by κ̄ = {REST:g}/m at rest, rolled further or flattened",
        "curvature κ [1/m]",
        "bending energy an area, over D [1/m²]",
        laws={_FLAT: lambda k: 0.5 * k**2, _CURVED: lambda k: 0.5 * (k - REST) ** 2},
        follows={"quadratic": _FLAT, "plate": _FLAT, "dihedral": _CURVED},
        marks={REST: "rest shape"},
    ),
)


def tasks(device):
    return [task(measure, device=device)]


def measure(device):
    """Returns the points of all panels, on an equilateral net, where D is exact."""
    flat, found = strip("equilateral", 0.0, _H).mesh, []
    shell = Mesh(rolled_up(flat.points, REST), flat.triangles)

    def add(panel, x, mesh, positions):
        for name, bending in BENDING.items():
            energy = 0.5 * bending_density(bending, mesh, positions, device=device, dtype="float64")
            found.append(point(panel, name, x, energy))

    for epsilon in np.linspace(-0.3, 0.3, 13):
        add("stretch", epsilon, flat, flat.points + epsilon * flat.points**2 * [1.0, 0.0, 0.0])
    for curvature in np.linspace(-1.0, 2.0, 13):
        moved = rolled_up(flat.points, curvature)
        add("flat", curvature, flat, moved)
        add("curved", curvature, shell, moved)
    return found
