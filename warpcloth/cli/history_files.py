"""The history of a run as files: energies and forces at pins and colliders, frame by frame."""

import numpy as np

from ..base.outputs import TEXT, Output, check_apart, check_replaceable, write_table
from ..base.texts import json_text
from .terminal import check_writable

EPILOG = """\
--csv and --report record energies [J], the reaction forces of pins and the forces of the cloth on each collider [N] in every
frame. The table of --csv has the sum of the reactions; the JSON of --report has the reaction of each pin. With self-contact or
mesh colliders, both have the numbers of pairs in contact, of pairs listed and of new lists, the fraction of moves kept, and the
least gap [m].
An unknown value is an empty cell in the table, and null in JSON.
"""


def record_of(arguments, scene):
    """Returns the words of ``record`` for a run of a scene, and checks that the files can be written."""
    files = [path for path in (arguments.csv, arguments.report) if path]
    check_apart([arguments.output, arguments.film, *files])
    check_writable(*files)
    check_replaceable(*files)
    return ("energies", "reactions", *["pairs"] * scene.has_pairs) if files else ()


def write_history(arguments, scene, animation):
    """Writes the table and the report of a run, those that are asked for."""
    energies, reactions, forces = animation.energies, animation.reactions, animation.collider_forces or {}
    pairs = animation.pairs or {}
    if arguments.csv:
        vectors = {"reaction": reactions.sum(axis=1), **{f"force on {name}": values for name, values in forces.items()}}
        vectors |= {f"friction on {name}": values for name, values in (animation.friction_forces or {}).items()}
        columns = ["frame", "time", *energies, *(f"{name} {axis}" for name in vectors for axis in "xyz")]
        numbers = [animation.times, *energies.values(), *vectors.values()]
        if animation.cuts is not None:
            columns, numbers = [*columns, "cut short"], [*numbers, animation.cuts]
        columns, numbers = [*columns, *pairs], [*numbers, *pairs.values()]
        rows = _known(np.column_stack(numbers))
        write_table(arguments.csv, columns, ([frame, *row] for frame, row in enumerate(rows)))
    if arguments.report:
        found = {"scene": scene.name, "times": _known(animation.times), "pins": scene.pins.vertices.tolist()}
        found |= {"energies": _by_name(energies), "reactions": _known(reactions)}
        if forces:
            found |= {"collider_forces": _by_name(forces), "friction_forces": _by_name(animation.friction_forces)}
        if animation.cuts is not None:
            found["cuts"] = _known(animation.cuts)
        if pairs:
            found["pairs"] = _by_name(pairs)
        with Output(arguments.report, "x", **TEXT) as output:
            output.file.write(json_text(found) + "\n")


def _by_name(found):
    return {name: _known(values) for name, values in found.items()}


def _known(values):
    """Returns numbers as lists, with None for those that are not finite."""
    return np.where(np.isfinite(values), values, None).tolist()
