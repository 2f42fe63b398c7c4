"""A strip clamped at one end that bends under its own weight, Γ = ρgL³/D (Romero et al. 2021), on an equilateral mesh.

Length runs along x. Of no width it is one row of triangles, which bends with 8/9 of D, for both bending energies have Poisson's
ratio 1/3; otherwise rows of edges lie across the width. The clamp is in the middle of the pinned vertices, half an element
from x = 0, and the free length L counts from there (to the mean of both row ends of a single row).
"""

import numpy as np

import warpcloth as wc


def scene(
    gamma: float = 10.0,
    width: float = 0.0,
    elements: int = 40,
    bending: str = "quadratic",
    stretching: float = 1e7,
    length: float = 1.0,
    duration: float = 2.0,
):
    """Γ, width [m], elements along, quadratic or dihedral, kL²/D of the springs' k, L [m], duration [s]."""
    if width == 0.0:
        spacing = length / (elements - 0.25)
        mesh = wc.Mesh.grid(elements + 1, 2, size=spacing * elements, pattern="equilateral")
    else:
        spacing = length / (elements - 0.5)
        edge = spacing / np.sqrt(0.75)
        across = max(round(width / edge), 1)
        rows = wc.Mesh.grid(across + 1, elements + 1, size=edge * across, pattern="equilateral")
        mesh = wc.Mesh(rows.points[:, ::-1], rows.triangles[:, ::-1])  # x and z change places
    stiffness = 1e-3  # D [N·m]
    bend = {"quadratic": wc.QuadraticBending, "dihedral": wc.DihedralBending}[bending]
    return wc.Scene(
        mesh,
        density=gamma * stiffness / (9.81 * length**3),
        terms=[wc.Spring(pairs="edges", stiffness=stretching * stiffness / length**2), bend(stiffness=stiffness)],
        pins=np.flatnonzero(mesh.points[:, 0] < 1.01 * spacing),
        duration=duration,
        name="cantilever",
    )
