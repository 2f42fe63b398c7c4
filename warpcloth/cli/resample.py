"""The command ``resample``: moves a template onto each frame of a capture, so that the result has one topology."""

import argparse
from contextlib import closing
from pathlib import Path

import numpy as np

from ..base.outputs import check_apart
from ..base.quiet import find_device
from ..base.texts import json_text
from .options import add_shared, add_stage, add_values, values_of
from .setup import named_scene
from .terminal import Progress, check_writable, frames_folder_of, location

TEXT = "Move a mesh onto each frame of a capture, so that its triangles stay."
EPILOG = """\
CAPTURE is a folder of .obj, .ply, .off, .stl or .glb files, or a pattern such as "scan/*.ply", of meshes that may change from
frame to frame, with noise and holes; or an animation. The template is a mesh file or a stage, which must lie near the first
frame, or a scene, which gives its start and its pins. --hold names further vertices that stay where the template is.

The template follows as rigidly as possible (ARAP). Over holes it follows its neighbours. Motion along the surface is only seen
at folds and at the outline. The output has two numbers of each vertex: captureDistance, its distance from the capture [m], and
captureObserved, 1 if it faces the capture.

  warpcloth resample scan --fps 60 --scale 0.001 --onto hanging -o resampled.usdc
  warpcloth analyze resampled.usdc --measure stretch rotation_angle --csv strain.csv
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    parser.add_argument("capture", metavar="CAPTURE", help="a folder or pattern of mesh files, or an animation")
    parser.add_argument("--onto", required=True, metavar="TEMPLATE", help="the mesh to move: a mesh file, a stage or a scene")
    add_values(parser, "-p", "parameter", "parameters of the scene")
    parser.add_argument("--hold", metavar="SELECTION", help="vertices of the template that stand still")
    parser.add_argument("--fps", type=float, help="frames per second of CAPTURE; overrides its own")
    text = "length of a unit of its mesh files [m] (default: 1)"
    parser.add_argument("--scale", type=float, default=1.0, metavar="M", help=text)
    parser.add_argument("--prim", help="path or name of the prim of CAPTURE, if it has several")
    text = "weight of the ARAP energy: less follows noise, more cuts across folds (default: 1e-3)"
    parser.add_argument("--stiffness", type=float, default=1e-3, help=text)
    text = "largest distance of points that count [m] (default: 10%% of the diagonal of the template)"
    parser.add_argument("--within", type=float, metavar="DISTANCE", help=text)
    text = "largest number of iterations of a frame (default: 60)"
    parser.add_argument("--iterations", type=int, default=60, metavar="N", help=text)
    text = "stop when no vertex moves by more than this share of the diagonal (default: 1e-5)"
    parser.add_argument("--tolerance", type=float, default=1e-5, help=text)
    add_shared(parser, "device", "json")
    add_stage(parser)
    add_shared(parser, "single_file")


def resample(arguments):
    from ..deformation.registration import resample
    from ..mesh.captures import open_capture
    from ..usd.chunks import check_output

    check_output(arguments.output)
    check_writable(arguments.output)
    device = find_device(arguments.device)
    capture = open_capture(arguments.capture, arguments.prim, arguments.fps, arguments.scale)
    arguments.prim = None
    check_apart([arguments.output], [*capture.files, arguments.onto])
    options = values_of(arguments, "stiffness", "within", "iterations", "tolerance")
    with closing(Progress()) as progress:
        found = resample(capture, **_template(arguments, capture), **options, device=device, progress=progress)
    found.write(arguments.output, arguments.single_file)
    late = int((~found.converged & (found.iterations > 0)).sum())
    facts = {
        "capture": arguments.capture,
        "template": arguments.onto,
        "frames": len(found.labels),
        "missing": [label.item() for label, count in zip(found.labels, found.iterations, strict=True) if not count],
        "vertices": len(found.mesh.points),
        "held": len(found.pins),
        "rms": float(np.sqrt(np.nanmean(found.rms**2))),
        "used": float(np.nanmean(found.used)),
        "observed": float(found.observed[found.iterations > 0].mean()),
        "not_converged": late,
        "most_iterations": int(found.iterations.max()),
        **options,
        "device": str(device),
        "file": arguments.output,
        "frames_folder": frames_folder_of(arguments),
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def _template(arguments, capture):
    """Returns the template, its start and its pins, as arguments of `resample`."""
    from ..mesh.mesh import Mesh
    from ..mesh.selection import some_vertices
    from ..scene.scene import Pins

    path, keyframes = Path(arguments.onto), None
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; --onto must be a mesh file, a stage or a scene")
    if path.suffix == ".py" or not path.suffix:
        _source, _values, scene = named_scene(argparse.Namespace(scene=arguments.onto, p=arguments.p))
        mesh, positions, pins = scene.mesh, scene.positions, scene.pins
        vertices = np.empty(0, dtype=int) if pins is None or not pins.held.all() else pins.vertices
        if len(vertices) and pins.keyframes is not None:
            keyframes = _at_frames(pins.keyframes, scene.fps, capture)
    else:
        if arguments.p:
            raise ValueError(f"-p is given, and {arguments.onto} is a mesh, which has no parameters; leave it out")
        mesh = Mesh.load(arguments.onto)
        positions, vertices = mesh.points, np.empty(0, dtype=int)
    if arguments.hold is not None:
        held = some_vertices("--hold", arguments.hold, mesh)
        if keyframes is not None:
            raise ValueError("--hold is given, and the pins of the scene move; leave it out")
        vertices = np.union1d(vertices, held)
    pins = Pins(vertices, keyframes) if len(vertices) else None
    return {"template": mesh, "positions": positions, "pins": pins}


def _at_frames(keyframes, fps, capture):
    """Returns keyframes (F, p, 3) at ``fps``, interpolated linearly at all frames of a capture, and constant after the last."""
    if capture.times is None:
        return keyframes
    times = np.linspace(capture.times[0], capture.times[-1], len(capture) + len(capture.missing)) * fps
    before = np.floor(times + 1e-6).astype(int).clip(0, len(keyframes) - 1)
    after = np.minimum(before + 1, len(keyframes) - 1)
    return keyframes[before] + (times - before).clip(0.0, 1.0)[:, None, None] * (keyframes[after] - keyframes[before])


def _summary(facts):
    facing = f"{100.0 * facts['observed']:.3g} % face the capture"
    lines = [
        f"{facts['capture']} resampled onto {facts['template']}",
        f"  frames        {facts['frames']}" + (f", {len(facts['missing'])} of them interpolated" if facts["missing"] else ""),
        f"  vertices      {facts['vertices']:,}, {facts['held']} of them held; {facing}",
        f"  distance      RMS {facts['rms']:.4g} m, of {100.0 * facts['used']:.3g} % of the area of the capture",
        f"  iterations    at most {facts['most_iterations']} a frame"
        + (f"; {facts['not_converged']} frames did not converge" if facts["not_converged"] else ""),
        f"  file          {location(facts)}",
    ]
    return "\n".join(lines)
