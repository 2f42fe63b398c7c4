"""The command ``check``: finds intersections in an animation, exactly."""

import time
from contextlib import closing, nullcontext
from pathlib import Path

import numpy as np

from ..base.interrupts import Interrupted
from ..base.outputs import check_apart, write_table
from ..base.texts import assignments, json_text
from .options import add_shared, add_values, values_of
from .render import SIZE, check_drawing, draw_film
from .terminal import Progress, aligned, check_writable, frames_folder_of, location

TEXT = "Find what intersects in an animation, exactly."
EPILOG = """\
FILE is a USD stage, a mesh file, a folder or pattern of mesh files, or arrays in .npz or .npy. Of a result of warpcloth the
cloth is checked, of other stages all meshes whose points move, or else all meshes, but no colliders; --prim names others. Pairs
of triangles of different meshes count too. Vertices inside the colliders of a stage and stretches beyond the limits that it
declares are found as well. FILE may also be a scene, a name that 'warpcloth scenes' lists or a .py file. Then its start is
checked, which 'run' refuses if it intersects.

The exit code is 0 if nothing was found, 1 if something was or if part of a frame could not be judged, and 2 for bad input.

  warpcloth check hanging.usdc
  warpcloth check cache.usdc --prim Shirt Trousers --csv pairs.csv -o crossings.usdc --still worst.png
  warpcloth check "frames/*.obj" --fps 24 --rest pattern.obj --stretch 1.1 --json
  warpcloth check my_scene.py --still start.png
"""
# Linear Rec. 709 of triangles that intersect, of those that could not be judged, and of others.
_RED, _UNKNOWN, _OTHER = (0.70, 0.01, 0.01), (0.05, 0.05, 0.05), (0.45, 0.47, 0.50)
_COLUMNS = ("frame", "time", "found", "prim", "element", "other", "other_element", "stretch")
_SHOWN = 12  # frames that the summary names
_SENTENCES = 8


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="the animation, mesh or scene to check")
    add_values(parser, "-p", "parameter", "parameters of a scene")
    add("--prim", nargs="+", metavar="PRIM", help="paths or names of the meshes to check, if not those that are cloth")
    add("--fps", type=float, help="frames per second (default: that of the input)")
    add("--rest", metavar="MESH", help="mesh file with the rest shape, for --stretch (default: as of analyze)")
    add("--stretch", type=float, metavar="RATIO", help="also report edges longer than this many times their rest length")
    add("--every", type=int, default=1, metavar="K", help="check only every K-th frame")
    add("-o", "--output", metavar="FILE", help="write a .usd, .usda, .usdc or .usdz file with what intersects in red")
    text = "write a table: a row for each pair, each vertex inside a collider and each stretch beyond a limit"
    add("--csv", metavar="FILE", help=text)
    add("--still", metavar="FILE", help="draw the frame with the most intersections (.png)")
    add("--up-axis", choices=("Y", "Z"), help="up axis of -o and --still, if the input does not say (default: Y)")
    add_shared(parser, "json", "single_file")


def check(arguments):
    from ..analysis.cloths import cloths_of
    from ..analysis.intersections import Checker
    from ..mesh.mesh import Surface

    files = values_of(arguments, "output", "csv", "still")
    check_apart(files.values(), [arguments.rest])
    check_writable(*files.values())
    check_drawing(arguments.still)
    if arguments.still and Path(arguments.still).suffix.lower() != ".png":
        raise ValueError(f"--still is {arguments.still}; it must end with .png")
    folder = frames_folder_of(arguments) if arguments.output else None  # checks the ending
    started = time.perf_counter()
    rest = None if arguments.rest is None else Surface.load(arguments.rest)
    source, scene = _scene_of(arguments)
    cloths = cloths_of(arguments.file if scene is None else scene, rest, arguments.prim, arguments.fps)
    check_apart(files.values(), [*cloths.files, source])
    checker = Checker(cloths, stretch=arguments.stretch, every=arguments.every)
    found = []
    opened = _writer(arguments, cloths)
    try:
        with closing(Progress(len(checker), first="checking")) as progress, opened as writer:
            for each in checker:
                found.append(each)
                if writer is not None:
                    _append(writer, cloths, each)
                progress(len(found), len(checker))
            if writer is not None:
                writer.close(single_file=arguments.single_file)
    except KeyboardInterrupt:
        saved = opened.saved() if arguments.output else "nothing was saved"
        raise Interrupted(f"interrupted after {len(found)} of {len(checker)} frames; {saved}") from None
    if arguments.csv:
        write_table(arguments.csv, _COLUMNS, (row for each in found for row in _rows(cloths, checker, each)))
    worst = max(found, key=lambda each: (len(each.pairs), each.vertices_inside))
    if arguments.still:
        _draw(arguments, scene, cloths, worst)
    facts = _facts(arguments, checker, found, worst) | {"seconds": time.perf_counter() - started, "frames_folder": folder}
    if arguments.json:
        print(json_text(facts | {"frames": [_counts(each) for each in found]}))
    else:
        print(_summary(facts, found))
    return 0 if facts["clean"] else 1


