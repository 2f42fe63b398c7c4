"""Turns any source into shapes whose positions are read frame by frame."""

import glob
import os
from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..base.checks import number, shown, whole
from ..base.outputs import STAGE_ENDINGS
from ..deformation.deform import Deformation
from ..mesh.loading import ENDINGS
from ..mesh.mesh import Mesh, Surface
from ..mesh.sequences import Sequence, as_sequence, open_sequence
from ..run.simulate import Animation
from ..scene.lines import lines_of
from ..scene.scene import Scene
from ..usd.drawn import camera_of, draw_colliders, read_drawn
from ..usd.layers import CURVE_WIDTH
from .shape import BACK, CLOTH, Shape

# Linear Rec. 709 of meshes beside the cloth, and of strings and bars.
SURROUNDINGS, LINES = (0.42, 0.41, 0.39), (0.06, 0.06, 0.065)
# Largest and smallest radius of pins relative to the size of the cloth, and a limit relative to the edge length, so that
# neighbours do not touch.
_PIN, _PIN_MIN, _PIN_EDGE = 0.005, 0.0025, 0.25
# Smallest radius of the tubes of a net or chain without widths, relative to its size, so that they are visible.
_THINNEST = 0.003
# The same for strings and bars beside a cloth.
_THINNEST_LINE = 0.001
# Distance between the centres of neighbouring cloths of a batch, relative to their size.
_APART = 1.12
# Additional distance to the next row of a batch, relative to the height of a cloth, so that it is visible.
_HIDES = 1.0
# Beyond this distance [m], its cube overflows.
_FARTHEST = 1e100
_SOURCES = "a path, an Animation, a Deformation, a Scene, a Mesh, a Sequence, or an array of frames with its mesh"


@dataclass(frozen=True, eq=False)
class Subject:
    """Everything that is drawn of a source.

    Attributes:
        labels: Frame numbers (F,).
        times: (F,) [s], or None.
        read: Function (index) → positions (n, 3) [m] of each shape.
        up_axis: "Y" or "Z", or None.
        coloured: Index of the coloured shape.
        sequences: Function that returns the :class:`Sequence` of each of its cloths.
        camera: Function (frame, aspect) of :func:`warpcloth.usd.drawn.camera_of`, or None.
    """

    name: str
    shapes: list
    labels: np.ndarray
    times: np.ndarray | None
    read: Callable
    up_axis: str | None
    sequences: Callable
    coloured: int = 0
    files: tuple = ()
    camera: Callable | None = None

    def __len__(self):
        return len(self.labels)

    @property
    def interval(self):
        """Time between frames [s], by default 1/24 s."""
        if self.times is None or len(self.times) < 2:
            return 1.0 / 24.0
        return float(np.median(np.diff(self.times)))

    @property
    def ends(self):
        """Numbers of the first and last frame, as text."""
        return f"{self.labels[0]:g} to {self.labels[-1]:g}"

    def between(self, frames):
        """Returns the indices of frames between two numbers, None for an end; refuses an empty range."""
        if frames is None:
            return np.arange(len(self))
        if not isinstance(frames, Several) or isinstance(frames, str) or len(frames) != 2:
            raise ValueError(f"frames is {shown(frames)}; it must be the numbers of the first and the last frame")
        low, high = (end if given is None else given for given, end in zip(frames, self.labels[[0, -1]].tolist(), strict=True))
        for value in (low, high):
            number("frames", value)
        found = np.flatnonzero((self.labels >= low - 1e-6) & (self.labels <= high + 1e-6))
        if not len(found):
            raise ValueError(f"frames is {low:g} to {high:g}, where there are none; they are {len(self)}, from {self.ends}")
        return found


def subject_of(source, mesh=None, prim=None, fps=None, copy=None, azimuth=0.0, camera=None):
    """Returns the :class:`Subject` of a source of :func:`warpcloth.render`, whose arguments these are; raises ValueError
    without anything to draw.

    A batch shows ``copy`` or all cloths, side by side for an ``azimuth`` [°].
    """
    if isinstance(source, (str, os.PathLike)):
        found = _of_path(os.fspath(source), mesh, prim, fps, camera)
    elif isinstance(source, Sequence):
        found = _of_sequence(source, source.mesh)
    elif isinstance(source, Scene):
        found = _of_frames(source.name, source.mesh, source.positions[None], None, source.pins.vertices, source)
    elif isinstance(source, Animation) and source.scene is not None:
        scene = source.scene
        found = _of_animation(source, scene, copy, azimuth)
        copy = None
    elif isinstance(source, Deformation) and source.mesh is not None:
        found = _of_frames("deformation", source.mesh, source.points, source.times, source.pins)
    elif isinstance(source, Mesh):
        found = _of_frames("mesh", source, source.points[None], None)
    else:
        points = getattr(source, "points", source)
        if mesh is None or not (hasattr(points, "__getitem__") or hasattr(points, "__array__")):
            given = shown(source) if isinstance(source, (str, int, float, type(None))) else type(source).__name__
            rule = "arrays need their mesh" if hasattr(points, "__getitem__") else f"it must be {_SOURCES}"
            raise ValueError(f"source is {given}; {rule}")
        found = _of_frames("frames", mesh, points, getattr(source, "times", None))
    if camera is not None and found.camera is None:
        raise ValueError(f"camera is {shown(camera)}; {found.name} is not a stage and has none, so that it must be None")
    if copy is not None:
        raise ValueError(f"copy is {shown(copy)}; the source is one cloth and no batch, so that it must be None")
    if fps is not None and not isinstance(source, (str, os.PathLike)):
        found = replace(found, times=(found.labels - found.labels[0]) / fps)
    return found


