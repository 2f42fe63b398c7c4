"""Runs that were interrupted go on to the bit of those that were not; all others are refused in one sentence."""

import os
import re
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import refused, run
from support.forks import Forks
from support.rows import slow_but
from support.setups import MAIN, SOLVERS
from warpcloth.cli import main
from warpcloth.core.status import Grade
from warpcloth.run import recorders
from warpcloth.run.checkpoint import Checkpoint
from warpcloth.scenes import hanging
from warpcloth.usd import FrameSequence, chunks

LAST, STOP = 24, 13  # frames; the last checkpoint before STOP is after frame 9
PINS = [0, 4]


def moved(offset=0.0):
    """A damped cloth out of balance, two corners led; far from the origin explicit steps keep the position residual."""
    grid = wc.Mesh.grid(5, 5, pattern="alternating")
    mesh = wc.Mesh(grid.points + offset, grid.triangles, grid_shape=grid.grid_shape)
    start = mesh.points + np.random.default_rng(0).normal(scale=0.02, size=mesh.points.shape)
    start[PINS] = mesh.points[PINS]
    keyframes = mesh.points[PINS][None] + np.linspace(0.0, 0.2, LAST - 4)[:, None, None] * [0.0, 0.3, 1.0]
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=100.0, damping=0.0 if offset else 0.02)]
    given = {"positions": start, "pins": wc.Pins(PINS, keyframes), "fps": 480.0, "duration": LAST / 480.0}
    return wc.Scene(mesh, density=0.1, terms=terms, **given)


def stop_at(*frames):
    def progress(frame, _frames):
        if frame in frames:
            raise KeyboardInterrupt

    return progress


def interrupted(scene, solver, output, *frames, **given):
    with pytest.raises(KeyboardInterrupt):
        wc.simulate(scene, solver, output=str(output), progress=stop_at(*frames), **given)


def same(one, other):
    """Whether two animations have the same frames and end in the same words."""
    for name in ("points", "velocities"):
        a, b = (np.asarray(getattr(animation, name)) for animation in (one, other))
        assert a.shape == b.shape and a.tobytes() == b.tobytes()
    np.testing.assert_equal(tuple(one.status), tuple(other.status))  # NaN is equal to NaN
    assert one.worst_strain == other.worst_strain
    assert len(one.timings["frames"]) == len(other.timings["frames"])
    return True


# One of each solver, and who has more state than it, or a history within a step that must not be of it.
STATES = [*MAIN, "newton midpoint", "newton bdf2", "pbd averaged by vertex", "xpbd averaged by constraint"]
STATES += ["projective dynamics chebyshev", "projective dynamics l-bfgs", "constrained dynamics searching"]
CASES = [("explicit", 300.0, "float32"), *((name, 0.0, "float32") for name in STATES), ("newton", 0.0, "float64")]


@pytest.mark.parametrize(
    ("name", "offset", "dtype"),
    slow_but(
        [
            ("explicit", 300.0, "float32"),
            *((name, 0.0, "float32") for name in ("newton", "pbd", "projective dynamics", "admm")),
        ],
        CASES,
    ),
)
def test_a_resumed_run_is_the_same_to_the_bit(name, offset, dtype, tmp_path, device, monkeypatch):
    """In the file, and in the precision of the run, which the file has not."""
    scene, solver, kept = moved(offset), SOLVERS[name], []
    append = recorders.File.append

    def keep(self, points, velocities, *carried, **more):
        kept[-1].append((points.copy(), velocities.copy()))
        append(self, points, velocities, *carried, **more)

    monkeypatch.setattr(recorders.File, "append", keep)
    given, outputs = {"device": device, "dtype": dtype}, [tmp_path / f"{k}.usdc" for k in range(2)]
    kept.append([])
    whole = wc.simulate(scene, solver, output=str(outputs[0]), **given)
    kept.append([])
    interrupted(scene, solver, outputs[1], STOP, **given)
    kept.append([])
    resumed = wc.simulate(scene, solver, output=str(outputs[1]), resume=True, **given)
    assert same(whole, resumed) and len(whole.points) == LAST + 1
    assert len(kept[2]) == LAST - 9
    for expected, found in zip(kept[0][10:], kept[2], strict=True):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(expected, found, strict=True))
    assert not list(tmp_path.rglob("checkpoint*"))


