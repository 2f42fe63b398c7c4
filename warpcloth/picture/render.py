"""Draws pictures and films of animations."""

import os
import warnings
from collections.abc import Mapping
from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import array, choice, number, shown, whole
from ..base.interrupts import Interrupted
from ..base.outputs import check_apart
from ..base.types import FilePath, Progress, UpAxis
from ..mesh.mesh import Mesh
from .camera import Camera
from .colour import byte_colour, check_colormap
from .films import IN_PAGES, SHORTEST, STILL, check_film, check_times, open_film
from .framing import frame_motion
from .measured import GivenColours, GivenScalar, MeasuredScalar
from .overlay import Overlay
from .raycast import BACKGROUND, RayCaster
from .subjects import subject_of


def render(
    source: Any,
    output: FilePath,
    *,
    names: Several[str] | None = None,
    mesh: Mesh | None = None,
    prim: str | None = None,
    fps: float | None = None,
    up_axis: UpAxis | None = None,
    copy: int | None = None,
    frame: float | None = None,
    frames: tuple[float | None, float | None] | None = None,
    every: int = 1,
    speed: float = 1.0,
    size: tuple[int, int] = (1280, 720),
    samples: int = 4,
    colour: str | ArrayLike | Mapping[str, ArrayLike] | None = None,
    colour_range: tuple[float, float] | None = None,
    colormap: str | None = None,
    measuring: Mapping[str, Any] | None = None,
    azimuth: float = -38.0,
    elevation: float = 24.0,
    zoom: float = 1.0,
    camera: str | None = None,
    ground: bool | float = True,
    time: bool = False,
    device: str = "cpu",
    progress: Progress | None = None,
) -> str:
    """Draws a picture or a film by ray casting, on the CPU or a GPU, without a display.

    Frames are drawn one at a time; the camera shows all of the motion; a film plays in real time. On one device, the same input
    gives the same bytes.

    Args:
        source: A path (stage, mesh file, folder or pattern, .npz, .npy); an :class:`warpcloth.Animation`, with its pins,
            strings and bars, :class:`warpcloth.Deformation`, :class:`warpcloth.Scene`, :class:`warpcloth.Mesh` or
            :class:`warpcloth.Sequence`; frames (F, n, 3) [m]; or a list of these, side by side.
        output: File to write: .png, .gif, .webp or, with PyAV, .mp4.
        names: Texts above sources, by default their names if several.
        mesh: The mesh of frames in an array; of other sources the rest shape for measures.
        prim: Cloth in a stage, by default what moves, or geometry of a mesh file.
        fps: Frames per second, instead of the source's.
        up_axis: "Y" or "Z", if the source does not give it.
        copy: Index of a cloth of a batch; None for all, side by side.
        frame: Number of the frame of a .png, by default the last.
        frames: Numbers of the first and last frame of a film; None for the ends of the source.
        every: Draw every k-th frame.
        speed: 0.5 plays at half speed.
        size: Width and height [px].
        samples: Rays through each pixel.
        colour: A measure such as "stretch_1"; values (F, n) of vertices or (F, T) of triangles, or ``{"text above the bar":
            values}``; linear Rec. 709 colours, (F, n, 3) or (F, T, 3); or None.
        colour_range: Ends of the colour scale, by default of all frames.
        colormap: Map of matplotlib.
        measuring: Options of :class:`warpcloth.Analyzer` by name.
        azimuth: Angle of the viewer about the vertical [°], from +z if y is up, from −y if z is.
        elevation: Angle of the viewer above the horizontal [°].
        zoom: 2 shows half of the width and height.
        camera: A Camera prim of the stage, in place of ``azimuth``, ``elevation`` and ``zoom``.
        ground: Whether there is a ground below the motion, or its height [m]; invisible from below.
        time: Whether to write the time, or without times the frame.
        device: A Warp device.
        progress: Function called with (pictures drawn, pictures), from 0, or None.

    Returns:
        str: The path of the file.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ImportError: Colours need matplotlib, .mp4 needs PyAV.
        Interrupted: A KeyboardInterrupt that says what is in the file.
        ValueError: An argument is not allowed, or a source cannot be read or drawn.

    Examples:
        >>> import os, tempfile
        >>> import warpcloth as wc
        >>> path = os.path.join(tempfile.mkdtemp(), "sheet.png")
        >>> os.path.basename(wc.render(wc.Mesh.grid(4, 4), path, size=(64, 36), samples=1))
        'sheet.png'
    """
    size, output = _checked_size(size), os.fspath(output)
    check_film(output, size)
    for name, value in (("azimuth", azimuth), ("elevation", elevation)):
        number(name, value)
    for name, value in (("speed", speed), ("zoom", zoom)):
        number(name, value, above=0.0)
    for name, value, default in (("azimuth", azimuth, -38.0), ("elevation", elevation, 24.0), ("zoom", zoom, 1.0)):
        if camera is not None and value != default:
            raise ValueError(f"{name} and camera are given; a camera of the stage sets what is seen, so leave one of them out")
    if fps is not None:
        number("fps", fps, above=0.0)
    whole("every", every, 1)
    if mesh is not None and not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is {shown(mesh)}; it must be a Mesh")
    if up_axis is not None:
        choice("up_axis", up_axis, ("Y", "Z"))
    if not isinstance(ground, bool | np.bool_):
        number("ground", ground)
    if colour_range is not None:
        array("colour_range", colour_range, (2,))
    if colormap is not None:
        check_colormap(colormap)
    sources = list(source) if _are_several(source) else [source]
    subjects = [subject_of(each, mesh, prim, fps, copy, azimuth, camera) for each in sources]
    subjects = [replace(each, up_axis=each.up_axis or up_axis or "Y") for each in subjects]
    if len({each.up_axis for each in subjects}) > 1:
        raise ValueError("source: one is Y up and another Z up; those that are drawn side by side must have one up axis")
    names = [each.name for each in subjects] if names is None and len(subjects) > 1 else list(names or ())
    if len(names) not in (0, len(subjects)) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"names is {shown(names)}; it must be a text for each of the {len(subjects)} sources")
    check_apart([output], [path for each in subjects for path in each.files])
    shots = _shots(subjects, Path(output).suffix.lower(), frame, frames, every, speed)
    times = [shot.time for shot in shots]
    check_times(output, times)
    values, scale = _colours(subjects, colour, colour_range, colormap, mesh, device, measuring)
    picture = _Picture(subjects, names, shots, size, samples, (azimuth, elevation, zoom), ground, values, scale, device)
    with open_film(output, size, times) as film:
        try:
            if progress is not None:
                progress(0, len(shots))
            for image in picture.images(time):
                film.add(image)
                if progress is not None:
                    progress(film.frames, len(shots))
        except KeyboardInterrupt:
            if not film.frames:
                film.discard()
                raise Interrupted("interrupted before the first picture; no picture was saved") from None
            raise Interrupted(f"interrupted after {film.frames} of {len(shots)} pictures, which are in {output}") from None
    if picture.left_out:
        why = "a position is not finite, or too far away"
        count = f"{picture.left_out} triangles, lines or pins are not drawn, in all pictures together"
        warnings.warn(f"{count}: {why}", stacklevel=2)
    return output


