"""An animated prim, and its attributes for a frame in its space and units."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .modules import Gf, Sdf, Vt
from .stage import VERTEX_PRIMVAR

Interpolation = Literal["vertex", "uniform"]
# Types of the attributes with one sample for each frame.
SAMPLED = {"points": "point3f[]", "velocities": "vector3f[]", "normals": "normal3f[]", "extent": "float3[]"}
DISPLAY_COLOUR = "primvars:displayColor"
# Primvars with another meaning.
_TAKEN = ("normals", "st", "displayColor", "displayOpacity", VERTEX_PRIMVAR)


@dataclass(frozen=True, eq=False)
class Target:
    """The prim to animate, with what expresses a frame in its space and units.

    Attributes:
        triangles: (T, 3), for normals; empty for curves.
        transform: (4, 4) from its space to metres; None for the identity.
        point_vertices: Vertex of each point; None if points are vertices.
        half_width: Half the width of curves, in the prim's units.
        face_triangles: Number of triangles of each face (F,), 0 for a hole; None if each has one.
        vectors: Names of the sampled vectors, of `SAMPLED`.
        primvars: Interpolation of each sampled primvar by name, "vertex" or "uniform".
        history: Types of history primvars by name: "float3[]" per vertex, "double" or "double3" per cloth, in SI units.
        vertices: Slice of the mesh's vertices; None for all.
        coloured: Name of the primvar that displayColor shows, or None.
    """

    prim: str
    triangles: np.ndarray
    transform: np.ndarray | None = None
    point_vertices: np.ndarray | None = None
    half_width: float = 0.0
    face_triangles: np.ndarray | None = None
    vectors: tuple = tuple(SAMPLED)
    primvars: dict = field(default_factory=dict)
    coloured: str | None = None
    history: dict = field(default_factory=dict)
    vertices: slice | None = None

    @property
    def attributes(self):
        """Types of the sampled attributes by name."""
        own = {name: SAMPLED[name] for name in self.vectors if name != "normals" or len(self.triangles)}
        own |= {f"primvars:{name}": "float[]" for name in self.primvars}
        own |= {f"primvars:{name}": type_name for name, type_name in self.history.items()}
        own |= {DISPLAY_COLOUR: "color3f[]"} if self.coloured else {}
        return {name: Sdf.ValueTypeNames.Find(type_name) for name, type_name in own.items()}

    def declare(self, layer, names):
        """Adds sampled attributes, without values, to a layer."""
        prim = layer.GetPrimAtPath(self.prim) or Sdf.CreatePrimInLayer(layer, self.prim)
        for name in names:
            if name not in prim.attributes:
                Sdf.AttributeSpec(prim, name, self.attributes[name])
            if name.startswith("primvars:"):
                shown = self.coloured if name == DISPLAY_COLOUR else name.removeprefix("primvars:")
                of_history = "constant" if self.history.get(shown) in ("double", "double3") else "vertex"
                prim.attributes[name].SetInfo("interpolation", self.primvars.get(shown, of_history))

    def samples(self, vectors, primvars=None, colours=None, history=None):
        """A dictionary of a pxr array for each of `attributes` in a frame.

        Args:
            vectors: "points" (n, 3) [m] in world space, and "velocities" (n, 3) [m/s] if sampled.
            primvars: Values by name, (n,) or (T,), NaN if unknown; a face gets the mean of its triangles.
            colours: (n, 3) or (T, 3), of the shown primvar; likewise.
            history: Values by name, (n, 3), (3,) or a number; NaN if unknown.
        """
        own = self._vectors({name: self._own(values) for name, values in vectors.items()})
        for name, values in (primvars or {}).items():
            own[f"primvars:{name}"] = Vt.FloatArray.FromNumpy(self._shown(values, name, np.isfinite(values)))
        for name in self.history if history else ():
            value = history[name]
            if self.history[name] == "double":
                own[f"primvars:{name}"] = float(value)
            elif self.history[name] == "double3":
                own[f"primvars:{name}"] = Gf.Vec3d(*map(float, value))
            else:
                value = self._own(value)
                value = value if self.point_vertices is None else value[self.point_vertices]
                own[f"primvars:{name}"] = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(value, dtype=np.float32))
        if colours is not None:
            known = np.isfinite(primvars[self.coloured])
            if self.primvars[self.coloured] == "uniform" and self.face_triangles is not None:
                # A face without a value gets the mean over all its triangles, which have the colour of unknown values.
                counts = self.face_triangles[self.face_triangles > 0]
                known |= np.repeat(~np.logical_or.reduceat(known, _starts(counts)), counts)
            shown = self._shown(colours, self.coloured, known)
            own[DISPLAY_COLOUR] = Vt.Vec3fArray.FromNumpy(np.nan_to_num(shown, copy=False))  # holes are invisible
        return own

    def _own(self, values):
        return values if self.vertices is None else values[self.vertices]

    def _shown(self, values, primvar, known):
        if self.primvars[primvar] == "vertex":
            values = values if self.point_vertices is None else values[self.point_vertices]
        elif self.face_triangles is not None:
            values = _face_means(values, known, self.face_triangles)
        return np.ascontiguousarray(values, dtype=np.float32)

    def _vectors(self, vectors):
        values = dict(vectors)
        if "normals" in self.attributes:
            values["normals"] = vertex_normals(values["points"], self.triangles)
        if self.transform is not None:
            linear, offset = self.transform[:3, :3], self.transform[3, :3]
            inverse = np.linalg.inv(linear)
            for name, value in values.items():
                # Normals are covectors: the transpose keeps them perpendicular to the surface, and on its front.
                if name == "normals":
                    values[name] = _unit(value @ linear.T)
                else:
                    values[name] = (np.asarray(value, np.float64) - (offset if name == "points" else 0.0)) @ inverse
        if self.point_vertices is not None:
            values = {name: value[self.point_vertices] for name, value in values.items()}
        values = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in values.items()}
        if "extent" in self.vectors:
            values["extent"] = self._extent(values["points"])
        return {name: Vt.Vec3fArray.FromNumpy(value) for name, value in values.items()}

    def _extent(self, points):
        # By column: NumPy reduces over a short last axis several times slower.
        low, high = [c.min() for c in points.T], [c.max() for c in points.T]
        return np.array([low, high], dtype=np.float32) + np.float32([[-self.half_width], [self.half_width]])


def check_primvars(primvars, mesh):
    """Checks that names are free, and interpolations "vertex" or, for triangles, "uniform"."""
    for name, interpolation in primvars.items():
        valid = isinstance(name, str) and Sdf.Path.IsValidNamespacedIdentifier(name) and not name.endswith(":indices")
        if not valid or name.startswith("primvars:"):
            raise ValueError(f"primvars: {name!r} must be a name such as rotationAngle, without primvars: before it")
        if name in _TAKEN:
            raise ValueError(f"primvars: {name!r} has a meaning already, must be none of {', '.join(_TAKEN)}")
        allowed = ("vertex", "uniform") if len(mesh.triangles) else ("vertex",)
        if interpolation not in allowed:
            of = "" if len(mesh.triangles) else " of a mesh of edges"
            raise ValueError(f"primvars[{name!r}] is {interpolation!r}; it must be {' or '.join(map(repr, allowed))}{of}")


def vertex_normals(points, triangles):
    """Unit normals (n, 3) of vertices of points (n, 3): area-weighted means over triangles (T, 3); +y without area."""
    # By column: NumPy takes twice as long for rows of three.
    corners = triangles.T.astype(np.intp)
    columns = [np.ascontiguousarray(column) for column in np.asarray(points).T]
    a, b = ([column.take(end) - column.take(corners[0]) for column in columns] for end in corners[1:])
    sums = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        doubled_areas = a[i] * b[j] - a[j] * b[i]
        sums.append(sum(np.bincount(corner, doubled_areas, len(points)) for corner in corners))
    return _unit(np.stack(sums, axis=1))


def _unit(vectors):
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    none = length == 0
    if none.any():
        vectors, length = vectors.copy(), length.copy()
        vectors[none], length[none] = (0, 1, 0), 1
    return vectors / length[:, None]


def _starts(counts):
    return np.cumsum(counts) - counts


def _face_means(values, known, face_triangles):
    """Means (F, …) of known values (T, …) over each face; NaN without one."""
    known = known.reshape(-1, *[1] * (values.ndim - 1))
    cut = face_triangles > 0
    starts = _starts(face_triangles[cut])
    means = np.full((len(face_triangles), *values.shape[1:]), np.nan)
    with np.errstate(invalid="ignore"):
        means[cut] = np.add.reduceat(np.where(known, values, 0.0), starts) / np.add.reduceat(known, starts, dtype=int)
    return means