@pytest.mark.parametrize("name", ["explicit", "newton bdf2", "xpbd"])
def test_books_of_a_resumed_run_are_the_same_to_the_bit(name, tmp_path, device):
    """Works of pins and of a pressure too, which are summed from the start; another record is another run."""
    wind = wc.Pressure(vertices="all", keyframes=np.linspace(0.0, 5.0, LAST))
    scene, solver, record = replace(moved(), loads=[wind]), SOLVERS[name], ("reactions", "energies")
    whole = wc.simulate(scene, solver, device=device, record=record)
    interrupted(scene, solver, tmp_path / "a.usdc", STOP, device=device, record=record)
    with pytest.raises(ValueError, match="interrupted had record energies, reactions, and this one has record energies; run"):
        wc.simulate(scene, solver, output=str(tmp_path / "a.usdc"), resume=True, device=device, record="energies")
    resumed = wc.simulate(scene, solver, output=str(tmp_path / "a.usdc"), resume=True, device=device, record=record)
    assert whole.reactions.shape == (LAST + 1, 2, 3) and whole.reactions.tobytes() == resumed.reactions.tobytes()
    assert "work of pins" in whole.energies and "work of loads" in whole.energies
    assert list(whole.energies) == list(resumed.energies)
    for values, found in zip(whole.energies.values(), resumed.energies.values(), strict=True):
        assert values.tobytes() == found.tobytes()


@pytest.mark.parametrize("stops", [(STOP,), (20, 21), (10, 10, 23)])
@pytest.mark.parametrize(("ending", "single"), [("usdc", False), ("usda", True), ("usdz", False)])
def test_frames_go_on_in_the_same_file(ending, single, stops, tmp_path, device):
    """However often it is interrupted; and where it is one file, that is all that is left."""
    scene, solver, given = moved(), SOLVERS["newton bdf2"], {"device": device, "single_file": single}
    whole = wc.simulate(scene, solver, output=str(tmp_path / f"whole.{ending}"), **given)
    output = tmp_path / f"out.{ending}"
    for k, stop in enumerate(stops):
        interrupted(scene, solver, output, stop, resume=k > 0, **given)
        assert len(FrameSequence(output)) == stop + 1
    (run,) = (path.parent for path in tmp_path.rglob("checkpoint.npz"))
    mine = [run / name for name in ("frames_000000_mine.usdc", "frames_best.usdc")]
    for path in mine:
        path.touch()
    assert same(whole, wc.simulate(scene, solver, output=str(output), resume=True, **given))
    for path in mine:
        path.unlink()  # raises if it is gone
    if single or ending == "usdz":
        run.rmdir()
        run.parent.rmdir()
    folders = [path for path in tmp_path.iterdir() if path.is_dir()]
    files = sorted(path.name for path in tmp_path.rglob("*") if path.is_file() and path.name.startswith("frames_"))
    assert len(folders) == (0 if single or ending == "usdz" else 2) and len(files) == 3 * len(folders)


IMPORTS = """
import os, sys
from warpcloth.cli import main
from warpcloth.run import recorders, simulate
from warpcloth.scenes import hanging
"""
KILLED = """
append = recorders.File.append

def killed(self, *more, **named):
    append(self, *more, **named)
    if self.frames == 26:
        os.kill(os.getpid(), int(given[0]))

recorders.File.append = killed
os.chdir(given[1])
code = main(given[2:])
sys.stderr.flush()
os._exit(code)
"""


