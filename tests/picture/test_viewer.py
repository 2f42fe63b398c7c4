"""Pages: what their numbers decode to, what they hold, what a browser shows and fetches, and what is refused."""

import base64
import hashlib
import html
import io
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpcloth as wc
from support.browser import CHROMIUM, Browser
from support.command_line import refused, run
from warpcloth.picture import pages
from warpcloth.picture.coding import LEVELS, NOWHERE, STEPS, CodedPositions, CodedValues, coded_indices
from warpcloth.picture.colour import Scale

VIEWER = Path(pages.__file__).parent / "viewer"
FRAMES = 6
MESH = wc.Mesh.grid(4, 5)
TIMES = np.linspace(0.0, 0.25, FRAMES)
# Events of a browser that say that something is wrong.
TOLD = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
# A sheet that turns, swells and sinks.
POINTS = np.stack(
    [(1.0 + t) * MESH.points @ [[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]] - [0, t, 0] for t in TIMES]
)


def inflated(text, kind):
    return np.frombuffer(zlib.decompress(base64.b64decode(text), -zlib.MAX_WBITS), kind)


def decoded(shape):
    """Positions (F, n, 3) [m], one frame for what stands still; NaN where they are not known. Written anew, from the docs."""
    bytes_ = inflated(shape["positions"], np.uint8).astype(np.int64).reshape(-1, 2, 3, shape["count"])
    folded = 256 * bytes_[:, 0] + bytes_[:, 1]
    change = np.where(folded % 2, -(folded + 1) // 2, folded // 2).cumsum(axis=-1)
    frames = []
    for each in change:
        last, other = (frames[-1], frames[-2] if len(frames) > 1 else frames[-1]) if frames else (0, 0)
        frames.append((each + 2 * last - other) % 65536)
    codes = np.array(frames).transpose(0, 2, 1)
    return np.where(codes == NOWHERE, np.nan, np.array(shape["low"]) + shape["quantum"] * codes)


def data_of(text):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*)</script>', text)[1])


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """A run with a ball that moves and a floor that does not, as a stage, and its points."""
    path = str(tmp_path_factory.mktemp("pages") / "fall.usdc")
    keys = np.linspace([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], FRAMES)
    given = {"density": 0.1, "terms": [wc.Spring(stiffness=50.0)], "pins": "corners and z == 0"}
    given |= {"colliders": [wc.Sphere(radius=0.2, position=keys - [0.0, 0.4, 0.0]), wc.Plane(position=(0.0, -1.2, 0.0))]}
    given |= {"fps": 24.0, "duration": (FRAMES - 1) / 24.0}
    scene = wc.Scene(wc.Mesh.grid(6, 6), **given)
    wc.simulate(scene, wc.XPBD(substeps=4), output=path, single_file=True, dtype="float64")
    return path


@pytest.mark.parametrize("case", ["random", "smooth", "still", "one vertex", "not finite"])
def test_positions_are_right_to_half_a_quantum(case):
    rng = np.random.default_rng(0)
    frames = {"random": rng.normal(size=(5, 9, 3)), "smooth": POINTS, "still": np.ones((3, 4, 3)), "one vertex": POINTS[:, :1]}
    points = frames.get(case, rng.normal(size=(5, 9, 3)))
    if case == "not finite":
        points[1, 3, 0], points[2, 4], points[:, 8] = np.nan, np.inf, 1e200
    known = (np.abs(points) < 1e100).all(axis=-1)
    low = np.min(points[known], axis=0)
    quantum = max(np.ptp(points[known], axis=0).max() / STEPS, 1e-12)
    coder = CodedPositions(low, quantum)
    for frame in points:
        coder.append(frame)
    found = decoded({"count": points.shape[1], "low": low, "quantum": quantum, "positions": coder.text()})
    assert np.array_equal(np.isnan(found).any(axis=-1), ~known)
    assert np.abs(found - points)[known].max() <= 0.5 * quantum * (1.0 + 1e-9)


