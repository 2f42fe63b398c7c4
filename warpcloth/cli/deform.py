"""The command ``deform``: deforms a mesh by handles that the command line moves, or by the moving pins of a scene."""

import argparse
import math
import statistics
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.checks import whole
from ..base.limits import refuse_memory
from ..base.outputs import STAGE_ENDINGS
from ..base.quiet import find_device
from ..base.texts import convert, json_text
from .options import DOUBLE, add_shared, add_stage, add_values, values_of
from .setup import named_scene, warn_of_seams
from .terminal import Progress, check_writable, frames_folder_of, location

_FRAMES, _FPS = 24, 24.0

TEXT = "Deform a mesh by handles, as rigidly as possible (ARAP)."
EPILOG = """\
--fix holds vertices where they are. --move moves vertices by the --rotate and --translate that follow it, before the next
--move. --rotate turns them by DEGREES about AXIS, which passes through (CX, CY, CZ), or through their centroid if that is not
given. AXIS is x, y, z or a vector such as 1,0,-1. 720 degrees are two turns, but between two frames a turn must be less than
180 degrees. The rotation is applied before the translation, in whatever order they are given, and both are spread evenly
over the frames.

A SELECTION is a text such as "y < 0.1 and not boundary" or "nearest(0, 1.5, 0, 40)", in metres and in world space, whatever
the units of the file.

--weights: cotangent (may be negative), intrinsic (cotangents of the intrinsic Delaunay triangulation), uniform, or clamped
(negative cotangents set to 0). --energy: spokes (the edges at a vertex), or spokes_and_rims (also the edges opposite to it
in its triangles; only with cotangent weights).

  warpcloth deform bunny.usd --fix "y < 0.2" --move "y > 1.3" --rotate 60 x --translate 0 0 0.3 -o out.usdc
"""


@dataclass
class _Move:
    """One --move: ``turn`` is degrees, axis (3,) and centre (3,) or None; ``shift`` is (3,) [m]."""

    selection: str
    turn: tuple | None = None
    shift: np.ndarray | None = None


def add_arguments(parser):
    """Adds the arguments of this command."""
    text = "a mesh file, a USD stage, or a scene with moving pins (a name or a .py file)"
    parser.add_argument("mesh", metavar="MESH", help=text)
    hold = "vertices to hold in place; may be repeated"
    parser.add_argument("--fix", action="append", default=[], metavar="SELECTION", help=hold)
    take = "vertices to move by the --rotate and --translate that follow; may be repeated"
    parser.add_argument("--move", action=_AddMove, dest="moves", default=[], metavar="SELECTION", help=take)
    turn = "rotate the vertices of the preceding --move: DEGREES AXIS, or DEGREES AXIS CX CY CZ"
    parser.add_argument("--rotate", action=_AddRotation, dest="moves", nargs="+", metavar=("DEGREES", "AXIS"), help=turn)
    shift = "translate the vertices of the preceding --move [m]"
    parser.add_argument("--translate", action=_AddTranslation, dest="moves", nargs=3, metavar=("X", "Y", "Z"), help=shift)
    text = f"number of frames after the first (default: {_FRAMES}; for a scene, one per keyframe)"
    parser.add_argument("--frames", type=int, metavar="N", help=text)
    parser.add_argument("--fps", type=float, help=f"frames per second (default: that of the stage, else {_FPS:g})")
    parser.add_argument("--prim", help="path or name of the mesh, if the file has several")
    add_values(parser, "-p", "parameter", "parameters of the scene")
    text = "weights of the edges (default: cotangent)"
    parser.add_argument("--weights", choices=("cotangent", "intrinsic", "uniform", "clamped"), default="cotangent", help=text)
    text = "edges in the ARAP energy of each vertex (default: spokes)"
    parser.add_argument("--energy", choices=("spokes", "spokes_and_rims"), default="spokes", help=text)
    parser.add_argument(
        "--iterations", type=int, default=500, metavar="N", help="maximum number of iterations per frame (default: 500)"
    )
    text = "stop when an iteration lowers the energy by less than this fraction (default: 1e-6)"
    parser.add_argument("--tolerance", type=float, default=1e-6, help=text)
    add_shared(parser, "device", "json", "dtype", dtype=DOUBLE)
    add_stage(parser)
    add_shared(parser, "single_file")


