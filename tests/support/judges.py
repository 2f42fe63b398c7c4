"""Judges of the run of a scene: what they condemn is wrong, whatever the solver. They use NumPy and the declared scene alone.

A state is compared with all states that are physically possible, so a condemnation is proved, not guessed: no motion of the
scene has such frames. Errors below the tolerances pass, and each judge says what they are.
"""

from copy import copy
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import warpcloth as wc

# Errors that pass: of strain (RMS over the cloth), and of velocity, relative to that which all energy gives all mass.
STRAIN, SPEED = 0.02, 0.1
# The tolerance of residuals, an acceleration over gravity, that solvers have by default.
RESIDUAL = 1e-3
# Hits by moving colliders that an estimate counts.
HITS = 4


class Condemnation(NamedTuple):
    """A proof that a run is wrong.

    Attributes:
        judge: Its name.
        frame: The worst frame.
        text: Figures.
    """

    judge: str
    frame: int
    text: str


def judge(scene: wc.Scene, animation, solver, dtype: str) -> list[Condemnation]:
    """Returns what the judges condemn in an animation of one copy, at most one frame each.

    Args:
        scene: A scene as of :mod:`support.random_scenes`, whose energies :func:`elastic_energies` knows.
        animation: Its :class:`warpcloth.Animation`.
        solver: The record of its solver.
        dtype: The precision of the run.
    """
    x, v = np.asarray(animation.points, np.float64), np.asarray(animation.velocities, np.float64)
    good = np.isfinite(x).all(axis=(1, 2)) & np.isfinite(v).all(axis=(1, 2))
    if not good.all():
        return [Condemnation("finite", int(good.argmin()), "a position or velocity is not finite")]
    rounding = 64.0 * float(np.finfo(dtype).eps) * max(1.0, np.abs(x).max())
    run = Run(scene, x, v, solver, rounding)
    judges = (crossings, inside, pierced, pins_left, energy, one_edge, momentum, pressed)
    return [found for each in judges for found in [each(run)] if found is not None]


class Run:
    """The frames of a run, and what several judges need of its scene.

    Attributes:
        x, v: Positions [m] and velocities [m/s], (F+1, n, 3).
        rounding: 64 units in the last place of the largest coordinate, or of 1 m: what a few operations and the poses of
            colliders lose [m].
        masses: (n,) [kg], a third of each adjacent triangle if the scene has a density.
        pins: Those of the scene, or None if it has none.
        free: Which vertices have no pin, (n,).
        times: (F+1,) [s].
        springs: Pairs of vertices (E, 2), the edges of the triangles unless springs have other pairs.
        lengths: Their lengths at rest (E,) [m].
    """

    def __init__(self, scene, x, v, solver, rounding):
        self.scene, self.x, self.v, self.solver, self.rounding = scene, x, v, solver, rounding
        points, self.triangles = np.asarray(scene.mesh.points), np.asarray(scene.mesh.triangles)
        a, b, c = points[self.triangles].transpose(1, 0, 2)
        self.areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        self.vertex_areas = np.bincount(self.triangles.ravel(), np.repeat(self.areas, 3) / 3.0, len(points))
        self.masses = scene.density * self.vertex_areas if scene.masses is None else np.asarray(scene.masses)
        self.free = np.ones(len(points), dtype=bool)
        self.pins = scene.pins if scene.pins is not None and len(scene.pins.vertices) else None
        if self.pins is not None:
            self.free[self.pins.vertices] = False
        self.times = np.arange(len(x)) / scene.fps
        self.h = 1.0 / scene.fps
        other = [term for term in scene.terms if isinstance(term, wc.Spring) and term.pairs != "edges"]
        self.springs = other[0].stencil(scene.mesh) if other else edges_of(self.triangles)
        self.lengths = np.linalg.norm(points[self.springs[:, 1]] - points[self.springs[:, 0]], axis=1)
        self.colliders = tuple(scene.colliders or ())
        self.gravity = np.asarray(scene.gravity, np.float64)
        self.loads = tuple(scene.loads or ())
        self.distances = [np.array([distances(each, x[f], f) for f in range(len(x))]) for each in self.colliders]


