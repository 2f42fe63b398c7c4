"""Reads and writes cloth by the names of the AOUSD proposal for deformable bodies and of Newton, the physics engine.

Two laws, in docs/usd.md, give the names a meaning. K, G and D are `surfaceStretchStiffness`, `surfaceShearStiffness` [N/m] and
`surfaceBendStiffness` [N·m], t is the thickness; a hinge has the edge e and triangles of areas A₁ and A₂:

| Name | "proposal" | "newton" |
|---|---|---|
| K | Et/(1 − ν²) | μ, with λ = 0 |
| G | shear modulus times thickness | not read |
| D | bending stiffness of the plate | κ of ½κ|e|θ², in N |

The second is that of the importer of Newton 1.8 for VBD. Without K or D, both laws take Et/(1 − ν²) and Et³/12(1 − ν²) from
`youngsModulus` and `poissonsRatio`. One stiffness D has κ = D|e|/(A₁ + A₂) at a hinge; as the importer has one κ, that of equal
energy, averaged over directions, is written: D Σ(A₁ + A₂)/Σ((A₁ + A₂)²/|e|).
"""

import warnings
from typing import NamedTuple

import numpy as np

from ..terms import Attachment, DihedralBending, NeoHookeanMembrane, OrthotropicMembrane, QuadraticBending, StVKMembrane
from ..terms.membrane import Membrane
from .attributes import Values
from .modules import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
from .stage import local_to_metres, moving_space, placed, space_codes
from .values import array_of, refuse_outside, value_of

LAWS = ("proposal", "newton")
THICKNESS = 1e-3  # [m], the default of the proposal
_POISSON = 0.3  # its default too
_AGREE = 1e-2  # relative difference above which a stretch stiffness and that by Young's modulus disagree
_SAME = 1e-5  # relative difference of products of float32 that counts as none
_NEAR = 1e-5  # distance of an anchor from its point, relative to size and position of the cloth, that counts as none


def thickness_of(values):
    """Returns the thickness [m] that the names give, or None; refuses one that varies, and mass models but shell and solid."""
    _token(values, "(mass model)", "newton:massModel", "shell", "solid")
    several = values.get("(thicknesses)")
    if several is None:
        shell = values.get("(shell thickness)") if values.get("(mass model)") == "shell" else None
        return values.get("(thickness)") or (None if shell is None or not shell > 0.0 else float(shell))
    if not len(several) or (several != several[0]).any() or not several[0] > 0.0:
        raise ValueError("physics:thicknesses has several values or none above 0, must be one thickness of the whole cloth")
    return float(several[0])


def masses_of(values, mesh):
    """Returns masses (n,) [kg] from `physics:masses`, or None; those of faces, or of the whole, are spread over vertices by
    area.
    """
    masses = values.get("(masses)")
    if masses is None:
        return None
    kind, count = values.get("(masses of)") or "point", len(mesh.points)
    wanted = {"point": count, "constant": 1, "face": len(mesh.triangles)}
    if kind not in wanted:
        raise ValueError(f"physics:masses:elementType is {kind!r}, must be one of {', '.join(wanted)}")
    if len(masses) != wanted[kind]:
        raise ValueError(f"physics:masses has {len(masses)} values, must have {wanted[kind]} for its element type {kind!r}")
    if kind == "point":
        return masses.astype(np.float64)
    if kind == "constant":
        areas = mesh.vertex_areas
        return float(masses[0]) * areas / areas.sum()
    return np.bincount(mesh.triangles.ravel(), np.repeat(masses / 3.0, 3), count)


