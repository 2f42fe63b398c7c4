"""Writes an analysis as a USD stage, tables, arrays, plots and pictures, row by row."""

import warnings
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from ..analysis.measures import scalars
from ..analysis.summaries import CsvWriter, JsonWriter, Summary, summarise
from ..base.interrupts import Interrupted
from ..base.outputs import check_apart
from ..base.texts import camel_case
from ..picture.measured import neutral_of, scalar_names, scale_of

# Drawn length of a principal direction with stretch 1, relative to the square root of the median triangle area.
_SEGMENT = 0.7
# Time codes nearer than this to the numbers of their frames are replaced by these.
_EVEN = 1e-6


@dataclass
class Extremes:
    """The extremes of a scalar over all rows: the :class:`Summary` with its smallest and its largest value."""

    smallest: Summary | None = None
    largest: Summary | None = None

    def add(self, summary):
        low, high = summary.percentiles[0], summary.percentiles[-1]
        if self.smallest is None or low < self.smallest.percentiles[0]:
            self.smallest = summary if summary.measured else self.smallest
        if self.largest is None or high > self.largest.percentiles[-1]:
            self.largest = summary if summary.measured else self.largest


@dataclass
class Report:
    """The result of :func:`write_report`.

    Attributes:
        rows: Number of rows.
        extremes: :class:`Extremes` by name of scalar.
        exclusions: Sentences about the first exclusions, at most ``SENTENCES``.
        excluded: Number of exclusions.
        coloured: The scalar shown as colour, or None.
        scale: Its (low, high), or None.
    """

    SENTENCES = 20

    rows: int = 0
    extremes: dict = field(default_factory=dict)
    exclusions: list = field(default_factory=list)
    excluded: int = 0
    coloured: str | None = None
    scale: tuple[float, float] | None = None


@dataclass(frozen=True)
class ReportFiles:
    """The files of a report, each a path, or None for no such file.

    Attributes:
        usd: A stage, a layer over the measured stage if there is one: each scalar as a primvar, and one as colour.
        csv: A table with a line for each row and scalar, see :class:`warpcloth.analysis.summaries.CsvWriter`.
        json: The same data as one object, with the exclusions.
        npz: The measures as arrays, (rows, E, *shape).
        plot: A picture of the percentiles over time, .png, .svg or .pdf.
        stills: Pictures, .png, by number of the frame.
        single_file: Whether the stage is one file, see :class:`warpcloth.usd.AnimationWriter`.
        up_axis: "Y" or "Z", for inputs that have none.
    """

    usd: str | None = None
    csv: str | None = None
    json: str | None = None
    npz: str | None = None
    plot: str | None = None
    stills: dict | None = None
    single_file: bool = False
    up_axis: str | None = None


@dataclass(frozen=True)
class ReportLooks:
    """The looks of the stage and the pictures of a report.

    Attributes:
        colour: The scalar to show, such as "stretch_1"; by default the first; "none" for a stage without colours.
        colour_range: (low, high) of its colours; by default from the smallest 1st percentile to the largest 99th of all rows,
            symmetric about the value without deformation, if there is one.
        colormap: Name of a colour map of matplotlib, or None, see :class:`warpcloth.picture.colour.Scale`.
        curves: Whether they show the principal directions, with their stretches as lengths.
        view: The :class:`warpcloth.picture.projection.View` of the stills, or None; its up axis is that of the animation.
        both_sides: Whether stills also show the opposite side of the cloth, see :func:`warpcloth.picture.picture.draw`.
    """

    colour: str | None = None
    colour_range: tuple[float, float] | None = None
    colormap: str | None = None
    curves: bool = False
    view: object = None
    both_sides: bool = False


