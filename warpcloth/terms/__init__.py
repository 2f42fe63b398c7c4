"""The catalogue of energies, :data:`TERMS`; :func:`register` adds one from outside."""

from ..base.catalogue import Catalogue, imported_on_use
from ..base.extensions import note
from .declared import Declared

_MODULES = {
    "Attachment": "attachment",
    "CorotatedMembrane": "corotated_membrane",
    "DihedralBending": "dihedral_bending",
    "NeoHookeanMembrane": "neo_hookean_membrane",
    "OrthotropicMembrane": "orthotropic_membrane",
    "PlateBending": "plate_bending",
    "QuadraticBending": "quadratic_bending",
    "RigidCluster": "rigid_cluster",
    "ShellBending": "shell_bending",
    "Spring": "spring",
    "SpringLimit": "spring_limit",
    "StVKMembrane": "stvk_membrane",
    "StrainLimit": "strain_limit",
}
__all__ = list(_MODULES)
__getattr__ = imported_on_use(__name__, _MODULES)
TERMS = Catalogue(__name__, {name: name for name in __all__})


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
    if energy.__name__ in __all__ and energy is not TERMS[energy.__name__]:
        raise ValueError(f"{energy.__name__} is the name of an energy of warpcloth; it must have another")
    TERMS[energy.__name__] = energy
    note(energy)
    return energy
