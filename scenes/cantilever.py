"""A strip clamped at one end that bends under its own weight, Γ = ρgL³/D (Romero et al. 2021), on an equilateral mesh.

The strip extends along x. With a width of 0 it is one row of triangles, which bends with 1 − ν² = 8/9 of D, because both
bending energies have the Poisson's ratio ν = −1/3. Otherwise it has rows of edges across its width. L is measured from the
middle of the pins, half an element from x = 0, to the free end (of a single row, its mean).
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
    """Γ, width [m], elements along, quadratic or dihedral, kL²/D for the spring stiffness k, L [m], duration [s]."""
    wc.checks.number("width", width, least=0.0)
    wc.checks.choice("bending", bending, ("quadratic", "dihedral"))
    spacing = length / (elements - (0.25 if width == 0.0 else 0.5))
    if width == 0.0:
        mesh = wc.Mesh.grid(elements + 1, 2, size=spacing * elements, pattern="equilateral")
    else:
        across = max(round(width / spacing * np.sqrt(0.75)), 1)
        rows = wc.Mesh.grid(across + 1, elements + 1, size=across * spacing / np.sqrt(0.75), pattern="equilateral")
        mesh = wc.Mesh(rows.points[:, ::-1], rows.triangles[:, ::-1])  # x and z change places
    stiffness = 1e-3  # D [N·m]
    bend = wc.QuadraticBending if bending == "quadratic" else wc.DihedralBending
    return wc.Scene(
        mesh,
        density=gamma * stiffness / (9.81 * length**3),
        terms=[wc.Spring(pairs="edges", stiffness=stretching * stiffness / length**2), bend(stiffness=stiffness)],
        pins=np.flatnonzero(mesh.points[:, 0] < 1.01 * spacing),
        duration=duration,
        name="cantilever",
    )
