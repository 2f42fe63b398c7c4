"""Scenes as models of pyPBD 2.2, the bindings of PositionBasedDynamics.

Its XPBD constraint of a distance has a stiffness in N/m. A constraint of PBD moves vertices by a fraction s of the way that
satisfies it. Here s follows from the energy ½kC² and the step dt: n iterations reduce C by w/(w + 1/(k dt²)), as one of XPBD
does, w = Σ ‖∂C/∂xᵢ‖²/mᵢ at rest, so f = 1 − (1 + w k dt²)^(−1/n).

| Energy | Constraint | s |
|---|---|---|
| `Spring`, method "xpbd" | distance, XPBD | – |
| `Spring`, method "pbd" | distance | f |
| `QuadraticBending` | isometric bending | 2f, with y in place of C and k = D/(A₁ + A₂) |
| `CorotatedMembrane` | strain of a triangle, normalised | f, with k = EtA for the stretch along two axes, EtA/2 for the shear |

Bending is constrained by its energy, so that satisfying it halves y; hence the factor 2. As dt falls, moves add up to those of
the energies, for every n.

Gravity is 9.81 m/s² along −y, so scenes are rotated, and time is scaled by √(|g|/9.81).
"""

import numpy as np

from ..mesh.mesh import Mesh
from ..terms import CorotatedMembrane, QuadraticBending, Spring

METHODS = ("pbd", "xpbd")
TAKES = (Spring, QuadraticBending, CorotatedMembrane)
_GRAVITY = 9.81


def engine():
    """Returns the module ``pypbd``.

    Raises:
        ImportError: It is not installed.
    """
    try:
        import pypbd
    except ImportError:
        raise ImportError("a comparison with pyPBD needs it: pip install -e '.[pbd]' in the checkout") from None
    return pypbd


def frame_of(gravity):
    """Returns the rotation (3, 3) from a scene to pyPBD, and the factor between times."""
    size = np.linalg.norm(gravity)
    down = np.asarray(gravity) / size
    side = np.eye(3)[np.abs(down).argmin()]
    across = np.cross(side, down)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, -down, np.cross(across, -down)])
    if np.array_equal(down, [0.0, -1.0, 0.0]):
        rotation = np.eye(3)
    return rotation, float(np.sqrt(size / _GRAVITY))


def pbd_model(scene, method, dt, iterations=1):
    """Returns a scene as a ``pypbd.SimulationModel`` for steps ``dt`` [s], with float64 arrays in the order of the scene.

    Positions are rotated, velocities per scaled time (:func:`frame_of`), pins have mass 0.

    Raises:
        ImportError: pyPBD is not installed.
        ValueError: The scene has something that pyPBD lacks.
    """
    pypbd = engine()
    refuse_inexpressible(scene, method)
    rotation, scale = frame_of(scene.gravity)
    rest, start, velocities = (each @ rotation.T for each in (scene.mesh.points, scene.positions, scene.velocities))
    masses = scene.vertex_masses.copy()
    masses[scene.fixed] = 0.0
    model = pypbd.SimulationModel()
    model.init()
    particles = model.getParticles()
    particles.reserve(len(rest))
    for i, mass in enumerate(masses.tolist()):
        particles.addVertex(rest[i])
        particles.setMass(i, mass)
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0.0)
    for term in scene.terms:
        found = term.elements(scene.mesh, scene.positions)
        if isinstance(term, Spring):
            _add_springs(model, found, inverse, method, dt, scale, iterations)
        elif isinstance(term, QuadraticBending):
            _add_bending(model, found, inverse, dt, iterations)
        else:
            _add_membrane(model, particles, found, scene.mesh, inverse, dt, iterations)
    for i in range(len(rest)):
        particles.setPosition0(i, rest[i])
        particles.setPosition(i, start[i])
        particles.setVelocity(i, velocities[i] / scale)
    return model