# Geometry


def crossings(run):
    """Condemns cloth that crosses cloth if there is self-contact, by exact predicates at the stored positions."""
    if run.scene.self_contact is None:
        return None
    from igl.predicates import find_self_intersections

    triangles = run.triangles.astype(np.int64)
    for f, x in enumerate(run.x):
        pairs = find_self_intersections(np.ascontiguousarray(x), triangles)[1].reshape(-1, 2)
        corners = triangles[pairs]
        pairs = pairs[~(corners[:, 0, :, None] == corners[:, 1, None]).any(axis=(1, 2))]  # neighbours touch
        if len(pairs):
            return Condemnation("crossings", f, f"{len(pairs)} pairs of triangles of the cloth cross")
    return None


def inside(run):
    """Condemns a free vertex that ends a frame inside a collider by more than rounding."""
    for collider, gaps in zip(run.colliders, run.distances, strict=True):
        depth = np.where(run.free, -gaps, -np.inf).max(axis=1)
        if (depth > run.rounding).any():
            f = int((depth > run.rounding).argmax())
            return Condemnation("inside", f, f"a vertex is {1e3 * depth[f]:.3g} mm deep in a {type(collider).__name__}")
    return None


def pierced(run):
    """Condemns cloth that crosses a mesh, by more than a thousandth of r.

    Triangles with a pinned corner are left out, and meshes that cross the cloth at the start.
    """
    for collider in run.colliders:
        if not collider.is_mesh:
            continue
        sides, margin = edges_of(collider.triangles), 1e-3 * run.scene.contact.distance + run.rounding
        edges, triangles = (each[run.free[each].all(axis=1)] for each in (edges_of(run.triangles), run.triangles))
        for f, x in enumerate(run.x):
            points = posed(collider, f)
            count = cross(x[edges], points[collider.triangles], margin).sum()
            count += cross(points[sides], x[triangles], margin).sum()
            if count and not f:
                break
            if count:
                return Condemnation("pierced", f, f"{count} edges cross triangles of the cloth and a mesh")
    return None


def pins_left(run):
    """Condemns pins that are not where they are declared, by more than rounding."""
    pins = run.pins
    if pins is None:
        return None
    keyframes = run.x[:1, pins.vertices] if pins.keyframes is None else pins.keyframes
    wanted = keyframes[np.minimum(np.arange(len(run.x)), len(keyframes) - 1)]
    away = np.linalg.norm(run.x[:, pins.vertices] - wanted, axis=2).max(axis=1)
    f = int(away.argmax())
    return Condemnation("pins", f, f"a pin is {1e3 * away[f]:.3g} mm from its keyframe") if away[f] > run.rounding else None


# Energy and momentum


def energy(run):
    """Condemns energy from nothing that makes strain or velocity wrong.

    In the frame of reference in which nothing moves, the energy A that was there at the start and that gravity, loads and wind
    added bounds K + U, with the kinetic energy K and the elastic U; bending, contact and damping only store or take more. In
    the norms √K and √U, a state with K + U > A is no nearer to an allowed one than K′ and U′ = A − K′ allow. So it is wrong by
    more than :data:`STRAIN` of RMS strain or :data:`SPEED` of √(2 max A/M) in RMS velocity, whatever the right state, if

        (√K − √K_ε)₊² + (√U − √U_ε)₊² > A,

    K_ε and U_ε the energies of these two errors, and max A that of all frames. Steps may add that of
    :func:`_residual_work`. Symplectic Euler, whose v is half a step early, keeps K + U below A (1 + ½hω)/(1 − ½hω);
    here ωh ≤ 0.8.
    """
    available, exact = energy_available(run)
    if available is None:
        return None
    K, U = kinetic_energies(run), elastic_energies(run)
    largest = np.maximum.accumulate(np.maximum(available, 0.0))
    K_error, U_error = SPEED**2 * largest[-1], uniform_strain(run, STRAIN)
    wrong = np.maximum(np.sqrt(K) - np.sqrt(K_error), 0.0) ** 2 + np.maximum(np.sqrt(U) - np.sqrt(U_error), 0.0) ** 2
    allowed = available + _residual_work(run)
    if isinstance(run.solver, wc.Explicit):
        allowed = allowed + largest * (1.4 / 0.6 - 1.0)
    excess = wrong - np.maximum(allowed, 0.0)
    f = int(excess.argmax())
    if not excess[f] > 0.0:
        return None
    text = f"kinetic {K[f]:.3g} J and elastic {U[f]:.3g} J of {available[f]:.3g} J{'' if exact else ' (estimate)'}"
    return Condemnation("energy", f, text)


