"""Python prints no more than the command line, unless it is asked to, and results have a short repr."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.scenes import hanging

ROOT = Path(__file__).parents[2]
RUN = """
import numpy as np
import warp as wp
{before}
import warpcloth as wc
from warpcloth.scenes import hanging
{after}
wc.svd(np.eye(3))
wc.simulate(hanging.scene(n=3, duration=0.1), wc.Explicit(substeps=64), output={output!r})
"""


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("", "", False),
        *(
            pytest.param(*row, marks=pytest.mark.slow)
            for row in (
                ("", "wp.config.log_level = wp.LOG_INFO", True),
                ("wp.config.log_level = wp.LOG_DEBUG", "", True),
                ("wp.config.log_level = wp.LOG_ERROR", "assert wp.config.log_level == wp.LOG_ERROR", False),
            )
        ),
    ],
)
def test_python_is_quiet_unless_asked(tmp_path, before, after, said):
    code = RUN.format(before=before, after=after, output=str(tmp_path / "o.usdc"))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert ("Warp 1." in done.stdout and "Module " in done.stdout) == said
    assert said or (done.stdout, done.stderr) == ("", "")


def test_an_animation_is_one_line(tmp_path):
    scene, path = hanging.scene(n=3, duration=0.1), str(tmp_path / "o.usdc")
    explicit = wc.Explicit(substeps=64)
    assert repr(wc.simulate(scene, explicit)) == "Animation(7 frames of 9 vertices, 0.1 s, completed)"
    assert repr(wc.simulate(scene, explicit, copies=2)) == "Animation(7 frames of 2 copies of 9 vertices, 0.1 s, completed)"
    assert repr(wc.simulate(scene, explicit, output=path)) == f"Animation(7 frames of 9 vertices, 0.1 s, completed, in {path})"


def test_a_deformation_is_one_line():
    mesh = wc.Mesh.grid(3, 3)
    pins = wc.Pins([0, 8], np.array([mesh.points[[0, 8]]] * 2))
    assert repr(wc.deform(mesh, pins, fps=24.0)) == "Deformation(2 frames of 9 vertices, 0.0416667 s, converged)"


def test_dir_shows_the_public_names():
    assert dir(wc) == sorted(wc.__all__)
    assert all(hasattr(wc, name) for name in wc.__all__)
