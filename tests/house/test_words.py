"""Words: docstrings say what a thing is or does, and no name is made of a word that the field has a better one for."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATHS = sorted(
    path.relative_to(ROOT).as_posix()
    for room in ("warpcloth", "kernels")
    for path in (ROOT / room).rglob("*.py")
    if path.relative_to(ROOT).parts[1] not in ("kernels", "scenes")  # the links
)
OPENINGS = re.compile(r"(What|The same)\b")
# Words that no name contains, with what it says instead.
INSTEAD = {
    "place": "position, index, path …",
    "places": "positions, indices …",
    "team": "thread_pool",
    "fronts": "pareto",
    "rules": "limits",
    "fits": "neighbourhood_fit",
    "splitting": "admm",
    "taut": "at_limit",
    "slack": "dead_zone",
    "reach": "max_length",
}
# "In place" is the field's.
ALLOWED = {"in_place", "correct_in_place", "launch_in_place", "refuse_in_place"}


# Constants say what they bound.
BARE = re.compile(r"_?(MOST|LEAST|WAY|ALIKE|LARGEST|SMALLEST)(_|$)")


def words(name):
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().strip("_").split("_")


@cache
def read(path):
    """Of a file the docstrings, with the names of what they are of, and all names."""
    docstrings, names = [], set()
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
            docstrings.append((getattr(node, "name", "module"), ast.get_docstring(node) or ""))
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
    return docstrings, names


def test_docstrings_open_with_a_statement():
    wrong = [
        f"{path}: {name}: {text.splitlines()[0]}" for path in PATHS for name, text in read(path)[0] if OPENINGS.match(text)
    ]
    assert not wrong, "\n".join(wrong)


def test_names_are_words_of_the_field():
    wrong = [
        f"{path}: {name}: {word} should be {INSTEAD[word]}"
        for path in PATHS
        for name in sorted(read(path)[1])
        if name.lower().strip("_") not in ALLOWED
        for word in INSTEAD.keys() & set(words(name))
    ]
    assert not wrong, "\n".join(wrong)


def test_constants_say_what_they_bound():
    wrong = [f"{path}: {name}" for path in PATHS for name in sorted(read(path)[1]) if BARE.match(name)]
    assert not wrong, "a bound is MAX_ or MIN_ of a value, not\n" + "\n".join(wrong)
