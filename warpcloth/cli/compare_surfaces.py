"""``compare --by surface``, and what the summaries of both kinds of comparison share."""

from contextlib import closing

import numpy as np

from ..base.outputs import check_apart, write_table
from ..base.texts import json_text
from .options import values_of
from .terminal import Progress

_SHOWN = 8  # largest number of frames or exclusions of each in the summary
_NUMBERS = ("mean", "rms", "percentile", "largest")


def compare_by_surface(arguments, device):
    """Compares surfaces whose triangles may change, and writes what the options ask for."""
    from ..analysis.surface_comparison import compare_surfaces, opened_capture

    for name in "ab":
        if getattr(arguments, f"rest_{name}") is not None:
            raise ValueError(f"--rest-{name} is for stretches, which --by surface does not compare; leave it out")
    each = []
    for name in "ab":
        source, prim, fps, scale = (getattr(arguments, key) for key in (name, f"prim_{name}", f"fps_{name}", f"scale_{name}"))
        each.append(opened_capture(name, source, prim, arguments.fps if fps is None else fps, 1.0 if scale is None else scale))
    check_apart([arguments.csv, arguments.plot], [file for one in each for file in one.files])
    given = {} if arguments.samples is None else {"samples": arguments.samples}
    given |= values_of(arguments, "up_axis", "up_axis_a", "up_axis_b")
    with closing(Progress()) as progress:
        found = compare_surfaces(*each, frames=arguments.frames, device=device, progress=progress, **given)
    columns = _columns(found)
    if arguments.csv:
        write_csv(arguments.csv, columns)
    if arguments.plot:
        from ..chart import plot_surface_distances

        plot_surface_distances(arguments.plot, found, (arguments.a, arguments.b), device)
    facts = _facts(arguments, found, each)
    if arguments.json:
        per_frame = {name: np.asarray(column).tolist() for name, column in columns.items()}
        print(json_text(facts | {"device": str(device), "frames": per_frame}))
    else:
        print(_summary(facts, found))
    return 0


def _columns(found):
    """Returns the columns of the table by name, (F,) in SI units; the endings a and b say from which surface."""
    columns = {"time": found.times, "frame_a": found.labels[:, 0], "frame_b": found.labels[:, 1], "size": found.sizes}
    for kind in ("all", "inner"):
        for name in _NUMBERS:
            columns |= {
                f"{kind}_{name}_{of}": column for of, column in zip("ab", getattr(getattr(found, kind), name).T, strict=True)
            }
    columns |= {f"inner_area_{of}": column for of, column in zip("ab", found.inner_area.T, strict=True)}
    return columns | {"hausdorff": found.hausdorff, "hausdorff_bound": found.hausdorff_bound}


def _facts(arguments, found, captures):
    """Returns the facts of the summary: RMS over all frames, and the largest of each number, from A and from B."""
    return {
        "a": arguments.a,
        "b": arguments.b,
        "by": "surface",
        "vertices": [[int(np.nanmin(column)), int(np.nanmax(column))] for column in found.vertices.T],
        "up_axes": list(found.up_axes),
        "compared": int(np.isfinite(found.hausdorff).sum()),
        "unmatched": [[c.labels[index].item() for index in alone] for c, alone in zip(captures, found.unmatched, strict=True)],
        "excluded": [[str(one) for one in excluded] for excluded in found.excluded],
        "hausdorff": worst_of(found, found.hausdorff),
        "hausdorff_bound": worst_of(found, found.hausdorff_bound),
        "inner_area": [float(np.nanmean(column)) for column in found.inner_area.T],
    } | {
        kind: {
            "rms": [over_frames(column) for column in getattr(found, kind).rms.T],
            "percentile": [worst_of(found, column) for column in getattr(found, kind).percentile.T],
            "largest": [worst_of(found, column) for column in getattr(found, kind).largest.T],
        }
        for kind in ("all", "inner")
    }


def _summary(facts, found):
    counts = " and ".join(f"{low:,}" if low == high else f"{low:,} to {high:,}" for low, high in facts["vertices"])
    lines = [
        f"{facts['a']} and {facts['b']}: {facts['compared']} of {len(found.times)} common frames compared by their surfaces",
        f"  meshes        {counts} vertices",
    ]
    for k, of in enumerate("AB"):
        for kind, title in (("all", f"from {of}"), ("inner", "")):
            numbers = facts[kind]
            if numbers["percentile"][k] is None:
                continue
            share = f"without holes ({100.0 * facts['inner_area'][k]:.3g} % of the area): " if kind == "inner" else ""
            parts = f"RMS {metres(numbers['rms'][k])} over all frames, 95 % within {shown_at(numbers['percentile'][k])}"
            lines.append(f"  {title.ljust(13)} {share}{parts}")
    at_most = metres(facts["hausdorff_bound"]["value"])
    lines.append(f"  Hausdorff     {shown_at(facts['hausdorff'])}, sampled; at most {at_most}")
    return "\n".join([*lines, *left_out(facts)])


def left_out(facts):
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


def write_csv(path, columns):
    """Writes columns (F,) by name as a table; NaN is empty."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(path, columns, ([None if value != value else value for value in row] for row in rows))


def over_frames(values):
    """Returns the RMS over the frames with a value, NaN if there are none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def worst_of(found, values):
    """Returns the largest of the values (F,) and its frame, or None if there are none."""
    if np.isnan(values).all():
        return None
    row = int(np.nanargmax(values))
    frame_a, frame_b = found.labels[row].tolist()
    return {"value": float(values[row]), "frame_a": frame_a, "frame_b": frame_b, "time": float(found.times[row])}


def metres(value):
    """Returns a length as a text."""
    return f"{value:.4g} m"


def shown_at(worst):
    """Returns the length and the frame of :func:`worst_of` as a text."""
    return f"{metres(worst['value'])} in {shown_frame(worst)}"


def shown_frame(worst):
    """Returns the frame of :func:`worst_of` as a text."""
    a, b = worst["frame_a"], worst["frame_b"]
    return f"frame {a:g} ({worst['time']:.4g} s)" if a == b else f"frames {a:g} and {b:g} ({worst['time']:.4g} s)"
