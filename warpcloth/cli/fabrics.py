"""The command ``fabrics``: lists measured fabrics."""

from pathlib import Path

from .terminal import aligned

TEXT = "List measured fabrics, their moduli, bending lengths and sources."
_DRAPE = """\
* computed, not measured: D as E·t³/12(1 − ν₁₂ν₂₁), and drape % as the coefficient of 'warpcloth measure cusick -p rows=8',
mean of eight starts. Several of these records drape less than such fabrics do (docs/fabrics.md)."""


def add_arguments(parser):
    """Adds the arguments of this command."""
    text = "show one fabric, or list those of a file instead: .json of ARCSim, or a .csv table of KES-F or FAST measurements"
    parser.add_argument("file", metavar="NAME|FILE", nargs="?", help=text)


def fabrics(arguments):
    from ..scene.fabric_files import read_fabrics
    from ..scene.measured_fabrics import fabrics as listed

    name = arguments.file
    if name and Path(name).suffix:
        listed = read_fabrics(name)
    elif name:
        listed = {name: listed[name]}
    if len(listed) == 1:
        print("\n".join(aligned(list(zip(COLUMNS, *rows(list(listed.values())), strict=True)))))
    else:
        print("\n".join(aligned([COLUMNS, *rows(list(listed.values()))], right=range(1, len(COLUMNS)))))
    sources = list(dict.fromkeys((fabric.source, fabric.notes) for fabric in listed.values()))
    for number, (source, notes) in enumerate(sources, start=1):
        print(f"\n[{number}] {source}. {notes}")
    if not any(fabric.computed for fabric in listed.values()):
        return 0
    print(f"\n{_DRAPE}")
    return 0


COLUMNS = (
    "fabric",
    "kg/m²",
    "t mm",
    "E₁t N/m",
    "E₂t N/m",
    "Gt N/m",
    "ν₁₂",
    "D₁ µN·m",
    "D₂ µN·m",
    "l₁ mm",
    "l₂ mm",
    "drape %",
    "source",
)
# The fields of a fabric from which the columns follow, between the first and the last two.
_BENDING = ("bending_warp", "bending_weft")
_NUMBERS = ("density", "thickness", "warp", "weft", "shear", "poisson_ratio", *_BENDING, *_BENDING)


def rows(fabrics):
    """The columns of :data:`COLUMNS` as texts, with – for numbers that are not known and * behind those that are computed.

    l are the bending lengths.
    """
    from ..scene.measured_fabrics import computed_drape

    sources = list(dict.fromkeys((fabric.source, fabric.notes) for fabric in fabrics))
    found = []
    for fabric in fabrics:
        values = [fabric.density, _times(1e3, fabric.thickness), fabric.warp, fabric.weft, fabric.shear, fabric.poisson_ratio]
        values += [_times(1e6, D) for D in (fabric.bending_warp, fabric.bending_weft)]
        values += [_times(1e3, length) for length in fabric.bending_lengths] + [computed_drape(fabric)]
        texts = ["–" if value is None or value != value else f"{value:.4g}" for value in values[:7]]
        texts += ["–" if value is None or value != value else f"{value:.3g}" for value in values[7:]]
        computed = [name in fabric.computed for name in _NUMBERS] + [True]
        texts = [text + "*" * (mark and text != "–") for text, mark in zip(texts, computed, strict=True)]
        found.append([fabric.name, *texts, f"[{sources.index((fabric.source, fabric.notes)) + 1}]"])
    return found


def _times(factor, value):
    return None if value is None else factor * value
