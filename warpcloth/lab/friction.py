"""Sheets on slopes that stick, creep or slide, with every solver that takes friction.

A sheet slides if tan θ > μ, with the acceleration g(sin θ − μ cos θ). Otherwise friction should hold it at rest. Friction that
depends on the speed below some ε_v creeps on any slope: with ρ = tan θ/μ, at ε_v(1 − √(1 − ρ)) if the force is smoothed to C¹
(Li et al. 2020, *Incremental potential contact*), and at ρε_v with a Huber function. Friction with anchors does not creep.
"""

from types import SimpleNamespace

import numpy as np

from ..base.turns import in_turn
from ..kernels.terms.friction import FRICTION
from ..mesh.mesh import Mesh
from ..scene.colliders import Contact, Plane
from ..scene.scene import EARTH, Scene
from ..solvers import SOLVERS
from ..terms import Spring
from ..terms.needs import lacks
from .measurements import task
from .panels import Map, Panel, point

TITLE = "16. Friction on a slope: to stick, to creep, to slide"
COEFFICIENTS = np.linspace(0.1, 0.9, 9)
SLOPES = np.linspace(0.0, 45.0, 16)  # [°]
COEFFICIENT = 0.3  # of the panels of one μ
RATIOS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99)  # tan θ/μ of sheets that stick
STEEP = 30.0  # [°]
ITERATIONS = (1, 3, 10, 30, 100, 300)
SPEED = 1e-3  # ε_v [m/s]
DENSITY, DISTANCE = 0.15, 1e-3  # [kg/m²], [m]
FRAMES = 60  # of 1/60 s
# Below this speed [m/s], a sheet sticks or does not accelerate: a tenth of ε_v.
STILL = 0.1 * SPEED
TAKERS = tuple(
    name
    for name, record in SOLVERS.items()
    if lacks(SimpleNamespace(term=FRICTION, hard=False, damping=None), record.needs) is None
)
# Options with which steps converge; a solver ignores those that it does not have.
SETTINGS = {
    "explicit": {"substeps": 16},
    "newton": {"tolerance": 1e-9},
    "projective-dynamics": {"tolerance": 1e-6, "iterations": 100},
    "admm": {"tolerance": 1e-7, "iterations": 1000},
    "xpbd": {"iterations": 20},
    "constrained-dynamics": {"substeps": 4, "tolerance": 1e-9, "iterations": 100},
}
ITERATING = tuple(name for name in TAKERS if "iterations" in SETTINGS.get(name, {}))
KINDS = ("sticks", "creeps", "slides")

_SLIDES = "g(sin θ − μ cos θ), or 0"
_ANCHORED, _SMOOTH, _HUBER = "with anchors: 0", "C¹ below ε_v: ε_v(1 − √(1 − ρ))", "Huber below ε_v: ρε_v"
_COEFFICIENT = f"μ = {COEFFICIENT:g}"
_LINE = "tan θ = μ"


def acceleration(slope, coefficient=COEFFICIENT):
    """Returns the acceleration down a slope [°], from rest [m/s²]."""
    angle = np.radians(slope)
    return max(EARTH * (np.sin(angle) - coefficient * np.cos(angle)), 0.0)


PANELS = (
    *(
        Map(
            solver,
            solver,
            "slope θ [°]",
            "coefficient of friction μ",
            laws={_LINE: lambda slope: np.tan(np.radians(slope))},
            value="speed down the slope [m/s]",
            kinds=KINDS,
        )
        for solver in TAKERS
    ),
    Panel(
        "acceleration",
        f"Acceleration down the slope, μ = {COEFFICIENT:g}",
        "slope θ [°]",
        "a [m/s²]",
        laws={_SLIDES: acceleration},
        follows=dict.fromkeys(TAKERS, _SLIDES),
        marks={float(np.degrees(np.arctan(COEFFICIENT))): _LINE},
    ),
    Panel(
        "creep",
        f"Creep of sheets that stick, lines of ε_v = {1e3 * SPEED:g} mm/s",
        "ρ = tan θ/μ",
        "speed down the slope [mm/s]",
        laws={
            _ANCHORED: lambda ratio: 0.0,
            _SMOOTH: lambda ratio: 1e3 * SPEED * (1.0 - np.sqrt(1.0 - min(ratio, 1.0))),
            _HUBER: lambda ratio: 1e3 * SPEED * ratio,
        },
        follows=dict.fromkeys(TAKERS, _ANCHORED),
        limits=(-0.1, 2.2),  # the legend is above the lines
    ),
    Panel(
        "iterations",
        f"Few iterations, on a slope of {STEEP:g}°, steps of 1/60 s",
        "iterations a step",
        "friction found, tan θ − a/(g cos θ)",
        ("log", "linear"),
        laws={_COEFFICIENT: lambda iterations: COEFFICIENT},
    ),
)


