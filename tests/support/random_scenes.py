"""Random scenes of one or two small sheets among colliders, each with a solver that takes it: one per seed."""

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import warpcloth as wc
from support.judges import Condemnation, distances, from_triangles, judge, posed, rotated
from warpcloth.run.simulate import Animation
from warpcloth.solvers.step import Step

SOLVERS = ("newton", "xpbd", "pbd", "projective-dynamics", "admm", "constrained-dynamics", "hierarchical-pbd", "explicit")
GRAVITY = 9.81
UP = np.array([0.0, 1.0, 0.0])


class Case(NamedTuple):
    """A scene with how to run it.

    Attributes:
        seed: The seed it is made from. Solvers take turns from seed to seed, precisions every 8 seeds.
        scene: Its frames are the steps of the solver, except for explicit steps.
        solver: The record of the solver.
        dtype: The precision.
        text: A description.
    """

    seed: int
    scene: wc.Scene
    solver: Step
    dtype: str
    text: str


def run_case(case: Case, device: str) -> tuple[Animation, list[Condemnation]]:
    """Runs a case and returns the animation, and what the judges condemn in it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # explicit steps above the limit in motion
        animation = wc.simulate(case.scene, case.solver, device=device, dtype=case.dtype)
    return animation, judge(case.scene, animation, case.solver, case.dtype)


def random_case(seed: int) -> Case:
    """Returns the case of a seed, an integer from 0; all of them are cases."""
    random = _Random(seed)
    if random.chance(0.05):
        return _pressed(random, seed)
    name, dtype = SOLVERS[seed % 8], ("float32", "float64")[seed // 8 % 2]
    steps, frames = random.of(24, 48, 96, 240), int(random.integers(12, 25))  # steps in a second
    gravity, distance = random.of(GRAVITY, GRAVITY, GRAVITY, 0.0), random.of(1e-3, 2e-3, 5e-3)
    density, friction = random.of(0.1, 0.15, 0.3), random.of(0.0, 0.0, random.uniform(0.0, 1.0))
    times = np.arange(frames + 1) / steps
    if "pbd" in name and name != "xpbd":
        friction = 0.0  # refused by both
    largest = 9 if name == "constrained-dynamics" else 13  # its conjugate gradients are slow on stiff contact
    cloth, facts = _sheets(random, distance, density, largest)
    terms, materials = _materials(random, name)
    pins, held = _pins(random, cloth, times)
    colliders, motion = _colliders(random, cloth, times, distance, friction, _velocity(pins, times))
    stiffness = random.of(1e4, 1e5, 1e6, 1e7) if name != "constrained-dynamics" else random.of(1e4, 1e5)
    if gravity and random.chance(0.5):
        stiffness = None  # that of the weight
    acting, about = {}, f"{facts}, {materials}, {held}, {motion}, gravity {gravity}, steps 1/{steps} s, {frames} frames"
    if colliders:
        random.of(0, 1)  # keeps the scenes of the seeds
        acting["contact"] = wc.Contact(distance=distance, stiffness=stiffness)
        about += f", contact {1e3 * distance:g} mm {stiffness} Pa/m, friction {friction:.2g}"
    if random.chance(0.8 if cloth["sheets"] == 2 else 0.4):
        acting["self_contact"] = wc.SelfContact(distance=min(distance, 2e-3), stiffness=stiffness, friction=friction)
        about += f", self-contact {stiffness} Pa/m"
    if random.chance(0.12) and "pbd" not in name.replace("xpbd", "") and name != "constrained-dynamics":
        acting["air"] = wc.Air(wind=random.direction() * random.uniform(0.0, 8.0))
        about += ", wind"
    if random.chance(0.12):
        weight = GRAVITY * density * cloth["size"] ** 2
        acting["loads"] = [wc.Force(vertices=[cloth["middle"]], force=random.direction() * weight * random.uniform(0.0, 1.0))]
        about += ", a force"
    scene = wc.Scene(
        cloth["mesh"],
        density=density,
        positions=cloth["positions"],
        velocities=cloth["velocities"],
        terms=terms,
        pins=pins,
        gravity=(0.0, -gravity, 0.0),
        colliders=colliders,
        duration=frames / steps,
        fps=float(steps),
        **acting,
    )
    solver = _solver(random, name, scene)
    return Case(seed, scene, solver, dtype, f"{about}, {solver.substeps} x {getattr(solver, 'iterations', 0)} iterations")


def _pressed(random, seed):
    """A sheet that forces without gravity press on a plane, at rest at the distance of balance (a pressure p at r − p/k)."""
    name, dtype = SOLVERS[seed % 8], ("float32", "float64")[seed // 8 % 2]
    distance, stiffness, density = random.of(1e-3, 5e-3), random.of(1e5, 1e6, 1e7), 0.15
    cloth, _ = _sheets(random, distance, density, 9)
    n, count = rotated(cloth["tilt"], UP), cloth["side"] ** 2
    mesh, x = wc.Mesh(cloth["mesh"].points[:count], cloth["mesh"].triangles[: cloth["cells"]]), cloth["positions"][:count]
    pressure = random.uniform(0.001, 0.4) * stiffness * distance
    areas = wc.Scene(mesh, density=1.0, terms=[wc.Spring(stiffness=1.0)]).vertex_masses
    gap = distance - pressure / stiffness
    terms, materials = _materials(random, name)
    scene = wc.Scene(
        mesh,
        density=density,
        positions=x,
        terms=terms,
        gravity=(0.0, 0.0, 0.0),
        colliders=[wc.Plane(normal=n, position=x[0] - gap * n)],
        contact=wc.Contact(distance=distance, stiffness=stiffness),
        loads=[wc.Force(vertices=np.arange(count), force=-pressure * areas[:, None] * n)],
        duration=0.25,
        fps=random.of(48.0, 240.0),
    )
    about = f"{len(mesh.points)} vertices pressed by {pressure:.3g} Pa, {1e3 * distance:g} mm, {stiffness:g} Pa/m, {materials}"
    return Case(seed, scene, _solver(random, name, scene), dtype, about)


class _Random(np.random.Generator):
    """A generator of random numbers with choices."""

    def __init__(self, seed):
        super().__init__(np.random.PCG64(seed))

    def of(self, *values):
        """Returns one of the values."""
        return values[self.integers(len(values))]

    def chance(self, probability):
        return self.random() < probability

    def direction(self):
        vector = self.normal(size=3)
        return vector / np.linalg.norm(vector)

    def rotation(self):
        vector = self.normal(size=4)
        return vector / np.linalg.norm(vector)


def _sheets(random, distance, density, largest):
    """Returns one or two parallel sheets, more than the contact distance apart, as a dictionary, and a text."""
    sheets, n, size = random.of(1, 1, 2), int(random.integers(7, largest + 1)), random.uniform(0.2, 0.5)
    grid = wc.Mesh.grid(n, n, size=size, pattern=random.of("alternating", "diagonal"))
    flat = grid.points - [0.5 * size, 0.0, 0.5 * size]
    tilt = random.rotation() if random.chance(0.2) else np.append(0.1 * random.normal(size=3), 1.0)
    tilt /= np.linalg.norm(tilt)
    aim = -UP + 0.3 * random.normal(size=3)
    aim /= np.linalg.norm(aim)
    speed = random.of(0.0, random.uniform(0.0, 3.0), random.uniform(3.0, 10.0))
    gap = 3.0 * distance + random.uniform(0.0, 0.05)
    positions, velocities = [], []
    for sheet in range(sheets):
        about_up = np.array([0.0, np.sin(0.5 * sheet), 0.0, np.cos(0.5 * sheet)])
        positions.append(rotated(tilt, rotated(about_up, flat) + sheet * gap * UP))
        moves = sheet == sheets - 1 or random.chance(0.5)  # the upper one always
        velocities.append(np.tile(moves * speed * aim, (n * n, 1)))
    rest = np.concatenate([flat + 2.0 * sheet * UP for sheet in range(sheets)])
    triangles = np.concatenate([grid.triangles + sheet * n * n for sheet in range(sheets)])
    cloth = {
        "sheets": sheets,
        "side": n,
        "size": size,
        "cells": len(grid.triangles),
        "middle": n * n // 2,
        "aim": aim,
        "tilt": tilt,
        "mesh": wc.Mesh(rest, triangles),
        "positions": np.concatenate(positions),
        "velocities": np.concatenate(velocities),
    }
    return cloth, f"{sheets} sheets of {n}² vertices, {size:.2f} m, {density} kg/m², {speed:.1f} m/s"


def _materials(random, name):
    """Returns the energies, and a text."""
    largest = 1e3 if name == "explicit" else 1e4
    stiffness = np.exp(random.uniform(np.log(50.0), np.log(largest)))
    kind = random.of("springs", "springs", "corotated", "StVK")
    if kind == "StVK" and name not in ("newton", "explicit", "projective-dynamics"):
        kind = "corotated"
    damping = random.of(None, None, random.uniform(0.0, 0.02))
    if kind == "springs":
        terms = [wc.Spring(pairs="edges", stiffness=stiffness, damping=damping)]
    elif kind == "StVK":
        terms = [wc.StVKMembrane(stiffness=stiffness, poisson_ratio=random.uniform(0.0, 0.4))]
    else:
        terms = [wc.CorotatedMembrane(stiffness=stiffness)]
    bending = random.of(0.0, 1e-6, 1e-5, 1e-4)
    if bending:
        terms.append(wc.QuadraticBending(stiffness=bending))
    damped = f", damping {damping:.2g} N s/m" if kind == "springs" and damping else ""
    return terms, f"{kind} {stiffness:.0f} N/m{damped}, bending {bending:g} N m"


def _pins(random, cloth, times):
    """Returns no pins, or two corners of one sheet or each, fixed or in uniform motion, and a text."""
    how, n = random.of("free", "free", "pinned", "pinned", "moved"), cloth["side"]
    corners = np.array([0, n - 1])
    if cloth["sheets"] == 2 and random.chance(0.5):
        corners = np.append(corners, corners + n * n)
    if how == "free":
        return None, how
    if how == "pinned":
        return wc.Pins(corners), f"{len(corners)} pins"
    velocity = random.direction() * random.uniform(0.0, 2.0)
    keyframes = cloth["positions"][corners] + times[:, None, None] * velocity
    return wc.Pins(corners, keyframes=keyframes), f"{len(corners)} pins at {np.linalg.norm(velocity):.2g} m/s"


def _velocity(pins, times):
    return None if pins is None or pins.keyframes is None else (pins.keyframes[1, 0] - pins.keyframes[0, 0]) / times[1]


KINDS = ("plane", "sphere", "capsule", "box", "cone", "brick")
CLOSING = (
    ("plane", "plane"),
    ("plane", "box"),
    ("box", "box"),
    ("brick", "brick"),
    ("sphere", "plane"),
    ("capsule", "capsule"),
    ("cone", "plane"),
)


def _colliders(random, cloth, times, distance, friction, velocity):
    """Returns colliders that start apart from the cloth, and a text. Moving ones have the velocity (3,) of pins that move."""
    motion = random.of("standing", "standing", "standing", "moving", "rotating", "closing", "no")
    kinds = tuple(random.of(*KINDS) for _ in range(random.of(1, 1, 2)))
    kinds = {"closing": random.of(*CLOSING), "no": ()}.get(motion, kinds)
    speed, x, found = random.uniform(0.1, 5.0), cloth["positions"], []
    for index, kind in enumerate(kinds):
        side = cloth["aim"] if motion == "closing" and index else -cloth["aim"]  # outward, towards the cloth
        rotation = _rotation_from_up(side)
        if kind not in ("plane", "sphere") and random.chance(0.4):
            rotation = random.rotation()
        collider = _collider(random, kind, rotation, friction)
        beside = rotated(cloth["tilt"], 0.3 * cloth["size"] * np.array([random.uniform(-1, 1), 0.0, random.uniform(-1, 1)]))
        gap = 2.5 * distance + random.uniform(0.0, 0.08)
        position = _at_gap(collider, x.mean(axis=0) + beside - 2.0 * side, side, cloth, gap)
        if motion == "moving":
            position = position + times[:, None] * (speed * side if velocity is None else velocity)
        elif motion == "closing":  # it stops before what stands still
            position = position + np.minimum(speed * times, gap - 2.5 * distance)[:, None] * side
        collider = replace(collider, position=position)
        if motion == "rotating" and kind not in ("plane", "sphere"):
            half = 0.5 * random.uniform(0.0, 8.0) * times
            turns = np.stack([0.0 * half, np.sin(half), 0.0 * half, np.cos(half)], axis=1)
            collider = replace(
                collider, position=np.tile(position, (len(times), 1)), rotation=[_product(turn, rotation) for turn in turns]
            )
        found.append(collider)
    along = motion == "moving" and velocity is not None
    moves = " with the pins" if along else f" at {speed:.1f} m/s" if motion in ("moving", "closing") else ""
    return found, f"{motion} colliders {'+'.join(kinds)}{moves}"


def _at_gap(collider, position, direction, cloth, gap):
    """Returns the position from which points on the cloth are a gap away, by marching along a direction.

    Points are the vertices and the middles of edges and triangles, and for meshes also the vertices of the mesh.
    """
    corners = cloth["positions"][cloth["mesh"].triangles]
    points = np.concatenate(
        [corners, 0.5 * (corners + np.roll(corners, 1, axis=1)), corners.mean(axis=1, keepdims=True)], axis=1
    )
    points = np.unique(points.reshape(-1, 3), axis=0)
    for _ in range(100):
        moved = replace(collider, position=position)
        ahead = distances(moved, points).min() - gap
        if isinstance(collider, wc.MeshCollider):
            ahead = min(ahead, from_triangles(posed(moved, 0), corners).min() - gap)
        if ahead < 1e-6:
            break
        position = position + 0.999 * ahead * direction  # distances change by no more than the way
    return position


def _collider(random, kind, rotation, friction):
    size, given = random.uniform(0.05, 0.15), {"rotation": rotation, "friction": friction}
    if kind == "plane":
        return wc.Plane(**given)
    if kind == "sphere":
        return wc.Sphere(radius=size, **given)
    if kind == "capsule":
        return wc.Capsule(radius=0.5 * size, length=2.0 * size, axis=(1.0, 0.0, 0.0), **given)
    edges = random.uniform(0.06, 0.2, 3)
    if kind == "box":
        return wc.Box(size=edges, **given)
    if kind == "brick":
        return wc.MeshCollider(*_brick(edges), **given)
    return wc.MeshCollider(*_cone(size, 2.0 * edges[1]), **given)


def _cone(radius, height, sides=10):
    """Points and triangles of a cone with its tip at 0."""
    angles = np.arange(sides) * 2.0 * np.pi / sides
    ring = np.stack([radius * np.cos(angles), np.full(sides, -height), radius * np.sin(angles)], axis=1)
    around = [(i, (i + 1) % sides) for i in range(sides)]
    triangles = [(sides + 1, after, i) for i, after in around] + [(sides, i, after) for i, after in around]
    return np.vstack([ring, [[0.0, -height, 0.0], [0.0, 0.0, 0.0]]]), np.array(triangles)


def _brick(edges):
    """Points and triangles of a box about 0."""
    points = 0.5 * edges * [[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, np.array([triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])


def _rotation_from_up(direction):
    """Returns the smallest rotation of the y axis to a direction (3,)."""
    x, y, z = direction
    quaternion = np.array([z, 0.0, -x, 1.0 + y]) if y > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
    return quaternion / np.linalg.norm(quaternion)


def _product(p, q):
    """Returns the quaternion of rotation q and then p."""
    return np.append(p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3]), p[3] * q[3] - p[:3] @ q[:3])


def _solver(random, name, scene):
    sweeps = int(random.of(10, 30, 100))
    if name == "newton":
        return wc.Newton(substeps=1)
    if name == "explicit":  # ωh at most 0.8 about the rest shape
        limit, _motion = wc.Explicit.step_limits(scene.build(dtype="float64"))
        return wc.Explicit(substeps=int(np.ceil(1.0 / (scene.fps * 0.4 * limit))))
    if name == "constrained-dynamics":
        return wc.ConstrainedDynamics(substeps=1, iterations=sweeps // 10, linear=random.of("cg", "factorised"))
    solvers = {
        "xpbd": wc.XPBD,
        "pbd": wc.PBD,
        "projective-dynamics": wc.ProjectiveDynamics,
        "admm": wc.ADMM,
        "hierarchical-pbd": wc.HierarchicalPBD,
    }
    return solvers[name](substeps=1, iterations=sweeps)
