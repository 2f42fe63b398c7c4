"""Scenes as scenes of libuipc 0.0.29 (https://github.com/spiriMirror/libuipc): incremental potential contact on CUDA.

Its parameters follow from its energies, t half of the cloth's thickness, C = FᵀF of a triangle:

| Energy | Element there | Its energy | Its parameters |
|---|---|---|---|
| `Spring` | stitch of two vertices | ½κ(l − L)² | κ = k, L |
| `NeoHookeanMembrane`, `StVKMembrane` | Neo-Hookean shell | 2tA(½μ(tr C − 2 − 2 ln J) + ½λ(ln J)²) | μ/2t, λ/2t |
| `QuadraticBending`, `DihedralBending` | bending of a discrete shell | 3κ|e|²/(A₁+A₂)(θ − θ̄)² | κ = D/6 |

Membranes agree for small strains, quadratic bending for small angles; steps are implicit Euler's.

Contact differs: elements at a distance d below w have the energy −κ(d² − w²)² ln(d²/w²). It begins at r; κ = kAr/((3 ln 4 +
4.5)w³) gives a vertex of mean area A the force of warpcloth at d = w/2, kAr/2. Cloth with itself has w = r, bodies the mean of
a width of cloth and of body; planes have no width and are moved along normals. Friction is smoothed below 0.01 m/s.
"""

import numpy as np

from ..kernels.terms.dihedral_bending import rest_state
from ..scene.colliders import Box, Capsule, Plane, Sphere, turned
from ..scene.mesh_collider import MeshCollider
from ..terms import DihedralBending, QuadraticBending, Spring
from ..terms.membrane import IsotropicMembrane
from .newton_model import lame

_BENDING, _SHAPES = (QuadraticBending, DihedralBending), (Plane, Sphere, Capsule, Box, MeshCollider)
TAKES = (Spring, IsotropicMembrane, *_BENDING)
_THIN = 1e-3  # t over the distance of self-contact, which begins 2t further away
_HALFWAY = 3.0 * np.log(4.0) + 4.5  # twice the force at d = w/2, over κw³


def engine():
    """Returns the module ``uipc``, without its messages.

    Raises:
        ImportError: It is not installed, or cannot be loaded.
    """
    try:
        import uipc
    except (ImportError, OSError) as error:
        need = "a comparison with libuipc needs it and CUDA: pip install -e '.[uipc]' in the checkout"
        raise ImportError(f"{need} ({error})") from None
    uipc.Logger.set_level(uipc.Logger.Level.Off)
    return uipc


def uipc_scene(scene, dt, iterations=1):
    """Returns a scene as a ``uipc.Scene`` for steps ``dt`` [s] of at least ``iterations``, vertices in its order.

    Raises:
        ImportError: libuipc is not installed.
        ValueError: The scene has something that libuipc lacks.
    """
    uipc = engine()
    refuse_inexpressible(scene)
    (outer, own), touching, config = _distances(scene), scene.self_contact, uipc.Scene.default_config()
    config["dt"], config["gravity"] = float(dt), scene.gravity[:, None].tolist()
    config["newton"]["min_iter"] = config["newton"]["semi_implicit"]["K_min"] = iterations - 1
    config["contact"] |= {"enable": int(bool(scene.colliders) or touching is not None), "d_hat": own}
    config["sanity_check"]["mode"] = "quiet"  # without files
    made = uipc.Scene(config)
    contacts = made.contact_tabular()
    contacts.default_model(0.0, 1.0, False)  # without contact, except for the pairs below
    cloth, force = contacts.create("cloth"), float(scene.mesh.vertex_areas.mean()) / _HALFWAY
    _add_cloth(made, scene, cloth, _THIN * own, uipc)
    if touching is not None:
        contacts.insert(cloth, cloth, touching.friction, touching.stiffness * force / own**2)
    for collider in scene.colliders:
        width, element = own if isinstance(collider, Plane) else outer, contacts.create(collider.label)
        contacts.insert(cloth, element, collider.friction, scene.contact.stiffness * force * outer / width**3)
        _add_collider(made, collider, element, outer, own, uipc)
    return made


def refuse_inexpressible(scene):
    """Raises ValueError with what libuipc lacks to run a scene; this does not need libuipc."""
    mesh, (outer, own) = scene.mesh, _distances(scene)
    refused = {
        "vertices outside of triangles in this comparison": not (mesh.vertex_areas > 0.0).all(),
        "vertices that move along some axes only": scene.locked is not None,
        "pins with keyframes in this comparison": scene.pins.moves,
        "loads in this comparison": scene.loads,
        "air": scene.air_terms,
        "infinite stiffness of contact": scene.colliders and not np.isfinite(scene.contact.stiffness),
        "self-contact that begins at more than twice the distance of contact with colliders": own > 2.0 * outer,
    }
    for collider in scene.colliders:
        refused[f"moving colliders in this comparison, as {collider.label} is"] = collider.moves or collider.deforms.any()
        refused[f"shape {type(collider).__name__}, as {collider.label} is"] = not isinstance(collider, _SHAPES)
    for term in scene.terms:
        if not isinstance(term, TAKES):
            names = ", ".join(each.__name__ for each in TAKES)
            raise ValueError(f"libuipc does not take {type(term).__name__} of the scene {scene.name!r}, only {names}")
        refused[f"infinite stiffness, as that of {term.label}"] = not np.isfinite(term.stiffness).all()
        refused[f"damping with warpcloth's law, as that of {term.label}"] = np.any(term.damping or 0.0)
        if isinstance(term, _BENDING):
            hinges = term.elements(mesh, scene.positions).stencil
            bent = isinstance(term, QuadraticBending) and (np.abs(rest_state(mesh.points, hinges)[:, 0]) > 1e-6).any()
            shared = len(np.unique(np.sort(hinges[:, :2]), axis=0)) < len(hinges)
            refused[f"hinges of more than two triangles, as those of {term.label}"] = shared
            refused[f"bending that is flat at rest on a mesh that is not, as {term.label} is"] = bent
    for what, has in refused.items():
        if has:
            raise ValueError(f"libuipc has no {what}; the scene {scene.name!r} has")


