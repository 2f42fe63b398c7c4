"""The constant layer below an animation: a complete stage, or a layer over an artist's stage."""

import os
from dataclasses import replace

import numpy as np

from .modules import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt
from .stage import (
    VERTEX_PRIMVAR,
    find_prim,
    local_to_metres,
    moving_space,
    open_stage,
    stage_mesh,
    triangles_of_faces,
)
from .targets import SAMPLED, Target
from .values import array_of

# Attributes of the artist's prim that would override ours, or belong to another motion.
_BLOCKED = (
    "accelerations",
    "primvars:normals",
    "primvars:normals:indices",
    "primvars:skel:jointIndices",
    "primvars:skel:jointWeights",
    "skel:blendShapes",
)
COLOUR = (0.17, 0.35, 0.58)
_LINE_COLOUR = (0.05, 0.05, 0.05)
# Width of drawn curves, relative to the mean edge length.
CURVE_WIDTH = 0.05


def scene_layer(mesh, pins, up_axis, name):
    """Builds a complete stage of one cloth at rest; returns the layer, the `Target` in it, and its root's metadata."""
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    Usd.ModelAPI(world).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(world)
    return layer, define_cloth(layer, mesh, pins, name), root_metadata(stage)


def define_cloth(layer, mesh, pins, name):
    """Defines a cloth at rest, with its parameters, in a layer of `scene_layer`; returns its `Target`."""
    if not Sdf.Path.IsValidIdentifier(name):
        raise ValueError(f"prim is {name!r}; it must be a name of letters, digits and _ where there is no source")
    stage, path = Usd.Stage.Open(layer), f"/World/{name}"
    if len(mesh.triangles):
        geometry, target = UsdGeom.Mesh.Define(stage, path), Target(path, mesh.triangles)
        geometry.CreateFaceVertexCountsAttr(np.full(len(mesh.triangles), 3, np.int32))
        geometry.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.triangles).reshape(-1)))
        geometry.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        geometry.CreateDoubleSidedAttr(True)
        geometry.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        geometry.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    else:
        paths = edge_paths(mesh.edges, len(mesh.points))
        lengths = np.linalg.norm(mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]], axis=1)
        geometry, target = _define_curves(stage, path, paths, CURVE_WIDTH * lengths.mean())
        primvar = UsdGeom.PrimvarsAPI(geometry).CreatePrimvar(VERTEX_PRIMVAR, Sdf.ValueTypeNames.IntArray)
        primvar.SetInterpolation(UsdGeom.Tokens.vertex)
        primvar.Set(Vt.IntArray.FromNumpy(target.point_vertices))
    for name, value in target.samples({"points": mesh.points}).items():
        geometry.GetPrim().GetAttribute(name).Set(value)
    _add_primvars(geometry, mesh)
    _add_pins(geometry, target, pins or {}, len(mesh.points))
    UsdGeom.Scope.Define(stage, "/World/Looks")
    bind_material(geometry.GetPrim(), define_material(stage, "/World/Looks/Cloth"))
    return target


def define_lines(layer, mesh, lines):
    """Defines linear curves beside a cloth, along ``lines``: pairs (E, 2) of its vertices and a thickness [m] by name.

    Names keep only letters, digits and _.

    Returns:
        list: The `Target` of each, to be sampled with all vertices of the mesh.
    """
    stage, targets = Usd.Stage.Open(layer), []
    material = UsdShade.Material.Get(stage, "/World/Looks/Cloth")
    for name, (pairs, width) in lines.items():
        path = f"/World/{Tf.MakeValidIdentifier(name)}"
        while stage.GetPrimAtPath(path):
            path += "_"
        paths = [each for each in edge_paths(pairs, len(mesh.points)) if each[0] != each[1]]
        curves, target = _define_curves(stage, path, paths, width)
        for attribute, value in target.samples({"points": mesh.points}).items():
            curves.GetPrim().GetAttribute(attribute).Set(value)
        curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*_LINE_COLOUR)])
        bind_material(curves.GetPrim(), material)
        targets.append(target)
    return targets


def _define_curves(stage, path, paths, width):
    width = float(np.float32(width))
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
    curves.CreateCurveVertexCountsAttr([len(vertices) for vertices in paths])
    curves.CreateWidthsAttr([width])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    point_vertices = np.concatenate(paths).astype(np.int32)
    return curves, Target(path, np.empty((0, 3), np.int32), point_vertices=point_vertices, half_width=width / 2)


