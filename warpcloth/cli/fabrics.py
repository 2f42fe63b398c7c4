"""The command ``fabrics``: lists measured fabrics."""

_DRAPE = """\
drape % is computed, not measured: the coefficient of 'warpcloth measure cusick -p rows=8', mean of eight starts. The D of these
records was not measured either, and several drape less than such fabrics do (docs/fabrics.md)."""


def fabrics(arguments):
    if arguments.file:
        from ..scene.fabric_files import read_fabrics

        listed = read_fabrics(arguments.file)
    else:
        from ..scene.measured_fabrics import fabrics as listed
    for line in table_lines(listed.values()):
        print(line)
    sources = list(dict.fromkeys((fabric.source, fabric.notes) for fabric in listed.values()))
    for number, (source, notes) in enumerate(sources, start=1):
        print(f"\n[{number}] {source}. {notes}")
    if not arguments.file:
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


def rows(fabrics):
    """The columns of :data:`COLUMNS` as texts, "–" where a number is not known; l are the bending lengths."""
    from ..scene.measured_fabrics import computed_drape

    sources = list(dict.fromkeys((fabric.source, fabric.notes) for fabric in fabrics))
    found = []
    for fabric in fabrics:
        values = [fabric.density, _times(1e3, fabric.thickness), fabric.warp, fabric.weft, fabric.shear, fabric.poisson_ratio]
        values += [_times(1e6, D) for D in (fabric.bending_warp, fabric.bending_weft)]
        values += [_times(1e3, length) for length in fabric.bending_lengths] + [computed_drape(fabric)]
        texts = ["–" if value is None or value != value else f"{value:.4g}" for value in values[:7]]
        texts += ["–" if value is None or value != value else f"{value:.3g}" for value in values[7:]]
        found.append([fabric.name, *texts, f"[{sources.index((fabric.source, fabric.notes)) + 1}]"])
    return found


def table_lines(fabrics):
    """Lines of a table in columns."""
    cells = [COLUMNS, *rows(list(fabrics))]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        first, *others = (
            text.ljust(width) if k == 0 else text.rjust(width) for k, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        yield "  ".join([first, *others])


def _times(factor, value):
    return None if value is None else factor * value
