"""Scenes of several cloths and stages: a prim for each cloth, read as one scene, and animated each with its own topology."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.stage_texts import prim
from warpcloth.usd import FrameSequence, read_mesh, read_scene

QUAD = [(0, 0, 0), (100, 0, 0), (0, 0, 100), (100, 0, 100)]


def cloth(name, counts, corners, points, density, stiffness, pins, *more):
    mesh = f"int[] faceVertexCounts = {counts}\nint[] faceVertexIndices = {corners}\npoint3f[] points = {points}"
    spring = f'token warpcloth:terms:threads:type = "Spring"\ndouble warpcloth:terms:threads:stiffness = {stiffness}'
    return prim("Mesh", name, mesh, f"double warpcloth:density = {density}\nint[] warpcloth:pins = {pins}", spring, *more)


def written(folder, more=""):
    """A stage in cm of a figure with a skirt, a belt 15 cm above it and a chair, which is no cloth."""
    facts = "double warpcloth:duration = 0.1\ndouble warpcloth:selfContact:distance = 0.002"
    raised = 'double3 xformOp:translate = (0, 5, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]'
    belt = [(0, 10, 0), (100, 10, 0), (0, 10, 100), (90, 10, 100)]
    chair = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 2, 1]\npoint3f[] points = "
    prims = [
        cloth("Skirt", [4], [0, 2, 3, 1], QUAD, 0.4, 1000, [0, 1], facts),
        cloth("Belt", [3, 3], [0, 2, 1, 1, 2, 3], belt, 0.05, 50, [2], raised, more),
        prim("Mesh", "Chair", f"{chair}[(0, -100, 0), (100, -100, 0), (0, -100, 100)]"),
    ]
    head = '#usda 1.0\n(\nmetersPerUnit = 0.01\nupAxis = "Y"\ntimeCodesPerSecond = 60\n)\n'
    path = folder / "figure.usda"
    path.write_text(head + prim("Xform", "Figure", *prims))
    return path


def joined():
    """Two cloths of other numbers of vertices, one of them pinned."""
    grid, other = wc.Mesh.grid(6, 6), wc.Mesh.grid(7, 5, pattern="alternating")
    felt = wc.Scene(grid, density=0.4, terms=[wc.Spring(stiffness=1e3)], pins="z == 0", duration=0.1)
    above = wc.Mesh(other.points + np.array([0.0, 0.1, 0.0]), other.triangles)
    silk = wc.Scene(above, density=0.05, terms=[wc.Spring(stiffness=50.0)], duration=0.1)
    return wc.Scene.join({"felt": felt, "silk": silk})


@pytest.mark.parametrize("single", [False, True])
def test_each_cloth_is_a_prim(single, tmp_path):
    """Frames of each prim are those of the run in memory, in float32, and read together they are those of the scene."""
    scene, path = joined(), tmp_path / "cloths.usdc"
    solver = wc.XPBD(substeps=4)
    expected = wc.simulate(scene, solver)
    expected = replace(expected, points=np.float32(expected.points), velocities=np.float32(expected.velocities))
    found = wc.simulate(scene, solver, output=str(path), single_file=single, record="reactions")
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.velocities[2:4], expected.velocities[2:4])
    np.testing.assert_array_equal(found.cloth("silk"), expected.points[:, 36:])
    for name in scene.cloths:
        np.testing.assert_array_equal(FrameSequence(path, name), expected.cloth(name))
        assert read_mesh(path, name).triangles.tolist() == scene.mesh.part(name).triangles.tolist()
    with pytest.raises(ValueError, match="has several meshes, name one of them as prim: /World/felt, /World/silk"):
        FrameSequence(path)
    sequence = wc.open_sequence(path)
    assert list(sequence.mesh.parts) == ["felt", "silk"]
    np.testing.assert_array_equal(sequence[3], expected.points[3])


def test_pictures_and_checks(tmp_path):
    path = tmp_path / "cloths.usdc"
    scene = joined()
    through = scene.positions.copy()
    through[36:, 1] -= np.linspace(0.0, 0.2, 35)
    grid = wc.Scene(
        scene.mesh, density=0.1, terms=[wc.Spring(stiffness=10.0)], positions=through, cloths=scene.cloths, duration=0.1
    )
    wc.simulate(grid, wc.XPBD(substeps=1), frames=1, output=str(path))
    found = wc.intersections(path)
    assert found.cloths.names == ("/World/felt", "/World/silk") and len(found.frames[0].pairs)
    wc.render(path, tmp_path / "cloths.png", size=(64, 64))
    assert (tmp_path / "cloths.png").exists()


def test_a_stage_of_several_cloths(tmp_path):
    """Each prim keeps its name, space, units and topology; the other mesh is left alone."""
    path = written(tmp_path)
    scene = read_scene(path)
    assert scene.cloths == ("Skirt", "Belt") and scene.frames == 6 and scene.name == "figure"
    assert scene.self_contact.distance == 0.002 and scene.pins.vertices.tolist() == [0, 1, 6]
    np.testing.assert_allclose(scene.vertex_masses.sum(), 0.4 + 0.05 * 0.95)
    np.testing.assert_allclose(scene.mesh.points[4], [0.0, 0.15, 0.0], atol=1e-12)
    assert "cloth Belt: 4 vertices" in str(scene)
    output = tmp_path / "animated.usdc"
    found = wc.simulate(scene, wc.XPBD(substeps=4), output=str(output))
    expected = wc.simulate(scene, wc.XPBD(substeps=4))
    np.testing.assert_allclose(found.points, expected.points, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(FrameSequence(output, "/Figure/Belt"), expected.cloth("Belt"), rtol=0.0, atol=1e-6)
    one = read_scene(path, "Skirt")
    assert one.cloths == () and one.name == "Skirt" and len(one.mesh.points) == 4
    with pytest.raises(ValueError, match=r"cloths have duration 0\.1 and 0\.2, must have the same"):
        read_scene(written(tmp_path, "double warpcloth:duration = 0.2"))
