"""The command ``compare``: measures the distance between two animations."""

from contextlib import closing

import numpy as np

from ..base.checks import whole
from ..base.outputs import check_apart, write_table
from ..base.quiet import find_device
from ..base.texts import json_text
from ..picture.figures import PICTURES, check_path
from .options import values_of
from .terminal import Progress, check_writable

_SHOWN = 8  # largest number of frames or exclusions of each in the summary

EPILOG = """\
A and B are USD stages, folders of .obj, .ply or .off files, patterns such as "frames/*.obj", .npz or .npy files. Frames are
matched by their time; those without a match are listed. Distances between the surfaces are always measured. If A and B have the
same triangles, the positions of vertices and the stretches are compared too. The stretches of each are relative to its own rest
shape. The rest shape of a folder or an .npz file is its first frame, unless --rest-a or --rest-b gives another. If one is Y up
and the other Z up, B is rotated to the up axis of A.

  warpcloth compare hanging.usdc frames --fps-b 24 --rest-b rest.obj --csv apart.csv
"""


def add_arguments(parser):
    """Adds the arguments of this command, without those of all commands."""
    for name, of in (("a", "A"), ("b", "B")):
        parser.add_argument(name, metavar=of, help="the first animation" if of == "A" else "the second animation")
    for name, of in (("a", "A"), ("b", "B")):
        parser.add_argument(f"--prim-{name}", metavar="PRIM", help=f"path or name of the prim of {of}, if it has several")
        parser.add_argument(f"--rest-{name}", metavar="MESH", help=f"mesh file with the rest shape of {of}")
        parser.add_argument(f"--fps-{name}", type=float, metavar="FPS", help=f"frames per second of {of}; overrides its own")
        parser.add_argument(f"--up-axis-{name}", choices=("Y", "Z"), help=f"up axis of {of}; overrides its own")
    parser.add_argument("--fps", type=float, help="frames per second of A and B; overrides their own")
    parser.add_argument("--up-axis", choices=("Y", "Z"), help="up axis of A and B; overrides their own")
    parser.add_argument("--frames", type=int, metavar="N", help="compare the first frame and N frames after it (default: all)")
    parser.add_argument("--csv", metavar="FILE", help="write a table with one row per frame")
    parser.add_argument("--plot", metavar="FILE", help=f"plot the distances over time ({', '.join(PICTURES)})")


def compare(arguments):
    from ..analysis.compare import compare, opened

    if arguments.frames is not None:
        whole("frames", arguments.frames, least=0)
    _check_outputs(arguments)
    device = find_device(arguments.device)
    a, b = (_open(arguments, name, opened) for name in ("a", "b"))
    check_apart([arguments.csv, arguments.plot], [*a.files, *b.files, arguments.rest_a, arguments.rest_b])
    with closing(Progress()) as progress:
        axes = values_of(arguments, "up_axis", "up_axis_a", "up_axis_b")
        found = compare(a, b, frames=arguments.frames, device=device, progress=progress, **axes)
    columns = _columns(found)
    if arguments.csv:
        _write_csv(arguments.csv, columns)
    if arguments.plot:
        from ..chart import plot_distances

        plot_distances(arguments.plot, found, (arguments.a, arguments.b), device)
    facts = _facts(arguments, found, (a, b))
    if arguments.json:
        per_frame = {name: np.asarray(column).tolist() for name, column in columns.items()}
        print(json_text(facts | {"device": str(device), "frames": per_frame}))
    else:
        print(_summary(facts, found))
    return 0


def _check_outputs(arguments):
    if arguments.plot:
        check_path(arguments.plot, PICTURES)
    check_writable(arguments.csv, arguments.plot)


def _open(arguments, name, opened):
    source, prim, rest, fps = (getattr(arguments, key) for key in (name, f"prim_{name}", f"rest_{name}", f"fps_{name}"))
    if rest is not None:
        from ..mesh.mesh import Surface

        source = (Surface.load(rest), source)
    return opened(name, source, prim, arguments.fps if fps is None else fps)


