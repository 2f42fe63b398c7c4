"""The command ``analyze``: measures an animation, and writes results as a stage, tables, arrays and pictures."""

import time
from contextlib import closing
from pathlib import Path

from ..base.checks import choice
from ..base.outputs import check_apart
from ..base.quiet import find_device
from ..base.texts import convert, json_text
from .options import DOUBLE, add_shared, values_of
from .terminal import Progress, aligned, check_writable, frames_folder_of, location

TEXT = "Measure how an animated cloth deforms."
EPILOG = """\
INPUT is a USD stage, a folder of .obj, .ply or .off files, a pattern such as "frames/*.obj", or arrays in .npz or .npy.
--measure help lists the measures. --colour takes a scalar measure, such as area_ratio, or a component of a vector, such as
stretch_1. What cannot be measured, such as triangles without area or points that are not finite, is left out and listed.

  warpcloth analyze cache.usdc --measure stretch area_ratio -o measured.usdc --plot measured.png
  warpcloth analyze frames/ --fps 24 --rest pattern.obj --neighbourhood 1-ring --measure rotation residual --csv table.csv
  warpcloth analyze cache.usdc --lag 3 --measure rate_of_strain stretch_rate -o rates.usdc --still one.png --still-frames 24
  warpcloth analyze cache.usdc --still turned.png --azimuth 60 --elevation 10 --both-sides --colormap cividis
"""
_SENTENCES = 8


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    text = (
        "the animation: a USD stage, a folder or pattern of mesh files, a .npz or a .npy file; may be left out with "
        "'--measure help'"
    )
    add("input", metavar="INPUT", nargs="?", help=text)
    add_measuring(parser)
    text = "measures to compute, or all; '--measure help' lists them (default: stretch)"
    add("--measure", nargs="+", default=["stretch"], metavar="NAME", help=text)
    text = "compare these pairs of reference and frame, such as 1:2,1:3,72:75; in place of --reference and --lag"
    add("--pairs", metavar="A:B,…", help=text)
    add("--every", type=int, default=1, metavar="K", help="measure only every K-th frame")
    text = "write a .usd, .usda, .usdc or .usdz file with the measures as primvars, and one as colour"
    add("-o", "--output", metavar="FILE", help=text)
    text = "the value to show as colour, such as stretch_1, or none (default: the first that is measured)"
    add("--colour", metavar="NAME", help=text)
    add("--curves", action="store_true", help="draw the principal directions as curves in the stage and in stills")
    add("--csv", metavar="FILE", help="write a table: percentiles of each measure in each frame, and where its extremes are")
    add("--report", metavar="FILE", help="write the table of --csv as JSON, with a list of what could not be measured")
    add("--npz", metavar="FILE", help="write the measures as arrays (frames, elements, …)")
    add("--plot", metavar="FILE", help="plot percentiles over time (.png, .svg, .pdf)")
    add("--still", metavar="FILE", help="write pictures (.png); the frame number is added to the name")
    add("--azimuth", type=float, metavar="DEGREES", help="azimuth of the camera of --still (default: -38)")
    add("--elevation", type=float, metavar="DEGREES", help="elevation of the camera of --still (default: 24)")
    add("--both-sides", action="store_true", help="also show the opposite side of the cloth in each still")
    add("--still-frames", type=float, nargs="+", metavar="FRAME", help="frames to show with --still (default: the last)")
    add_shared(parser, "device", "json", "dtype", "single_file", dtype=DOUBLE)


def add_measuring(parser):
    """Adds the options of references, measures and colours."""
    add = parser.add_argument
    add("--prim", help="path or name of the mesh, if the file has several")
    add("--fps", type=float, help="frames per second (default: that of the input); rates need it")
    text = "mesh file or stage with the rest shape (default: the rest shape in the animation, else its first frame)"
    add("--rest", metavar="MESH", help=text)
    add("--rest-prim", metavar="PRIM", help="path or name of the mesh in the file of --rest")
    text = "measure vertices instead of triangles: 1-ring, 2-ring, nearest:k=12, nearest:radius=0.05, nearest:2%%"
    add("--neighbourhood", metavar="N", help=text)
    add("--reference", metavar="R", help="compare each frame with rest (default), first, previous, or a frame number")
    add("--lag", type=int, metavar="K", help="compare each frame with the one K frames earlier; in place of --reference")
    text = "formula of rates (default: midpoint), see docs/measuring.md"
    add("--rates", choices=("midpoint", "forward", "logarithm"), default="midpoint", help=text)
    text = "direction of the warp, for measures along warp and weft: st for texture coordinates, or a vector such as 1,0,0"
    add("--directions", metavar="D", help=text)
    text = "membrane for energy and stress, with --stiffness: neo-hookean (default), stvk or corotated"
    add("--material", metavar="M", help=text)
    text = "values at the ends of the colour scale (default: from the 1st to the 99th percentile of all frames)"
    add("--range", dest="colour_range", type=float, nargs=2, metavar=("LOW", "HIGH"), help=text)
    text = "a colormap of matplotlib, such as cividis (default: viridis, or coolwarm around the undeformed value)"
    add("--colormap", metavar="NAME", help=text)
    add("--up-axis", choices=("Y", "Z"), help="up axis, if the input does not say (default: Y)")
    add("--stiffness", type=float, metavar="K", help="stiffness of the material, Young's modulus times thickness [N/m]")
    add("--poisson", type=float, metavar="NU", help="Poisson's ratio of the material (default: 0)")


