"""Colours, pictures and plots: colours by their tables, pictures and plots by their pixels."""

import json
import re
import sys
import warnings
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread

import warpcloth as wc
from warpcloth.chart import Scale, View, draw, plot_percentiles, range_over
from warpcloth.picture import colour
from warpcloth.picture.colour import EXCLUDED
from warpcloth.picture.figures import PICTURES, check_path, save
from warpcloth.picture.projection import brightness

FRONT = View(azimuth=0.0, elevation=0.0)
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
# Of 8 bits a channel, rounded.
STEP = 0.51 / 255


def lab(srgb):
    """CIELAB of sRGB (…, 3), by D65."""
    matrix = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    xyz = linear @ matrix.T / matrix.sum(axis=1)
    x, y, z = np.moveaxis(np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def lit(scale, value, corners=SQUARE[None, :3]):
    """The colour of a triangle that :data:`FRONT` sees."""
    return scale.srgb(value) * brightness(FRONT.project(corners), 0.85)


def share(path, wanted):
    """Of how many pixels the colour is ``wanted``."""
    return int((np.abs(imread(path)[..., :3] - wanted) < 2 * STEP).all(axis=-1).sum())


def summaries(percentiles, name="stretch", unit="1"):
    return [
        SimpleNamespace(name=name, unit=unit, time=k / 24, frame=k + 1, percentiles=tuple(row))
        for k, row in enumerate(percentiles)
    ]


@pytest.mark.parametrize(
    ("scale", "name", "values", "places"),
    [
        (Scale(2.0, 6.0), "viridis", [2.0, 4.0, 6.0, 1.0, 9.0, -np.inf, np.inf], [0.0, 0.5, 1.0, 0.0, 1.0, 0.0, 1.0]),
        (Scale(0.9, 1.2, 1.0), "coolwarm", [0.8, 1.0, 1.2, 0.0, np.inf], [0.0, 0.5, 1.0, 0.0, 1.0]),
        (Scale(0.1, 0.3, 0.0), "coolwarm", [-0.3, 0.0, 0.3], [0.0, 0.5, 1.0]),
        (Scale(0.1, 0.3, 0.0, colormap="RdBu"), "RdBu", [-0.3, 0.0, 0.3], [0.0, 0.5, 1.0]),
    ],
    ids=["sequential", "diverging", "all on one side", "of one's choice"],
)
def test_ends_and_middle_have_the_colours_of_the_map(scale, name, values, places):
    """An odd number of stops has one in the middle, of matplotlib's 256 none is; between stops colours are linear."""
    found = matplotlib.colormaps[name].resampled(257)
    assert np.abs(scale.srgb(values) - found(places)[:, :3]).max() < 1e-14
    shaped = scale.srgb(np.float32([values, values]))
    assert shaped.shape == (2, len(values), 3) and np.abs(shaped[1] - found(places)[:, :3]).max() < 1e-4


@pytest.mark.parametrize("scale", [Scale(0.0, 1.0), Scale(-1.0, 1.0, 0.0)], ids=["sequential", "diverging"])
def test_lightness_is_monotone_and_grey_is_no_colour_of_the_map(scale):
    colours = lab(scale.srgb(np.linspace(scale.low, scale.high, 513)))
    lightness = colours[:, 0]
    if scale.neutral is None:
        assert (np.diff(lightness) >= 0.0).all() and np.ptp(lightness) > 70.0
    else:
        assert (np.diff(lightness[:257]) > 0.0).all() and (np.diff(lightness[256:]) < 0.0).all()
        assert np.abs(lightness - lightness[::-1]).max() < 1.0 and np.hypot(*colours[256, 1:]) < 1.0
    excluded = scale.srgb([np.nan, 0.5])
    assert np.array_equal(excluded[0], EXCLUDED) and np.array_equal(scale.srgb(np.nan), EXCLUDED)
    # 2.3 is what an eye just tells apart (Mahy et al. 1994).
    assert np.linalg.norm(colours - lab(excluded[0]), axis=1).min() > 25.0


def test_linear_colours_are_those_of_srgb():
    scale = Scale(0.0, 1.0)
    values = np.append(np.linspace(0.0, 1.0, 100), np.nan)
    found = scale.linear(values)
    coded = np.where(found <= 0.0031308, 12.92 * found, 1.055 * found ** (1 / 2.4) - 0.055)
    assert np.abs(coded - scale.srgb(values)).max() < 1e-12
    assert abs(colour.to_linear(np.float64(0.5)) - 0.21404114) < 1e-8


@pytest.mark.parametrize("scale", [Scale(0.0, 0.3), Scale(0.9, 1.1, 1.0)], ids=["sequential", "diverging"])
def test_a_legend_is_plain_and_survives_a_stage(scale, tmp_path):
    from pxr import Sdf

    legend = scale.legend("stretch_1", "1")
    assert json.loads(json.dumps(legend, allow_nan=False)) == legend
    expected = {"measure": "stretch_1", "unit": "1", "map": scale.map, "low": scale.low, "high": scale.high}
    assert {key: legend[key] for key in expected} == expected
    assert legend.get("neutral") == scale.neutral
    stops = [legend[f"stop_{k}"] for k in range(9)]
    assert [stops[0]["value"], stops[-1]["value"]] == [scale.low, scale.high] and "stop_9" not in legend
    assert scale.neutral is None or stops[4]["value"] == scale.neutral
    colours = np.array([[stop[channel] for channel in ("red", "green", "blue")] for stop in (*stops, legend["excluded"])])
    assert np.array_equal(colours, scale.linear([*(stop["value"] for stop in stops), np.nan]))
    layer = Sdf.Layer.CreateNew(str(tmp_path / "legend.usda"))
    layer.customLayerData = {"warpcloth": {"legend": legend}}
    layer.Save()
    layer.Reload(True)
    assert layer.customLayerData["warpcloth"]["legend"] == legend


NONE = [np.nan] * 9
GROWING = [[k, 10 + k, 11 + k, 12, 13, 14, 15, 20 + k, 99] for k in range(4)]


@pytest.mark.parametrize(
    ("rows", "neutral", "expected"),
    [
        (GROWING, None, (10.0, 23.0)),
        (GROWING, 12.0, (1.0, 23.0)),
        ([*GROWING, NONE], None, (10.0, 23.0)),
        ([*GROWING, [0] * 7 + [np.inf] * 2], None, (0.0, 23.0)),
        ([[2.0] * 9] * 3, None, (2.0, 2.000002)),
        ([[2.0] * 9], 2.0, (1.999998, 2.000002)),
        ([[1.0 - 1e-7] * 5 + [1.0 + 1e-7] * 4], 1.0, (1.0 - 1e-6, 1.0 + 1e-6)),
        ([[2.0] * 9], 1.0, (0.0, 2.0)),
        ([[0.0] * 9], None, (0.0, 1.0)),
        ([[0.0] * 9], 0.0, (-1.0, 1.0)),
        ([NONE, NONE], None, (0.0, 1.0)),
        ([NONE], 0.0, (-1.0, 1.0)),
        ([], None, (0.0, 1.0)),
    ],
)
def test_a_range_over_all_frames(rows, neutral, expected):
    low, high = range_over(iter(summaries(rows)), neutral)
    assert (low, high) == pytest.approx(expected, rel=2e-12, abs=0.0) and low < high
    scale = Scale(low, high, neutral)
    # A sum of two numbers is rounded once, and then what is symmetric is so to that.
    assert (scale.low, scale.high) == pytest.approx((low, high), rel=1e-15)


@pytest.mark.parametrize("turn", [0.0, np.pi], ids=["front", "back"])
def test_both_sides_have_the_colours_of_the_scale(turn, tmp_path):
    scale, path = Scale(0.0, 1.0), tmp_path / "square.png"
    points = SQUARE * [np.cos(turn), 1.0, 1.0]
    draw(path, points, HALVES, [0.2, np.nan], scale, view=FRONT)
    height, width = imread(path).shape[:2]
    # 6 inches of 150 pixels for 1.03 sides, less the pixels at the borders.
    half = (6.0 * 150 / 1.03) ** 2 / 2
    assert (width, height) == (1080, 975)
    assert share(path, lit(scale, 0.2)) == pytest.approx(half, rel=0.01)
    assert share(path, lit(scale, np.nan)) == pytest.approx(half, rel=0.01)


@pytest.mark.parametrize("size", [(1.0, 1.0), (2.0, 1.0), (1.0, 2.0)], ids=["square", "wide", "high"])
def test_two_panels_show_both_sides(size, tmp_path):
    """Of two layers each panel shows the one that faces it; wide panels stand one above another."""
    scale, path = Scale(0.0, 1.0), tmp_path / "layers.png"
    sheet = SQUARE * [*size, 1.0]
    points, triangles = np.concatenate([sheet, sheet + np.array([0.0, 0.0, 0.1])]), np.concatenate([HALVES, HALVES + 4])
    draw(path, points, triangles, [0.1, 0.1, 0.9, 0.9], scale, view=FRONT, both_sides=True)
    height, width = imread(path).shape[:2]
    panel = 900 * np.array(size) / max(size)
    wide = size[0] > size[1]
    assert (width, height) == pytest.approx([panel[0] * (1 + (not wide)) + 180, (panel[1] + 45) * (1 + wide) + 75], abs=30)
    for value in (0.9, 0.1):
        assert share(path, lit(scale, value)) == pytest.approx(np.prod(panel / 1.03), rel=0.02), value
    behind = View(30.0, 20.0, window=(-1.0, 2.0, 0.0, 1.0)).opposite()
    assert (behind.azimuth, behind.elevation, behind.window) == (-150.0, -20.0, (-2.0, 1.0, 0.0, 1.0))
    assert behind.project(points) == pytest.approx(View(30.0, 20.0).project(points) * [-1.0, 1.0, -1.0])


def test_a_vertex_colours_a_third_of_its_triangles(tmp_path):
    scale, path = Scale(0.0, 1.0), tmp_path / "vertices.png"
    draw(path, SQUARE, HALVES, [0.1, 0.5, 0.8, np.nan], scale, on="vertex", view=FRONT)
    side = (6.0 * 150 / 1.03) ** 2
    for value, part in ((0.1, 1 / 3), (0.5, 1 / 6), (0.8, 1 / 3), (np.nan, 1 / 6)):
        assert share(path, lit(scale, value)) == pytest.approx(part * side, rel=0.02), value


def test_what_is_in_front_hides_what_is_behind(tmp_path):
    scale, path = Scale(0.0, 1.0), tmp_path / "layers.png"
    points = np.concatenate([SQUARE, SQUARE + np.array([0.0, 0.0, 0.1])])
    triangles = np.concatenate([HALVES, HALVES + 4])
    across = {"across": ([[0.5, 0.5, 0.0]], [[0.1, 0.0, 0.0]])}
    for values, front in (([0.1, 0.1, 0.9, 0.9], 0.9), ([0.9, 0.9, 0.1, 0.1], 0.1)):
        draw(path, points, triangles, values, scale, view=FRONT, directions=across)
        assert share(path, lit(scale, front)) > 700_000 and share(path, lit(scale, 1.0 - front)) < 100
        assert share(path, np.zeros(3)) == 0, "a segment on the layer behind"


def test_directions_are_segments_of_their_length(tmp_path):
    """The first are black and the second white; a side of the square is 900/1.03 pixels."""
    scale, path = Scale(0.0, 1.0), tmp_path / "directions.png"
    centres = [[0.5, 0.25, 0.0], [0.5, 0.75, 0.0], [np.nan] * 3]
    across, up = (np.array([vector, [np.nan] * 3, vector]) for vector in ([0.5, 0.0, 0.0], [0.0, 0.25, 0.0]))
    draw(path, SQUARE, HALVES, [0.5, 0.5], scale, view=FRONT, directions={"first": (centres, across), "second": (centres, up)})
    inside = imread(path)[95:955, 20:880, :3]
    for grey, size in ((0.0, (0.0, 0.5)), (1.0, (0.25, 0.0))):
        found = np.nonzero((np.abs(inside - grey) < 0.3).all(axis=-1))
        assert [np.ptp(axis) for axis in found] == pytest.approx(np.array(size) * 900 / 1.03, abs=4.0)
        # The header has 75 pixels, and the square is in the middle of 900.
        middle = [(axis.min() + axis.max()) / 2 + first for axis, first in zip(found, (95 - 75, 20), strict=True)]
        assert middle == pytest.approx([450 + 0.25 * 900 / 1.03, 450], abs=2.0)


def test_one_view_shows_all_frames(tmp_path):
    frames = [SQUARE, SQUARE + np.array([3.0, 0.0, 0.0]), SQUARE * np.nan]
    view = FRONT.fit(iter(frames))
    left, right, bottom, top = view.window
    assert (left, right) == pytest.approx((2.0 - 1.03 * 2.0, 2.0 + 1.03 * 2.0)) and bottom < 0.0 and top > 1.0
    draw(tmp_path / "0.png", frames[0], HALVES, [0.5, 0.5], Scale(0.0, 1.0), view=view)
    draw(tmp_path / "1.png", frames[1], HALVES, [0.5, 0.5], Scale(0.0, 1.0), view=view)
    seen = [imread(tmp_path / name)[:, :850, :3] for name in ("0.png", "1.png")]
    # Three sides to the right are 900·3/4.12 pixels, 655.3; the picture is the same but for its borders.
    assert np.abs(seen[0][:, 20:190] - seen[1][:, 675:845]).max() < STEP
    flat = FRONT.fit([SQUARE[:1]]).window
    assert flat[0] < 0.0 < flat[1] and flat[2] < 0.0 < flat[3]


def test_the_up_axis_is_up(tmp_path):
    mesh = wc.Mesh.grid(5, 7)
    points = mesh.points + np.sin(5.0 * mesh.points[:, :1]) * [0.0, 0.2, 0.0]
    values, scale = points[mesh.triangles, 1].mean(axis=1), Scale(-0.2, 0.2, 0.0)
    draw(tmp_path / "y.png", points, mesh.triangles, values, scale, title="wave $^$", unit="m")
    upright = points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    draw(tmp_path / "z.png", upright, mesh.triangles, values, scale, title="wave $^$", unit="m", view=View(up_axis="Z"))
    assert (tmp_path / "y.png").read_bytes() == (tmp_path / "z.png").read_bytes()


def test_triangles_that_are_nowhere_or_flat(tmp_path):
    """Nothing warns of them; the picture says in its head how many are nowhere."""
    scale, points = Scale(0.0, 1.0), np.concatenate([SQUARE, SQUARE[:1] + 0.5, [[np.inf, 0.0, 0.0]]])
    triangles = np.array([*HALVES, [0, 4, 4], [0, 1, 5]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw(tmp_path / "all.png", points, triangles, [0.5] * 4, scale, view=FRONT)
        draw(tmp_path / "some.png", points, triangles[:3], [0.5] * 3, scale, view=FRONT)
        draw(tmp_path / "none.png", points, triangles[:0], [], scale, view=FRONT)
    everything, some = (imread(tmp_path / name)[..., :3] for name in ("all.png", "some.png"))
    assert np.array_equal(everything[75:], some[75:]) and not np.array_equal(everything[:75], some[:75])
    assert share(tmp_path / "none.png", lit(scale, 0.5)) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "a.jpg"}, r"a\.jpg: the ending is '\.jpg'; it must be \.png"),
        ({"points": SQUARE[:, :2]}, r"points has shape \(4, 2\); it must be \(n, 3\)"),
        ({"triangles": HALVES * 1.0}, r"triangles has shape \(2, 3\) and type float64"),
        ({"triangles": HALVES + 2}, "triangles refers to vertices 2 to 5; there are 4"),
        ({"triangles": HALVES - 1}, "triangles refers to vertices -1 to 2; there are 4"),
        ({"values": [1.0]}, r"values has shape \(1,\); it must be \(2,\), one for each triangle"),
        ({"on": "vertex"}, r"values has shape \(2,\); it must be \(4,\), one for each vertex"),
        ({"on": "edge"}, "on is 'edge'; it must be one of 'triangle', 'vertex'"),
        ({"points": SQUARE * np.nan}, "no point of the frames is finite"),
        ({"directions": {"first": ([[0.0] * 3], [0.0] * 3)}}, r"directions\['first'\] has centres \(1, 3\) and vectors \(3,\)"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_refused(options, message, tmp_path):
    good = {"path": "a.png", "points": SQUARE, "triangles": HALVES, "values": [0.0, 1.0], "scale": Scale(0.0, 1.0)}
    wrong = {**good, **options}
    with pytest.raises(ValueError, match=message):
        draw(**{**wrong, "path": tmp_path / wrong["path"]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scale(1.0, 1.0), "low is 1 and high 1; low must be below high"),
        (lambda: Scale(np.nan, 1.0), "low is nan; it must be a number that is finite"),
        (lambda: Scale(0.0, np.inf), "high is inf"),
        (lambda: Scale(0.0, 1.0, "0"), "neutral is '0'"),
        (lambda: View(azimuth=np.nan), "azimuth is nan"),
        (lambda: View(up_axis="X"), "up_axis is 'X'; it must be one of 'Y', 'Z'"),
        (lambda: View(window=(0.0, 0.0, 1.0, 2.0)), "left must be below right and bottom below top"),
        (lambda: View().fit([]), "no point of the frames is finite"),
        (lambda: plot_percentiles("a.gif", summaries(GROWING)), r"the ending is '\.gif'; it must be \.png or \.svg or \.pdf"),
        (lambda: plot_percentiles("a.png", []), "there are no summaries"),
        (lambda: plot_percentiles("a.png", summaries(GROWING), "label"), "along is 'label'; it must be one of 'time', 'frame'"),
    ],
)
def test_what_has_no_meaning_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_folder_that_does_not_exist_or_is_in_the_way_is_refused(tmp_path):
    path = tmp_path / "no" / "a.png"
    for write in (lambda: plot_percentiles(path, summaries(GROWING)), lambda: draw(path, None, None, None, None)):
        with pytest.raises(FileNotFoundError, match=r"a\.png: the folder .*no does not exist"):
            write()
    (tmp_path / "a.png").mkdir()
    with pytest.raises(ValueError, match=r"a\.png: is no regular file; it must be one, or free"):
        check_path(tmp_path / "a.png", PICTURES)


def test_a_picture_that_cannot_be_finished_leaves_the_earlier_one(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    def fill_the_disk(figure, file, **options):
        (file if hasattr(file, "write") else open(file, "wb")).write(b"the first bytes")
        raise OSError("full")

    path = tmp_path / "picture.png"
    save(Figure(), path)
    before = path.read_bytes()
    monkeypatch.setattr(Figure, "savefig", fill_the_disk)
    with pytest.raises(OSError, match="full"):
        save(Figure(), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    colour.table.cache_clear()
    for need in (
        lambda: Scale(0.0, 1.0).linear([0.5]),
        lambda: plot_percentiles("a.png", summaries(GROWING)),
        lambda: draw("a.png", SQUARE, HALVES, [0.0, 1.0], Scale(0.0, 1.0)),
    ):
        with pytest.raises(ImportError, match=r"need matplotlib: pip install -e '.\[chart\]' in the checkout"):
            need()


@pytest.mark.parametrize(
    ("ending", "head"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF"), (".PNG", b"\x89PNG")]
)
def test_plots_have_the_format_of_their_ending_and_the_same_bytes(ending, head, tmp_path, monkeypatch):
    first, second = tmp_path / f"first{ending}", tmp_path / f"second{ending}"
    for day, path in enumerate((first, second)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", str(86400 * day))  # what matplotlib takes for the date
        plot_percentiles(path, summaries(GROWING), neutrals={"stretch": 12.0})
    assert first.read_bytes().startswith(head) and first.read_bytes() == second.read_bytes()


def median_line(path):
    """Columns of the row with most black pixels, below the legend."""
    black = imread(path)[75:, :, :3].max(axis=-1) < 0.15
    return np.flatnonzero(black[black.sum(axis=1).argmax()])


LEVEL = [0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0, 10.0]


@pytest.mark.parametrize(
    ("missing", "gaps"),
    [([], 0), ([4, 5], 1), ([4, 6], 2), ([*range(1, 11)], 1)],
    ids=["none", "two", "one between", "ends alone"],
)
def test_rows_without_values_leave_gaps(missing, gaps, tmp_path):
    """What is alone between gaps is a mark; the marks of all but the ends have no line between them."""
    rows = [NONE if k in missing else LEVEL for k in range(12)]
    plot_percentiles(tmp_path / "plot.png", summaries(rows))
    columns = median_line(tmp_path / "plot.png")
    assert (np.diff(columns) > 10).sum() == gaps
    assert share(tmp_path / "plot.png", np.full(3, 0.88)) > 500


def texts(path, *arguments, **options):
    """All texts of a plot, which an SVG has as such."""
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        plot_percentiles(path, *arguments, **options)
    return re.findall(r"<text[^>]*>(.*?)</text>", path.read_text(encoding="utf-8"))


def test_extremes_far_away_leave_the_panel(tmp_path):
    """The bands, 8 high, keep more than half of the height that they have beside extremes of 0 and 10; a note says how far."""
    heights, notes = [], []
    for extremes in ((0.0, 10.0), (-50.0, 1e6), (0.0, np.inf)):
        rows = summaries([[extremes[0], *LEVEL[1:8], extremes[1]]] * 5)
        plot_percentiles(tmp_path / "plot.png", rows)
        band = (np.abs(imread(tmp_path / "plot.png")[..., :3] - 0.88) < 2 * STEP).all(axis=-1)
        heights.append(np.ptp(np.flatnonzero(band.sum(axis=1) > 100)))
        notes.append([text for text in texts(tmp_path / "plot.svg", rows) if text.startswith("to ")])
    assert heights[0] > 150 and min(heights[1:]) > 0.35 * heights[0]
    assert notes == [[], ["to 1e+06", "to -50"], ["to inf"]]


def test_axes_say_what_they_show(tmp_path):
    rows = summaries([LEVEL] * 4, unit="1/s") + summaries([NONE] * 4, "spin") + summaries([[np.inf] * 9], "size", "m")
    found = texts(tmp_path / "plot.svg", rows, neutrals={"stretch": 4.0})
    assert {"stretch [1/s]", "spin", "size [m]", "time [s]", "no values", "nothing finite", "median", "undeformed"} <= set(
        found
    )
    assert {"25 to 75 %", "5 to 95 %", "1 to 99 %", "extremes"} <= set(found)
    found = texts(tmp_path / "plot.svg", rows, "frame")
    assert "frame" in found and "undeformed" not in found


@pytest.mark.slow
def test_each_scalar_has_a_panel_and_neutral_values_a_line(tmp_path):
    rows = [row for k in range(7) for row in summaries([LEVEL] * 4 if k else [NONE] * 4, name=f"scalar_{k}", unit="1/s")]
    plot_percentiles(tmp_path / "plain.png", rows)
    plot_percentiles(tmp_path / "neutral.png", rows, neutrals={"scalar_3": 4.0, "scalar_5": 6.0})
    plot_percentiles(tmp_path / "one.png", rows[4:8])
    few, many = (imread(tmp_path / name).shape for name in ("one.png", "plain.png"))
    assert many[0] > 2.5 * few[0] and many[1] > 2.0 * few[1]
    blue = [(np.ptp(imread(tmp_path / name)[..., :3], axis=-1) > 0.3).sum() for name in ("plain.png", "neutral.png")]
    assert blue[0] == 0 and blue[1] > 500
    plot_percentiles(tmp_path / "far.png", rows[4:8], neutrals={"scalar_1": -5.0})
    plot_percentiles(tmp_path / "near.png", rows[4:8], neutrals={"scalar_1": 2.5})
    blue = [(np.ptp(imread(tmp_path / name)[..., :3], axis=-1) > 0.3).sum() for name in ("far.png", "near.png")]
    assert blue[0] == pytest.approx(blue[1], rel=0.2), "a line beyond all values is shown too"
