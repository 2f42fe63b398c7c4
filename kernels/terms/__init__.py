"""The catalogue: the energies that :mod:`warpcloth.terms` declares, one line each."""

from .attachment import ATTACHMENT as ATTACHMENT
from .corotated_membrane import COROTATED_MEMBRANE as COROTATED_MEMBRANE
from .dihedral_bending import DIHEDRAL_BENDING as DIHEDRAL_BENDING
from .neo_hookean_membrane import NEO_HOOKEAN_MEMBRANE as NEO_HOOKEAN_MEMBRANE
from .orthotropic_membrane import ORTHOTROPIC_MEMBRANE as ORTHOTROPIC_MEMBRANE
from .plate_bending import PLATE_BENDING as PLATE_BENDING
from .quadratic_bending import QUADRATIC_BENDING as QUADRATIC_BENDING
from .rigid_cluster import RIGID_CLUSTER as RIGID_CLUSTER
from .shell_bending import SHELL_BENDING as SHELL_BENDING
from .spring import SPRING as SPRING
from .spring_limit import SPRING_LIMIT as SPRING_LIMIT
from .strain_limit import STRAIN_LIMIT as STRAIN_LIMIT
from .stvk_membrane import STVK_MEMBRANE as STVK_MEMBRANE
