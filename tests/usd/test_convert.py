"""Animations in other formats: what is read back has the bits, the order, the triangles, the times and the names."""

import os
import re
import shutil
import signal
import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from pxr import Usd

import warpcloth as wc
from support.mesh_texts import obj
from support.stages import full_from
from warpcloth.base import outputs
from warpcloth.cli import main
from warpcloth.mesh.mesh import Surface
from warpcloth.mesh.sequences import open_sequence
from warpcloth.usd.conversion import convert
from warpcloth.usd.frames import FrameSequence
from warpcloth.usd.stage import find_prim
from warpcloth.usd.writer import AnimationWriter

pytestmark = pytest.mark.host
COUNT, FPS = 5, 24


def moved(mesh, frame):
    """Points (n, 3) whose coordinates have all bits of float32."""
    return (mesh.points + 0.1 * np.sin(mesh.points[:, ::-1] * 7.0 + frame)).astype(np.float32)


@pytest.fixture
def stage(tmp_path):
    """A stage of a sheet whose velocities are no differences of its points."""
    mesh = wc.Mesh.grid(4, 3)
    with AnimationWriter(tmp_path / "sheet.usdc", mesh, FPS, prim="Sheet") as writer:
        for frame in range(COUNT):
            writer.append(moved(mesh, frame), np.full((12, 3), float(frame)))
    return tmp_path / "sheet.usdc"


def check(sequence, original, times=True):
    assert np.array_equal(sequence.mesh.triangles, original.mesh.triangles) and len(sequence) == len(original)
    for a, b in zip(sequence, original, strict=True):
        assert np.array_equal(a.astype(np.float32), b.astype(np.float32))
    assert np.array_equal(sequence.labels, original.labels)
    assert not times or sequence.times == pytest.approx(original.times, rel=1e-6)


@pytest.mark.parametrize("name", ["a.pc2", "a.mdd", "a.npz", "a.usda", "a.obj", "a.ply"])
def test_what_is_read_back_is_the_same(name, stage, tmp_path):
    """To the bits of float32, also of what is converted twice; caches fit the mesh beside them, of the first frame."""
    original = open_sequence(stage)
    (tmp_path / "out").mkdir()
    _, paths = convert(stage, tmp_path / "out" / name)
    source = tmp_path / "out" if name[2:] in ("obj", "ply") else paths[0]
    check(open_sequence(source, fps=FPS if name[2:] in ("obj", "ply", "pc2") else None), original)
    if name[2:] in ("pc2", "mdd"):
        beside = Surface.load(tmp_path / "out" / "a.obj")
        assert np.array_equal(beside.points.astype(np.float32), original[0].astype(np.float32))
        check(open_sequence(paths[0], fps=FPS, mesh=wc.Mesh.grid(4, 3)), original)
    convert(source, tmp_path / "again.npz", fps=FPS)
    check(open_sequence(tmp_path / "again.npz"), original)
    with np.load(tmp_path / "again.npz") as arrays:
        assert arrays["points"].dtype == (np.float64 if name[2:] in ("obj", "ply") else np.float32)


@pytest.mark.parametrize("name", ["a.pc2", "a.mdd", "a.npz", "a.usda", "a.usdc", "a.usdz", "a.obj", "a.ply"])
@pytest.mark.parametrize("older", [True, False])
def test_an_error_or_interrupt_leaves_older_files_whole(name, older, stage, tmp_path):
    """Nothing is left of new files either, in the middle or after the last frame. What replaces a file has its permissions."""
    out, frames = tmp_path / "out", 12
    out.mkdir()
    original = open_sequence(stage)
    if older:
        convert(stage, out / name)
    before = contents(out)
    for path in before:
        path.chmod(0o600)
    points = np.array([original[0] + 0.1 * frame for frame in range(frames)], dtype=np.float32)
    np.savez(tmp_path / "other.npz", points=points, triangles=original.mesh.triangles, times=np.arange(frames) / FPS)

    def full(done, total):
        if done == frames:
            raise OSError("No space left on device")

    def interrupted(done, total):
        if done == 11:
            signal.raise_signal(signal.SIGINT)

    for stop, kind in ((full, OSError), (interrupted, KeyboardInterrupt)):
        with pytest.raises(kind):
            convert(tmp_path / "other.npz", out / name, progress=stop)
        assert contents(out) == before and (older or not list(out.iterdir()))
    convert(tmp_path / "other.npz", out / name)
    source = out if name[2:] in ("obj", "ply") else out / name
    assert len(open_sequence(source, fps=FPS)) == frames
    private = contents(out) if older and ".usd" in name else before  # a stage has its frames in new files
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in private)


