"""The command ``compare``: measures the distance between two animations."""

from contextlib import closing

import numpy as np

from ..base.checks import whole
from ..base.outputs import check_apart, write_table
from ..base.quiet import find_device
from ..base.texts import json_text
from ..picture.figures import PICTURES, check_path
from .options import add_shared, values_of
from .terminal import Progress, check_writable

_SHOWN = 8  # largest number of frames or exclusions of each in the summary
_NUMBERS = ("mean", "rms", "percentile", "largest")
# Options of one kind of comparison, with the reason why the other has none.
_OF_ONE = {
    "vertices": (("scale_a", "scale_b", "samples"), "for --by surface"),
    "surface": (("rest_a", "rest_b"), "for stretches, which --by surface does not compare"),
}
TEXT = "Measure the distance between two animations."
EPILOG = """\
A and B are USD stages, folders of .obj, .ply or .off files, patterns such as "frames/*.obj", .npz or .npy files. Frames are
matched by their time; those without a match are listed. Distances between the surfaces are always measured. If A and B have the
same triangles, the positions of vertices and the stretches are compared too. The stretches of each are relative to its own rest
shape. The rest shape of a folder or an .npz file is its first frame, unless --rest-a or --rest-b gives another. If one is Y up
and the other Z up, B is rotated to the up axis of A.

With --by surface, A and B may be captures: their triangles may change from frame to frame, with noise and holes. Points
that sample each surface by its area are measured to the other: all, and those alone whose nearest point is not on its boundary,
which leaves out what faces a hole.

  warpcloth compare hanging.usdc frames --fps-b 24 --rest-b rest.obj --csv apart.csv
  warpcloth compare scan hanging.usdc --by surface --fps-a 60 --scale-a 0.001 --csv apart.csv
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    for name, of in (("a", "A"), ("b", "B")):
        parser.add_argument(name, metavar=of, help="the first animation" if of == "A" else "the second animation")
    for name, of in (("a", "A"), ("b", "B")):
        parser.add_argument(f"--prim-{name}", metavar="PRIM", help=f"path or name of the prim of {of}, if it has several")
        parser.add_argument(f"--rest-{name}", metavar="MESH", help=f"mesh file with the rest shape of {of}")
        parser.add_argument(f"--fps-{name}", type=float, metavar="FPS", help=f"frames per second of {of}; overrides its own")
        parser.add_argument(f"--up-axis-{name}", choices=("Y", "Z"), help=f"up axis of {of}; overrides its own")
        text = f"with --by surface: length of a unit of the mesh files of {of} [m]"
        parser.add_argument(f"--scale-{name}", type=float, metavar="M", help=text)
    text = "compare meshes that keep their triangles (vertices, default), or surfaces that may change them (surface)"
    parser.add_argument("--by", choices=("vertices", "surface"), default="vertices", help=text)
    parser.add_argument(
        "--samples", type=int, metavar="N", help="with --by surface: number of points on each surface (default: 10000)"
    )
    parser.add_argument("--fps", type=float, help="frames per second of A and B; overrides their own")
    parser.add_argument("--up-axis", choices=("Y", "Z"), help="up axis of A and B; overrides their own")
    parser.add_argument("--frames", type=int, metavar="N", help="compare the first frame and N frames after it (default: all)")
    parser.add_argument("--csv", metavar="FILE", help="write a table with one row per frame")
    parser.add_argument("--plot", metavar="FILE", help=f"plot the distances over time ({', '.join(PICTURES)})")
    add_shared(parser, "device", "json")


def compare(arguments):
    from ..analysis.compare import compare
    from ..analysis.surface_comparison import compare_surfaces

    if arguments.frames is not None:
        whole("frames", arguments.frames, least=0)
    if arguments.plot:
        check_path(arguments.plot, PICTURES)
    check_writable(arguments.csv, arguments.plot)
    device = find_device(arguments.device)
    options, why = _OF_ONE[arguments.by]
    for option in options:
        if getattr(arguments, option) is not None:
            raise ValueError(f"--{option.replace('_', '-')} is {why}; leave it out")
    by_surface = arguments.by == "surface"
    each = [(_capture if by_surface else _sequence)(arguments, name) for name in "ab"]
    check_apart([arguments.csv, arguments.plot], [*each[0].files, *each[1].files, arguments.rest_a, arguments.rest_b])
    given = values_of(arguments, "frames", "up_axis", "up_axis_a", "up_axis_b")
    given |= {} if arguments.samples is None else {"samples": arguments.samples}
    with closing(Progress()) as progress:
        found = (compare_surfaces if by_surface else compare)(*each, device=device, progress=progress, **given)
    columns = {"time": found.times, "frame_a": found.labels[:, 0], "frame_b": found.labels[:, 1], "size": found.sizes}
    columns |= (_surface_columns if by_surface else _vertex_columns)(found)
    columns |= {"hausdorff": found.hausdorff, "hausdorff_bound": found.hausdorff_bound}
    if arguments.csv:
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        write_table(arguments.csv, columns, ([None if value != value else value for value in row] for row in rows))
    if arguments.plot:
        from ..chart import plot_distances, plot_surface_distances

        plot = plot_surface_distances if by_surface else plot_distances
        plot(arguments.plot, found, (arguments.a, arguments.b), device)
    facts = {
        "a": arguments.a,
        "b": arguments.b,
        "up_axes": list(found.up_axes),
        "compared": int(np.isfinite(found.hausdorff).sum()),
        "unmatched": [[s.labels[index].item() for index in alone] for s, alone in zip(each, found.unmatched, strict=True)],
        "excluded": [[str(one) for one in excluded] for excluded in found.excluded],
        "hausdorff": _worst(found, found.hausdorff),
        "hausdorff_bound": _worst(found, found.hausdorff_bound),
        **(_surface_facts(found) if by_surface else _vertex_facts(found, each)),
    }
    if arguments.json:
        per_frame = {name: np.asarray(column).tolist() for name, column in columns.items()}
        print(json_text(facts | {"device": str(device), "frames": per_frame}))
        return 0
    compared = f"{facts['a']} and {facts['b']}: {facts['compared']} of {len(found.times)} common frames compared"
    lines = _surface_lines(facts) if by_surface else _vertex_lines(facts)
    print("\n".join([compared + " by their surfaces" * by_surface, *lines, *_left_out(facts)]))
    return 0


def _sequence(arguments, name):
    """Returns the sequence A or B, by vertices."""
    from ..analysis.compare import opened

    source, prim, rest, fps = (getattr(arguments, key) for key in (name, f"prim_{name}", f"rest_{name}", f"fps_{name}"))
    if rest is not None:
        from ..mesh.mesh import Surface

        source = (Surface.load(rest), source)
    return opened(name, source, prim, arguments.fps if fps is None else fps)


def _capture(arguments, name):
    """Returns the capture A or B, by surface."""
    from ..analysis.surface_comparison import opened_capture

    source, prim, fps, scale = (getattr(arguments, key) for key in (name, f"prim_{name}", f"fps_{name}", f"scale_{name}"))
    return opened_capture(name, source, prim, arguments.fps if fps is None else fps, 1.0 if scale is None else scale)


def _vertex_columns(found):
    """Returns columns of the table by name, (F,) in SI units, with endings a and b, or 1 and 2 for stretches."""
    columns = {}
    if found.same_topology:
        columns |= {name: getattr(found, name) for name in ("rms", "relative_rms", "largest", "largest_vertex")}
        for name in ("stretch_rms", "stretch_largest"):
            columns |= {f"{name}_{k + 1}": column for k, column in enumerate(getattr(found, name).T)}
    for name in ("surface_mean", "surface_rms", "surface_largest"):
        columns |= _of_each(name, getattr(found, name))
    return columns


def _surface_columns(found):
    """Returns columns of the table by name, (F,) in SI units; the endings a and b say from which surface."""
    columns = {}
    for kind in ("all", "inner"):
        for name in _NUMBERS:
            columns |= _of_each(f"{kind}_{name}", getattr(getattr(found, kind), name))
    return columns | _of_each("inner_area", found.inner_area)


def _of_each(name, values):
    return {f"{name}_{of}": column for of, column in zip("ab", values.T, strict=True)}


def _vertex_facts(found, sequences):
    """Returns the facts of the summary: the largest value of each number with its frame, and the RMS over all frames."""
    facts = {
        "vertices": [len(s.mesh.points) for s in sequences],
        "triangles": [len(s.mesh.triangles) for s in sequences],
        "same_topology": found.same_topology,
        "rest_declared": [bool(s.declared) for s in sequences],
        "surface_rms": [_over_frames(column) for column in found.surface_rms.T],
        "surface_largest": [_worst(found, column) for column in found.surface_largest.T],
    }
    if found.same_topology:
        facts |= {
            "rms": _over_frames(found.rms),
            "relative_rms": _over_frames(found.relative_rms),
            "worst_rms": _worst(found, found.rms),
            "largest": _worst(found, found.largest) | {"vertex": int(found.largest_vertex[np.nanargmax(found.largest)])},
            "stretch_rms": [_over_frames(column) for column in found.stretch_rms.T],
            "stretch_largest": _worst(found, found.stretch_largest.max(axis=1)),
        }
    return facts


def _surface_facts(found):
    """Returns the facts of the summary: RMS over all frames, and the largest of each number, from A and from B."""
    return {
        "by": "surface",
        "vertices": [[int(np.nanmin(column)), int(np.nanmax(column))] for column in found.vertices.T],
        "inner_area": [float(np.nanmean(column)) for column in found.inner_area.T],
    } | {
        kind: {
            "rms": [_over_frames(column) for column in getattr(found, kind).rms.T],
            "percentile": [_worst(found, column) for column in getattr(found, kind).percentile.T],
            "largest": [_worst(found, column) for column in getattr(found, kind).largest.T],
        }
        for kind in ("all", "inner")
    }


def _vertex_lines(facts):
    vertices, triangles = (" and ".join(f"{n:,}" for n in dict.fromkeys(facts[name])) for name in ("vertices", "triangles"))
    mesh = "the same triangles" if facts["same_topology"] else "different triangles, so that surfaces alone are compared"
    lines = [
        f"  meshes        {mesh}; {vertices} vertices, {triangles} triangles",
    ]
    if facts["same_topology"]:
        lines += [
            f"  vertices      RMS {_metres(facts['rms'])} over all frames, {100.0 * facts['relative_rms']:.3g} % of the size",
            f"                worst RMS {_shown_at(facts['worst_rms'])}",
            f"                largest {_shown_at(facts['largest'])}, of vertex {facts['largest']['vertex']}",
        ]
    rms = " and ".join(_metres(value) for value in facts["surface_rms"])
    lines += [
        f"  surfaces      RMS {rms} over all frames, from A and from B",
        f"  Hausdorff     {_shown_at(facts['hausdorff'])}, sampled at vertices; "
        f"at most {_metres(facts['hausdorff_bound']['value'])}",
    ]
    if facts["same_topology"]:
        worst = facts["stretch_largest"]
        if worst is None:
            lines.append("  stretches     none compared")
        else:
            rms = " and ".join(f"{value:.3g}" for value in facts["stretch_rms"])
            largest = f"{worst['value']:.3g} in {_shown_frame(worst)}"
            lines.append(f"  stretches     RMS of the differences of λ₁ and λ₂ {rms} over all frames, largest {largest}")
        first = [of for of, declared in zip("AB", facts["rest_declared"], strict=True) if not declared]
        if first:
            lines.append(f"                from the first frame of {' and of '.join(first)}, where no rest shape is given")
    return lines


def _surface_lines(facts):
    counts = " and ".join(f"{low:,}" if low == high else f"{low:,} to {high:,}" for low, high in facts["vertices"])
    lines = [f"  meshes        {counts} vertices"]
    for k, of in enumerate("AB"):
        for kind, title in (("all", f"from {of}"), ("inner", "")):
            numbers = facts[kind]
            if numbers["percentile"][k] is None:
                continue
            share = f"without holes ({100.0 * facts['inner_area'][k]:.3g} % of the area): " if kind == "inner" else ""
            parts = f"RMS {_metres(numbers['rms'][k])} over all frames, 95 % within {_shown_at(numbers['percentile'][k])}"
            lines.append(f"  {title.ljust(13)} {share}{parts}")
    at_most = _metres(facts["hausdorff_bound"]["value"])
    lines.append(f"  Hausdorff     {_shown_at(facts['hausdorff'])}, sampled; at most {at_most}")
    return lines


def _left_out(facts):
    """Returns the lines about axes that differ, and about frames and elements that were not compared."""
    lines = []
    up_a, up_b = facts["up_axes"]
    if up_a and up_b and up_a != up_b:
        lines.append(f"  up axis       A is {up_a} up and B {up_b} up; B was turned to {up_a} up")
        lines.append("                (with --up-axis both are taken as they are)")
    for of, labels in zip("AB", facts["unmatched"], strict=True):
        if labels:
            few = ", ".join(f"{label:g}" for label in labels[:_SHOWN]) + (", …" if len(labels) > _SHOWN else "")
            lines.append(f"  not compared  {len(labels)} of the frames of {of}, without a partner: {few}")
    for of, excluded in zip("AB", facts["excluded"], strict=True):
        lines += [f"  excluded      {of}: {one}" for one in excluded[:_SHOWN]]
        if len(excluded) > _SHOWN:
            lines.append(f"                {of}: {len(excluded) - _SHOWN} more, which --json names")
    return lines


def _over_frames(values):
    """Returns the RMS over the frames with a value, NaN if there are none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _worst(found, values):
    """Returns the largest of the values (F,) and its frame, or None if there are none."""
    if np.isnan(values).all():
        return None
    row = int(np.nanargmax(values))
    frame_a, frame_b = found.labels[row].tolist()
    return {"value": float(values[row]), "frame_a": frame_a, "frame_b": frame_b, "time": float(found.times[row])}


def _metres(value):
    """Returns a length as a text."""
    return f"{value:.4g} m"


def _shown_at(worst):
    """Returns the length and the frame of `_worst` as a text."""
    return f"{_metres(worst['value'])} in {_shown_frame(worst)}"


def _shown_frame(worst):
    """Returns the frame of `_worst` as a text."""
    a, b = worst["frame_a"], worst["frame_b"]
    return f"frame {a:g} ({worst['time']:.4g} s)" if a == b else f"frames {a:g} and {b:g} ({worst['time']:.4g} s)"
