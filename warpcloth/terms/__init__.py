"""The catalogue of the energies that a scene declares: one file, one record and two lines here for each.

Stages and others that name an energy look it up in :data:`TERMS`; :func:`register` adds one from outside the package.
"""

from ..base.extensions import note
from .attachment import Attachment
from .corotated_membrane import CorotatedMembrane
from .declared import Declared
from .dihedral_bending import DihedralBending
from .neo_hookean_membrane import NeoHookeanMembrane
from .plate_bending import PlateBending
from .quadratic_bending import QuadraticBending
from .rigid_cluster import RigidCluster
from .spring import Spring
from .spring_limit import SpringLimit
from .strain_limit import StrainLimit
from .stvk_membrane import StVKMembrane

__all__ = [
    "Attachment",
    "CorotatedMembrane",
    "DihedralBending",
    "NeoHookeanMembrane",
    "PlateBending",
    "QuadraticBending",
    "RigidCluster",
    "Spring",
    "SpringLimit",
    "StVKMembrane",
    "StrainLimit",
]

TERMS = {name: globals()[name] for name in __all__}


def register(energy):
    """Adds the record of an energy to :data:`TERMS`, so that stages, charts and tests know it by its name.

    It replaces one of the same name from outside the package, such as the same file loaded before.

    Args:
        energy: A frozen dataclass that derives from :class:`warpcloth.terms.declared.Declared`.

    Returns:
        The same class, so that this is a decorator too.

    Raises:
        ValueError: If it is not such a class, or has the name of an energy of the package.
    """
    if not (isinstance(energy, type) and issubclass(energy, Declared) and hasattr(energy, "term")):
        raise ValueError(
            f"{energy!r} is no energy; it must be a class with a term that derives from warpcloth.terms.declared.Declared"
        )
    if energy.__name__ in __all__ and energy is not globals()[energy.__name__]:
        raise ValueError(f"{energy.__name__} is the name of an energy of warpcloth; it must have another")
    TERMS[energy.__name__] = energy
    note(energy)
    return energy
