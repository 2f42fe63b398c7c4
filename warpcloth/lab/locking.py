"""Locking: a net that cannot bend without straining bends too little, and less the stiffer its membrane is.

Chords of a cylinder are shorter than its arcs by κ²h²/24. The energy of this strain exceeds the bending energy per area, ½Dκ²,
if κ²h⁴K > 576D. A regular net with three edge lengths avoids it at no cost. An irregular net keeps some of the strain, or loses
curvature to wrinkles. Springs k on all edges act as a membrane of K = 2k/√3 on an equilateral net; the same is assumed for
others.

Apart from locking, each net of hinges has its own bending stiffness, which a cantilever with a soft membrane shows. The
stiffness divided by that is due to locking, and falls with h⁴. Regular nets lock there too, because their curvature varies and
their sides curl. Plate bending locks as well.

Stiff edges leave a net some freedom to avoid strain (:mod:`warpcloth.scene.freedom`): rows and columns leave more than one
degree of freedom per vertex, all edges of triangles 3 plus the number of boundary edges, and a grid with both diagonals only
rigid motion. With so little, a net bends only if it is regular and bent along its own lines. Springs alone leave motion without
stiffness, and the net keeps sliding along its wrinkles.
"""

from dataclasses import replace

import numpy as np

from ..kernels.terms.dihedral_bending import rest_state
from ..mesh.mesh import Mesh
from ..run.equilibrium import SETTLED, equilibrium
from ..run.simulate import simulate
from ..scene.freedom import rank_of
from ..scene.scene import Scene
from ..solvers import Newton
from ..terms import DihedralBending, Spring
from . import physics
from .measurements import task
from .panels import Panel, point
from .physics import D, energies, rolled_up
from .strips import strip

TITLE = "9. Locking: irregular nets strain, wrinkle or stay flat where regular ones bend"
# Patterns and the angle by which they are turned [°]: "alternating" cannot bend along its diagonals without strain.
NETS = {"equilateral": 0.0, "jittered": 0.0, "alternating": 45.0}
CURVATURE = 1.0  # [1/m]
GAMMA = 1.0
# Elements along a sheet that is at rest when rolled up.
_RELAXED = (("equilateral", 8), ("jittered", 8), ("jittered", 16), ("alternating", 8))
_MODULI = np.geomspace(1e3, 1e10, 15).tolist()  # K/D [1/m²]
# Patterns and angles [°] of nets of springs that are let go.
_LET_GO = (("equilateral", 0.0), ("jittered", 0.0), ("jittered", 20.0), ("jittered", 40.0))
# KL²/D of membranes so soft that nothing locks, where a cantilever shows the pattern by itself, and of a stiff one.
SOFT, STIFF = 1e4, 1e8
_DECADES = {8: range(4, 11), 16: range(4, 10)}
_CANTILEVERS = [(pattern, n, "dihedral") for pattern in ("equilateral", "jittered") for n in (6, 8, 12, 16, 24)]
_CANTILEVERS += [("alternating", 8, "dihedral"), *(("jittered", n, "plate") for n in (6, 8, 12, 16, 24))]
# Nets of springs by the edges that hold; their freedom is counted, and they are rolled up while almost rigid, K/D = 1e9.
_HOLDING = {"rows and columns": "diagonal", "edges": "equilateral", "edges, jittered": "jittered", "both diagonals": "diagonal"}
_COUNTED = (5, 9, 17, 33, 65)  # vertices a side
_TURNED = (0.0, 15.0, 30.0, 45.0)  # [°]
_ALL_BUT_RIGID = 1e9
_ONSET = "costs as much as bending"
_LAW, _KEPT, _FREE = "κ²h⁴K/576D", "nothing lost", "no locking"
_ROWS, _EDGES, _RIGID = "n² + 2n, n = 1 + B/4", "3 + B", "6, rigid motion"


def ratio(curvature, h, K):
    """Returns κ²h⁴K/576D, with K given over D [1/m²]."""
    return curvature**2 * h**4 * K / 576.0