def edge_paths(edges, count):
    """Returns paths of at least two vertices along edges (E, 2), each edge in one, found greedily from odd vertices first.

    A vertex without edges has a path of length 0.
    """
    neighbours = [[] for _ in range(count)]
    for edge, (a, b) in enumerate(np.asarray(edges).tolist()):
        neighbours[a].append((b, edge))
        neighbours[b].append((a, edge))
    odd = [v for v in range(count) if len(neighbours[v]) % 2]
    isolated = [v for v in range(count) if not neighbours[v]]
    for adjacent in neighbours:
        adjacent.sort(reverse=True)
    used = [False] * len(edges)
    paths = []
    for start in odd + list(range(count)):
        path = [start]
        while adjacent := neighbours[path[-1]]:
            other, edge = adjacent.pop()
            if not used[edge]:
                used[edge] = True
                path.append(other)
        if len(path) > 1:
            paths.append(path)
    return paths + [[v, v] for v in isolated]


def _add_primvars(geometry, mesh):
    primvars = UsdGeom.PrimvarsAPI(geometry)
    coordinates = mesh.texture_coordinates
    if coordinates is not None and len(mesh.triangles):
        at = UsdGeom.Tokens.vertex if coordinates.ndim == 2 else UsdGeom.Tokens.faceVarying
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, at)
        st.Set(Vt.Vec2fArray.FromNumpy(coordinates.reshape(-1, 2).astype(np.float32)))
    geometry.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*COLOUR)])


def _add_pins(geometry, target, pins, count):
    for name, vertices in pins.items():
        if not Sdf.Path.IsValidIdentifier(name):
            raise ValueError(f"pins: {name!r} must be a name of letters, digits and _, not starting with a digit")
        vertices = np.unique(np.asarray(vertices))
        if len(vertices) and (vertices.dtype.kind not in "iu" or vertices[0] < 0 or vertices[-1] >= count):
            raise ValueError(f"pins[{name!r}]: {vertices[0]} to {vertices[-1]}, must be whole numbers, 0 to {count - 1}")
        if target.point_vertices is not None:
            vertices = np.flatnonzero(np.isin(target.point_vertices, vertices))
        UsdGeom.Subset.CreateGeomSubset(
            geometry,
            name,
            UsdGeom.Tokens.point,
            Vt.IntArray.FromNumpy(vertices.astype(np.int32)),
            "pins",
            UsdGeom.Tokens.unrestricted,
        )


def define_material(stage, path):
    """Defines a UsdPreviewSurface that reads displayColor."""
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    reader = UsdShade.Shader.Define(stage, f"{path}/Colour")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(*COLOUR))
    result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(result)
    output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    return material


def bind_material(prim, material):
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def over_layer(source, prim, mesh, primvars, history, layer=None):
    """Builds a layer over the artist's prim, to be animated, added to ``layer`` if that is not None.

    The artist's default points stay the rest shape; without them ours are written. The artist's primvars named as ours are
    blocked.

    Returns:
        The layer, the `Target`, the artist's root metadata, the `StageMesh`, real paths of all files of the stage, and a
        function (time code) → transform of the prim, or None if it does not move.

    Raises:
        ValueError: As for `read_stage_mesh` and `artist_prim`, or a primvar of the artist is not float[].
    """
    surroundings = stage_mesh(source, prim)
    stage, artist = artist_prim(surroundings, mesh)
    identity = np.array_equal(surroundings.transform, np.eye(4))
    target = artist_target(artist, surroundings, primvars, transform=None if identity else surroundings.transform)
    target = replace(target, history=history)
    layer = layer or Sdf.Layer.CreateAnonymous(".usdc")
    over = Sdf.CreatePrimInLayer(layer, surroundings.prim)
    rest = target.samples({"points": surroundings.mesh.points})
    defaults = ["extent"]
    if artist.GetAttribute("points").Get() is None:
        defaults.append("points")
    if artist.IsA(UsdGeom.Mesh):
        defaults.append("normals")
        scheme = Sdf.AttributeSpec(over, "subdivisionScheme", Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform)
        scheme.default = UsdGeom.Tokens.none
    for name in defaults:
        Sdf.AttributeSpec(over, name, Sdf.ValueTypeNames.Find(SAMPLED[name])).default = rest[name]
    if "normals" in defaults:
        over.attributes["normals"].SetInfo("interpolation", UsdGeom.Tokens.vertex)
    for name in _BLOCKED:
        _block(artist, over, name)
    declare_primvars(layer, artist, target, surroundings.path)
    transform_at = None
    if moving_space(artist):

        def transform_at(code):
            prim = stage.GetPrimAtPath(surroundings.prim)  # the function keeps the stage
            return local_to_metres(prim, f"{surroundings.path}, prim {surroundings.prim}, time code {code:g}", code)

    return layer, target, root_metadata(stage), surroundings, files_of_stage(stage), transform_at


