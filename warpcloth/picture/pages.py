"""Pages: an animation in one file of HTML, without a server or network."""

import base64
import html
import importlib.util
import json
import os
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..base.checks import array, choice, number, shown, whole
from ..base.limits import shown_bytes
from ..base.outputs import OutputSet, check_apart, check_replaceable
from ..base.types import FilePath, Progress, UpAxis
from ..base.version import installed_version
from ..mesh.mesh import Mesh
from .coding import LEVELS, STEPS, CodedPositions, CodedValues, coded_indices
from .colour import byte_colour, check_colormap
from .framing import drawn_points, frame_motion, seen_points
from .measured import GivenScalar, MeasuredScalar
from .overlay import bar_ticks, bar_unit
from .raycast import BACKGROUND
from .shape import CLOTH
from .subjects import subject_of

ENDING = ".html"
# Measures in a page if none are named: both principal stretches.
USUAL = ("stretch_1", "stretch_2")
# Largest page [bytes] that a browser can be expected to open, and that a notebook embeds.
MAX_BYTES, EMBEDDED = 400_000_000, 5_000_000
# Positions of more than this many times the bytes that a notebook embeds are not coded to see whether they fit. Coding shortens
# those of cloth in motion to 0.3 or 0.6.
_SHORTEN = 8
# Width of the picture by its height for which the camera is set. A narrower window sees the same width.
_ASPECT = 1.5
_TICKS = 6
_LISTED = 10  # largest number of frames that a warning names
_LESS = "fewer frames (frames, every) or colours take less"
_FOLDER = Path(__file__).parent / "viewer"


class TooLarge(ValueError):
    """A page would be too large."""


def view(
    source: Any,
    output: FilePath,
    *,
    mesh: Mesh | None = None,
    prim: str | None = None,
    fps: float | None = None,
    up_axis: UpAxis | None = None,
    copy: int | None = None,
    frames: tuple[float | None, float | None] | None = None,
    every: int = 1,
    colours: str | Sequence[str] | Mapping[str, ArrayLike] | None = None,
    colour_range: tuple[float, float] | None = None,
    colormap: str | None = None,
    measuring: Mapping[str, Any] | None = None,
    azimuth: float = -38.0,
    elevation: float = 24.0,
    zoom: float = 1.0,
    ground: bool | float = True,
    device: str = "cpu",
    progress: Progress | None = None,
) -> str:
    """Writes a page that shows an animation in a browser: one file of HTML, which loads nothing else.

    The page plays the motion in real time, turns about the cloth, and colours it by measures. Positions are rounded to 1/65534
    of the motion's box, values to 1/254 of the bar. The same input gives the same bytes.

    Args:
        source: One source of :func:`warpcloth.render`.
        output: File to write, .html.
        mesh: The mesh of frames in an array; of other sources the rest shape for measures.
        prim: Cloth in a stage, or geometry of a mesh file.
        fps: Frames per second, instead of the source's.
        up_axis: "Y" or "Z", if the source does not give it.
        copy: Index of a cloth of a batch; None for all, side by side.
        frames: Numbers of the first and last frame; None for the ends of the source.
        every: Show every k-th frame.
        colours: Measures to show, such as ("stretch_1", "area_ratio"); or arrays (F, n) or (F, T) by the text of their bar. ()
            for none; None for the two principal stretches, with matplotlib and one cloth of triangles with several frames. The
            page opens with the first that is given.
        colour_range: Ends of the only measure's bar; by default from the 1st to the 99th percentile of all frames.
        colormap: Map of matplotlib; by default viridis, or coolwarm about the undeformed value.
        measuring: Options of :class:`warpcloth.Analyzer` by name.
        azimuth: Angle of the camera about the vertical [°].
        elevation: Angle of the camera above the horizontal [°].
        zoom: Factor by which the camera is nearer than to see the whole motion.
        ground: Whether there is a ground below the motion, or its height [m].
        device: A Warp device, which measures.
        progress: Function called with (frames coded, frames), from 0, or None.

    Returns:
        str: The path of the file.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ImportError: Colours need matplotlib.
        ValueError: An argument is not allowed, the source cannot be read or drawn, or the page would be above 400 MB.

    Warns:
        UserWarning: Something is not drawn because a position is not finite or too far away.

    Examples:
        >>> import os, tempfile
        >>> import warpcloth as wc
        >>> path = os.path.join(tempfile.mkdtemp(), "sheet.html")
        >>> os.path.basename(wc.view(wc.Mesh.grid(4, 4), path))
        'sheet.html'
    """
    output = os.fspath(output)
    check_page(output)
    subject = _subject(source, mesh, prim, fps, up_axis, copy, azimuth)
    check_apart([output], subject.files)
    text = _page(
        subject,
        _chosen(subject, frames, every),
        _values(subject, colours, mesh, measuring, device),
        opened=bool(colours),
        scaling=(colour_range, colormap),
        seen_from=(azimuth, elevation, zoom),
        ground=ground,
        progress=progress,
    )
    with OutputSet() as outputs, outputs.writing(output) as file:
        file.write(text.encode())
    return output


