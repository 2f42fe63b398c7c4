"""Scenes as models of Newton, the physics engine of newton-physics (https://github.com/newton-physics/newton), version 1.8.

Its solvers read the same arrays with different laws, so stiffness follows from the energy of each element. A hinge with the
angle θ, edge e and triangles of areas A₁ and A₂ has ∂²U/∂θ² = K = D|e|²/(A₁+A₂) at rest; there it is:

| Solver | ∂²U/∂θ² for ``edge_ke`` κ | κ |
|---|---|---|
| semi-implicit | κ·2A·|e| | K/(2A|e|) |
| xpbd | κ·2A | K/(2A) |
| vbd | κ|e| | K/|e| |
| style3d | 3κ|e|²/(A₁+A₂) | D/3 |

In the first two, the gradient of the angle is not divided by the length of the normals, so both triangles must have the area A.
style3d bends as :class:`warpcloth.QuadraticBending`; the others have angles.

Damping of vbd, ½(κ′|e|/h)(θ − θₙ)² for ``edge_kd`` κ′, is that of :class:`warpcloth.DihedralBending` with β for D; the others
refuse it.

For membranes, ``tri_ke`` is μ, and ``tri_ka`` λ in vbd, λ + μ in semi-implicit. style3d has no springs and no lateral
contraction; its moduli are measured, :func:`panel_moduli`.
"""

import contextlib
import io
from typing import NamedTuple

import numpy as np
import warp as wp

from ..kernels.terms.dihedral_bending import rest_state
from ..mesh.mesh import Mesh
from ..run.equilibrium import equilibrium
from ..scene.colliders import Box, Capsule, Plane, Sphere
from ..scene.mesh_collider import MeshCollider
from ..scene.scene import Pins, Scene
from ..terms import DihedralBending, NeoHookeanMembrane, QuadraticBending, Spring
from ..terms.membrane import IsotropicMembrane

METHODS = ("semi-implicit", "xpbd", "vbd", "style3d")
_BENDING = (QuadraticBending, DihedralBending)
# The energies that each solver has, or that a test of a strip can calibrate.
TAKES = {
    "semi-implicit": (Spring, NeoHookeanMembrane, *_BENDING),
    "xpbd": (Spring, *_BENDING),
    "vbd": (Spring, NeoHookeanMembrane, *_BENDING),
    "style3d": (Spring, IsotropicMembrane, *_BENDING),
}
_EQUAL = 1e-3  # relative difference of areas that counts as none
_SLIGHT = 1e-6  # friction of cloth on itself in place of none, so that a mean with it is not 0
_STRAIN = 1e-4  # of cloth that is pulled to measure its moduli


class PanelModuli(NamedTuple):
    """Moduli of flat cloth under small strains [N/m].

    Attributes:
        along: Force per width and strain along each axis with free sides, (2,).
        shear: Force per length and angle of shear.
    """

    along: np.ndarray
    shear: float


def engine():
    """Returns the module ``newton``.

    Raises:
        ImportError: It is not installed.
    """
    try:
        import newton
    except ImportError:
        raise ImportError("a comparison with the Newton engine needs it: pip install -e '.[newton]' in the checkout") from None
    return newton


def newton_model(scene, method, device="cpu"):
    """Returns a scene as a ``newton.Model``, with float32 arrays in the order of the scene.

    Pins are not active, with inverse mass 0. Contact begins at the contact distance, the radius of particles, with the
    stiffness of warpcloth times the mean vertex area.

    Args:
        scene: The :class:`warpcloth.Scene`.
        method: One of :data:`METHODS`.
        device: A Warp device.

    Raises:
        ImportError: Newton is not installed.
        ValueError: The scene has something that the solver lacks.
    """
    newton = engine()
    refuse_inexpressible(scene, method)
    points, held = scene.mesh.points, np.zeros(len(scene.mesh.points), dtype=bool)
    held[scene.fixed] = True
    flags = np.where(held, 0, int(newton.ParticleFlags.ACTIVE)).tolist()
    radius = scene.contact.distance if scene.colliders else 0.0
    if scene.self_contact is not None:
        radius = max(radius, 0.5 * scene.self_contact.distance)
    builder = newton.ModelBuilder(gravity=tuple(scene.gravity.tolist()))
    if method == "style3d":
        _add_style3d(builder, scene, newton.solvers)
        for name, values in (("mass", scene.vertex_masses), ("flags", flags), ("radius", np.full(len(points), radius))):
            setattr(builder, f"particle_{name}", np.asarray(values).tolist())
    else:
        still = np.zeros_like(points).tolist()
        masses, radii = scene.vertex_masses.tolist(), np.full(len(points), radius).tolist()
        builder.add_particles(points.tolist(), still, masses, radius=radii, flags=flags)
        for term in scene.terms:
            _add_term(builder, scene, term, method)
        if scene.self_contact is not None:
            _add_surface(builder, scene.mesh)
    builder.particle_q, builder.particle_qd = scene.positions.tolist(), scene.velocities.tolist()
    for collider in scene.colliders:
        _add_collider(builder, collider, newton)
    if method == "vbd":
        _colour(builder)
    with wp.ScopedDevice(device):
        model = builder.finalize()
    model.particle_inv_mass.assign(np.where(held, 0.0, 1.0 / np.where(held, 1.0, scene.vertex_masses)).astype(np.float32))
    model.particle_grid, model.particle_max_radius = None, 0.0  # without contact between particles
    if scene.colliders or scene.self_contact is not None:
        _set_contact(model, scene)
    return model


