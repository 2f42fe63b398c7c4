"""Measures how far cloth at rest is from closed forms, over mesh size and cost.

| Case | Closed form | Order |
|---|---|---|
| cylinder | energy ½Dκ² per area of a sheet rolled to a cylinder with κL = 1 | 2 |
| cantilever | H/W of the heavy elastica at the tip of a wide strip under its weight | 1.5 to 3, down to the effect of sides |
| chain | extension of N springs k by N masses m, (mg/k)·N(N + 1)/2 | none: exact |
| catenary | sag of the elastic catenary | 2 |
| patch | x = Gx̄ inside a membrane whose boundary is moved to Gx̄ | none: exact |

Hinges are calibrated on equilateral nets; on others, refinement does not remove their error (:func:`strips.rolled`). Plates,
here with ν = 0, have no such error. A cantilever with hinges differs from the elastica in these ways, the last three also with
plates, for which the position of the clamp was not calibrated:

- A strip much narrower than long bends with 1 − ν² = 8/9 of D, as ν = −1/3 (:func:`strips.plate`): it is the elastica of 9Γ/8.
  This strip is twice as wide as it is long.
- Its sides curl as far in as its membrane allows. `sides` is the fraction of D lost by that, and falls with the stiffness of
  the membrane.
- A stiff membrane locks, by κ²h²/24 per triangle. That costs more than bending if h⁴ > 576D/(Kκ²), and vanishes with h.
- The clamp is half a row before the last pinned one, because a hinge bends if any of its vertices is free. L starts there.
- Quadratic bending is for small Γ or stiff membranes, because it resists non-uniform stretch.
"""

import time
from dataclasses import replace

import numpy as np
import warp as wp
from scipy.optimize import brentq

from ..base.checks import choice, number, whole
from ..base.turns import in_turn
from ..core.energy import Energy
from ..core.status import Result
from ..core.sums import Sums
from ..run.equilibrium import SETTLED, equilibrium
from ..scene.scene import Scene
from ..scenes import catenary, chain
from ..terms import CorotatedMembrane, DihedralBending, NeoHookeanMembrane, PlateBending, QuadraticBending
from . import elastica
from .strips import PATTERNS, inner_shares, strip

CASES = ("cylinder", "cantilever", "chain", "catenary", "patch")
BENDING = {"dihedral": DihedralBending, "quadratic": QuadraticBending, "plate": PlateBending}
D = 1e-3  # [N·m]
G = 9.81  # [m/s²]
SEED = 0  # of the perturbations that give the accuracy of an equilibrium
# Number of Newton iterations between checks of the time.
_CHUNK = 200
# Largest number of solutions for the median time, and time in which they must begin [s].
_REPEATS, _BRIEF = 5, 1.0


def measure(
    case,
    resolution,
    bending="quadratic",
    pattern="equilateral",
    angle=0.0,
    gamma=1.0,
    device="cpu",
    dtype="float64",
    limit=60.0,
    stretching=1e6,
    width=2.0,
):
    """Measures one point of the diagram.

    ``case`` is one of `CASES`, with ``resolution`` elements along L, 1 m. ``pattern`` is that of :func:`strips.strip`, rotated
    by ``angle`` [rad]. ``gamma`` is Γ = ρgL³/D of the cantilever, up to 100, and ``width`` its width over L. ``stretching`` is
    KL²/D of its membrane, or EA/wL of the catenary. ``limit`` [s] is checked every 200 iterations.

    Returns:
        dict: ``status`` "ok", "diverged" (or did not settle) or "slow", and ``reason``; relative ``error``; ``stiffness``, the
        apparent bending stiffness over D; ``sides``, see above; ``floor``, the accuracy of the equilibrium: the largest change
        of the error when every coordinate is rounded, and when the shape is perturbed by a thousandth of an edge and settles
        again; ``ms``, the median time of a warm solution, including building the model and capturing launches, and ``spread``,
        its quartiles; ``elements``, ``h`` over L and ``iterations``. Unknown values are None.

    Raises:
        ValueError: An argument is not allowed.
    """
    choice("case", case, CASES)
    choice("bending", bending, tuple(BENDING))
    choice("pattern", pattern, PATTERNS)
    whole("resolution", resolution, 1)
    for name, value in (("gamma", gamma), ("limit", limit), ("stretching", stretching), ("width", width)):
        number(name, value, above=0.0)
    number("angle", angle)
    if gamma > elastica.MAX_GAMMA:
        raise ValueError(f"gamma is {gamma:g}; it must be {elastica.MAX_GAMMA:g} or less")
    settle = _Settling(device, dtype, limit)
    nothing = {"error": None, "stiffness": None, "sides": None, "elements": None, "h": None}
    if case == "cylinder":
        found = _cylinder(settle, BENDING[bending], pattern, angle, resolution)
    elif case == "cantilever":
        found = _cantilever(settle, BENDING[bending], (pattern, angle, resolution), gamma, stretching, width)
    elif case == "patch":
        found = _patch(settle, pattern, angle, resolution)
    else:
        found = _chain(settle, resolution) if case == "chain" else _catenary(settle, resolution, stretching)
    if settle.status != "ok":
        found |= {"error": None, "stiffness": None}
    facts = ("status", "reason", "ms", "spread", "iterations", "floor")
    return nothing | found | {name: getattr(settle, name) for name in facts}