def notebook_html(source):
    """Returns the HTML of an animation in a notebook: its page, how to write a large one, or None if it cannot be drawn.

    Args:
        source: An :class:`warpcloth.Animation`, :class:`warpcloth.Deformation` or :class:`warpcloth.Sequence`.
    """
    if any(getattr(source, name, True) is None for name in ("mesh", "scene")):
        return None
    named = html.escape(repr(source) if len(repr(source)) < 200 else type(source).__name__)
    subject = _subject(source)
    try:
        if 6 * len(subject) * sum(shape.count for shape in subject.shapes) > _SHORTEN * EMBEDDED:
            raise TooLarge("so many positions are not coded to find out")
        page = _page(subject, np.arange(len(subject)), _values(subject, None), largest=EMBEDDED)
    except TooLarge:
        path = getattr(source, "output", None) or getattr(source, "path", None)
        how = f"warpcloth view {path} -o {Path(path).stem}.html" if path else 'wc.view(animation, "animation.html")'
        rule = f"too large to be shown here, where a page may have {shown_bytes(EMBEDDED)}"
        return f"<p>{named}: {rule}. <code>{html.escape(how, quote=False)}</code> writes it into a file.</p>"
    style = "width: 100%; height: 480px; border: 0"
    return f'<iframe title="{named}" style="{style}" srcdoc="{html.escape(page)}"></iframe>'


def check_page(path):
    """Checks that a page can be written; raises OSError or ValueError."""
    path = Path(path)
    if path.suffix.lower() != ENDING:
        raise ValueError(f"{path}: the ending is {path.suffix!r}; it must be {ENDING}")
    check_replaceable(path)


def _subject(source, mesh=None, prim=None, fps=None, up_axis=None, copy=None, azimuth=-38.0):
    if fps is not None:
        number("fps", fps, above=0.0)
    if mesh is not None and not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is {shown(mesh)}; it must be a Mesh")
    if up_axis is not None:
        choice("up_axis", up_axis, ("Y", "Z"))
    number("azimuth", azimuth)
    found = subject_of(source, mesh, prim, fps, copy, azimuth)
    return replace(found, up_axis=found.up_axis or up_axis or "Y")


def _chosen(subject, frames, every):
    whole("every", every, 1)
    return subject.between(frames)[::every]


def _values(subject, colours, rest=None, measuring=None, device="cpu"):
    if colours is None:
        cloths = [shape for shape in subject.shapes if tuple(shape.colour) == CLOTH]
        can = len(cloths) == 1 and len(cloths[0].triangles) and len(subject) > 1 and importlib.util.find_spec("matplotlib")
        colours = USUAL if can else ()
    if isinstance(colours, Mapping):
        if measuring:
            raise ValueError("measuring is given with values of your own; it must be None with them")
        return [GivenScalar(values, subject, name) for name, values in colours.items()]
    colours = (colours,) if isinstance(colours, str) else colours
    if not isinstance(colours, Sequence):
        raise ValueError(f"colours is {shown(colours)}; it must be names of measures, or arrays by name")
    return [MeasuredScalar(subject, name, rest, device, dict(measuring or {})) for name in dict.fromkeys(colours)]