@pytest.fixture(scope="module")
def forks():
    with Forks(IMPORTS, PYTHONPATH=os.pathsep.join(sys.path)) as forks:
        yield forks


@pytest.mark.host
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("number", slow_but([signal.SIGKILL], [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]))
def test_the_command_line_resumes_what_a_signal_ended(number, forks, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["run", "hanging", "-p", "n=6", "--solver", "xpbd", "-s", "substeps=2", "iterations=2"]
    forks.start(KILLED, tmp_path / "said", int(number), str(tmp_path), *command)
    assert forks.wait() == (-number if number == signal.SIGKILL else 128 + number), (tmp_path / "said").read_text()
    assert len(FrameSequence("hanging.usdc")) == (20 if number == signal.SIGKILL else 26)
    code, out, err = run(capfd, *command, "--resume")
    assert code == 0 and "60 of 60" in out and err == ""
    assert main([*command, "-o", "whole.usdc"]) == 0
    for name in ("points", "velocities"):
        one, other = (np.asarray(FrameSequence(path, attribute=name)) for path in ("hanging.usdc", "whole.usdc"))
        assert one.shape == (61, 36, 3) and one.tobytes() == other.tobytes()
    refused(capfd, [*command, "--resume", "-o", "hanging.usdc"], "hanging.usdc: there is nothing to resume")


def test_a_full_disk_is_an_interruption_too(tmp_path, device, monkeypatch):
    scene, solver, output = moved(), SOLVERS["xpbd"], tmp_path / "out.usdc"
    export = chunks._export

    def full(layer, file, meant=None):
        if meant is not None and meant.name == "frames_000001.usdc":
            raise OSError(f"{meant}: could not be written: no space left on device")
        export(layer, file, meant)

    with monkeypatch.context() as patched:
        patched.setattr(chunks, "_export", full)
        with pytest.raises(OSError, match="could not be written"):
            wc.simulate(scene, solver, output=str(output), device=device)
    whole = wc.simulate(scene, solver, output=str(tmp_path / "whole.usdc"), device=device)
    assert same(whole, wc.simulate(scene, solver, output=str(output), device=device, resume=True))


def test_more_frames_may_be_asked_for_and_not_fewer(tmp_path, device):
    scene, solver, output = moved(), SOLVERS["xpbd"], str(tmp_path / "out.usdc")
    interrupted(scene, solver, output, 21, device=device)
    with pytest.raises(ValueError, match="frames is 18; the run to be resumed has 19 already, and this must be no less"):
        wc.simulate(scene, solver, output=output, device=device, resume=True, frames=18)
    whole = wc.simulate(scene, solver, output=str(tmp_path / "whole.usdc"), device=device, frames=30)
    assert same(whole, wc.simulate(scene, solver, output=output, device=device, resume=True, frames=30))
    interrupted(scene, solver, output, 21, device=device)
    assert len(wc.simulate(scene, solver, output=output, device=device, resume=True, frames=19).points) == 20
    interrupted(scene, solver, output, 21, device=device)
    Path(output).unlink()
    assert len(wc.simulate(scene, solver, output=output, device=device, resume=True, frames=19).points) == 20


OTHERS = {
    "another scene": ({"scene": replace(moved(), gravity=(0.0, -1.0, 0.0))}, "had another scene; run as then"),
    "another option": ({"solver": wc.XPBD(substeps=1, iterations=3)}, r"had the solver XPBD\(.*iterations=4.*iterations=3"),
    "another solver": ({"solver": wc.Newton(substeps=1)}, r"had the solver XPBD\(.*, and this one has the solver Newton\("),
    "other values": ({"vary": {"gravity": [[0.0, -1.0, 0.0]]}}, "had other values of vary"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_another_run_is_refused(name, tmp_path, device):
    """And leaves what is there as it is, to be resumed or replaced."""
    given, said = {"scene": moved(), "solver": SOLVERS["xpbd"], "device": device}, OTHERS[name][1]
    output = str(tmp_path / "out.usdc")
    with pytest.raises(KeyboardInterrupt):
        wc.simulate(**given, output=output, progress=stop_at(STOP))
    with pytest.raises(ValueError, match=f"out.usdc: cannot be resumed, because the run that was interrupted {said}"):
        wc.simulate(**given | OTHERS[name][0], output=output, resume=True)
    assert len(FrameSequence(output)) == STOP + 1
    assert len(wc.simulate(**given, output=output, resume=True).points) == LAST + 1


FOREIGN = {
    "code": "another version of warpcloth or of Warp; run as then",
    "device": "the device Toaster 3, and this one has the device ",
}


@pytest.mark.parametrize("fact", FOREIGN)
def test_a_checkpoint_of_another_machine_is_refused(fact, tmp_path, device):
    """Which has another device or another version."""
    given = {"scene": moved(), "solver": SOLVERS["xpbd"], "device": device, "output": str(tmp_path / "out.usdc")}
    with pytest.raises(KeyboardInterrupt):
        wc.simulate(**given, progress=stop_at(STOP))
    (path,) = tmp_path.rglob("checkpoint.npz")
    checkpoint = Checkpoint.read(path)
    replace(checkpoint, facts=checkpoint.facts | {fact: "Toaster 3"}).write(path.parent)
    with pytest.raises(ValueError, match=f"the run that was interrupted had {FOREIGN[fact]}"):
        wc.simulate(**given, resume=True)


def test_the_precision_is_that_of_the_run_by_default(tmp_path, device):
    scene, solver, output = moved(), SOLVERS["xpbd"], str(tmp_path / "out.usdc")
    precisions = ("float64", "float32") if device == "cpu" else ("float32", "float64")
    interrupted(scene, solver, output, STOP, device=device)
    with pytest.raises(ValueError, match="had dtype {}, and this one has dtype {}; run as then".format(*precisions)):
        wc.simulate(scene, solver, output=output, device=device, dtype=precisions[1], resume=True)
    resumed = wc.simulate(scene, solver, output=output, device=device, dtype=precisions[0], resume=True)
    assert same(wc.simulate(scene, solver, output=str(tmp_path / "whole.usdc"), device=device), resumed)


def test_where_there_is_nothing_to_resume_that_is_said(tmp_path, device):
    scene, solver, output = moved(), SOLVERS["xpbd"], str(tmp_path / "out.usdc")
    nothing = "out.usdc: there is nothing to resume, for no run to it was interrupted after its first 10 frames; run without"
    with pytest.raises(ValueError, match="resume is given without output"):
        wc.simulate(scene, solver, device=device, resume=True)
    with pytest.raises(ValueError, match=nothing):
        wc.simulate(scene, solver, output=output, device=device, resume=True)
    interrupted(scene, solver, output, 5, device=device)
    with pytest.raises(ValueError, match=nothing):
        wc.simulate(scene, solver, output=output, device=device, resume=True)
    wc.simulate(scene, solver, output=output, device=device)
    with pytest.raises(ValueError, match=nothing):
        wc.simulate(scene, solver, output=output, device=device, resume=True)
    interrupted(scene, solver, output, STOP, device=device)
    (checkpoint,) = tmp_path.rglob("checkpoint.npz")
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"checkpoint\.npz: is no checkpoint that can be read"):
        wc.simulate(scene, solver, output=output, device=device, resume=True)


def test_a_checkpoint_with_any_damaged_byte_is_refused_or_whole(tmp_path):
    facts = {name: name for name in ("code", "scene")}
    written = Checkpoint(9, facts, [[0.0, "frames_000000.usdc"]], [0.0, 9.0], {"x": np.arange(3.0)}, {"0 seconds": np.ones(2)})
    written.write(tmp_path)
    (path,) = tmp_path.iterdir()
    data, refusals = path.read_bytes(), 0
    for k in range(len(data)):
        path.write_bytes(data[:k] + bytes([data[k] ^ 0x41]) + data[k + 1 :])
        try:
            read = Checkpoint.read(path)
        except ValueError as error:
            refusals += 1
            assert str(error) == f"{path}: is no checkpoint that can be read; run without resume to begin anew"
        else:  # dates, and what the central directory of the file repeats
            assert (read.frame, read.facts, read.chunks, read.span) == (9, facts, written.chunks, written.span)
            np.testing.assert_equal([read.state, read.watch], [written.state, written.watch])
    assert refusals > len(data) / 2


def test_a_run_diverges_where_it_would_have_and_is_over_then(tmp_path, device):
    scene, solver = hanging.scene(n=8), wc.XPBD(substeps=4, iterations=4, relaxation=1.85)
    whole = wc.simulate(scene, solver, output=str(tmp_path / "whole.usdc"), device=device)
    assert not whole.status.ok and whole.status.frame > STOP
    output = str(tmp_path / "out.usdc")
    interrupted(scene, solver, output, STOP, device=device)
    assert same(whole, wc.simulate(scene, solver, output=output, device=device, resume=True))
    with pytest.raises(ValueError, match="there is nothing to resume"):
        wc.simulate(scene, solver, output=output, device=device, resume=True)


# Steps that are far too long, on edges of 67 and 143 mm, and sweeps that gain energy and diverge after LAST.
LONG, GAINING = wc.XPBD(substeps=1, iterations=1), wc.XPBD(substeps=4, iterations=4, relaxation=1.85)


@pytest.mark.parametrize(
    ("given", "solver", "stop", "before"),
    [
        ({"n": 16}, LONG, STOP, True),
        ({"n": 5}, LONG, STOP, False),
        ({"n": 8, "stiffness": 1e4}, GAINING, LAST - 1, True),
        ({"n": 8, "stiffness": 1e4}, GAINING, STOP, False),
    ],
)
def test_a_resumed_run_has_the_same_grade(given, solver, stop, before, tmp_path, device):
    """With the same frame and figures in its message, whether it was usable at the last checkpoint or not."""
    scene, outputs = hanging.scene(**given, duration=LAST / 60.0), [str(tmp_path / f"{k}.usdc") for k in range(2)]
    whole = wc.simulate(scene, solver, output=outputs[0], device=device)
    assert whole.status.grade is Grade.NOT_USABLE and whole.status.complete and len(whole.points) == LAST + 1
    first = int(re.match(r"not usable: in frame (\d+) ", whole.status.message)[1])
    assert (first <= (stop + 1) // 10 * 10 - 1) == before  # frames are written by tens, the first one is the start
    interrupted(scene, solver, outputs[1], stop, device=device)
    assert same(whole, wc.simulate(scene, solver, output=outputs[1], device=device, resume=True))


@dataclass(frozen=True, kw_only=True)
class Opaque(wc.Spring):
    """A term with something that no digest is of."""

    what: object = object()


def test_a_scene_without_a_digest_runs_and_cannot_be_resumed(tmp_path, device):
    scene, solver, output = moved(), SOLVERS["xpbd"], str(tmp_path / "out.usdc")
    scene = replace(scene, terms=[Opaque(pairs="structural", stiffness=100.0)])
    interrupted(scene, solver, output, STOP, device=device)
    with pytest.raises(ValueError, match="there is nothing to resume"):
        wc.simulate(scene, solver, output=output, device=device, resume=True)


def test_limits_that_are_kept_may_be_checked_again(tmp_path, device):
    """The command line finds the largest stable step and checks it no more; Python may name that step."""
    scene, output = moved(), str(tmp_path / "out.usdc")
    interrupted(scene, wc.Explicit(substeps=4, above_limit="allow"), output, STOP, device=device)
    assert len(wc.simulate(scene, wc.Explicit(substeps=4), output=output, device=device, resume=True).points) == LAST + 1
