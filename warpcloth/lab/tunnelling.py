"""Sheets that fly against a thin wall, over speed and step, with the filter of contact and with the energy of contact alone.

The wall is a box of 1 µm, or a sheet of triangles without thickness. It has contact within the distance r on either side, and a
vertex moves by v h in a step. A test at the end of each step misses a vertex that passes without contact, if v h ≥ 2r. If v h ≥
r, it can end beyond the wall, where the energy pushes it on. The energy also fails if it is less than that of the motion. Per
area it is ½kr² for explicit steps and kτ²(2 + ln τ/δ) for the others, with τ = r/2 and δ = r/1000, below which it is a
parabola.

Implicit steps, which have contact with the wall ahead, need the filter if their minimiser is nearer than δ. With the prediction
v h beyond the wall and the pressure kτ²/d, it is at d = kτ²h/(ρv).
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..base.turns import in_turn
from ..kernels.term import Term
from ..kernels.terms.contact import CONTACT, FLOOR
from ..mesh.mesh import Mesh
from ..scene.colliders import Box, Contact
from ..scene.mesh_collider import MeshCollider
from ..scene.scene import Scene
from ..solvers import SOLVERS
from ..terms import Spring
from ..terms.contact import VertexContact
from .flights import DENSITY, DISTANCE, RATE, STIFFNESS, Flights, count_steps
from .flights import LAWS as BLIND
from .measurements import task

TITLE = "15. Fast cloth and thin colliders: contact alone lets cloth pass, the filter does not"
THICKNESS = 1e-6  # of the wall [m]
STEPS = np.geomspace(1e-4, 1.0 / 24.0, 10)  # [s]
SPEEDS = np.geomspace(0.1, 100.0, 13)  # [m/s]
PHASES = np.arange(6) / 6.0  # fractions of a step by which sheets start farther away
# Solvers by wall: a box with the energy of contact alone, a box with the filter, and triangles with it. Solvers that are left
# out minimise the same energy as one of these.
_FEW = ("explicit", "newton", "xpbd", "pbd")
SHOWN = {"energy alone": _FEW, "filter": tuple(SOLVERS), "filter, triangles": _FEW}

_QUADRATIC, _LOGARITHM, _DEEP = "ρv² = kr²", "½ρv² = ¼kr²(2 + ln r/2δ)", "v = kr²h/(4ρδ)"
LAWS = {
    **BLIND,
    _QUADRATIC: lambda h: DISTANCE * RATE,
    _LOGARITHM: lambda h: 0.5 * DISTANCE * RATE * np.sqrt(2.0 * (2.0 + np.log(0.5 / FLOOR))),
    _DEEP: lambda h: 0.25 * RATE**2 * DISTANCE * h / FLOOR,
}
_FLIGHTS = Flights(
    speed="speed v [m/s]",
    fails="passes",
    holds="stays outside",
    failed="vertices that pass the wall [%]",
    cut="vertices that were cut short [%]",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class PenaltyContact(VertexContact):
    """Contact with the energy of explicit steps, ½k(r − d)² at all depths."""

    term: ClassVar[Term] = CONTACT.bounded


def _panel(solver, wall):
    names, filtered = list(BLIND), wall != "energy alone"
    if solver == "explicit":
        names.append(_QUADRATIC)
    elif "pbd" not in solver or solver == "xpbd":  # the stiffness of the others is that of their sweeps
        names.append(_DEEP if filtered else _LOGARITHM)
    title = f"{solver}, with the {wall}" if filtered else f"{solver}, energy of contact alone"
    return _FLIGHTS.panel(f"{solver}, {wall}", title, {name: LAWS[name] for name in names}, filtered)


PANELS = tuple(_panel(solver, wall) for wall, solvers in SHOWN.items() for solver in solvers)


def tasks(device):
    given = {"steps": STEPS.tolist(), "speeds": SPEEDS.tolist(), "device": device}
    return [task(measure, solver=solver, wall=wall, **given) for wall, solvers in SHOWN.items() for solver in solvers]


def measure(solver, wall, steps, speeds, device):
    """Returns the points of one panel: the fraction of vertices that were cut short, or that passed the wall [%]."""
    return _FLIGHTS.points(_panel(solver, wall), lambda h: flights(solver, wall, h, speeds, device), steps, speeds)


def sheet(h, wall, solver):
    """Returns a scene of nine vertices and a wall at y = 0, with steps h as frames; without filter, contact is a term."""
    grid = Mesh.grid(3, 3, size=0.1)
    box = Box(size=(1.0, THICKNESS, 1.0))
    ground = Mesh.grid(5, 5, size=1.0)  # whose edges are none of the sheet
    triangles = MeshCollider(ground.points - np.array([0.47, 0.0, 0.43]), ground.triangles)
    scene = Scene(
        Mesh(grid.points + np.array([0.0, 2.0 * DISTANCE, 0.0]), grid.triangles),
        density=DENSITY,
        terms=[Spring(stiffness=0.1)],
        gravity=(0.0, 0.0, 0.0),
        fps=1.0 / h,
        duration=h,
        colliders=[triangles if "triangles" in wall else box],
        contact=Contact(distance=DISTANCE, stiffness=STIFFNESS),
    )
    if wall != "energy alone":
        return scene
    (declared,) = scene.contact_terms
    kind = PenaltyContact if solver == "explicit" else VertexContact
    contact = kind(**vars(declared) | {"collider": None})
    return replace(scene, terms=[*scene.terms, contact], colliders=(), contact=None)


@in_turn
def flights(solver, wall, h, speeds, device):
    """Returns the fractions of vertices that end a step beyond the wall or inside, and that were cut short, per speed, (S,).

    Sheets start at r plus a fraction of a step above the wall. They fly until the slowest has passed it or turned back.

    Raises:
        ValueError: The solver refuses the step.
    """
    scene, top = sheet(h, wall, solver), 0.0 if "triangles" in wall else 0.5 * THICKNESS
    velocity, phase = (each.ravel() for each in np.meshgrid(speeds, PHASES, indexing="ij"))
    positions = np.repeat(scene.mesh.points[None], len(velocity), axis=0)
    positions[:, :, 1] = (DISTANCE + top + phase * velocity * h)[:, None]
    velocities = np.zeros_like(positions)
    velocities[:, :, 1] = -velocity[:, None]
    vary = {"positions": positions, "velocities": velocities}
    model = scene.build(device=device, dtype="float64", copies=len(velocity), vary=vary)
    stepper = SOLVERS[solver](substeps=1).bind(model)
    passed = np.zeros(positions.shape[:2], dtype=bool)
    count = count_steps(h, speeds)
    for _ in range(count):
        stepper.step()
        passed |= stepper.state.x.numpy().reshape(positions.shape)[:, :, 1] < top
    # All vertices of a sheet are cut in the same steps, because it is flat.
    cut = np.minimum(stepper.cut * count, 1.0)
    return passed.mean(axis=1).reshape(len(speeds), -1).mean(axis=1), cut.reshape(len(speeds), -1).mean(axis=1)
