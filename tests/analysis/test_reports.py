"""An analysis as files, from Python and from the command line: each says what the arrays say."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

import warpcloth as wc
from support.rows import slow_but
from support.usd_validation import validate
from warpcloth.analysis.measures import scalars
from warpcloth.base.texts import camel_case
from warpcloth.chart import Scale
from warpcloth.cli import main
from warpcloth.cli.reports import ReportFiles, ReportLooks, write_report
from warpcloth.picture.colour import table
from warpcloth.picture.measured import scalar_names
from warpcloth.scenes import hanging
from warpcloth.usd import AnimationWriter, FrameSequence

FPS = 60.0


@pytest.fixture(scope="module")
def cloth(tmp_path_factory):
    """A stage of a hanging cloth, 7 frames."""
    path = tmp_path_factory.mktemp("cloth") / "cloth.usdc"
    wc.simulate(hanging.scene(n=6, duration=0.1), wc.XPBD(substeps=4, iterations=5), output=str(path))
    return path


@pytest.fixture
def folder(cloth, tmp_path):
    """The same frames as OBJ files 001 to 007."""
    sequence = wc.open_sequence(cloth)
    for frame in range(len(sequence)):
        mesh = trimesh.Trimesh(sequence[frame], sequence.mesh.triangles, process=False)
        (tmp_path / f"cloth_{frame + 1:03d}.obj").write_text(trimesh.exchange.obj.export_obj(mesh, digits=12))
    trimesh.Trimesh(sequence.mesh.points, sequence.mesh.triangles, process=False).export(tmp_path / "rest.ply")
    return tmp_path


@pytest.mark.parametrize("neighbourhood", [None, "1-ring"])
def test_every_file_says_what_the_arrays_say(cloth, tmp_path, neighbourhood):
    measures = ["stretch", "directions", "rotation_angle", "rate_of_strain", "spin"]
    options = {"measures": measures, "neighbourhood": neighbourhood, "every": 2}
    expected = wc.analyze(cloth, **options)
    files = {name: tmp_path / f"out.{name}" for name in ("csv", "json", "npz")}
    report = write_report(
        wc.Analyzer(cloth, **options), ReportFiles(usd=tmp_path / "out.usdc", **files), ReportLooks("stretch_2", curves=True)
    )
    fields = {name: found for m in measures for name, found in rows_of(expected, m).items()}
    with open(files["csv"], encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 4 * len(fields) == sum(1 for _ in json.load(open(files["json"]))["rows"])
    for row in table:
        values = fields[row["name"]][[0, 2, 4, 6].index(int(row["frame"]))]
        if np.isnan(values).all():
            assert row["p50"] == "" and int(row["excluded"]) == len(values)
            continue
        assert float(row["p50"]) == np.median(values) and float(row["p100"]) == values.max()
        assert float(row["mean"]) == pytest.approx(values.mean(), rel=1e-12) and row["reference"] == "rest"
        assert values[int(row["max_element"])] == values.max()
    with np.load(files["npz"]) as archive:
        assert archive["frames"].tolist() == [0, 2, 4, 6]
        for measure in measures:
            assert np.array_equal(archive[measure], expected[measure], equal_nan=True)
    for name, values in fields.items():
        read = FrameSequence(str(tmp_path / "out.usdc"), attribute=f"primvars:{camel_case(name)}")
        assert np.array_equal(np.asarray(read), values.astype(np.float32), equal_nan=True), name
    scale = Scale(*report.scale, 1.0)
    ends = [np.percentile(values, [1, 99]) for values in fields["stretch_2"]]
    half = np.abs(np.array(ends) - 1.0).max()
    assert report.scale == pytest.approx((1.0 - half, 1.0 + half), rel=1e-12)
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    colours = stage.GetPrimAtPath("/World/Cloth").GetAttribute("primvars:displayColor")
    for row, code in enumerate([0, 2, 4, 6]):
        np.testing.assert_allclose(np.array(colours.Get(code)), scale.linear(fields["stretch_2"][row]), atol=1e-6)
    legend = stage.GetRootLayer().customLayerData["warpcloth"]["legend"]
    assert legend["measure"] == "stretch_2" and (legend["low"], legend["high"]) == pytest.approx(report.scale)
    assert report.rows == 4 and report.extremes["stretch_1"].largest.percentiles[-1] == fields["stretch_1"].max()
    assert validate(tmp_path / "out.usdc", cloth) == []


def rows_of(analysis, name):
    """Scalars (rows, E) of a measure by name."""
    measure = analysis.measures[name]
    return {
        scalar: np.stack([scalars(measure, values)[scalar] for values in analysis[name]]) for scalar in scalar_names(measure)
    }


def test_curves_are_the_principal_directions(cloth, tmp_path):
    options = {"measures": ["stretch", "directions"], "reference": "first"}
    found = wc.analyze(cloth, **options)
    write_report(wc.Analyzer(cloth, **options), ReportFiles(usd=tmp_path / "out.usda"), ReportLooks(curves=True))
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    sequence = wc.open_sequence(cloth)
    centres = sequence[5][sequence.mesh.triangles].mean(axis=1)
    for k in range(2):
        points = np.array(stage.GetPrimAtPath(f"/World/Cloth_principal{k + 1}").GetAttribute("points").Get(5)).reshape(-1, 2, 3)
        np.testing.assert_allclose(points.mean(axis=1), centres, atol=1e-6)
        vectors = points[:, 1] - points[:, 0]
        lengths = np.linalg.norm(vectors, axis=1)
        ratios = lengths / found["stretch"][5, :, k]
        np.testing.assert_allclose(ratios, ratios[0], rtol=1e-4)
        np.testing.assert_allclose(vectors / lengths[:, None], found["directions"][5, :, k], atol=1e-4)


def test_a_folder_of_files_becomes_a_stage(folder, cloth, capsys):
    command = ["analyze", str(folder / "cloth_*.obj"), "--fps", "60", "--rest", str(folder / "rest.ply"), "--up-axis", "Z"]
    out = folder / "out.usdc"
    assert main([*command, "--measure", "stretch", "--dtype", "float64", "-o", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["rows"] == 7 and (facts["first_frame"], facts["last_frame"]) == (1, 7) and facts["excluded"] == 0
    stage = Usd.Stage.Open(str(out))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and stage.GetFramesPerSecond() == FPS
    read = FrameSequence(str(out), attribute="primvars:stretch1")
    expected = wc.analyze(cloth)["stretch"][:, :, 0]
    assert read.time_codes.tolist() == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_allclose(np.asarray(read), expected, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(FrameSequence(str(out))), np.asarray(FrameSequence(str(cloth))), atol=1e-7)
    assert validate(out) == []


def test_frames_that_are_broken_are_left_out_and_named(folder, capsys):
    """One with a point that is not a number, one that is missing, one triangle of the rest shape without area."""
    text = (folder / "cloth_003.obj").read_text().splitlines()
    place = next(k for k, line in enumerate(text) if line.startswith("v "))
    (folder / "cloth_003.obj").write_text("\n".join([*text[: place + 4], "v nan 0 0", *text[place + 5 :]]))
    (folder / "cloth_005.obj").unlink()
    out = folder / "out.usdc"
    command = ["analyze", str(folder / "cloth_*.obj"), "--fps", "60", "--measure", "stretch", "--csv", str(folder / "t.csv")]
    assert main([*command, "-o", str(out), "--report", str(folder / "t.json")]) == 0
    said = capsys.readouterr().out
    assert "frame 5 is missing" in said and "frame 3, vertex 4: has no finite position" in said
    assert FrameSequence(str(out), attribute="primvars:stretch1").time_codes.tolist() == [1, 2, 4, 6, 7]
    with open(folder / "t.csv", encoding="utf-8") as file:
        excluded = {int(row["frame"]): int(row["excluded"]) for row in csv.DictReader(file)}
    touched = (wc.open_sequence(folder / "cloth_*.obj", fps=60).mesh.triangles == 4).any(axis=1).sum()
    assert excluded == {1: 0, 2: 0, 3: touched, 4: 0, 6: 0, 7: 0}
    reasons = [(entry["frame"], entry["kind"], entry["elements"]) for entry in json.load(open(folder / "t.json"))["exclusions"]]
    assert reasons == [(5, "frame", []), (3, "vertex", [4])]


@pytest.mark.parametrize("kind", ["obj", "npz"])
def test_files_of_the_input_are_not_written_over(folder, kind):
    sequence = wc.open_sequence(folder / "cloth_*.obj")
    if kind == "npz":
        np.savez(folder / "cloth.npz", points=np.array(list(sequence)), triangles=sequence.mesh.triangles)
        sequence = wc.open_sequence(folder / "cloth.npz")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    (folder / "link").symlink_to(sequence.files[-1])
    for path in (sequence.files[-1], folder / "link"):
        with pytest.raises(ValueError, match="is a file of the input, which must not be changed"):
            write_report(wc.Analyzer(sequence), ReportFiles(csv=path))
    assert {path: path.read_bytes() for path in before} == before


HIDDEN = [(neighbourhood, frame, "nan") for neighbourhood in (None, "1-ring", "nearest:k=4") for frame in ("rest", 2)]


@pytest.mark.parametrize(
    ("neighbourhood", "frame", "place"),
    slow_but(HIDDEN, [*HIDDEN, (None, "rest", "inf"), ("1-ring", 2, "inf"), ("nearest:k=4", "rest", "inf")]),
)
def test_points_without_a_place_hide_no_other_directions(tmp_path, recwarn, place, frame, neighbourhood):
    """All elements that do not touch such a point have their values and their segments, whichever is the frame."""
    mesh = wc.Mesh.grid(6, 6)
    stage = Usd.Stage.CreateNew(str(tmp_path / "cache.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    sheet = UsdGeom.Mesh.Define(stage, "/Sheet")
    sheet.CreateFaceVertexCountsAttr([3] * len(mesh.triangles))
    sheet.CreateFaceVertexIndicesAttr(np.array(mesh.triangles).reshape(-1))
    for code in range(3):
        points = mesh.points * [1.0, 1.0, 1.0 + 0.1 * code]
        if code == {"rest": 0}.get(frame, frame):
            points[7] = float(place)
        sheet.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)), code)
    if frame != "rest":
        sheet.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(mesh.points.astype(np.float32)))
    stage.Save()
    analyzer = wc.Analyzer(tmp_path / "cache.usda", measures=["stretch", "directions"], neighbourhood=neighbourhood)
    more = {"plot": tmp_path / "p.png"} if frame == "rest" else {}
    files = ReportFiles(usd=tmp_path / "out.usdc", csv=tmp_path / "t.csv", **more)
    report = write_report(analyzer, files, ReportLooks(curves=True))
    assert report.rows == 3 and report.excluded
    shown = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    curves = UsdGeom.BasisCurves(shown.GetPrimAtPath("/Sheet_principal1"))
    stretches = wc.analyze(tmp_path / "cache.usda", neighbourhood=neighbourhood)["stretch"][2, :, 0]
    ends = np.array(curves.GetPointsAttr().Get(2.0)).reshape(-1, 2, 3)
    seen = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.0
    np.testing.assert_array_equal(seen, np.isfinite(stretches))
    assert 0 < seen.sum() < len(seen) and np.isfinite(ends).all() and 0.0 < curves.GetWidthsAttr().Get()[0] < 1.0
    assert not [str(warning.message) for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


def test_a_first_frame_at_rest_is_said(folder, cloth, capsys):
    """What nobody says is at rest is so in the summary and in the files, and frames are numbers there."""
    said = "rest shape    that of the first frame"
    for command, declared in (([str(cloth)], True), ([f"{folder}/cloth_*.obj"], False)):
        assert main(["analyze", *command, "--report", str(folder / "t.json")]) == 0
        assert (said in capsys.readouterr().out) is not declared
        assert json.load(open(folder / "t.json"))["input"]["rest_declared"] is declared
        assert main(["analyze", *command, "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["rest_declared"] is declared and isinstance(facts["extremes"]["stretch_1"]["largest"]["frame"], int)
    assert main(["analyze", f"{folder}/cloth_*.obj", "--rest", str(folder / "rest.ply")]) == 0
    assert said not in capsys.readouterr().out


def test_another_programs_cache(tmp_path, capsys):
    """Quads in centimetres, z up, left-handed, below a transform that moves, at time codes of its own, with seams in st."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "cache.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(48)
    above = UsdGeom.Xform.Define(stage, "/Garment")
    turn = above.AddRotateZOp()
    mesh = UsdGeom.Mesh.Define(stage, "/Garment/Panel")
    corners = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [0, 10, 0], [10, 10, 0], [20, 10, 0]], dtype=float)
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 3, 4, 1, 1, 4, 5, 2])
    mesh.CreateOrientationAttr("leftHanded")
    mesh.CreateSubdivisionSchemeAttr("none")
    points = mesh.CreatePointsAttr([Gf.Vec3f(*map(float, point)) for point in corners])
    for k, code in enumerate((101.0, 103.0, 105.0)):
        turn.Set(20.0 * k, code)
        points.Set([Gf.Vec3f(*map(float, point * [1.0 + 0.1 * k, 1.0, 1.0])) for point in corners], code)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st.Set([Gf.Vec2f(*pair) for pair in [(0, 0), (1, 0), (1, 1), (0, 1), (5, 0), (6, 0), (6, 1), (5, 1)]])
    stage.SetDefaultPrim(above.GetPrim())
    stage.Save()
    out = tmp_path / "out.usda"
    command = ["analyze", str(tmp_path / "cache.usda"), "--directions", "st", "-o", str(out), "--json"]
    assert main([*command, "--measure", "length_ratio", "length_rate", "rate_of_strain", "--colour", "length_ratio_2"]) == 0
    # s runs along y, t along x, which is stretched by 10 % in 1/24 s, while all of it turns by 20°.
    for name, expected in (("lengthRatio1", [1, 1, 1]), ("lengthRatio2", [1, 1.1, 1.2])):
        read = FrameSequence(str(out), attribute=f"primvars:{name}")
        assert read.shape == (3, 2) and read.time_codes.tolist() == [101, 103, 105]
        np.testing.assert_allclose(np.asarray(read), np.array(expected)[:, None] * [1, 1], rtol=1e-6)
    rates = np.asarray(FrameSequence(str(out), attribute="primvars:lengthRate2"))
    assert np.isnan(rates[0]).all()
    np.testing.assert_allclose(rates[1:, 0], [2 * 0.1 / 2.1 * 24, 2 * 0.1 / 2.3 * 24], rtol=1e-5)
    layered = Usd.Stage.Open(str(out))
    assert layered.GetPrimAtPath("/Garment/Panel").GetAttribute("points").Get(103) == points.Get(103)
    assert json.loads(capsys.readouterr().out)["coloured"] == "length_ratio_2"


