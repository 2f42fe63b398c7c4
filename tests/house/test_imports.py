"""Imports stay light, and none is deferred to hide one that points upwards."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import warpcloth

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


def test_type_checkers_see_the_names_that_are_imported():
    """The table of names stands twice in the package, for Python and for what reads it without running it."""
    body = ast.parse((PACKAGE / "__init__.py").read_bytes()).body
    (checked,) = [node.body for node in body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    found = [(node.module, name.name) for node in checked for name in node.names if name.asname == name.name]
    assert found == [(module, name) for name, module in warpcloth._MODULES.items()]
    assert [(node.module, name.name) for node in checked for name in node.names if not name.asname] == [
        (catalogue, "*") for catalogue in warpcloth._CATALOGUES
    ]
