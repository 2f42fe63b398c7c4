"""Writers of stages: flat memory, one writer at a time, sources that change meanwhile, and processes that are killed."""

import errno
import gc
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from support.forks import Forks
from support.rows import slow_but
from support.stages import (
    CHUNK,
    FRAMES,
    animated_prim,
    anonymous_memory,
    artist_stage,
    full_from,
    measure,
    measured,
    motion,
    write,
)
from support.usd_validation import validate
from warpcloth.analysis.analysis import Analyzer
from warpcloth.cli.reports import ReportFiles, write_report
from warpcloth.mesh.mesh import Mesh
from warpcloth.usd import AnimationWriter, FrameSequence, MeasureWriter, chunks, read_mesh, read_stage_mesh

EPS = np.finfo(np.float32).eps


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="counts memory as Linux does")
@pytest.mark.parametrize("kind", slow_but(["usdc", "measures"], ["usdc", "usdz", "measures"]))
def test_memory_stays_flat(tmp_path, kind):
    mesh = Mesh.grid(100, 100)
    points, velocities = (values.astype(np.float32) for values in motion(mesh, 0))
    values = np.arange(len(mesh.triangles), dtype=np.float32)
    colours = np.zeros((len(values), 3), np.float32)
    if kind == "measures":
        writer, count = MeasureWriter(tmp_path / "a.usdc", mesh, {"a": "uniform"}, "a"), 300
        frame_bytes = values.nbytes + colours.nbytes + 2 * points.nbytes  # normals too
    else:
        writer, count, frame_bytes = AnimationWriter(tmp_path / f"a.{kind}", mesh, 24), 500, 3 * points.nbytes
    for frame in range(count):
        if frame == 50:
            before = anonymous_memory()
        moved = points + np.float32(1e-3 * frame)
        if kind == "measures":
            writer.append(frame, {"a": values + frame}, colours + np.float32(1e-3 * frame), points=moved)
        else:
            writer.append(moved, velocities)
    grown = [anonymous_memory() - before]
    writer.close(single_file=True)
    grown.append(anonymous_memory() - before)
    for found in FrameSequence(writer.path):
        assert found[0, 0] >= 0
    grown.append(anonymous_memory() - before)
    # Kept frames would be 450 · 360 kB = 154 MiB. A chunk of 10, its copy and what malloc keeps stay below 40 frames.
    assert max(grown) < 40 * frame_bytes, grown