def test_stills_and_plots_are_pictures(cloth, tmp_path, capsys):
    command = ["analyze", str(cloth), "--measure", "stretch", "directions", "--curves", "--range", "0.9", "1.1"]
    outputs = ["--still", str(tmp_path / "still.png"), "--still-frames", "2", "6", "--plot", str(tmp_path / "plot.svg")]
    assert main([*command, *outputs]) == 0
    said = capsys.readouterr().out
    for name in ("still_2.png", "still_6.png", "plot.svg"):
        assert (tmp_path / name).stat().st_size > 10_000
        assert str(tmp_path / name) in said


def test_stills_are_seen_from_where_one_asks(cloth, tmp_path, capsys):
    """Both sides are the pictures from in front and from straight behind, one above the other."""

    def still(name, *options):
        command = ["analyze", str(cloth), "--still", str(tmp_path / f"{name}.png"), "--still-frames", "6", *options]
        assert main(command) == 0, capsys.readouterr().err
        return imread(tmp_path / f"{name}_6.png")[75:, :, :3]

    places = {"front": ("0", "60"), "back": ("180", "-60")}
    front, back = (still(name, "--azimuth", a, "--elevation", e)[:, :900] for name, (a, e) in places.items())
    both = still("both", "--azimuth", "0", "--elevation", "60", "--both-sides")[:, :900]
    height = len(both) // 2
    assert len(front) == pytest.approx(height - 45, abs=1) and not np.array_equal(front, back)
    for whole, part in ((front, both[:height]), (back, both[height:])):  # a pixel may be another, and at the foot are words
        assert np.abs(part[: height - 45] - whole[: height - 45]).mean() < 0.01
    assert not np.array_equal(still("steep", "--elevation", "80"), still("flat", "--elevation", "10"))
    shades = still("grey", "--colormap", "gray")
    assert np.ptp(shades, axis=2).max() < 0.01 < np.ptp(still("own"), axis=2).max()
    assert main(["analyze", str(cloth), "-o", str(tmp_path / "grey.usda"), "--colormap", "gray"]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "grey.usda"))
    assert stage.GetRootLayer().customLayerData["warpcloth"]["legend"]["map"] == "gray"


