"""Whether a belt that slides steadily over a drum flutters: growth of its fastest growing vibration, for a list of frictions.

    python benchmarks/flutter.py [--turns 24] [--friction 0.1 0.3 0.5] [--run]

The belt is that of the scene ``capstan``, both rows of vertices as one. A vertex on the drum has the force k δ (n − μ t), δ
its overlap, n the normal and t the direction of sliding. Friction makes the stiffness matrix unsymmetric: it couples motion
along n to motion along t, but not the other way round, and where a vibration along n and one along t have nearly one
frequency, one of the two roots of M x″ + C x′ + K x = 0 has a positive real part. Prints this growth and its frequency, and
that of a vertex on its contact. With ``--run`` it also prints the tension that each solver finds, relative to exp(μπ), and the
RMS of v − Δx/Δt of vertices in contact along t and along n, in the second half of 0.5 s.
"""

import argparse
import warnings

import numpy as np

import warpcloth as wc
from warpcloth.scenes import capstan

SOLVERS = {
    "newton euler, 1": wc.Newton(substeps=1, linear="factorised"),
    "newton bdf2, 8": wc.Newton(substeps=8, integrator="bdf2", linear="factorised"),
    "newton midpoint, 1": wc.Newton(substeps=1, integrator="midpoint", linear="factorised", tolerance=1e-5),
    "newton midpoint, 4": wc.Newton(substeps=4, integrator="midpoint", linear="factorised", tolerance=1e-5),
    "newton midpoint, 16": wc.Newton(substeps=16, integrator="midpoint", linear="factorised", tolerance=1e-5),
    "explicit, 1400": wc.Explicit(substeps=1400),
}


def root(scene, friction, damping=None):
    """The root with the largest real part, and the frequency of a vertex on its contact [1/s]."""
    points, n = scene.positions[: len(scene.positions) // 2, [0, 2]], len(scene.positions) // 2
    spring, width, radius = scene.terms[0], np.ptp(scene.mesh.points[:, 2]), np.linalg.norm(scene.positions[n // 2, [0, 2]])
    edges = np.diff(points, axis=0)
    length, rest = np.linalg.norm(edges[0]), scene.mesh.points[1, 0] - scene.mesh.points[0, 0]
    mass, contact = scene.density * rest * width, scene.contact.stiffness * rest * width
    stiffness, damping = 2.0 * spring.stiffness, 2.0 * (spring.damping if damping is None else damping)
    touches = np.linalg.norm(points, axis=1) < 1.0001 * radius
    half = friction * np.tan(0.5 * length / radius)
    held = np.cumsum(touches)[:-1]  # vertices on the drum behind each edge
    tension = stiffness * (length - rest) * ((1.0 + half) / (1.0 - half)) ** held
    K, C = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    for e, edge in enumerate(edges / length):
        along = np.outer(edge, edge)
        pair = np.kron([[1.0, -1.0], [-1.0, 1.0]], stiffness * along + tension[e] / length * (np.eye(2) - along))
        K[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += pair
        C[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += np.kron([[1.0, -1.0], [-1.0, 1.0]], damping * along)
    for i in np.flatnonzero(touches):
        normal = points[i] / np.linalg.norm(points[i])
        slides = np.array([normal[1], -normal[0]])
        slides *= np.sign(slides @ edges[i])
        K[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += contact * np.outer(normal - friction * slides, normal)
    K, C = K[:-2, :-2] / mass, C[:-2, :-2] / mass  # the end ahead is pinned
    roots = np.linalg.eigvals(np.block([[np.zeros_like(K), np.eye(len(K))], [-K, -C]]))
    return roots[roots.real.argmax()], np.sqrt(contact / mass)


def vibration(scene, solver):
    """Tension ahead over that behind, over exp(μπ) − 1, and RMS of v − Δx/Δt along the drum and along its normal [m/s]."""
    found = wc.simulate(scene, solver, dtype="float64")
    n, half = found.points.shape[1] // 2, len(found.points) // 2
    lengths = np.linalg.norm(np.diff(found.points.reshape(len(found.points), 2, n, 3), axis=2), axis=-1).mean(axis=1)
    rest = scene.mesh.points[1, 0] - scene.mesh.points[0, 0]
    stretch = lengths[half:].mean(axis=0) - rest
    x, before, v = found.points[half:], found.points[half - 1 : -1], found.velocities[half:]
    near = np.abs(scene.colliders[0].distances(x)) < scene.contact.distance
    shake, away = v - scene.fps * (x - before), x * [1.0, 0.0, 1.0]
    normal = away / np.linalg.norm(away, axis=-1, keepdims=True)
    along = np.cross(normal, [0.0, 1.0, 0.0])
    rms = [np.sqrt(np.mean((shake * each).sum(axis=-1)[near] ** 2)) for each in (along, normal)]
    return stretch[-1] / stretch[0] / np.exp(np.pi * scene.colliders[0].friction) - 1.0, *rms, found.status.grade.name


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=24)
    parser.add_argument("--friction", type=float, nargs="+", default=[0.1, 0.2, 0.3, 0.4, 0.5])
    parser.add_argument("--run", action="store_true", help="also simulate")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for friction in options.friction:
        scene = capstan.scene(friction=friction, turns=options.turns, duration=0.5)
        found, contact = root(scene, friction)
        print(
            f"μ = {friction:g}: grows by {found.real:.1f}/s at {abs(found.imag):.0f}/s; contact has {contact:.0f}/s", flush=True
        )
        for name, solver in SOLVERS.items() if options.run else ():
            error, along, normal, grade = vibration(scene, solver)
            print(f"  {name:20} {100.0 * error:+6.1f} %  {along:.3f} and {normal:.3f} m/s  {grade}", flush=True)


if __name__ == "__main__":
    main()
