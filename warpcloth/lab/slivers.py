"""Dihedral bending of slivers, whose stiffness has no bound, and of hinges that fold through, whose angle jumps.

The angle of a hinge changes by 1/height per metre of normal motion of its apex, so a sliver has the largest forces and the
smallest explicit step of a mesh. With a height below 1e-6 of the longest side it has no force. When a hinge is folded flat, its
angle jumps from π to −π, and the force changes sign.
"""

import numpy as np

from ..base.turns import in_turn
from ..core.gradient import Gradient
from ..mesh.mesh import Mesh
from ..scene.scene import Scene
from ..solvers.explicit import step_limits
from ..terms import DihedralBending
from .measurements import task
from .panels import Panel, point
from .physics import BENDING, energies

TITLE = "11. Dihedral bending: slivers, and hinges that fold through"
GUARD = 1e-6  # of the longest side
_HEIGHT = np.sqrt(0.75)  # of an equilateral triangle over its side
_WEIGHT = 2.0 / np.sqrt(3.0)  # |e|²/(A₁ + A₂) of two such
_TURN = 1.0  # [rad]


def limit(height):
    """Returns 2/ω of a flat hinge with unit edge, masses and D, one triangle equilateral; its Hessian is cD∇θ∇θᵀ."""
    a, b = 1.0 / height, 1.0 / _HEIGHT
    return 2.0 / np.sqrt(2.0 / (height + _HEIGHT) * (a**2 + b**2 + 0.5 * (a + b) ** 2))


def folded(degrees, rest=0.0):
    """Returns θ − θ̄ [rad] in (−π, π] of a hinge folded by some degrees."""
    turn = np.radians(degrees) - rest
    return turn - 2.0 * np.pi * np.ceil((turn - np.pi) / (2.0 * np.pi))


# Series by the kind of bending and its fold at rest [°], and their laws.
_FOLDS = {
    "dihedral, 0° at rest": ("dihedral", 0.0),
    "dihedral, 90° at rest": ("dihedral", 90.0),
    "quadratic": ("quadratic", 0.0),
}
_ENERGIES = {
    "½θ², θ in (−π, π]": lambda d: 0.5 * folded(d) ** 2,
    "½(θ − θ̄)², in (−π, π]": lambda d: 0.5 * folded(d, 0.5 * np.pi) ** 2,
    "2 sin²(θ/2)": lambda d: 2.0 * np.sin(0.5 * np.radians(d)) ** 2,
}
_TORQUES = {
    "θ in (−π, π]": folded,
    "θ − θ̄ in (−π, π]": lambda d: folded(d, 0.5 * np.pi),
    "sin θ": lambda d: np.sin(np.radians(d)),
}
_GRADIENT = "|e|/height, 0 below the guard"
_STEP = "2/ω, c = |e|²/(A₁ + A₂)"
PANELS = (
    Panel(
        "gradient",
        "The gradient grows beyond bounds, down to a relative guard",
        "height of the apex over the edge",
        "|∂θ/∂x| of the apex × edge",
        ("log", "log"),
        laws={_GRADIENT: lambda h: 1.0 / h if h > GUARD else 0.0},
        follows={f"edge {size}, {dtype}": _GRADIENT for size in ("1 m", "1 mm") for dtype in ("float32", "float64")},
        marks={GUARD: "no force at 1e-6 of the longest side and below"},
    ),
    Panel(
        "step",
        "The explicit step falls with the height of one sliver",
        "height of the apex over the edge",
        "largest stable step × √(D/m)/edge",
        ("log", "log"),
        laws={_STEP: limit},
        follows={"step limit of Explicit": _STEP},
    ),
    Panel(
        "energy",
        "Folded through flat: the energy turns back at π",
        "fold [°]",
        "energy over cD",
        laws=_ENERGIES,
        follows=dict(zip(_FOLDS, _ENERGIES, strict=True)),
        marks={180.0: "folded flat"},
    ),
    Panel(
        "torque",
        "… and the torque jumps by 2π",
        "fold [°]",
        "torque about the edge over cD [rad]",
        laws=_TORQUES,
        follows=dict(zip(_FOLDS, _TORQUES, strict=True)),
        marks={180.0: "folded flat"},
    ),
)


def tasks(device):
    return [task(measure, device=device)]


def measure(device):
    """Returns the points of all panels, for one hinge."""
    found = []
    for size, label in ((1.0, "1 m"), (1e-3, "1 mm")):
        for dtype in ("float32", "float64"):
            for height in np.geomspace(1.0, 1e-7, 30):
                gradient = apex_gradient(height, size, device, dtype)
                found.append(point("gradient", f"edge {label}, {dtype}", height, gradient * size))
    for height in np.geomspace(1.0, 1e-5, 16):
        found.append(point("step", "step limit of Explicit", height, step_limit(height, device)))
    for series, (term, rest) in _FOLDS.items():
        for fold in np.arange(5.0, 360.0, 10.0):
            energy, torque = fold_of(term, fold, rest, device)
            found += [point("energy", series, fold, energy), point("torque", series, fold, torque)]
    return found


def hinge(height=_HEIGHT, degrees=0.0, size=1.0):
    """Returns the points (4, 3) of an edge of length ``size`` along x and two apexes, of which the first is folded up."""
    angle = np.radians(degrees)
    apex = [0.5, height * np.cos(angle), height * np.sin(angle)]
    return size * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], apex, [0.5, -_HEIGHT, 0.0]])


def _scene(rest, positions, bending):
    mesh = Mesh(rest, [[0, 1, 2], [1, 0, 3]])
    return Scene(mesh, masses=np.ones(4), positions=positions, terms=[bending(stiffness=1.0)])


@in_turn
def _force(scene, device, dtype):
    model = scene.build(device=device, dtype=dtype)
    gradient = model.vectors()
    Gradient(model).add(model.positions, gradient)
    return gradient.numpy()[2].astype(np.float64)


def apex_gradient(height, size, device, dtype):
    """Returns |∂θ/∂x| of the apex [1/m] of a hinge that is equilateral at rest and bent by 1 rad; 0 without a force."""
    scene = _scene(hinge(size=size), hinge(height, np.degrees(_TURN), size), DihedralBending)
    return float(np.linalg.norm(_force(scene, device, dtype)) / (_WEIGHT * _TURN))


def step_limit(height, device):
    """Returns the largest stable explicit step [s] about a flat hinge with one triangle of a given height."""
    rest = hinge(height)
    return step_limits(_scene(rest, rest, DihedralBending).build(device=device, dtype="float64"))[0]


def fold_of(term, degrees, rest, device):
    """Returns energy and torque about the edge, both over cD, of an equilateral hinge folded by ``degrees``."""
    positions = hinge(degrees=degrees)
    scene = _scene(hinge(degrees=rest), positions, BENDING[term])
    (energy,) = energies(scene, device=device, dtype="float64")
    angle = np.radians(degrees)
    round_it = _HEIGHT * np.array([0.0, -np.sin(angle), np.cos(angle)])
    torque = _force(scene, device, "float64") @ round_it
    return float(energy.sum() / _WEIGHT), float(torque / _WEIGHT)