def newton_solver(model, scene, method, iterations):
    """Returns the solver of Newton for a model of :func:`newton_model`; semi-implicit steps have no iterations."""
    solvers = engine().solvers
    if method == "semi-implicit":
        return solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    if method == "xpbd":
        return solvers.SolverXPBD(model, iterations=iterations)
    if method == "style3d":
        with contextlib.redirect_stdout(io.StringIO()):  # it prints how long it took
            solver = solvers.SolverStyle3D(model, config=solvers.SolverStyle3D.Config(iterations=iterations))
        solver.collision = solver.collision if scene.colliders else None
        return solver
    given = {"rigid_soft_contact_use_log_barrier": True}  # the law of warpcloth, for contact with colliders
    if scene.self_contact is not None:
        distance = float(scene.self_contact.distance)
        given |= {"particle_enable_self_contact": True, "particle_self_contact_margin": distance}
        given |= {"particle_self_contact_gap": distance, "particle_topological_contact_filter_threshold": 1}
    return solvers.SolverVBD(model, iterations=iterations, **given)


def refuse_inexpressible(scene, method):
    """Raises ValueError with what a solver of Newton lacks to run a scene."""
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {', '.join(METHODS)}")
    whose = f"Newton's {method} solver"

    def refuse(what):
        raise ValueError(f"{whose} has no {what}; the scene {scene.name!r} has")

    if scene.locked is not None:
        refuse("vertices that move along some axes only")
    if scene.pins.moves:
        refuse("pins with keyframes in this comparison")
    if scene.loads:
        refuse("loads in this comparison")
    if scene.air_terms:
        refuse("air with warpcloth's law of drag")
    if scene.self_contact is not None and method != "vbd":
        refuse("self-contact by a distance in this comparison")
    for collider in scene.colliders:
        if collider.moves or collider.deforms.any():
            refuse(f"moving colliders in this comparison, such as {collider.label}")
        if collider.friction != scene.colliders[0].friction:
            refuse(f"friction that differs between colliders, as that of {collider.label} from {scene.colliders[0].label}")
    if scene.colliders and not np.isfinite(scene.contact.stiffness):
        refuse("infinite stiffness of contact")
    if scene.colliders and scene.self_contact is not None and scene.self_contact.stiffness > 2.0 * scene.contact.stiffness:
        refuse("self-contact that is more than twice as stiff as contact with colliders")
    for term in scene.terms:
        if not isinstance(term, TAKES[method]):
            names = ", ".join(each.__name__ for each in TAKES[method])
            raise ValueError(f"{whose} does not take {type(term).__name__} of the scene {scene.name!r}, only {names}")
        if not np.isfinite(term.stiffness).all():
            refuse(f"infinite stiffness, as that of {term.label}")
        damped = {"vbd": (Spring, *_BENDING), "style3d": ()}.get(method, (Spring,))
        if np.any(term.damping or 0.0) and not isinstance(term, damped):
            refuse(f"damping with warpcloth's law for {term.label}")
    if method == "style3d":
        _refuse_style3d(scene)


def panel_moduli(scene):
    """Returns the :class:`PanelModuli` of a cloth that is flat along two axes of space with a straight end, by pulling and
    shearing it.
    """
    axes = _plane_axes(scene.mesh)
    return PanelModuli(np.array([_strip_modulus(scene, axes, i) for i in (0, 1)]), _shear_modulus(scene, axes))


