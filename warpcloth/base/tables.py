"""Reads tables from CSV files, and checks the names of JSON objects."""

import csv

from .checks import shown
from .types import FilePath


def read_table(path: FilePath) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Returns the names of the columns of a CSV file, and its rows with the numbers of their lines, all stripped.

    Empty lines are left out.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is not text, has no rows, has a column without a name or two of one name, or a row has another length.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        try:
            lines = [(reader.line_num, [each.strip() for each in row]) for row in reader if any(map(str.strip, row))]
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: is no CSV file, {error}") from None
    if len(lines) < 2:
        raise ValueError(f"{path}: has no rows; it must have a line of names and a row below it")
    names = lines[0][1]
    for name in names:
        if not name or names.count(name) > 1:
            raise ValueError(f"{path}: has {names.count(name)} columns named {name!r}; each column must have a name of its own")
    for line, row in lines[1:]:
        if len(row) != len(names):
            raise ValueError(f"{path}, line {line}: has {len(row)} values; it must have {len(names)}, one for each column")
    return names, lines[1:]


def number_in(path: FilePath, line: int, name: str, text: str) -> float:
    """Returns a number of a table.

    Raises:
        ValueError: The text is no number.
    """
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}, line {line}: {name} is {shown(text)}; it must be a number") from None


def distinct(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Returns a JSON object, for ``object_pairs_hook`` of `json.loads`.

    Raises:
        ValueError: Two values have one name; `json` would keep the last.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{shown(twice)} occurs twice in one JSON object; each name must occur once")
    return found
