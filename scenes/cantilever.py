"""A strip clamped at one end that bends under its own weight, Γ = ρgL³/D (Romero et al. 2021), on an equilateral mesh.

With a width of 0 it is one row of triangles along x, which bends with 1 − ν² = 8/9 of D, as both bending energies of hinges
have ν = −1/3. Otherwise it has rows of edges across; a plate, with ν = 0, needs a width. L is measured from the middle of the
pins, half an element from x = 0, to the free end (of a single row, its mean); for a plate from 0.18 elements behind the second
row of pins.

With a fabric, it is the sample of a Shirley tester: 25 mm wide by default, cut at an angle to the warp. L follows from Γ, ρ and
D; for Γ = 8, twice the bending length, the tip hangs 41.5° below the clamp.
"""

from typing import Literal, get_args

import numpy as np

import warpcloth as wc

Bending = Literal["quadratic", "dihedral", "plate"]
CLAMP = 0.18  # distance from the second row of pins back to where a plate is clamped, in elements


def scene(
    gamma: float = 10.0,
    width: float = 0.0,
    elements: int = 40,
    bending: Bending = "quadratic",
    stretching: float = 1e7,
    length: float = 1.0,
    duration: float = 2.0,
    fabric: str | None = None,
    angle: float = 0.0,
):
    """Γ, width [m], elements along, quadratic, dihedral or plate, kL²/D of springs, L [m], duration [s]; fabric, angle [°]."""
    wc.checks.number("gamma", gamma, above=0.0)
    wc.checks.number("width", width, least=0.0)
    wc.checks.whole("elements", elements, 2)
    wc.checks.number("length", length, above=0.0)
    wc.checks.choice("bending", bending, get_args(Bending))
    if bending == "plate" and width == 0.0 and fabric is None:
        raise ValueError("bending is 'plate' and width is 0, one row of triangles, which has no plate; give a width")
    wc.checks.number("angle", angle)
    held = 0.25 if width == 0.0 else 1.0 - CLAMP if bending == "plate" else 0.5  # elements from x = 0 to where L begins
    spacing, stiffness = length / (elements - held), 1e-3  # D [N·m]
    if fabric is not None:
        cloth = wc.fabrics.find(fabric)
        length = (gamma * cloth.bending_along(np.radians(angle)) / (9.81 * cloth.density)) ** (1 / 3)
        spacing, width = length / (elements + CLAMP), width or 0.025
        if width < 3.9 * spacing:
            raise ValueError(f"width is {width:g} m, below 4 elements of {spacing:.3g} m; take more elements or a wider strip")
        size = ((elements + 1) * spacing, width)
        mesh = wc.Mesh.grid(elements + 2, round(width / spacing) + 1, size=size, pattern="alternating")
    elif width == 0.0:
        mesh = wc.Mesh.grid(elements + 1, 2, size=spacing * elements, pattern="equilateral")
    else:
        across = max(round(width / spacing * np.sqrt(0.75)), 1)
        rows = wc.Mesh.grid(across + 1, elements + 1, size=across * spacing / np.sqrt(0.75), pattern="equilateral")
        mesh = wc.Mesh(rows.points[:, ::-1], rows.triangles[:, ::-1])  # x and z change places
    bend = {"quadratic": wc.QuadraticBending, "dihedral": wc.DihedralBending, "plate": wc.PlateBending}[bending]
    springs = wc.Spring(pairs="edges", stiffness=stretching * stiffness / length**2)
    return wc.Scene(
        mesh,
        density=cloth.density if fabric else gamma * stiffness / (9.81 * length**3),
        terms=cloth.terms(warp_angle=-np.radians(angle)) if fabric else [springs, bend(stiffness=stiffness)],
        pins=np.flatnonzero(mesh.points[:, 0] < 1.01 * spacing),
        duration=duration,
        name="cantilever",
    )