def _strip_modulus(scene, axes, i):
    """Returns the modulus E of cloth pulled along an axis with free sides [N/m], from the energy ½Eε² per area."""
    mesh, (along, across) = scene.mesh, (axes[i], axes[1 - i])
    x = mesh.points @ along
    near = 1e-6 * np.ptp(x)
    low, high = np.flatnonzero(x < x.min() + near), np.flatnonzero(x > x.max() - near)
    if max(len(low), len(high)) < 2:
        raise ValueError(f"the cloth of the scene {scene.name!r} must have a straight end, to be pulled as a strip")
    letters = ["xyz"[int(axis.argmax())] for axis in (along, across)]
    ends = np.concatenate([low, high])
    moved = mesh.points[ends] + np.outer(np.isin(ends, high) * _STRAIN * np.ptp(x), along)
    free = np.ones((len(x), 3), dtype=bool)
    free[:, int((along + across).argmin())] = False
    pins = Pins(ends, [mesh.points[ends], moved], ["".join(letters), *([letters[0]] * (len(ends) - 1))])
    stretched = Scene(
        mesh,
        masses=scene.vertex_masses,
        terms=[term for term in scene.terms if not isinstance(term, _BENDING)],
        pins=pins,
        gravity=np.zeros(3),
        free_axes=free,
        name=f"a strip of {scene.name}",
    )
    rest = equilibrium(stretched, record="energies")
    return 2.0 * sum(rest.energies.values()) / (_STRAIN**2 * float(np.nansum(mesh.triangle_areas)))


def _shear_modulus(scene, axes):
    """Returns the energy under a small shear γ over ½γ² and the area [N/m]."""
    mesh, found = scene.mesh, 0.0
    for term in scene.terms:
        if isinstance(term, Spring):
            springs = term.elements(mesh, scene.positions)
            d = (mesh.points[springs.stencil[:, 1]] - mesh.points[springs.stencil[:, 0]]) @ axes.T
            found += float((springs.stiffness * (d[:, 0] * d[:, 1]) ** 2 / (d**2).sum(axis=1)).sum())
        elif isinstance(term, IsotropicMembrane):
            stencil, mu, _lam = lame(term, scene)
            found += float(np.nan_to_num(Mesh(mesh.points, stencil).triangle_areas) @ mu)
    return found / float(np.nansum(mesh.triangle_areas))


def _add_term(builder, scene, term, method):
    if isinstance(term, Spring):
        found = term.elements(scene.mesh, scene.positions)
        count = len(found.stencil)
        builder.spring_indices += found.stencil.ravel().tolist()
        builder.spring_rest_length += found.rest[:, 0].tolist()
        builder.spring_stiffness += np.broadcast_to(found.stiffness, count).tolist()
        builder.spring_damping += np.broadcast_to(found.damping, count).tolist()
        builder.spring_control += [0.0] * count
    elif isinstance(term, _BENDING):
        hinges, ke, kd, angle = _hinges(term, scene, method)
        i, j, k, l = (hinges[:, c].tolist() for c in (2, 3, 0, 1))
        builder.add_edges(i, j, k, l, rest=angle.tolist(), edge_ke=ke.tolist(), edge_kd=kd.tolist())
    else:
        stencil, mu, lam = lame(term, scene)
        ka, none = (lam if method == "vbd" else lam + mu), [0.0] * len(mu)
        given = {"tri_ke": mu.tolist(), "tri_ka": ka.tolist(), "tri_kd": none, "tri_drag": none, "tri_lift": none}
        builder.add_triangles(*(stencil[:, c].tolist() for c in range(3)), **given)


def _hinges(term, scene, method):
    """Returns the hinges (E, 4), ``edge_ke`` and ``edge_kd`` by the table, and rest angles [rad] (E,)."""
    found, points = term.elements(scene.mesh, scene.positions), scene.mesh.points
    stiffness, damping = (np.broadcast_to(each, len(found.stencil)) for each in (found.stiffness, found.damping))
    angle, shape = rest_state(points, found.stencil).T
    angle = angle if isinstance(term, DihedralBending) else np.zeros_like(angle)
    if method == "style3d":
        return found.stencil, stiffness / 3.0, damping, angle
    x0, x1, x2, x3 = (points[found.stencil[:, i]] for i in range(4))
    edge = np.linalg.norm(x1 - x0, axis=1)
    if method == "vbd":
        return found.stencil, stiffness * shape / edge, damping * shape / edge, angle
    first, second = (np.linalg.norm(np.cross(x1 - x0, x - x0), axis=1) for x in (x2, x3))
    for e in np.flatnonzero(np.abs(first - second) > _EQUAL * np.maximum(first, second))[:1]:
        raise ValueError(
            f"Newton's {method} solver scales the forces of a hinge with the areas of its triangles, so both must be equal; "
            f"hinge {e} of {term.label} has {0.5 * first[e]:.3g} and {0.5 * second[e]:.3g} m²"
        )
    both = 0.5 * (first + second)
    return found.stencil, stiffness * shape / (both if method == "xpbd" else both * edge), damping, angle