def one_edge(run):
    """Condemns a spring that holds more energy by itself than there was, even if it were shorter by 5 % of its length."""
    stiffness = [term.stiffness for term in run.scene.terms if isinstance(term, wc.Spring)]
    available, exact = energy_available(run)
    if not stiffness or available is None:
        return None
    strain = np.abs(_spring_lengths(run) / run.lengths - 1.0)
    alone = 0.5 * stiffness[0] * (np.maximum(strain - 0.05, 0.0) * run.lengths) ** 2
    allowed = available + _residual_work(run)
    if isinstance(run.solver, wc.Explicit):
        allowed = allowed + np.maximum.accumulate(np.maximum(available, 0.0)) * (1.4 / 0.6 - 1.0)
    excess = alone.max(axis=1) - np.maximum(allowed, 0.0)
    f = int(excess.argmax())
    if not excess[f] > 0.0:
        return None
    text = f"a spring has a strain of {strain[f].max():.3g} and {alone[f].max():.3g} J of {available[f]:.3g} J"
    return Condemnation("one edge", f, text + ("" if exact else " (estimate)"))


def momentum(run):
    """Condemns a momentum of cloth in free flight that gravity does not explain, by 1 % of what its motion has.

    Frames count until cloth may touch: no pins, loads or air, and in the next step no vertex can get to a collider and no part
    of the cloth to another. Residuals of :data:`RESIDUAL` g change the momentum by that fraction of the fall only.
    """
    scene, x, v = run.scene, run.x, run.v
    if run.pins is not None or run.loads or scene.air is not None:
        return None
    speeds = np.linalg.norm(v, axis=2).max(axis=1) + np.linalg.norm(run.gravity) * run.h + _obstacle_speed(run)
    touched = np.zeros(len(x), dtype=bool)
    for gaps in run.distances:
        touched |= gaps.min(axis=1) < scene.contact.distance + speeds * run.h
    if scene.self_contact is not None:
        touched |= [_may_touch_itself(run, f) for f in range(len(x))]
    count = int(touched.argmax()) if touched.any() else len(x)
    P = np.einsum("i,fik->fk", run.masses, v)
    wanted = P[0] + run.masses.sum() * run.gravity * run.times[:, None]
    scale = np.sqrt(run.masses.sum() * np.einsum("i,fik,fik->f", run.masses, v, v)) + np.linalg.norm(wanted, axis=1)
    off = np.linalg.norm(P - wanted, axis=1)
    excess = (off - 0.01 * scale - run.masses.sum() * run.rounding / run.h)[:count]
    if not count or not (excess > 0.0).any():
        return None
    f = int(excess.argmax())
    return Condemnation("momentum", f, f"off by {off[f]:.3g} N s of {scale[f]:.3g} N s in free flight")


