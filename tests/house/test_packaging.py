"""The package as others install it: a wheel from the source tree and one from the source archive, in an empty environment."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# What lies in a checkout that is no part of the source.
NO_SOURCE = (".*", "build", "dist", "*.egg-info", "__pycache__", "node_modules")

pytestmark = pytest.mark.slow

RUN = """
import importlib.metadata, json
import warpcloth as wc
from warpcloth import kernels
from warpcloth.scenes import hanging
animation = wc.simulate(hanging.scene(n=4), wc.Newton(dt=1/240), frames=1)
print(json.dumps({
    "package": wc.__file__,
    "kernels": kernels.__file__,
    "version": importlib.metadata.version("warpcloth"),
    "ok": animation.status.ok,
    "lowest": float(animation.points[-1, :, 1].min()),
}))
"""


def run(*command, **options):
    """Standard output of a command that must end well."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=600, **options)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def build(tree, what, out):
    run(sys.executable, "-m", "build", "--no-isolation", what, "--outdir", out, tree)
    (made,) = out.iterdir()
    return made


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the source, so that nothing that an earlier build left in the checkout gets into this one."""
    copy = tmp_path_factory.mktemp("source") / "warpcloth"
    shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(*NO_SOURCE))
    return copy


@pytest.fixture(scope="module")
def archive(tree, tmp_path_factory):
    return build(tree, "--sdist", tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(archive, tmp_path_factory):
    """The wheel that is made from the source archive."""
    unpacked = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(archive) as packed:
        packed.extractall(unpacked, filter="data")
    (source,) = unpacked.iterdir()
    return build(source, "--wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """A new environment with the wheel; its dependencies are the ones of this environment, without its warpcloth."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    run(sys.executable, "-m", "pip", "--python", folder / "bin" / "python", "install", "--no-index", "--no-deps", wheel)
    (packages,) = folder.glob("lib/python*/site-packages")
    # The .pth files there, and so an editable warpcloth, are not read; warpcloth itself comes after the wheel's.
    others = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "others.pth").write_text("".join(f"{path}\n" for path in sorted(others)))
    return folder


@pytest.fixture
def bare():
    """Environment variables by which nothing of the checkout is found."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")}


def test_a_wheel_has_all_files_and_no_others(wheel):
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
    expected = set()
    for folder, inside in (("warpcloth", "warpcloth"), ("kernels", "warpcloth/kernels"), ("scenes", "warpcloth/scenes")):
        paths = (path.relative_to(ROOT / folder) for path in (ROOT / folder).rglob("*.py"))
        # The links in warpcloth/ to the other two are not followed by every Python.
        expected |= {f"{inside}/{path}" for path in paths if path.parts[0] not in ("kernels", "scenes")}
    assert {"warpcloth/kernels/assemble.py", "warpcloth/kernels/terms/spring.py", "warpcloth/scenes/hanging.py"} <= expected
    expected |= {"warpcloth/py.typed", "warpcloth/scenes/character.usda"}
    expected |= {f"warpcloth/picture/viewer/{name}" for name in ("page.html", "viewer.js", "three.LICENSE")}
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert [name for name in names if name.endswith("/LICENSE")]


def test_the_tree_and_its_archive_make_the_same_wheel(wheel, tree, tmp_path):
    found = []
    for path in (wheel, build(tree, "--wheel", tmp_path / "wheel")):
        with zipfile.ZipFile(path) as packed:
            found.append({name: packed.read(name) for name in packed.namelist()})
    assert found[0] == found[1]


def test_an_archive_has_its_tests_and_pictures(archive):
    with tarfile.open(archive) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    there = [path for folder in ("tests", "docs") for path in (ROOT / folder).rglob("*") if path.is_file()]
    wanted = {str(path.relative_to(ROOT)) for path in there if "__pycache__" not in path.parts}
    assert wanted | {"LICENSE", "CHANGELOG.md", "README.md"} <= names


def test_an_installed_wheel_runs_its_kernels(environment, bare, tmp_path):
    facts = json.loads(run(environment / "bin" / "python", "-c", RUN, cwd=tmp_path, env=bare).splitlines()[-1])
    for module in ("package", "kernels"):
        assert Path(facts[module]).resolve().is_relative_to(environment.resolve()), facts
    assert facts["ok"] and facts["lowest"] < 0.0


def test_an_installed_command_runs_a_scene(environment, bare, tmp_path):
    command = environment / "bin" / "warpcloth"
    listed = run(command, "scenes", cwd=tmp_path, env=bare)
    assert all(path.stem in listed for path in (ROOT / "scenes").glob("*.py")) and str(environment.resolve()) in listed
    said = run(command, "run", "hanging", "-p", "n=4", "--frames", 1, "-o", "out.usdc", "--json", cwd=tmp_path, env=bare)
    assert json.loads(said)["frames"] == 1 and (tmp_path / "out.usdc").is_file()