class _Settling:
    def __init__(self, device, dtype, limit):
        self.options, self.limit = {"device": device, "dtype": dtype}, limit
        self.status, self.reason, self.ms, self.spread, self.iterations, self.floor = "ok", "", None, None, 0, None

    def __call__(self, scene, error, **options):
        """Returns ``error(points)`` of a scene at rest, or when the time is up."""
        points = self._rest(scene, options)
        found = error(points)
        if self.status == "ok":
            shaken = replace(scene, positions=points + _moves(scene, 1e-3 * np.median(scene.mesh.edge_lengths))[0])
            again = equilibrium(shaken, iterations=max(self.iterations, _CHUNK), **options, **self.options)
            if again.status.result in SETTLED:
                rounded = points + _moves(scene, np.finfo(points.dtype).eps * np.abs(points).max())
                self.floor = float(max(np.abs(error(each) - found).max() for each in (again.points, *rounded)))
        return found

    def _rest(self, scene, options):
        equilibrium(scene, iterations=1, **options, **self.options)  # compiles
        rest, self.iterations, seconds = self._solve(scene, options)
        taken = [seconds]
        if rest.status.result not in SETTLED:
            slow = rest.status.result is Result.ITERATIONS_USED_UP
            self.status = "slow" if slow else "diverged"
            self.reason = f"not at rest after {seconds:.3g} s" if slow else rest.status.message
        while self.status == "ok" and len(taken) < _REPEATS and sum(taken) < _BRIEF:
            taken.append(self._solve(scene, options)[-1])
        low, self.ms, high = (1e3 * np.percentile(taken, [25, 50, 75])).tolist()
        self.spread = [low, high]
        return rest.points

    def _solve(self, scene, options):
        started, iterations = time.perf_counter(), 0
        while True:
            rest = equilibrium(scene, iterations=_CHUNK, **options, **self.options)
            seconds, iterations = time.perf_counter() - started, iterations + rest.iterations
            if rest.status.result is not Result.ITERATIONS_USED_UP or seconds > self.limit:
                return rest, iterations, seconds
            scene = replace(scene, positions=rest.points)


def _moves(scene, size):
    """Returns eight displacements of free coordinates of up to ``size``, equal in every call, (8, n, 3) [m]."""
    moves = size * np.random.default_rng(SEED).uniform(-1.0, 1.0, size=(8, *scene.positions.shape))
    moves[:, scene.pins.vertices] = 0.0
    return moves


def _cylinder(settle, bending, pattern, angle, resolution):
    mesh = strip(pattern, angle, 1.0 / resolution).mesh
    stiffness = bending_density(bending, mesh, rolled_up(mesh.points, 1.0), **settle.options)
    return {"error": abs(stiffness - 1.0), "stiffness": stiffness, "elements": len(mesh.triangles), "h": 1.0 / resolution}


def rolled_up(points, curvature):
    """Returns points (n, 3) of the plane y = 0, rolled along x to a cylinder of a curvature [1/m], which may be 0."""
    x, _, z = points.T
    # sin(κx)/κ and (1 − cos κx)/κ, by sinc for κ = 0 too.
    half = np.sinc(curvature * x / (2.0 * np.pi))
    return np.stack([x * np.sinc(curvature * x / np.pi), -0.5 * curvature * (x * half) ** 2, z], axis=1)


def bending_density(bending, mesh, positions, **options):
    """Returns the bending energy per area over ½D [1/m²] of a mesh at ``positions``; of hinges, over triangles with three."""
    shares, area = (1.0, mesh.triangle_areas.sum()) if bending is PlateBending else inner_shares(mesh)
    scene = Scene(mesh, density=1.0, positions=positions, terms=[bending(stiffness=D * shares)])
    return float(energies(scene, **options)[0].sum() / (0.5 * D * area))