def refuse_inexpressible(scene, method):
    """Raises ValueError with what pyPBD lacks to run a scene."""
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {', '.join(METHODS)}")

    def refuse(what):
        raise ValueError(f"pyPBD has no {what}; the scene {scene.name!r} has")

    if not np.linalg.norm(scene.gravity) > 0.0:
        raise ValueError(f"pyPBD has gravity that cannot be switched off; the scene {scene.name!r} has none")
    if scene.locked is not None:
        refuse("vertices that move along some axes only")
    if scene.pins.moves:
        refuse("pins with keyframes in this comparison")
    if scene.loads:
        refuse("loads")
    if scene.air_terms:
        refuse("air")
    if scene.self_contact is not None:
        refuse("self-contact of cloth")
    if scene.colliders:
        refuse("colliders with a stiffness, and none in this comparison")
    for term in scene.terms:
        if not isinstance(term, TAKES):
            names = ", ".join(each.__name__ for each in TAKES)
            raise ValueError(f"pyPBD does not take {type(term).__name__} of the scene {scene.name!r}, only {names}")
        if not np.isfinite(term.stiffness).all() and not isinstance(term, Spring):
            refuse(f"infinite stiffness of {term.label}")
        if np.any(term.damping or 0.0):
            refuse(f"damping, as that of {term.label}")


def _fraction(w, stiffness, dt, iterations):
    with np.errstate(invalid="ignore"):
        found = 1.0 - (1.0 + w * stiffness * dt**2) ** (-1.0 / iterations)
    return np.where(w > 0.0, found, 0.0)


def _add_springs(model, found, inverse, method, dt, scale, iterations):
    """Adds distances; infinitely stiff ones are PBD's."""
    stiffness = np.broadcast_to(found.stiffness, len(found.stencil))
    fractions = _fraction(inverse[found.stencil].sum(axis=1), stiffness, dt, iterations)
    # At a turned time t' = t·scale, a force per length is k/scale².
    soft = np.isfinite(stiffness) if method == "xpbd" else np.zeros(len(stiffness), dtype=bool)
    values = np.where(soft, stiffness / scale**2, fractions)
    first = len(model.getConstraints())
    for (a, b), value, compliant in zip(found.stencil.tolist(), values.tolist(), soft.tolist(), strict=True):
        (model.addDistanceConstraint_XPBD if compliant else model.addDistanceConstraint)(a, b, value)
    constraints = model.getConstraints()
    for e, length in enumerate(found.rest[:, 0].tolist()):
        constraints[first + e].restLength = length


def _add_bending(model, found, inverse, dt, iterations):
    weights, measure = found.rest[:, :4], found.rest[:, 4]
    w = (inverse[found.stencil] * weights**2).sum(axis=1)
    fractions = 2.0 * _fraction(w, np.broadcast_to(found.stiffness, len(w)) * measure, dt, iterations)
    for (x0, x1, x2, x3), value in zip(found.stencil.tolist(), fractions.tolist(), strict=True):
        model.addIsometricBendingConstraint(x2, x3, x0, x1, value)


def _add_membrane(model, particles, found, mesh, inverse, dt, iterations):
    """Adds triangles, each with its rest shape in the plane that the constraint reads."""
    stiffness = np.broadcast_to(found.stiffness, len(found.stencil))
    triangles = Mesh(mesh.points, found.stencil)
    x0, x1, x2 = (mesh.points[found.stencil[:, i]] for i in range(3))
    length = np.linalg.norm(x1 - x0, axis=1)
    along = ((x2 - x0) * (x1 - x0)).sum(axis=1) / length
    across = 2.0 * triangles.triangle_areas / length
    flat = np.zeros((len(length), 3, 3))
    flat[:, 1, 0], flat[:, 2, 0], flat[:, 2, 2] = length, along, across
    sides = np.stack([flat[:, 1, [0, 2]], flat[:, 2, [0, 2]]], axis=2)
    inner = np.linalg.inv(sides)  # rows: gradients of the coordinates of the second and third corner
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)  # (T, 3, 2)
    k = stiffness * triangles.triangle_areas
    weights = inverse[found.stencil][:, :, None] * gradients**2
    stretch = _fraction(4.0 * weights.sum(axis=1), 0.25 * k[:, None], dt, iterations)
    shear = _fraction(weights.sum(axis=(1, 2)), 0.5 * k, dt, iterations)
    for t, corners in enumerate(found.stencil.tolist()):
        for corner, i in enumerate(corners):
            particles.setPosition0(i, flat[t, corner])
        model.addStrainTriangleConstraint(*corners, *stretch[t].tolist(), float(shear[t]), True, True)
