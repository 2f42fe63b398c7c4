"""Writes measures of a cloth, numbers and colours of its elements, over the measured stage or as a stage of their own."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..base.types import FilePath, UpAxis
from ..mesh.mesh import Mesh
from ..mesh.stage_mesh import StageMesh
from .chunks import ChunkWriter, check_scene
from .directions import check_directions, define_directions, middle, refuse_taken, segments, to_metres
from .layers import (
    artist_prim,
    artist_target,
    bind_material,
    declare_primvars,
    define_material,
    files_of_stage,
    root_metadata,
    scene_layer,
)
from .modules import Sdf, Usd, UsdGeom, UsdShade
from .stage import METADATA_KEY, read_stage_mesh
from .targets import DISPLAY_COLOUR, Interpolation, check_primvars


class MeasureWriter(ChunkWriter):
    """Writes measures of vertices or triangles as sampled primvars, in the files of `ChunkWriter`.

    With a source, the result is a layer over the measured stage with its time codes and rates, which adds `primvars:<name>`. A
    measure in colours also adds `primvars:displayColor`, doubleSided and a material that shows it. Without a source it is a
    complete stage, /World/Cloth.

    Unknown values are NaN. An artist's face has the mean of the known values and colours of its triangles.

    Directions are linear BasisCurves beside the prim, `<prim>_<name>`, a segment per element.

    Attributes:
        path: The file to open now: the output, or for .usdz before `close` a root layer in the folder.
        frames: Number of frames appended.
    """

    def __init__(
        self,
        output: FilePath,
        mesh: Mesh,
        primvars: Mapping[str, Interpolation],
        coloured: str | None = None,
        directions: Mapping[str, Interpolation] | None = None,
        source: StageMesh | Sequence[StageMesh] | None = None,
        fps: float = 24.0,
        up_axis: UpAxis | None = None,
        chunk: int = 10,
        metadata: Mapping[str, object] | None = None,
    ) -> None:
        """Checks everything; writes nothing yet.

        Args:
            output: File to write, as for `AnimationWriter`.
            mesh: The `Mesh` or `Surface`, at rest; with a source, as read from it.
            primvars: "vertex" or "uniform" (per triangle), by name of the primvar.
            coloured: Name of the primvar that displayColor shows, or None.
            directions: "vertex" or "uniform" by name of the segments, or None.
            source: The measured `StageMesh`, or several of one stage, in the order of ``mesh``; or None.
            fps: Frames and time codes per second, without a source.
            up_axis: "Y" or "Z", by default that of the mesh, without a source.
            chunk: Number of frames per chunk.
            metadata: Further customLayerData["warpcloth"]: numbers, texts or dicts of these.

        Raises:
            FileNotFoundError: The output's folder does not exist.
            ValueError: A parameter is not allowed; the output is a file of the source's stage; the source's prim is an
                instance, of another mesh, or has a primvar of another type.
        """
        super().__init__(output, mesh, chunk)
        # A set of its own, so that it does not hide earlier measures and the motion of the source.
        self._clip_set = f"measures_{self.run.name[-8:]}"
        up_axis = up_axis or mesh.up_axis or "Y"
        check_scene(fps, up_axis)
        primvars, directions = dict(primvars), dict(directions or {})
        check_primvars(primvars, mesh)
        check_directions(directions, mesh)
        if coloured is not None and coloured not in primvars:
            raise ValueError(f"coloured is {coloured!r}; it must be one of {', '.join(map(repr, primvars)) or 'none'}, or None")
        self._with_points, self._stage = source is None, None
        self._sources = [] if source is None else [source] if isinstance(source, StageMesh) else list(source)
        if len(self._sources) > 1 and directions:
            raise ValueError("directions: are of one prim, must be none of several sources")
        if source is None:
            self._checked("points of the rest shape", mesh.points)
            rest, target, facts = _scene(mesh, up_axis, primvars, coloured)
            own = [target]
            facts |= {"timeCodesPerSecond": float(fps), "framesPerSecond": float(fps)}
            stage, path, files, refit = Usd.Stage.Open(rest), None, (), None
            material = UsdShade.Material.Get(stage, "/World/Looks/Cloth")
        else:
            meshes = [mesh] if len(self._sources) == 1 else [each.mesh for each in self._sources]
            rest = Sdf.Layer.CreateAnonymous(".usdc")
            over = [_over(rest, *each, primvars, coloured) for each in zip(self._sources, meshes, strict=True)]
            own, (target, stage) = [target for target, _ in over], over[0]
            first = self._sources[0]
            facts, path, files = _facts_of(stage, first), first.path, files_of_stage(stage)
            for each, (_, of) in zip(self._sources, over, strict=True):
                material = _show_colours(of, each, with_mesh=bool(coloured)) if coloured or directions else None
            self._stage = stage

            def refit():
                for each, found in zip(self._sources, meshes, strict=True):
                    artist_prim(read_stage_mesh(each.path, each.prim, type(each.mesh), time=0.0), found)

        self._directions = dict(directions)
        self._nowhere = middle(mesh)
        targets = define_directions(stage, target.prim, mesh, directions, material, self._nowhere) if directions else []
        self._own = len(own)
        self._put_on(rest, [*own, *targets], facts, metadata, path, files, refit)
        if len(own) > 1:  # otherwise readers of one cloth would read the first
            del self._root_metadata["customLayerData"][METADATA_KEY]["prim"]

    def append(
        self,
        time_code: float,
        primvars: Mapping[str, ArrayLike],
        colours: ArrayLike | None = None,
        directions: Mapping[str, ArrayLike] | None = None,
        points: np.ndarray | None = None,
    ) -> None:
        """Adds a frame; every `chunk` frames they are written.

        Args:
            time_code: Time code in the source, or the frame's number; it must increase.
            primvars: Values by name, (n,) or (T,); NaN if unknown.
            colours: Linear RGB (n, 3) or (T, 3) of the shown primvar, if any.
            directions: Centres and vectors [m] by name, both (n, 3) or (T, 3), in world space; without a segment where NaN.
            points: (n, 3) [m], finite, in world space; without a source.

        Raises:
            ValueError: Values, shapes or the time code are not as declared, a value is infinite as float32, or the writer is
                closed.
        """
        self._check_open()
        if not math.isfinite(time_code) or (self._span and time_code <= self._span[1]):
            raise ValueError(f"time_code is {time_code} at frame {self.frames}; it must be finite and after the one before")
        target, time = self._targets[0], float(time_code)
        primvars = self._checked_primvars(primvars, unknown=True)
        _check_given("colours", colours, target.coloured)
        if colours is not None:
            colours = self._checked("colours", colours, target.primvars[target.coloured])
        _check_given("points", points, self._with_points)
        vectors = {} if points is None else {"points": self._checked("points", points)}
        values = [*self._samples(vectors, primvars, colours), *self._curves(time, directions or {})]
        samples = zip(self._targets, values, strict=True)
        self._append(time, {f"{t.prim}.{name}": value for t, own in samples for name, value in own.items()})

    def _samples(self, vectors, primvars, colours):
        starts = {"vertex": 0, "uniform": 0}
        for k, target in enumerate(self._targets[: self._own]):
            mesh = self._sources[k].mesh if self._own > 1 else None
            ends = self._counts if mesh is None else {"vertex": len(mesh.points), "uniform": len(mesh.triangles)}
            parts = {kind: slice(start, start + ends[kind]) for kind, start in starts.items()}
            own = {name: values[parts[target.primvars[name]]] for name, values in primvars.items()}
            shown = None if colours is None else colours[parts[target.primvars[target.coloured]]]
            yield target.samples(vectors, own, shown)
            starts = {kind: part.stop for kind, part in parts.items()}

    def _curves(self, time, directions):
        if directions.keys() != self._directions.keys():
            names = [", ".join(map(repr, given)) or "none" for given in (directions, self._directions)]
            raise ValueError(f"directions: {names[0]} at frame {self.frames}, must be {names[1]}")
        for target, (name, interpolation) in zip(self._targets[self._own :], self._directions.items(), strict=True):
            both = [
                self._checked(f"{part} of directions[{name!r}]", values, interpolation, unknown=True)
                for part, values in zip(("centres", "vectors"), directions[name], strict=True)
            ]
            if self._stage:
                target = replace(target, transform=to_metres(self._stage, target.prim, time))
            yield target.samples({"points": segments(*both, self._nowhere)})


def _check_given(name, value, wanted):
    if (value is None) == bool(wanted):
        raise ValueError(f"{name}: must be {'given with each frame' if wanted else 'left out, this writer has none'}")


def _scene(mesh, up_axis, primvars, coloured):
    rest, target, facts = scene_layer(mesh, None, up_axis, "Cloth")
    target = replace(target, vectors=("points", "normals", "extent"), primvars=primvars, coloured=coloured)
    target.declare(rest, target.attributes)
    if coloured:
        # A single colour would override those of the elements.
        rest.GetAttributeAtPath(f"{target.prim}.{DISPLAY_COLOUR}").ClearDefaultValue()
    return rest, target, facts


def _over(rest, source, mesh, primvars, coloured):
    """Adds primvars on the artist's prim to a layer; returns the `Target`, and a stage that edits the layer."""
    stage, artist = artist_prim(source, mesh)
    target = artist_target(artist, source, primvars, vectors=(), coloured=coloured)
    Sdf.CreatePrimInLayer(rest, target.prim)
    declare_primvars(rest, artist, target, source.path)
    stage.GetSessionLayer().subLayerPaths.append(rest.identifier)
    stage.SetEditTarget(Usd.EditTarget(rest))
    return target, stage