def _of_path(path, mesh, prim, fps, camera):
    name = Path(path).name or path
    ending = Path(path).suffix.lower()
    if ending in STAGE_ENDINGS and (os.path.isfile(path) or not glob.has_magic(path)):
        return _of_stage(path, name, prim, fps, camera)
    if ending in ENDINGS and os.path.isfile(path):
        one = Surface.load(path, prim)
        return replace(_of_frames(name, one, one.points[None], None), files=(path,))
    sequence = open_sequence(path, prim, fps, mesh)
    return replace(_of_sequence(sequence, sequence.mesh), name=name)


def _of_stage(path, name, prim, fps, camera=None):
    stage = read_drawn(path, prim)
    codes = stage.codes
    first = np.concatenate([each.points(codes[0]) for each in stage.prims if each.cloth])
    size = _size(first)
    shapes = [_prim_shape(each, codes[0], size) for each in stage.prims]
    labels = codes.astype(np.int64) if np.array_equal(codes, np.rint(codes)) else codes
    times = (codes - codes[0]) / (stage.rate if fps is None else fps)

    def read(frame):
        return [each.points(codes[frame]) for each in stage.prims]

    cloths = [k for k, each in enumerate(stage.prims) if each.cloth]
    measured = stage.prims[cloths[0]].path if prim is None and len(cloths) == 1 else prim

    def sequences():
        return [open_sequence(path, measured, fps)]

    files = tuple(layer.realPath for layer in stage.stage.GetUsedLayers() if layer.realPath)
    view = None if camera is None else camera_of(stage.stage, path, camera)
    seen = None if view is None else lambda frame, aspect: view(codes[frame], aspect)
    return Subject(name, shapes, labels, times, read, stage.up_axis, sequences, cloths[0], files, seen)


def _prim_shape(prim, code, size):
    edge = np.linalg.norm(np.diff(prim.points(code)[prim.edges], axis=1), axis=-1).mean() if len(prim.edges) else 0.0
    radius = max(prim.radius, min((_THINNEST if prim.cloth else _THINNEST_LINE) * size, 0.2 * edge))
    colour = prim.colour or (CLOTH if prim.cloth else LINES if len(prim.edges) else SURROUNDINGS)
    return _shape(prim.count, prim.triangles, prim.edges, radius or 0.2 * edge, prim.pins, size, edge, colour)


def _of_sequence(sequence, mesh):
    if sequence.stage is not None:
        found = _of_stage(os.fspath(sequence.path), Path(sequence.path).name, sequence.stage.prim, None)
        return replace(found, times=sequence.times, sequences=lambda: [sequence])
    shape = _cloth(mesh, sequence[0])
    name = "frames" if sequence.path is None else Path(sequence.path).name
    up_axis = sequence.up_axis or mesh.up_axis
    files = tuple(sequence.files)
    return Subject(
        name, [shape], sequence.labels, sequence.times, lambda k: [sequence[k]], up_axis, lambda: [sequence], 0, files
    )


def _of_frames(name, mesh, frames, times, pins=(), scene=None):
    positions, count = _reader(frames, mesh)
    times = None if times is None else np.asarray(times, dtype=float)
    shapes, read = _with_surroundings(scene, _cloth(mesh, positions(0), pins), positions)

    def sequences():
        return [as_sequence(mesh, frames, times=times)]

    return Subject(name, shapes, np.arange(count), times, read, mesh.up_axis, sequences)


def _reader(frames, mesh):
    if not hasattr(frames, "exact"):
        frames = frames if isinstance(frames, (list, tuple)) else np.asarray(frames)
    if not len(frames):
        raise ValueError("frames is empty; there must be one at least")
    shape = np.shape(frames[0])
    if shape != mesh.points.shape:
        raise ValueError(f"frames have shape {shape}; they must be {mesh.points.shape}, as the points of the mesh")
    return (lambda frame: np.asarray(frames[frame], dtype=np.float64)), len(frames)


