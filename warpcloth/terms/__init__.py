"""The catalogue of energies: each has a file with its record, and two lines here.

:data:`TERMS` has them by name; :func:`register` adds one from outside.
"""

from ..base.extensions import note
from .attachment import Attachment
from .corotated_membrane import CorotatedMembrane
from .declared import Declared
from .dihedral_bending import DihedralBending
from .neo_hookean_membrane import NeoHookeanMembrane
from .orthotropic_membrane import OrthotropicMembrane
from .plate_bending import PlateBending
from .quadratic_bending import QuadraticBending
from .rigid_cluster import RigidCluster
from .shell_bending import ShellBending
from .spring import Spring
from .spring_limit import SpringLimit
from .strain_limit import StrainLimit
from .stvk_membrane import StVKMembrane

__all__ = [
    "Attachment",
    "CorotatedMembrane",
    "DihedralBending",
    "NeoHookeanMembrane",
    "OrthotropicMembrane",
    "PlateBending",
    "QuadraticBending",
    "RigidCluster",
    "ShellBending",
    "Spring",
    "SpringLimit",
    "StVKMembrane",
    "StrainLimit",
]

TERMS = {name: globals()[name] for name in __all__}


def register(energy):
    """Adds the record of an energy to :data:`TERMS`, in place of one of that name; also a decorator.

    Args:
        energy: A frozen dataclass that derives from :class:`warpcloth.terms.declared.Declared`.

    Raises:
        ValueError: It is not such a class, or it has the name of an energy of the package.
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
