"""The command ``fit``: finds parameters of a scene with which it moves, or rests, as measured."""

from dataclasses import asdict, replace
from functools import partial

import numpy as np

from ..base.checks import choice, whole
from ..base.quiet import find_device
from ..base.texts import assignments, convert, json_text
from ..picture.figures import PICTURES, check_path
from .options import DOUBLE, add_fabric, add_pins, add_scene, add_shared, add_solver, add_values
from .setup import named_scene, solver_facts, solver_line, solver_setup
from .terminal import check_writable, say

TEXT = "Find parameters with which a scene moves as measured."
EPILOG = """\
MEASURED is an animation of the scene's vertices, or of those of --vertices, in their order: a USD stage, a folder of .obj, .ply
or .off files, a pattern such as "frames/*.obj", an .npz file. Its times count from the start of the scene, and its frames at
the times of frames of the scene are used. Positions that are NaN count as not measured. Or MEASURED is a .csv file of markers
with the columns time, id, x, y, z [s, m]: rows at time 0 bind the markers to the nearest points of the cloth at its start.
Without the column id, rows are free points on the cloth. --start names the parameters and the values to start from. Errors are
one standard deviation, relative to the value; intervals contain the true value with a probability of 95 %.

--capture stands for MEASURED: a folder of meshes whose triangles may change from frame to frame, with noise and holes, as of a
scanner. Its vertices are compared with the surface of the cloth, along the normal.

--reading stands for MEASURED: numbers that the device of a laboratory reads from its sample at rest, in the units of 'warpcloth
measure'. Each of several needs its standard deviation, NAME=VALUE+-DEVIATION; one without gives an estimate without an error.

  warpcloth fit hanging seen.usdc --start Spring.stiffness=300 QuadraticBending.stiffness=1e-4 --frames 30
  warpcloth fit hanging markers.csv --start QuadraticBending.stiffness=1e-4 --at-rest
  warpcloth fit hanging --capture scan --fps 60 --scale 0.001 --start QuadraticBending.stiffness=1e-4 --frames 30
  warpcloth fit loop --fabric cotton --reading "depth of the loop=19+-0.2" --start PlateBending.stiffness=1e-5
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add_scene(parser)
    add_fabric(parser)
    add_pins(parser)
    parser.add_argument(
        "measured", nargs="?", metavar="MEASURED", help="the measured animation; without --reading and --capture"
    )
    parser.add_argument("--capture", metavar="FOLDER", help="fit surfaces whose triangles may change: a folder of mesh files")
    parser.add_argument("--scale", type=float, metavar="M", help="length of a unit of the files of --capture [m] (default: 1)")
    parser.add_argument(
        "--points", type=int, metavar="N", help="use at most N vertices of each frame of --capture (default: all)"
    )
    text = 'fit what a laboratory\'s device reads from SCENE at rest, such as "drape coefficient=52+-1"'
    parser.add_argument("--reading", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=text)
    text = "parameters, such as Spring.stiffness=100, and values above 0 to start from"
    parser.add_argument("--start", nargs="+", action="extend", required=True, metavar="NAME=VALUE", help=text)
    add_solver(parser, "the solver (default: newton)")
    add_values(parser, "-s", "option", "options of the solver")
    parser.add_argument(
        "--at-rest", action="store_true", help="fit the equilibrium; after time 0 each marker has one row, its position at rest"
    )
    parser.add_argument("--vertices", default="all", metavar="SELECTION", help="the vertices that were measured (default: all)")
    parser.add_argument("--prim", help="path or name of the prim of MEASURED, if it has several")
    parser.add_argument("--fps", type=float, help="frames per second of MEASURED; overrides its own")
    parser.add_argument("--frames", type=int, metavar="N", help="use the first N frames of the scene (default: all)")
    parser.add_argument("--plot", metavar="FILE", help=f"plot the residuals over time ({', '.join(PICTURES)})")
    add_shared(parser, "device", "json", "dtype", dtype=DOUBLE)


def fit(arguments):
    from ..mesh.sequences import open_sequence
    from ..run.fit import fit

    _check(arguments)
    if arguments.plot:
        check_path(arguments.plot, PICTURES)
    check_writable(arguments.plot)
    start = {
        name: convert(f"--start {name}", value, (float,)) for name, value in assignments(arguments.start, "--start").items()
    }
    measured, prim, arguments.prim = arguments.measured, arguments.prim, None
    _source, values, scene = named_scene(arguments)
    if arguments.frames is not None:
        whole("frames", arguments.frames, least=1)
        scene = replace(scene, duration=arguments.frames / scene.fps)
    device, read = find_device(arguments.device), bool(arguments.reading)
    setup = None if arguments.at_rest or read else solver_setup(arguments, scene, device)
    if read:
        seen = _readings(arguments.reading, start, scene)
    elif arguments.capture:
        seen = _captured(arguments, prim)
    else:
        seen = measured if _is_table(measured) else open_sequence(measured, prim, arguments.fps)
    options = {"device": device, "dtype": arguments.dtype, "record": ("reactions",) if read else ()}
    found = fit(scene, setup and setup.solver, start, seen, arguments.vertices, **options)
    if arguments.plot:
        from ..chart import plot_residuals

        plot_residuals(arguments.plot, found, scene.fps, str(device))
    facts = {
        "scene": arguments.scene,
        "measured": measured or arguments.capture,
        "readings": arguments.reading,
        "scene_parameters": values,
    }
    facts |= {"device": str(device), "dtype": arguments.dtype}
    facts |= solver_facts(arguments, setup, scene.fps) if setup else {"solver": None}
    status = found.status
    facts |= {**asdict(replace(found, status=None)), "intervals": found.intervals}
    facts |= {"status": status.result.value, "grade": status.grade.value, "usable": status.ok}
    facts["distance"] = float(np.max(status.distance))
    facts |= {name: np.asarray(facts[name]).tolist() for name in ("correlation", "residuals")}
    print(json_text(facts) if arguments.json else _summary(facts, found))
    return 0 if status.ok else say(f"the run with the fitted parameters is {status.message}", 1)


def _check(arguments):
    """Checks that options go together."""
    measured, read = arguments.measured, arguments.reading
    given = [name for name, one in (("MEASURED", measured), ("--reading", read), ("--capture", arguments.capture)) if one]
    taken = next((text for text in (*arguments.p, *arguments.s, *arguments.start) if "=" not in text and text != "help"), None)
    if taken and not given:
        raise ValueError(f"{taken!r} is not of the form name=value; MEASURED must stand directly after SCENE, before -p")
    if len(given) != 1:
        said = f"{given[0]} and {given[1]} are" if given else "none of MEASURED, --reading and --capture is"
        raise ValueError(f"{said} given; one of the three must be")
    if not arguments.capture and (arguments.scale is not None or arguments.points is not None):
        raise ValueError("--scale and --points are for --capture; leave them out")
    if arguments.capture and arguments.vertices != "all":
        raise ValueError("--vertices is given, and the vertices of --capture are not those of the scene; leave it out")
    kind = "--reading is given" if read else "MEASURED is a file of markers"
    if (read or (measured and _is_table(measured))) and (arguments.prim or arguments.fps is not None):
        raise ValueError(f"--prim and --fps are for animations, and {kind}; leave them out")
    if arguments.at_rest and measured and not _is_table(measured):
        raise ValueError("--at-rest is given, but MEASURED is an animation; it must be a .csv file of markers, or --capture")
    motion = arguments.solver or arguments.s or arguments.plot or arguments.frames is not None
    if motion and (arguments.at_rest or read):
        option = "--reading" if read else "--at-rest"
        raise ValueError(f"{option} is given with --solver, -s, --plot or --frames, which are for motions; leave them out")


def _captured(arguments, prim):
    """Returns the :class:`warpcloth.CapturePoints` of --capture."""
    from ..mesh.captures import open_capture
    from ..run.readings import CapturePoints

    scale = 1.0 if arguments.scale is None else arguments.scale
    return CapturePoints(open_capture(arguments.capture, prim, arguments.fps, scale), arguments.points)


def _is_table(measured):
    """Returns whether MEASURED is a file of markers."""
    return measured.lower().endswith(".csv")


def _readings(texts, start, scene):
    """Returns a :class:`warpcloth.Reading` for each of the texts of --reading."""
    from ..lab.laboratory import DEVICES, check_sample
    from ..run.readings import Reading

    check_sample(scene)
    found = []
    for quantity, text in assignments(texts, "--reading").items():
        choice("--reading", quantity, tuple(DEVICES[scene.name][1]))
        if quantity == "D" and "density" in start:
            raise ValueError("--reading has D, which the device computes from the density, and --start has density")
        value, sign, deviation = text.replace("±", "+-").partition("+-")
        numbers = [convert(f"--reading {quantity}", each, (float,)) for each in ([value, deviation] if sign else [value])]
        found.append(Reading(partial(_read, scene, quantity), *numbers))
    return found


def _read(scene, quantity, rest):
    from ..lab.laboratory import laboratory_readings

    return laboratory_readings(scene, rest)[quantity][0]


def _summary(facts, found):
    width = max(map(len, found.parameters))
    measured = facts["measured"] or ", ".join(facts["readings"])
    lines = [f"{facts['scene']} fitted to {measured}, {solver_line(facts) if facts['solver'] else 'at rest'}"]
    for name, value in found.parameters.items():
        error, (low, high) = found.errors[name], found.intervals[name]
        if np.isnan(error):
            certain = "its error is not known"
        else:
            known = 0.0 < low and high < np.inf
            certain = f"± {100.0 * error:.2g} %, from {low:.5g} to {high:.5g}" if known else "not determined"
        lines.append(f"  {name.ljust(width)}  {value:.6g}  {certain}")
    names = list(found.parameters)
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        if np.isfinite(found.correlation[i, j]):
            lines.append(f"  correlation of {names[i]} and {names[j]}: {found.correlation[i, j]:.2f}")
    frames = int(np.isfinite(found.residuals).sum())
    over = f", over {frames} frame{'s' * (frames != 1)}" if facts["solver"] else ""
    ran = f"{found.runs} {'batches were' if facts['solver'] else 'sets of equilibria were'} run"
    if facts["measured"]:
        unit = " m"
    else:
        unit = " standard deviations" if np.isinf(found.freedom) else " in the unit of the reading,"
    lines.append(f"  residual {found.residual:.4g}{unit} RMS{over}; {ran}")
    return "\n".join(lines)
