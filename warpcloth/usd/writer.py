"""Writing an animation so that it can be opened at any moment, whatever happens to the process that writes it."""

import os
import re
import secrets
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdUtils

from .layers import check_primvars, flatten, over_layer, relative_path, scene_layer
from .stage import METADATA_KEY, followed

_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
_CLIP_SET = "warpcloth"


class AnimationWriter:
    """Writes frames of a cloth as USD, in chunks that are each written once.

    While it runs, the result is a small root layer, `path`, and a folder beside it, `<stem>_frames/<run>/`, with

    - `rest.usdc`: all that is not animated. Without a source a complete stage, /World/Cloth and its material; with one,
      what has to be said once about the artist's prim. It is weaker than the frames and stronger than the source.
    - `frames_000000.usdc` and so on: value clips of `chunk` frames. USD interpolates between the last frame of one and
      the first frame of the next too.
    - `manifest.usda`: the names of the animated attributes, so that no chunk need be opened to find them.

    Every file is written under another name, complete, and then renamed; the root is replaced after each chunk. So a
    process killed at any moment leaves a result that opens, with at most one chunk of frames missing, and the result of
    an earlier run stays whole until the first chunk of this one stands. Files are not forced to the disk (fsync): a
    killed process loses nothing by that, a power failure may lose the newest chunks. Memory holds one chunk. The folder
    belongs to the file: move them together, or make one file of them with `close(single_file=True)`. One writer at a
    time for an output.

    With a source the result is a layer over the artist's stage, which it sublayers by a relative path and never
    changes: it has opinions on points, velocities, normals, extent and subdivisionScheme of one prim, in that prim's
    own space and units, and blocks accelerations and `primvars:normals`, which would be used instead. Time codes start
    at the source's own first one (at the same second, where fps differs from its time codes per second), or else at 0.

    Numbers that go with the motion are float primvars, `primvars:<name>`, sampled as the points are. An artist's faces
    with more corners than three have the mean over the triangles that they were cut into.

    Edge meshes become linear BasisCurves along paths of edges (a chain: one curve, its vertices in order); where curves
    meet each has a point for the vertex, and `primvars:warpcloth:vertex` says which vertex a point is.

    Attributes:
        path: The file to open now: the output, or for .usdz before `close` a root layer in the folder.
        frames: Number of frames appended.
    """

    def __init__(
        self, output, mesh, fps, source=None, prim=None, pins=None, up_axis="Y", chunk=10, metadata=None, primvars=None
    ):
        """Checks everything that can be checked before the first frame; writes nothing yet.

        Args:
            output: File to write: .usd, .usda, .usdc, or .usdz, which is always one file. Of a link the file that it stands
                for is written, with the folder beside that; viewers find the frames through a link in the same folder only.
            mesh: The `Mesh`; its points are the rest shape. With a source: as read from it.
            fps: Frames per second; also time codes per second.
            source: A stage to write a layer over, or None.
            prim: Of a source: path or name of the prim. Without: name of the prim under /World, "Cloth" if None.
            pins: Vertex indices by name, written as GeomSubsets in the family "pins". A source has its own.
            up_axis: "Y" or "Z"; a source has its own.
            chunk: Frames of a chunk: what a killed process may lose, and what is held in memory.
            metadata: More to keep in the root layer's customLayerData["warpcloth"]: names with numbers or texts.
            primvars: Interpolation of each primvar that `append` will be given, by name: "vertex", a value for each
                vertex, or "uniform", one for each triangle.

        Raises:
            FileNotFoundError: The output's folder or the source does not exist.
            ValueError: A parameter is not as above, or the output is a file of the source's stage.
        """
        self._output = Path(os.path.abspath(followed(output)))
        _check_output(self._output)
        if self._output.suffix != Path(output).suffix:
            raise ValueError(f"output = {output}: is a link to {self._output}, must end as that does")
        _check_options(fps, up_axis, chunk)
        primvars = dict(primvars or {})
        check_primvars(primvars, mesh)
        self._source = None if source is None else Path(os.path.abspath(source))
        start = 0.0
        if source is None:
            name = prim or "Cloth"
            if not Sdf.Path.IsValidIdentifier(name):
                raise ValueError(f"prim = {name!r}: must be a name of letters, digits and _ where there is no source")
            self._rest, self._target, self._root_metadata = scene_layer(mesh, pins, up_axis, name)
        else:
            if pins:
                raise ValueError("pins: a source has its own, and a layer over it writes none; leave them out")
            self._rest, self._target, self._root_metadata, stage, files = over_layer(source, prim, mesh, primvars)
            if os.path.realpath(self._output) in files:
                raise ValueError(f"output = {output}: is a file of the source's stage, which must not be changed")
            if stage.start is not None:
                start = stage.start * fps / stage.time_codes_per_second
        self._target = replace(self._target, primvars=primvars)
        # Clips have samples alone; a name, type and interpolation have to stand on the stage itself.
        self._target.declare(self._rest, [f"primvars:{name}" for name in primvars])
        self._root_metadata["customLayerData"] = {METADATA_KEY: {**(metadata or {}), "prim": self._target.prim}}
        self._start, self._fps, self._chunk = start, float(fps), int(chunk)
        self._counts = {"vertex": len(mesh.points), "uniform": len(mesh.triangles)}
        self._folder = frames_folder(self._output)
        if self._folder.exists() and not self._folder.is_dir():
            raise ValueError(f"{self._folder}: is a file, must be free for the folder of frames")
        # A name never used before: pxr may still hold layers of an earlier run in this process, and would show those.
        self._run = self._folder / f"{self._output.suffix[1:]}-{secrets.token_hex(4)}"
        self.path = str(self._run / "animation.usdc" if self._output.suffix == ".usdz" else self._output)
        self.frames = 0
        self._pending = []
        self._chunks = []  # (first time code, file) of each chunk that stands
        self._closed = False

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            self.close()
        elif not self._closed:
            # What there is may be worth a look; it stays in chunks, for nobody waits for one file.
            self._write_chunk()
            self._closed = True

    def append(self, points, velocities, primvars=None):
        """Adds a frame; every `chunk` frames they are written.

        Args:
            points: (n, 3) [m], world space.
            velocities: (n, 3) [m/s].
            primvars: Values by name of all primvars that were declared, (n,) or, where uniform, (T,).

        Raises:
            ValueError: Other primvars than declared, a wrong shape, or a value that is not finite as float32, with the
                frame and the vertex or triangle; the writer is closed.
        """
        if self._closed:
            raise ValueError(f"{self._output}: is closed, no frame can be appended")
        points = self._checked("points", points)
        velocities = self._checked("velocities", velocities)
        declared, primvars = self._target.primvars, primvars or {}
        if primvars.keys() != declared.keys():
            names = ", ".join(map(repr, primvars)) or "none"
            raise ValueError(f"primvars: {names} at frame {self.frames}, must be {', '.join(map(repr, declared)) or 'none'}")
        primvars = {name: self._checked(f"primvars[{name!r}]", primvars[name], declared[name], ()) for name in declared}
        samples = self._target.samples(points, velocities, primvars)
        self._pending.append((self._start + self.frames, samples))
        self.frames += 1
        if len(self._pending) >= self._chunk:
            self._write_chunk()

    def close(self, single_file=False):
        """Writes what is pending. Without a single frame nothing is written.

        Args:
            single_file: Make one self-contained file, with all of the source in it, and remove the folder. Frames are
                copied chunk by chunk, so that memory stays flat; .usda alone is written from a binary file. A .usdz
                always is one.

        Raises:
            OSError: A file could not be written; the chunks that stand stay.
        """
        if self._closed:
            return
        self._write_chunk()
        self._closed = True
        if self._chunks and (single_file or self._output.suffix == ".usdz"):
            self._write_single_file()

    def _checked(self, name, values, interpolation="vertex", components=(3,)):
        values = np.asarray(values)
        shape = (self._counts[interpolation], *components)
        if values.shape != shape:
            raise ValueError(f"{name}: shape {values.shape} at frame {self.frames}, must be {shape}")
        with np.errstate(over="ignore"):
            finite = np.isfinite(values.astype(np.float32, copy=False))
        if not finite.all():
            row = int(np.argmin(finite)) // (3 if components else 1)
            where = f"frame {self.frames}, {'vertex' if interpolation == 'vertex' else 'triangle'} {row}"
            raise ValueError(f"{name}: {values[row].tolist()} at {where}, must be finite in float32")
        return values

    def _write_chunk(self):
        """Writes the pending frames as a clip, and a root that has it."""
        if not self._pending:
            return
        if not self._chunks:
            self._start_run()
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        self._target.declare(layer, self._target.attributes)
        for time, values in self._pending:
            for name, value in values.items():
                layer.SetTimeSample(f"{self._target.prim}.{name}", time, value)
        layer.timeCodesPerSecond = layer.framesPerSecond = self._fps
        layer.startTimeCode, layer.endTimeCode = self._pending[0][0], self._pending[-1][0]
        path = self._run / f"frames_{len(self._chunks):06d}.usdc"
        export(layer, path)
        chunks = [*self._chunks, (self._pending[0][0], path)]
        self._write_root(chunks)
        # Only now, so that a chunk whose writing was interrupted is written again by close.
        self._chunks, self._pending = chunks, []
        if len(chunks) == 1:
            self._remove_other_runs()

    def _start_run(self):
        self._run.mkdir(parents=True, exist_ok=True)
        export(self._rest, self._run / "rest.usdc")
        manifest = Sdf.Layer.CreateAnonymous(".usda")
        self._target.declare(manifest, self._target.attributes)
        export(manifest, self._run / "manifest.usda")

    def _write_root(self, chunks):
        """Writes a root that has these chunks."""
        folder = Path(self.path).parent
        end = self._start + self.frames - 1
        layer = Sdf.Layer.CreateAnonymous(".usda")
        stage = Usd.Stage.Open(layer)
        clips = Usd.ClipsAPI(stage.OverridePrim(self._target.prim))
        asset_paths = [Sdf.AssetPath(relative_path(path, folder)) for _, path in chunks]
        clips.SetClipAssetPaths(asset_paths, _CLIP_SET)
        clips.SetClipManifestAssetPath(Sdf.AssetPath(relative_path(self._run / "manifest.usda", folder)), _CLIP_SET)
        clips.SetClipPrimPath(self._target.prim, _CLIP_SET)
        clips.SetClipActive([(time, index) for index, (time, _) in enumerate(chunks)], _CLIP_SET)
        # Clip time is stage time. One frame has one time: listed twice, USD 25.5 reports the frame twice.
        clips.SetClipTimes([(time, time) for time in sorted({self._start, end})], _CLIP_SET)
        del clips, stage
        self._describe(layer)
        # Last, for an anonymous layer cannot tell what they are relative to.
        layer.subLayerPaths = [relative_path(path, folder) for path in self._base_paths()]
        export(layer, self.path, self._run)

    def _describe(self, layer):
        """Writes on a root layer what is read from root layers only."""
        for name, value in self._root_metadata.items():
            layer.pseudoRoot.SetInfo(name, value)
        layer.timeCodesPerSecond = layer.framesPerSecond = self._fps
        layer.startTimeCode, layer.endTimeCode = self._start, self._start + self.frames - 1

    def _base_paths(self):
        return [self._run / "rest.usdc"] + ([self._source] if self._source else [])

    def _remove_other_runs(self):
        """Removes what earlier runs to the same output left, now that the output no longer refers to it."""
        own_kind = re.compile(re.escape(self._output.suffix[1:]) + "-[0-9a-f]{8}")
        for folder in self._folder.iterdir():
            if folder != self._run and own_kind.fullmatch(folder.name):
                shutil.rmtree(folder)

    def _write_single_file(self):
        packed = self._output.suffix == ".usdz"
        flat = flatten(self._base_paths(), self._describe, None if packed else self._output.parent)
        self._target.declare(flat, self._target.attributes)
        for name in self._target.attributes:
            flat.GetAttributeAtPath(f"{self._target.prim}.{name}").ClearInfo("timeSamples")
        single = self._run / f"{self._output.stem}.usdc"
        flat.Export(str(single))
        self._copy_frames(single)
        finished = self._run / f"finished{self._output.suffix}"
        if packed:
            if not UsdUtils.CreateNewUsdzPackage(str(single), str(finished)):
                raise OSError(f"{finished}: could not be written")
        elif self._output.suffix == ".usda":
            export(Sdf.Layer.FindOrOpen(str(single)), finished)
        else:
            os.replace(single, finished)
        os.replace(finished, self._output)
        self.path = str(self._output)
        shutil.rmtree(self._run)
        if not any(self._folder.iterdir()):
            self._folder.rmdir()

    def _copy_frames(self, single):
        """Copies all chunks to a binary layer, saved in place: nobody needs that file if the process dies."""
        layer = Sdf.Layer.FindOrOpen(str(single))
        for _, path in self._chunks:
            chunk = Sdf.Layer.FindOrOpen(str(path))
            for name in self._target.attributes:
                attribute = f"{self._target.prim}.{name}"
                for time in chunk.ListTimeSamplesForPath(attribute):
                    layer.SetTimeSample(attribute, time, chunk.QueryTimeSample(attribute, time))
            if not layer.Save():
                raise OSError(f"{single}: could not be written")


def frames_folder(output):
    """The folder of frames that belongs to an output; of a link beside the file that it stands for."""
    output = Path(followed(output))
    return output.parent / f"{output.stem}_frames"


def _check_output(output):
    if output.suffix not in _ENDINGS:
        raise ValueError(f"output = {output}: must end with one of {', '.join(_ENDINGS)}")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"output = {output}: the folder {output.parent} does not exist")
    if output.is_dir():
        raise ValueError(f"output = {output}: is a folder, must be a file")


def _check_options(fps, up_axis, chunk):
    if not (np.isscalar(fps) and np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps = {fps}: must be positive and finite")
    if up_axis not in ("Y", "Z"):
        raise ValueError(f'up_axis = {up_axis!r}: must be "Y" or "Z"')
    if int(chunk) != chunk or chunk < 1:
        raise ValueError(f"chunk = {chunk}: must be a whole number, at least 1")


def export(layer, path, unfinished_in=None):
    """Writes a layer under another name first, so that the path has either what was there or the whole layer."""
    path = Path(path)
    unfinished = Path(unfinished_in or path.parent) / f"unfinished{path.suffix}"
    if not layer.Export(str(unfinished)):
        raise OSError(f"{path}: could not be written")
    os.replace(unfinished, path)
