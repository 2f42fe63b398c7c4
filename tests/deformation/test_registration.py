"""Captures of known motions, resampled to one topology: the error of positions, what holes hide, and what is refused."""

import json

import numpy as np
import pytest

import warpcloth as wc
from support.continuum import corner_normals
from support.mesh_texts import obj
from warpcloth.cli import main
from warpcloth.lab.scans import scan, write_capture
from warpcloth.mesh.mesh import Surface

TEMPLATE = wc.Mesh.grid(9, 9, pattern="alternating")
SPACING = 1 / 12


def bent(frames=4):
    """The sheet, bent about z to cylinders of growing curvature, which is isometric, and moved, (frames, n, 3)."""
    found = []
    for k in range(frames):
        angle, radius = 0.4 * (k + 1) * (TEMPLATE.points[:, 0] - 0.5), 1.0 / (0.4 * (k + 1))
        y = radius * (1.0 - np.cos(angle))
        found.append(np.stack([0.5 + radius * np.sin(angle) + 0.03 * k, y, TEMPLATE.points[:, 2]], axis=1))
    return np.array(found)


def errors(found, true):
    """RMS error along the normal and along the surface [m]."""
    apart, normal = found - true, np.array([corner_normals(TEMPLATE, x) for x in true])
    along = np.einsum("fki,fki->fk", apart, normal)
    return np.sqrt(np.mean(along**2)), np.sqrt(np.mean(np.sum(apart**2, axis=2) - along**2))


@pytest.mark.parametrize(("noise", "pinned"), [(0.0, False), (1e-3, True), (1e-3, False)])
def test_it_follows_the_vertices_of_a_known_motion(noise, pinned):
    """Along the normal within the sagitta of an edge, h²κ/8 = 3 mm, and the noise; along the surface within 1/40 of an edge."""
    # It does so without pins, because the outline is seen.
    true = bent()
    seen = scan(TEMPLATE, true, 1 / 24, SPACING, noise, 0.1, 0.1)
    edge = np.flatnonzero(TEMPLATE.points[:, 0] == 0.0)
    pins = wc.Pins(edge, true[:, edge]) if pinned else None
    found = wc.resample(seen, TEMPLATE, true[0], pins)
    normal, tangential = errors(found.points, true)
    assert normal < 1.5e-3 + noise and tangential < 1.5e-3 + 2.0 * noise
    assert (found.converged.all() or noise) and (found.used > 0.95).all() and np.allclose(found.times, np.arange(4) / 24)
    assert found.rms.max() < 1.5e-3 + np.sqrt(3.0) * noise
    if pinned:
        assert np.array_equal(found.points[:, edge], true[:, edge])
    # The result has one topology, and can be measured: the motion is isometric.
    stretch = wc.analyze(found.points, TEMPLATE, measures=("stretch",))["stretch"]
    assert np.sqrt(np.mean((stretch - 1.0) ** 2)) < 0.01 + 10.0 * noise


