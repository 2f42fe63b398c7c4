"""Cloth simulation: every classic method on the same scene, from energies written once, on NVIDIA Warp, writing USD."""

from .arap import Arap
from .deform import Deformation, deform
from .equilibrium import Equilibrium, equilibrium
from .mesh import Mesh
from .rotation import kabsch, polar, svd
from .scene import Pins, Scene
from .simulate import Animation, simulate
from .solvers import ADMM, PBD, XPBD, Explicit, Newton, ProjectiveDynamics
from .terms import Attachment, DihedralBending, QuadraticBending, Spring

__all__ = [
    "ADMM",
    "PBD",
    "XPBD",
    "Animation",
    "Arap",
    "Attachment",
    "Deformation",
    "DihedralBending",
    "Equilibrium",
    "Explicit",
    "Mesh",
    "Newton",
    "Pins",
    "ProjectiveDynamics",
    "QuadraticBending",
    "Scene",
    "Spring",
    "deform",
    "equilibrium",
    "kabsch",
    "polar",
    "simulate",
    "svd",
]
