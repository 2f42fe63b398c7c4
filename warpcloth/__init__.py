"""Cloth simulation: every classic method on the same scene, from energies written once, on NVIDIA Warp, writing USD."""

from .base import interrupts as interrupts  # first: it handles interrupts while the other modules load, which takes a second

# isort: split
from .analysis.analysis import Analyzer, analyze
from .analysis.compare import Comparison, compare
from .analysis.samples import Analysis
from .base import checks
from .base.kernel_cache import mend
from .base.quiet import leave_out_news
from .deformation.arap import Arap
from .deformation.deform import Deformation, deform
from .mesh import ordering
from .mesh.mesh import Mesh
from .mesh.sequences import Sequence, as_sequence, open_sequence
from .numerics.rotation import kabsch, polar, svd
from .run.equilibrium import Equilibrium, equilibrium
from .run.simulate import Animation, simulate
from .scene.scene import Pins, Scene
from .solvers import ADMM, PBD, XPBD, ConstrainedDynamics, Explicit, HierarchicalPBD, Newton, ProjectiveDynamics
from .terms import (
    Attachment,
    CorotatedMembrane,
    DihedralBending,
    NeoHookeanMembrane,
    QuadraticBending,
    RigidCluster,
    Spring,
    SpringLimit,
    StrainLimit,
    StVKMembrane,
)

__all__ = [
    "ADMM",
    "PBD",
    "XPBD",
    "Analysis",
    "Analyzer",
    "Animation",
    "Arap",
    "Attachment",
    "Comparison",
    "ConstrainedDynamics",
    "CorotatedMembrane",
    "Deformation",
    "DihedralBending",
    "Equilibrium",
    "Explicit",
    "HierarchicalPBD",
    "Mesh",
    "NeoHookeanMembrane",
    "Newton",
    "Pins",
    "ProjectiveDynamics",
    "QuadraticBending",
    "RigidCluster",
    "Scene",
    "Sequence",
    "Spring",
    "SpringLimit",
    "StVKMembrane",
    "StrainLimit",
    "analyze",
    "as_sequence",
    "checks",
    "compare",
    "deform",
    "equilibrium",
    "kabsch",
    "open_sequence",
    "ordering",
    "polar",
    "simulate",
    "svd",
]

leave_out_news()
mend()


def __dir__():
    return __all__
