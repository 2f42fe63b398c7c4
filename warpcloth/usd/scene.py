"""Reads scenes from USD stages and writes them."""

import os
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..base.limits import MAX_FRAMES
from ..base.types import FilePath
from ..mesh.mesh import Mesh
from ..mesh.parts import Part
from ..mesh.selection import distinct_vertices
from ..scene.air import Air
from ..scene.colliders import Contact
from ..scene.mesh_scene import warn_of_unit
from ..scene.scene import DOWN, EARTH, Pins, Scene
from ..scene.self_contact import SelfContact
from ..terms import TERMS
from ..terms.limit import Limit
from ..terms.loads import LOADS
from .attributes import LOADS_NAMESPACE, TERMS_NAMESPACE, Values, attributes, author, has_api, kind_of, own_names
from .chunks import export
from .colliders import errors_at, read_colliders
from .deformables import (
    LAWS,
    THICKNESS,
    attachments_of,
    define_deformable,
    masses_of,
    refuse_other_rest,
    terms_of,
    thickness_of,
)
from .gprims import define_colliders
from .layers import scene_layer
from .modules import Sdf, Usd, UsdGeom, UsdPhysics
from .stage import (
    find_prim,
    first_points,
    followed,
    frame_codes,
    local_to_metres,
    moving_space,
    open_stage,
    pinned_points,
    placed,
    posed,
    read_stage_mesh,
    space_codes,
)
from .values import array_of, refuse_unknown, sentences, time_codes_of, value_of


def read_scene(
    path: FilePath, prim: str | None = None, law: Literal["proposal", "newton"] = "proposal", fabric: str | None = None
) -> Scene:
    """Reads a scene from a stage.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        prim: Path or name of the cloth; by default all prims with cloth attributes, else the only mesh.
        fabric: Fabric of all cloths, in place of density, terms and thickness.
        law: Meaning of standard names of a material: "proposal" or "newton", see :mod:`.deformables`.

    Returns:
        Scene: With `stage` set. A file of `write_scene` gives the written scene, but with sorted pins, None for a NaN
        thickness, and float32 texture coordinates, which edge meshes lose.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The prim or mesh is not valid (as of `read_stage_mesh`), there is no mass or no term, or an attribute has a
            wrong type, an invalid value, or an unknown name in the namespace "warpcloth".
    """
    if law not in LAWS:
        raise ValueError(f"law is {law!r}; it must be one of {', '.join(LAWS)}")
    with sentences(path):
        stage = open_stage(path)
        found = _cloth_prims(stage, path, prim)
        each = [read_stage_mesh(path, str(cloth.GetPath())) for cloth in found]
        surroundings = each[0]
        where = f"{path}, prim {surroundings.prim}" if len(each) == 1 else f"{path}"
        with errors_at(where):
            fps = surroundings.fps or surroundings.time_codes_per_second
            duration = _duration(stage, _teller("duration", [Values(stage, cloth) for cloth in found]), fps)
            first = surroundings.start or 0.0
            # One more frame, because colliders need a keyframe after the last step.
            stage = posed(stage, first, first + (duration + 1.0 / fps) * surroundings.time_codes_per_second)
        cloths = [stage.GetPrimAtPath(one.prim) for one in each]
        values = [Values(stage, cloth) for cloth in cloths]
        scenes = []
        for cloth, of_cloth, one in zip(cloths, values, each, strict=True):
            with errors_at(f"{path}, prim {one.prim}"):
                scenes.append(_scene(stage, cloth, of_cloth, one, fps, duration, values, law, fabric))

        def codes(samples):  # one more frame than the scene has, so that every step has a keyframe after it
            return frame_codes(samples, surroundings, scenes[0].frames + 1, fps)

        whole = {"colliders": read_colliders(stage, cloths, surroundings, codes)}
        with errors_at(where):
            for name, kind in (("contact", Contact), ("self_contact", SelfContact)):
                whole[name] = _of_fields(kind, name, values)
            whole["air"] = _air(values, surroundings, scenes[0].frames, fps)
            for scene in scenes:
                warn_of_unit(where, scene, surroundings.meters_per_unit, "metersPerUnit = {}")
            if len(each) == 1:
                return replace(scenes[0], **whole) if any(whole.values()) else scenes[0]
            name = _teller("name", values).get("name") or Path(path).stem
            scene = Scene.join(dict(zip(_names_of(each), scenes, strict=True)), name=name, **whole)
            mesh, own = scene.mesh, tuple(one.stage for one in scenes)
            return replace(scene, stage=replace(own[0], mesh=mesh, cloths=own))


