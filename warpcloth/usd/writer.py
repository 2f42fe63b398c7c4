"""Writing an animation: the motion of a cloth, and numbers that go with it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..base.types import FilePath, UpAxis
from ..mesh.mesh import Mesh
from ..scene.colliders import Collider
from .chunks import ChunkWriter, check_scene
from .gprims import define_colliders
from .layers import artist_prim, define_cloth, define_lines, over_layer, scene_layer
from .stage import carried, read_stage_mesh
from .targets import Interpolation, check_primvars


class AnimationWriter(ChunkWriter):
    """Writes frames of a cloth as USD: `ChunkWriter` says in what files.

    With a source the result is a layer over the artist's stage, which it sublayers by a relative path and never
    changes: it has opinions on points, velocities, normals, extent and subdivisionScheme of one prim, in that prim's
    own space and units, and blocks accelerations and `primvars:normals`, which would be used instead. Time codes start
    at the source's own first one (at the same second, where fps differs from its time codes per second), or else at 0.

    Numbers that go with the motion are float primvars, `primvars:<name>`, sampled as the points are. An artist's faces
    with more corners than three have the mean over the triangles that they were cut into.

    Edge meshes become linear BasisCurves along paths of edges (a chain: one curve, its vertices in order); where curves
    meet each has a point for the vertex, and `primvars:warpcloth:vertex` says which vertex a point is. Lines are curves of the
    same kind beside a mesh of triangles.

    Attributes:
        path: The file to open now: the output, or for .usdz before `close` a root layer in the folder.
        frames: Number of frames appended.
    """

    def __init__(
        self,
        output: FilePath,
        mesh: Mesh,
        fps: float,
        source: FilePath | None = None,
        prim: str | None = None,
        pins: Mapping[str, ArrayLike] | None = None,
        up_axis: UpAxis | None = None,
        chunk: int = 10,
        metadata: Mapping[str, object] | None = None,
        primvars: Mapping[str, Interpolation] | None = None,
        lines: Mapping[str, tuple[np.ndarray, float]] | None = None,
        colliders: Sequence[Collider] = (),
        history: Mapping[str, str] | None = None,
        cloths: Mapping[str, str] | None = None,
    ) -> None:
        """Checks everything that can be checked before the first frame; writes nothing yet.

        Args:
            output: File to write: .usd, .usda, .usdc, or .usdz, which is always one file. Of a link the file that it stands
                for is written, with the folder beside that; viewers find the frames through a link in the same folder only.
            mesh: The `Mesh`; its points are the rest shape. With a source: as read from it.
            fps: Frames per second; also time codes per second.
            source: A stage to write a layer over, or None.
            prim: Of a source: path or name of the prim. Without: name of the prim under /World, "Cloth" if None.
            pins: Vertex indices by name, written as GeomSubsets in the family "pins". A source has its own.
            up_axis: "Y" or "Z", by default that of the mesh; a source has its own.
            chunk: Frames of a chunk: what a killed process may lose, and what is held in memory.
            metadata: More to keep in the root layer's customLayerData["warpcloth"]: names with numbers or texts.
            primvars: Interpolation of each primvar that `append` will be given, by name: "vertex", a value for each
                vertex, or "uniform", one for each triangle.
            lines: Pairs of vertices (E, 2) and a thickness [m] by name, drawn as curves beside the cloth;
                `lines.lines_of` finds those of a scene. Not allowed with a source.
            colliders: Drawn as gprims under /World/Colliders, with their motion; a layer over a source has none.
            history: Type of each primvar of the history of a run, by name: "float3[]", a vector for each vertex, or "double3"
                or "double", a vector or a number of the whole cloth; of several cloths the first has those of the whole.
            cloths: For a mesh whose parts have a prim each, the prims by part: names under /World, or with a source paths.
                Primvars are not allowed then.

        Raises:
            FileNotFoundError: The output's folder or the source does not exist.
            ValueError: A parameter is not as above, or the output is a file of the source's stage.
        """
        super().__init__(output, mesh, chunk)
        up_axis = up_axis or mesh.up_axis or "Y"
        check_scene(fps, up_axis)
        primvars, history = dict(primvars or {}), dict(history or {})
        check_primvars(primvars | dict.fromkeys(history, "vertex"), mesh)
        if cloths and primvars:
            raise ValueError("primvars are given for several cloths, which have none; write each cloth by itself")
        each = [_of_part(mesh, *named) for named in cloths.items()] if cloths else [(None, mesh, prim)]
        self._start, self._moving_spaces, files, refit = 0.0, {}, (), None
        if source is None:
            (vertices, own, name), *others = each
            rest, target, root_metadata = scene_layer(own, _pins_of(pins, vertices), up_axis, name or "Cloth")
            targets = [replace(target, primvars=primvars, history=history, vertices=vertices)]
            for vertices, own, name in others:
                target = define_cloth(rest, own, _pins_of(pins, vertices), name)
                targets.append(replace(target, history=_of_vertices(history), vertices=vertices))
            # Clips have samples alone; a name, type and interpolation have to stand on the stage itself.
            for target in targets:
                target.declare(rest, [f"primvars:{name}" for name in (*target.primvars, *target.history)])
            targets += define_lines(rest, mesh, lines or {})
            define_colliders(rest, colliders, mesh)
            if colliders:  # whose keyframes are in this layer, and would be read at 24 a second otherwise
                rest.timeCodesPerSecond = float(fps)
        else:
            for name, given in (("pins", pins), ("lines", lines)):
                if given:
                    raise ValueError(f"{name}: a source has its own, and a layer over it writes none; leave them out")
            rest, targets, stages = None, [], []
            for vertices, own, name in each:
                of_cloth = _of_vertices(history) if targets else history
                found = over_layer(source, name, own, primvars, of_cloth, rest)
                rest, target, root_metadata, stage, files, transform_at = found
                if transform_at:
                    self._moving_spaces[len(targets)] = _MovingSpace(transform_at, stage, fps)
                targets.append(replace(target, vertices=vertices))
                stages.append(stage)
            if stage.start is not None:
                self._start = stage.start * fps / stage.time_codes_per_second

            def refit():
                for stage, (_vertices, own, _name) in zip(stages, each, strict=True):
                    artist_prim(read_stage_mesh(source, stage.prim, time=0.0), own)

        root_metadata |= {"timeCodesPerSecond": float(fps), "framesPerSecond": float(fps)}
        self._put_on(rest, targets, root_metadata, metadata, source, files, refit)

    def append(
        self,
        points: np.ndarray,
        velocities: np.ndarray,
        primvars: Mapping[str, ArrayLike] | None = None,
        history: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Adds a frame; every `chunk` frames they are written.

        Args:
            points: (n, 3) [m], world space.
            velocities: (n, 3) [m/s].
            primvars: Values by name of all primvars that were declared, (n,) or, where uniform, (T,).
            history: Values by name of all that `history` declared, (n, 3), (3,) or a number, in SI and in world space.

        Raises:
            ValueError: Other primvars than declared, a wrong shape, or a value that is not finite as float32, with the
                frame and the vertex or triangle; the writer is closed.
        """
        self._check_open()
        vectors = {"points": self._checked("points", points), "velocities": self._checked("velocities", velocities)}
        primvars, samples = self._checked_primvars(primvars), {}
        for k, target in enumerate(self._targets):
            own = vectors
            if k in self._moving_spaces:
                of_cloth = slice(None) if target.vertices is None else target.vertices
                own = vectors | {"velocities": np.array(vectors["velocities"], dtype=np.float64)}
                found = self._moving_spaces[k].at(self.frames, own["points"][of_cloth], own["velocities"][of_cloth])
                transform, own["velocities"][of_cloth] = found
                target = replace(target, transform=transform)
            found = target.samples(own, {} if k else primvars, None, history)
            samples |= {f"{target.prim}.{name}": value for name, value in found.items()}
        self._append(self._start + self.frames, samples)


