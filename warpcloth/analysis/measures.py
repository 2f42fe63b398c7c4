"""The measures of a deforming surface: names, shapes, units and definitions."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import did_you_mean, shown


@dataclass(frozen=True)
class Measure:
    """A field of numbers of triangles or vertices.

    Attributes:
        shape: Shape of one value, () for a number.
        unit: SI unit, or "1".
        neutral: Undeformed value, the middle of a colour scale, or None if scales start at 0.
        rate: Whether it is a rate from the previous frame.
        needs: "directions" or "material", options of :func:`warpcloth.analyze`, or "".
        summed: Whether :func:`scalars` uses it, unlike rotations and unit vectors.
        undefined: Why an element may have no value.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    text: str
    neutral: float | None = None
    rate: bool = False
    needs: str = ""
    summed: bool = True
    undefined: str = "has collapsed"


_TURNED = "turns by 180° or more, or has collapsed"
_EQUAL = "has stretches that are equal but for rounding, and so no principal directions"
_FORCES: dict[str, Any] = {"needs": "material"}
_THREADS: dict[str, Any] = {"needs": "directions", "undefined": "has collapsed, or has no such directions"}
_RATES = (
    Measure("velocity_gradient", (3, 3), "1/s", "L = ḞF⁻¹", 0.0, True, undefined=_TURNED),
    Measure("rate_of_strain", (3, 3), "1/s", "D = ½(L + Lᵀ) in the tangent plane", 0.0, True, undefined=_TURNED),
    Measure("spin", (3, 3), "1/s", "Ω = ½(L − Lᵀ)", 0.0, True, undefined=_TURNED),
    Measure("stretch_rate", (2,), "1/s", "λ̇/λ of the principal stretches in the tangent plane", 0.0, True),
    Measure("rest_direction_rate", (), "rad/s", "turn of the first principal direction in the material, about the normal", 0.0,
            True, undefined=_EQUAL),
    Measure("direction_rate", (3,), "rad/s", "turn of the first principal direction in space, along its axis", 0.0, True,
            undefined=_EQUAL),
)  # fmt: skip
_LISTED = {
    "triangle": (
        Measure("deformation_gradient", (3, 2), "1", "F = [x₁ − x₀, x₂ − x₀] Dm⁻¹, from the triangle's rest frame to space"),
        Measure("rotation", (3, 2), "1", "R of F = R U", summed=False),
        Measure("right_stretch", (2, 2), "1", "U of F = R U"),
        Measure("right_cauchy_green", (2, 2), "1", "C = FᵀF = U²"),
        Measure("green_strain", (2, 2), "1", "E = ½(C − I)", 0.0),
        Measure("stretch", (2,), "1", "principal stretches λ₁ ≥ λ₂, the singular values of F", 1.0),
        Measure("rest_directions", (2, 3), "1", "principal directions in the reference, unit vectors", summed=False),
        Measure("directions", (2, 3), "1", "principal directions in the frame, unit vectors", summed=False),
        Measure("rotation_angle", (), "rad", "angle of R as a rotation in space, 0 to π"),
        Measure("area_ratio", (), "1", "area over that of the reference, λ₁λ₂", 1.0),
        Measure("length_ratio", (2,), "1", "stretches along warp and weft", 1.0, **_THREADS),
        Measure("angle", (), "rad", "angle between warp and weft", np.pi / 2, **_THREADS),
        Measure("energy_density", (), "J/m²", "elastic energy, of reference area", **_FORCES),
        Measure("first_piola_stress", (3, 2), "N/m", "P = ∂u/∂F, force over reference length", 0.0, **_FORCES),
        Measure("cauchy_stress", (3, 3), "N/m", "σ = P Fᵀ/J, force over length", 0.0, **_FORCES),
        *_RATES,
        Measure("length_rate", (2,), "1/s", "rates of the lengths along warp and weft, l̇/l", 0.0, True, **_THREADS),
        Measure("angle_rate", (), "rad/s", "rate of the angle between warp and weft; that of shear is its negative", 0.0, True,
                **_THREADS),
    ),
    "vertex": (
        Measure("rotation", (3, 3), "1", "rotation that fits the neighbourhood best (Kabsch 1976)", summed=False),
        Measure("rotation_angle", (), "rad", "its angle, 0 to π"),
        Measure("residual", (), "m", "root of the mean squared distance that this rotation leaves"),
        Measure("deformation_gradient", (3, 3), "1", "F of least squares, with the normal as one pair more"),
        Measure("stretch", (3,), "1", "singular values λ₁ ≥ λ₂ ≥ λ₃ of F; that along the normal is prescribed, 1", 1.0),
        Measure("directions", (3, 3), "1", "their directions in the frame, unit vectors", summed=False),
        Measure("cross_covariance", (3, 3), "m²", "H = Σ p qᵀ, which has the rotation and the shape of the set in it"),
        *_RATES,
    ),
}  # fmt: skip
MEASURES = {on: {measure.name: measure for measure in listed} for on, listed in _LISTED.items()}


def chosen(names, on, given=("directions", "material", "rate")):
    """Returns the measures of a list of names, or "all" whose needs are ``given``; raises ValueError without any."""
    known = MEASURES[on]
    if isinstance(names, str):
        names = (names,)
    try:
        names = tuple(names)
    except TypeError:
        raise ValueError(f"measures is {shown(names)}; it must be one or more of {', '.join(known)}, or all") from None
    if names == ("all",):
        return [m for m in known.values() if (not m.needs or m.needs in given) and (not m.rate or "rate" in given)]
    for name in names:
        if not isinstance(name, str) or name not in known:
            other = next((where for where, found in MEASURES.items() if name in found), None) if isinstance(name, str) else None
            hint = f" (it is one of each {other})" if other else ""
            raise ValueError(
                f"measures: {shown(name)}{hint} must be one of {', '.join(known)}, or all{did_you_mean(name, known)}"
            )
    if not names:
        raise ValueError(f"measures: none; must be one or more of {', '.join(known)}, or all")
    return [known[name] for name in dict.fromkeys(names)]


def scalars(measure, values):
    """Returns the scalars of a field (E, *shape), arrays (E,) by name.

    Vectors give components, such as ``stretch_1``, matrices the Frobenius norm, such as ``spin_norm``, rotations and unit
    vectors none.
    """
    if not measure.summed:
        return {}
    if not measure.shape:
        return {measure.name: values}
    if len(measure.shape) == 1:
        return {f"{measure.name}_{k + 1}": values[:, k] for k in range(measure.shape[0])}
    flat = values.reshape(len(values), -1)
    return {f"{measure.name}_norm": np.sqrt(np.einsum("ij,ij->i", flat, flat))}