def _may_touch_itself(run, f):
    """Returns whether parts of the cloth may touch in the next step.

    Pieces are too near if vertices of one are within twice r and the way of a step of triangles of the other. One piece may
    touch itself if vertices are nearer than 0.7 of their distance at rest: pairs touch within half of that at most.
    """
    x, rest = run.x[f], np.asarray(run.scene.mesh.points)
    way = 2.0 * run.h * np.linalg.norm(run.v[f] - run.v[f].mean(axis=0), axis=1).max()
    _, labels = connected_components(coo_matrix((np.ones(len(run.springs)), run.springs.T), (len(x), len(x))))
    same = labels[:, None] == labels
    np.fill_diagonal(same, False)
    apart, apart_at_rest = (np.linalg.norm(points[:, None] - points, axis=2)[same] for points in (x, rest))
    if (apart < 0.7 * apart_at_rest + way).any():
        return True
    near = from_triangles(x, x[run.triangles])[labels[:, None] != labels[run.triangles[:, 0]]]
    return near.size > 0 and near.min() < 2.0 * (run.scene.self_contact.distance + way)


def pressed(run):
    """Condemns a plane that presses cloth with more than 3 times the force that the motion of the cloth shows, for 5 steps.

    The only collider is a plane that stands still, and nothing else holds the cloth. The normal force N of the declared energy,
    k A φ′ at the distances of the frames, and filters, which only push outwards, give hΣN ≤ MΔv − hΣ(Mg + F). The distances
    must also be wrong, by more than r/4: the mean distance of touching vertices is compared with that of the right pressure.
    """
    scene, plane = run.scene, run.colliders[0] if len(run.colliders) == 1 else None
    stands = isinstance(plane, wc.Plane) and len(np.atleast_2d(plane.position)) == len(np.atleast_2d(plane.rotation)) == 1
    substeps = getattr(run.solver, "substeps", 1)
    if not stands or run.pins is not None or scene.air is not None or substeps != 1 or len(run.x) < 7:
        return None
    if scene.contact.stiffness is None:
        return None
    n, r, k = rotated(plane.rotation, plane.normal), scene.contact.distance, scene.contact.stiffness
    force = k * (run.vertex_areas * barrier_slope(run.distances[0], r)).sum(axis=1)
    acting = _forces(run).sum(axis=0) @ n
    P = np.einsum("i,fik,k->f", run.masses, run.v, n)
    window = 5
    for f in range(1 + window, len(run.x)):
        pushed = force[f - window + 1 : f + 1]
        needed = max((P[f] - P[f - window]) / (window * run.h) - acting, 0.0)
        if pushed.min() <= 3.0 * needed + RESIDUAL * run.masses.sum() * 9.81:
            continue
        touching = run.distances[0][f] < r
        pressure = needed / run.vertex_areas[touching].sum()
        right = r - pressure / k if pressure < 0.5 * k * r else 0.25 * r * r * k / pressure
        near = float(run.distances[0][f - window + 1 : f + 1, touching].mean())
        if right - near > 0.25 * r:
            return Condemnation(
                "pressed", f, f"{pushed.min():.3g} N where {needed:.3g} N are right, {near:.2g} m from the plane"
            )
    return None


def energy_available(run):
    """Returns the energy A [J] that K + U cannot exceed in each frame, (F+1,), and whether that is proved, not estimated.

    It is proved in the frame of reference of velocity V in which no collider and no pin moves, see :func:`rest_frame`. There A
    is K₀ + U₀ + the energy of contact at the start + the work of gravity and forces + that of the wind. The force of air in a
    step is F = c(w − v) along the normal and across, c from the relative speed at its start, so its work h F·v is at most h c
    w²/4; cloth that only wind touches is judged in the frame of the wind, where air only brakes.

    Else colliders that move estimate it: one of relative velocity V turns a speed of v into v + 2V at most, and is taken to
    do so :data:`HITS` times. What they store in cloth that something else holds is :func:`pulled_energies`. None if loads have
    keyframes.
    """
    V = rest_frame(run)
    exact = V is not None
    V = _first_velocity(run) if V is None else V
    y = run.x - run.times[:, None, None] * V
    A = np.einsum("ik,fik->f", _forces(run), y - y[0]) + _wind_work(run, V)
    A += elastic_energies(run)[0] + contact_energy(run, 0)
    if isinstance(run.solver, wc.PBD | wc.HierarchicalPBD) and run.colliders:  # whose contact is a constraint d ≥ r
        A += np.linalg.norm(_forces(run), axis=1).sum() * run.scene.contact.distance
    start = 0.5 * np.einsum("i,ik,ik->", run.masses * run.free, run.v[0] - V, run.v[0] - V)
    if exact:
        return A + start, True
    M, relative = run.masses.sum(), _obstacle_speed(run, V)
    A = A + 0.5 * M * (np.sqrt(2.0 * start / M) + 2.0 * HITS * relative) ** 2
    return A + pulled_energies(run, relative), False