def test_values_are_right_to_half_a_level():
    scale = Scale(-0.5, 2.0)
    rows = np.random.default_rng(1).normal(size=(4, 50))
    rows[0, 0], rows[2, 5], rows[3, 6] = np.nan, np.inf, -np.inf
    coder = CodedValues(scale)
    for row in rows:
        coder.append(row)
    codes = inflated(coder.text(), np.uint8).reshape(rows.shape).cumsum(axis=0, dtype=np.uint8)
    assert np.array_equal(codes == 0, np.isnan(rows))
    found = scale.low + (codes - 1.0) / LEVELS * (scale.high - scale.low)
    error = np.abs(found - np.clip(rows, scale.low, scale.high))[codes > 0]
    assert error.max() <= 0.5 * (scale.high - scale.low) / LEVELS * (1.0 + 1e-9)


def test_a_page_has_all_shapes(stage, tmp_path):
    path = tmp_path / "fall.html"
    assert wc.view(stage, path) == str(path)
    assert np.array_equal(inflated(coded_indices(MESH.triangles), "<i4").reshape(-1, 3).cumsum(axis=0), MESH.triangles)
    text = path.read_text(encoding="utf-8")
    data, sequence = data_of(text), wc.open_sequence(stage)
    cloth, *others = data["shapes"]
    found, given = decoded(cloth), np.stack([sequence[k] for k in range(FRAMES)])
    assert np.abs(found - given).max() <= 0.5 * cloth["quantum"] * (1.0 + 1e-9)
    assert cloth["quantum"] == pytest.approx(np.ptp(given, axis=(0, 1)).max() / STEPS)
    assert sorted(each["moves"] for each in data["shapes"]) == [False, True, True] and cloth["moves"]
    ball = next(each for each in others if each["moves"])
    shift = decoded(ball)[[0, -1]].mean(axis=1)
    assert shift[1] - shift[0] == pytest.approx([0.2, 0.0, 0.0], abs=2.0 * ball["quantum"])
    assert [each["name"] for each in data["measures"]] == ["stretch_1", "stretch_2"] and data["opened"] is None
    assert data["times"] == pytest.approx(np.arange(FRAMES) / 24.0) and data["labels"] == list(range(FRAMES))
    # The one file has the viewer with its licence, and forbids the browser to load any other.
    assert "default-src 'none'" in text and "Copyright" in text and "three.js authors" in text
    assert not re.search(r"(src|href)\s*=", text)
    wc.view(stage, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == path.read_bytes()


def test_measures_are_those_of_an_analysis(stage, tmp_path):
    wc.view(stage, tmp_path / "a.html", colours="area_ratio", frames=(1, 4), every=3, colour_range=(0.9, 1.1))
    (measure,) = data_of((tmp_path / "a.html").read_text())["measures"]
    found = inflated(measure["values"], np.uint8).reshape(2, -1).cumsum(axis=0, dtype=np.uint8)
    rows = {sample.frame: sample.values["area_ratio"].copy() for sample in wc.Analyzer(stage, measures="area_ratio")}
    for codes, frame in zip(found, (1, 4), strict=True):
        values = 0.9 + (codes - 1.0) / LEVELS * 0.2
        assert np.abs(values - np.clip(rows[frame], 0.9, 1.1)).max() <= 0.5 * 0.2 / LEVELS * (1.0 + 1e-5)
    assert measure["ticks"][0] == [pytest.approx(0.0, abs=1e-12), "0.90"] and (
        measure["low"],
        measure["high"],
    ) == pytest.approx((0.9, 1.1))


def test_of_several_cloths_one_is_measured_by_its_name(tmp_path):
    moved = "0: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 1: [(0, 0, 1), (1, 0, 1), (0, 1, 1)]"
    points = f"point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\npoint3f[] points.timeSamples = {{{moved}}}"
    sheet = f'def Mesh "Sheet" {{\nint[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n{points}\n}}\n'
    rope = f'def BasisCurves "Rope" {{\nuniform token type = "linear"\nint[] curveVertexCounts = [3]\n{points}\n}}\n'
    for others, named in (("", 2), (sheet.replace("Sheet", "Other"), 0), (rope, 0)):
        (tmp_path / "cloths.usda").write_text(f'#usda 1.0\n(upAxis = "Z")\n{sheet}{others}')
        for prim, count in ((None, named), ("Sheet", 2)):
            wc.view(tmp_path / "cloths.usda", tmp_path / "a.html", prim=prim)
            data = data_of((tmp_path / "a.html").read_text())
            assert (len(data["measures"]), data["up"], len(data["shapes"])) == (count, "Z", 1 + bool(others))


def test_values_of_ones_own(tmp_path):
    values = {"height [m]": POINTS[..., 1]}
    wc.view(POINTS, tmp_path / "a.html", mesh=MESH, colours=values)
    data = data_of((tmp_path / "a.html").read_text())
    assert [(each["name"], each["count"]) for each in data["measures"]] == [("height [m]", len(MESH.points))]
    assert data["opened"] == 0 and data["times"] is None


def test_a_notebook_shows_a_page_or_a_line(monkeypatch):
    sequence = wc.as_sequence(MESH, POINTS, times=TIMES)
    shown = sequence._repr_html_()
    page = html.unescape(re.fullmatch(r'<iframe title="Sequence" .* srcdoc="([^"]*)"></iframe>', shown, re.DOTALL)[1])
    assert len(decoded(data_of(page)["shapes"][0])) == FRAMES
    monkeypatch.setattr(pages, "EMBEDDED", 100_000)
    line = sequence._repr_html_()
    assert "\n" not in line and "where a page may have 100 kB" in line and 'wc.view(animation, "animation.html")' in line
    monkeypatch.setattr(pages, "_page", None)  # is not called for positions that are surely too many
    monkeypatch.setattr(pages, "EMBEDDED", 20)
    assert sequence._repr_html_().startswith("<p>Sequence: too large")
    scene = wc.Scene(MESH, density=0.1, terms=[wc.Spring(stiffness=10.0)], duration=0.1)
    assert "<p>Animation(" in wc.simulate(scene, wc.XPBD(substeps=1), frames=1)._repr_html_()
    start = MESH.points[:3]
    deformation = wc.deform(MESH, wc.Pins([0, 1, 2], keyframes=[start, start + np.array([0.0, 0.1, 0.0])]))
    assert deformation._repr_html_().startswith("<p>Deformation(")
    assert replace(deformation, mesh=None)._repr_html_() is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output": "a.htm"}, r"a\.htm: the ending is '\.htm'; it must be \.html"),
        ({"output": "no/a.html"}, "the folder .*no does not exist"),
        ({"every": 0}, "every is 0"),
        ({"frames": (10, 20)}, "frames is 10 to 20, where there are none"),
        ({"zoom": 0.0}, "zoom is 0"),
        ({"ground": "low"}, "ground is 'low'"),
        ({"up_axis": "X"}, "up_axis is 'X'"),
        ({"colours": "stretch"}, "colour is 'stretch'; it must be one of"),
        ({"colours": 3}, "colours is 3; it must be names of measures, or arrays by name"),
        ({"colour_range": (0.0, 1.0)}, "colour_range is given for 2 measures; it must be that of one"),
        ({"colours": {"a": np.zeros((FRAMES, 3))}}, r"colour has shape \(6, 3\)"),
        ({"source": MESH, "copy": 1}, "copy is 1; the source is one cloth"),
        (
            {"source": np.nan * POINTS},
            "no triangle, line or pin has positions that are finite and below 1e100 m; there is nothing",
        ),
        ({"source": 1e199 * POINTS}, "finite and below 1e100 m; there is nothing to draw"),
    ],
)
def test_what_cannot_be_shown_is_refused(given, message, tmp_path):
    options = {"source": POINTS, "mesh": MESH, "output": "a.html", **given}
    options["output"] = tmp_path / options["output"]
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        wc.view(**options)
    assert not list(tmp_path.iterdir())


