"""What all frames share: the layer that an animation is put on, and how a frame is expressed in its prim."""

import os
import warnings
from dataclasses import dataclass, field

import numpy as np
from pxr import Ar, Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt

from .stage import VERTEX_PRIMVAR, find_prim, open_stage, read_stage_mesh

# Attributes with one sample for each frame.
SAMPLED = {
    "points": Sdf.ValueTypeNames.Point3fArray,
    "velocities": Sdf.ValueTypeNames.Vector3fArray,
    "normals": Sdf.ValueTypeNames.Normal3fArray,
    "extent": Sdf.ValueTypeNames.Float3Array,
}
# Attributes of the artist's prim that would be used instead of ours, or beside ours with values of another motion.
_BLOCKED = ("accelerations", "primvars:normals", "primvars:normals:indices")
# Primvars that say something else already.
_TAKEN = ("normals", "st", "displayColor", "displayOpacity", VERTEX_PRIMVAR)
_COLOUR = (0.17, 0.35, 0.58)
# Curves are drawn as tubes this thick, as a part of the mean edge length.
_CURVE_WIDTH = 0.05


@dataclass(frozen=True, eq=False)
class Target:
    """The prim to animate, and all that a frame needs to be expressed in its own space and units.

    Attributes:
        prim: Path of the prim.
        triangles: (T, 3), for normals; empty for curves.
        transform: (4, 4) from the prim's space to metres, as in `StageMesh`; None where they are the same.
        point_vertices: Vertex of each point of the prim, or None where they are the same.
        half_width: How far the shape reaches around its points, in the prim's units; curves have a width.
        face_triangles: Number of triangles of each face of the prim (F,), or None where each has one.
        primvars: Interpolation of each sampled primvar, "vertex" or "uniform", by name.
    """

    prim: str
    triangles: np.ndarray
    transform: np.ndarray | None = None
    point_vertices: np.ndarray | None = None
    half_width: float = 0.0
    face_triangles: np.ndarray | None = None
    primvars: dict = field(default_factory=dict)

    @property
    def attributes(self):
        """Types of the sampled attributes by name; curves are drawn as tubes, which need no normals."""
        own = {name: kind for name, kind in SAMPLED.items() if name != "normals" or len(self.triangles)}
        return own | {f"primvars:{name}": Sdf.ValueTypeNames.FloatArray for name in self.primvars}

    def declare(self, layer, names):
        """Makes sure that a layer has some of the sampled attributes, without giving them values."""
        prim = layer.GetPrimAtPath(self.prim) or Sdf.CreatePrimInLayer(layer, self.prim)
        for name in names:
            if name not in prim.attributes:
                Sdf.AttributeSpec(prim, name, self.attributes[name])
            if name.startswith("primvars:"):
                prim.attributes[name].SetInfo("interpolation", self.primvars[name.removeprefix("primvars:")])

    def samples(self, points, velocities, primvars=None):
        """The attribute values of a frame.

        Args:
            points: (n, 3) [m], world space.
            velocities: (n, 3) [m/s].
            primvars: Values by name, (n,) or, where uniform, one for each triangle (T,).

        Returns:
            dict: An array of pxr for each of `attributes`.
        """
        own = self._vectors(points, velocities)
        for name, value in (primvars or {}).items():
            if self.primvars[name] == "vertex":
                value = value if self.point_vertices is None else value[self.point_vertices]
            elif self.face_triangles is not None:
                starts = np.cumsum(self.face_triangles) - self.face_triangles
                value = np.add.reduceat(value, starts) / self.face_triangles
            own[f"primvars:{name}"] = Vt.FloatArray.FromNumpy(np.ascontiguousarray(value, dtype=np.float32))
        return own

    def _vectors(self, points, velocities):
        values = {"points": points, "velocities": velocities}
        if len(self.triangles):
            values["normals"] = vertex_normals(points, self.triangles)
        if self.transform is not None:
            linear, offset = self.transform[:3, :3], self.transform[3, :3]
            inverse = np.linalg.inv(linear)
            values["points"] = (np.asarray(points, np.float64) - offset) @ inverse
            values["velocities"] = np.asarray(velocities, np.float64) @ inverse
            if "normals" in values:
                # Normals are covectors: they stay at right angles to the surface, and on its front, under the transpose.
                values["normals"] = _unit(values["normals"] @ linear.T)
        if self.point_vertices is not None:
            values = {name: value[self.point_vertices] for name, value in values.items()}
        values = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in values.items()}
        values["extent"] = self._extent(values["points"])
        return {name: Vt.Vec3fArray.FromNumpy(value) for name, value in values.items()}

    def _extent(self, points):
        # A column at a time: NumPy reduces a short last axis several times slower.
        low, high = [c.min() for c in points.T], [c.max() for c in points.T]
        return np.array([low, high], dtype=np.float32) + np.float32([[-self.half_width], [self.half_width]])


