"""Cloth simulation on NVIDIA Warp: every classic method on one scene, energies written once, output to USD.

Each public name is imported from its module when it is first used, and Warp with it.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from .base import interrupts as interrupts  # first, so that it handles interrupts while the other modules load
from .base.collector import collector_paused
from .base.extensions import load_installed
from .base.notebooks import show_by
from .base.quiet import prepare_warp

if TYPE_CHECKING:  # the table below, for type checkers
    from .analysis.analysis import Analyzer as Analyzer
    from .analysis.analysis import analyze as analyze
    from .analysis.compare import Comparison as Comparison
    from .analysis.compare import compare as compare
    from .analysis.intersections import intersections as intersections
    from .analysis.samples import Analysis as Analysis
    from .analysis.surface_comparison import SurfaceComparison as SurfaceComparison
    from .analysis.surface_comparison import compare_surfaces as compare_surfaces
    from .base import checks as checks
    from .deformation.arap import Arap as Arap
    from .deformation.deform import Deformation as Deformation
    from .deformation.deform import deform as deform
    from .deformation.registration import Resampled as Resampled
    from .deformation.registration import resample as resample
    from .lab.laboratory import laboratory_readings as laboratory_readings
    from .mesh import ordering as ordering
    from .mesh.captures import Capture as Capture
    from .mesh.captures import as_capture as as_capture
    from .mesh.captures import open_capture as open_capture
    from .mesh.mesh import Mesh as Mesh
    from .mesh.sequences import Sequence as Sequence
    from .mesh.sequences import as_sequence as as_sequence
    from .mesh.sequences import open_sequence as open_sequence
    from .numerics.rotation import kabsch as kabsch
    from .numerics.rotation import polar as polar
    from .numerics.rotation import svd as svd
    from .picture.pages import view as view
    from .picture.render import render as render
    from .run.equilibrium import Equilibrium as Equilibrium
    from .run.equilibrium import equilibrium as equilibrium
    from .run.fit import Fit as Fit
    from .run.fit import fit as fit
    from .run.readings import CapturePoints as CapturePoints
    from .run.readings import Markers as Markers
    from .run.readings import Reading as Reading
    from .run.simulate import Animation as Animation
    from .run.simulate import simulate as simulate
    from .scene.air import Air as Air
    from .scene.colliders import Box as Box
    from .scene.colliders import Capsule as Capsule
    from .scene.colliders import Contact as Contact
    from .scene.colliders import Plane as Plane
    from .scene.colliders import Sphere as Sphere
    from .scene.fabric import Fabric as Fabric
    from .scene.fabric_files import read_fabrics as read_fabrics
    from .scene.measured_fabrics import fabrics as fabrics
    from .scene.mesh_collider import MeshCollider as MeshCollider
    from .scene.scene import Pins as Pins
    from .scene.scene import Scene as Scene
    from .scene.self_contact import SelfContact as SelfContact
    from .solvers.admm import ADMM as ADMM
    from .solvers.constrained_dynamics import ConstrainedDynamics as ConstrainedDynamics
    from .solvers.explicit import Explicit as Explicit
    from .solvers.hierarchical_pbd import HierarchicalPBD as HierarchicalPBD
    from .solvers.newton import Newton as Newton
    from .solvers.pbd import PBD as PBD
    from .solvers.projective_dynamics import ProjectiveDynamics as ProjectiveDynamics
    from .solvers.xpbd import XPBD as XPBD
    from .terms.attachment import Attachment as Attachment
    from .terms.corotated_membrane import CorotatedMembrane as CorotatedMembrane
    from .terms.dihedral_bending import DihedralBending as DihedralBending
    from .terms.loads import Force as Force
    from .terms.loads import Pressure as Pressure
    from .terms.loads import Traction as Traction
    from .terms.neo_hookean_membrane import NeoHookeanMembrane as NeoHookeanMembrane
    from .terms.orthotropic_membrane import OrthotropicMembrane as OrthotropicMembrane
    from .terms.plate_bending import PlateBending as PlateBending
    from .terms.quadratic_bending import QuadraticBending as QuadraticBending
    from .terms.rigid_cluster import RigidCluster as RigidCluster
    from .terms.shell_bending import ShellBending as ShellBending
    from .terms.spring import Spring as Spring
    from .terms.spring_limit import SpringLimit as SpringLimit
    from .terms.strain_limit import StrainLimit as StrainLimit
    from .terms.stvk_membrane import StVKMembrane as StVKMembrane

# The module of each public name. The names of the two catalogues are added.
_MODULES = {
    "Analyzer": "analysis.analysis",
    "analyze": "analysis.analysis",
    "Comparison": "analysis.compare",
    "compare": "analysis.compare",
    "intersections": "analysis.intersections",
    "Analysis": "analysis.samples",
    "SurfaceComparison": "analysis.surface_comparison",
    "compare_surfaces": "analysis.surface_comparison",
    "checks": "base",
    "Arap": "deformation.arap",
    "Deformation": "deformation.deform",
    "deform": "deformation.deform",
    "Resampled": "deformation.registration",
    "resample": "deformation.registration",
    "laboratory_readings": "lab.laboratory",
    "ordering": "mesh",
    "Capture": "mesh.captures",
    "as_capture": "mesh.captures",
    "open_capture": "mesh.captures",
    "Mesh": "mesh.mesh",
    "Sequence": "mesh.sequences",
    "as_sequence": "mesh.sequences",
    "open_sequence": "mesh.sequences",
    "kabsch": "numerics.rotation",
    "polar": "numerics.rotation",
    "svd": "numerics.rotation",
    "view": "picture.pages",
    "render": "picture.render",
    "Equilibrium": "run.equilibrium",
    "equilibrium": "run.equilibrium",
    "Fit": "run.fit",
    "fit": "run.fit",
    "CapturePoints": "run.readings",
    "Markers": "run.readings",
    "Reading": "run.readings",
    "Animation": "run.simulate",
    "simulate": "run.simulate",
    "Air": "scene.air",
    "Box": "scene.colliders",
    "Capsule": "scene.colliders",
    "Contact": "scene.colliders",
    "Plane": "scene.colliders",
    "Sphere": "scene.colliders",
    "Fabric": "scene.fabric",
    "read_fabrics": "scene.fabric_files",
    "fabrics": "scene.measured_fabrics",
    "MeshCollider": "scene.mesh_collider",
    "Pins": "scene.scene",
    "Scene": "scene.scene",
    "SelfContact": "scene.self_contact",
    "Force": "terms.loads",
    "Pressure": "terms.loads",
    "Traction": "terms.loads",
}
_CATALOGUES = ("solvers", "terms")


@show_by
def _html(source):
    """Returns the HTML by which a notebook shows an animation, from the package that draws."""
    return _from("picture.pages", "notebook_html")(source)


if not TYPE_CHECKING:  # with __getattr__, a type checker would accept any name

    def __getattr__(name):
        if name.startswith("__") and name != "__all__":  # Python and its tools ask every module for these
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        with collector_paused():
            if name == "__all__":
                value = [*_MODULES, *(public for room in _CATALOGUES for public in _from(room, "__all__"))]
            else:
                import_module(".usd", __name__)  # any function may be given a stage
                value = _find(name)
                prepare_warp()
                load_installed()
        return globals().setdefault(name, value)


def _find(name):
    if name in _MODULES:
        return _from(_MODULES[name], name)
    for catalogue in _CATALOGUES:
        if name in _from(catalogue, "__all__"):
            return _from(catalogue, name)
    if find_spec(f".{name}", __name__):  # a subpackage, such as solvers
        return import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _from(module, name):
    """Returns what ``from .module import name`` gives."""
    return getattr(__import__(f"{__name__}.{module}", fromlist=[name]), name)


def __dir__():
    return sys.modules[__name__].__all__


if sys.modules.get("warp"):  # the user may change its settings from here on
    prepare_warp()
