"""The catalogue: the only list of the energies."""

from .attachment import ATTACHMENT
from .corotated_membrane import COROTATED_MEMBRANE
from .dihedral_bending import DIHEDRAL_BENDING
from .membrane_damping import MEMBRANE_DAMPING
from .neo_hookean_membrane import NEO_HOOKEAN_MEMBRANE
from .quadratic_bending import DAMPED_QUADRATIC_BENDING, QUADRATIC_BENDING
from .rigid_cluster import RIGID_CLUSTER
from .spring import SPRING
from .spring_limit import SPRING_LIMIT
from .strain_limit import STRAIN_LIMIT
from .stvk_membrane import STVK_MEMBRANE

CATALOGUE = (
    SPRING,
    COROTATED_MEMBRANE,
    STVK_MEMBRANE,
    NEO_HOOKEAN_MEMBRANE,
    QUADRATIC_BENDING,
    DIHEDRAL_BENDING,
    ATTACHMENT,
    SPRING_LIMIT,
    STRAIN_LIMIT,
    RIGID_CLUSTER,
)
# What damping makes of those whose sum with it is another energy, or that it stands beside.
DISSIPATIONS = (DAMPED_QUADRATIC_BENDING, MEMBRANE_DAMPING)
