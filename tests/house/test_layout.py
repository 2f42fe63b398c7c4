"""Where tests are: in folders that mirror the rooms, each file for itself. What a test that is expected to fail must say."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]
# Beside the packages: what several tests share, and tests of the checkout, of its pages and of its scenes.
OTHERS = {"support", "house", "docs", "scenes"}


def test_folders_mirror_the_packages():
    packages = {path.parent.name for path in (TESTS.parent / "warpcloth").glob("*/__init__.py")}
    folders = {path.parent.name for path in TESTS.rglob("*.py") if path.parent != TESTS}
    assert folders <= packages | OTHERS
    assert [path.name for path in TESTS.glob("*.py")] == ["conftest.py"]


def test_no_test_file_imports_another():
    """Code that several test files share is in tests/support. pytest finds files by their names, so no two have the same."""
    files = [path for path in TESTS.rglob("test_*.py")]
    names = {path.stem for path in files}
    assert len(names) == len(files)
    for path in TESTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            imported = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imported += [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            assert not names & {part for name in imported for part in name.split(".")}, path


def test_expected_failures_name_their_exception_and_reason():
    """Any other exception is a failure. So is a test that passes: pyproject.toml makes xfail strict, and no mark undoes it."""
    for path in TESTS.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        nodes = list(ast.walk(ast.parse(text))) if "xfail" in text else []
        marks = [node for node in nodes if isinstance(node, ast.Attribute) and node.attr == "xfail"]
        calls = [node for node in nodes if isinstance(node, ast.Call) and node.func in marks]
        assert len(calls) == len(marks), f"{path}: a mark xfail without arguments"
        for call in calls:
            assert ast.unparse(call.func) == "pytest.mark.xfail", f"{path}:{call.lineno} hides what comes after it"
            named = {keyword.arg for keyword in call.keywords}
            assert {"raises", "reason"} <= named and "strict" not in named, f"{path}:{call.lineno}"