def artist_prim(surroundings, mesh):
    """Returns the stage, to be kept alive, and the artist's prim in it; refuses instances and meshes of another topology."""
    where = f"{surroundings.path}, prim {surroundings.prim}"
    count = len(surroundings.mesh.points)
    if count != len(mesh.points):
        raise ValueError(f"{where}: has {count} vertices, must have as many as the mesh, {len(mesh.points)}")
    if not np.array_equal(surroundings.mesh.triangles, mesh.triangles):
        raise ValueError(f"{where}: has other triangles than the mesh; read the mesh from this prim")
    stage = open_stage(surroundings.path)
    artist = find_prim(stage, surroundings.path, surroundings.prim)
    if artist.IsInstanceProxy():
        raise ValueError(f"{where}: is part of an instance, which no layer can animate; set instanceable = false first")
    return stage, artist


def artist_target(artist, surroundings, primvars, **options):
    """Returns the `Target` of an artist's prim."""
    half_width = 0.0
    if artist.IsA(UsdGeom.Curves):
        half_width = float(_widths(artist, surroundings).max(initial=0.0)) / 2
    face_triangles = triangles_of_faces(artist) if artist.IsA(UsdGeom.Mesh) else np.array([])
    return Target(
        surroundings.prim,
        surroundings.mesh.triangles,
        point_vertices=surroundings.point_vertices,
        half_width=half_width,
        face_triangles=face_triangles if (face_triangles != 1).any() else None,
        primvars=primvars,
        **options,
    )


def _widths(curves, surroundings):
    try:
        widths = array_of(UsdGeom.Curves(curves).GetWidthsAttr())
        widths = np.empty(0) if widths is None else widths
        for row in np.flatnonzero(~((widths >= 0.0) & np.isfinite(widths)))[:1]:
            raise ValueError(f"widths[{row}] is {widths[row]}, must be finite and 0 or more")
    except ValueError as error:
        raise ValueError(f"{surroundings.path}, prim {surroundings.prim}: {error}") from None
    return widths


def declare_primvars(layer, artist, target, path):
    """Declares the sampled primvars in a layer, and blocks the artist's of the same names, which must be of these types."""
    sampled = {name: kind for name, kind in target.attributes.items() if name.startswith("primvars:")}
    over = layer.GetPrimAtPath(target.prim)
    for name, kind in sampled.items():
        attribute = artist.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue() and attribute.GetTypeName() != kind:
            raise ValueError(
                f"{path}, prim {target.prim}: {name} has type {attribute.GetTypeName()}, must be {kind} or not be there; "
                "a layer cannot change it"
            )
        if _block(artist, over, name):
            over.attributes[name].SetInfo("elementSize", 1)  # or the artist's would hold
        _block(artist, over, f"{name}:indices")
    target.declare(layer, sampled)


def _block(artist, over, name):
    attribute = artist.GetAttribute(name)
    if not (attribute and attribute.HasAuthoredValue()):
        return False
    Sdf.AttributeSpec(over, name, attribute.GetTypeName()).default = Sdf.ValueBlock()
    return True


def files_of_stage(stage):
    """Returns the real paths of all files of a stage."""
    return {os.path.realpath(used.realPath) for used in stage.GetUsedLayers() if used.realPath}


def root_metadata(stage):
    """Returns units, up axis and default prim, which USD reads from the root layer only."""
    facts = {
        "metersPerUnit": UsdGeom.GetStageMetersPerUnit(stage),
        "upAxis": UsdGeom.GetStageUpAxis(stage),
        "kilogramsPerUnit": UsdPhysics.GetStageKilogramsPerUnit(stage),
    }
    if stage.HasDefaultPrim():
        facts["defaultPrim"] = stage.GetRootLayer().defaultPrim
    return facts


def flattened_layer(base_paths, describe, named):
    """Flattens layers, strongest first and without clips, into an anonymous one; ``named`` (path, stage) gives paths of files
    in it.
    """
    root = Sdf.Layer.CreateAnonymous(".usda")
    # Rates first, because they scale the times of the layers below.
    describe(root)
    root.subLayerPaths = [os.path.abspath(path) for path in base_paths]
    stage = Usd.Stage.Open(root)
    flat = stage.Flatten(addSourceFileComment=False)
    describe(flat)
    UsdUtils.ModifyAssetPaths(flat, lambda path: named(path, stage))
    return flat


def named_from(folder):
    """Returns a function for `flattened_layer`: paths of existing files relative to a folder."""
    return lambda path, _: relative_path(path, folder) if os.path.isabs(path) and os.path.exists(path) else path


def relative_path(path, folder):
    """Returns a path relative to a folder with "./", because USD searches for bare names elsewhere too."""
    path = os.path.relpath(os.path.abspath(path), os.path.abspath(folder)).replace(os.sep, "/")
    return path if path.startswith("../") else f"./{path}"