def _facts_of(stage, source):
    root = stage.GetRootLayer()
    rates = {"timeCodesPerSecond": source.time_codes_per_second, "framesPerSecond": source.fps or source.time_codes_per_second}
    start = {"startTimeCode": root.startTimeCode} if root.HasStartTimeCode() else {}
    end = {"endTimeCode": root.endTimeCode} if root.HasEndTimeCode() else {}
    return root_metadata(stage) | rates | start | end


def _show_colours(stage, source, with_mesh):
    """Defines a material that shows displayColor; ``with_mesh`` binds it to the prim and its faces."""
    path = f"{source.prim}/DisplayColour"
    refuse_taken(stage, path, "Material")
    material = define_material(stage, path)
    if not with_mesh:
        return material
    prim = stage.GetPrimAtPath(source.prim)
    UsdGeom.Gprim(prim).CreateDoubleSidedAttr(True)
    parts = UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(prim), familyName=UsdShade.Tokens.materialBind)
    for part in (prim, *(subset.GetPrim() for subset in parts)):
        bind_material(part, material)
        # Materials bound for a purpose override those for all purposes.
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            bound = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial(purpose)[0]
            if bound and bound.GetPath() != path:
                UsdShade.MaterialBindingAPI(part).Bind(material, materialPurpose=purpose)
        bound = {
            UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial(p)[0]
            for p in UsdShade.MaterialBindingAPI.GetMaterialPurposes()
        }
        if hiding := sorted(str(other.GetPath()) for other in bound if other.GetPath() != path):
            warnings.warn(
                f"{source.path}, prim {part.GetPath()}: the material {hiding[0]} is bound above it, stronger than any on it, "
                "and may hide the colours",
                stacklevel=4,
            )
    return material
