"""Two sheets that fly at each other, over relative speed and step, with the filter of self-contact and without it.

Without the filter, the path during a step is not tested, and the energy of contact does not know the side from which a sheet
came. For v h ≥ r, a step can end beyond the other sheet, where the energy pushes it on; for v h ≥ 2r it can do so without
contact. Contact also fails if its energy is less than that of the motion, ½(ρ/2)v² of two free sheets of density ρ. Per area it
is ½kr² in explicit steps, and kτ²(2 + ln τ/δ) in those of Newton's method, with τ = r/2 and δ = r/1000, plus that of pairs of
edges below r/4. Sweeps take contacts nearer than r plus the skin at the start of the step, and know their side.

Vertices can move along the line of flight only. Otherwise sheets could tip and pass each other.
"""

import numpy as np

from ..base.turns import in_turn
from ..contact.self_steps import skin_of
from ..kernels.terms.contact import FLOOR
from ..mesh.mesh import Mesh
from ..scene.scene import Scene
from ..scene.self_contact import SelfContact
from ..solvers import SOLVERS
from ..terms import Spring
from .flights import DENSITY, DISTANCE, RATE, STIFFNESS, Flights, count_steps
from .flights import LAWS as BLIND
from .measurements import task

TITLE = "17. Sheets that fly at each other: without the filter of self-contact they cross"
SIDE = 0.1  # of the sheets [m]
# Rotation of one sheet relative to the other [°]: without the filter, all vertices are in contact at once, as in the theory;
# with it, they are in general position.
TURN = {"without": 0.0, "filter": 5.0}
LISTED = DISTANCE + skin_of(Mesh.grid(3, 3, size=SIDE), DISTANCE, DISTANCE)  # from which pairs are listed [m]
STEPS = np.geomspace(5e-4, 1.0 / 24.0, 7)  # [s]
SPEEDS = np.geomspace(0.1, 100.0, 10)  # [m/s]
PHASES = np.arange(4) / 4.0  # of a step, by which sheets start farther apart
SHOWN = {"without": ("explicit", "newton", "xpbd", "pbd"), "filter": tuple(SOLVERS)}

_QUADRATIC, _LOGARITHM = "½ρv² = kr²", "ρv² = kr²(2 + ln r/2δ)"
LAWS = {
    **BLIND,
    "v h = r + skin": lambda h: LISTED / h,
    _QUADRATIC: lambda h: DISTANCE * RATE * np.sqrt(2.0),
    _LOGARITHM: lambda h: DISTANCE * RATE * np.sqrt(2.0 + np.log(0.5 / FLOOR)),
}
_FLIGHTS = Flights(
    speed="relative speed v [m/s]",
    fails="crosses",
    holds="stays apart",
    failed="flights in which sheets cross [%]",
    cut="flights in which a move was cut short [%]",
)


def _panel(solver, kept):
    names = ["v h = r + skin"] if "pbd" in solver else [*BLIND, _QUADRATIC if solver == "explicit" else _LOGARITHM]
    filtered = kept == "filter"
    title = f"{solver}, with the filter" if filtered else f"{solver}, without the filter"
    return _FLIGHTS.panel(f"{solver}, {kept}", title, {name: LAWS[name] for name in names}, filtered)


PANELS = tuple(_panel(solver, kept) for kept, solvers in SHOWN.items() for solver in solvers)


def tasks(device):
    given = {"steps": STEPS.tolist(), "speeds": SPEEDS.tolist(), "device": device}
    return [task(measure, solver=solver, kept=kept, **given) for kept, solvers in SHOWN.items() for solver in solvers]


def measure(solver, kept, steps, speeds, device):
    """Returns the points of one panel: the fraction of flights that were cut short, or in which sheets crossed [%]."""
    return _FLIGHTS.points(_panel(solver, kept), lambda h: meetings(solver, kept, h, speeds, device), steps, speeds)