def test_one_file(cloth, tmp_path, capsys):
    for name, more in (("a.usdz", []), ("b.usdc", ["--single-file"])):
        assert main(["analyze", str(cloth), "-o", str(tmp_path / name), *more]) == 0
        assert len(FrameSequence(str(tmp_path / name), attribute="primvars:stretch1")) == 7
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.usdz", "b.usdc"]


def test_a_stage_without_colours(cloth, tmp_path, monkeypatch, capsys):
    """On request, or with a warning where there are no colour maps."""
    assert main(["analyze", str(cloth), "-o", str(tmp_path / "a.usdc"), "--colour", "none"]) == 0
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    table.cache_clear()
    capsys.readouterr()
    assert main(["analyze", str(cloth), "-o", str(tmp_path / "b.usdc")]) == 0
    said = capsys.readouterr()
    assert "the stage has no colours: colours and charts need matplotlib" in said.err and "colours " not in said.out
    for name in ("a", "b"):
        assert len(FrameSequence(str(tmp_path / f"{name}.usdc"), attribute="primvars:stretch1")) == 7
        stage = Usd.Stage.Open(str(tmp_path / f"{name}.usdc"))
        assert not stage.GetPrimAtPath("/World/Cloth").GetAttribute("primvars:displayColor").GetNumTimeSamples()
    assert main(["analyze", str(cloth), "-o", str(tmp_path / "b.usdc"), "--colour", "stretch_1"]) == 2
    assert "pip install -e '.[chart]' in the checkout" in capsys.readouterr().err