PANELS = (
    Panel(
        "cost",
        "Strain of a cylinder, and of sheets at rest when rolled up",
        "κ²h⁴K/576D",
        "membrane energy over ½Dκ² an area",
        ("log", "log"),
        laws={_LAW: lambda x: x},
        follows={"threads round it, imposed": _LAW},
        marks={1.0: _ONSET},
        limits=(1e-12, 1e3),
    ),
    Panel(
        "kept",
        "Curvature that a sheet keeps which is at rest when rolled up",
        "κ²h⁴K/576D",
        "part of the curvature kept",
        ("log", "linear"),
        laws={_KEPT: lambda x: 1.0},
        follows={"equilateral, h = 1/8 m": _KEPT},
        marks={1.0: _ONSET},
        limits=(0.0, 1.1),
    ),
    Panel(
        "time",
        "Springs alone, rolled up and let go: what wrinkles slides on",
        "time [s]",
        "part of the curvature kept",
        ("log", "linear"),
        laws={_KEPT: lambda t: 1.0},
        follows={"equilateral": _KEPT},
        limits=(0.0, 1.1),
    ),
    Panel(
        "apparent",
        f"A wide cantilever, Γ = {GAMMA:g}, h = L/8: pattern and locking",
        "KL²/D",
        "apparent bending stiffness over D",
        ("log", "log"),
        laws={"D": lambda x: 1.0},
    ),
    Panel(
        "locking",
        "The same over that with a soft membrane: locking alone",
        "κ²h⁴K/576D with κ = Γ/2L, that of the clamp",
        "apparent over unlocked stiffness",
        ("log", "log"),
        laws={_FREE: lambda x: 1.0},
        marks={1.0: _ONSET},
    ),
    Panel(
        "refined",
        "Refinement cures locking, and not the pattern",
        "h/L",
        "apparent bending stiffness over D",
        ("log", "log"),
        laws={"D": lambda x: 1.0},
    ),
    Panel(
        "freedom",
        "What stiff edges leave: 3 + those of the boundary, or nothing",
        "boundary edges B",
        "degrees of freedom left",
        ("log", "log"),
        laws={_ROWS: lambda B: (1 + B / 4) ** 2 + 2 * (1 + B / 4), _EDGES: lambda B: 3 + B, _RIGID: lambda B: 6.0},
        follows={"rows and columns": _ROWS, "edges": _EDGES, "edges, jittered": _EDGES, "both diagonals": _RIGID},
    ),
    Panel(
        "left",
        "All but rigid, K/D = 1e9/m², and turned by 0, 15, 30 and 45°",
        "degrees of freedom left, less rigid motion, a vertex",
        "part of the curvature kept, h = 1/8 m",
        laws={_KEPT: lambda x: 1.0},
        follows=dict.fromkeys(("rows and columns", "edges"), _KEPT),
        limits=(0.0, 1.1),
    ),
)


def tasks(device):
    found = [task(imposed, device=device)]
    found += [task(relaxed, pattern=pattern, elements=n, moduli=_MODULI, device=device) for pattern, n in _RELAXED]
    found += [task(let_go, pattern=pattern, degrees=turn, device=device) for pattern, turn in _LET_GO]
    found += [task(counted, holding=holding, n=n) for holding in _HOLDING for n in _COUNTED]
    found += [task(nearly_rigid, holding=holding, degrees=turn, device=device) for holding in _HOLDING for turn in _TURNED]
    given = [{"pattern": pattern, "elements": n, "bending": bending} for pattern, n, bending in _CANTILEVERS]
    return found + [task(cantilever, **each, device=device) for each in given]


def imposed(device):
    """Returns points of threads of a square grid bent round a cylinder, K = k, for many κ, h and K."""
    found = []
    for n in (9, 17, 33):
        mesh = Mesh.grid(n, n, pattern="alternating")
        columns = mesh.points[:, 0].argsort(kind="stable").reshape(n, n)
        round_it = np.stack([columns[:-1].ravel(), columns[1:].ravel()], axis=1)
        h = 1.0 / (n - 1)
        for curvature in (0.25, 1.0):
            for K in (1e4, 1e6, 1e8):
                terms = [Spring(pairs=round_it, stiffness=K * D)]
                rolled = rolled_up(mesh.points, curvature)
                scene = Scene(mesh, density=1.0, positions=rolled, terms=terms)
                (energy,) = energies(scene, device=device, dtype="float64")
                cost = energy.mean() / h**2 / (0.5 * D * curvature**2)
                found.append(point("cost", "threads round it, imposed", ratio(curvature, h, K), cost))
    return found


def relaxed(pattern, elements, moduli, device):
    """Returns points of a sheet whose hinges are at rest on a cylinder and springs when flat, over K/D."""
    h = 1.0 / elements
    flat = strip(pattern, np.radians(NETS[pattern]), h).mesh
    area = flat.triangle_areas.sum()
    series, found = f"{pattern}, h = 1/{elements} m", []
    for K in moduli:
        (scene, rest), x = _at_rest(flat, flat.edges, K, device), ratio(CURVATURE, h, K)
        if rest.status.result not in SETTLED:
            found += [point(panel, series, x, None, rest.status.message) for panel in ("cost", "kept")]
            continue
        settled = replace(scene, positions=rest.points)
        strained = energies(settled, device=device, dtype="float64")[0].sum()
        found.append(point("cost", series, x, strained / (0.5 * D * CURVATURE**2 * area)))
        found.append(point("kept", series, x, kept_angles(flat, scene.mesh.points, rest.points)))
    return found


def _at_rest(flat, pairs, K, device):
    rolled = Mesh(rolled_up(flat.points, CURVATURE), flat.triangles)
    lengths = np.linalg.norm(flat.points[pairs[:, 1]] - flat.points[pairs[:, 0]], axis=1)
    terms = [
        Spring(pairs=pairs, stiffness=np.sqrt(0.75) * K * D, rest_lengths=lengths),
        DihedralBending(stiffness=D),
    ]
    scene = Scene(rolled, density=D, terms=terms, gravity=(0.0, 0.0, 0.0))
    return scene, equilibrium(scene, device=device)


