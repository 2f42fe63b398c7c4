"""The energy of docs/extending.md, one file outside the package, through all that takes one; identities in test_terms.py."""

import sys
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import refused, run
from support.outside import FILES, Plane
from support.rows import table
from support.steps import after_steps, newton_step
from warpcloth import terms
from warpcloth.base import extensions
from warpcloth.solvers import SOLVERS
from warpcloth.terms.declared import Declared, indices, quantity
from warpcloth.usd import read_scene, write_scene
from warpcloth.usd.attributes import attributes

NORMAL = np.array([1.0, 2.0, 2.0]) / 3.0
# A scene in a file that defines the energy too.
FILE = (
    FILES["plane.py"]
    + """

def scene(n: int = 6):
    mesh = wc.Mesh.grid(n, n, size=0.5)
    plane = Plane(vertices="boundary", stiffness=300.0, normal=(1.0, 2.0, 2.0))
    return wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=50.0), plane], pins=[0], duration=0.1)
"""
)


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """Later tests of the process do not take for an extension what a test registers."""
    monkeypatch.setattr(extensions, "_names", set())
    monkeypatch.setattr(extensions, "_files", set())


@pytest.fixture
def registered():
    terms.register(Plane)
    yield
    del terms.TERMS["Plane"]


def sheet(**fields):
    mesh = wc.Mesh.grid(6, 5, size=0.5)
    start = mesh.points + np.random.default_rng(3).normal(scale=0.01, size=mesh.points.shape)
    plane = Plane(vertices="boundary", stiffness=300.0, normal=NORMAL)
    energies = [wc.Spring(stiffness=50.0), plane]
    return wc.Scene(mesh, density=0.1, terms=energies, positions=start, pins=[0], **fields)


ITERATED = {
    "newton": {"tolerance": 1e-10},
    "projective-dynamics": {"tolerance": 1e-11, "iterations": 3000},
    "admm": {"tolerance": 1e-11, "iterations": 3000, "weight": 1.0},
    "xpbd": {"iterations": 3000},
    "constrained-dynamics": {"tolerance": 1e-10, "iterations": 3000},
}


@table("name", list(ITERATED)[:1], ITERATED)
def test_solvers_that_minimise_meet(name, device):
    solver = SOLVERS[name](substeps=1, **ITERATED[name])
    x, _ = after_steps(sheet(), solver, device)
    assert np.abs(x - newton_step(sheet(), device)).max() < 1e-8


@pytest.mark.parametrize("name", sorted(set(SOLVERS) - set(ITERATED)))
def test_the_others_keep_to_the_plane(name, device):
    """Stiff, at the boundary: from 1 cm on; falling for 0.1 s is 5 cm."""
    declared = sheet(duration=0.1)
    animation = wc.simulate(declared, SOLVERS[name](substeps=64), device=device)
    found = declared.mesh.select("boundary")
    distance = (animation.points[-1] - declared.mesh.points)[found] @ NORMAL
    assert animation.status.ok and np.abs(distance).max() < 0.02


def test_it_varies_between_copies(device):
    normals = np.array([NORMAL, [0.0, 1.0, 0.0]])
    both = sheet().build(
        device=device, dtype="float64", copies=2, vary={"Plane.normal": normals, "Plane.stiffness": [1.0, 2.0]}
    )
    rest = both.terms[1].rest.numpy().reshape(2, -1, 4)
    assert np.allclose(rest[:, :, :3], normals[:, None])


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_a_stage_holds_it(tmp_path, ending):
    declared = sheet()
    normals = np.random.default_rng(4).normal(size=(len(declared.terms[1].stencil(declared.mesh)), 3))
    every = replace(declared.terms[1], normal=normals, name="by vertex")
    read = read_scene(write_scene(replace(declared, terms=[*declared.terms, every]), tmp_path / f"plane.{ending}"))
    for given, found in zip([*declared.terms, every], read.terms, strict=True):
        assert type(found) is type(given) and found.name == given.name
        assert found.elements(declared.mesh, None).rest.tolist() == given.elements(declared.mesh, None).rest.tolist()
    assert read.terms[1].vertices == "boundary" and read.terms[1].normal.shape == (3,)


def test_a_stage_with_an_unknown_energy_is_refused(tmp_path):
    terms.register(Plane)
    path = write_scene(sheet(), tmp_path / "plane.usda")
    del terms.TERMS["Plane"]
    with pytest.raises(ValueError, match=r"terms:Plane:type is 'Plane', must be one of .*is imported \(--import\)"):
        read_scene(path)