def test_help_on_measures(capsys):
    assert main(["analyze", "--measure", "help"]) == 0
    said = capsys.readouterr().out
    assert "deformation_gradient  3×2  1" in said and "residual" in said


WRONG = [
    ("", "INPUT is missing"),
    ("gone.usdc", "gone.usdc: there is no such file"),
    ("CLOTH --measure stretsch", "measures: 'stretsch' must be one of"),
    ("CLOTH --measure residual", "it is one of each vertex"),
    ("CLOTH --colour stretch", "colour is 'stretch'; it must be one of stretch_1, stretch_2, or none"),
    ("CLOTH --measure rotation -o out.usdc", "rotation has no number to be coloured"),
    ("CLOTH --curves -o out.usdc", "curves: need the measures stretch and directions"),
    ("CLOTH --reference 99", "there is no frame 99"),
    ("CLOTH --pairs 1:9", "pairs, 1:9; there is no frame 9"),
    ("CLOTH --pairs 1:3,2:3 -o out.usdc", "frame 3 is measured twice"),
    ("CLOTH --lag 3 --reference rest", "reference and lag: give one of them"),
    ("CLOTH --neighbourhood 9-ring", "neighbourhood = '9-ring'"),
    ("CLOTH --directions u", "--directions is 'u'"),
    ("CLOTH --directions 1,2", "directions has shape"),
    ("CLOTH --poisson 0.3", "--poisson is given without --stiffness"),
    ("CLOTH --material corotated --stiffness 1 --poisson 0.3 --measure energy_density", "--poisson: the corotated membrane"),
    ("CLOTH --stiffness -1 --measure energy_density", "stiffness"),
    ("CLOTH --still a.png --still-frames 99", "stills: frame 99 is not measured"),
    ("CLOTH --still-frames 2", "--still-frames is given without --still"),
    ("CLOTH --still a.jpg", "the ending is '.jpg'"),
    ("CLOTH --azimuth 10", "--azimuth is given without --still"),
    ("CLOTH --elevation 10 -o out.usdc", "--elevation is given without --still"),
    ("CLOTH --both-sides", "--both-sides is given without --still"),
    ("CLOTH --colormap viridis", "--colormap is given without --still and -o"),
    ("CLOTH --still a.png --colormap virdis", "colormap is 'virdis'; it must be a colour map of matplotlib, such as viridis"),
    ("CLOTH --still a.png --azimuth nan", "azimuth is nan"),
    ("CLOTH --plot a.txt", "a.txt"),
    ("CLOTH --range 2 1 -o out.usdc", "low must be below high"),
    ("CLOTH --csv gone/t.csv", "gone"),
    ("CLOTH -o CLOTH", "must not be changed"),
    *[(f"CLOTH --{option} CLOTH", "must not be changed") for option in ("csv", "report", "npz")],
    ("CLOTH --rest REST --csv REST", "rest.ply: is a file of the input, which must not be changed"),
    ("CLOTH --csv t.csv --report ./t.csv", "t.csv: is given for two outputs"),
    ("CLOTH --plot a_6.png --still a.png", "a_6.png: is given for two outputs"),
    ("CLOTH -o out.txt", "out.txt"),
    ("CLOTH --rest REST", "must be those of the frames"),
    ("CLOTH --fps 0", "fps is 0"),
    ("CLOTH --device cuda:9", "device is 'cuda:9'"),
]