def _scene_of(arguments):
    """Returns the path of FILE, and the scene that it is, or None."""
    path = Path(arguments.file)
    if path.suffix != ".py" and (path.suffix or path.name != arguments.file or path.exists()):
        if arguments.p:
            raise ValueError(f"-p is given, but {arguments.file} is no scene; leave it out")
        return arguments.file, None
    from ..run.scene_files import find_source

    source = find_source(arguments.file)
    return str(source.path), source.scene(source.values(assignments(arguments.p)))


def _writer(arguments, cloths):
    """Returns the writer of the stage, or a null context."""
    if arguments.output is None:
        return nullcontext()
    from ..usd import MeasureWriter
    from .reports import codes_per_second

    return MeasureWriter(
        arguments.output,
        cloths.mesh,
        {"intersections": "uniform", "inside": "uniform"},
        coloured="intersections",
        source=cloths.stages or None,
        fps=codes_per_second(cloths),
        up_axis=cloths.up_axis or arguments.up_axis or "Y",
    )


def _marks(cloths, each):
    """Returns marks of the triangles of a frame.

    Returns:
        The number of others that each intersects and of its vertices inside colliders, (T,) each, NaN if it could not be
        judged; and its colour (T, 3).
    """
    count, triangles = len(cloths.mesh.triangles), cloths.mesh.triangles
    pairs = np.bincount(each.pairs.ravel(), minlength=count).astype(float)
    within = np.zeros(len(cloths.mesh.points), dtype=bool)
    within[[vertex for vertices in each.inside.values() for vertex in vertices]] = True
    inside, unknown = within[triangles].sum(axis=1).astype(float), np.zeros(count, dtype=bool)
    for one in each.excluded:
        if one.frame == each.frame and one.kind != "frame":
            unknown |= (
                np.isin(triangles, one.elements).any(axis=1) if one.kind == "vertex" else np.isin(range(count), one.elements)
            )
    colours = np.where(((pairs > 0.0) | (inside > 0.0))[:, None], _RED, _OTHER)
    colours[unknown], pairs[unknown], inside[unknown] = _UNKNOWN, np.nan, np.nan
    return pairs, inside, colours


def _append(writer, cloths, each):
    """Adds a frame to the stage; if that is not a layer over another stage, all points must be finite."""
    pairs, inside, colours = _marks(cloths, each)
    points = None if cloths.stages else cloths.read(each.index)
    if points is None or np.isfinite(points).all():
        writer.append(each.frame, {"intersections": pairs, "inside": inside}, colours, points=points)


def _draw(arguments, scene, cloths, each):
    """Draws a frame: cloths of a stage or a scene with their surroundings, others alone."""
    colours, options = _marks(cloths, each)[2], {"size": SIZE}
    if scene is not None:
        draw_film(scene, arguments.still, colour=colours[None], **options)
    elif len(cloths.stages) == 1:
        shown = np.broadcast_to(colours, (len(cloths.labels), *colours.shape))
        draw_film(arguments.file, arguments.still, prim=cloths.stages[0].prim, frame=each.frame, colour=shown, **options)
    else:
        up_axis = cloths.up_axis or arguments.up_axis
        frames = cloths.read(each.index)[None]
        draw_film(frames, arguments.still, mesh=cloths.mesh, colour=colours[None], up_axis=up_axis, **options)


def _rows(cloths, checker, each):
    """Yields rows of the table: pairs, vertices inside colliders, elements beyond a limit, and what could not be judged."""
    about = (each.frame, None if each.time != each.time else each.time)
    for one, other in each.pairs.tolist():
        yield (*about, "intersection", *cloths.face(one), *cloths.face(other), None)
    for collider, vertices in each.inside.items():
        for vertex in vertices:
            yield (*about, "inside", *cloths.vertex(vertex), collider, None, None)
    stencils = {limit.name: limit.stencil for limit in checker.limits}
    for name, (elements, stretches) in each.exceeded.items():
        for element, stretch in zip(elements.tolist(), stretches.tolist(), strict=True):
            prim, _ = cloths.vertex(stencils[name][element, 0])
            vertices = " ".join(str(cloths.vertex(vertex)[1]) for vertex in stencils[name][element])
            yield (*about, "stretch", prim, vertices, name, None, stretch)
    for exclusion in each.excluded:
        yield (*about, f"not judged: {exclusion}", None, None, None, None, None)