def write_report(analyzer, files, looks=ReportLooks(), progress=None):
    """Measures and writes all rows of an analysis, in constant memory but for the percentiles of the plot.

    Args:
        analyzer: The :class:`warpcloth.Analyzer`.
        files: The :class:`ReportFiles`.
        looks: The :class:`ReportLooks`.
        progress: Function called with (row, rows) after each row, or None.

    Returns:
        :class:`Report`.

    Raises:
        ValueError: There is no such scalar or frame, ``curves`` is given without the measures "stretch" and "directions", a
            file is given twice or is the input, or a writer refuses its file.
    """
    usd, csv, json, npz, plot, stills = files.usd, files.csv, files.json, files.npz, files.plot, files.stills
    colour, colormap = looks.colour, looks.colormap
    listed = {name: measure for measure in analyzer.measures for name in scalar_names(measure)}
    report = Report(extremes={name: Extremes() for name in listed})
    _check(analyzer, listed, usd, stills, colour, looks.curves)
    if colormap is not None:
        from ..picture.colour import check_colormap

        check_colormap(colormap)
    _check_pictures(plot, stills)
    check_apart([usd, csv, json, npz, plot, *(stills or {}).values()], analyzer.sequence.files)
    if (usd or stills) and colour != "none" and (stills or colour or _can_colour()):
        report.coloured = colour or next(iter(listed))
        scale = scale_of([analyzer], report.coloured, listed[report.coloured], looks.colour_range)
        report.scale = scale.low, scale.high
    kept, opened = [], []
    with _interruptible(report, len(analyzer), opened), ExitStack() as stack:
        writers = [stack.enter_context(CsvWriter(csv))] if csv else []
        log = stack.enter_context(JsonWriter(json, _input(analyzer), {m.name: m for m in analyzer.measures})) if json else None
        writers += [log] if log else []
        archive = stack.enter_context(_archive(analyzer, npz)) if npz else None
        opened += filter(None, (*writers, archive))
        shown = None
        if usd or stills:
            shown = _Shown(analyzer, report, listed, files, looks, stack)
            opened += filter(None, [shown.writer])
        try:
            for sample in analyzer:
                values = {}
                for measure in analyzer.measures:
                    values |= scalars(measure, sample.values[measure.name])
                positions = analyzer.positions(sample.points)
                about = {"frame": sample.frame, "reference": sample.reference, "time": sample.time}
                for name, numbers in values.items():
                    summary = summarise(name, listed[name].unit, numbers, positions, analyzer.areas, **about)
                    report.extremes[name].add(summary)
                    if plot:
                        kept.append(summary)
                    for writer in writers:
                        writer.append(summary)
                for exclusion in sample.excluded:
                    report.excluded += 1
                    if len(report.exclusions) < Report.SENTENCES:
                        report.exclusions.append(str(exclusion))
                    if log:
                        log.exclude(exclusion, exclusion.frame)
                if archive:
                    archive.append(sample.frame, sample.reference, sample.time, sample.values)
                if shown:
                    shown.append(sample, values, positions)
                report.rows += 1
                if progress:
                    progress(report.rows, len(analyzer))
        except KeyboardInterrupt:
            if not report.rows:  # keep earlier files rather than write empty ones
                for writer in filter(None, (*writers, archive)):
                    writer.discard()
            raise
        if log:
            log.facts |= {"rows": report.rows, "excluded": report.excluded}
    if plot:
        from ..chart import plot_percentiles

        along = "frame" if analyzer.sequence.times is None else "time"
        with _interruptible(report, len(analyzer), opened):
            plot_percentiles(plot, kept, along, {name: measure.neutral for name, measure in listed.items()})
    return report


@contextmanager
def _interruptible(report, rows, opened):
    """Turns an interrupt into a message about which files have the rows so far."""
    try:
        yield
    except KeyboardInterrupt:
        tables = ", ".join(writer.path for writer in opened if getattr(writer, "finished", False))
        said = [f"they are in {tables}"] if tables else []
        said += [writer.saved() for writer in opened if getattr(writer, "kept", 0)]
        saved = "; ".join(said) or "nothing was saved"
        raise Interrupted(f"interrupted after {report.rows} of {rows} frames; {saved}") from None


def _check(analyzer, listed, usd, stills, colour, curves):
    if (usd or stills) and not listed:
        raise ValueError(f"colour: {analyzer.measures[0].name} has no number to be coloured; measure something else too")
    if colour is not None and colour not in listed and (colour != "none" or stills):
        raise ValueError(f"colour is {colour!r}; it must be one of {', '.join(listed)}" + ("" if stills else ", or none"))
    names = {measure.name for measure in analyzer.measures}
    if curves and not {"stretch", "directions"} <= names:
        raise ValueError("curves: need the measures stretch and directions")
    frames = [analyzer.sequence.labels[pair.frame] for pair in analyzer.pairs]
    if usd and len(set(frames)) < len(frames):
        twice = next(frame for frame in frames if frames.count(frame) > 1)
        raise ValueError(
            f"pairs: frame {twice:g} is measured twice, and a stage has one value at a time; write no stage, or one each"
        )
    for frame in stills or ():
        if frame not in frames:
            raise ValueError(f"stills: frame {frame:g} is not measured; it must be one of {frames[0]:g} to {frames[-1]:g}")


def _can_colour():
    """Returns whether matplotlib has colour maps; without it, warns that the stage has no colours."""
    from ..picture.figures import require_matplotlib

    try:
        require_matplotlib()
    except ImportError as error:
        warnings.warn(f"the stage has no colours: {error}", stacklevel=3)
        return False
    return True


def _check_pictures(plot, stills):
    """Checks that pictures can be written, before anything is measured."""
    if plot or stills:
        from ..picture.figures import PICTURES, check_path

        if plot:
            check_path(plot, PICTURES)
        for path in (stills or {}).values():
            check_path(path, PICTURES[:1])


def _count(analyzer, name):
    """Returns the number of components of a measure."""
    return next(measure.shape[0] for measure in analyzer.measures if measure.name == name)


def codes_per_second(sequence):
    """Returns frame numbers per second of a sequence or of cloths; 24 if there are no times."""
    if sequence.times is None or len(sequence.labels) < 2:
        return 24.0
    return float((sequence.labels[-1] - sequence.labels[0]) / (sequence.times[-1] - sequence.times[0]))