def check_primvars(primvars, mesh):
    """Refuses primvars, interpolation by name, that a mesh cannot have.

    Raises:
        ValueError: A name that is none or is taken, or an interpolation that is not "vertex" or, of triangles, "uniform".
    """
    for name, interpolation in primvars.items():
        valid = isinstance(name, str) and Sdf.Path.IsValidNamespacedIdentifier(name) and not name.endswith(":indices")
        if not valid or name.startswith("primvars:"):
            raise ValueError(f"primvars: {name!r} must be a name such as rotationAngle, without primvars: before it")
        if name in _TAKEN:
            raise ValueError(f"primvars: {name!r} has a meaning already, must be none of {', '.join(_TAKEN)}")
        allowed = ("vertex", "uniform") if len(mesh.triangles) else ("vertex",)
        if interpolation not in allowed:
            of = "" if len(mesh.triangles) else " of a mesh of edges"
            raise ValueError(f"primvars[{name!r}] = {interpolation!r}: must be {' or '.join(map(repr, allowed))}{of}")


def vertex_normals(points, triangles):
    """Unit normals (n, 3) of vertices: the normals of their triangles, weighted by area.

    A vertex without area (isolated, or all its triangles collapsed) has no normal, and gets +y so that all have length 1.

    Args:
        points: (n, 3).
        triangles: (T, 3).

    Returns:
        np.ndarray: (n, 3) float64.
    """
    origin = points[triangles[:, 0]]
    doubled_areas = np.cross(points[triangles[:, 1]] - origin, points[triangles[:, 2]] - origin)
    corners = triangles.T.ravel()
    return _unit(np.stack([np.bincount(corners, np.tile(n, 3), len(points)) for n in doubled_areas.T], axis=1))


def _unit(vectors):
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    none = length == 0
    if none.any():
        vectors, length = vectors.copy(), length.copy()
        vectors[none], length[none] = (0, 1, 0), 1
    return vectors / length[:, None]


def scene_layer(mesh, pins, up_axis, name):
    """A complete stage of one cloth at rest, to be animated.

    Args:
        mesh: The `Mesh`.
        pins: Vertex indices by name, or None.
        up_axis: "Y" or "Z".
        name: Name of the prim: /World/<name>.

    Returns:
        The layer, the `Target` in it, and its root's metadata.
    """
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    Usd.ModelAPI(world).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(world)
    path = f"/World/{name}"
    if len(mesh.triangles):
        geometry, target = UsdGeom.Mesh.Define(stage, path), Target(path, mesh.triangles)
        geometry.CreateFaceVertexCountsAttr(np.full(len(mesh.triangles), 3, np.int32))
        geometry.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.triangles).reshape(-1)))
        geometry.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        geometry.CreateDoubleSidedAttr(True)
        geometry.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        geometry.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    else:
        geometry, target = _define_curves(stage, path, mesh)
    rest = target.samples(mesh.points, np.zeros_like(mesh.points))
    for name in target.attributes:
        if name != "velocities":
            geometry.GetPrim().GetAttribute(name).Set(rest[name])
    _add_primvars(geometry, mesh)
    _add_pins(geometry, target, pins or {}, len(mesh.points))
    _bind_material(stage, geometry)
    return layer, target, root_metadata(stage)