def _checked_size(size):
    found = tuple(size) if np.ndim(size) == 1 and len(size) == 2 else ()
    if not found:
        raise ValueError(f"size is {shown(size)}; it must be a width and a height [px]")
    for name, value in zip(("width", "height"), found, strict=True):
        whole(f"size: {name}", value, 8, 16384)
    return int(found[0]), int(found[1])


def _are_several(source):
    if not isinstance(source, (list, tuple)) or not len(source):
        return False
    return not any(isinstance(each, np.ndarray | list | tuple) for each in source)


class _Shot:
    """A picture of a film: its time [s], the frame of each subject, and the text of its time."""

    def __init__(self, time, frames, text):
        self.time, self.frames, self.text = time, frames, text


def _shots(subjects, ending, frame, frames, every, speed):
    """Returns the pictures, one for each frame of the first subject, with the nearest in time of others, to the end of the
    longest.
    """
    first = subjects[0]
    if ending == STILL:
        for name, value in (("frames", frames), ("every", None if every == 1 else every)):
            if value is not None:
                raise ValueError(f"{name} is given, and a {STILL} has one picture; give frame, or a film")
        chosen = [len(first) - 1 if frame is None else _index(first, frame)]
    elif frame is not None:
        raise ValueError(f"frame is given, and a {ending} has many; give frames, or a {STILL}")
    else:
        chosen = first.between(frames)[::every]
    times = [each.labels - each.labels[0] if each.times is None else each.times for each in subjects]
    times = [np.asarray(t) * (each.interval if each.times is None else 1.0) for t, each in zip(times, subjects, strict=True)]
    moments = [(times[0][k], _text(first, k)) for k in chosen]
    if ending != STILL and frames is None:
        longest, own = max(zip(subjects, times, strict=True), key=lambda pair: pair[1][-1])
        late = np.flatnonzero(own > times[0][-1] + 0.5 * longest.interval)[every - 1 :: every]
        moments += [(own[k], _text(longest, k)) for k in late]
    start, kept = moments[0][0], []
    least = SHORTEST if ending in IN_PAGES else 0.0
    for moment, text in moments:
        at = (moment - start) / speed
        if not kept or at - kept[-1].time >= least - 1e-9:
            kept.append(_Shot(at, [int(np.abs(own - moment).argmin()) for own in times], text))
    return kept


def _text(subject, k):
    if subject.times is None:
        return f"{subject.labels[k]:g}"
    digits = 2 if subject.interval < 10.0 else 0
    return f"{subject.times[k]:.{digits}f} s"


def _index(subject, label):
    number("frame", label)
    apart = np.abs(subject.labels - label)
    if not apart.min() <= 1e-6:
        raise ValueError(f"frame is {label:g}; it must be one of the {len(subject)} from {subject.ends}")
    return int(apart.argmin())


