"""Writes time samples in chunks, so that the result can be opened at any moment, even after the process is killed."""

import os
import re
import secrets
import shutil
import sys
import warnings
import weakref
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..base.interrupts import deferred
from ..base.outputs import Lock, keep_mode
from .layers import flattened_layer, named_from, relative_path
from .modules import Sdf, Usd
from .packages import Contents
from .stage import METADATA_KEY, followed, identity
from .values import refuse_path, sentences

_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
_ROOT = "animation.usdc"  # root of a .usdz until it is packed, and of frames whose output cannot be written
_MANIFEST = "manifest.usda"
_FRAMES = re.compile(r"frames_(\d{6,})\.usdc")
_COMPLETE = "complete"  # file that marks the folder of a run whose frames are complete but not packed yet
_NAMES = {_ROOT, "rest.usdc", _COMPLETE, "checkpoint.npz", "checkpoint.unfinished", _MANIFEST}  # the others of a run


class ChunkWriter:
    """Writes samples of a few prims over a layer, in chunks that are each written once.

    The result is a root layer, `path`, and a folder `<stem>_frames/<run>/` beside it, with

    - `rest.usdc`: everything that is not animated, stronger than a source;
    - `frames_000000.usdc` and so on: value clips of `chunk` frames;
    - `manifest.usda`: the names of the animated attributes.

    Files are written under temporary names and renamed; the root is replaced after each chunk. So a killed process leaves a
    result that opens, without at most one chunk; a power failure may lose more. An earlier result stays whole until the first
    chunk is written, or for .usdz the package. An output has one writer at a time, in all processes. An interrupt (Ctrl-C)
    waits for a chunk or `close`; a second one does not.

    A run removes the files of earlier runs to the output, except those that it reads and complete frames of a .usdz that was
    not packed; nothing else, and nothing behind a link.

    Attributes:
        path: The file to open now: the output, or for .usdz before `close` a root layer in the folder.
        frames: Number of frames appended.
        kept: Number of appended frames that are in the file.
        chunk: Number of frames per chunk.
        run: The folder of the chunks.
    """

    # Name of the set of value clips of all sampled prims. It hides a set with this name in the source.
    _clip_set = METADATA_KEY

    def __init__(self, output, mesh, chunk, whole=False):
        """Checks the output, a stage or the link to one; `_put_on` comes next. If ``whole``, only `close` writes the root, and
        an error removes the chunks.
        """
        self._whole = whole
        self._output = check_output(output)
        if int(chunk) != chunk or chunk < 1:
            raise ValueError(f"chunk is {chunk}; it must be a whole number, at least 1")
        self.chunk = int(chunk)
        self._counts = {"vertex": len(mesh.points), "uniform": len(mesh.triangles)}
        self._folder, self._packed = frames_folder(self._output), self._output.suffix == ".usdz"
        if self._folder.exists() and not self._folder.is_dir():
            raise ValueError(f"{self._folder}: is a file, must be free for the folder of frames")
        # A new name, because pxr may still hold layers of an earlier run in this process, and would show those.
        self.run = self._folder / f"{self._output.suffix[1:]}-{secrets.token_hex(4)}"
        self.path = str(self.run / _ROOT if self._packed else self._output)
        self.frames = self.kept = 0
        self._given, self._packing, self._lock = os.fspath(output), False, None
        self._span = None  # first and last time code appended
        self._pending = []
        self._chunks = []  # (first time code, file) of each written chunk
        self._number = 0  # of the next chunk
        self._stale = set()  # files of an interrupted run that the first root of this one no longer names
        self._closed = False

    def _put_on(self, rest, targets, root_metadata, metadata, source=None, files=(), refit=None):
        """Sets the layer below the samples, and locks the output for this writer.

        ``rest`` has everything not sampled and the declarations of the rest, ``targets`` the sampled prims, the main one first,
        ``source`` is the artist's stage of ``files``, and ``refit`` raises ValueError if that no longer fits.

        Raises:
            BlockingIOError: Another writer has the output.
            ValueError: The output is a file of the source's stage.
        """
        if os.path.realpath(self._output) in files:
            raise ValueError(f"output is {self._output}, a file of the source's stage; it must be another file")
        self._rest, self._targets = rest, targets
        self._source = None if source is None else Path(os.path.abspath(source))
        cloths = [target.prim for target in targets if target.vertices is not None]
        named = {"prims": " ".join(cloths)} if cloths else {"prim": targets[0].prim}
        facts = {METADATA_KEY: {**_facts(metadata or {}), **named}}
        self._root_metadata = {**root_metadata, "customLayerData": facts}
        self._files, self._refit = {file: identity(file) for file in files}, refit
        self._lock = Lock(self._output)
        weakref.finalize(self, self._lock.release)  # in case nobody closes the writer

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            self.close()
        elif not self._closed:
            # After an error the frames so far stay in chunks, without packing, unless only the whole animation is wanted.
            try:
                if self._whole:
                    self._remove_run()
                else:
                    self._write_chunk()
                self._closed = True
            finally:
                self._lock.release()

    def saved(self) -> str:
        """Returns a text with the number of frames and their file."""
        if not self.kept:
            return "nothing was saved"
        path = self._given
        if self.path != str(self._output):
            path = os.path.join(os.path.dirname(path), os.path.relpath(self.path, self._output.parent))
        packing = f", and {self._given} was not made" if path != self._given else f", with {self._folder.name} beside it"
        return f"frames 0 to {self.kept - 1} are in {path}" + (packing if self._packing else "")

    def close(self, single_file: bool = False, keep: bool = False) -> None:
        """Writes the pending frames. Without frames nothing is written.

        Args:
            single_file: Whether to make one file that includes the source, and remove the folder; .usdz always is one.
            keep: Whether to keep the chunks beside a single file, so that the run can be resumed.

        Raises:
            OSError: A file could not be written; the finished chunks stay.
            ValueError: The source no longer fits the frames, which stay in chunks.

        Warns:
            UserWarning: The source has changed but still fits, or an earlier run was not packed.
        """
        if self._closed:
            return
        try:
            with deferred(0 if isinstance(sys.exc_info()[1], KeyboardInterrupt) else 1):
                self._packing = single_file or self._packed
                self._write_chunk(last=True)
                if self._chunks and (self._whole or (self._stale and not keep) or not Path(self.path).exists()):
                    self._write_root(self._chunks)
                    if self._whole and not self._packed:
                        self._remove_other_runs()
                if not keep:
                    self._remove_stale()
                self._closed = True
                if self._chunks:
                    self._check_source()
                    if self._packing and not (keep and self._stale):  # else it has more frames than this
                        self._write_single_file(keep)
                        self._packing = False
        except OSError as error:
            if self._whole:
                self._remove_run()
                raise
            self._keep_chunks()
            raise OSError(f"{error}; {self.saved()}") from error
        finally:
            self._lock.release()

    @property
    def complete(self):
        """Whether it is closed, and packed if asked for."""
        return self._closed and not self._packing

    def runs_with(self, name):
        """Returns the folders of earlier runs that have a file of this name, the newest first."""
        found = self._folder.glob(f"{self._output.suffix[1:]}-*/{name}") if self._folder.is_dir() else ()
        runs = [path for path in found if _is_run(path.parent)]
        return [path.parent for path in sorted(runs, key=lambda path: path.stat().st_mtime, reverse=True)]

    def written(self):
        """Returns (chunks, span) for :meth:`resume`: time code and file of each chunk, first and last time code."""
        return [(time, path.name) for time, path in self._chunks], self._span

    def resume(self, run, chunks, span, frames):
        """Continues an interrupted run before the first frame is appended, from :meth:`written`; later chunks are removed once
        replaced.

        Raises:
            FileNotFoundError: One of the chunks is gone.
        """
        self.run, self._chunks = Path(run), [(time, Path(run) / name) for time, name in chunks]
        for path in (self.run / "rest.usdc", self.run / _MANIFEST, *(path for _, path in self._chunks)):
            if not path.is_file():
                self._chunks = []
                raise FileNotFoundError(f"{path}: is missing, so that the run cannot be resumed; run without resume")
        found = {self.run / name: int(match[1]) for name in os.listdir(self.run) if (match := _FRAMES.fullmatch(name))}
        self._stale = set(found) - {path for _, path in self._chunks}
        self._number = max(found.values()) + 1  # a new name, because pxr may hold the old files
        self._span, self.frames, self.kept = tuple(span), frames, frames
        if self._packed:
            self.path = str(self.run / _ROOT)
        (self.run / _COMPLETE).unlink(missing_ok=True)

    def _keep_chunks(self):
        if self._closed or not (self.run / "rest.usdc").exists():
            return
        before, self.path = self.path, str(self.run / _ROOT)
        try:
            (self.run / _COMPLETE).touch()
            self._write_chunk()
        except OSError:  # a full disk: the folder cannot be written either
            self.path = before

    def _check_source(self):
        """Warns if the files of the source have changed; raises ValueError if they no longer fit."""
        changed = [file for file, before in self._files.items() if identity(file) != before]
        if not changed:
            return
        try:
            with sentences(changed[0]):
                for layer in filter(None, map(Sdf.Layer.Find, changed)):
                    layer.Reload()
                self._refit()
        except (OSError, ValueError) as error:
            now = f"has changed during the run and no longer fits ({error})"
            raise ValueError(f"{changed[0]}: {now}; {self.saved()}") from None
        warnings.warn(f"{changed[0]}: has changed during the run; the frames belong to its earlier version", stacklevel=4)

    def _append(self, time, samples):
        self._pending.append((time, samples))
        self._span = (time if self._span is None else self._span[0], time)
        self.frames += 1
        if len(self._pending) >= self.chunk:
            self._write_chunk()

    def _check_open(self):
        if self._closed:
            raise ValueError(f"{self._output}: is closed, no frame can be appended")

    def _checked_primvars(self, primvars, unknown=False):
        """Checks and returns the values of all declared primvars; with ``unknown`` they may be NaN."""
        declared, primvars = self._targets[0].primvars, primvars or {}
        if primvars.keys() != declared.keys():
            names = ", ".join(map(repr, primvars)) or "none"
            raise ValueError(f"primvars: {names} at frame {self.frames}, must be {', '.join(map(repr, declared)) or 'none'}")
        return {
            name: self._checked(f"primvars[{name!r}]", primvars[name], interpolation, (), unknown)
            for name, interpolation in declared.items()
        }

    def _checked(self, name, values, interpolation="vertex", components=(3,), unknown=False):
        values = np.asarray(values)
        shape = (self._counts[interpolation], *components)
        if values.shape != shape:
            raise ValueError(f"{name}: shape {values.shape} at frame {self.frames}, must be {shape}")
        with np.errstate(over="ignore"):
            single = values.astype(np.float32, copy=False)
        good = np.isfinite(single) | np.isnan(single) if unknown else np.isfinite(single)
        if not good.all():
            row = int(np.argmin(good)) // (3 if components else 1)
            where = f"frame {self.frames}, {'vertex' if interpolation == 'vertex' else 'triangle'} {row}"
            allowed = "finite in float32" + (", or NaN where there is none" if unknown else "")
            raise ValueError(f"{name}: {values[row].tolist()} at {where}, must be {allowed}")
        return values

    def _attributes(self):
        return [f"{target.prim}.{name}" for target in self._targets for name in target.attributes]

    def _write_chunk(self, last=False):
        with deferred():
            if self._pending:
                self._write_pending()
            if last and self._packed and self._chunks and not self._whole:
                (self.run / _COMPLETE).touch()

    def _write_pending(self):
        if not self._chunks:
            self._start_run()
        elif not self._chunks[-1][1].exists():  # USD would make the folder again, without the earlier frames
            self.kept, last = 0, self.frames - len(self._pending) - 1
            raise FileNotFoundError(f"{self.run}: has been removed during the run, with frames 0 to {last}")
        layer = self._declared(Sdf.Layer.CreateAnonymous(".usdc"))
        for time, values in self._pending:
            for attribute, value in values.items():
                layer.SetTimeSample(attribute, time, value)
        for name in ("timeCodesPerSecond", "framesPerSecond"):
            layer.pseudoRoot.SetInfo(name, self._root_metadata[name])
        layer.startTimeCode, layer.endTimeCode = self._pending[0][0], self._pending[-1][0]
        path = self.run / f"frames_{self._number:06d}.usdc"
        export(layer, path, like=self._output)
        chunks = [*self._chunks, (self._pending[0][0], path)]
        if not self._whole:
            self._write_root(chunks)
        # Only now, so that close writes a chunk again whose writing was interrupted.
        self._chunks, self._pending, self.kept, self._number = chunks, [], self.frames, self._number + 1
        self._remove_stale()
        if len(chunks) == 1 and not self._packed and not self._whole:
            self._remove_other_runs()

    def _start_run(self):
        self.run.mkdir(parents=True, exist_ok=True)
        manifest = self._declared(Sdf.Layer.CreateAnonymous(".usda"))
        manifest.customLayerData = {METADATA_KEY: {"manifest": self.run.name}}
        export(manifest, self.run / _MANIFEST, like=self._output)
        export(self._rest, self.run / "rest.usdc", like=self._output)

    def _declared(self, layer):
        for target in self._targets:
            target.declare(layer, target.attributes)
        return layer

    def _write_root(self, chunks):
        folder = Path(self.path).parent
        layer = Sdf.Layer.CreateAnonymous(".usda")
        stage = Usd.Stage.Open(layer)
        asset_paths = [Sdf.AssetPath(relative_path(path, folder)) for _, path in chunks]
        for target in self._targets:
            clips = Usd.ClipsAPI(stage.OverridePrim(target.prim))
            clips.SetClipAssetPaths(asset_paths, self._clip_set)
            clips.SetClipManifestAssetPath(Sdf.AssetPath(relative_path(self.run / _MANIFEST, folder)), self._clip_set)
            clips.SetClipPrimPath(target.prim, self._clip_set)
            clips.SetClipActive([(time, index) for index, (time, _) in enumerate(chunks)], self._clip_set)
            # Clip time is stage time. With one frame listed twice, USD 25.5 reports the frame twice.
            clips.SetClipTimes([(time, time) for time in sorted(set(self._span))], self._clip_set)
        del clips, stage
        self._describe(layer)
        # Last, because an anonymous layer cannot resolve relative paths.
        layer.subLayerPaths = [relative_path(path, folder) for path in self._base_paths()]
        export(layer, self.path, self.run, self._output)

    def _describe(self, layer):
        start, end = self._span
        for name, value in {"startTimeCode": start, "endTimeCode": end, **self._root_metadata}.items():
            layer.pseudoRoot.SetInfo(name, value)

    def _base_paths(self):
        return [self.run / "rest.usdc"] + ([self._source] if self._source else [])

    def _remove_stale(self):
        for path in self._stale:
            path.unlink(missing_ok=True)
        self._stale = set()

    def _remove_run(self):
        with suppress(OSError):  # it is not empty, or was never made
            self._remove(self.run)
            self._folder.rmdir()

    def _remove_other_runs(self):
        own_kind = re.compile(re.escape(self._output.suffix[1:]) + "-[0-9a-f]{8}")
        for folder in () if self._folder.is_symlink() else self._folder.iterdir():
            inside = os.path.join(os.path.realpath(folder), "")
            read = any(file.startswith(inside) for file in self._files)
            if read or folder == self.run or not (own_kind.fullmatch(folder.name) and _is_run(folder)):
                continue
            if (folder / _COMPLETE).exists():
                warnings.warn(
                    f"{folder / _ROOT}: has all frames of an earlier run that was not packed, and is kept; "
                    "remove its folder if nobody needs them",
                    stacklevel=5,
                )
            else:
                with suppress(OSError):  # another process may have a file open
                    self._remove(folder)

    def _remove(self, run):
        """Removes the files of a run, the root first and the manifest last, and its folder if empty."""
        if (unpacked := _temporary(run, "unpacked")).exists():
            shutil.rmtree(unpacked)
        fixed = _NAMES | {f"{self._output.stem}.usdc"}
        names = [name for name in os.listdir(run) if name in fixed or _FRAMES.fullmatch(name) or _is_temporary(name, run)]
        for name in sorted(names, key=lambda name: (name != _ROOT, name == _MANIFEST)):
            os.remove(run / name)
        with suppress(OSError):
            run.rmdir()

    def _write_single_file(self, keep):
        contents = Contents(_temporary(self.run, "unpacked"))
        named = contents.named if self._packed else named_from(self._output.parent)
        flat = self._declared(flattened_layer(self._base_paths(), self._describe, named))
        for attribute in self._attributes():
            flat.GetAttributeAtPath(attribute).ClearInfo("timeSamples")
        single = self.run / f"{self._output.stem}.usdc"
        export(flat, single, like=self._output)
        self._copy_frames(single)
        finished = _temporary(self.run, "finished", self._output.suffix)
        if self._packed:
            with _writing(self._output):
                contents.write(single, finished, self._output)
        elif self._output.suffix == ".usda":
            _export(Sdf.Layer.FindOrOpen(str(single)), finished, self._output)
        else:
            os.replace(single, finished)
        _rename(finished, self._output)
        self.path = str(self._output)
        (self.run / _COMPLETE).unlink(missing_ok=True)
        if keep:
            return
        with suppress(OSError):  # it may be gone, or in use, also by a run to an output with another ending
            self._remove(self.run)
            if self._packed:
                self._remove_other_runs()
            self._folder.rmdir()

    def _copy_frames(self, single):
        layer = Sdf.Layer.FindOrOpen(str(single))
        for _, path in self._chunks:
            chunk = Sdf.Layer.FindOrOpen(str(path))
            for attribute in self._attributes():
                for time in chunk.ListTimeSamplesForPath(attribute):
                    layer.SetTimeSample(attribute, time, chunk.QueryTimeSample(attribute, time))
            with _writing(self._output):
                if not layer.Save():
                    raise OSError(f"{self._output}: could not be written")