def test_obj_files_of_which_one_cannot_be_opened_or_renamed(stage, tmp_path, monkeypatch):
    """An interrupt while the first is opened leaves nothing; those that are renamed stay if the next cannot be."""
    (tmp_path / "out").mkdir()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(outputs, "keep_mode", lambda *paths: signal.raise_signal(signal.SIGINT))
        convert(stage, tmp_path / "out" / "a.obj")
    assert not list((tmp_path / "out").iterdir())
    full_from(2, monkeypatch)
    with pytest.raises(OSError, match="no space left"):
        convert(stage, tmp_path / "out" / "a.obj")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a_0000.obj", "a_0001.obj"]


@pytest.mark.parametrize("older", [True, False])
@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_a_stage_of_which_a_file_cannot_be_renamed_leaves_nothing(ending, older, stage, tmp_path, monkeypatch):
    """Whichever it is: the rest shape, the manifest, the frames, the root, the layer of a package or that."""
    out = tmp_path / "out"
    out.mkdir()
    if older:
        convert(stage, out / f"a.{ending}")
    before, failed = contents(out), 0
    while True:
        with monkeypatch.context() as patch:
            full_from(failed, patch, once=False)
            try:
                convert(stage, out / f"a.{ending}")
            except OSError:
                assert contents(out) == before and (older or not list(out.iterdir())), failed
                failed += 1
            else:
                break
    assert failed == (6 if ending == "usdz" else 4)


@pytest.mark.parametrize("name", ["a.pc2", "a.mdd", "a.npz", "a.usda", "a.usdc", "a.usdz", "a.obj", "a.##.ply"])
def test_what_a_killed_conversion_left_is_removed_by_the_next(name, stage, tmp_path, monkeypatch):
    """Before any of the renames. Files of other outputs stay, and what is left of a longer sequence does not."""
    out, rename, moments = tmp_path / "out", os.replace, []
    out.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(outputs.os, "replace", lambda *paths: (moments.append(contents(out)), rename(*paths)))
        convert(stage, out / name)
    clean = [path.name for path in sorted(contents(out))]
    others = {out / "b.npz.0123abcd.unfinished": b"b", out / "a.npz.old": b"old"}
    longer = [out / "a_0099.obj.0123abcd.unfinished"] if name == "a.obj" else []
    for left in moments:
        shutil.rmtree(out)
        for path, data in (left | others | dict.fromkeys(longer, b"")).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            convert(stage, out / name)
        assert [path.name for path in sorted(contents(out)) if path not in others] == clean
        assert all(path.read_bytes() == data for path, data in others.items())
    assert moments


@pytest.mark.parametrize(
    ("first", "second"), [("a.obj", "a_####.obj"), ("a.pc2", "a.mdd"), ("a.npz", "a.npz"), ("a.usdc", "a.usdc")]
)
def test_two_conversions_to_one_output_do_not_run_at_a_time(first, second, stage, tmp_path):
    """The first would else lose its temporary files; .pc2 and .mdd have the same mesh beside them."""

    def meanwhile(done, total):
        with pytest.raises(BlockingIOError, match="is being written by process"):
            convert(stage, tmp_path / second)
        convert(stage, tmp_path / "other.npz")

    convert(stage, tmp_path / first, progress=meanwhile)
    convert(stage, tmp_path / second)
    assert not [path for path in contents(tmp_path) if path.name.endswith((".lock", ".unfinished"))]


