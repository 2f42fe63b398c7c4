"""Signatures of kernels: parameters in groups that comments name, in one order, and not more than a dozen of them."""

import ast
import re
from pathlib import Path

KERNELS = Path(__file__).parents[2] / "kernels"
# Elements are what a model fixes when it is built; parameters are numbers, and which copies or vertices take part.
GROUPS = ("elements", "state in", "parameters", "in and out", "out")
MAX_PARAMETERS = 12


def faults(path):
    """Returns the faults in the signatures of the kernels of a file, a sentence each."""
    text = path.read_text(encoding="utf-8")
    lines, found = text.splitlines(), []
    for function in ast.walk(ast.parse(text)):
        if not isinstance(function, ast.FunctionDef) or not any("wp.kernel" in ast.unparse(d) for d in function.decorator_list):
            continue
        arguments, groups = function.args.args, []
        for argument in arguments:
            comment = re.fullmatch(r"\s*# (.+)", lines[argument.lineno - 2])
            if comment:  # a group may say more after a comma
                groups.append(comment[1].partition(",")[0])
            elif not groups:
                found.append(f"{function.name}: {argument.arg} is in no group")
        if groups != [group for group in GROUPS if group in groups]:
            found.append(f"{function.name}: the groups are {groups}; they must be of {GROUPS}, in this order")
        if len(arguments) > MAX_PARAMETERS:
            found.append(f"{function.name}: {len(arguments)} parameters; at most {MAX_PARAMETERS}, a struct can hold some")
    return found


def test_parameters_are_grouped():
    found = {path.relative_to(KERNELS).as_posix(): faults(path) for path in sorted(KERNELS.rglob("*.py"))}
    assert not any(found.values()), {name: each for name, each in found.items() if each}
