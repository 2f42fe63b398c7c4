"""The history of a run as files: energies and reactions at pins, frame by frame."""

import numpy as np

from ..base.outputs import TEXT, Output, check_apart, write_table
from ..base.texts import json_text
from .terminal import check_writable

EPILOG = """\
--csv and --report record energies [J] and the reaction forces of pins [N] in every frame. The table of --csv has the sum of the
reactions; the JSON of --report has the reaction of each pin. An unknown value is an empty cell in the table, and null in JSON.
"""


def record_of(arguments):
    """The words for what a run must record; refuses files that cannot be written."""
    files = [path for path in (arguments.csv, arguments.report) if path]
    check_apart([arguments.output, arguments.film, *files])
    check_writable(*files)
    for path in files:
        Output(path, "x").discard()
    return ("energies", "reactions") if files else ()


def write_history(arguments, scene, animation):
    """Writes the table and the report of a run that recorded both."""
    energies, reactions = animation.energies, animation.reactions
    if arguments.csv:
        columns = ["frame", "time", *energies, *(f"reaction {axis}" for axis in "xyz")]
        numbers = np.column_stack([animation.times, *energies.values(), reactions.sum(axis=1)])
        write_table(arguments.csv, columns, ([frame, *row] for frame, row in enumerate(_known(numbers))))
    if arguments.report:
        found = {"scene": scene.name, "times": _known(animation.times), "pins": scene.pins.vertices.tolist()}
        found |= {"energies": {name: _known(values) for name, values in energies.items()}, "reactions": _known(reactions)}
        with Output(arguments.report, "x", **TEXT) as output:
            output.file.write(json_text(found) + "\n")


def _known(values):
    """Numbers as lists, None in place of NaN."""
    return np.where(np.isnan(values), None, values).tolist()