def _counts(each):
    """Returns a frame as JSON values."""
    exceeded = {name: {"elements": len(elements), **_ends(stretches)} for name, (elements, stretches) in each.exceeded.items()}
    inside = {name: len(vertices) for name, vertices in each.inside.items()}
    found = {"frame": each.frame, "time": each.time, "pairs": len(each.pairs), "inside": inside, "stretch": exceeded}
    return found | {"not_judged": [str(one) for one in each.excluded], "clean": each.clean}


def _ends(stretches):
    return {"smallest": float(stretches.min()), "largest": float(stretches.max())}


def _facts(arguments, checker, found, worst):
    cloths = checker.cloths
    first = [cloths.face(triangle) for triangle in worst.pairs[0]] if len(worst.pairs) else None
    return {
        "input": arguments.file,
        "prims": list(filter(None, cloths.names)),
        "vertices": len(cloths.mesh.points),
        "triangles": len(cloths.mesh.triangles),
        "clean": all(each.clean for each in found),
        "checked": len(found),
        "first_frame": found[0].frame,
        "last_frame": found[-1].frame,
        "intersecting": sum(len(each.pairs) > 0 for each in found),
        "pairs": sum(len(each.pairs) for each in found),
        "worst_frame": worst.frame if len(worst.pairs) else None,
        "worst_pairs": len(worst.pairs),
        "worst_first": None if first is None else [list(each) for each in first],
        "colliders": list(checker.colliders),
        "open_colliders": [name for name, each in checker.colliders.items() if not getattr(each, "closed", True)],
        "inside": sum(each.vertices_inside for each in found),
        "limits": [limit.name for limit in checker.limits],
        "exceeded": sum(bool(each.exceeded) for each in found),
        "not_judged": [str(one) for each in found for one in each.excluded],
        "sewn": checker.sewn,
        "not_checked": list(cloths.others),
        "file": arguments.output,
        "csv": arguments.csv,
        "still": arguments.still,
    }


def _summary(facts, found):
    said = "clean" if facts["clean"] else "not clean"
    frames = f"{facts['checked']} frames" if facts["checked"] > 1 else "1 frame"
    of = f"{facts['triangles']} triangles" + (f" of {len(facts['prims'])} meshes" if len(facts["prims"]) > 1 else "")
    lines = [f"{facts['input']}: {said}; {of}, {frames} from {facts['first_frame']:g} to {facts['last_frame']:g}, "]
    lines[0] += f"in {facts['seconds']:.3g} s"
    bad = [each for each in found if not each.clean]
    if bad:
        rows = [("frame", "pairs", "inside", "stretch", "not judged")]
        for each in bad[:_SHOWN]:
            most = max((stretches.max() for _, stretches in each.exceeded.values()), default=None)
            cells = (len(each.pairs), each.vertices_inside, "–" if most is None else f"{most:.4g}", len(each.excluded))
            rows.append((f"{each.frame:g}", *map(str, cells)))
        lines += [f"  {line}" for line in aligned(rows, right=range(5))]
        lines += [f"  and {len(bad) - _SHOWN} more frames, all of them with --csv FILE or --json"] if len(bad) > _SHOWN else []
    pairs = f"{facts['intersecting']} frames with {facts['pairs']} pairs of triangles" if facts["pairs"] else "none"
    lines.append(f"  intersections {pairs}")
    if facts["pairs"]:
        pair = " and ".join(f"face {face} of {prim}" if prim else f"face {face}" for prim, face in facts["worst_first"])
        lines.append(f"                most in frame {facts['worst_frame']:g}, {facts['worst_pairs']} pairs, such as {pair}")
    if facts["colliders"]:
        lines.append(f"  colliders     {_listed(facts['colliders'])}: {facts['inside'] or 'no'} vertices inside, in all frames")
    if facts["open_colliders"]:
        lines.append(f"                {_listed(facts['open_colliders'])}: not closed, and has no inside")
    if facts["limits"]:
        lines.append(f"  stretch       limits of {_listed(facts['limits'])}: exceeded in {facts['exceeded'] or 'no'} frames")
    if facts["sewn"]:
        lines.append(f"  sewn          {facts['sewn']} vertices of boundaries, at the positions of others in all frames")
    lines += [f"  not judged    {one}" for one in facts["not_judged"][:_SENTENCES]]
    more = len(facts["not_judged"]) - _SENTENCES
    lines += [f"                and {more} more, all of them with --json"] if more > 0 else []
    if facts["not_checked"]:
        lines.append(f"  not checked   {_listed(facts['not_checked'])}; --prim names what is checked")
    if facts["file"]:
        lines.append(f"  file          {location(facts)}")
    lines += [f"  {name:<13} {facts[name]}" for name in ("csv", "still") if facts[name]]
    return "\n".join(lines)


def _listed(names):
    return ", ".join(names[:_SENTENCES]) + (f" and {len(names) - _SENTENCES} more" if len(names) > _SENTENCES else "")
