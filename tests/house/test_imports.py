"""Imports stay light, and none is deferred to hide one that points upwards.

A package may have a table of names of its own modules, which are imported when a name is first used. Modules of other packages
import the package, at their top, and take a name from it where they need it.
"""

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import warpcloth
from warpcloth import solvers, terms

PACKAGE = Path(warpcloth.__file__).parent
HEAVY = {"warp", "scipy", "trimesh", "matplotlib", "pxr", "tqdm", "PIL", "av"}
# The command line imports what loads Warp where it is used; the package passes its names on when one is first used.
DEFERRED = ("cli/", "__init__.py")
# Answers of the command line in a process that cannot import Warp.
WITHOUT_WARP = """
import json, sys
sys.modules["warp"] = None
import warpcloth
from warpcloth.cli import main
codes = {" ".join(words): main(words) for words in json.loads(sys.argv[1])}
print(json.dumps([codes, sorted(name for name in %s if sys.modules.get(name))]), file=sys.stderr)
"""


def commands():
    """The words of each command, those of charts by themselves."""
    from warpcloth.cli import _parser

    def below(parser, words):
        found = [action.choices for action in parser._actions if isinstance(action.choices, dict) and action.nargs == "A..."]
        yield words
        for choices in found:
            for name, command in choices.items():
                yield from below(command, [*words, name])

    return list(below(_parser(), []))


def test_help_needs_no_warp():
    asked = [[*words, "--help"] for words in commands()]
    assert len(asked) > 12 and ["chart", "stability", "--help"] in asked
    code = WITHOUT_WARP % sorted(HEAVY)
    done = subprocess.run([sys.executable, "-c", code, json.dumps([*asked, ["--version"]])], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    codes, loaded = json.loads(done.stderr)
    assert not loaded and set(codes.values()) == {0}
    assert "constrained-dynamics" in done.stdout and done.stdout.count("usage: warpcloth") == len(asked)


def test_no_own_import_is_deferred():
    found = set()
    for path in PACKAGE.rglob("*.py"):
        tree, name = ast.parse(path.read_bytes()), path.relative_to(PACKAGE).as_posix()
        checked = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
        at_once = {id(node) for node in (*tree.body, *(inner for each in checked for inner in each.body))}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                own = node.level > 0 or (node.module or "").startswith("warpcloth")
            else:
                own = isinstance(node, ast.Import) and any(each.name.startswith("warpcloth") for each in node.names)
            if own and id(node) not in at_once:
                found.add(name)
    assert {name for name in found if not name.startswith(DEFERRED)} == set()


def test_names_imported_on_use_are_those_of_modules_of_the_package():
    """Only the table makes imports by name, so that none can point upwards."""
    users = set()
    for path in PACKAGE.rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Call)]
        if any(ast.unparse(call.func).endswith(("import_module", "__import__")) for call in calls):
            users.add(path.relative_to(PACKAGE).as_posix())
    others = {"base/extensions.py", "lab/measurements.py", "usd/modules.py"}  # of extensions, of lab itself, of pxr
    assert users == {"__init__.py", "base/catalogue.py"} | others
    for name in ("contact", "fast", "model", "solvers", "terms", "usd"):
        package = importlib.import_module(f"warpcloth.{name}")
        modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
        assert set(package._MODULES.values()) <= modules
        assert all(hasattr(package, name) for name in package._MODULES)


def test_names_come_when_they_are_used():
    code = f"""
import json, sys
import warpcloth as wc
before = [name for name in {sorted(HEAVY)} if name in sys.modules]
names = dir(wc)
from warpcloth import *
missing = [name for name in names if name not in globals()]
late = [name for name in ("pxr.Usd", "scipy") if name in sys.modules]
print(json.dumps([before, missing, "warp" in sys.modules, late, wc.solvers.SOLVERS["newton"] is Newton]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [[], [], True, [], True]
    assert set(warpcloth.solvers.__all__) | set(warpcloth.terms.__all__) < set(warpcloth.__all__)


def test_a_name_loads_no_more_than_its_module_needs():
    own = "{name.split('.')[1] for name in sys.modules if name.startswith('warpcloth.')}"
    code = f"import sys, warpcloth as wc; wc.Scene; print(*{own})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"base", "kernels", "mesh", "model", "scene", "terms", "usd"}


@pytest.mark.parametrize("solver", ["Explicit(substeps=100)", "XPBD(substeps=2)"])
def test_a_scene_imports_no_module_that_it_does_not_name(solver):
    code = f"""
import sys
import warpcloth as wc
scene = wc.Scene(wc.Mesh.grid(4, 4), density=0.1, terms=[wc.Spring(stiffness=1e3)], pins=[0, 3])
assert wc.simulate(scene, wc.{solver}, frames=2).status.ok
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    own = {name.removeprefix("warpcloth.") for name in done.stdout.split() if name.startswith("warpcloth.")}
    assert own >= {"run.simulate", "terms.spring", "kernels.terms.spring", "contact", "usd"}
    assert not {name for name in own if name.startswith(("contact.", "kernels.contact.", "usd."))}
    energies = {f"terms.{module}" for module in terms._MODULES.values()} - {"terms.spring"}
    # Kernels of energies with one vertex share a function with those of attachments.
    energies |= {f"kernels.{name}" for name in energies - {"terms.attachment"}}
    methods = {f"solvers.{solvers._MODULES[name]}" for name in solvers.__all__ if not solver.startswith(name)}
    assert not own & (energies | methods)


def test_type_checkers_see_the_names_that_are_imported():
    """The table of names stands twice in the package, for Python and for what reads it without running it."""
    body = ast.parse((PACKAGE / "__init__.py").read_bytes()).body
    (checked,) = [node.body for node in body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    found = [(node.module, name.name) for node in checked for name in node.names if name.asname == name.name]
    rows = [(module, name) for name, module in warpcloth._MODULES.items()]
    for room in warpcloth._CATALOGUES:
        catalogue = importlib.import_module(f"warpcloth.{room}")
        rows += [(f"{room}.{catalogue._MODULES[name]}", name) for name in catalogue.__all__]
    assert sorted(found) == sorted(rows)