@pytest.mark.parametrize(
    ("held", "numbered", "other"), [("a0001.obj", False, "a####.obj"), ("a0000.obj", True, "a0001.pc2")], ids=["mesh", "frame"]
)
def test_a_conversion_keeps_unfinished_files_of_another_that_runs(held, numbered, other, stage, tmp_path):
    """a0001.obj may be the mesh beside a cache or a frame, and another conversion may write it as the other of these."""
    left = tmp_path / "a0001.obj.0123abcd.unfinished"
    with outputs.writing_alone([tmp_path / held], numbered):
        left.touch()
        convert(stage, tmp_path / other)
        assert left.exists()
    convert(stage, tmp_path / other)
    assert not left.exists()


def test_formats_are_those_of_others(stage, tmp_path, capfd):
    """The bytes of the headers, and names of frames."""
    assert main(["convert", str(stage), str(tmp_path / "c.pc2")]) == 0
    assert f"c.pc2 and {tmp_path / 'c.obj'}: {COUNT} frames of 12 vertices" in capfd.readouterr().out
    assert main(["convert", str(tmp_path / "c.pc2"), str(tmp_path / "b.ply"), "--json"]) == 0
    assert '"frames": 5' in capfd.readouterr().out
    data = (tmp_path / "c.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 12, 0.0, 1.0, COUNT) and len(data) == 32 + 12 * 12 * 5
    convert(stage, tmp_path / "c.mdd")
    data = (tmp_path / "c.mdd").read_bytes()
    assert struct.unpack(">7f", data[8:36])[:5] == pytest.approx(np.arange(COUNT) / FPS) and data[:8] == b"\0\0\0\5\0\0\0\x0c"
    _, paths = convert(stage, tmp_path / "c_.ply")
    assert [path.name for path in paths[:2]] == ["c__0000.ply", "c__0001.ply"]
    (tmp_path / "n").mkdir()
    _, named = convert(stage, tmp_path / "n" / "c2.##.ply")
    assert [path.name for path in named[:2]] == ["c2.00.ply", "c2.01.ply"]
    assert np.array_equal(open_sequence(tmp_path / "n", fps=FPS).labels, np.arange(COUNT))
    assert paths[0].read_bytes().startswith(b"ply\nformat binary_little_endian")


@pytest.mark.parametrize("fps", [24.0, 23.976, 24000 / 1001, 29.97, 59.94])
@pytest.mark.parametrize("source", ["a.npz", "a.mdd"])
def test_frames_of_stages_are_at_their_seconds(source, fps, stage, tmp_path):
    """Also of rates that are nearly whole. Caches have times in float32; a rate that is whole up to these is written so."""
    shown = open_sequence(stage)
    points, times = np.array([shown[0]] * 120, dtype=np.float32), np.arange(120) / fps
    np.savez(tmp_path / "long.npz", points=points, triangles=shown.mesh.triangles, times=times)
    convert(tmp_path / "long.npz", tmp_path / source)
    convert(tmp_path / source, tmp_path / "b.usdc")
    written = Usd.Stage.Open(str(tmp_path / "b.usdc"))
    codes = find_prim(written, "b.usdc", None).GetAttribute("points").GetTimeSamples()
    assert np.array(codes) / written.GetTimeCodesPerSecond() == pytest.approx(times, rel=1e-6, abs=1e-12)
    assert fps != 24.0 or written.GetTimeCodesPerSecond() == 24.0


def test_velocities_of_stages_are_kept_and_others_are_differences(stage, tmp_path):
    convert(stage, tmp_path / "v.npz")
    with np.load(tmp_path / "v.npz") as arrays:
        assert arrays["velocities"].dtype == np.float32 and (arrays["velocities"] == np.arange(COUNT)[:, None, None]).all()
    convert(stage, tmp_path / "v.usdc")
    assert (np.asarray(FrameSequence(tmp_path / "v.usdc", "Sheet", "velocities")) == np.arange(COUNT)[:, None, None]).all()
    convert(stage, tmp_path / "v.pc2")
    convert(tmp_path / "v.pc2", tmp_path / "w.usdc", fps=FPS)
    found, points = FrameSequence(tmp_path / "w.usdc", None, "velocities"), open_sequence(stage)
    assert found[2] == pytest.approx((points[3] - points[1]) * FPS / 2, rel=1e-5)
    assert found[4] == pytest.approx((points[4] - points[3]) * FPS, rel=1e-5)


def test_cloths_keep_their_names(tmp_path):
    mesh = wc.Mesh.join({"felt": wc.Mesh.grid(3, 3), "silk": wc.Mesh.grid(2, 4)})
    with AnimationWriter(tmp_path / "two.usdc", mesh, FPS, cloths={"felt": "felt", "silk": "silk"}) as writer:
        for frame in range(2):
            writer.append(moved(mesh, frame), np.ones((17, 3)))
    (tmp_path / "out").mkdir()
    original = open_sequence(tmp_path / "two.usdc")
    convert(tmp_path / "two.usdc", tmp_path / "two.npz")
    convert(tmp_path / "two.npz", tmp_path / "back.usdc")
    convert(tmp_path / "two.usdc", tmp_path / "out" / "two.obj")
    check(open_sequence(tmp_path / "back.usdc"), original)
    check(open_sequence(tmp_path / "out"), original, times=False)
    for name in ("two.npz", "back.usdc"):
        parts = open_sequence(tmp_path / name).mesh.parts
        assert {each: part.first for each, part in parts.items()} == {"felt": 0, "silk": 9}
    assert re.findall(r"g (\w+)", (tmp_path / "out" / "two_0001.obj").read_text()) == ["felt", "silk"]
    with np.load(tmp_path / "two.npz") as arrays:
        assert (arrays["velocities"] == 1.0).all()


def saved(path, **arrays):
    np.savez(path, **arrays)
    return path


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_wrong_input_is_refused_in_a_sentence(stage, tmp_path, capfd):
    mesh = wc.Mesh.grid(3, 3)
    points = np.stack([moved(mesh, frame) for frame in range(3)]).astype(np.float64)
    good = {"points": points, "triangles": mesh.triangles}
    bad = points + 1.0
    bad[2, 4, 2] = np.nan
    fast = points.copy()
    fast[1:, 4, 0] = 3e38, -3e38
    saved(tmp_path / "nan.npz", points=bad, triangles=mesh.triangles, times=[0.0, 1.0, 2.0])
    saved(tmp_path / "fast.npz", points=fast, triangles=mesh.triangles, times=[0.0, 1.0, 2.0])
    saved(tmp_path / "huge.npz", points=1e39 * points, triangles=mesh.triangles)
    saved(tmp_path / "empty.npz", points=points[:0], triangles=mesh.triangles)
    saved(tmp_path / "untimed.npz", **good)
    saved(tmp_path / "uneven.npz", **good, times=[0.0, 1.0, 3.0])
    for folder in ("mixed", "far"):
        (tmp_path / folder).mkdir()
    for frame, width in enumerate((3, 3, 4)):
        shape = wc.Mesh.grid(3, width)
        (tmp_path / "mixed" / f"f{frame}.obj").write_text(obj(shape.points, shape.triangles))
    (tmp_path / "far" / "f0.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 100/1\nf 1 2 3\n")
    with AnimationWriter(tmp_path / "chain.usdc", wc.Mesh.chain(3), FPS) as writer:
        writer.append(np.zeros((3, 3)), np.zeros((3, 3)))
    for name in ("old.usdc", "old.obj"):
        convert(tmp_path / "untimed.npz", tmp_path / name, fps=FPS)
    (tmp_path / "zero.usdc").write_bytes(b"")
    (tmp_path / "c_0002.obj").mkdir()
    (tmp_path / "short.pc2").write_bytes(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 12, 0.0, 1.0, 5) + bytes(100))
    (tmp_path / "none.mdd").write_bytes(struct.pack(">ii", 0, 12))
    (tmp_path / "alone.mdd").write_bytes(struct.pack(">iif9f", 1, 3, 0.0, *range(9)))
    (tmp_path / "s_0099.ply").write_bytes(b"")
    (tmp_path / "rest.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    cases = [
        ("nan.npz a.pc2", r"nan\.npz, frame 2: point 4 is \[.*nan\]; it must be finite as float32"),
        ("nan.npz a.usdc", r"frame 2: point 4 is .*finite"),
        ("nan.npz a.npz", r"frame 2: point 4 is .*finite"),
        ("nan.npz old.usdc", r"frame 2: point 4 is .*finite"),
        ("nan.npz old.obj", r"frame 2: point 4 is .*finite"),
        ("fast.npz old.usdc", r"frame 2: velocity 4 is \[-6e\+38, .*finite as float32"),
        ("huge.npz a.obj", r"frame 0: point .* finite as float32"),
        ("empty.npz a.pc2", "of one frame or more"),
        ("untimed.npz a.mdd", r"has no times; give the frames per second \(--fps\)"),
        ("uneven.npz a.usdc", "times are uneven after frame 1"),
        ("mixed a.pc2", r"f2\.obj: 12 vertices, must be 9 as in"),
        ("mixed a.ply", r"f2\.obj: 12 vertices, must be 9 as in"),
        ("mixed old.obj", r"f2\.obj: 12 vertices, must be 9 as in"),
        ("far a.npz", r"f0\.obj, line 4: face 1 names vertex 100; the file has 3$"),
        ("zero.usdc a.npz", r"zero\.usdc: the file is empty$"),
        ("chain.usdc a.npz", r"chain\.usdc: has edges and no triangles; a sequence must have triangles$"),
        ("short.pc2 a.npz", "has 132 bytes; 5 frames of 12 points must have 752"),
        ("none.mdd a.npz", "has 0 frames of 12 points"),
        ("alone.mdd a.npz", "has no triangles; give a rest mesh .* put it beside as alone.obj"),
        ("sheet.usdc a.abc", r"the ending is '\.abc'; it must be one of \.obj \.ply \.pc2 \.mdd"),
        ("sheet.usdc sheet.usdc", "is a file of the input"),
        ("sheet.usdc s.ply", r"s_0099\.ply: is a frame of another sequence; remove it"),
        ("sheet.usdc s.##_2.ply", r"has # or a digit after ##; the last number of a name must be that of the frame"),
        ("sheet.usdc rest.pc2", r"rest\.obj: is another mesh, which the first frame would replace"),
        ("untimed.npz c.obj", r"c_0002\.obj: is no regular file"),
        *((f"sheet.usdc nowhere/a{end}", r": \S+: the folder \S+nowhere does not exist") for end in (".pc2", ".usda", ".obj")),
        ("gone.usdc a.pc2", "no such file"),
    ]
    before = contents(tmp_path)
    for words, says in cases:
        source, output = words.split()
        code = main(["convert", str(tmp_path / source), str(tmp_path / output)])
        out, err = capfd.readouterr()
        assert code == 2 and re.search(says, err) and err.count("\n") == 1 and not out, (words, err)
        assert contents(tmp_path) == before, words


def test_frames_are_streamed(tmp_path):
    """Of 400 frames, 9.6 MB, no more than some are in memory; NumPy reports its arrays to tracemalloc."""
    mesh = wc.Mesh.grid(40, 25)
    saved(tmp_path / "a.npz", points=np.tile(mesh.points, (400, 1, 1)), triangles=mesh.triangles, times=np.arange(400.0))
    convert(tmp_path / "a.npz", tmp_path / "warm.pc2")
    for name in ("b.pc2", "b.mdd", "b.npz"):
        tracemalloc.start()
        convert(tmp_path / "a.npz", tmp_path / name)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < 2e6, name