def terms_of(values, mesh, law, where):
    """Returns the terms of a surface material by a law; none if it has no stiffness.

    Raises:
        ValueError: There is a stiffness in shear alone, or a value is not allowed.

    Warns:
        UserWarning: There is only a bending stiffness, one is not read, or Young's modulus gives another stretch stiffness.
    """
    names = ("stretch stiffness", "shear stiffness", "bend stiffness", "Young's modulus", "Poisson's ratio")
    stretch, shear, bend, modulus, ratio = (values.get(f"({name})") for name in names)
    given, ratio = ratio is not None, _POISSON if ratio is None else float(ratio)
    if not -1.0 < ratio < 1.0:
        raise ValueError(f"physics:poissonsRatio is {ratio}, must be above -1 and below 1")
    if modulus is not None:
        t = thickness_of(values) or THICKNESS
        plate = modulus * t / (1.0 - ratio**2)
        stretch = plate if stretch is None else stretch
        if abs(stretch - plate) > _AGREE * max(stretch, plate):
            other = f"physics:youngsModulus gives {plate:.4g} N/m with a thickness of {t:.4g} m"
            warnings.warn(
                f"{where}: physics:surfaceStretchStiffness is {stretch:.4g} N/m and is used, but {other}", stacklevel=2
            )
        bend = modulus * t**3 / (12.0 * (1.0 - ratio**2)) if bend is None else bend
    if stretch is None and shear is not None:
        raise ValueError("physics:surfaceShearStiffness is given without a surfaceStretchStiffness or a youngsModulus")
    if stretch is None and bend is not None:
        lacking = "physics:surfaceStretchStiffness and physics:youngsModulus are not given, or 0"
        warnings.warn(f"{where}: {lacking}, so the cloth resists bending only", stacklevel=2)
    angles = _token(values, "(rest angles)", "physics:restBendAnglesDefault", "flat", "restShape")
    terms = []
    if stretch is not None and law == "newton":
        terms.append(NeoHookeanMembrane.from_moduli(mu=float(stretch), lam=0.0))
        if shear is not None:
            warnings.warn(f"{where}: physics:surfaceShearStiffness is not read, as by the importer of Newton", stacklevel=2)
    elif stretch is not None:
        terms.append(_membrane(float(stretch), shear, ratio, given, mesh))
    if bend is not None:
        kind = DihedralBending if angles == "restShape" else QuadraticBending
        terms.append(kind(stiffness=float(bend) if law == "proposal" else bend / _kappa(mesh)))
    return terms


def _token(values, field, name, *allowed):
    value = values.get(field)
    if value is not None and value not in allowed:
        raise ValueError(f"{name} is {value!r}, must be one of {', '.join(allowed)}")
    return value


def _membrane(stretch, shear, ratio, given, mesh):
    """Returns the membrane with K = Et/(1 − ν²) and the shear modulus Gt, isotropic if these agree with ν."""
    if shear is None:
        return NeoHookeanMembrane(stiffness=stretch * (1.0 - ratio**2), poisson_ratio=ratio)
    shear = float(shear)
    isotropic = 1.0 - 2.0 * shear / stretch
    if -1.0 < isotropic < 1.0 and (not given or abs(isotropic - ratio) < _SAME):
        return NeoHookeanMembrane(stiffness=2.0 * shear * (1.0 + isotropic), poisson_ratio=isotropic)
    k = stretch * (1.0 - ratio**2)
    # The proposal has no direction; its shear is that along the texture, else along the axis in which the cloth is longest.
    axis = None if mesh.texture_coordinates is not None else np.eye(3)[np.ptp(mesh.points, axis=0).argmax()]
    return OrthotropicMembrane(stiffness=k, poisson_ratio=ratio, shear_ratio=shear / k, warp=axis)


def _kappa(mesh):
    """Returns κ/D of each hinge, |e|/(A₁ + A₂) (H,) [1/m]."""
    edges, areas = _hinge_sizes(mesh)
    return edges / areas


def _hinge_sizes(mesh):
    x0, x1, x2, x3 = (mesh.points[mesh.hinges[:, i]] for i in range(4))
    first, second = (0.5 * np.linalg.norm(np.cross(x1 - x0, x - x0), axis=1) for x in (x2, x3))
    return np.linalg.norm(x1 - x0, axis=1), first + second