def analyze(arguments):
    from ..analysis.measures import MEASURES
    from .reports import ReportFiles, ReportLooks, write_report

    if arguments.measure == ["help"]:
        print(_listed(MEASURES))
        return 0
    files = values_of(arguments, "output", "csv", "report", "npz", "plot", "still")
    check_apart(files.values(), [arguments.rest])
    check_writable(*files.values())
    if arguments.output:
        frames_folder_of(arguments)  # checks the ending
    started = time.perf_counter()
    view = _view(arguments)
    analyzer = _analyzer(arguments)
    stills = _stills(arguments, analyzer)
    with closing(Progress(len(analyzer), first="measuring")) as progress:
        others = values_of(arguments, "csv", "npz", "plot", "single_file", "up_axis")
        written = ReportFiles(usd=arguments.output, json=arguments.report, stills=stills, **others)
        looks = ReportLooks(view=view, **values_of(arguments, "colour", "colour_range", "colormap", "curves", "both_sides"))
        found = write_report(analyzer, written, looks, progress)
    facts = {
        "input": arguments.input,
        "vertices": len(analyzer.mesh.points),
        "triangles": len(analyzer.mesh.triangles),
        "measured": analyzer.on,
        "neighbourhood": arguments.neighbourhood,
        "rest_declared": arguments.rest is not None or bool(analyzer.sequence.declared),
        "rows": found.rows,
        "first_frame": analyzer.sequence.labels[analyzer.pairs[0].frame].item(),
        "last_frame": analyzer.sequence.labels[analyzer.pairs[-1].frame].item(),
        "seconds": time.perf_counter() - started,
        "extremes": {name: _extremes(extremes) for name, extremes in found.extremes.items()},
        "excluded": found.excluded,
        "exclusions": found.exclusions,
        "coloured": found.coloured,
        "colour_range": found.scale,
        "rates": arguments.rates,
        "device": arguments.device,
        "dtype": arguments.dtype,
        "file": arguments.output,
        "frames_folder": frames_folder_of(arguments) if arguments.output else None,
        **{name: path for name, path in files.items() if name != "output"},
        "still": ", ".join(map(str, stills.values())) if stills else None,
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def _analyzer(arguments):
    from ..analysis.analysis import Analyzer
    from ..mesh.mesh import Surface
    from ..mesh.sequences import open_sequence

    if arguments.input is None:
        raise ValueError(
            "INPUT is missing, the animation to be measured; it must stand before options that take several values, such as "
            "--measure; see warpcloth analyze --help"
        )
    rest = None if arguments.rest is None else Surface.load(arguments.rest, arguments.rest_prim)
    sequence = open_sequence(arguments.input, arguments.prim, arguments.fps, rest)
    return Analyzer(
        sequence,
        rest,
        measures="all" if arguments.measure == ["all"] else arguments.measure,
        device=find_device(arguments.device),
        **values_of(arguments, "pairs", "every", "dtype"),
        **measuring_of(arguments),
    )


def measuring_of(arguments):
    """Returns the options of `add_measuring`, without the rest shape, for :class:`warpcloth.Analyzer`."""
    directions = arguments.directions
    if directions is not None and directions != "st":
        directions = [convert("--directions", number, (float,)) for number in directions.split(",")]
    others = values_of(arguments, "reference", "lag", "neighbourhood", "rates")
    return {**others, "directions": directions, "material": _material(arguments)}


def _material(arguments):
    from ..terms import TERMS
    from ..terms.membrane import Membrane

    membranes = {energy.material: energy for energy in TERMS.values() if issubclass(energy, Membrane) and energy.material}
    kind = "neo-hookean" if arguments.material is None else arguments.material
    choice("--material", kind, tuple(membranes))
    if arguments.stiffness is None:
        for name in ("material", "poisson"):
            if getattr(arguments, name) is not None:
                raise ValueError(f"--{name} is given without --stiffness, Young's modulus times thickness [N/m]")
        return None
    options = {"stiffness": arguments.stiffness}
    if arguments.poisson is not None:
        if "poisson_ratio" not in membranes[kind].quantities():
            raise ValueError(f"--poisson: the {kind} membrane has none, leave it out")
        options["poisson_ratio"] = arguments.poisson
    return membranes[kind](**options)


def _stills(arguments, analyzer):
    """Returns the paths of the pictures by frame."""
    labels = [analyzer.sequence.labels[pair.frame].item() for pair in analyzer.pairs]
    if arguments.still is None:
        if arguments.still_frames:
            raise ValueError("--still-frames is given without --still, the name of the pictures")
        return None
    path = Path(arguments.still)
    width = max(len(f"{label:g}") for label in labels)
    chosen = arguments.still_frames or [labels[-1]]
    return {frame: path.with_name(f"{path.stem}_{f'{frame:g}'.zfill(width)}{path.suffix}") for frame in chosen}


def _view(arguments):
    """Returns the view of the stills, or None without stills."""
    angles = {name: value for name, value in values_of(arguments, "azimuth", "elevation").items() if value is not None}
    if arguments.still is None:
        for name in (*angles, *(["both-sides"] if arguments.both_sides else [])):
            raise ValueError(f"--{name} is given without --still, which writes the pictures")
        if arguments.colormap is not None and arguments.output is None:
            raise ValueError("--colormap is given without --still and -o, which have colours")
        return None
    from ..chart import View

    return View(**angles)


def _extremes(extremes):
    """Returns the smallest and the largest value of a scalar, and their positions."""
    facts = {}
    for end, summary in (("smallest", extremes.smallest), ("largest", extremes.largest)):
        if summary is None:
            facts[end] = None
            continue
        value = summary.percentiles[0 if end == "smallest" else -1]
        facts[end] = {"value": value, "frame": summary.frame, "reference": summary.reference, "element": getattr(summary, end)}
        facts[end] |= {"at": list(getattr(summary, f"{end}_at")), "median": summary.percentiles[4], "unit": summary.unit}
    return facts


def _summary(facts):
    rows = [("", "smallest", "frame", facts["measured"], "largest", "frame", facts["measured"], "unit")]
    for name, ends in facts["extremes"].items():
        if ends["smallest"] is None:
            rows.append((name, *("–",) * 7))
            continue
        cells = [(f"{end['value']:.5g}", f"{end['frame']:g}", str(end["element"])) for end in ends.values()]
        rows.append((name, *cells[0], *cells[1], ends["largest"]["unit"]))
    table = [f"  {line}" for line in aligned(rows)]
    frames = f"{facts['rows']} frames from {facts['first_frame']:g} to {facts['last_frame']:g}"
    of = f"{facts['triangles']} triangles" if facts["measured"] == "triangle" else f"{facts['vertices']} vertices"
    around = f", {facts['neighbourhood']}" if facts["neighbourhood"] else ""
    lines = [f"{facts['input']}: {of}{around}, {frames}, in {facts['seconds']:.3g} s", *table]
    if not facts["rest_declared"]:
        lines.append("  rest shape    that of the first frame, because neither the input nor --rest gives one")
    if facts["coloured"]:
        low, high = facts["colour_range"]
        lines.append(f"  colours       {facts['coloured']}, {low:.5g} to {high:.5g}")
    if facts["file"]:
        lines.append(f"  file          {location(facts)}")
    lines += [f"  {name:<13} {facts[name]}" for name in ("csv", "report", "npz", "plot", "still") if facts[name]]
    if facts["excluded"]:
        lines.append("  left out")
        lines += [f"    {sentence}" for sentence in facts["exclusions"][:_SENTENCES]]
        more = facts["excluded"] - _SENTENCES
        lines += [f"    and {more} more, all of them in --report FILE"] if more > 0 else []
    return "\n".join(lines)


def _listed(measures):
    lines = []
    for on, found in measures.items():
        lines.append(f"of each {on}" + (", with --neighbourhood" if on == "vertex" else ""))
        for measure in found.values():
            shape = "×".join(map(str, measure.shape)) or "–"
            needs = f" (needs --{measure.needs})" if measure.needs else ""
            lines.append(f"  {measure.name:<21} {shape:<4} {measure.unit:<6} {measure.text}{needs}")
    return "\n".join(lines)
