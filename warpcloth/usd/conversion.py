"""Converts animations from one format to another, frame by frame."""

import os
from functools import partial
from pathlib import Path

import numpy as np

from ..base.outputs import STAGE_ENDINGS, OutputSet, check_apart, check_replaceable, writing_alone
from ..mesh.caches import CACHES, NUMBERED, numbered_paths, write_mdd, write_npz, write_obj, write_pc2, write_ply
from ..mesh.loading import read_arrays
from ..mesh.sequences import open_sequence
from .frames import FrameSequence, JoinedFrames
from .stage import animated_prims, open_stage
from .writer import AnimationWriter

OUTPUTS = (*NUMBERED, *CACHES, ".npz", *STAGE_ENDINGS)
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
_UNEVEN = 1e-3  # of an interval, above the rounding of times as float32


def convert(source, output, prim=None, fps=None, mesh=None, progress=None):
    """Writes an animation in another format; docs/usd.md says what each has, and how files are replaced.

    Args:
        source: Path of an animation, as for :func:`warpcloth.open_sequence`.
        output: The file to write, with an ending of :data:`OUTPUTS`.
        prim: As of :func:`warpcloth.open_sequence`.
        fps: Likewise.
        mesh: The rest mesh of a source without triangles.
        progress: Function called with (frames written, frames), or None.

    Returns:
        The :class:`warpcloth.Sequence` of the source, and a list of the written paths.

    Raises:
        BlockingIOError: Another conversion to this output is running.
        OSError: A file does not exist, or cannot be written or renamed.
        ValueError: The source or the ending is not supported; a written point or velocity is not finite as float32; the
            triangles change; times are needed and unknown, or uneven where the format has one interval; or an output is not a
            regular file.
    """
    ending = Path(output).suffix.lower()
    if ending not in OUTPUTS:
        raise ValueError(f"{output}: the ending is {ending!r}; it must be one of {' '.join(OUTPUTS)}")
    sequence = open_sequence(source, prim, fps, mesh)
    if ending in NUMBERED:
        paths = numbered_paths(output, sequence.labels)
    else:
        paths = [Path(output), *([Path(output).with_suffix(".obj")] if ending in CACHES else [])]
    check_apart(paths, [*sequence.files, source])
    check_replaceable(*paths)
    if ending in STAGE_ENDINGS:
        interval = _interval(sequence, _times(sequence), "times")
    elif ending == ".mdd":
        _times(sequence)
    elif ending == ".pc2":
        _interval(sequence, sequence.labels, "frame numbers")
    if ending in CACHES:
        _check_beside(paths, _points(sequence, 0), sequence.mesh)
    velocities = _velocities(sequence) if ending in (".npz", *STAGE_ENDINGS) else None
    moving = partial(_moving, sequence, velocities, ending in STAGE_ENDINGS)
    for index, (_, found) in enumerate(moving()):
        if found is not None:
            _check_finite(sequence, index, "velocity", found)
    frames = partial(_frames, sequence, progress)
    if ending in STAGE_ENDINGS:
        _write_stage(paths[0], sequence, interval, moving(), progress)
        return sequence, paths
    with writing_alone(paths, ending in NUMBERED), OutputSet() as outputs:
        if ending in NUMBERED:
            write = write_ply if ending == ".ply" else partial(write_obj, digits=_digits(sequence))
            for path, points in zip(paths, frames(), strict=True):
                with outputs.writing(path) as file:
                    write(file, points, sequence.mesh)
        elif ending == ".npz":
            with outputs.writing(paths[0]) as file:
                _write_npz(file, sequence, frames, velocities)
        else:
            write, given = (write_pc2, sequence.labels) if ending == ".pc2" else (write_mdd, sequence.times)
            with outputs.writing(paths[0]) as file:
                write(file, frames(), given, len(sequence.mesh.points))
            with outputs.writing(paths[1]) as file:
                write_obj(file, _points(sequence, 0), sequence.mesh, _digits(sequence))
    return sequence, paths


def _check_beside(paths, points, mesh):
    """Refuses to replace a different mesh beside a new cache, which nobody named."""
    cache, beside = paths
    if beside.exists() and not cache.exists():
        try:
            found, triangles, _ = read_arrays(beside)
            same = np.array_equal(triangles, mesh.triangles) and np.allclose(found, points, 1e-6, 0.0)
        except ValueError:
            same = False
        if not same:
            raise ValueError(f"{beside}: is another mesh, which the first frame would replace; give the output another name")