def _mean_kappa(mesh):
    edges, areas = _hinge_sizes(mesh)
    return areas.sum() / (areas**2 / edges).sum()


class Held(NamedTuple):
    """Vertices that PhysicsAttachments hold.

    Attributes:
        vertices: Pinned vertices (p,).
        keyframes: Their positions (F, p, 3) [m], or None if they stand still.
        terms: Soft attachments.
    """

    vertices: np.ndarray
    keyframes: np.ndarray | None
    terms: list


def attachments_of(stage, cloth, surroundings, start, codes):
    """Returns what the enabled PhysicsAttachments of a cloth hold, with positions (n, 3) [m] at the start.

    Raises:
        ValueError: An attachment is of another kind, or its anchors are not at its points.
    """
    held, moves, terms = [], [], []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() != "PhysicsAttachment" or cloth.GetPath() not in _targets(prim, "physics:src0"):
            continue
        values = Values(stage, prim, "attachment")
        if values.get("(attached)") is not None and not values.get("(attached)"):
            continue
        try:
            vertices, anchors = _anchors(stage, prim, values, surroundings, codes)
            stiffness, damping = values.get("(attachment stiffness)"), values.get("(attachment damping)")
            if stiffness is None or np.isposinf(stiffness):
                apart = np.abs(anchors[0] - start[vertices]).max(initial=0.0)
                if apart > _NEAR * max(np.ptp(start, axis=0).max(), np.abs(start).max()):
                    raise ValueError(f"has an anchor {apart:.3g} m away from its point, must be at it to hold it rigidly")
                held.append(vertices)
                moves.append(anchors - anchors[0] + start[vertices])
            elif len(anchors) > 1:
                raise ValueError("has a finite stiffness and a moving anchor, must have one of them only")
            else:
                given = {} if not damping else {"damping": float(damping)}
                terms.append(
                    Attachment(vertices=vertices, targets=anchors[0], stiffness=float(stiffness), name=prim.GetName(), **given)
                )
        except ValueError as error:
            raise ValueError(f"{prim.GetPath()}: {error}") from error
    if not held:
        return Held(np.empty(0, np.int32), None, terms)
    vertices, first = np.unique(np.concatenate(held), return_index=True)
    frames = max(map(len, moves))
    if frames == 1:
        return Held(vertices, None, terms)
    moves = [np.concatenate([each, np.repeat(each[-1:], frames - len(each), axis=0)]) for each in moves]
    return Held(vertices, np.concatenate(moves, axis=1)[:, first], terms)


def _targets(prim, name):
    relationship = prim.GetRelationship(name)
    return relationship.GetTargets() if relationship else []


def _anchors(stage, prim, values, surroundings, codes):
    for field, allowed in (("(kind of points)", "point"), ("(kind of anchors)", "xform")):
        kind = values.get(field)
        if kind != allowed:
            raise ValueError(f"the {field[1:-1]} is {kind!r}, must be {allowed!r}")
    points = values.get("(held points)")
    if points is None or not len(points):
        raise ValueError("has no physics:indices0, must have the index of a point")
    shown_by = surroundings.point_vertices
    refuse_outside("physics:indices0", points, len(surroundings.mesh.points if shown_by is None else shown_by), "point")
    vertices = (points if shown_by is None else shown_by[points]).astype(np.int32)
    coordinates = values.get("(anchors)")
    coordinates = np.zeros((len(points), 3)) if coordinates is None or not len(coordinates) else coordinates.astype(np.float64)
    if coordinates.shape != (len(points), 3):
        raise ValueError(f"physics:coords1 has {len(coordinates)} anchors, must have one for each of {len(points)} points")
    target = next(iter(_targets(prim, "physics:src1")), None)
    body = stage.GetPrimAtPath(target) if target not in (None, Sdf.Path.absoluteRootPath) else None
    if body is None:
        return vertices, coordinates[None] * UsdGeom.GetStageMetersPerUnit(stage)
    if not body:
        raise ValueError(f"physics:src1 is {target}, must be a prim of the stage")
    if moving_space(body) is None:
        return vertices, placed(coordinates, local_to_metres(body, ""))[None]
    times = codes(space_codes(body))
    return vertices, np.array([placed(coordinates, local_to_metres(body, "", code)) for code in times])


