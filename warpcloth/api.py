"""The public names, which the package passes on when one of them is first used: the catalogues' and those below."""

from . import solvers, terms
from .analysis.analysis import Analyzer, analyze
from .analysis.compare import Comparison, compare
from .analysis.samples import Analysis
from .base import checks
from .base.extensions import load_installed
from .base.quiet import prepare_warp
from .deformation.arap import Arap
from .deformation.deform import Deformation, deform
from .mesh import ordering
from .mesh.mesh import Mesh
from .mesh.sequences import Sequence, as_sequence, open_sequence
from .numerics.rotation import kabsch, polar, svd
from .run.equilibrium import Equilibrium, equilibrium
from .run.simulate import Animation, simulate
from .scene.scene import Pins, Scene
from .solvers import *  # noqa: F403
from .terms import *  # noqa: F403

__all__ = [
    "Analysis",
    "Analyzer",
    "Animation",
    "Arap",
    "Comparison",
    "Deformation",
    "Equilibrium",
    "Mesh",
    "Pins",
    "Scene",
    "Sequence",
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
__all__ += solvers.__all__
__all__ += terms.__all__

prepare_warp()
load_installed()