def _page(
    subject,
    chosen,
    values,
    opened=False,
    scaling=(None, None),
    seen_from=(-38.0, 24.0, 1.0),
    ground=True,
    progress=None,
    largest=None,
):
    """Returns the text of the page of the ``chosen`` frames of a subject.

    ``values`` are `MeasuredScalar` or `GivenScalar`, ``scaling`` the range and map of the only one, or None each.

    Raises:
        TooLarge: The page would be larger than ``largest`` [bytes], by default than a file may be.
    """
    given, colormap = scaling
    largest = largest or MAX_BYTES
    if given is not None:
        if len(values) != 1:
            raise ValueError(
                f"colour_range is given for {len(values)} measures; it must be that of one, the only one in colours"
            )
        array("colour_range", given, (2,))
    if colormap is not None:
        check_colormap(colormap)
    number("elevation", seen_from[1])
    number("zoom", seen_from[2], above=0.0)
    if not isinstance(ground, bool | np.bool_):
        number("ground", ground)
    motion = _Motion(subject)
    camera, lowest = frame_motion([subject], ([motion.note(subject.read(k))] for k in chosen), seen_from, _ASPECT)
    if isinstance(ground, bool | np.bool_):
        below = camera.position["YZ".index(subject.up_axis) + 1] < lowest
        ground = lowest if ground and not below else None
    ground = None if ground is None else float(ground)
    left_out = _left_out(subject.labels[chosen], motion.left_out)
    if left_out:
        warnings.warn(left_out, stacklevel=3)
    scales = [each.scale((), given, colormap) for each in values]
    positions = motion.coders()
    coded = [CodedValues(scale) for scale in scales]
    rows, excluded, counts = [each.rows(chosen) for each in values], [False] * len(values), [0] * len(values)
    for done, k in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen))
        for coder, moves, points in zip(positions, motion.moves, subject.read(k), strict=True):
            if moves or not done:
                coder.append(points)
        for index, row in enumerate(rows):
            found = next(row)
            counts[index], excluded[index] = len(found), excluded[index] or bool(np.isnan(found).any())
            coded[index].append(found)
        size = sum(each.size for each in (*positions, *coded))
        if size > largest:
            so_far = f"with {done + 1} of {len(chosen)} frames in it"
            raise TooLarge(f"{subject.name}: the page would be larger than {shown_bytes(largest)}, {so_far}; {_LESS}")
    if progress is not None:
        progress(len(chosen), len(chosen))
    shapes = [_shape_data(*each) for each in zip(subject.shapes, positions, motion.moves, strict=True)]
    measures = [_measure_data(*each) for each in zip(values, scales, coded, counts, excluded, strict=True)]
    times = None if subject.times is None else np.round(subject.times[chosen], 9).tolist()
    data = {
        "name": subject.name,
        "up": subject.up_axis,
        "labels": subject.labels[chosen].tolist(),
        "times": times,
        "interval": subject.interval,
        "camera": {"position": camera.position, "target": camera.target, "fov": camera.fov, "aspect": _ASPECT},
        "sun": camera.sun(np.eye(3)["YZ".index(subject.up_axis) + 1]).tolist(),
        "ground": ground,
        "background": list(byte_colour(BACKGROUND)),
        "shapes": shapes,
        "coloured": subject.coloured,
        "measures": measures,
        "leftOut": left_out,
        "opened": 0 if opened and measures else None,
        "version": installed_version() or "",
    }
    text = _filled(subject.name, data)
    if len(text) > largest:
        raise TooLarge(f"{subject.name}: the page would be larger than {shown_bytes(largest)}; {_LESS}")
    return text