def _teller(field, values):
    """The values of the first cloth that gives a field of the whole scene, else of the first; refuses differing ones."""
    telling = [(each, each.get(field)) for each in values if each.get(field) is not None]
    for _, value in telling[1:]:
        if not np.array_equal(value, telling[0][1]):
            raise ValueError(f"cloths have {field} {telling[0][1]} and {value}, must have the same, or one of them alone")
    return telling[0][0] if telling else values[0]


def _names_of(each):
    paths = [one.prim.strip("/") for one in each]
    names = [path.rsplit("/", 1)[-1] for path in paths]
    return names if len(set(names)) == len(names) else [path.replace("/", "_") for path in paths]


def _scene(stage, cloth, values, surroundings, fps, duration, of_all, law, fabric):
    refuse_other_rest(cloth)
    rest = surroundings.mesh.points
    surroundings = replace(surroundings, mesh=_exact_mesh(values, cloth, surroundings))
    mesh = surroundings.mesh
    fabric, terms, frames = fabric or values.get("fabric"), [_term(values, key) for key in values.terms], round(duration * fps)
    warp = values.get("warp")
    standard = not terms and fabric is None
    masses, own = values.get("masses"), values.get("density")
    masses = masses_of(values, mesh) if masses is None and own is None and fabric is None else masses
    density = _density(values, mesh) if masses is None else own
    vertices = _pinned(values, cloth, surroundings)
    positions, keyframes = _motion(values, cloth, surroundings, vertices, frames, fps)

    def codes(samples):
        return frame_codes(samples, surroundings, frames + 1, fps)

    held = attachments_of(stage, cloth, surroundings, rest if positions is None else positions, codes)
    vertices, keyframes = _with_held(vertices, keyframes, held, rest if positions is None else positions)
    if standard:
        where = f"{surroundings.path}, prim {cloth.GetPath()}"
        terms = [*(terms_of(values, mesh, law, where) if len(mesh.triangles) else ()), *held.terms]
    if fabric is None:
        _refuse_missing(density is not None or masses is not None, len(terms) > 0)
    if positions is not None and np.array_equal(positions, rest):
        positions = None
    own_positions, name = values.get("positions"), values.get("name")
    scene = Scene(
        mesh,
        density=density,
        masses=masses,
        positions=positions if own_positions is None else own_positions,
        velocities=values.get("velocities"),
        terms=terms,
        pins=Pins(vertices, keyframes, values.get("pins.axes") or "xyz"),
        free_axes=_free_axes(values),
        loads=[_load(values, key, surroundings, frames, fps) for key in values.loads],
        gravity=_gravity(stage, _teller("gravity", of_all), surroundings.up_axis),
        duration=duration,
        fps=fps,
        name=cloth.GetName() if name is None else name,
        stage=surroundings,
        fabric=fabric,
        warp=warp,
        thickness=thickness_of(values) if standard and values.get("thickness") is None else values.get("thickness"),
    )
    for term in scene.terms:
        term.elements(mesh, scene.positions)  # raises errors here, where the file is known
    return scene


def read_limits(stage, cloth, surroundings):
    """The strain limits that the prim of a cloth declares, a list of `Limit`, and their mesh."""
    with errors_at(f"{surroundings.path}, prim {cloth.GetPath()}"):
        values = Values(stage, cloth)
        kinds = {key: kind_of(values, key) for key in values.terms}
        found = [_term(values, key) for key, kind in kinds.items() if issubclass(TERMS[kind], Limit)]
        return found, _exact_mesh(values, cloth, surroundings) if found else surroundings.mesh