def _define_curves(stage, path, mesh):
    """An edge mesh as linear curves that follow its edges, so that a chain is one curve with its vertices in order.

    Where curves meet they each have a point for the vertex: a primvar says which vertex each point is.
    """
    paths = edge_paths(mesh.edges, len(mesh.points))
    point_vertices = np.concatenate(paths).astype(np.int32)
    lengths = np.linalg.norm(mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]], axis=1)
    width = float(np.float32(_CURVE_WIDTH * lengths.mean()))
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
    curves.CreateCurveVertexCountsAttr([len(vertices) for vertices in paths])
    curves.CreateWidthsAttr([width])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    primvar = UsdGeom.PrimvarsAPI(curves).CreatePrimvar(VERTEX_PRIMVAR, Sdf.ValueTypeNames.IntArray)
    primvar.SetInterpolation(UsdGeom.Tokens.vertex)
    primvar.Set(Vt.IntArray.FromNumpy(point_vertices))
    return curves, Target(path, mesh.triangles, point_vertices=point_vertices, half_width=width / 2)


def edge_paths(edges, count):
    """Paths along edges that use each edge once, found greedily from the vertices of odd valence first.

    Args:
        edges: (E, 2).
        count: Number of vertices n.

    Returns:
        list: Vertices of each path, at least two; a vertex without edges has a path of no length, so that it is kept.
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
    """Texture coordinates where the mesh has them, and a colour that the material reads."""
    primvars = UsdGeom.PrimvarsAPI(geometry)
    if mesh.texture_coordinates is not None and len(mesh.triangles):
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(mesh.texture_coordinates.astype(np.float32)))
    geometry.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*_COLOUR)])


def _add_pins(geometry, target, pins, count):
    """A GeomSubset of points for each set of pins, in a family of their own, which may overlap."""
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


def _bind_material(stage, geometry):
    """A UsdPreviewSurface that reads displayColor: viewers that ignore displayColor itself show it through this."""
    UsdGeom.Scope.Define(stage, "/World/Looks")
    material = UsdShade.Material.Define(stage, "/World/Looks/Cloth")
    surface = UsdShade.Shader.Define(stage, "/World/Looks/Cloth/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    reader = UsdShade.Shader.Define(stage, "/World/Looks/Cloth/Colour")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(*_COLOUR))
    result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(result)
    output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    UsdShade.MaterialBindingAPI.Apply(geometry.GetPrim()).Bind(material)


def over_layer(source, prim, mesh, primvars):
    """A layer of opinions on the artist's prim, to be animated: it says how to read normals, and has no points.

    The artist's default points stay the rest shape; only where there are none (samples alone) ours are given.

    Args:
        source: File of the stage.
        prim: Path or name of the prim, or None.
        mesh: The `Mesh` that is simulated.
        primvars: Names of those that will be sampled; the artist's of the same name are blocked.

    Returns:
        The layer, the `Target`, the artist's root metadata, the `StageMesh` of the prim, and real paths of all files of the
        artist's stage.

    Raises:
        ValueError: As `read_stage_mesh`; the prim is an instance; the mesh has another number of vertices or other triangles;
            a primvar of the artist has another type than float[].
    """
    surroundings = read_stage_mesh(source, prim)
    where = f"{source}, prim {surroundings.prim}"
    count = len(surroundings.mesh.points)
    if count != len(mesh.points):
        raise ValueError(f"{where}: has {count} vertices, must have as many as the mesh, {len(mesh.points)}")
    if not np.array_equal(surroundings.mesh.triangles, mesh.triangles):
        raise ValueError(f"{where}: has other triangles than the mesh; read the mesh from this prim")
    stage = open_stage(source)
    artist = find_prim(stage, source, surroundings.prim)
    if artist.IsInstanceProxy():
        raise ValueError(f"{where}: is part of an instance, which no layer can animate; set instanceable = false first")
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    over = Sdf.CreatePrimInLayer(layer, surroundings.prim)
    target = _artist_target(artist, surroundings)
    shape = surroundings.mesh.points
    rest = target.samples(shape, np.zeros_like(shape))
    defaults = ["extent"]
    if artist.GetAttribute("points").Get() is None:
        defaults.append("points")
    if artist.IsA(UsdGeom.Mesh):
        defaults.append("normals")
        scheme = Sdf.AttributeSpec(over, "subdivisionScheme", Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform)
        scheme.default = UsdGeom.Tokens.none
    for name in defaults:
        Sdf.AttributeSpec(over, name, SAMPLED[name]).default = rest[name]
    if "normals" in defaults:
        over.attributes["normals"].SetInfo("interpolation", UsdGeom.Tokens.vertex)
    sampled = [f"primvars:{name}" for name in primvars]
    for name in (*_BLOCKED, *sampled, *(f"{name}:indices" for name in sampled)):
        attribute = artist.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            kind = attribute.GetTypeName()
            if name in sampled and kind != Sdf.ValueTypeNames.FloatArray:
                raise ValueError(f"{where}: {name} has type {kind}, must be float[] or not be there; a layer cannot change it")
            blocked = Sdf.AttributeSpec(over, name, kind)
            blocked.default = Sdf.ValueBlock()
            if name in sampled:
                blocked.SetInfo("elementSize", 1)  # or the artist's would hold
    files = {os.path.realpath(used.realPath) for used in stage.GetUsedLayers() if used.realPath}
    return layer, target, root_metadata(stage), surroundings, files


def _artist_target(artist, surroundings):
    identity = np.array_equal(surroundings.transform, np.eye(4))
    half_width = 0.0
    if artist.IsA(UsdGeom.Curves):
        widths = UsdGeom.Curves(artist).GetWidthsAttr().Get()
        half_width = float(np.max(widths)) / 2 if widths else 0.0
    counts = UsdGeom.Mesh(artist).GetFaceVertexCountsAttr().Get(Usd.TimeCode.EarliestTime()) if artist.IsA(UsdGeom.Mesh) else []
    face_triangles = np.array(counts, dtype=np.int32) - 2
    return Target(
        surroundings.prim,
        surroundings.mesh.triangles,
        transform=None if identity else surroundings.transform,
        point_vertices=surroundings.point_vertices,
        half_width=half_width,
        face_triangles=face_triangles if (face_triangles > 1).any() else None,
    )


def root_metadata(stage):
    """Units, up axis and default prim: USD reads them from a root layer only, so a root over it has to repeat them."""
    facts = {
        "metersPerUnit": UsdGeom.GetStageMetersPerUnit(stage),
        "upAxis": UsdGeom.GetStageUpAxis(stage),
        "kilogramsPerUnit": UsdPhysics.GetStageKilogramsPerUnit(stage),
    }
    if stage.HasDefaultPrim():
        facts["defaultPrim"] = stage.GetRootLayer().defaultPrim
    return facts


def flatten(base_paths, describe, folder=None):
    """One layer with everything that the given layers compose to, without their clips.

    Args:
        base_paths: Files of the layers, strongest first.
        describe: Function that writes the root's metadata on a layer.
        folder: Where the layer will be, for paths of other files (textures). None if it will be packed with them: then
            files that are missing already are left out, with a warning, for a package with a missing file is refused.

    Returns:
        Sdf.Layer: Anonymous.
    """
    root = Sdf.Layer.CreateAnonymous(".usda")
    # Rates first: they decide how the times of the layers below are scaled.
    describe(root)
    root.subLayerPaths = [os.path.abspath(path) for path in base_paths]
    flat = Usd.Stage.Open(root).Flatten(addSourceFileComment=False)
    describe(flat)

    def relative(path):
        return relative_path(path, folder) if os.path.isabs(path) and os.path.exists(path) else path

    def present(path):
        if "<UDIM>" in path or Ar.GetResolver().Resolve(path):
            return path
        warnings.warn(f"{path}: there is no such file, the package is made without it", stacklevel=2)
        return ""

    UsdUtils.ModifyAssetPaths(flat, present if folder is None else relative)
    return flat


def relative_path(path, folder):
    """Path of a file as a layer in a folder names it: "./…", for bare names are searched for elsewhere too."""
    path = os.path.relpath(os.path.abspath(path), os.path.abspath(folder)).replace(os.sep, "/")
    return path if path.startswith("../") else f"./{path}"