def pulled_energies(run, speed):
    """Returns the elastic energy that colliders may store in cloth that something else holds, (F+1,) [J].

    In the frame of reference of a collider, only pins and other colliders do work. If they move vertices at w, their power on
    elastic cloth is Σ ∇U·w over the elements that join such a vertex to another, for springs at most √(2U Σk) w. So √U grows
    by at most √(½Σk) times the way, wherever the cloth is. ½Σk way² is the energy of the start with those vertices moved that
    far along these springs; it is summed over the axes, each the mean of both senses, as springs have all directions: 0.9 to 3
    times as much.
    Pins move the same vertices all the time, colliders those that they may touch in a step.

    Args:
        run: The :class:`Run`.
        speed: The largest speed of a collider or pin relative to another [m/s].
    """
    found, alone = np.zeros(len(run.x)), copy(run)
    alone.pins = None
    if run.pins is not None:
        found += _of_moves(run, np.broadcast_to(~run.free, found.shape + run.free.shape), speed * run.times)
    if len(run.colliders) > 1 and rest_frame(alone) is None:
        touched, one_step = _touched(run, speed), np.full(len(found), speed * run.h)
        of_others = [np.delete(touched, c, axis=0).any(axis=0) & run.free for c in range(len(touched))]
        found += np.min([np.cumsum(np.sqrt(_of_moves(run, moved, one_step))) ** 2 for moved in of_others], axis=0)
    return found


def _touched(run, speed):
    """Returns which vertices each collider may touch in the step before each frame, (C, F+1, n)."""
    ways = np.zeros(run.x.shape[:2])
    ways[1:] = np.linalg.norm(np.diff(run.x, axis=0), axis=2) + speed * run.h
    found = [gaps < run.scene.contact.distance + ways for gaps in run.distances]
    return np.array(found) & (run.times > 0.0)[:, None]


def _of_moves(run, moved, ways):
    """Returns the energy that moving vertices (F+1, n) of the start by ways (F+1,) adds, see :func:`pulled_energies`."""
    after, energy = copy(run), np.zeros(len(ways))
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        after.x = run.x[0] + (ways[:, None] * moved)[..., None] * direction
        energy += 0.5 * elastic_energies(after)
    return np.maximum(energy - 3.0 * elastic_energies(run)[0], 0.0)


def _forces(run):
    """Returns the weight of each vertex and the constant forces on it, (n, 3) [N]."""
    forces = run.masses[:, None] * run.gravity
    for load in run.loads:
        forces[np.asarray(load.vertices)] += load.force
    return forces


def contact_energy(run, frame):
    """Returns Σ kAφ(d) of the free vertices and all colliders in a frame [J]."""
    total = 0.0
    for gaps in run.distances:
        r, k = run.scene.contact.distance, run.scene.contact.stiffness
        total += k * (run.free * run.vertex_areas * barrier(np.maximum(gaps[frame], 1e-3 * r), r)).sum()
    return total