class _AddMove(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        namespace.moves = [*namespace.moves, _Move(values)]


class _AddRotation(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        move = _last(namespace, option_string, "turn")
        if len(values) not in (2, 5):
            raise ValueError(f"--rotate {' '.join(values)}: it takes DEGREES AXIS, or DEGREES AXIS CX CY CZ")
        axis = dict(zip("xyz", np.eye(3), strict=True)).get(values[1])
        try:
            axis = _vector("AXIS", values[1].split(",")) if axis is None else axis
        except ValueError:
            axis = np.zeros(3)
        if len(axis) != 3 or not axis.any():
            raise ValueError(f"the AXIS of --rotate is {values[1]!r}; it must be x, y, z or a vector such as 1,0,-1")
        axis = axis / np.abs(axis).max()  # so that squares do not overflow
        centre = _vector("the centre of --rotate", values[2:]) if len(values) == 5 else None
        move.turn = (_number("DEGREES of --rotate", values[0]), axis / np.linalg.norm(axis), centre)


class _AddTranslation(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        _last(namespace, option_string, "shift").shift = _vector("--translate", values)


def _last(namespace, option, field):
    """Returns the move to which an option belongs."""
    if not namespace.moves:
        raise ValueError(f"{option} stands before any --move; it says how the --move before it goes")
    move = namespace.moves[-1]
    if getattr(move, field) is not None:
        raise ValueError(f"--move {move.selection!r} has {option} twice; each may follow it once")
    return move


def _number(name, text):
    value = convert(name, text, (float,))
    if not math.isfinite(value):
        raise ValueError(f"{name} is {text!r}; it must be finite")
    return value


def _vector(name, texts):
    return np.array([_number(name, text) for text in texts])


def deform(arguments):
    from ..deformation.deform import deform

    name, values, given = _given(arguments)
    warn_of_seams(given["mesh"])
    frames = len(given["pins"].keyframes) - 1
    check_writable(arguments.output)
    device = find_device(arguments.device)
    options = values_of(arguments, "weights", "energy", "iterations", "tolerance", "dtype")
    progress = Progress(frames, first="factorising")
    with progress.of(arguments.output):
        found = deform(
            **given, **options, device=device, output=arguments.output, single_file=arguments.single_file, progress=progress
        )
        progress.close()
        late = np.flatnonzero(~found.converged)
        unmet = f"{len(late)} of the frames did not converge, the first is {late[0]}" if len(late) else "converged"
        facts = {
            "mesh": name,
            "source": arguments.mesh,
            "parameters": values,
            "converged": not len(late),
            "message": unmet,
            "vertices": len(given["mesh"].points),
            "handles": len(given["pins"].vertices),
            "frames": frames,
            "seconds_per_frame": statistics.median(found.timings["frames"]),
            "factorise_seconds": found.timings["factorise"],
            "median_iterations": float(np.median(found.iterations)),
            "most_iterations": int(found.iterations.max()),
            "largest_angle": math.degrees(found.largest_angles.max()),
            "last_energy": float(found.energies[-1]),
            **options,
            "device": str(device),
            "file": arguments.output,
            "frames_folder": frames_folder_of(arguments),
        }
        print(json_text(facts) if arguments.json else _summary(facts))
        return 0


def _summary(facts):
    return "\n".join(
        [
            f"{facts['mesh']}: {facts['message']}",
            f"  frames        {facts['frames']}, {facts['seconds_per_frame']:.3g} s each (median)",
            f"  handles       {facts['handles']} of {facts['vertices']} vertices",
            f"  iterations    {facts['median_iterations']:g} a frame (median), at most {facts['most_iterations']}",
            f"  largest angle {facts['largest_angle']:.4g}° from rest",
            f"  energy        {facts['last_energy']:.4g} m² in the last frame",
            f"  method        {facts['energy']}, {facts['weights']} weights, tolerance {facts['tolerance']:g}",
            f"  device        {facts['device']}, {facts['dtype']}",
            f"  file          {location(facts)}",
        ]
    )


def _given(arguments):
    """Returns (name, parameters of the scene, arguments of `deform`) from the command line."""
    from ..scene.scene import Pins

    path = Path(arguments.mesh)
    if arguments.frames is not None:
        whole("frames", arguments.frames, least=1)
    if path.suffix == ".py" or (path.name == arguments.mesh and not path.suffix):
        _source, values, scene = named_scene(argparse.Namespace(scene=arguments.mesh, p=arguments.p))
        _refuse(arguments, ("fix", "moves", "fps", "prim"), "is a scene, whose pins and keyframes are taken as they are")
        keyframes = scene.pins.keyframes
        if keyframes is None:
            raise ValueError(
                f"the pins of {scene.name} do not move; give a scene whose pins have keyframes, or a mesh and --move"
            )
        if arguments.frames is not None:  # pins do not move after the last keyframe
            _refuse_size(arguments.frames, scene.mesh, keyframes.shape[1])
            keyframes = keyframes[np.minimum(np.arange(arguments.frames + 1), len(keyframes) - 1)]
        pins = Pins(scene.pins.vertices, keyframes, scene.pins.axes)
        given = {"mesh": scene.mesh, "pins": pins, "fps": scene.fps, "stage": scene.stage, "up_axis": scene.up_axis}
        return scene.name, values, given
    _refuse(arguments, ("p",), "is a mesh and has no parameters")
    if path.suffix.lower() in STAGE_ENDINGS:
        from ..usd import read_stage_mesh

        stage = read_stage_mesh(arguments.mesh, arguments.prim)
        mesh, fps = stage.mesh, stage.fps or _FPS
    else:
        from ..mesh.mesh import Mesh

        stage, mesh, fps = None, Mesh.load(arguments.mesh, arguments.prim), _FPS
    pins = Pins(*_handles(mesh, arguments.fix, arguments.moves, arguments.frames or _FRAMES))
    return path.name, {}, {"mesh": mesh, "pins": pins, "fps": fps if arguments.fps is None else arguments.fps, "stage": stage}


def _refuse(arguments, names, why):
    options = {"fix": "--fix", "moves": "--move", "fps": "--fps", "prim": "--prim", "p": "-p"}
    for name in names:
        if getattr(arguments, name) not in (None, []):
            raise ValueError(f"{options[name]} is given, and {arguments.mesh} {why}; leave it out")


def _handles(mesh, fixes, moves, frames):
    """Returns vertices (p,) that are held or moved, and their positions (frames + 1, p, 3)."""
    from ..mesh.selection import some_vertices

    if not moves:
        raise ValueError("nothing moves; give --move SELECTION and after it --rotate or --translate")
    for move in moves:
        if move.turn is None and move.shift is None:
            raise ValueError(f"--move {move.selection!r} does not say how; --rotate or --translate must follow it")
    named = [(f"--fix {text!r}", text, None) for text in fixes]
    named += [(f"--move {move.selection!r}", move.selection, move) for move in moves]
    groups = [(option, some_vertices(option, text, mesh), move) for option, text, move in named]
    owners = np.full(len(mesh.points), -1)
    for number, (option, vertices, move) in enumerate(groups):
        taken = vertices[owners[vertices] >= 0]
        if move is not None and len(taken):
            other = groups[owners[taken[0]]][0]
            raise ValueError(f"{option} and {other} both name vertex {taken[0]}; one alone may say where it goes")
        if move is not None and move.turn is not None and abs(move.turn[0]) >= 180.0 * frames:
            least = math.floor(abs(move.turn[0]) / 180.0) + 1
            raise ValueError(
                f"{option} turns by {abs(move.turn[0]) / frames:g}° a frame, which must be less than 180°; "
                f"give --frames {least} or more"
            )
        owners[vertices] = number
    handles = np.flatnonzero(owners >= 0)
    _refuse_size(frames, mesh, len(handles))
    time = np.linspace(0.0, 1.0, frames + 1)
    keyframes = np.tile(mesh.points[handles], (frames + 1, 1, 1))
    for number, (_, _, move) in enumerate(groups):
        if move is not None:
            own = owners[handles] == number
            keyframes[:, own] = _path(move, mesh.points[handles[own]], time)
    return handles, keyframes


def _refuse_size(frames, mesh, handles):
    """Raises ValueError if positions of handles, points and angles of all frames exceed the free memory."""
    refuse_memory(f"frames is {frames:,}", 8 * frames * (3 * handles + 4 * len(mesh.points)))


def _path(move, points, time):
    """Returns positions (F, p, 3) of points during a move, at times (F,) from 0 to 1."""
    from scipy.spatial.transform import Rotation

    path = np.tile(points, (len(time), 1, 1))
    if move.turn is not None:
        degrees, axis, centre = move.turn
        centre = points.mean(axis=0) if centre is None else centre
        rotations = Rotation.from_rotvec(np.radians(degrees) * time[:, None] * axis).as_matrix()
        path = (path - centre) @ rotations.transpose(0, 2, 1) + centre
    return path if move.shift is None else path + time[:, None, None] * move.shift