def frames_folder(output):
    """Returns the folder of frames of an output; for a link, beside the file behind it."""
    output = Path(followed(output))
    return output.parent / f"{output.stem}_frames"


def check_output(path):
    """Returns the absolute path of the file that a writer writes, for a link that behind it.

    Raises:
        ValueError: The ending is not that of a stage or differs from that behind the link, or the path is a folder.
    """
    output = Path(os.path.abspath(followed(path)))
    refuse_path(output)
    if output.suffix not in _ENDINGS:
        others = "'warpcloth convert' makes .pc2, .mdd, .npz and numbered .obj files of it"
        raise ValueError(f"output is {output}; it must end with one of {', '.join(_ENDINGS)}; {others}")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"output = {output}: the folder {output.parent} does not exist")
    if output.is_dir():
        raise ValueError(f"output is {output}, a folder; it must be a file")
    if output.suffix != Path(path).suffix:
        raise ValueError(f"output is {path}, a link to {output}; it must end as that does")
    return output


def check_scene(fps, up_axis):
    """Raises ValueError if a stage cannot have this rate or up axis."""
    if not (np.isscalar(fps) and np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps is {fps}; it must be positive and finite")
    if up_axis not in ("Y", "Z"):
        raise ValueError(f'up_axis is {up_axis!r}; it must be "Y" or "Z"')


def _facts(metadata, where="metadata"):
    facts = {}
    for name, value in metadata.items():
        if isinstance(value, dict):
            facts[name] = _facts(value, f"{where}[{name!r}]")
        else:
            facts[name] = value.item() if isinstance(value, np.generic) else value
            if not isinstance(facts[name], (bool, int, float, str)):
                raise ValueError(f"{where}[{name!r}] is {value!r}; it must be a number, a text, or a dict of those")
    return facts


def export(layer, path, unfinished_in=None, like=None):
    """Writes a layer under a temporary name and renames it; it has the permissions of the file ``like``, else of the replaced
    one.
    """
    path = Path(path)
    unfinished = _temporary(Path(unfinished_in or path.parent), "unfinished", path.suffix)
    _export(layer, unfinished, path)
    _rename(unfinished, path, like)


def _rename(finished, path, like=None):
    keep_mode(finished, like or path)
    try:
        os.replace(finished, path)
    except OSError as error:
        raise OSError(f"{path}: could not be written: {error.strerror or error}") from None


def _temporary(folder, word, suffix=""):
    """Returns a path in a folder that no file of a user has."""
    return folder / f"{word}-{folder.name[-8:]}{suffix}"


def _is_temporary(name, folder):
    return re.fullmatch(rf"(un)?finished-{re.escape(folder.name[-8:])}\.\w+", name)


def _is_run(folder):
    """Returns whether a folder has the manifest of a run, or was left by a killed one."""
    try:
        if folder.is_symlink():
            return False
        begun = all(_is_temporary(name, folder) for name in os.listdir(folder))
        return begun or f'"{folder.name}"' in (folder / _MANIFEST).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _export(layer, file, meant=None):
    with _writing(meant or file):
        if not layer.Export(str(file)):
            raise OSError(f"{meant or file}: could not be written")


def _writing(path):
    return sentences(path, OSError, "could not be written: ")