def rest_frame(run):
    """Returns the velocity (3,) [m/s] at which all colliders and pins move, or None if there is none."""
    velocities = []
    for collider in run.colliders:
        position, rotation = np.atleast_2d(collider.position), np.atleast_2d(collider.rotation)
        if np.ptp(rotation, axis=0).max() > 0.0 or 1 < len(position) < len(run.x):
            return None
        velocities.extend(np.diff(position, axis=0) / run.h if len(position) > 1 else np.zeros((1, 3)))
    pins = run.pins
    if pins is not None:
        velocities.extend([np.zeros(3)] if pins.keyframes is None else (np.diff(pins.keyframes, axis=0) / run.h).reshape(-1, 3))
    if not velocities:
        air = run.scene.air
        return np.zeros(3) if air is None else np.asarray(air.wind, np.float64)
    return velocities[0] if np.ptp(velocities, axis=0).max() < 1e-9 else None


def _first_velocity(run):
    """Returns the velocity of the pins, or else of the first collider."""
    pins = run.pins
    moved = pins.keyframes[:2, 0] if pins is not None and pins.keyframes is not None else None
    if pins is None:
        moved = np.atleast_2d(run.colliders[0].position)[:2]
    return np.zeros(3) if moved is None or len(moved) < 2 else (moved[1] - moved[0]) / run.h


def _obstacle_speed(run, V=(0.0, 0.0, 0.0)):
    """Returns the largest speed of a collider or pin, where it may touch cloth, relative to a velocity [m/s]."""
    speed = 0.0
    for collider in run.colliders:
        position, rotation = np.atleast_2d(collider.position), np.atleast_2d(collider.rotation)
        ways = np.diff(position, axis=0) / run.h if len(position) > 1 else np.zeros((1, 3))
        turning = 0.0
        if len(rotation) > 1:
            turned = 2.0 * np.arccos(np.clip(np.abs((rotation[1:] * rotation[:-1]).sum(axis=1)), 0.0, 1.0)) / run.h
            turning = turned.max() * _extent(collider)
        speed = max(speed, np.linalg.norm(ways - V, axis=1).max() + turning)
    pins = run.pins
    if pins is not None:
        ways = np.zeros((1, 3)) if pins.keyframes is None else (np.diff(pins.keyframes, axis=0) / run.h).reshape(-1, 3)
        speed = max(speed, np.linalg.norm(ways - V, axis=1).max())
    return speed


def _extent(collider):
    if isinstance(collider, wc.MeshCollider):
        return np.linalg.norm(collider.points, axis=1).max()
    if isinstance(collider, wc.Capsule):
        return collider.radius + 0.5 * collider.length
    return np.linalg.norm(collider.size) / 2.0 if isinstance(collider, wc.Box) else 0.0


def _wind_work(run, V):
    """Returns a bound of the work of the air up to each frame, (F+1,) [J]."""
    air = run.scene.air
    if air is None:
        return np.zeros(len(run.x))
    wind = np.asarray(air.wind, np.float64) - V
    a, b, c = run.x[:, run.triangles].transpose(2, 0, 1, 3)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=2)
    speeds = np.linalg.norm(run.v[:, run.triangles].mean(axis=2) - V - wind, axis=2)
    drag = (0.5 * air.density * (air.normal_drag + air.tangential_drag) * areas * speeds).sum(axis=1)
    if isinstance(run.solver, wc.Explicit):  # between two frames
        drag[:-1] = 2.0 * np.maximum(drag[:-1], drag[1:])
    return np.concatenate([[0.0], np.cumsum(drag[:-1])]) * run.h * (wind @ wind) / 4.0


def _residual_work(run):
    """Returns the work that steps may add, (F+1,) [J]: residuals of :data:`RESIDUAL` g along the path of each vertex, and the
    weight and forces over the contact distance, by which cloth may be off where it touches."""
    path = np.linalg.norm(np.diff(run.x, axis=0), axis=2) @ run.masses
    work = RESIDUAL * max(np.linalg.norm(run.gravity), 1.0) * np.concatenate([[0.0], np.cumsum(path)]) + 1e-9
    if run.colliders:
        work += np.linalg.norm(_forces(run), axis=1).sum() * run.scene.contact.distance
    return work