def sheets(h, turn, count=1):
    """Returns a scene of two sheets of nine vertices, one of them rotated by ``turn`` [°], with ``count`` steps h as frames."""
    grid, (c, s) = Mesh.grid(3, 3, size=SIDE), (np.cos(np.radians(turn)), np.sin(np.radians(turn)))
    below = grid.points - [0.5 * SIDE, 0.0, 0.5 * SIDE]
    above = below @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) + [0.0, 2.0 * DISTANCE, 0.0]
    return Scene(
        Mesh(np.concatenate([below, above]), np.concatenate([grid.triangles, grid.triangles + 9])),
        density=DENSITY,
        terms=[Spring(stiffness=0.1)],
        gravity=(0.0, 0.0, 0.0),
        free_axes=np.tile([False, True, False], (18, 1)),
        fps=1.0 / h,
        duration=count * h,
        self_contact=SelfContact(DISTANCE, STIFFNESS),
    )


@in_turn
def meetings(solver, kept, h, speeds, device):
    """Returns the fractions of flights in which sheets end a step crossed or beyond one another, and that were cut, (S,) each.

    Sheets start at r plus a fraction of a step. They fly until the slowest have passed one another or turned back.

    Raises:
        ValueError: The solver refuses the step.
    """
    count = count_steps(h, speeds)
    scene = sheets(h, TURN[kept], count)  # the tolerance of iterations follows from the duration
    speed, phase = (each.ravel() for each in np.meshgrid(speeds, PHASES, indexing="ij"))
    positions = np.repeat(scene.mesh.points[None], len(speed), axis=0)
    positions[:, 9:, 1] = (DISTANCE + phase * speed * h)[:, None]
    velocities = np.zeros_like(positions)
    velocities[:, :9, 1], velocities[:, 9:, 1] = 0.5 * speed[:, None], -0.5 * speed[:, None]
    vary = {"positions": positions, "velocities": velocities}
    model = scene.build(device=device, dtype="float64", copies=len(speed), vary=vary)
    stepper = SOLVERS[solver](substeps=1).bind(model)
    if kept != "filter":
        without_filter(stepper)
    crossed = np.zeros(len(speed), dtype=bool)
    for _ in range(count):
        stepper.step()
        x = stepper.state.x.numpy().reshape(positions.shape)
        below, above = x[:, :9], x[:, 9:]
        crossed |= above[..., 1].max(axis=1) < below[..., 1].min(axis=1)
        crossed |= cross(below, above, scene.mesh.triangles[:8])
    return (each.reshape(len(speeds), -1).mean(axis=1) for each in (crossed, stepper.cut > 0.0))


def without_filter(stepper):
    """Removes the filter of self-contact from a stepper, at the end of steps and in the iterates of its method."""
    kept = stepper.pairs.filter
    kept.launch_end = kept.launch_limit = lambda *given, **options: None
    kept.launch_start = lambda base, d: d.zero_()
    kept.launch_aim = lambda goal, d, direction: direction.zero_()
    stepper.pairs.contact.least = 0.0
    stepper.record_again()


def cross(one, other, triangles):
    """Returns whether an edge of one sheet crosses a triangle of the other, (B,), from positions (B, n, 3) of both."""
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    found = np.zeros(len(one), dtype=bool)
    for x, y in ((one, other), (other, one)):
        p, q = (x[:, edges[:, k], None] for k in (0, 1))
        a, b, c = (y[:, None, triangles[:, k]] for k in (0, 1, 2))
        through = _volume(a, b, c, p) * _volume(a, b, c, q) < 0.0
        sides = np.stack([_volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)])
        found |= (through & ((sides > 0.0).all(axis=0) | (sides < 0.0).all(axis=0))).any(axis=(1, 2))
    return found


def _volume(a, b, c, d):
    return (np.cross(b - a, c - a) * (d - a)).sum(axis=-1)
