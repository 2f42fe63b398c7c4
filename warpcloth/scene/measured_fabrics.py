"""Measured fabrics, by name. Papers that differ have a record each."""

from ..base.checks import did_you_mean, shown
from .fabric import Fabric

_CLYDE = "Clyde, Teran and Tamstorf 2017, Modeling and data-driven parameter estimation for woven fabrics"
_PENAVA = (
    "Penava, Šimić Penava and Knezić 2014, Determination of the elastic constants of plain woven fabrics by a tensile test"
)
_WANG = "Wang, O'Brien and Ramamoorthi 2011, Data-driven elastic models for cloth: modeling and measurement"
_PLATES = (
    "Moduli in the plane from a model fitted to measurements. D₁ and D₂ were not measured: they are computed, "
    "E₁t³/12(1 − ν₁₂ν₂₁) and E₂t³/12(1 − ν₁₂ν₂₁)."
)
_TENSILE = "Moduli and Poisson's ratio by tensile tests in the plane. Shear modulus and bending were not measured."
_ZERO_STRAIN = (
    "Moduli at zero strain, as the authors' code takes them: entries k₁ and k₂ of the tensor, equal to Young's moduli only if "
    "ν₁₂ = 0. ν₁₂ and thickness are not known. D is uncertain by a factor of 4, by which the paper and the code differ. "
    "Whether Gt belongs to 2E₁₂ or to E₁₂ is uncertain too, a factor of 2."
)


class Fabrics(dict[str, Fabric]):
    """Fabrics by name.

    Raises:
        ValueError: ``fabrics[name]`` does not exist; the message lists the names.
    """

    def __missing__(self, name: str) -> Fabric:
        raise ValueError(f"fabric is {name!r}; it must be one of {', '.join(self)}{did_you_mean(name, self)}")

    def find(self, fabric: Fabric | str) -> Fabric:
        """Returns a fabric by its name, or itself.

        Raises:
            ValueError: It is neither.
        """
        if isinstance(fabric, str):
            return self[fabric]
        if not isinstance(fabric, Fabric):
            raise ValueError(f"fabric is {shown(fabric)}; it must be a Fabric or its name")
        return fabric


def _plate(name, density, millimetres, warp, weft, shear, ratio):
    t = 1e-3 * millimetres
    whole = t**2 / 12.0 / (1.0 - ratio**2 * weft / warp)
    return Fabric(
        name=name,
        density=density,
        thickness=t,
        warp=warp,
        weft=weft,
        shear=shear,
        poisson_ratio=ratio,
        bending_warp=warp * whole,
        bending_weft=weft * whole,
        source=_CLYDE,
        notes=_PLATES,
        computed=("bending_warp", "bending_weft"),
    )


def _in_plane(name, density, millimetres, warp, weft, ratio):
    given = {"thickness": 1e-3 * millimetres, "warp": warp, "weft": weft, "poisson_ratio": ratio}
    return Fabric(name=name, density=density, **given, source=_PENAVA, notes=_TENSILE)


def _zero_strain(name, density, warp, weft, shear, bending_warp, bending_weft):
    """A fabric with D₁ and D₂ in µN·m."""
    bending = {"bending_warp": 1e-6 * bending_warp, "bending_weft": 1e-6 * bending_weft}
    given = {"warp": warp, "weft": weft, "shear": shear, **bending}
    return Fabric(name=name, density=density, **given, source=_WANG, notes=_ZERO_STRAIN)


fabrics = Fabrics(
    (found.name, found)
    for found in (
        _plate("cotton", 0.1036, 0.18, 2365.0, 3801.0, 194.0, 0.31),
        _plate("wool", 0.4806, 1.28, 2175.0, 2108.0, 475.0, 0.52),
        _plate("canvas", 0.294, 0.53, 2651.0, 9785.0, 1065.0, 0.14),
        _plate("silk", 0.083, 0.18, 327.0, 755.0, 103.0, 0.50),
        _plate("denim", 0.400, 0.66, 1673.0, 3152.0, 1616.0, 0.50),
        _in_plane("cotton-penava", 0.1503, 0.318, 10093.0, 3694.0, 0.243),
        _in_plane("wool-penava", 0.2348, 0.568, 12320.0, 4532.0, 0.277),
        _in_plane("wool-lycra-penava", 0.1782, 0.328, 57.0, 254.0, 0.071),
        _in_plane("polyester-penava", 0.1646, 0.252, 1178.0, 2821.0, 0.381),
        _zero_strain("denim-wang", 0.324, 411.0, 2028.0, 27.0, 16.0, 24.0),
        _zero_strain("interlock-wang", 0.187, 33.0, 69.0, 18.0, 5.8, 3.6),
        _zero_strain("ponte-roma-wang", 0.284, 62.0, 88.0, 16.0, 9.1, 9.3),
        _zero_strain("rib-knit-wang", 0.276, 86.0, 130.0, 42.0, 11.6, 8.1),
        _zero_strain("swim-nylon-wang", 0.204, 96.0, 209.0, 30.0, 15.1, 12.8),
        _zero_strain("blanket-polyester-wang", 0.228, 303.0, 490.0, 15.0, 29.0, 15.0),
        _zero_strain("jacket-polyester-wang", 0.113, 86.0, 343.0, 7.0, 3.6, 5.1),
    )
)

# Drape coefficients [%] that were computed, not measured: means over eight starts of the scene `cusick` with rows=8. Records
# that lack a number which the scene needs have none.
DRAPES = {"cotton": 71.1, "wool": 96.8, "canvas": 90.9, "silk": 52.1, "denim": 91.0}


def computed_drape(fabric: Fabric) -> float | None:
    """Returns the drape coefficient [%] in :data:`DRAPES`, or None."""
    return DRAPES.get(fabric.name) if fabrics.get(fabric.name) is fabric else None