@pytest.mark.parametrize(("frames", "whole"), [(1, True), (4, True), (4, False)])
def test_folds_are_not_cut(frames, whole):
    """A pleated strip, whose edges have their full length and turn at each crease, seen at its own vertices."""
    # It starts with the angle of 1 rad at creases. Or it starts flat and reaches that in 4 equal steps of δ, of which the first
    # two may lack three columns. At its true positions distances and strain are 0, so that the energy is that of cells, 0.12
    # Σ_c Σ w ‖e − ê‖². Of its edges ê, 0.9 are those of the last frame, off by 2 sin(δ/4) h for each of the two edges of a cell
    # along the strip, of length h, and 0.1 are those at rest with the rotation of the middle, off by 2 sin(¼) h. With w = d/h
    # inside and half of it on the border, of d the distance of rows, all vertices add less than 0.12 · 2 (0.9 · 2 sin(δ/4) +
    # 0.1 · 2 sin(¼))² · area. The minimum lies below, of the energy of triangles, 2 Σ area Σ (σ − 1)², and the mean squared
    # distance over α.
    count, alpha = 12, 1e-3
    mesh = wc.Mesh.grid(count + 1, 5, size=(1.0, 0.4))
    column = np.rint(count * mesh.points[:, 0]).astype(int)

    def pleated(angle):
        angles = angle * np.cumsum(np.tile([1.0, 1.0, -1.0, -1.0], count // 4))
        steps = np.stack([np.cos(angles), np.sin(angles)], axis=1) / count
        path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        return np.column_stack([path[column], mesh.points[:, 2]])

    true = [pleated((k + 1) / frames) for k in range(frames)]
    start, step = (true[0], 0.0) if frames == 1 else (mesh.points, 1.0 / frames)
    beside = np.abs(column[mesh.triangles].mean(axis=1) - 5.5) > 1.5
    kept = [mesh.triangles[beside | whole | (k > 1)] for k in range(frames)]
    seen = wc.as_capture([Surface(x, each) for x, each in zip(true, kept, strict=True)], dt=1.0)
    found = wc.resample(seen, mesh, start, stiffness=alpha, iterations=30)
    bending = 0.12 * 2.0 * (0.9 * 2.0 * np.sin(step / 4.0) + 0.1 * 2.0 * np.sin(0.25)) ** 2 * 0.4
    stretch = wc.analyze(found.points[-1:], mesh, measures="stretch")["stretch"]
    strain = 2.0 * 0.4 * np.mean(np.sum((stretch - 1.0) ** 2, axis=-1))
    assert strain + found.rms[-1] ** 2 / alpha < bending


def test_what_holes_hide_is_not_observed():
    """Vertices over a hole in the middle follow their neighbours, and are said not to be observed."""
    true, middle = bent(1), (np.abs(TEMPLATE.points - 0.5)[:, [0, 2]] < 0.2).all(axis=1)
    kept = ~middle[TEMPLATE.triangles].any(axis=1)
    seen = wc.as_capture([Surface(true[0], TEMPLATE.triangles[kept])], dt=1.0)
    found, inside = wc.resample(seen, TEMPLATE), np.setdiff1d(np.arange(len(true[0])), TEMPLATE.boundary)
    assert found.distances[0][middle].min() < 0.13  # points within 0.141 m count
    assert not found.observed[0][middle].any() and found.observed[0][inside].mean() > 0.5
    assert np.abs(found.points[0] - true[0])[middle].max() < 5e-3


def test_flat_cloth_without_its_outline_slides():
    """A flat sheet that moves in its plane, of which a window shows the middle alone: nothing of the motion is seen."""
    window = wc.Mesh.grid(7, 7, size=0.6)
    frames = [wc.Mesh(window.points + np.array([0.2, 0.0, 0.2]), window.triangles) for _ in range(3)]
    found = wc.resample(wc.as_capture(frames, dt=1.0), TEMPLATE)
    assert np.abs(found.points - TEMPLATE.points).max() < 1e-5  # nearest points are float32, and 60 iterations add roundings
    # The outline shows most of it, of 0.08 m; more iterations show more.
    moved = [wc.Mesh(TEMPLATE.points + k * np.array([0.04, 0.0, 0.02]), TEMPLATE.triangles) for k in range(3)]
    found = wc.resample(wc.as_capture(moved, dt=1.0), TEMPLATE)
    assert np.abs(found.points - np.array([each.points for each in moved])).max() < 0.01


def test_missing_frames_are_interpolated_and_files_are_written(tmp_path, capsys):
    true = bent()
    write_capture(scan(TEMPLATE, true, 1 / 24, SPACING), tmp_path / "seen", scale=1e-3)
    (tmp_path / "seen" / "seen_0002.ply").unlink()
    (tmp_path / "first.obj").write_text(obj(true[0], TEMPLATE.triangles))
    words = ["resample", str(tmp_path / "seen"), "--onto", str(tmp_path / "first.obj"), "-o", str(tmp_path / "x.usdc")]
    assert main([*words, "--fps", "24", "--scale", "0.001", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == 4 and facts["missing"] == [2] and facts["not_converged"] == 0 and facts["rms"] < 1.5e-3
    sequence = wc.open_sequence(tmp_path / "x.usdc")
    assert np.allclose(sequence.times, np.arange(4) / 24)
    assert np.allclose(sequence[2], 0.5 * (sequence[1] + sequence[3]), atol=1e-6)
    distances = np.asarray(wc.usd.FrameSequence(tmp_path / "x.usdc", attribute="primvars:captureDistance"))
    assert (distances[2] == -1.0).all() and 0.0 <= distances[[0, 1, 3]].min() and distances.max() < 0.02
    for wrong, sentence in (  # wrong outputs with nothing to read: they are refused before the capture
        (["resample", "none", "--onto", "none.obj", "-o", str(tmp_path / "x.obj")], "x.obj; it must end with one of .usd"),
        (["resample", "none", "--onto", "none.obj", "-o", str(tmp_path / "no" / "x.usdc")], "no does not exist"),
        (words, "seen: has no times; open it with open_capture(path, fps=…), or give --fps on the command line"),
        ([*words, "--fps", "24"], "seen: frame 0 has no point within 0.141 m of the template"),
        ([*words, "--fps", "24", "-p", "n=3"], "-p is given, and"),
        ([*words[:3], str(tmp_path), *words[4:], "--fps", "24"], "is a folder; --onto must be a mesh file, a stage or a scene"),
        ([*words[:3], str(tmp_path / "x.usdc"), *words[4:], "--fps", "24"], "x.usdc: is a file of the input, which must not"),
        ([*words, "--fps", "24", "--hold", "x < -9"], "--hold"),
    ):
        assert main(wrong) == 2 and sentence in capsys.readouterr().err, wrong


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"capture": 3}, "capture is 3; it must be a Capture, such as open_capture"),
        ({"template": wc.Mesh.chain(3)}, "template is Mesh.*; it must be a Mesh with triangles"),
        ({"capture": wc.as_capture([TEMPLATE])}, "capture: has no times"),
        ({"stiffness": 0.0}, "stiffness is 0.0; it must be a number above 0"),
        ({"iterations": 0}, "iterations is 0; it must be a whole number of 1 or more"),
        ({"positions": TEMPLATE.points[1:]}, r"positions has shape \(80, 3\)"),
        ({"pins": wc.Pins([0], axes="x")}, "pins.axes leaves some axes of a pin free"),
        ({"capture": wc.as_capture([Surface(0.0 * TEMPLATE.points, TEMPLATE.triangles)], dt=1.0)}, "has no area"),
    ],
    ids=range(8),
)
def test_wrong_use_is_refused(change, message):
    given = {"capture": wc.as_capture([TEMPLATE], dt=1.0), "template": TEMPLATE} | change
    with pytest.raises(ValueError, match=message):
        wc.resample(**given)


def test_a_wrong_unit_is_said():
    """If a capture is too large, few of its points are near the template; if it is too small, it faces one spot of it."""
    large, small = (wc.as_capture([wc.Mesh(scale * TEMPLATE.points, TEMPLATE.triangles)], dt=1.0) for scale in (1e3, 1e-3))
    with pytest.warns(UserWarning, match=r"^capture: 0.\d+ % of its area is within 0.141 m of the template"):
        wc.resample(large, TEMPLATE, iterations=1)
    with pytest.warns(UserWarning, match="the unit of the capture"):
        wc.resample(small, TEMPLATE, iterations=1)