def kinetic_energies(run):
    """Returns K of the free vertices in each frame, (F+1,) [J], in the frame of reference of :func:`energy_available`."""
    V = rest_frame(run)
    u = run.v - (_first_velocity(run) if V is None else V)
    return 0.5 * np.einsum("i,fik,fik->f", run.masses * run.free, u, u)


def elastic_energies(run):
    """Returns the energy of springs and membranes in each frame, (F+1,) [J]; that of bending is left out.

    Springs have Σ½k(l − L)² over the edges, corotated membranes Σ½kAΣ(σᵢ − 1)², StVK ones ΣA(μ‖E‖² + ½λ(tr E)²).
    """
    U = np.zeros(len(run.x))
    for term in run.scene.terms:
        k = term.stiffness
        if isinstance(term, wc.Spring):
            U += 0.5 * k * ((_spring_lengths(run) - run.lengths) ** 2).sum(axis=1)
        elif isinstance(term, wc.CorotatedMembrane):
            stretches = np.sqrt(np.maximum(np.linalg.eigvalsh(_right_cauchy_green(run)), 0.0))
            U += (0.5 * k * run.areas * ((stretches - 1.0) ** 2).sum(axis=2)).sum(axis=1)
        elif isinstance(term, wc.StVKMembrane):
            mu, lam = _lame(term)
            E = 0.5 * (_right_cauchy_green(run) - np.eye(2))
            U += (run.areas * (mu * (E**2).sum(axis=(2, 3)) + 0.5 * lam * np.trace(E, axis1=2, axis2=3) ** 2)).sum(axis=1)
    return U


def uniform_strain(run, strain):
    """Returns the largest energy of cloth whose strain has this RMS [J]."""
    U = 0.0
    for term in run.scene.terms:
        if isinstance(term, wc.Spring):
            U += 0.5 * term.stiffness * (strain * run.lengths) @ (strain * run.lengths)
        elif isinstance(term, wc.CorotatedMembrane):
            U += term.stiffness * run.areas.sum() * strain**2
        elif isinstance(term, wc.StVKMembrane):
            mu, lam = _lame(term)
            U += 2.0 * (mu + lam) * run.areas.sum() * strain**2
    return U


def _lame(term):
    k, ratio = term.stiffness, term.poisson_ratio
    return 0.5 * k / (1.0 + ratio), k * ratio / (1.0 - ratio**2)


def _spring_lengths(run):
    return np.linalg.norm(run.x[:, run.springs[:, 1]] - run.x[:, run.springs[:, 0]], axis=2)


def _right_cauchy_green(run):
    """Returns FᵀF of each triangle in each frame, (F+1, T, 2, 2)."""
    a, b, c = np.asarray(run.scene.mesh.points)[run.triangles].transpose(1, 0, 2)
    u = (b - a) / np.linalg.norm(b - a, axis=1)[:, None]
    n = np.cross(b - a, c - a)
    w = np.cross(n / np.linalg.norm(n, axis=1)[:, None], u)
    flat = np.stack([u, w], axis=1) @ np.stack([b - a, c - a], axis=2)
    a, b, c = run.x[:, run.triangles].transpose(2, 0, 1, 3)
    F = np.stack([b - a, c - a], axis=3) @ np.linalg.inv(flat)
    return np.swapaxes(F, -1, -2) @ F


def barrier(d, r):
    """Returns φ(d) [m²] at d > 0, ½(r − d)² for r/2 ≤ d < r, and ⅛r² + ¼r² ln(r/2d) below."""
    far, near = 0.5 * np.maximum(r - d, 0.0) ** 2, 0.125 * r * r + 0.25 * r * r * np.log(0.5 * r / d)
    return np.where(d < 0.5 * r, near, far)


def barrier_slope(d, r):
    """Returns −φ′(d) [m] of :func:`barrier`."""
    return np.where(d < 0.5 * r, 0.25 * r * r / np.maximum(d, 1e-3 * r), np.maximum(r - d, 0.0))


# Shapes