@pytest.mark.parametrize("single_file", [False, True], ids=["chunks", "one"])
@pytest.mark.parametrize("step", range(10))
def test_every_rename_may_be_the_last(tmp_path, monkeypatch, step, single_file):
    """A disk that is full at any of the steps leaves the earlier result, or the new one as far as it got."""
    mesh, output = Mesh.grid(5, 4), tmp_path / "out.usdc"
    write(output, mesh, frames=30, sign=-1.0)
    full_from(step, monkeypatch)
    writer = AnimationWriter(output, mesh, 24, chunk=CHUNK)
    appended = 0
    try:
        for frame in range(FRAMES):
            writer.append(*motion(mesh, frame))
            appended += 1
        writer.close(single_file=single_file)
    except OSError:
        assert appended < FRAMES or step >= 6
    else:
        assert step >= 8 and not single_file, "eight renames, and two more for one file"
    now = FrameSequence(output)
    assert len(now) == (30 if step <= 3 else min(FRAMES, (step - 2) // 2 * CHUNK))
    for frame, points in enumerate(now):
        np.testing.assert_allclose(points, motion(mesh, frame, -1.0 if step <= 3 else 1.0)[0], atol=4 * EPS)


@pytest.mark.parametrize("single_file", [False, True], ids=["chunks", "one"])
@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_a_reader_finds_a_whole_file_at_any_moment(tmp_path, monkeypatch, ending, single_file):
    """Before and after each rename, when it opens what was there before or the new frames so far."""
    mesh, output, seen = Mesh.grid(5, 4), tmp_path / f"out.{ending}", []
    write(output, mesh, frames=30, sign=-1.0)
    real = os.replace

    def look():
        for path in {str(output), writer.path}:
            if os.path.exists(path):
                found = FrameSequence(path)
                sign = -1.0 if len(found) == 30 else 1.0
                seen.append(len(found))
                for frame, points in enumerate(found):
                    np.testing.assert_allclose(points, motion(mesh, frame, sign)[0], atol=4 * EPS)

    def replace(*paths):
        look()
        real(*paths)
        look()

    writer = AnimationWriter(output, mesh, 24, chunk=CHUNK)
    monkeypatch.setattr(os, "replace", replace)
    for frame in range(FRAMES):
        writer.append(*motion(mesh, frame))
    writer.close(single_file=single_file)
    assert set(seen) == {30, 3, 6, 8}


def test_an_output_has_one_writer_at_a_time(tmp_path):
    """If two threads begin together, one is refused or starts later; outputs that differ in their ending do not conflict."""
    mesh, output = Mesh.grid(4, 4), tmp_path / "out.usdc"

    def run(sign):
        together.wait()
        try:
            return write(output, mesh, sign=sign)
        except BlockingIOError as error:
            return str(error)

    for _ in range(20):
        together = threading.Barrier(2, timeout=600.0)
        with ThreadPoolExecutor(2) as pool:
            found = list(pool.map(run, (1.0, -1.0)))
        assert str(output) in found
        assert all(text == str(output) or f"{output}: is being written by " in text for text in found)
        points = np.asarray(FrameSequence(output))
        sign = np.sign(points[1, 0, 2])
        for frame in range(FRAMES):
            np.testing.assert_allclose(points[frame], motion(mesh, frame, sign)[0], atol=4 * EPS)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out.usdc", "out_frames"]
    with AnimationWriter(output, mesh, 24) as writer:
        writer.append(*motion(mesh, 0))
        write(tmp_path / "out.usdz", mesh)
    assert len(FrameSequence(output)) == 1 and len(FrameSequence(tmp_path / "out.usdz")) == FRAMES


def test_a_writer_that_nobody_closed_or_that_failed_holds_nobody_up(tmp_path):
    mesh, output = Mesh.grid(4, 4), tmp_path / "out.usdc"
    writer = AnimationWriter(output, mesh, 24)
    writer.append(*motion(mesh, 0))
    with pytest.raises(BlockingIOError):
        write(output, mesh)
    del writer
    gc.collect()
    with pytest.raises(ValueError, match="velocities"), AnimationWriter(output, mesh, 24) as writer:
        writer.append(mesh.points, mesh.points[:1])
    with pytest.raises(ValueError, match="source"), AnimationWriter(output, mesh, 24) as writer:
        raise ValueError("source")
    assert len(FrameSequence(write(output, mesh))) == FRAMES


HOLDER = """
import os, sys
sys.path[:0] = {path!r}
from support.stages import Mesh, motion
from warpcloth.usd import AnimationWriter
writer = AnimationWriter(sys.argv[1], Mesh.grid(4, 4), 24)
writer.append(*motion(Mesh.grid(4, 4), 0))
print("ready", flush=True)
sys.stdin.read()
"""


def test_a_writer_of_another_process_is_waited_for_until_it_is_killed(tmp_path):
    mesh, output = Mesh.grid(4, 4), tmp_path / "out.usdc"
    script = HOLDER.format(path=[str(Path(__file__).parents[1]), *sys.path])
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", script, str(output)], **pipes) as holder:
        assert holder.stdout.readline() == "ready\n"
        with pytest.raises(BlockingIOError, match=rf"out\.usdc: is being written by process {holder.pid} on .*; wait"):
            write(output, mesh)
        holder.kill()
        holder.wait()
    assert (tmp_path / ".out.usdc.lock").exists()
    assert len(FrameSequence(write(output, mesh))) == FRAMES
    assert not (tmp_path / ".out.usdc.lock").exists()


def test_a_link_in_place_of_a_lock_is_not_written_through(tmp_path):
    """Anybody may leave one in a shared folder; the file that it stands for was emptied."""
    (tmp_path / "precious").write_text("text")
    (tmp_path / ".out.usdc.lock").symlink_to("precious")
    with pytest.raises(OSError, match=r"\.out\.usdc\.lock"):
        AnimationWriter(tmp_path / "out.usdc", Mesh.grid(2, 2), 24.0)
    assert (tmp_path / "precious").read_text() == "text"


def test_a_folder_without_locks_warns(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("warpcloth.base.outputs._lock", refuse)
    with pytest.warns(UserWarning, match=r"out\.usdc: its folder does not support locks; do not start another run to it"):
        write(tmp_path / "out.usdc", Mesh.grid(4, 4))
    assert len(FrameSequence(tmp_path / "out.usdc")) == FRAMES


SPOIL = {  # what changes a source, or the files of an output in a folder, during a run
    "delete": lambda folder: (folder / "artist.usda").unlink(),
    "garble": lambda folder: (folder / "artist.usda").write_text("garbage"),
    "triangles": lambda folder: artist_stage(folder / "artist.usda", Mesh.grid(3, 3)),
    "touch": lambda folder: (folder / "artist.usda").write_text((folder / "artist.usda").read_text() + "# said later\n"),
    "frames": lambda folder: shutil.rmtree(folder / "out_frames"),
    "folder": lambda folder: ((folder / "out.usdc").unlink(missing_ok=True), (folder / "out.usdc").mkdir()),
}


@pytest.mark.parametrize(
    ("act", "ending", "single_file", "message", "kept"),
    [
        *(
            (act, *how, "has changed during the run and no longer fits", FRAMES)
            for act in ("delete", "garble", "triangles")
            for how in (("usdc", False), ("usdc", True), ("usdz", True))
        ),
        ("frames", "usdc", False, "has been removed during the run, with frames 0 to 2; nothing was saved", 0),
        ("folder", "usdc", False, "out.usdc: could not be written: Is a directory; frames 0 to 5 are in ", 6),
    ],
)
def test_what_changes_during_a_run_is_noticed(tmp_path, act, ending, single_file, message, kept):
    """The error is one sentence that says where the frames are, and no later run removes them."""
    source = artist_stage(tmp_path / "artist.usda", Mesh.grid(5, 4))
    original, mesh, output = Path(source).read_text(), read_mesh(source), tmp_path / f"out.{ending}"
    writer = AnimationWriter(output, mesh, 24, source=source, chunk=CHUNK)
    with pytest.raises((ValueError, OSError), match=message) as caught:
        try:
            for frame in range(FRAMES):
                writer.append(*motion(mesh, frame))
                if frame == CHUNK:
                    SPOIL[act](tmp_path)
        finally:
            writer.close(single_file=single_file)
    assert "\n" not in str(caught.value) and writer.kept == kept
    assert not output.is_file() or ending != "usdz"
    Path(source).write_text(original)
    if kept:
        assert f"frames 0 to {kept - 1} are in {writer.path}" in str(caught.value)
        sequence = np.asarray(FrameSequence(writer.path))
        assert len(sequence) == kept
        np.testing.assert_allclose(sequence[-1], motion(mesh, kept - 1)[0], rtol=0, atol=1e-5)
    if output.is_dir():
        output.rmdir()
    path = writer.path
    del writer
    if path != str(output):
        with pytest.warns(UserWarning, match="has all frames of an earlier run that was not packed, and is kept"):
            write(output, mesh, source=source)
        assert len(FrameSequence(path)) == kept


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_a_source_that_changes_and_fits_is_said(tmp_path, ending):
    source = artist_stage(tmp_path / "artist.usda", Mesh.grid(5, 4))
    mesh = read_mesh(source)
    with (
        pytest.warns(UserWarning, match=r"artist\.usda: has changed during the run; the frames belong to its earlier version"),
        AnimationWriter(tmp_path / f"out.{ending}", mesh, 24, source=source, chunk=CHUNK) as writer,
    ):
        for frame in range(FRAMES):
            writer.append(*motion(mesh, frame))
            if frame == CHUNK:
                SPOIL["touch"](tmp_path)
    assert len(FrameSequence(tmp_path / f"out.{ending}")) == FRAMES


@pytest.mark.parametrize("cut", [False, True], ids=["ended", "cut-short"])
def test_a_run_that_was_cut_short_is_recovered_under_its_own_name(tmp_path, cut):
    """Files that a run reads are not removed, neither by that run nor after it is cut short itself."""
    mesh, output = Mesh.grid(5, 4), tmp_path / "out.usdz"
    writer = AnimationWriter(output, mesh, 24, chunk=CHUNK)
    for frame in range(2 * CHUNK):
        writer.append(*motion(mesh, frame))
    left = writer.path
    del writer  # killed: nothing is packed
    gc.collect()
    analyzer = Analyzer(left)
    if cut:
        with pytest.raises(KeyboardInterrupt):
            write_report(analyzer, ReportFiles(usd=output), progress=lambda row, _: interrupt_twice(row == 4))
    else:
        write_report(analyzer, ReportFiles(usd=output))
        for frame, points in enumerate(FrameSequence(output)):
            np.testing.assert_allclose(points, motion(mesh, frame)[0], atol=4 * EPS)
    again = np.asarray(FrameSequence(left))
    assert len(again) == 2 * CHUNK
    np.testing.assert_allclose(again[-1], motion(mesh, 2 * CHUNK - 1)[0], atol=4 * EPS)


@pytest.mark.parametrize("last", ["animation.usdc", "rest.usdc", "frames_000000.usdc"])
def test_no_root_is_left_whose_layers_are_gone(tmp_path, monkeypatch, last):
    """The process dies while it removes the folder of a package that is finished; the next one removes what is left of it."""
    output, remove = tmp_path / "out.usdz", os.remove

    def killed(path):
        remove(path)
        if Path(path).name == last:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "remove", killed)
        write(output, Mesh.grid(5, 4))
    assert len(FrameSequence(output)) == FRAMES
    assert list(tmp_path.rglob("manifest.usda")) and not list(tmp_path.rglob("animation.usdc"))
    write(output, Mesh.grid(5, 4))
    assert [path.name for path in tmp_path.iterdir()] == ["out.usdz"]


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
@pytest.mark.parametrize("linked", [False, True], ids=["folder", "linked folder"])
def test_a_run_removes_no_files_but_those_of_runs(tmp_path, ending, linked):
    """Folders that are called like those of runs, what users put into those, and all that is behind links."""
    mine = ("mine.txt", "finished.blend", "unfinished.md", "unfinished.backup", "checkpoint.pth", "frames_000000_mine.usdc")
    output, elsewhere = tmp_path / f"out.{ending}", tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("animation.usdc", "rest.usdc", "frames_000000.usdc", "manifest.usda", "mine.txt"):
        (elsewhere / name).write_text(name)
    killed = AnimationWriter(output, Mesh.grid(5, 4), 24, chunk=CHUNK)
    for frame in range(CHUNK):
        killed.append(*motion(Mesh.grid(5, 4), frame))
    earlier, folder = killed.run, killed.run.parent
    del killed
    gc.collect()
    unpacked = earlier / f"unpacked-{earlier.name[-8:]}" / "0"
    for path in (*(earlier / name for name in mine), unpacked / "texture.png"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
    (earlier / "frames_000009.usdc").symlink_to(elsewhere / "frames_000000.usdc")
    shutil.copytree(elsewhere, folder / f"{ending}-0123abcd")
    (folder / f"{ending}-4567abcd").symlink_to(elsewhere)
    for name in ("notes", f"{ending}-deadbeef"):
        (folder / name).mkdir()
    for name in ("finished.blend", "unfinished.md"):
        (folder / f"{ending}-deadbeef" / name).write_text(name)
    (elsewhere / "manifest.usda").write_text(f'"{ending}-4567abcd"')
    if linked:
        folder.rename(tmp_path / "disk")
        folder.symlink_to(tmp_path / "disk")
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*") if path != output}
    write(output, Mesh.grid(5, 4))
    gone = {path for path in before if not os.path.lexists(path)}
    assert {path.parent for path in gone} <= {earlier, unpacked.parent, unpacked} and not (linked and gone)
    assert linked or {path.name for path in earlier.iterdir()} == {*mine}
    assert all(path.read_bytes() == data for path, data in before.items() if data and path not in gone)
    assert len(FrameSequence(output)) == FRAMES


def interrupt_twice(now):
    """Of which the second comes while the first has the file packed."""
    if now:
        real = chunks.Contents.write

        def write(*_):
            chunks.Contents.write = real
            raise KeyboardInterrupt

        chunks.Contents.write = write
        raise KeyboardInterrupt


IMPORTS = """
import itertools, os, sys
sys.path[:0] = {path!r}
from support.stages import CHUNK, FRAMES, Mesh, measure, motion
from warpcloth.usd import AnimationWriter, read_mesh, read_stage_mesh
"""
VICTIM = """
output, source, single_file, log = given
mesh = read_mesh(source) if source else Mesh.grid(40, 40)
log = os.open(log, os.O_WRONLY | os.O_CREAT)
for run in itertools.count():
    with AnimationWriter(output, mesh, 24, source=source or None, chunk=CHUNK) as writer:
        for frame in range(FRAMES):
            writer.append(*motion(mesh, frame, (-1) ** run))
            os.write(log, b".")
        writer.close(single_file=bool(single_file))
        os.write(log, b"|")
"""


MEASURER = """
source = read_stage_mesh(given[1])
print("ready", flush=True)
for run in itertools.count():
    measure(given[0], source.mesh, source, sign=(-1) ** run)
"""


@pytest.fixture(scope="module")
def forks():
    with Forks(IMPORTS.format(path=[str(Path(__file__).parents[1]), *sys.path])) as forks:
        yield forks


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(
    ("ending", "with_source", "single_file"),
    [("usdc", False, False), ("usda", True, False), ("usdc", True, True), ("usdz", False, True)],
    ids=["chunks", "layer", "one-file", "package"],
)
def test_a_killed_writer_loses_one_chunk_at_most(tmp_path, forks, ending, with_source, single_file):
    """Two kills of each kind. The victim writes one result over the other for ever, so each kill meets it at work."""
    mesh = Mesh.grid(40, 40)
    source = artist_stage(tmp_path / "artist.usda", mesh) if with_source else ""
    mesh = read_mesh(source) if source else mesh
    moments = random.Random(f"{ending} {with_source} {single_file}")
    for trial in (0, 2):
        output, log = tmp_path / f"{trial}.{ending}", tmp_path / f"{trial}.log"
        arguments = [str(output), source, "yes" if single_file else "", str(log)]
        victim, ends = forks.start(VICTIM, tmp_path / f"{trial}.txt", *arguments), time.monotonic() + 60.0
        while not log.exists() and time.monotonic() < ends:
            time.sleep(0.001)
        time.sleep(moments.uniform(0, 0.2 * trial + 0.02))
        os.kill(victim, signal.SIGKILL)
        assert forks.wait() == -signal.SIGKILL
        check_survivor(output, mesh, log.read_text(), source)
        # The next run is not disturbed by what is left, and clears it away; but not what was only to be packed.
        folder = tmp_path / f"{trial}_frames"
        complete = [path.parent for path in folder.glob("usdz-*/complete")]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(output, mesh, source=source or None)
        assert len(FrameSequence(output)) == FRAMES
        left = list(folder.glob("*"))
        assert left == complete if ending == "usdz" else len(left) == 1, (left, [list(p.glob("*")) for p in left])
        assert not list(tmp_path.glob(".*.lock"))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_writer_of_measures_leaves_a_readable_result(tmp_path, forks):
    mesh, moments, output = Mesh.grid(40, 40), random.Random(1), tmp_path / "out.usdc"
    path = artist_stage(tmp_path / "artist.usda", mesh)
    measure(output, read_mesh(path), read_stage_mesh(path))
    for trial in range(3):
        said, ends = tmp_path / f"{trial}.txt", time.monotonic() + 60.0
        victim = forks.start(MEASURER, said, str(output), path)
        while not (said.exists() and said.read_text()) and time.monotonic() < ends:
            time.sleep(0.001)
        time.sleep(moments.uniform(0, 0.5))
        os.kill(victim, signal.SIGKILL)
        assert forks.wait() == -signal.SIGKILL and said.read_text() == "ready\n"
        now = FrameSequence(output, attribute="primvars:stretch1")
        sign = np.sign(now[0][5])
        for frame, values in enumerate(now):
            np.testing.assert_array_equal(values, np.float32(measured(mesh, frame, sign)[0]["stretch1"]))
        assert len(now) in (3, 6, 7) and validate(output, path) == []


def check_survivor(output, mesh, log, source):
    """The result before is left, or the last run but for its last chunk at most; the log has . for an append, | for a close."""
    runs = log.split("|")
    appended = len(runs[-1])
    last = (-1) ** (len(runs) - 1)
    # A package is made at the end; until then its frames can be opened in the folder.
    partial = [path for path in (output.parent / f"{output.stem}_frames").glob("usdz-*/animation.usdc")]
    found = [path for path in [output, *partial] if path.exists()]
    newest = 0
    for path in found:
        points, velocities = FrameSequence(path), FrameSequence(path, attribute="velocities")
        sign = 1 if abs(velocities[1][0, 0] - 1.0) < 0.5 else -1
        if sign == last:
            newest = max(newest, len(points))
        else:
            assert len(runs) > 1 and len(points) == FRAMES
        transform = read_stage_mesh(path).transform
        for frame in range(len(points)):
            expected = motion(mesh, frame, sign)
            # As in the round trip, with the transform's condition number 1 and its offset below 2 m.
            tolerance = 2 * EPS * (np.abs(expected[0]).max() + np.abs(transform[3]).max() + np.abs(expected[1]).max())
            np.testing.assert_allclose(points[frame], expected[0], rtol=0, atol=tolerance)
            np.testing.assert_allclose(velocities[frame], expected[1], rtol=0, atol=tolerance)
        stage, _ = animated_prim(path)
        assert stage.GetEndTimeCode() - stage.GetStartTimeCode() == len(points) - 1
        assert validate(path, source or None) == []
    assert appended // CHUNK * CHUNK <= newest <= FRAMES
    assert found or appended < CHUNK
    assert len(runs) == 1 or output.exists()