def _add_surface(builder, mesh):
    """Adds triangles and edges of a mesh without energy, for self-contact."""
    known = {frozenset(each) for each in np.reshape(builder.tri_indices, (-1, 3)).tolist()}
    stencil = np.array([each for each in mesh.triangles.tolist() if frozenset(each) not in known], dtype=int).reshape(-1, 3)
    none = [0.0] * len(stencil)
    given = dict.fromkeys(("tri_ke", "tri_ka", "tri_kd", "tri_drag", "tri_lift"), none)
    builder.add_triangles(*(stencil[:, c].tolist() for c in range(3)), **given)
    known = {frozenset(each[2:]) for each in np.reshape(builder.edge_indices, (-1, 4)).tolist()}
    edges = np.array([each for each in mesh.edges.tolist() if frozenset(each) not in known], dtype=int).reshape(-1, 2)
    lone, none = [-1] * len(edges), [0.0] * len(edges)  # without triangles beside it, an edge does not bend
    builder.add_edges(lone, lone, *(edges[:, c].tolist() for c in range(2)), rest=none, edge_ke=none, edge_kd=none)


def lame(term, scene):
    """Returns the triangles (T, 3) of an isotropic membrane, μ and λ (T,) [N/m]."""
    found = term.elements(scene.mesh, scene.positions)
    count = len(found.stencil)
    k = np.broadcast_to(found.stiffness, count)
    ratio = np.broadcast_to(term.of_elements("poisson_ratio", count), count)
    return found.stencil, k / (2.0 * (1.0 + ratio)), k * ratio / (1.0 - ratio**2)


def _plane_axes(mesh):
    """Returns two axes of space (2, 3) in the plane of a flat mesh, whose product is its normal, or None."""
    normals = np.cross(*(mesh.points[mesh.triangles[:, i]] - mesh.points[mesh.triangles[:, 0]] for i in (1, 2)))
    axis = int(np.abs(normals).sum(axis=0).argmax())
    off = np.abs(np.delete(normals, axis, axis=1)).max()
    size = np.abs(normals).max()
    if off > 1e-6 * size or not (np.sign(normals[:, axis]) == np.sign(normals[0, axis])).all():
        return None
    axes = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]]
    return axes if normals[0, axis] > 0.0 else axes[::-1]


def _refuse_style3d(scene):
    whose = "Newton's style3d solver"
    if not len(scene.mesh.triangles) or _plane_axes(scene.mesh) is None:
        raise ValueError(
            f"{whose} has flat panels only; the cloth of the scene {scene.name!r} must be flat at rest, along two axes"
        )
    stretching = [term for term in scene.terms if not isinstance(term, _BENDING)]
    bending = [term for term in scene.terms if isinstance(term, _BENDING)]
    if not stretching or len(bending) > 1 or any(term.part is not None for term in scene.terms):
        raise ValueError(
            f"{whose} has one stiffness of the whole cloth in stretch and one in bending; the scene {scene.name!r} must have "
            "springs or membranes, and at most one bending energy"
        )
    for term in stretching:
        rest = term.elements(scene.mesh, scene.positions)
        if isinstance(term, Spring) and not np.allclose(rest.rest, term.term.rest_state(scene.mesh.points, rest.stencil)):
            raise ValueError(f"{whose} has no rest lengths other than those of the mesh; {term.label} has")