def edges_of(triangles):
    """Returns the edges of triangles (T, 3), each once, (E, 2)."""
    return np.unique(np.sort(np.asarray(triangles)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def rotated(quaternion, points):
    """Returns points (…, 3) rotated by a quaternion (x, y, z, w)."""
    u, w = np.asarray(quaternion[:3]), quaternion[3]
    t = 2.0 * np.cross(u, points)
    return points + w * t + np.cross(u, t)


def _pose(collider, frame):
    positions, rotations = np.atleast_2d(collider.position), np.atleast_2d(collider.rotation)
    return positions[min(frame, len(positions) - 1)], rotations[min(frame, len(rotations) - 1)]


def posed(collider, frame):
    """Returns the vertices of a rigid mesh at a frame (n, 3) [m]."""
    position, rotation = _pose(collider, frame)
    return rotated(rotation, collider.points) + position


def distances(collider, points, frame=0):
    """Returns signed distances of points (n, 3) to the surface of a collider at a frame, negative inside, (n,) [m]."""
    position, (x, y, z, w) = _pose(collider, frame)
    local = rotated((-x, -y, -z, w), points - position)
    if isinstance(collider, wc.Plane):
        return local @ collider.normal
    if isinstance(collider, wc.Sphere):
        return np.linalg.norm(local, axis=1) - collider.radius
    if isinstance(collider, wc.Capsule):
        along = np.clip(local @ collider.axis, -0.5 * collider.length, 0.5 * collider.length)
        return np.linalg.norm(local - along[:, None] * collider.axis, axis=1) - collider.radius
    if isinstance(collider, wc.Box):
        beyond = np.abs(local) - 0.5 * collider.size
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    corners = collider.points[collider.triangles]
    return np.where(_winding(local, corners) > 0.5, -1.0, 1.0) * from_triangles(local, corners).min(axis=1)


def from_triangles(points, corners):
    """Returns distances of points (n, 3) to triangles (T, 3, 3), (n, T): to the plane above the triangle, else to an edge."""
    n = _normals(corners)
    height = np.einsum("ptk,tk->pt", points[:, None] - corners[:, 0], n)
    foot = points[:, None] - height[..., None] * n
    above, nearest = np.ones(height.shape, dtype=bool), np.full(height.shape, np.inf)
    for i in range(3):
        start, edge = corners[:, i], corners[:, (i + 1) % 3] - corners[:, i]
        above &= np.einsum("ptk,tk->pt", np.cross(edge, foot - start), n) >= 0.0
        along = np.clip(np.einsum("ptk,tk->pt", points[:, None] - start, edge) / (edge**2).sum(axis=1), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points[:, None] - start - along[..., None] * edge, axis=2))
    return np.where(above, np.abs(height), nearest)


def _normals(corners):
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]


def _winding(points, corners):
    """Returns how often a closed surface winds about points: its solid angle over 4π (Van Oosterom and Strackee 1983)."""
    a, b, c = (corners[:, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(each, axis=2) for each in (a, b, c))
    volume = np.einsum("ptk,ptk->pt", a, np.cross(b, c))
    dots = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    return np.arctan2(volume, dots).sum(axis=1) / (2.0 * np.pi)


def cross(segments, corners, margin):
    """Returns which segments (S, 2, 3) cross which triangles (T, 3, 3) by more than a margin [m], (S, T).

    Both ends are farther than the margin from the plane, on different sides, and the crossing is as far within all edges.
    """
    n = _normals(corners)
    low, high = (np.einsum("stk,tk->st", segments[:, i, None] - corners[:, 0], n) for i in range(2))
    crossing = (low * high < 0.0) & (np.minimum(np.abs(low), np.abs(high)) > margin)
    part = low / np.where(crossing, low - high, 1.0)
    point = segments[:, 0, None] + part[..., None] * (segments[:, 1] - segments[:, 0])[:, None]
    for i in range(3):
        inward = np.cross(n, corners[:, (i + 1) % 3] - corners[:, i])
        inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-300)[:, None]
        crossing &= np.einsum("stk,tk->st", point - corners[:, i], inward) > margin
    return crossing