def _refuse_missing(mass, term):
    wanted = {
        "mass": (mass, ("density", "fabric", "masses", "(masses)", "(total mass)", "(mass per volume)")),
        "term": (term, ("terms.type", "(stretch stiffness)", "(bend stiffness)", "(Young's modulus)")),
    }
    missing = [
        f"{what} ({', '.join(dict.fromkeys(row.name for row in attributes() if row.field in read_from))})"
        for what, (given, read_from) in wanted.items()
        if not given
    ]
    if missing:
        raise ValueError(
            f"has no {' and no '.join(missing)}, must have a mass and a term to be a cloth, or a fabric (--fabric)"
        )


def _cloth_prims(stage, path, prim):
    if prim is None:
        of_colliders = {row.name for row in attributes() if row.location == "collider"}
        cloths = [
            found
            for found in stage.Traverse(Usd.TraverseInstanceProxies())
            if found.IsA(UsdGeom.PointBased)
            and (set(own_names(found)) - of_colliders or has_api(found, "PhysicsSurfaceDeformableSimAPI"))
        ]
        if cloths:
            return cloths
    return [find_prim(stage, path, prim)]


def _exact_mesh(values, cloth, surroundings):
    """The mesh with exact points and edges of attributes, if they agree with the prim, and its grid and parts."""
    mesh, transform = surroundings.mesh, surroundings.transform
    points, edges, grid_shape = (values.get(f"mesh.{name}") for name in ("points", "edges", "grid_shape"))
    if points is not None:
        stored = array_of(UsdGeom.PointBased(cloth).GetPointsAttr(), (3,))
        stored = np.empty((0, 3), np.float32) if stored is None else stored.astype(np.float32)
        if surroundings.point_vertices is not None and len(stored):
            stored = stored[first_points(surroundings.point_vertices)]
        same = np.array_equal(points.astype(np.float32), stored)
        points = points @ transform[:3, :3] + transform[3, :3] if same else None
    if edges is not None and not np.array_equal(np.unique(np.sort(edges, axis=1), axis=0), np.sort(mesh.edges, axis=1)):
        edges = None
    parts = _parts(values)
    if points is None and edges is None and grid_shape is None and parts is None:
        return mesh
    return Mesh(
        mesh.points if points is None else points,
        triangles=mesh.triangles if len(mesh.triangles) else None,
        edges=None if len(mesh.triangles) else mesh.edges if edges is None else edges,
        texture_coordinates=mesh.texture_coordinates,
        grid_shape=None if grid_shape is None else tuple(grid_shape.tolist()),
        up_axis=mesh.up_axis,
        parts=parts,
    )


def _parts(values):
    names, sizes, shapes = (values.get(f"mesh.{name}") for name in ("parts", "part_sizes", "part_grid_shapes"))
    if names is None and sizes is None and shapes is None:
        return None
    counts = [None if each is None else len(each) for each in (names, sizes, shapes)]
    if len(set(counts)) > 1:
        raise ValueError(f"warpcloth:parts, partSizes, partGridShapes have {counts} values, must have one each for every part")
    firsts = np.cumsum(sizes) - sizes
    grids = [tuple(shape) if any(shape) else None for shape in shapes.tolist()]
    return {name: Part(*part) for name, *part in zip(names, firsts.tolist(), sizes.tolist(), grids, strict=True)}


def _duration(stage, values, fps):
    """Duration [s]: warpcloth:duration, else whole frames between the time codes, else 1."""
    duration = values.get("duration")
    if duration is None:
        seconds = stage.GetEndTimeCode() - stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
        return max(0.0, np.floor(seconds / stage.GetTimeCodesPerSecond() * fps * (1 + 1e-9)) / fps) or 1.0
    if not 0.0 < float(duration) * fps <= MAX_FRAMES:
        raise ValueError(f"warpcloth:duration is {duration} s, must be finite and above 0, and {MAX_FRAMES:,} frames at most")
    return float(duration)