def refuse_other_rest(prim):
    """Raises ValueError if a prim has a rest shape besides its points."""
    for name in ("restShapePoints", "restTriVertexIndices", "restAdjTriPairs", "restBendAngles"):
        attribute = prim.GetAttribute(f"physics:{name}")
        value = value_of(attribute) if attribute else None
        if value is None or not len(value):
            continue
        if name == "restShapePoints" and np.array_equal(value, array_of(UsdGeom.PointBased(prim).GetPointsAttr(), (3,))):
            continue
        raise ValueError(f"physics:{name} is given, must not be: the rest shape is the default value of points")


def define_deformable(layer, scene, law):
    """Writes the standard names of a cloth into a layer of :func:`.layers.scene_layer`.

    The pins are points of the kinematic rigid body /World/Pins.

    Raises:
        ValueError: The law is unknown, or the scene has something without a name.
    """
    material = _material_of(scene, law)
    stage = Usd.Stage.Open(layer)
    cloth = stage.GetPrimAtPath("/World/Cloth")
    for name in ("PhysicsDeformableBodyAPI", "PhysicsSurfaceDeformableSimAPI"):
        cloth.AddAppliedSchema(name)
    if scene.colliders:
        UsdPhysics.CollisionAPI.Apply(cloth)
    t = material.pop("thickness")
    _set(cloth, "thicknesses", Sdf.ValueTypeNames.FloatArray, [t])
    _set(cloth, "thicknesses:elementType", Sdf.ValueTypeNames.Token, "constant")
    angles = "restShape" if any(isinstance(term, DihedralBending) for term in scene.terms) else "flat"
    _set(cloth, "restBendAnglesDefault", Sdf.ValueTypeNames.Token, angles)
    physics = UsdShade.Material.Define(stage, "/World/Looks/ClothPhysics")
    physics.GetPrim().AddAppliedSchema("PhysicsSurfaceDeformableMaterialAPI")
    UsdShade.MaterialBindingAPI(cloth).Bind(physics, materialPurpose="physics")
    for name, value in material.items():
        _set(physics.GetPrim(), name, Sdf.ValueTypeNames.Float, float(value))
    surroundings = UsdPhysics.Scene.Define(stage, "/World/Physics")
    magnitude = float(np.linalg.norm(scene.gravity))
    surroundings.CreateGravityMagnitudeAttr(magnitude)
    surroundings.CreateGravityDirectionAttr(Gf.Vec3f(*(scene.gravity / (magnitude or 1.0)).tolist()))
    held = {}
    if len(scene.pins.vertices):
        held["hard"] = (np.sort(scene.pins.vertices), scene.positions[np.sort(scene.pins.vertices)], {})
    for term in scene.terms:
        if isinstance(term, Attachment):
            found = term.elements(scene.mesh, scene.positions)
            gains = {"stiffness": float(term.stiffness), "damping": float(term.damping or 0.0)}
            held[f"soft_{len(held)}"] = (found.stencil[:, 0], found.rest, gains)
    if held:
        body = UsdGeom.Xform.Define(stage, "/World/Pins").GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(body).CreateKinematicEnabledAttr(True)
    for name, (vertices, anchors, gains) in held.items():
        prim = stage.DefinePrim(f"/World/Pins/{name}", "PhysicsAttachment")
        prim.CreateRelationship("physics:src0").SetTargets([cloth.GetPath()])
        prim.CreateRelationship("physics:src1").SetTargets([body.GetPath()])
        _set(prim, "type0", Sdf.ValueTypeNames.Token, "point")
        _set(prim, "type1", Sdf.ValueTypeNames.Token, "xform")
        _set(prim, "indices0", Sdf.ValueTypeNames.IntArray, Vt.IntArray.FromNumpy(vertices.astype(np.int32)))
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(anchors, np.float32))
        _set(prim, "coords1", Sdf.ValueTypeNames.Point3fArray, points)
        for gain, value in gains.items():
            _set(prim, gain, Sdf.ValueTypeNames.Float, value)


