"""The command ``fit``: finds parameters of a scene with which it moves, or rests, as measured."""

from dataclasses import asdict, replace

import numpy as np

from ..base.checks import whole
from ..base.quiet import find_device
from ..base.texts import assignments, convert, json_text
from ..picture.figures import PICTURES, check_path
from .options import add_scene, add_solver, add_values
from .setup import named_scene, solver_facts, solver_line, solver_setup
from .terminal import check_writable

EPILOG = """\
MEASURED is an animation of the scene's vertices, or of those of --vertices, in their order: a USD stage, a folder of .obj, .ply
or .off files, a pattern such as "frames/*.obj", an .npz file. Its times count from the start of the scene, and its frames at
the times of frames of the scene are used. Positions that are NaN count as not measured. Or MEASURED is a .csv file of markers
with the columns time, id, x, y, z [s, m]: rows at time 0 bind the markers to the nearest points of the cloth at its start.
Without the column id, rows are free points on the cloth. --start names the parameters and the values to start from. Errors are
one standard deviation, relative to the value; intervals contain the true value with a probability of 95 %.

  warpcloth fit hanging seen.usdc --start Spring.stiffness=300 QuadraticBending.stiffness=1e-4 --frames 30
  warpcloth fit hanging markers.csv --start QuadraticBending.stiffness=1e-4 --at-rest
"""


def add_arguments(parser):
    """Adds the arguments of this command, without those of all commands."""
    add_scene(parser)
    parser.add_argument("measured", metavar="MEASURED", help="the measured animation")
    parser.add_argument(
        "--start",
        nargs="+",
        action="extend",
        required=True,
        metavar="NAME=VALUE",
        help="parameters, such as Spring.stiffness=100, and values above 0 to start from",
    )
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


def fit(arguments):
    from ..mesh.sequences import open_sequence
    from ..run.fit import fit

    markers = arguments.measured.lower().endswith(".csv")
    if markers and (arguments.prim or arguments.fps is not None):
        raise ValueError("--prim and --fps are for animations, and MEASURED is a file of markers; leave them out")
    if arguments.at_rest and not markers:
        raise ValueError("--at-rest is given, but MEASURED is an animation; it must be a .csv file of markers")
    if arguments.at_rest and (arguments.solver or arguments.s or arguments.plot or arguments.frames is not None):
        raise ValueError("--at-rest is given with --solver, -s, --plot or --frames, which are for motions; leave them out")
    if arguments.plot:
        check_path(arguments.plot, PICTURES)
    check_writable(arguments.plot)
    start = {name: convert(f"--start {name}", value, (float,)) for name, value in assignments(arguments.start).items()}
    measured, prim, arguments.prim = arguments.measured, arguments.prim, None
    _source, values, scene = named_scene(arguments)
    if arguments.frames is not None:
        whole("frames", arguments.frames, least=1)
        scene = replace(scene, duration=arguments.frames / scene.fps)
    device = find_device(arguments.device)
    setup = None if arguments.at_rest else solver_setup(arguments, scene, device)
    seen = measured if markers else open_sequence(measured, prim, arguments.fps)
    found = fit(scene, setup and setup.solver, start, seen, arguments.vertices, device=device, dtype=arguments.dtype)
    if arguments.plot:
        from ..chart import plot_residuals

        plot_residuals(arguments.plot, found, scene.fps)
    facts = {"scene": arguments.scene, "measured": measured, "scene_parameters": values}
    facts |= {"device": str(device), "dtype": arguments.dtype}
    facts |= solver_facts(arguments, setup, scene.fps) if setup else {"solver": None}
    facts |= {**asdict(found), "intervals": found.intervals}
    facts |= {name: np.asarray(facts[name]).tolist() for name in ("correlation", "residuals")}
    print(json_text(facts) if arguments.json else _summary(facts, found))
    return 0


def _summary(facts, found):
    width = max(map(len, found.parameters))
    lines = [f"{facts['scene']} fitted to {facts['measured']}, {solver_line(facts) if facts['solver'] else 'at rest'}"]
    for name, value in found.parameters.items():
        error, (low, high) = found.errors[name], found.intervals[name]
        certain = f"± {100.0 * error:.2g} %, from {low:.5g} to {high:.5g}" if np.isfinite(error) else "not determined"
        lines.append(f"  {name.ljust(width)}  {value:.6g}  {certain}")
    names = list(found.parameters)
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        if np.isfinite(found.correlation[i, j]):
            lines.append(f"  correlation of {names[i]} and {names[j]}: {found.correlation[i, j]:.2f}")
    frames = int(np.isfinite(found.residuals).sum())
    over = f", over {frames} frame{'s' * (frames != 1)}" if facts["solver"] else ""
    ran = f"{found.runs} {'batches were' if facts['solver'] else 'sets of equilibria were'} run"
    lines.append(f"  residual {found.residual:.4g} m RMS{over}; {ran}")
    return "\n".join(lines)
