"""Scenes of mesh files: lengths, fabric and pins are given beside the file, and a file in another unit is noticed."""

import re

import numpy as np
import pytest
import trimesh

import warpcloth as wc
from support.command_line import run
from support.mesh_texts import TEXTS
from warpcloth.run.scene_files import find_source
from warpcloth.usd import read_scene

GRID = wc.Mesh.grid(5, 5)


def obj(points=GRID.points):
    return TEXTS["obj"](points, GRID.triangles.tolist())


def stage(points=GRID.points, st=None, indices=None, warp=None):
    """The text of a stage with a mesh alone, as a modeller writes it."""
    lines = [] if warp is None else [f"double3 warpcloth:warp = {warp}"]
    if st is not None:
        kind = "vertex" if indices is None else "faceVarying"
        lines.append(f'texCoord2f[] primvars:st = {[tuple(pair) for pair in st]} (interpolation = "{kind}")')
    if indices is not None:
        lines.append(f"int[] primvars:st:indices = {indices}")
    return TEXTS["usda"](points, GRID.triangles.tolist(), "\n".join(lines))


@pytest.fixture
def sheet(tmp_path):
    path = tmp_path / "sheet.obj"
    path.write_text(obj())
    return path


@pytest.mark.filterwarnings("ignore:the mesh has no texture")
def test_a_mesh_file_is_a_scene_of_a_fabric(sheet):
    source = find_source(sheet, "boundary")
    scene = source.scene(source.values({"scale": "0.5", "fabric": "denim", "up_axis": "Z", "duration": "0.5", "warp": "0,0,1"}))
    assert np.array_equal(scene.mesh.points, 0.5 * GRID.points) and np.array_equal(scene.mesh.triangles, GRID.triangles)
    assert scene.vertex_masses.sum() == pytest.approx(0.25 * 0.4) and scene.gravity.tolist() == [0.0, 0.0, -9.81]
    assert (len(scene.pins.vertices), scene.frames, scene.name) == (16, 30, "sheet")
    assert scene.terms[0].warp.tolist() == [0.0, 0.0, 1.0]


def test_options_of_the_command_line_are_those_of_the_mesh(sheet, tmp_path, capfd):
    given = ("--scale", "0.5", "--pins", "boundary", "--fabric", "silk", "--frames", "2")
    code, out, err = run(capfd, "run", sheet, *given, "-o", tmp_path / "o.usda")
    assert code == 0 and "sheet: converged" in out
    assert err.count("warning") == 1 and "the warp of the fabric is along x" in err
    code, out, _ = run(capfd, "bench", sheet, *given[:-2], "--frames", "1", "--json")
    assert code == 0 and '"fabric": "silk"' in out
    code, _, err = run(capfd, "bench", sheet, "--sizes", "3")
    assert code == 2 and "sheet.obj has no resolution to vary; none of its parameters is n or links or elements" in err


@pytest.mark.parametrize(
    ("scale", "hint"),
    [
        (1.0, None),
        (20.0, "the cloth is 20 m long and has 41.44 kg; if the file is in centimetres, --scale 0.01 makes it 0.2 m"),
        (150.0, "if the file is in centimetres, --scale 0.01 makes it 1.5 m"),
        (1500.0, "if the file is in millimetres, --scale 0.001 makes it 1.5 m"),
        (30000.0, "the cloth is 3e+04 m long and has 9.324e+07 kg"),
    ],
)
@pytest.mark.filterwarnings("ignore:the mesh has no texture")
@pytest.mark.parametrize("kind", ["mesh", "stage"])
def test_a_cloth_that_is_too_large_is_said_with_the_likely_unit(tmp_path, kind, scale, hint, recwarn):
    path = tmp_path / ("sheet.obj" if kind == "mesh" else "sheet.usda")
    path.write_text(obj(scale * GRID.points) if kind == "mesh" else stage(scale * GRID.points))
    source = find_source(path)
    source.scene(source.values({"fabric": "cotton"}))
    said = [str(warning.message) for warning in recwarn if " m long and has " in str(warning.message)]
    hint = hint if hint is None or kind == "mesh" else hint.replace("--scale", "metersPerUnit =")
    assert len(said) == (hint is not None) and all(text.startswith(str(path)) and text.endswith(hint) for text in said)