def test_what_is_not_finite_is_left_out_and_said(tmp_path, capfd):
    """A vertex of frame 3 is NaN, one of frame 4 far away: on the page both are nowhere, and it has the same warning."""
    broken = POINTS.copy()
    broken[3, 0], broken[4, 0] = np.nan, 1e200
    count = 2 * int((MESH.triangles == 0).any(axis=1).sum())
    said = f"{count} triangles, lines or pins are not drawn, in all pictures together, frames 3, 4: a position is not finite, "
    np.savez(tmp_path / "nan.npz", points=broken, triangles=MESH.triangles)
    code, _, err = run(capfd, "view", tmp_path / "nan.npz", "-o", tmp_path / "a.html", "--plain")
    data = data_of((tmp_path / "a.html").read_text())
    assert code == 0 and f"{said}or too far away" in err and data["leftOut"] == f"{said}or too far away"
    known = np.isfinite(decoded(data["shapes"][0])).all(axis=2)
    assert np.argwhere(~known).tolist() == [[3, 0], [4, 0]]


def test_a_page_that_is_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "MAX_BYTES", 250_000)
    noise, mesh = np.random.default_rng(0).normal(size=(FRAMES, 10_000, 3)), wc.Mesh.grid(100, 100)
    with pytest.raises(ValueError, match=r"larger than 250 kB, with [2-5] of 6 frames in it"):
        wc.view(noise, tmp_path / "a.html", mesh=mesh, colours=())