@pytest.mark.parametrize(("words", "said"), WRONG, ids=[words for words, _ in WRONG])
def test_wrong_use(words, said, cloth, tmp_path, monkeypatch, capsys):
    """One line, exit code 2, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    known = {"CLOTH": str(cloth), "REST": str(tmp_path / "rest.ply")}
    trimesh.creation.box().export(tmp_path / "rest.ply")
    before = cloth.read_bytes()
    assert main(["analyze", *(known.get(word, word) for word in words.split())]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1 and said in errors[0], errors
    assert [path.name for path in tmp_path.iterdir()] == ["rest.ply"] and cloth.read_bytes() == before


def test_a_failure_on_the_way_leaves_earlier_results(cloth, tmp_path, monkeypatch, capsys):
    outputs = ["--csv", str(tmp_path / "t.csv"), "--report", str(tmp_path / "t.json"), "--npz", str(tmp_path / "t.npz")]
    assert main(["analyze", str(cloth), *outputs]) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    sequence = wc.open_sequence(cloth)
    broken = replace(sequence, read=lambda frame: sequence.read(frame) if frame < 4 else 1 / 0)
    monkeypatch.setattr("warpcloth.mesh.sequences.open_sequence", lambda *_: broken)
    assert main(["analyze", str(cloth), *outputs]) == 2
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(("frame", "kept"), [(1, True), (4, False)])
def test_an_interruption_keeps_rows_and_without_any_what_was_there(frame, kept, cloth, tmp_path, monkeypatch, capsys):
    outputs = ["--csv", str(tmp_path / "t.csv"), "--report", str(tmp_path / "t.json"), "--npz", str(tmp_path / "t.npz")]
    assert main(["analyze", str(cloth), *outputs]) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    sequence = wc.open_sequence(cloth)

    def read(place):
        if place >= frame:
            raise KeyboardInterrupt
        return sequence.read(place)

    monkeypatch.setattr("warpcloth.mesh.sequences.open_sequence", lambda *_: replace(sequence, read=read))
    capsys.readouterr()
    assert main(["analyze", str(cloth), "--reference", "previous", *outputs]) == 130
    saved = "nothing was saved" if kept else f"they are in {', '.join(outputs[1::2])}"
    rows = f"interrupted after {0 if kept else frame - 1} of 6 frames"
    assert capsys.readouterr().err == f"warpcloth: {rows}; {saved}\n"
    after = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert after.keys() == before.keys() and (after == before) is kept
    assert kept or len((tmp_path / "t.csv").read_text().splitlines()) == 1 + 2 * (frame - 1)


def test_a_stage_of_frames_that_are_not_even_in_time(tmp_path):
    """They stand at time codes that fit their times; a rest shape with a hole has none, and says what to do."""
    mesh = wc.Mesh.grid(3, 3)
    frames = np.stack([mesh.points * (1.0 + 0.1 * k) for k in range(4)])
    times = np.array([0.0, 0.1, 0.4, 0.5])
    path = str(tmp_path / "frames.npz")
    np.savez(path, points=frames, triangles=mesh.triangles, times=times)
    write_report(wc.Analyzer(path), ReportFiles(usd=tmp_path / "out.usdc"))
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    codes = np.array(stage.GetPrimAtPath("/World/Cloth").GetAttribute("primvars:stretch1").GetTimeSamples())
    np.testing.assert_allclose(codes / stage.GetTimeCodesPerSecond(), times, atol=1e-9)
    frames[0, 3] = np.nan
    np.savez(path, points=frames, triangles=mesh.triangles, times=times)
    with pytest.raises(ValueError, match="which is the rest shape, has vertex 3 without a finite position"):
        write_report(wc.Analyzer(path), ReportFiles(usd=tmp_path / "out.usdc"))


def test_a_layer_over_a_measured_stage(cloth, tmp_path):
    """A second analysis sees the animation through the first, and both sets of measures are there."""
    assert main(["analyze", str(cloth), "-o", str(tmp_path / "a.usdc")]) == 0
    assert main(["analyze", str(tmp_path / "a.usdc"), "--measure", "area_ratio", "-o", str(tmp_path / "b.usdc")]) == 0
    for name in ("stretch1", "areaRatio"):
        assert len(FrameSequence(str(tmp_path / "b.usdc"), attribute=f"primvars:{name}")) == 7


def test_an_animation_of_other_lengths_has_its_own_colours(tmp_path):
    """Rates alone in the first frame are grey; a sequence without any value has a scale all the same."""
    mesh = wc.Mesh.grid(4, 4)
    with AnimationWriter(tmp_path / "still.usdc", mesh, FPS) as writer:
        writer.append(mesh.points, np.zeros_like(mesh.points))
    report = write_report(wc.Analyzer(tmp_path / "still.usdc", measures="spin"), ReportFiles(usd=tmp_path / "out.usdc"))
    assert report.scale[0] < report.scale[1] and report.extremes["spin_norm"].largest is None
