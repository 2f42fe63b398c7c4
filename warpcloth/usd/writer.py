"""Writes an animation: the motion of a cloth, and data per vertex, triangle or frame."""

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
    """Writes frames of a cloth as USD, in the files of `ChunkWriter`.

    With a source, the result is a layer over the artist's stage, which never changes, with points, velocities, normals, extent
    and subdivisionScheme of one prim, in its space and units. It blocks accelerations and `primvars:normals`. Time codes start
    at the time of the source's first one, else at 0.

    Data are float primvars, `primvars:<name>`; a face gets the mean of its triangles.

    Edge meshes become linear BasisCurves along paths of edges; where curves meet, each has its own point, and
    `primvars:warpcloth:vertex` gives vertices.

    Attributes:
        path: The file to open: the output, or for .usdz before `close` a root layer in the folder.
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
        whole: bool = False,
    ) -> None:
        """Checks the arguments; nothing is written before the first frame.

        Args:
            output: File to write: .usd, .usda, .usdc, or .usdz, which is always one file; for a link the file behind it.
            mesh: The `Mesh` at rest; with a source as read from it.
            fps: Frames per second; also time codes per second.
            source: A stage to write a layer over, or None.
            prim: With a source, path or name of the prim; else name under /World, by default "Cloth".
            pins: Vertex indices by name, written as GeomSubsets; without a source.
            up_axis: "Y" or "Z", by default that of the mesh; without a source.
            chunk: Number of frames written together, which a killed process may lose.
            metadata: Further customLayerData["warpcloth"]: numbers or texts by name.
            primvars: Interpolation of each primvar by name: "vertex", or "uniform" for triangles.
            lines: Pairs of vertices (E, 2) and a thickness [m] by name, drawn as curves; without a source.
            colliders: Written as gprims under /World/Colliders, with motion; without a source.
            history: Types of history primvars by name: "float3[]" per vertex, "double3" or "double" per cloth. Of several
                cloths, the first has those of the whole.
            cloths: Prims by part, if each part has its own: names under /World, or paths in a source; without primvars.
            whole: Whether an older output is replaced only once all frames are written.

        Raises:
            FileNotFoundError: The folder of the output or the source does not exist.
            ValueError: A parameter is not allowed, or the output is a file of the source's stage.
        """
        super().__init__(output, mesh, chunk, whole)
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
            # Clips contain only samples; name, type and interpolation must be on the stage itself.
            for target in targets:
                target.declare(rest, [f"primvars:{name}" for name in (*target.primvars, *target.history)])
            targets += define_lines(rest, mesh, lines or {})
            define_colliders(rest, colliders, mesh)
            if colliders:  # their keyframes are in this layer, which has 24 time codes per second by default
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
        """Adds a frame; `chunk` of them are written together.

        Args:
            points: (n, 3) [m], world space.
            velocities: (n, 3) [m/s].
            primvars: Values of declared primvars by name, (n,), or (T,) if uniform.
            history: Values of declared history primvars by name, (n, 3), (3,) or a number, in SI units.

        Raises:
            ValueError: Values or shapes are not as declared, a value is not finite as float32, or the writer is closed.
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
    own = mesh.part(name)
    first = (mesh.parts or {})[name].first
    return slice(first, first + len(own.points)), own, prim


def _pins_of(pins, vertices):
    if vertices is None or not pins:
        return pins
    found = {name: np.asarray(given) for name, given in pins.items()}
    found = {name: given[(given >= vertices.start) & (given < vertices.stop)] - vertices.start for name, given in found.items()}
    return {name: given for name, given in found.items() if len(given)}


def _of_vertices(history):
    return {name: kind for name, kind in history.items() if kind == "float3[]"}


class _MovingSpace:
    """The space of a prim of the source with an animated transform, frame by frame."""

    def __init__(self, transform_at, stage, fps):
        self._transform_at, self._fps = transform_at, fps
        self._first, self._rate = stage.start or 0.0, stage.time_codes_per_second / fps

    def at(self, frame, points, velocities):
        """The transform (4, 4) at a frame, and the velocities (n, 3) [m/s] relative to the moving space.

        The velocity of the space is its displacement since the frame before, times fps.
        """
        now = self._transform_at(self._first + frame * self._rate)
        if frame == 0:
            return now, velocities
        before = self._transform_at(self._first + (frame - 1) * self._rate)
        local = (points - now[3, :3]) @ np.linalg.inv(now[:3, :3])
        return now, velocities - self._fps * carried(local, before, now)