@pytest.mark.parametrize(
    ("ending", "given", "axis"),
    [
        ("obj", "Z", "Z"),
        ("glb", "Y", "Y"),
        ("glb", None, None),
        ("glb", "Z", "up_axis is 'Z', but in the file it is 'Y'"),
        ("usda", "Y", "Y"),
        ("usda", "Z", "up_axis is 'Z', but in the file it is 'Y'"),
    ],
)
def test_an_up_axis_is_given_where_the_file_has_none(tmp_path, ending, given, axis):
    path = tmp_path / f"sheet.{ending}"
    if ending == "glb":
        trimesh.Trimesh(GRID.points, GRID.triangles).export(path)
    else:
        path.write_text(obj() if ending == "obj" else stage())
    if axis in (None, "Y", "Z"):
        assert wc.Mesh.load(path, up_axis=given).up_axis == axis
    else:
        with pytest.raises(ValueError, match=axis):
            wc.Mesh.load(path, up_axis=given)


UV = {"st": GRID.points[:, [2, 0]].tolist()}
CORNERS = {"st": [*UV["st"], (0, 0)], "indices": GRID.triangles.ravel().tolist()}


@pytest.mark.parametrize(
    ("turned", "given", "warp", "says"),
    [  # axes that take the place of x, y and z, texture coordinates or an attribute of the stage, warp, end of the warning
        ((0, 1, 2), {}, (1, 0, 0), "is along x of the rest shape"),
        ((1, 0, 2), {}, (0, 1, 0), "is along y of the rest shape"),
        ((0, 1, 2), {"warp": (1, 0, 1)}, (0.5**0.5, 0, 0.5**0.5), None),
        ((0, 1, 2), UV, (0, 0, 1), None),
        ((0, 1, 2), CORNERS, (0, 0, 1), None),
        ((0, 1, 2), {"st": np.zeros((25, 2)).tolist()}, (1, 0, 0), "is along x of the rest shape"),
    ],
    ids=["none", "faces x", "attribute", "vertices", "corners", "no area"],
)
def test_the_warp_of_a_fabric_on_a_stage(tmp_path, turned, given, warp, says, recwarn):
    path = tmp_path / "sheet.usda"
    path.write_text(stage(GRID.points[:, turned], **given))
    scene = read_scene(path, fabric="denim")
    for term in scene.terms:
        assert np.allclose(term.warp_directions(scene.mesh), warp)
    said = [str(warning.message) for warning in recwarn]
    assert len(said) == (says is not None) and all(says in text and "Membrane" not in text for text in said)


@pytest.mark.parametrize(
    ("ending", "warp", "says"),
    [
        ("obj", "0,1,0", "warp (warpcloth:warp) has no direction in triangle 0; it must have a part in its plane"),
        ("obj", "0,1", "warp has shape (2,); it must be (3,)"),
        ("obj", "s", "warp is 's'; it must be three numbers, such as 0,0,1"),
        ("obj", "0,0,nan", "warp[2] is nan; it must be finite"),
        ("usda", (0, 1, 0), "prim /Sheet: warp (warpcloth:warp) has no direction in triangle 0"),
    ],
)
def test_a_warp_that_is_none_is_refused_by_the_name_that_was_written(tmp_path, ending, warp, says):
    path = tmp_path / f"sheet.{ending}"
    path.write_text(obj() if ending == "obj" else stage(warp=warp))
    source = find_source(path)
    with pytest.raises(ValueError, match=re.escape(says)):
        source.scene(source.values({"fabric": "denim"} | ({"warp": warp} if ending == "obj" else {})))


def test_a_mesh_that_faces_x_in_part_has_a_warp_everywhere():
    """As half a tube about z, whose triangles at one side face x."""
    angle, z = np.pi * GRID.points[:, 0], GRID.points[:, 2]
    tube = wc.Mesh(np.stack([np.sin(angle), np.cos(angle), z], axis=1), GRID.triangles)
    with pytest.warns(UserWarning, match="along x, or along y where triangles face x"):
        points = np.concatenate([tube.points, GRID.points[:, [1, 0, 2]] + 5.0])
        scene = wc.Scene(wc.Mesh(points, np.concatenate([GRID.triangles, GRID.triangles + 25])), fabric="denim")
    assert np.isfinite(scene.terms[0].warp_directions(scene.mesh)).all()
    with pytest.raises(ValueError, match="warp is given without fabric"):
        wc.Scene(GRID, density=0.1, terms=[wc.Spring(stiffness=1.0)], warp=(1, 0, 0))