@in_turn
def energies(scene, **options):
    """Returns the energy [J] of each element of each term at the start of a scene."""
    model = scene.build(**options)
    energy = Energy(model, Sums(model))
    energy.add(model.positions, wp.zeros(1, dtype=wp.float64, device=model.device))
    return [values.numpy() for values in energy.of_elements]


def _cantilever(settle, bending, net, gamma, stretching, width):
    """Measures a wide strip; its tip is the mean of the vertices within h of the end, where the strip is almost straight."""
    pattern, angle, resolution = net
    cut = strip(pattern, angle, 1.0 / resolution, 1.0, width)
    L, x = cut.length, cut.mesh.points[:, 0]
    terms = [CorotatedMembrane(stiffness=stretching * D / L**2), bending(stiffness=D)]
    tip = x > cut.end - 1.0 / resolution
    at = (x[tip].mean() - cut.clamp) / L
    known = elastica.aspect(gamma, at)

    def error(rest):
        return -rest[tip, 1].mean() / (rest[tip, 0].mean() - cut.clamp) / known - 1.0

    found = settle(Scene(cut.mesh, density=gamma * D / (G * L**3), terms=terms, pins=cut.pins), error)
    apparent = elastica.gamma_of((1.0 + found) * known, at, gamma) if settle.status == "ok" else None
    return {
        "error": float(abs(found)),
        "stiffness": gamma / apparent if apparent else None,
        "sides": 0.0 if bending is PlateBending else side_loss(gamma, stretching, width),
        "elements": len(cut.mesh.triangles),
        "h": float(1.0 / (resolution * L)),
    }


def side_loss(gamma, stretching, width):
    """Estimates the fraction of D that the free sides of a wide cantilever lose, for small Γ.

    The free side of a plate with curvature κ has no moment. It curls within a width of 1/α, α⁴ = Kκ²/4D, and saves ν²Dκ²/2α per
    length (Lamb 1891, *On the flexure of a flat elastic spring*). Here ν = −1/3 and κ = Γu²/2. A narrow strip loses ν² of D.
    """
    saved = 2.0 / 9.0 / width * (4.0 / stretching) ** 0.25
    return float(min(saved * 8.0 / (3.0 * np.sqrt(2.0 * gamma)), 1.0 / 9.0))


def _chain(settle, links):
    mass, stiffness = 0.2 / links, 50.0 * links
    extension = mass * G / stiffness * links * (links + 1) / 2.0
    scene = chain.scene(links=links, mass=mass, stiffness=stiffness)
    error = settle(scene, lambda rest: (-rest[-1, 1] - 1.0) / extension - 1.0, tolerance=1e-13)
    return {"error": float(abs(error)), "elements": links, "h": 1.0 / links}


def _catenary(settle, links, stretching):
    """Measures the sag of a cable of length S = 1.2, span d = 1, weight w = 1 per length and EA = ``stretching``.

    With the horizontal tension T, d = (2T/w) asinh(wS/2T) + TS/EA and sag = (T/w)(√(1 + (wS/2T)²) − 1) + wS²/8EA.
    """
    S = 1.2
    T = brentq(lambda T: 2.0 * T * np.arcsinh(S / (2.0 * T)) + T * S / stretching - 1.0, 1e-6, 1e3, xtol=1e-14)
    sag = T * (np.hypot(1.0, S / (2.0 * T)) - 1.0) + S**2 / (8.0 * stretching)
    error = settle(catenary.scene(links=links, length=S, stretching=stretching), lambda rest: -rest[:, 1].min() / sag - 1.0)
    return {"error": float(abs(error)), "elements": links, "h": 1.0 / links}


def _patch(settle, pattern, angle, resolution):
    """Measures the largest distance of a vertex to Gx̄ over the length; inner vertices start perturbed."""
    mesh = strip(pattern, angle, 1.0 / resolution).mesh
    affine = mesh.points @ np.array([[1.1, 0.05, 0.02], [0.0, 1.0, 0.0], [0.03, -0.1, 1.2]])
    moved = np.random.default_rng(0).uniform(-0.1, 0.1, affine.shape) / resolution
    moved[mesh.boundary] = 0.0
    membrane = NeoHookeanMembrane(stiffness=1e3, poisson_ratio=0.3)
    scene = Scene(mesh, density=0.1, positions=affine + moved, terms=[membrane], pins=mesh.boundary, gravity=(0.0, 0.0, 0.0))
    apart = settle(scene, lambda rest: rest - affine, tolerance=1e-12)
    return {"error": float(np.abs(apart).max()), "elements": len(mesh.triangles), "h": 1.0 / resolution}