def _distances(scene):
    """Returns the distances [m] of contact with colliders and with itself; each defaults to the other, or to 1 mm."""
    outer, own = scene.colliders and scene.contact.distance, scene.self_contact and scene.self_contact.distance
    return float(outer or own or 1e-3), float(own or outer or 1e-3)


def _add_cloth(made, scene, element, half, uipc):
    law, view, mesh = uipc.constitution, uipc.view, scene.mesh
    rest = uipc.geometry.trimesh(mesh.points.copy(), mesh.triangles.astype(np.int32))
    uipc.geometry.label_surface(rest)
    if membranes := [term for term in scene.terms if isinstance(term, IsotropicMembrane)]:
        law.NeoHookeanShell().apply_to(rest, law.ElasticModuli2D.lame(0.0, 0.0), 1.0, half)
        for term in membranes:
            stencil, *moduli = lame(term, scene)
            for name, values in zip(("mu", "lambda"), moduli, strict=True):
                view(rest.triangles().find(name))[_indices(mesh.triangles, stencil)] += values / (2.0 * half)
    else:
        law.Empty().apply_to(rest, 1.0, half)
    if bending := [term for term in scene.terms if isinstance(term, _BENDING)]:
        law.DiscreteShellBending().apply_to(rest, 0.0)
        edges, kappa = view(rest.edges().topo()).reshape(-1, 2), view(rest.edges().find("bending_stiffness"))
        for term in bending:
            found = term.elements(mesh, scene.positions)
            kappa[_indices(edges, found.stencil[:, :2])] += found.stiffness / 6.0
    vertices, names = rest.vertices(), uipc.builtin
    view(vertices.create(names.mass_density, 0.0))[:] = scene.vertex_masses / view(vertices.find(names.volume))
    view(vertices.find(names.velocity))[:] = scene.velocities[:, :, None]
    view(vertices.find(names.is_fixed))[scene.fixed] = 1
    element.apply_to(rest)
    start = rest.copy()
    view(start.positions())[:] = scene.positions[:, :, None]
    cloth, _rest = made.objects().create("cloth").geometries().create(start, rest)
    for term in (each for each in scene.terms if isinstance(each, Spring)):
        found = term.elements(mesh, scene.positions)
        springs = law.SoftVertexStitch().create_geometry((cloth, cloth), found.stencil.astype(np.int32), 0.0, 0.0)
        view(springs.instances().find("kappa"))[:] = found.stiffness
        view(springs.instances().find("rest_length"))[:] = found.rest[:, 0]
        made.objects().create(term.label).geometries().create(springs)


def _indices(rows, sought):
    index = {frozenset(row): i for i, row in enumerate(rows.tolist())}
    return [index[frozenset(row)] for row in sought.tolist()]


def _add_collider(made, collider, element, outer, own, uipc):
    """Adds a half-space or a fixed body, of any stiffness [Pa] and density [kg/m³]."""
    law, pose = uipc.constitution, collider.poses[0]
    if isinstance(collider, Plane):
        normal = turned(pose[3:], np.array([0.0, 1.0, 0.0]))
        shape = uipc.geometry.halfplane(pose[:3] + (outer - own) * normal, normal)
    else:
        points, triangles = _surface(collider)
        shape = uipc.geometry.trimesh(pose[:3] + turned(pose[3:], points), triangles.astype(np.int32))
        uipc.geometry.label_surface(shape)
        given = (_THIN * own,) if collider.is_mesh else ()  # a mesh need not enclose a volume
        (law.AffineBodyShell if given else law.AffineBodyConstitution)().apply_to(shape, 1e8, 1e3, *given)
        uipc.view(shape.instances().find(uipc.builtin.is_fixed))[:] = 1
        shape.meta().create(uipc.builtin.d_hat, 2.0 * outer - own)
    element.apply_to(shape)
    made.objects().create(collider.label).geometries().create(shape)


def _surface(collider):
    if collider.is_mesh:
        return collider.frames[0], collider.triangles
    from trimesh import creation

    if isinstance(collider, Capsule):
        found = creation.capsule(collider.length, collider.radius, (64, 64))
    else:
        found = creation.box(collider.size) if isinstance(collider, Box) else creation.icosphere(4, collider.radius)
    points = np.array(found.vertices - found.bounds.mean(axis=0))
    return points[:, [0, 2, 1]] * [1.0, 1.0, -1.0] if isinstance(collider, Capsule) else points, found.faces  # capsules along y