def test_a_scene_file_runs_on_the_command_line(tmp_path, capfd):
    file = tmp_path / "slope.py"
    file.write_text(FILE, encoding="utf-8")
    assert run(capfd, "run", file, "--solver", "xpbd", "-o", tmp_path / "slope.usdc")[0] == 0
    assert "Plane" in run(capfd, "info", file)[1] and len(wc.open_sequence(tmp_path / "slope.usdc").labels) == 7
    del terms.TERMS["Plane"]


@pytest.fixture
def stage(tmp_path):
    """A stage with the energy, and the file that defines it, which nothing has imported."""
    terms.register(Plane)
    path = write_scene(sheet(duration=0.1), tmp_path / "slope.usda")
    del terms.TERMS["Plane"]
    file = tmp_path / "plane.py"
    file.write_text(FILES["plane.py"], encoding="utf-8")
    yield path, "--import", file
    terms.TERMS.pop("Plane", None)
    sys.modules.pop("plane", None)


def test_the_command_line_imports_it_for_a_stage(stage, tmp_path, capfd):
    refused(capfd, ["info", stage[0]], "must be one of")
    assert "Plane" in run(capfd, "info", *stage)[1]
    assert run(capfd, "run", *stage, "--frames", 2, "-o", tmp_path / "moved.usdc")[0] == 0


def test_a_membrane_is_a_material_by_its_name(tmp_path, capfd):
    @dataclass(frozen=True, kw_only=True)
    class Silk(wc.StVKMembrane):
        material = "silk"

    cloth, table = tmp_path / "cloth.usdc", tmp_path / "table.csv"
    wc.simulate(sheet(), wc.XPBD(substeps=4), output=cloth, frames=2)
    options = ["--measure", "energy_density", "--stiffness", "10", "--poisson", "0.2", "--csv", table, "--material"]
    refused(capfd, ["analyze", cloth, *options, "silk"], "must be one of 'corotated', 'neo-hookean', 'stvk'")
    terms.register(Silk)
    found = []
    for name in ("silk", "stvk"):
        assert run(capfd, "analyze", cloth, *options, name)[0] == 0
        found.append(table.read_text(encoding="utf-8"))
    del terms.TERMS["Silk"]
    assert found[0] == found[1] and "energy_density" in found[0]


def test_what_is_no_energy_is_not_registered():
    @dataclass(frozen=True, kw_only=True)
    class Spring(Declared):
        term = Plane.term

    with pytest.raises(ValueError, match="Spring is the name of an energy of warpcloth"):
        terms.register(Spring)
    with pytest.raises(ValueError, match="must be a class with a term that derives from"):
        terms.register(Plane(stiffness=1.0))
    with pytest.raises(ValueError, match="must be a class with a term that derives from"):
        terms.register(Declared)
    assert terms.register(terms.Spring) is terms.TERMS["Spring"]


@dataclass(frozen=True, kw_only=True)
class Wide(Plane):
    """It has fields of shapes for which USD has a type, and for which it has none."""

    pair: tuple = field(default=(0.0, 1.0), metadata=quantity("must be finite", np.isfinite, shape=(2,)))
    table: tuple = field(default=((0.0,) * 5,), metadata=quantity("must be finite", np.isfinite, shape=(1, 5)))
    six: np.ndarray | None = field(default=None, metadata=indices(each=6))


def test_a_field_without_a_type_in_usd_keeps_no_stage_from_being_read(tmp_path):
    terms.register(Wide)
    try:
        other = replace(sheet(), terms=[wc.Spring(stiffness=50.0)])
        assert len(read_scene(write_scene(other, tmp_path / "other.usda")).terms) == 1
        names = {row.name.split(":")[-1] for row in attributes()}
        assert "pair" in names and not {"table", "six"} & names
    finally:
        del terms.TERMS["Wide"]


@pytest.mark.parametrize(
    ("method", "found", "message"),
    [
        ("stencil", np.array([[0, 1]]), r"stencil has shape \(1, 2\) .* must be 1 of the 30 vertices for each element"),
        ("stencil", np.array([[30]]), "stencil has .* vertices 30 to 30; it must be 1 of the 30 vertices"),
        ("stencil", np.array([[-1]]), "stencil has .* vertices -1 to -1; it must be 1 of the 30 vertices"),
        ("rest", np.zeros((18, 3)), r"rest state has shape \(18, 3\); it must be \(…, 4\)"),
    ],
)
def test_elements_that_are_none_of_its_term_are_refused(method, found, message):
    wrong = type("Wrong", (Plane,), {method: lambda *_: found})
    with pytest.raises(ValueError, match=f"Wrong: the {message}"):
        replace(sheet(), terms=[wrong(vertices="boundary", stiffness=1.0)]).build()
