"""The catalogue: the only list of the energies."""

from .attachment import ATTACHMENT
from .dihedral_bending import DIHEDRAL_BENDING
from .quadratic_bending import QUADRATIC_BENDING
from .spring import SPRING

CATALOGUE = (SPRING, QUADRATIC_BENDING, DIHEDRAL_BENDING, ATTACHMENT)