def test_the_command(stage, tmp_path, capfd):
    path = tmp_path / "a.html"
    code, out, _ = run(capfd, "view", stage, "-o", path, "--every", 2, "--plain", "--json")
    facts = json.loads(out)
    assert code == 0 and (facts["frames"], facts["bytes"]) == (3, path.stat().st_size)
    assert data_of(path.read_text())["measures"] == []
    code, out, _ = run(capfd, "view", stage, "-o", path, "--colour", "area_ratio", "--colour", "stretch_2", "--no-ground")
    assert code == 0 and out.startswith(f"{path}: 6 frames in ") and out.endswith("; open it in a browser\n")
    data = data_of(path.read_text())
    assert [each["name"] for each in data["measures"]] == ["area_ratio", "stretch_2"] and data["ground"] is None
    refused(capfd, ["view", stage, "-o", path, "--range", "0", "1"], "--range is given without --colour")
    refused(capfd, ["view", stage, "-o", path, "--plain", "--colour", "area_ratio"], "--plain and --colour are given")
    refused(capfd, ["view", "none.usdc", "-o", path], "none.usdc")
    refused(capfd, ["view", stage, "-o", stage], "it must be .html")


def test_the_viewer_is_built_from_its_sources():
    sources = [VIEWER / "source" / name for name in ("main.js", "decode.js", "shapes.js", "package-lock.json")]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    assert f"of sources {digest} " in (VIEWER / "viewer.js").read_text(encoding="utf-8")[:200], "run viewer/source/build.sh"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium, in which a page is opened")