def _density(values, mesh):
    """Mass per area [kg/m²], or for curves per length [kg/m], or None."""
    density, total, per_volume = (values.get(field) for field in ("density", "(total mass)", "(mass per volume)"))
    if density is not None:
        return density
    if total is not None:
        return total / (mesh.vertex_areas if len(mesh.triangles) else mesh.vertex_lengths).sum()
    if len(mesh.triangles) and per_volume is not None:
        return per_volume * (thickness_of(values) or THICKNESS)
    return None


def _term(values, key):
    prefix, kind, given = f"{TERMS_NAMESPACE}:{key}", kind_of(values, key), {}
    for row in attributes():
        if row.name.startswith(f"{TERMS_NAMESPACE}:"):
            value = values.get(row.field, key)
            given |= {} if value is None else {row.field.removeprefix("terms."): value}
    given.pop("type", None)
    known = {field.name: field for field in fields(TERMS[kind])}
    wrong = sorted(set(given) - set(known))
    if wrong:
        raise ValueError(f"{prefix} has {wrong[0]}, which a {kind} has not; it must have none")
    if "stiffness" not in given and known["stiffness"].default is MISSING:
        raise ValueError(f"{prefix}:stiffness is not given, must be a number or one for each element")
    given = {name: float(value) if isinstance(value, np.number) else value for name, value in given.items()}
    # A term without a name is named after its kind.
    given["name"] = given.get("name", "" if key == kind else key) or None
    try:
        return TERMS[kind](**given)
    except ValueError as error:
        raise ValueError(f"{prefix}: {error}") from error


def _load(values, key, surroundings, frames, fps):
    prefix, kind = f"{LOADS_NAMESPACE}:{key}", kind_of(values, key, LOADS, "loads")
    quantity, given = LOADS[kind].quantity, {"vertices": values.get("loads.vertices", key)}
    wrong = [load.quantity for load in LOADS.values() if load.quantity != quantity]
    for name in wrong:
        if any(values.authored(f"loads.{name}", key)):
            raise ValueError(f"{prefix} has {name}, which a {kind} has not; it must have none")
    if given["vertices"] is None:
        raise ValueError(f"{prefix}:vertices is not given, must be a selection or indices")
    attribute = next((found for _, found in values.authored(f"loads.{quantity}", key)), None)
    if attribute is not None and attribute.GetNumTimeSamples():
        given["keyframes"] = _keyframes_of(attribute, surroundings, frames, fps)
    else:
        given[quantity] = values.get(f"loads.{quantity}", key)
    name = values.get("loads.name", key)
    given["name"] = ("" if key == kind else key) if name is None else name
    try:
        return LOADS[kind](**given | {"name": given["name"] or None})
    except ValueError as error:
        raise ValueError(f"{prefix}: {error}") from error


def _value_at(attribute, code):
    value = value_of(attribute, code)
    if value is None:
        raise ValueError(f"{attribute.GetName()} is blocked at time code {code:g}, must have a value")
    value = np.array(value, dtype=np.float64)
    refuse_unknown(attribute.GetName(), value, f" at time code {code:g}")
    return value


def _pinned(values, cloth, surroundings):
    selection, shown_by = values.get("pins.vertices"), surroundings.point_vertices
    count = len(surroundings.mesh.points) if shown_by is None else len(shown_by)
    points = pinned_points(cloth, count)
    vertices = points if shown_by is None else shown_by[points]
    if selection is not None:
        vertices = np.append(vertices, distinct_vertices("warpcloth:pins", selection, surroundings.mesh))
    return np.unique(vertices).astype(np.int32)