def _add_style3d(builder, scene, solvers):
    mesh, axes = scene.mesh, _plane_axes(scene.mesh)
    moduli = panel_moduli(scene)
    solvers.SolverStyle3D.register_custom_attributes(builder)
    nothing = wp.vec3(0.0, 0.0, 0.0)
    solvers.style3d.add_cloth_mesh(
        builder,
        pos=nothing,
        rot=wp.quat_identity(),
        vel=nothing,
        vertices=[wp.vec3(*point) for point in mesh.points.tolist()],
        indices=mesh.triangles.ravel().tolist(),
        panel_verts=[wp.vec2(*point) for point in (mesh.points @ axes.T).tolist()],
        density=0.0,
        tri_aniso_ke=wp.vec3(*moduli.along.tolist(), moduli.shear),
        edge_aniso_ke=nothing,
        tri_kd=0.0,
        edge_kd=0.0,
        particle_radius=0.0,
    )
    ke = {}
    for term in (each for each in scene.terms if isinstance(each, _BENDING)):
        hinges, values, _damping, _angle = _hinges(term, scene, "style3d")
        ke = {frozenset(ends): value for ends, value in zip(hinges[:, :2].tolist(), values.tolist(), strict=True)}
    edges = [frozenset(edge[2:]) for edge in np.asarray(builder.edge_indices).tolist()]
    builder.edge_bending_properties = [(ke.get(ends, 0.0), 0.0) for ends in edges]


def _add_collider(builder, collider, newton):
    """Adds a static shape; planes and capsules are along z there."""
    *position, x, y, z, w = collider.poses[0].tolist()
    upright = wp.quat(x, y, z, w) * wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), -0.5 * wp.pi)
    turn = upright if isinstance(collider, Plane | Capsule) else wp.quat(x, y, z, w)
    cfg = newton.ModelBuilder.ShapeConfig(density=0.0, mu=float(collider.friction), kd=0.0)
    given = {"xform": wp.transform(wp.vec3(*position), turn), "body": -1, "cfg": cfg, "label": collider.label}
    if isinstance(collider, Plane):
        builder.add_shape_plane(width=0.0, length=0.0, **given)
    elif isinstance(collider, Sphere):
        builder.add_shape_sphere(radius=float(collider.radius), **given)
    elif isinstance(collider, Capsule):
        builder.add_shape_capsule(radius=float(collider.radius), half_height=0.5 * float(collider.length), **given)
    elif isinstance(collider, Box):
        hx, hy, hz = (0.5 * collider.size).tolist()
        builder.add_shape_box(hx=hx, hy=hy, hz=hz, **given)
    elif isinstance(collider, MeshCollider):
        points = collider.points if collider.points.ndim == 2 else collider.points[0]
        mesh = newton.Mesh(points.astype(np.float32), collider.triangles.ravel().astype(np.int32), compute_inertia=False)
        builder.add_shape_mesh(mesh=mesh, **given)
    else:
        raise ValueError(f"a model of Newton has no shape {type(collider).__name__}, as {collider.label} is")


def _set_contact(model, scene):
    """Sets stiffness and friction of contact.

    A particle and a shape have the arithmetic mean of stiffness and the geometric mean of friction, cloth with itself those of
    particles.
    """
    areas = scene.mesh.vertex_areas if len(scene.mesh.triangles) else scene.vertex_masses / scene.vertex_masses.mean()
    area, declared = float(areas.mean()), scene.self_contact
    stiffness, friction = (declared.stiffness, declared.friction) if declared else (0.0, 0.0)
    if scene.colliders:
        friction = max(friction, _SLIGHT) if declared else scene.colliders[0].friction
        stiffness = stiffness or scene.contact.stiffness
        model.shape_material_ke.fill_(area * (2.0 * scene.contact.stiffness - stiffness))
        model.shape_material_mu.fill_(scene.colliders[0].friction ** 2 / friction if friction else 0.0)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = area * float(stiffness), 0.0, float(friction)


def _colour(builder):
    """Colours particles by Newton's method, which ignores springs, so that no element joins two of one colour."""
    stencils = [np.reshape(each, (-1, size)) for each, size in ((builder.spring_indices, 2), (builder.tri_indices, 3))]
    stencils.append(np.reshape(builder.edge_indices, (-1, 4)))
    pairs = [each[:, [i, j]] for each in stencils for j in range(each.shape[1]) for i in range(j)]
    pairs = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0).astype(np.int32)
    pairs = pairs[pairs[:, 0] >= 0]
    with wp.ScopedDevice("cpu"):
        edges, colours = wp.array(pairs, dtype=int), wp.empty(len(builder.particle_q), dtype=int)
        count = wp.utils.graph_coloring_assign(edges, colours, wp.utils.GraphColoringAlgorithm.MCS)
        wp.utils.graph_coloring_balance(edges, colours, count, 1.1)
    builder.set_coloring([np.flatnonzero(colours.numpy() == colour) for colour in range(count)])
