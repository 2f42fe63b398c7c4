"""Cloth simulation: every classic method on the same scene, from energies written once, on NVIDIA Warp, writing USD."""

from . import interrupts as interrupts  # first: it handles interrupts while the other modules load, which takes a second

# isort: split
from . import checks, ordering
from .analysis import Analyzer, analyze
from .arap import Arap
from .compare import Comparison, compare
from .deform import Deformation, deform
from .equilibrium import Equilibrium, equilibrium
from .kernel_cache import mend
from .mesh import Mesh
from .quiet import leave_out_news
from .rotation import kabsch, polar, svd
from .samples import Analysis
from .scene import Pins, Scene
from .sequences import Sequence, as_sequence, open_sequence
from .simulate import Animation, simulate
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