def _of_part(mesh, name, prim):
    """The vertices of a part, its mesh and the prim."""
    own = mesh.part(name)
    first = (mesh.parts or {})[name].first
    return slice(first, first + len(own.points)), own, prim


def _pins_of(pins, vertices):
    """Pins by name, those among the vertices of a part, counted from its first."""
    if vertices is None or not pins:
        return pins
    found = {name: np.asarray(given) for name, given in pins.items()}
    found = {name: given[(given >= vertices.start) & (given < vertices.stop)] - vertices.start for name, given in found.items()}
    return {name: given for name, given in found.items() if len(given)}


def _of_vertices(history):
    """The types of the primvars of a history that have a value for each vertex."""
    return {name: kind for name, kind in history.items() if kind == "float3[]"}


class _MovingSpace:
    """The space of an artist's prim whose transform is animated, frame by frame.

    Args:
        transform_at: The transform (4, 4) at a time code.
        stage: The `StageMesh`.
        fps: Frames per second.
    """

    def __init__(self, transform_at, stage, fps):
        self._transform_at, self._fps = transform_at, fps
        self._first, self._rate = stage.start or 0.0, stage.time_codes_per_second / fps

    def at(self, frame, points, velocities):
        """The transform (4, 4) at a frame, and velocities (n, 3) [m/s] relative to the space that carries the points there.

        The velocity of the space is that of the way since the frame before, as that of moving pins.
        """
        now = self._transform_at(self._first + frame * self._rate)
        if frame == 0:
            return now, velocities
        before = self._transform_at(self._first + (frame - 1) * self._rate)
        local = (points - now[3, :3]) @ np.linalg.inv(now[:3, :3])
        return now, velocities - self._fps * carried(local, before, now)