def tasks(device):
    found = []
    for solver in TAKERS:
        found += [task(mapped, solver=solver, coefficient=float(f"{mu:.6g}"), device=device) for mu in COEFFICIENTS]
        found.append(task(sticking, solver=solver, ratios=list(RATIOS), device=device))
    return found + [task(iterated, solver=solver, counts=list(ITERATIONS), device=device) for solver in ITERATING]


def mapped(solver, coefficient, device, slopes=None):
    """Returns a row of the map of a solver; for :data:`COEFFICIENT`, also the points of the acceleration."""
    slopes = SLOPES.tolist() if slopes is None else slopes
    speeds, accelerations = slide(solver, coefficient, slopes, device)
    found = [
        point(solver, kind(*motion), slope, motion[0], y=coefficient)
        for slope, *motion in zip(slopes, speeds, accelerations, strict=True)
    ]
    if coefficient == COEFFICIENT:
        found += [point("acceleration", solver, *each) for each in zip(slopes, accelerations, strict=True)]
    return found


def sticking(solver, ratios, device):
    """Returns the points of the panel of creep, for slopes given by tan θ/μ."""
    slopes = np.degrees(np.arctan(COEFFICIENT * np.array(ratios))).tolist()
    speeds, _ = slide(solver, COEFFICIENT, slopes, device)
    return [point("creep", solver, ratio, 1e3 * speed) for ratio, speed in zip(ratios, speeds, strict=True)]


def iterated(solver, counts, device):
    """Returns the points of the panel of iterations."""
    found = []
    for count in counts:
        _, (a,) = slide(solver, COEFFICIENT, [STEEP], device, substeps=1, iterations=count)
        friction = np.tan(np.radians(STEEP)) - a / (EARTH * np.cos(np.radians(STEEP)))
        found.append(point("iterations", solver, count, friction))
    return found


def kind(speed, acceleration):
    """Returns whether a sheet sticks, creeps or slides, from its final speed [m/s] and its acceleration [m/s²]."""
    if acceleration * FRAMES / 180.0 > STILL:
        return KINDS[2]
    return KINDS[1] if abs(speed) > STILL else KINDS[0]


@in_turn
def slide(solver, coefficient, slopes, device, **options):
    """Returns speeds [m/s] and accelerations [m/s²] of sheets down slopes [°], each (S,).

    A batch with one plane and different directions of gravity stands for the slopes. The sheets start at rest, with contact in
    balance with their weight. Speeds and accelerations are differences of mean positions over each third of the time, so the
    oscillation of explicit steps about an anchor cancels; they are exact for constant acceleration.
    """
    grid = Mesh.grid(3, 3, size=0.1)
    scene = Scene(
        grid,
        density=DENSITY,
        terms=[Spring(stiffness=10.0)],
        positions=grid.points + np.array([0.0, DISTANCE, 0.0]),
        colliders=[Plane(friction=coefficient)],
        contact=Contact(distance=DISTANCE, stiffness=10.0 * DENSITY * EARTH / DISTANCE),
        duration=FRAMES / 60.0,
    )
    angles, contact = np.radians(slopes), scene.contact
    gravity = EARTH * np.stack([np.sin(angles), -np.cos(angles), 0.0 * angles], axis=1)
    positions = np.repeat(grid.points[None], len(angles), axis=0)
    positions[:, :, 1] = (contact.distance + DENSITY * gravity[:, 1] / contact.stiffness)[:, None]
    vary = {"positions": positions, "gravity": gravity}
    model = scene.build(device=device, dtype="float64", copies=len(angles), vary=vary)
    record = SOLVERS[solver](**{"substeps": 1} | SETTINGS.get(solver, {}) | options)
    stepper, along = record.bind(model), []
    for _ in range(FRAMES * stepper.steps_per_frame):
        stepper.step()
        along.append(stepper.state.x.numpy().reshape(positions.shape)[:, :, 0].mean(axis=1))
    first, second, third = np.reshape(along, (3, -1, len(angles))).mean(axis=1)
    part = FRAMES / 180.0
    return ((third - second) / part).tolist(), ((third - 2.0 * second + first) / part**2).tolist()
