"""Meshes that other programs cut along the seams of their textures: files are welded, others are reported."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import warpcloth as wc
from support.mesh_texts import TEXTS
from warpcloth.cli import main
from warpcloth.mesh.mesh import Surface
from warpcloth.mesh.seams import coincident, piece_count, seam_pairs
from warpcloth.scenes import knot

GRID = wc.Mesh.grid(5, 4)


def cut(mesh, labels):
    """Points, triangles and vertices of a mesh that is cut where labels (T,) of triangles differ, as by charts of a texture."""
    keys, which = np.unique(np.stack([np.repeat(labels, 3), mesh.triangles.ravel()], axis=1), axis=0, return_inverse=True)
    return mesh.points[keys[:, 1]], which.reshape(-1, 3), keys[:, 1]


def load(tmp_path, ending, points, triangles):
    (tmp_path / f"a.{ending}").write_text(TEXTS[ending](points, triangles.tolist()))
    return wc.Mesh.load(tmp_path / f"a.{ending}")


@settings(deadline=None, derandomize=True, database=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from(["obj", "ply", "off"]))
def test_meshes_that_were_cut_at_random_are_whole_again(tmp_path_factory, seed, charts, ending):
    random = np.random.default_rng(seed)
    order = random.permutation(len(GRID.triangles))
    grid = wc.Mesh(GRID.points, GRID.triangles[order])
    points, triangles, _ = cut(grid, random.integers(charts, size=len(order)))
    mesh = load(tmp_path_factory.mktemp("cut"), ending, points, triangles)
    np.testing.assert_array_equal(mesh.points[mesh.triangles], grid.points[grid.triangles])
    # Where no triangles that share a side meet, charts stay apart at a corner.
    assert (
        piece_count(mesh) == 1 and len(mesh.edges) == len(grid.edges) and len(mesh.boundary_edges) == len(grid.boundary_edges)
    )


@pytest.mark.parametrize("ending", ["obj", "ply", "off"])
def test_vertices_that_touch_elsewhere_stay_apart(tmp_path, ending):
    """Two sheets that meet at a corner, and two layers that meet at an inner vertex."""
    corner = np.concatenate([GRID.points, GRID.points + np.array([1.0, 0.0, 1.0])])
    mesh = load(tmp_path, ending, corner, np.concatenate([GRID.triangles, GRID.triangles + len(GRID.points)]))
    assert len(mesh.points) == 2 * len(GRID.points) == coincident(mesh.points) + len(np.unique(mesh.points, axis=0))
    layers = np.concatenate([GRID.points, GRID.points + np.array([0.0, 0.1, 0.0])])
    layers[[6, 6 + len(GRID.points)], 1] = 0.05
    mesh = load(tmp_path, ending, layers, np.concatenate([GRID.triangles, GRID.triangles + len(GRID.points)]))
    assert len(mesh.points) == 2 * len(GRID.points) and coincident(mesh.points) == 1


BACK = GRID.triangles[:, ::-1]
RIGHT = GRID.points[GRID.triangles].mean(axis=1)[:, 0] > 0.5
LAYERS = {  # two layers that coincide, with the height of the second, and how many vertices are left
    "wound alike": (GRID.triangles, 0.0, 40),
    "wound otherwise": (BACK, 0.0, 40),
    "cut along other diagonals": (wc.Mesh.grid(5, 4, pattern="alternating").triangles, 0.0, 40),
    "two layers that are joined nowhere": (GRID.triangles, 0.1, 40),
    "a pillow": (BACK, 0.1, 28),  # two triangles at corners lie upon others
}


@pytest.mark.parametrize("ending", ["obj", "ply", "off"])
@pytest.mark.parametrize(("triangles", "height", "left"), LAYERS.values(), ids=LAYERS)
def test_layers_stay_apart(tmp_path, ending, triangles, height, left):
    second = GRID.points.copy()
    second[np.setdiff1d(np.arange(20), GRID.boundary_edges), 1] += height
    both = np.concatenate([GRID.triangles, triangles + 20])
    assert len(load(tmp_path, ending, np.concatenate([GRID.points, second]), both).points) == left


def test_seams_of_charts_that_are_wound_otherwise_and_of_two_layers(tmp_path):
    points, triangles, _ = cut(GRID, RIGHT.astype(int))
    mixed = np.where(RIGHT[:, None], triangles[:, ::-1], triangles)
    assert len(load(tmp_path, "obj", points, mixed).points) == 20
    twice = np.concatenate([triangles, triangles + len(points)])  # nobody knows which pieces belong together
    assert len(load(tmp_path, "obj", np.tile(points, (2, 1)), twice).points) == 48


def test_scenes_of_strips_that_start_in_one_place_do_not_warn():
    mesh = knot.scene().mesh
    assert coincident(mesh.points) == len(mesh.points) // 2 and not len(seam_pairs(mesh.points, mesh.triangles))


def test_rest_meshes_of_caches_keep_their_vertices(tmp_path):
    points, triangles, _ = cut(GRID, np.arange(len(GRID.triangles)) % 2)
    (tmp_path / "a.obj").write_text(TEXTS["obj"](points, triangles.tolist()))
    np.savez(tmp_path / "a.npz", points=np.stack([points, points + 1.0]), triangles=triangles)
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.pc2"), "--fps", "24"]) == 0
    assert len(wc.open_sequence(tmp_path / "b.pc2").mesh.points) == len(Surface.load(tmp_path / "a.obj").points) == len(points)


@pytest.mark.parametrize("at", ["vertices", "corners"])
def test_seams_keep_texture_coordinates_of_corners(tmp_path, at):
    """The charts of a .ply file lie apart in the texture, so that vertices of the seam have two pairs."""
    labels = (GRID.points[GRID.triangles].mean(axis=1)[:, 0] > 0.5).astype(int)
    points, triangles, _ = cut(GRID, labels)
    right = np.zeros(len(points))
    right[triangles[labels == 1]] = 5.0
    texture = points[:, [0, 2]] + right[:, None]
    text = TEXTS["ply"](points, triangles.tolist())
    rows = text.splitlines()
    if at == "vertices":
        rows.insert(rows.index("property double z") + 1, "property float u\nproperty float v")
        first = rows.index("end_header") + 1
        for row, (s, t) in enumerate(texture.tolist(), start=first):
            rows[row] += f" {s!r} {t!r}"
    else:
        rows.insert(rows.index("property list uchar int vertex_indices") + 1, "property list uchar double texcoord")
        for row, corners in enumerate(triangles, start=len(rows) - len(triangles)):
            rows[row] += " 6 " + " ".join(map(repr, texture[corners].ravel().tolist()))
    (tmp_path / "a.ply").write_text("\n".join(rows) + "\n")
    mesh = wc.Mesh.load(tmp_path / "a.ply")
    assert len(mesh.points) == len(GRID.points)
    np.testing.assert_allclose(mesh.texture_coordinates, texture[triangles], atol=1e-6)
    warp = wc.OrthotropicMembrane(stiffness=1.0, poisson_ratio=0.0).warp_directions(mesh)
    np.testing.assert_allclose(warp, np.tile([1.0, 0.0, 0.0], (len(triangles), 1)), atol=1e-6)


def test_coordinates_of_corners_come_back(tmp_path):
    """From parts, stages and .obj files."""
    seams = np.random.default_rng(0).uniform(size=(len(GRID.triangles), 3, 2))
    mesh = wc.Mesh(GRID.points, GRID.triangles, texture_coordinates=seams)
    joined = wc.Mesh.join({"a": mesh, "b": GRID})
    np.testing.assert_array_equal(joined.part("a").texture_coordinates, seams)
    np.testing.assert_array_equal(joined.part("b").corner_coordinates, GRID.corner_coordinates)
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=100.0)], duration=0.05)
    wc.simulate(scene, wc.Newton(substeps=1), frames=2, output=str(tmp_path / "a.usda"))
    np.testing.assert_allclose(wc.Mesh.load(tmp_path / "a.usda").texture_coordinates, seams, atol=1e-6)
    assert main(["convert", str(tmp_path / "a.usda"), str(tmp_path / "b.obj")]) == 0
    np.testing.assert_allclose(wc.Mesh.load(tmp_path / "b_0000.obj").texture_coordinates, seams, atol=1e-6)
    for shape in ((2, 3, 2), (len(GRID.triangles), 3, 3), (4, 2)):
        with pytest.raises(ValueError, match="texture_coordinates: "):
            wc.Mesh(GRID.points, GRID.triangles, texture_coordinates=np.zeros(shape))


def test_stages_that_are_cut_are_reported(tmp_path, capfd):
    points, triangles, _ = cut(GRID, (GRID.points[GRID.triangles].mean(axis=1)[:, 0] > 0.5).astype(int))
    terms = 'double warpcloth:density = 0.1\ntoken warpcloth:terms:a:type = "Spring"\ndouble warpcloth:terms:a:stiffness = 9\n'
    path = str(tmp_path / "a.usda")
    for joined in (False, True):
        pairs = [*wc.Mesh(points, triangles).edges.tolist(), *seam_pairs(points, triangles).tolist()]
        springs = f"int2[] warpcloth:terms:a:pairs = {[*map(tuple, pairs)]}\n" if joined else ""
        (tmp_path / "a.usda").write_text(TEXTS["usda"](points, triangles.tolist(), terms + springs))
        assert main(["info", path, "--json"]) == 0
        found = json.loads(capfd.readouterr().out)["scene"]
        assert (found["coincident"], found["pieces"]) == (4, 2)
        assert main(["run", path, "-o", str(tmp_path / "b.usdc"), "--frames", "1"]) == 0
        warned = (
            "4 vertices lie upon others along seams and nothing joins them, so the cloth is cut there" in capfd.readouterr().err
        )
        assert warned == (not joined)
    move = ["--fix", "x == 0", "--move", "x == 1", "--translate", "0", "0.1", "0"]
    assert main(["deform", path, *move, "--frames", "1", "-o", str(tmp_path / "c.usdc")]) in (0, 1)
    assert "4 vertices lie upon others along seams" in capfd.readouterr().err