def held(holding, mesh):
    if holding.startswith("edges"):
        return mesh.edges
    # The longest side of a right triangle is the diagonal of a cell.
    diagonal = mesh.edge_lengths > 1.2 * mesh.edge_lengths.min()
    if holding == "rows and columns":
        return mesh.edges[~diagonal]
    one, two, *others = mesh.hinges.T
    across = np.linalg.norm(mesh.points[two] - mesh.points[one], axis=1) > 1.2 * mesh.edge_lengths.min()
    return np.concatenate([mesh.edges, np.stack(others, axis=1)[across]])


def counted(holding, n):
    pattern = _HOLDING[holding]
    mesh = strip(pattern, 0.0, 1.0 / (n - 1)).mesh if pattern == "jittered" else Mesh.grid(n, n, pattern=pattern)
    return [point("freedom", holding, len(mesh.boundary_edges), _left(mesh, held(holding, mesh)))]


def _left(mesh, pairs):
    return 3 * len(mesh.points) - rank_of(pairs, np.ones(mesh.points.shape, dtype=bool))


def nearly_rigid(holding, degrees, device):
    """Measures the fraction of curvature that a net of very stiff springs keeps at rest, over the freedom that they leave."""
    flat = strip(_HOLDING[holding], np.radians(degrees), 1.0 / 8).mesh
    pairs = held(holding, flat)
    scene, rest = _at_rest(flat, pairs, _ALL_BUT_RIGID, device)
    settled = rest.status.result in SETTLED
    value = kept_angles(flat, scene.mesh.points, rest.points) if settled else None
    free = (_left(flat, pairs) - 6) / len(flat.points)
    return [point("left", holding, free, value, "" if settled else rest.status.message)]


def kept_angles(mesh, imposed, points):
    """Returns the fraction of the hinge angles of an imposed shape that a mesh keeps, weighted by bending energy."""
    before, weights = rest_state(imposed, mesh.hinges).T
    after = rest_state(points, mesh.hinges)[:, 0]
    return float((weights * after) @ before / (weights * before @ before))


def let_go(pattern, degrees, device):
    """Simulates springs alone, rolled up and released, for 20 s with implicit Euler of 1/60 s, which damps stiff motion."""
    flat = strip(pattern, np.radians(degrees), 0.1).mesh
    start = rolled_up(flat.points, CURVATURE)
    terms = [Spring(stiffness=1e3)]
    scene = Scene(flat, density=0.1, positions=start, terms=terms, gravity=(0.0, 0.0, 0.0), duration=20.0)
    solver = Newton(substeps=1, tolerance=1e-8, linear="factorised")
    run = simulate(scene, solver, device=device, dtype="float64")
    series = pattern if pattern == "equilateral" else f"{pattern}, turned by {degrees:g}°"
    frames = np.unique(np.geomspace(1, len(run.points) - 1, 25).astype(int))
    return [point("time", series, run.times[frame], kept_angles(flat, start, run.points[frame])) for frame in frames]


def cantilever(pattern, elements, device, bending="dihedral"):
    """Returns the apparent bending stiffness of a cantilever over its membrane stiffness, also relative to a soft membrane."""
    angle, found, unlocked = np.radians(NETS[pattern]), [], None
    of = pattern if bending == "dihedral" else f"{pattern}, {bending}"
    for stretching in [10.0**e for e in _DECADES[elements]] if elements in _DECADES else (SOFT, STIFF):
        rest = physics.measure("cantilever", elements, bending, pattern, angle, GAMMA, device, stretching=stretching)
        stiffness, h, reason = rest["stiffness"], rest["h"], rest["reason"]
        if stiffness is None and not reason:
            reason = "beyond 20 times D"
        if stretching == SOFT:
            unlocked = stiffness
        if elements == min(_DECADES):
            found.append(point("apparent", of, stretching, stiffness, reason))
        if elements in _DECADES:
            alone = stiffness / unlocked if stiffness and unlocked else None
            series, at = f"{of}, h = L/{elements}", ratio(0.5 * GAMMA, h, stretching)
            found.append(point("locking", series, at, alone, reason))
        if pattern != "alternating" and stretching in (SOFT, STIFF):
            found.append(point("refined", f"{of}, KL²/D = 1e{np.log10(stretching):.0f}", h, stiffness, reason))
    if elements == min(_DECADES):
        # An upper bound: a sheet at rest finds a softer shape.
        rolled = physics.measure("cylinder", elements, bending, pattern, angle, device=device)["stiffness"]
        found += [
            point("apparent", f"{of}, rolled up, without membrane", 10.0**end, rolled)
            for end in (_DECADES[elements][0], _DECADES[elements][-1])
        ]
    return found