def test_a_browser_shows_the_motion_and_fetches_nothing(stage, tmp_path):
    path = tmp_path / "fall.html"
    wc.view(stage, path)
    path.write_text(path.read_text().replace('"leftOut":""', '"leftOut":"2 are not drawn"'))
    data, sequence = data_of(path.read_text()), wc.open_sequence(stage)
    with Browser(tmp_path / "profile") as browser:
        browser.open(f"{path.as_uri()}#frame=5&colour=stretch_1", "window.player?.drawn > 0")
        count = len(sequence[0])
        read = f"Array.from({{length: 3 * {count}}}, (_, k) => player.shapes[0].at({{}}, (k / 3) | 0, k % 3))"
        for frame in (0, 5):
            points = np.reshape(browser.run(read.replace("{}", str(frame))), (-1, 3))
            assert np.abs(points - sequence[frame]).max() <= 0.5 * data["shapes"][0]["quantum"] * (1.0 + 1e-9)
        codes = browser.run("Array.from(player.measures[0].codes)")
        rows = inflated(data["measures"][0]["values"], np.uint8).reshape(FRAMES, -1).cumsum(axis=0, dtype=np.uint8)
        assert codes == rows.ravel().tolist()
        pictures = [picture(browser)]
        browser.press("ArrowLeft")
        assert browser.run("player.frame") == 4
        browser.press("Home")
        assert browser.run("[player.frame, document.getElementById('slider').value, player.playing]") == [0, "0", False]
        pictures.append(picture(browser))
        browser.run("player.paint(null)")
        pictures.append(picture(browser))
        browser.press(" ", " ")
        assert browser.run("player.playing")
        browser.press(" ", " ")
        text = browser.run("document.getElementById('text').textContent")
        assert "quantised to 0.0" in text and " 2 are not drawn." in text
        assert browser.run("document.getElementById('note').textContent").endswith("; parts are not drawn")
        fetched = [each["params"]["request"]["url"] for each in browser.events if each["method"] == "Network.requestWillBeSent"]
        told = [each for each in browser.events if each["method"] in TOLD]
        entries = browser.run("performance.getEntriesByType('resource').length")
    assert fetched == [path.as_uri()] and entries == 0 and told == []
    for other in (1, 2):
        changed = np.abs(pictures[0].astype(int) - pictures[other]).max(axis=-1) > 8
        assert changed.mean() > 0.01, "the cloth covers more than a hundredth of the picture"
    assert np.ptp(pictures[2], axis=(0, 1)).min() > 100


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium, in which a page is opened")
def test_of_many_pages_in_one_those_in_view_are_drawn(stage, tmp_path):
    """A browser keeps few contexts of WebGL, here 3. Of 5 frames of a notebook, those in view have one, also a second time."""
    count, each = 5, "Array.from(frames, (_, k) => frames[k])"
    wc.view(stage, tmp_path / "fall.html", colours=())
    frame = f'<iframe srcdoc="{html.escape((tmp_path / "fall.html").read_text())}" width="400" height="300"></iframe><br>'
    (tmp_path / "notebook.html").write_text("<!DOCTYPE html>" + count * frame)
    with Browser(tmp_path / "profile", options=["--max-active-webgl-contexts=3"]) as browser:
        browser.open(
            (tmp_path / "notebook.html").as_uri(), f"{each}.length == {count} && {each}.every((each) => each.player?.shapes)"
        )
        shown = []
        for k in (*range(count), 0):
            browser.run(f"document.querySelectorAll('iframe')[{k}].scrollIntoView()")
            drawn = browser.run(f"frames[{k}].player.drawn")
            while (
                browser.run(f"frames[{k}].player.pause(), frames[{k}].player.dirty = true, frames[{k}].player.drawn") <= drawn
            ):
                pass
            if k == 0:
                shown.append(np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB"))[:300, :400])
        live = browser.run(f"{each}.filter((each) => each.player.renderer?.getContext().isContextLost() === false).length")
        told = [each for each in browser.events if each["method"] == "Log.entryAdded"]
    assert live <= 2 and told == []  # the browser tells that it took a context from another frame
    assert np.ptp(shown[1][60:240], axis=(0, 1)).min() > 100, "the first is drawn again"
    assert np.abs(shown[0].astype(int) - shown[1]).max(axis=-1).mean() < 20.0


def picture(browser):
    drawn = browser.run("player.drawn")
    browser.run("player.dirty = true")
    while browser.run("player.drawn") == drawn:
        pass
    return np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB"))