def _with_held(vertices, keyframes, held, start):
    both = np.union1d(vertices, held.vertices).astype(np.int32)
    if len(both) == len(vertices) and (keyframes is not None or held.keyframes is None):
        return vertices, keyframes
    if held.keyframes is None and keyframes is None:
        return both, None
    if keyframes is not None:
        raise ValueError("pins follow keyframes and a PhysicsAttachment holds other points, must be one of them")
    moved = np.repeat(start[both][None], len(held.keyframes), axis=0)
    moved[:, np.searchsorted(both, held.vertices)] = held.keyframes
    return both, moved


def _motion(values, cloth, surroundings, vertices, frames, fps):
    """Initial positions (n, 3), and keyframes (F, p, 3) of pins; each may be None."""
    animated, own = UsdGeom.PointBased(cloth).GetPointsAttr(), next(values.authored("pins.keyframes"), None)
    positions = keyframes = None
    if animated.GetNumTimeSamples():
        positions = next(_frames(cloth, surroundings, 0, fps))
    if len(vertices) and own is None and (animated.GetNumTimeSamples() or moving_space(cloth)):
        keyframes = np.array([points[vertices] for points in _frames(cloth, surroundings, frames, fps)])
        keyframes = None if (keyframes == keyframes[0]).all() else keyframes
    if own is not None:
        # Pins written by `write_scene` have a sample for each keyframe, even after the last frame.
        most = max(frames, len(own[1].GetTimeSamples()) - 1)
        keyframes = list(_samples(own[1], surroundings, most, fps))
        wrong = [len(row) for row in keyframes if len(row) != len(vertices)]
        if wrong:
            raise ValueError(f"{own[0].name} has {wrong[0]} positions, must have one for each of {len(vertices)} pins")
    return positions, keyframes


def _frames(cloth, surroundings, frames, fps):
    attribute, moving, rest = UsdGeom.PointBased(cloth).GetPointsAttr(), moving_space(cloth), surroundings.mesh.points
    count, first = len(rest), np.arange(len(rest))
    if surroundings.point_vertices is not None:
        first, count = first_points(surroundings.point_vertices), len(surroundings.point_vertices)
    samples, transform = time_codes_of(attribute), surroundings.transform
    at_rest = (rest - transform[3, :3]) @ np.linalg.inv(transform[:3, :3])
    for code in frame_codes([*samples, *space_codes(cloth)], surroundings, frames, fps):
        points = at_rest
        if samples:
            points = _vectors_at(attribute, code)
            if len(points) != count:
                raise ValueError(f"points has {len(points)} points at a time sample, must have {count} as at rest")
            points = points[first]
        yield placed(points, local_to_metres(cloth, f"time code {code:g}", code) if moving else transform)


def _samples(attribute, surroundings, frames, fps):
    return (_vectors_at(attribute, code) for code in frame_codes(time_codes_of(attribute), surroundings, frames, fps))


def _vectors_at(attribute, code):
    value = array_of(attribute, (3,), time=code)
    if value is None:
        raise ValueError(f"{attribute.GetName()} is blocked at time code {code:g}, must have a value")
    refuse_unknown(attribute.GetName(), value, f" at time code {code:g}")
    return value.astype(np.float64)


def _free_axes(values):
    free_axes = values.get("free_axes")
    if free_axes is None:
        return None
    for i, axis in np.argwhere((free_axes != 0) & (free_axes != 1))[:1]:
        raise ValueError(f"warpcloth:freeAxes[{i}] has {free_axes[i, axis]}, must be 0 or 1 for each axis")
    return free_axes.astype(bool)


def _of_fields(kind, name, values):
    given = {field.name: _teller(f"{name}.{field.name}", values).get(f"{name}.{field.name}") for field in fields(kind)}
    given = {field: value if isinstance(value, str) else float(value) for field, value in given.items() if value is not None}
    return kind(**given) if given else None