def _columns(found):
    """Returns the columns of the table by name, (F,) in SI units, with endings a and b, or 1 and 2 for stretches."""
    columns = {"time": found.times, "frame_a": found.labels[:, 0], "frame_b": found.labels[:, 1], "size": found.sizes}
    if found.same_topology:
        columns |= {name: getattr(found, name) for name in ("rms", "relative_rms", "largest", "largest_vertex")}
        for name in ("stretch_rms", "stretch_largest"):
            columns |= {f"{name}_{k + 1}": column for k, column in enumerate(getattr(found, name).T)}
    for name in ("surface_mean", "surface_rms", "surface_largest"):
        columns |= {f"{name}_{of}": column for of, column in zip("ab", getattr(found, name).T, strict=True)}
    return columns | {"hausdorff": found.hausdorff, "hausdorff_bound": found.hausdorff_bound}


def _write_csv(path, columns):
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(path, columns, ([None if value != value else value for value in row] for row in rows))


def _facts(arguments, found, sequences):
    """Returns the facts of the summary: the largest value of each number with its frame, and the RMS over all frames."""
    facts = {
        "a": arguments.a,
        "b": arguments.b,
        "vertices": [len(s.mesh.points) for s in sequences],
        "triangles": [len(s.mesh.triangles) for s in sequences],
        "same_topology": found.same_topology,
        "up_axes": list(found.up_axes),
        "rest_declared": [bool(s.declared) for s in sequences],
        "compared": int(np.isfinite(found.hausdorff).sum()),
        "unmatched": [
            [s.labels[index].item() for index in partners] for s, partners in zip(sequences, found.unmatched, strict=True)
        ],
        "excluded": [[str(one) for one in excluded] for excluded in found.excluded],
        "hausdorff": _worst(found, found.hausdorff),
        "hausdorff_bound": _worst(found, found.hausdorff_bound),
        "surface_rms": [_over_frames(column) for column in found.surface_rms.T],
        "surface_largest": [_worst(found, column) for column in found.surface_largest.T],
    }
    if found.same_topology:
        facts |= {
            "rms": _over_frames(found.rms),
            "relative_rms": _over_frames(found.relative_rms),
            "worst_rms": _worst(found, found.rms),
            "largest": _worst(found, found.largest),
            "stretch_rms": [_over_frames(column) for column in found.stretch_rms.T],
            "stretch_largest": _worst(found, found.stretch_largest.max(axis=1)),
        }
        facts["largest"]["vertex"] = int(found.largest_vertex[np.nanargmax(found.largest)])
    return facts


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


def _summary(facts, found):
    vertices, triangles = (" and ".join(f"{n:,}" for n in dict.fromkeys(facts[name])) for name in ("vertices", "triangles"))
    mesh = "the same triangles" if facts["same_topology"] else "different triangles, so that surfaces alone are compared"
    lines = [
        f"{facts['a']} and {facts['b']}: {facts['compared']} of {len(found.times)} common frames compared",
        f"  meshes        {mesh}; {vertices} vertices, {triangles} triangles",
    ]
    if facts["same_topology"]:
        lines += [
            f"  vertices      RMS {_metres(facts['rms'])} over all frames, {100.0 * facts['relative_rms']:.3g} % of the size",
            f"                worst RMS {_at(facts['worst_rms'])}",
            f"                largest {_at(facts['largest'])}, of vertex {facts['largest']['vertex']}",
        ]
    rms = " and ".join(_metres(value) for value in facts["surface_rms"])
    lines += [
        f"  surfaces      RMS {rms} over all frames, from A and from B",
        f"  Hausdorff     {_at(facts['hausdorff'])}, sampled at vertices; at most {_metres(facts['hausdorff_bound']['value'])}",
    ]
    if facts["same_topology"]:
        worst = facts["stretch_largest"]
        if worst is None:
            lines.append("  stretches     none compared")
        else:
            rms = " and ".join(f"{value:.3g}" for value in facts["stretch_rms"])
            largest = f"{worst['value']:.3g} in {_frame(worst)}"
            lines.append(f"  stretches     RMS of the differences of λ₁ and λ₂ {rms} over all frames, largest {largest}")
        first = [of for of, declared in zip("AB", facts["rest_declared"], strict=True) if not declared]
        if first:
            lines.append(f"                from the first frame of {' and of '.join(first)}, where no rest shape is given")
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
    return "\n".join(lines)


def _metres(value):
    return f"{value:.4g} m"


def _at(worst):
    return f"{_metres(worst['value'])} in {_frame(worst)}"


def _frame(worst):
    a, b = worst["frame_a"], worst["frame_b"]
    return f"frame {a:g} ({worst['time']:.4g} s)" if a == b else f"frames {a:g} and {b:g} ({worst['time']:.4g} s)"