def _left_out(labels, counts):
    lost = [f"{label:g}" for label, count in zip(labels, counts, strict=True) if count]
    if not lost:
        return ""
    listed = ", ".join(lost[:_LISTED]) + (", …" if len(lost) > _LISTED else "")
    where = f"{'frames' if len(lost) > 1 else 'frame'} {listed}"
    count = f"{sum(counts)} triangles, lines or pins are not drawn, in all pictures together"
    return f"{count}, {where}: a position is not finite, or too far away"


class _Motion:
    """The box of each shape's motion, and whether it moves.

    Attributes:
        left_out: Number of elements not shown in each frame so far.
    """

    def __init__(self, subject):
        self._seen = [seen_points(shape) for shape in subject.shapes]
        self._low = np.full((len(self._seen), 3), np.inf)
        self._high, self._first = -self._low, None
        self._shapes, self.moves, self.left_out = subject.shapes, [False] * len(self._seen), []

    def note(self, picture):
        self._first = picture if self._first is None else self._first
        self.left_out.append(0)
        for k, (points, start, seen) in enumerate(zip(picture, self._first, self._seen, strict=True)):
            found, lost = drawn_points(self._shapes[k], points, seen)
            self.left_out[-1] += lost
            if len(found):
                self._low[k], self._high[k] = np.minimum(self._low[k], found.min(0)), np.maximum(self._high[k], found.max(0))
            self.moves[k] = self.moves[k] or not np.array_equal(points, start, equal_nan=True)
        return picture

    def coders(self):
        found = []
        for low, high in zip(self._low, self._high, strict=True):
            known = np.isfinite(low).all()
            side = float((high - low).max()) if known else 0.0
            # The smallest quantum is far below the rounding of the coordinates, for a shape that is one point.
            quantum = max(side / STEPS, np.finfo(np.float64).eps * float(np.abs(low).max()) if known else 0.0) or 1.0
            found.append(CodedPositions(low if known else np.zeros(3), quantum))
        return found


def _shape_data(shape, coder, moves):
    return {
        "count": shape.count,
        "triangles": coded_indices(shape.triangles),
        "lines": coded_indices(shape.lines),
        "radius": float(shape.radius),
        "balls": coded_indices(shape.balls[:, None]),
        "ballRadius": float(shape.ball_radius),
        "colour": shape.colour.tolist(),
        "back": shape.back.tolist(),
        "ballColour": shape.ball_colour.tolist(),
        "moves": moves,
        "low": coder.low.tolist(),
        "quantum": coder.quantum,
        "positions": coder.text(),
    }


def _measure_data(values, scale, coder, count, excluded):
    table = np.vstack([scale.srgb([np.nan]), scale.srgb(np.linspace(scale.low, scale.high, LEVELS + 1))])
    return {
        "name": values.name,
        "unit": bar_unit(scale, values.unit),
        "count": count,
        "low": scale.low,
        "high": scale.high,
        "ticks": [[(value - scale.low) / (scale.high - scale.low), text] for value, text in bar_ticks(scale, _TICKS)],
        "colours": base64.b64encode(np.round(255.0 * table).astype(np.uint8).tobytes()).decode(),
        "excluded": excluded,
        "values": coder.text(),
    }


def _filled(title, data):
    parts = {
        "title": html.escape(title),
        "licence": html.escape((_FOLDER / "three.LICENSE").read_text(encoding="utf-8").strip()),
        "viewer": _viewer(),
        # In JSON < stands in texts only, where no end of the element may be read into it.
        "data": json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
    }
    text = (_FOLDER / "page.html").read_text(encoding="utf-8")
    first, *rest = text.split("{{")
    return first + "".join(parts[name] + after for name, after in (part.split("}}", 1) for part in rest))


@cache
def _viewer():
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    code = deflate.compress((_FOLDER / "viewer.js").read_bytes()) + deflate.flush()
    return base64.b64encode(code).decode()