def _air(values, surroundings, frames, fps):
    names = ("density", "normal_drag", "tangential_drag")
    given = {name: _teller(f"air.{name}", values).get(f"air.{name}") for name in names}
    given = {name: float(value) for name, value in given.items() if value is not None}
    attribute = next((found for each in values for _, found in each.authored("air.wind")), None)
    if attribute is not None and attribute.GetNumTimeSamples():
        given["keyframes"] = _keyframes_of(attribute, surroundings, frames, fps)
    elif attribute is not None:
        given["wind"] = _teller("air.wind", values).get("air.wind")
    return Air(**given) if given else None


def _keyframes_of(attribute, surroundings, frames, fps):
    most = max(frames, attribute.GetNumTimeSamples() - 1)
    return [_value_at(attribute, code) for code in frame_codes(time_codes_of(attribute), surroundings, most, fps)]


def _gravity(stage, values, up_axis):
    gravity = values.get("gravity")
    if gravity is not None:
        return gravity
    scenes = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]
    if len(scenes) > 1:
        raise ValueError(f"the stage has {len(scenes)} PhysicsScenes, must have one or warpcloth:gravity on the cloth")
    values.locations["physics scene"] = scenes
    if values.get("(gravity acts)") is not None and not values.get("(gravity acts)"):
        return np.zeros(3)
    direction, magnitude = values.get("(gravity direction)"), values.get("(gravity magnitude)")
    if direction is None or not direction.any():
        direction = np.array(DOWN[up_axis])
    if magnitude is None or magnitude < 0:  # in UsdPhysics a negative value means the gravity of the Earth
        magnitude = EARTH
    return magnitude * direction.astype(np.float64) / np.linalg.norm(direction)


