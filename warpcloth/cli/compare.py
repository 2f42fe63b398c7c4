"""The command ``compare``: measures the distance between two animations."""

from contextlib import closing

import numpy as np

from ..base.checks import whole
from ..base.outputs import check_apart
from ..base.quiet import find_device
from ..base.texts import json_text
from ..picture.figures import PICTURES, check_path
from .compare_surfaces import compare_by_surface, left_out, metres, over_frames, shown_at, shown_frame, worst_of, write_csv
from .options import add_shared, values_of
from .terminal import Progress, check_writable

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
        parser.add_argument(
            f"--scale-{name}",
            type=float,
            metavar="M",
            help=f"with --by surface: length of a unit of the mesh files of {of} [m]",
        )
    parser.add_argument(
        "--by",
        choices=("vertices", "surface"),
        default="vertices",
        help="compare meshes that keep their triangles (vertices, default), or surfaces that may change them (surface)",
    )
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
    from ..analysis.compare import compare, opened

    if arguments.frames is not None:
        whole("frames", arguments.frames, least=0)
    _check_outputs(arguments)
    device = find_device(arguments.device)
    if arguments.by == "surface":
        return compare_by_surface(arguments, device)
    for option in ("scale_a", "scale_b", "samples"):
        if getattr(arguments, option) is not None:
            raise ValueError(f"--{option.replace('_', '-')} is for --by surface; leave it out")
    a, b = (_open(arguments, name, opened) for name in ("a", "b"))
    check_apart([arguments.csv, arguments.plot], [*a.files, *b.files, arguments.rest_a, arguments.rest_b])
    with closing(Progress()) as progress:
        axes = values_of(arguments, "up_axis", "up_axis_a", "up_axis_b")
        found = compare(a, b, frames=arguments.frames, device=device, progress=progress, **axes)
    columns = _columns(found)
    if arguments.csv:
        write_csv(arguments.csv, columns)
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
        "hausdorff": worst_of(found, found.hausdorff),
        "hausdorff_bound": worst_of(found, found.hausdorff_bound),
        "surface_rms": [over_frames(column) for column in found.surface_rms.T],
        "surface_largest": [worst_of(found, column) for column in found.surface_largest.T],
    }
    if found.same_topology:
        facts |= {
            "rms": over_frames(found.rms),
            "relative_rms": over_frames(found.relative_rms),
            "worst_rms": worst_of(found, found.rms),
            "largest": worst_of(found, found.largest),
            "stretch_rms": [over_frames(column) for column in found.stretch_rms.T],
            "stretch_largest": worst_of(found, found.stretch_largest.max(axis=1)),
        }
        facts["largest"]["vertex"] = int(found.largest_vertex[np.nanargmax(found.largest)])
    return facts


def _summary(facts, found):
    vertices, triangles = (" and ".join(f"{n:,}" for n in dict.fromkeys(facts[name])) for name in ("vertices", "triangles"))
    mesh = "the same triangles" if facts["same_topology"] else "different triangles, so that surfaces alone are compared"
    lines = [
        f"{facts['a']} and {facts['b']}: {facts['compared']} of {len(found.times)} common frames compared",
        f"  meshes        {mesh}; {vertices} vertices, {triangles} triangles",
    ]
    if facts["same_topology"]:
        lines += [
            f"  vertices      RMS {metres(facts['rms'])} over all frames, {100.0 * facts['relative_rms']:.3g} % of the size",
            f"                worst RMS {shown_at(facts['worst_rms'])}",
            f"                largest {shown_at(facts['largest'])}, of vertex {facts['largest']['vertex']}",
        ]
    rms = " and ".join(metres(value) for value in facts["surface_rms"])
    lines += [
        f"  surfaces      RMS {rms} over all frames, from A and from B",
        f"  Hausdorff     {shown_at(facts['hausdorff'])}, sampled at vertices; "
        f"at most {metres(facts['hausdorff_bound']['value'])}",
    ]
    if facts["same_topology"]:
        worst = facts["stretch_largest"]
        if worst is None:
            lines.append("  stretches     none compared")
        else:
            rms = " and ".join(f"{value:.3g}" for value in facts["stretch_rms"])
            largest = f"{worst['value']:.3g} in {shown_frame(worst)}"
            lines.append(f"  stretches     RMS of the differences of λ₁ and λ₂ {rms} over all frames, largest {largest}")
        first = [of for of, declared in zip("AB", facts["rest_declared"], strict=True) if not declared]
        if first:
            lines.append(f"                from the first frame of {' and of '.join(first)}, where no rest shape is given")
    return "\n".join([*lines, *left_out(facts)])