def _digits(sequence):
    return 9 if np.dtype(sequence.precision).itemsize <= 4 else 17


def _points(sequence, index):
    points = sequence[index]
    _check_finite(sequence, index, "point", points)
    return points


def _check_finite(sequence, index, name, vectors):
    bad = np.flatnonzero(~(np.abs(vectors) <= _MAX_FLOAT32).all(axis=1))
    if len(bad):
        where, given = f"{sequence.path}, frame {sequence.labels[index]}", vectors[bad[0]].tolist()
        raise ValueError(f"{where}: {name} {bad[0]} is {given}; it must be finite as float32")


def _frames(sequence, progress=None):
    for index in range(len(sequence)):
        yield _points(sequence, index)
        if progress:
            progress(index + 1, len(sequence))


def _times(sequence):
    if sequence.times is None:
        raise ValueError(f"{sequence.path}: has no times; give the frames per second (--fps)")
    return sequence.times


def _interval(sequence, values, name):
    intervals = np.diff(values)
    if not len(intervals):
        return 1.0
    if np.ptp(intervals) > _UNEVEN * intervals.min():
        uneven = int(np.argmax(np.abs(intervals - intervals[0]) > _UNEVEN * intervals[0]))
        label = sequence.labels[uneven]
        raise ValueError(f"{sequence.path}: {name} are uneven after frame {label}; this format needs one interval for all")
    return float(values[-1] - values[0]) / len(intervals)


def _velocities(sequence):
    if sequence.path is None or Path(sequence.path).suffix.lower() not in STAGE_ENDINGS:
        return None
    path = os.fspath(sequence.path)
    try:
        if sequence.stage is not None:
            found = FrameSequence(path, sequence.stage.prim, "velocities")
        else:
            found = JoinedFrames(path, [str(each.GetPath()) for each in animated_prims(open_stage(path))], "velocities")
    except ValueError:  # without velocities
        return None
    return found.exact if len(found) == len(sequence) and found.shape[1] == len(sequence.mesh.points) else None


def _moving(sequence, velocities, differences):
    """Returns an iterator over points (n, 3) [m] and velocities (n, 3) [m/s] of each frame: those of ``velocities``, else
    ``differences``, or None.
    """
    if velocities is not None:
        return zip(_frames(sequence), map(velocities, range(len(sequence))), strict=True)
    return _differences(sequence) if differences else ((points, None) for points in _frames(sequence))


def _differences(sequence):
    """Yields points and their differences over time, central, one-sided at the ends."""
    last = len(sequence) - 1
    before = now = _points(sequence, 0)
    for index in range(last + 1):
        after = _points(sequence, index + 1) if index < last else now
        first, end = max(index - 1, 0), min(index + 1, last)
        yield now, (after - before) / (sequence.times[end] - sequence.times[first]) if end > first else np.zeros_like(now)
        before, now = now, after


def _write_npz(file, sequence, frames, velocities):
    dtype = np.float32 if _digits(sequence) == 9 else np.float64
    arrays = {"triangles": sequence.mesh.triangles}
    if sequence.times is not None:
        arrays["times"] = sequence.times
    if sequence.mesh.parts:
        arrays["parts"] = np.array(list(sequence.mesh.parts))
        arrays["first"] = np.array([part.first for part in sequence.mesh.parts.values()])
    rows = {"points": frames()}
    if velocities is not None:
        rows["velocities"] = map(velocities, range(len(sequence)))
    write_npz(file, rows, (len(sequence), *sequence.mesh.points.shape), dtype, arrays)


def _write_stage(path, sequence, interval, moving, progress):
    fps = 1.0 / interval
    fps = round(fps) if abs(fps - round(fps)) < 1e-4 * fps else fps
    name = None if sequence.stage is None else sequence.stage.prim.rsplit("/", 1)[1]
    parts = sequence.mesh.parts
    cloths = {each: each for each in parts} if parts and len(parts) > 1 else None
    mesh, up_axis = sequence.mesh, sequence.up_axis
    with AnimationWriter(path, mesh, fps, prim=name, up_axis=up_axis, cloths=cloths, whole=True) as writer:
        for index, (points, velocities) in enumerate(moving):
            writer.append(points, velocities)
            if progress:
                progress(index + 1, len(sequence))