def write_scene(scene: Scene, path: FilePath, law: str | None = None) -> str:
    """Writes a scene as a new stage, /World/Cloth at rest, in metres.

    Args:
        scene: The `Scene`, without the rest of a stage that it was read from.
        path: File to write: .usd, .usda or .usdc.
        law: Also write the standard names of deformable bodies by the law "proposal" or "newton", see :mod:`.deformables`; None
            writes none.

    Returns:
        str: The path.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: The path has another ending or is the stage of the scene; the scene has no terms, a term that does not fit
            the mesh, a wind that is a function, or something without a name by ``law``.
        OSError: The file could not be written.
    """
    path = Path(os.path.abspath(followed(path)))
    if path.suffix not in (".usd", ".usda", ".usdc"):
        raise ValueError(f"path is {path}; it must end with one of .usd, .usda, .usdc")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path = {path}: the folder {path.parent} does not exist")
    if scene.stage is not None and os.path.realpath(path) == os.path.realpath(scene.stage.path):
        raise ValueError(f"path is {path}, the stage that the scene was read from; it must be another file")
    if not scene.terms:
        raise ValueError("scene.terms is empty; a scene in a stage must have one or more")
    if scene.air is not None and scene.air.blow is not None:
        raise ValueError("air.wind is a function, which a stage cannot hold; it must be a vector, vectors or keyframes")
    for term in scene.terms:
        term.elements(scene.mesh, scene.positions)  # raises here what reading the file would raise
    up_axis = scene.stage.up_axis if scene.stage else scene.up_axis
    pins = {"pins": scene.pins.vertices} if len(scene.pins.vertices) else None
    layer, target, _ = scene_layer(scene.mesh, pins, up_axis, "Cloth")
    define_colliders(layer, scene.colliders, scene.mesh)
    if law is not None:
        define_deformable(layer, scene, law)
    stage = Usd.Stage.Open(layer)
    stage.SetTimeCodesPerSecond(scene.fps)
    stage.SetFramesPerSecond(scene.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(scene.frames)
    cloth = stage.GetPrimAtPath(target.prim)
    for field, value in _scene_values(scene).items():
        author(cloth, field, value)
    order = np.argsort(scene.pins.vertices)
    if not scene.pins.held.all():
        axes = scene.pins.axes
        author(cloth, "pins.axes", axes if isinstance(axes, str) else [axes[k] for k in order])
    if scene.pins.keyframes is not None:
        for frame, positions in enumerate(scene.pins.keyframes[:, order]):
            author(cloth, "pins.keyframes", positions, time=frame)
    for frame, wind in enumerate(scene.air.winds if scene.air is not None and scene.air.keyframes is not None else ()):
        author(cloth, "air.wind", wind, time=frame)
    keys = _keys_of(scene.terms)
    for key, term in zip(keys, scene.terms, strict=True):
        given = {field.name: getattr(term, field.name) for field in fields(term)}
        for field, value in {**given, **_kind_and_name(term, key)}.items():
            if value is not None:
                author(cloth, f"terms.{field}", value, key)
    keys_of_loads = _keys_of(scene.loads)
    for key, load in zip(keys_of_loads, scene.loads, strict=True):
        given = {"vertices": load.vertices, load.quantity: getattr(load, load.quantity)}
        for field, value in {**_kind_and_name(load, key), **given}.items():
            if value is not None:
                author(cloth, f"loads.{field}", value, key)
        for frame, value in enumerate(() if load.keyframes is None else np.asarray(load.keyframes)):
            author(cloth, f"loads.{load.quantity}", value, key, time=frame)
    # USD sorts properties by name, so the order of terms is stored explicitly.
    of_terms = [f"{TERMS_NAMESPACE}:{key}:type" for key in keys]
    cloth.SetPropertyOrder(of_terms + [f"{LOADS_NAMESPACE}:{key}:type" for key in keys_of_loads])
    export(layer, path)
    return str(path)


def _scene_values(scene):
    mesh = scene.mesh
    given = {"name": scene.name, "duration": scene.duration, "gravity": scene.gravity}
    given |= {"masses": scene.masses} if scene.density is None else {"density": scene.density}
    if scene.thickness is not None and np.isfinite(scene.thickness):
        given["thickness"] = scene.thickness
    for name, contact in (("contact", scene.contact), ("self_contact", scene.self_contact)):
        if contact is not None and contact.distance is not None:
            given[f"{name}.distance"] = contact.distance
        if contact is not None and contact.stiffness is not None:
            given[f"{name}.stiffness"] = contact.stiffness
    for name in ("friction", "held_pins"):
        if scene.self_contact is not None and (value := getattr(scene.self_contact, name)) != getattr(SelfContact, name):
            given[f"self_contact.{name}"] = value
    if scene.air is not None:
        given |= {f"air.{name}": getattr(scene.air, name) for name in ("density", "normal_drag", "tangential_drag")}
        if scene.air.keyframes is None:
            given["air.wind"] = scene.air.winds
    if not np.array_equal(scene.positions, mesh.points):
        given["positions"] = scene.positions
    if scene.velocities.any():
        given["velocities"] = scene.velocities
    if scene.free_axes is not None:
        given["free_axes"] = scene.free_axes
    if not np.array_equal(mesh.points, mesh.points.astype(np.float32)):
        given["mesh.points"] = mesh.points
    if not len(mesh.triangles) and not np.array_equal(mesh.edges, np.unique(np.sort(mesh.edges, axis=1), axis=0)):
        given["mesh.edges"] = mesh.edges
    if mesh.grid_shape:
        given["mesh.grid_shape"] = mesh.grid_shape
    if mesh.parts:
        given["mesh.parts"] = tuple(mesh.parts)
        given["mesh.part_sizes"] = [part.count for part in mesh.parts.values()]
        given["mesh.part_grid_shapes"] = [part.grid_shape or (0, 0) for part in mesh.parts.values()]
    return given


def _kind_and_name(part, key):
    kind, name = type(part).__name__, part.name or ""
    return {"type": kind, "name": None if name == ("" if key == kind else key) else name}


def _keys_of(terms):
    """Attribute names of terms or loads: names or kinds, numbered if taken."""
    keys = []
    for term in terms:
        kind = type(term).__name__
        key = term.name if term.name and Sdf.Path.IsValidIdentifier(term.name) and term.name != kind else kind
        number = 1
        while key in keys:
            number += 1
            key = f"{kind}_{number}"
        keys.append(key)
    return keys