def _colours(subjects, colour, given, colormap, rest, device, measuring):
    """Returns the values of each subject, and a common scale, or None."""
    if not isinstance(colour, str):
        options = {"measuring": measuring or None}
        options |= {"colour_range": given, "colormap": colormap} if colour is None else {}
        for name, value in options.items():
            if value is not None:
                raise ValueError(f"{name} is given without colour, the name of what is measured")
    if colour is None:
        return None, None
    if isinstance(colour, str):
        values = [MeasuredScalar(each, colour, rest, device, measuring or {}) for each in subjects]
    else:
        if isinstance(colour, Mapping) and len(colour) != 1:
            raise ValueError(f"colour has {len(colour)} entries; it must be one text with its values")
        ((title, given_values),) = colour.items() if isinstance(colour, Mapping) else [("", colour)]
        arrays = [given_values] if len(subjects) == 1 else list(given_values)
        if len(arrays) != len(subjects):
            raise ValueError(f"colour has {len(arrays)} arrays; it must have one for each of the {len(subjects)} sources")
        values = [
            GivenColours(array, each) if np.ndim(array) == 3 else GivenScalar(array, each, title)
            for array, each in zip(arrays, subjects, strict=True)
        ]
    return values, values[0].scale(values[1:], given, colormap)


class _Picture:
    """Draws all pictures of a film, with one size and camera."""

    def __init__(self, subjects, names, shots, size, samples, view, ground, values, scale, device):
        self._subjects, self._shots, self._values, self._scale, self.left_out = subjects, shots, values, scale, 0
        self._up = subjects[0].up_axis
        title, unit = (values[0].name, values[0].unit) if values else ("", "1")
        width, height = size
        # Panels are in rows, as nearly square as possible.
        columns = -(-len(subjects) // max(1, round(np.sqrt(len(subjects) * height / width))))
        rows = -(-len(subjects) // columns)
        self._overlay = Overlay(size, scale, title, unit, names, byte_colour(BACKGROUND), columns)
        room = width - self._overlay.beside
        widths, heights = [room // columns] * columns, [height // rows] * rows
        widths[0] += room - sum(widths)
        heights[0] += height - sum(heights)
        pictures = ([each.read(k) for each, k in zip(subjects, shot.frames, strict=True)] for shot in shots)
        self._camera, low = frame_motion(subjects, pictures, view, min(widths) / min(heights))
        below = self._camera.position["YZ".index(self._up) + 1] < low
        if isinstance(ground, bool | np.bool_):
            ground = low if ground and not below else None
        options = {"samples": samples, "ground": ground, "device": device, "up_axis": self._up}
        if values and scale is None:  # colours of the cloth itself are shaded like its plain one
            options["contrast"] = 1.0
        # The bar is on the last column, so the motion there is shifted to the left of it.
        beside = [0] * (columns - 1) + [self._overlay.beside]
        cells = [divmod(k, columns) for k in range(len(subjects))]
        self._cameras = [replace(self._camera, shift=0.5 * beside[column] / heights[row]) for row, column in cells]
        self._sizes = [(widths[column] + beside[column], heights[row]) for row, column in cells]
        self._casters = [RayCaster(each.shapes, *size, **options) for each, size in zip(subjects, self._sizes, strict=True)]

    def images(self, with_time):
        """Yields the pictures as Pillow images."""
        rows = None
        if self._values:
            columns = zip(*(shot.frames for shot in self._shots), strict=True)
            rows = [_held(each.rows, column) for each, column in zip(self._values, columns, strict=True)]
        for shot in self._shots:
            panels, excluded = [], False
            for k, (subject, caster) in enumerate(zip(self._subjects, self._casters, strict=True)):
                colours = [None] * len(subject.shapes)
                if rows:
                    values = next(rows[k])
                    excluded = excluded or bool(np.isnan(values).any())
                    colours[subject.coloured] = self._painted(subject.shapes[subject.coloured], values)
                camera = self._cameras[k] if subject.camera is None else self._seen(k, shot.frames[k])
                panels.append(caster.image(subject.read(shot.frames[k]), camera, colours))
                self.left_out += caster.left_out
            yield self._overlay.draw(panels, shot.text if with_time else None, excluded)

    def _seen(self, k, frame):
        """Returns the camera of subject k's stage, with the middle of the motion as distance."""
        width, height = self._sizes[k]
        position, forward, up, *lens = self._subjects[k].camera(frame, width / height)
        forward = forward / np.linalg.norm(forward)
        away = self._camera.target - position
        return Camera(position, position + max(away @ forward, 0.1 * np.linalg.norm(away)) * forward, up, *lens)

    def _painted(self, shape, values):
        """Returns colours of vertices (n, 3), or of corners of triangles (T, 3, 3)."""
        colours = values if values.ndim == 2 else self._scale.linear(values)
        return colours if len(values) == shape.count else np.repeat(colours[:, None], 3, axis=1)


def _held(rows, frames):
    found = rows(dict.fromkeys(frames))
    last = values = None
    for frame in frames:
        if frame != last:
            last, values = frame, next(found)
        yield values
