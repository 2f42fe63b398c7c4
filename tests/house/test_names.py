"""Names of the package: no two modules, classes or public functions of one name mean different things."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("warpcloth", "kernels", "scenes")
# Modules that share a name because one does what the other is about, and why. Those of kernels/ are the kernels of a module.
MODULES = {
    "compare": "the command of warpcloth.analysis.compare",
    "deform": "the command of warpcloth.deformation.deform",
    "fit": "the command of warpcloth.run.fit",
    "render": "the command of warpcloth.picture.render",
    "stability": "the command of warpcloth.lab.stability",
    "distances": "the pictures of warpcloth.mesh.distances",
    "failures": "the pictures of warpcloth.lab.failures",
    "panels": "the pictures of warpcloth.lab.panels",
    "cheapest": "the pictures of warpcloth.lab.cheapest",
    "measures": "what writes warpcloth.analysis.measures into a stage",
    "loads": "the arrays on a device of what warpcloth.terms.loads declares",
    "colliders": "what reads warpcloth.scene.colliders from a stage",
    "scene": "what reads and writes warpcloth.scene.scene as a stage",
}
# Classes and functions that mean one thing in several modules, and why.
NAMES = {
    "add_arguments": "each command declares its own",
    "analyze compare convert deform choose fit render view resample": "the command and what it calls",
    "measure tasks": "each file of the laboratory has its measurement and the list of them; a term has its rest measure",
    "write_csv": "each table has one",
    "run": "runs what it is given",
    "register": "adds a record to the catalogue of its room",
    "constant_blocks": "the launch of the kernel",
    "open_sequence": "reads any sequence, and one of a stage",
    "vertex_normals turned": "on the host and on the device",
    "scene": "each file of scenes/ has its own",
    "engine refuse_inexpressible calibrate": "each other simulator has its own",
    "energy": "of a term, and its kernel",
}
# Where the functions of terms are, whose names are given.
TERMS = ("kernels/terms/", "kernels/membrane.py", "kernels/fast/quadratic_pair.py")


@cache
def defined():
    """Where each module (no package), and each public class and function of a module is, {name: {path}}."""
    modules, names = defaultdict(set), defaultdict(set)
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        inside = path.relative_to(ROOT).as_posix()
        if inside.startswith(("warpcloth/kernels/", "warpcloth/scenes/")):
            continue  # links to the rooms
        if not path.stem.startswith("__"):
            modules[path.stem].add(inside)
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                names[node.name].add(inside)
    return modules, names


def shared(places):
    return {name: sorted(where) for name, where in places.items() if len(where) > 1}


def test_modules_of_one_name_are_of_one_matter():
    for name, where in shared(defined()[0]).items():
        host = [path for path in where if not path.startswith("kernels/")]
        if (len(host) < 2 and len(where) == 2) or name in MODULES:
            continue
        pytest.fail(f"{where} are of one name; rename one, or say in this file why they mean one thing")


def test_classes_and_functions_of_one_name_mean_one_thing():
    allowed = {name for names in NAMES for name in names.split()}
    for name, where in shared(defined()[1]).items():
        terms = [path for path in where if path.startswith(TERMS)]
        if len(where) - len(terms) + bool(terms) > 1 and name not in allowed:
            pytest.fail(f"{name} is defined in {where}; rename one, or say in this file why they mean one thing")


def test_what_is_allowed_is_there():
    modules, names = map(shared, defined())
    assert set(MODULES) <= set(modules)
    assert {name for group in NAMES for name in group.split()} <= set(names)