def _set(prim, name, type_name, value):
    prim.CreateAttribute(f"physics:{name}", type_name).Set(value)


def _material_of(scene, law):
    """Returns the named values of a surface material by a law, and the thickness; refuses what has no name."""
    if law not in LAWS:
        raise ValueError(f"law is {law!r}; it must be one of {', '.join(LAWS)}")

    def refuse(what):
        raise ValueError(f"the names of deformable bodies by the law {law!r} have no {what}; the scene {scene.name!r} has")

    if not len(scene.mesh.triangles):
        refuse("cloth without triangles")
    if scene.locked is not None or not scene.pins.held.all():
        refuse("vertices that move along some axes only")
    for name in ("loads", "air", "self_contact"):
        if getattr(scene, name):
            refuse(f"{name} with laws of warpcloth")
    if scene.pins.moves:
        refuse("pins with keyframes that are not those of a prim")
    if scene.velocities.any() or not np.array_equal(scene.positions, scene.mesh.points):
        refuse("start that differs from the rest shape at rest")
    areas, masses = scene.mesh.vertex_areas, scene.vertex_masses
    density = masses.sum() / areas.sum()
    if not np.allclose(masses, density * areas, rtol=_SAME, atol=0.0):
        refuse("masses other than those of an even density")
    for term in scene.terms:
        if term.part is not None or np.ndim(term.stiffness) or not np.isfinite(term.stiffness):
            refuse(f"stiffness that is infinite or not one for the whole cloth, as that of {term.label}")
        if np.any(term.damping or 0.0) and not isinstance(term, Attachment):
            refuse(f"damping of cloth, as that of {term.label}")
    t = 2.0 * scene.contact.distance if scene.colliders else scene.thickness
    t = t if t is not None and np.isfinite(t) else THICKNESS
    found = {"thickness": t, "density": density / t}
    for term in scene.terms:
        given = {}
        if isinstance(term, Membrane):
            given = _of_membrane(term, law, refuse)
        elif isinstance(term, QuadraticBending | DihedralBending):
            given = {"surfaceBendStiffness": term.stiffness * (1.0 if law == "proposal" else _mean_kappa(scene.mesh))}
        elif not isinstance(term, Attachment):
            refuse(f"{type(term).__name__}")
        if set(given) & set(found):
            refuse(f"second {next(iter(given))}, as that of {term.label}")
        found |= given
    return found


def _of_membrane(term, law, refuse):
    isotropic = isinstance(term, NeoHookeanMembrane | StVKMembrane)
    if not isotropic and not (isinstance(term, OrthotropicMembrane) and np.all(term.weft_ratio == 1.0)):
        refuse(f"{type(term).__name__} with warp and weft or with another law")
    if np.ndim(term.poisson_ratio):
        refuse(f"Poisson's ratio of each triangle, as that of {term.label}")
    k, ratio = float(term.stiffness), float(term.poisson_ratio)
    shear = k / (2.0 * (1.0 + ratio)) if isotropic or term.shear_ratio is None else k * float(term.shear_ratio)
    if law == "newton":
        if ratio != 0.0 or not np.isclose(shear, 0.5 * k):
            refuse(f"Poisson's ratio other than 0 and no shear stiffness, as {term.label} has")
        return {"surfaceStretchStiffness": shear}
    return {"surfaceStretchStiffness": k / (1.0 - ratio**2), "surfaceShearStiffness": shear, "poissonsRatio": ratio}