def _of_animation(animation, scene, copy, azimuth):
    points = animation.points
    if points.ndim == 3 and copy is not None:
        raise ValueError(f"copy is {shown(copy)}; the animation is of one cloth, so that it must be None")
    if copy is not None:
        whole("copy", copy, 0, points.shape[1] - 1)
        points = points[:, copy]
    if points.ndim == 3:
        found = _of_frames(scene.name, scene.mesh, points, animation.times, scene.pins.vertices, scene)
        return replace(found, up_axis=scene.up_axis)
    batch = points.shape[1]
    offsets = _side_by_side(points, azimuth, scene.up_axis)
    count = len(scene.mesh.points)

    def positions(frame):
        return (np.asarray(points[frame], dtype=np.float64) + offsets).reshape(batch * count, 3)

    cloth = _cloth(scene.mesh, scene.positions, scene.pins.vertices)
    shapes, read = _with_surroundings(scene, cloth, positions, offsets)
    shapes = [_repeated(shape, batch) for shape in shapes]

    def sequences():
        return [as_sequence(scene.mesh, points[:, k], times=animation.times) for k in range(batch)]

    return Subject(scene.name, shapes, np.arange(len(points)), np.asarray(animation.times), read, scene.up_axis, sequences)


def _with_surroundings(scene, cloth, positions, offsets=0.0):
    """Returns the shapes of a cloth and of its scene, and a function that reads positions, with ``offsets`` (B, 1, 3) [m] of a
    batch, or 0.
    """
    if scene is None:
        return [cloth], lambda frame: [positions(frame)]
    own = [cloth, *_strings(scene.mesh, lines_of(scene))]
    if not scene.colliders:
        return own, lambda frame: [positions(frame)] * len(own)
    stage, size = draw_colliders(scene), _size(scene.positions)

    def read(frame):  # keeps the stage alive, which its prims need
        return [positions(frame)] * len(own) + [(each.points(frame) + offsets).reshape(-1, 3) for each in stage.prims]

    return own + [_prim_shape(each, 0, size) for each in stage.prims], read


def _side_by_side(points, azimuth, up_axis):
    """Returns offsets (B, 1, 3) [m] of a batch in rows, seen from an azimuth."""
    batch = points.shape[1]
    a = np.radians(azimuth)
    right, back = np.array([np.cos(a), 0.0, -np.sin(a)]), np.array([-np.sin(a), 0.0, -np.cos(a)])
    if up_axis == "Z":
        right, back = (np.array([x, -z, y]) for x, y, z in (right, back))
    sizes = []
    for axis in (right, back, np.eye(3)["YZ".index(up_axis) + 1]):
        extents = [np.asarray(frame, dtype=np.float64) @ axis for frame in points]
        finite = [each[np.isfinite(each)] for each in extents]
        sizes.append(max(each.max() for each in finite if each.size) - min(each.min() for each in finite if each.size))
    width, depth, height = sizes
    rows = max(1, round(np.sqrt(batch / 2.5)))
    columns = -(-batch // rows)
    row, column = np.divmod(np.arange(batch), columns)
    across = _APART * max(width, 0.3 * depth) * (column - (columns - 1) / 2.0)
    behind = (_APART * depth + _HIDES * height) * row
    return (np.outer(across, right) + np.outer(behind, back))[:, None]


def _repeated(shape, batch):
    offsets = shape.count * np.arange(batch)

    def tiled(rows):
        return np.concatenate([rows + offset for offset in offsets])

    return replace(
        shape,
        count=shape.count * batch,
        triangles=tiled(shape.triangles),
        lines=tiled(shape.lines),
        balls=tiled(shape.balls),
    )


def _strings(mesh, lines):
    count, least = len(mesh.points), _THINNEST_LINE * _size(mesh.points)
    return [Shape(count, lines=pairs, radius=max(width / 2.0, least), colour=LINES) for pairs, width in (lines or {}).values()]


def _cloth(mesh, points, pins=()):
    lengths = mesh.edge_lengths[np.isfinite(mesh.edge_lengths)]
    edge = float(lengths.mean()) if len(lengths) else 0.0
    edges = np.empty((0, 2), int) if len(mesh.triangles) else mesh.edges
    size = _size(points)
    radius = max(0.5 * CURVE_WIDTH * edge, min(_THINNEST * size, 0.2 * edge))
    return _shape(len(mesh.points), mesh.triangles, edges, radius, pins, size, edge, CLOTH)


def _shape(count, triangles, edges, radius, pins, size, edge, colour):
    ball = max(_PIN_MIN * size, min(_PIN * size, _PIN_EDGE * edge), 1.6 * radius) or 1.0
    return Shape(
        count,
        triangles,
        edges,
        radius,
        np.asarray(pins, dtype=int),
        ball,
        colour,
        back=BACK if colour == CLOTH else (1.0, 1.0, 1.0),
    )


def located(points):
    """Returns the points (n, 3) that a camera can show: finite, without overflow of products."""
    return points[are_located(points)]


def are_located(points):
    """Returns which points (n, 3) are :func:`located`, (n,)."""
    return (np.abs(points) < _FARTHEST).all(axis=1)


def _size(points):
    finite = located(points)
    return float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else 1.0