def _input(analyzer):
    mesh, sequence = analyzer.mesh, analyzer.sequence
    facts = {"file": sequence.path, "vertices": len(mesh.points), "triangles": len(mesh.triangles), "frames": len(sequence)}
    facts |= {"rest_declared": mesh is not sequence.mesh or bool(sequence.declared), "on": analyzer.on, "rates": analyzer.rates}
    return {name: value for name, value in facts.items() if value is not None}


def _archive(analyzer, path):
    from ..analysis.stacks import NpzWriter

    fields = {measure.name: ((analyzer.count, *measure.shape), analyzer.dtype) for measure in analyzer.measures}
    return NpzWriter(path, len(analyzer), fields)


class _Shown:
    """Writes the stage and the pictures, coloured by one scalar on one scale."""

    def __init__(self, analyzer, report, listed, files, looks, stack):
        self.analyzer, self.name, self.looks, self.stills = analyzer, report.coloured, looks, files.stills or {}
        self.over, self.scale, metadata = analyzer.sequence.stage is not None, None, {"analysis": _input(analyzer)}
        if self.name:
            from ..chart import Scale

            self.unit = listed[self.name].unit
            self.scale = Scale(*report.scale, neutral_of(listed[self.name]), looks.colormap)
            metadata["legend"] = self.scale.legend(self.name, self.unit)
        areas = analyzer.mesh.triangle_areas
        areas = areas[np.isfinite(areas) & (areas > 0.0)]  # others have no segments
        self.length = _SEGMENT * np.sqrt(np.median(areas)) if len(areas) else 0.0
        sequence = analyzer.sequence
        up_axis = sequence.up_axis or files.up_axis or analyzer.mesh.up_axis or "Y"
        if self.stills:
            from ..chart import View

            frames = {pair.frame for pair in analyzer.pairs if sequence.labels[pair.frame] in self.stills}
            view = replace(looks.view or View(), up_axis=up_axis)
            self.view = view.fit(sequence[frame] for frame in sorted(frames))
        self.writer, self.rate = None, codes_per_second(sequence)
        if files.usd:
            from ..usd import MeasureWriter

            lost = np.flatnonzero(~np.isfinite(analyzer.mesh.points).all(axis=1))
            if len(lost) and not self.over:
                where = "the rest shape" if sequence.declared else f"frame {sequence.labels[0]:g}, which is the rest shape,"
                raise ValueError(
                    f"{sequence.path or 'mesh'}: {where} has vertex {lost[0]} without a finite position; "
                    "a stage needs all of them; give another rest shape (--rest), or write no stage"
                )

            kind = "uniform" if analyzer.on == "triangle" else "vertex"
            names = [f"principal{k + 1}" for k in range(_count(analyzer, "stretch"))] if looks.curves else []
            self.writer = MeasureWriter(
                files.usd,
                analyzer.mesh if sequence.stage is None else sequence.mesh,
                {camel_case(name): kind for name in listed},
                coloured=camel_case(self.name) if self.name else None,
                directions=dict.fromkeys(names, kind),
                source=sequence.stage,
                fps=self.rate,
                up_axis=up_axis,
                metadata=metadata,
            )
            stack.callback(self.writer.close, single_file=files.single_file)

    def append(self, sample, values, positions):
        """Adds a row, whose scalars (E,) are ``values``."""
        segments = self._segments(sample, positions) if self.looks.curves else None
        finite = np.isfinite(sample.points).all()
        if self.writer and (self.over or finite):  # only a layer over a stage may lack points
            primvars = {camel_case(name): _single(numbers) for name, numbers in values.items()}
            colours = self.scale.linear(values[self.name]) if self.scale else None
            self.writer.append(self._time_code(sample), primvars, colours, segments, None if self.over else sample.points)
        if sample.frame in self.stills:
            from ..chart import draw

            reference = "the rest shape" if sample.reference is None else f"frame {sample.reference:g}"
            draw(
                self.stills[sample.frame],
                sample.points,
                self.analyzer.mesh.triangles,
                values[self.name],
                self.scale,
                on=self.analyzer.on,
                title=f"{self.name}, frame {sample.frame:g} against {reference}",
                unit=self.unit,
                view=self.view,
                directions=segments,
                both_sides=self.looks.both_sides,
            )

    def _time_code(self, sample):
        """Returns the time code of the source stage, or else the number of the frame, or its time in frames if uneven."""
        sequence = self.analyzer.sequence
        if self.over or sequence.times is None:
            return sample.frame
        code = sequence.labels[0] + self.rate * (sample.time - sequence.times[0])
        return sample.frame if abs(code - sample.frame) < _EVEN else code

    def _segments(self, sample, positions):
        """Returns the principal directions, with stretches as lengths, by name: centres and vectors (E, 3) [m]."""
        stretch, directions = sample.values["stretch"], sample.values["directions"]
        count = stretch.shape[1]
        vectors = [self.length * stretch[:, k, None] * directions[:, k] for k in range(count)]
        return {f"principal{k + 1}": (_single(positions), _single(vector)) for k, vector in enumerate(vectors)}


def _single(values):
    """Returns values with NaN for those that overflow in float32."""
    return np.where(np.abs(values) <= np.finfo(np.float32).max, values, np.nan)
