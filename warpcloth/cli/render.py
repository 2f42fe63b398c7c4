"""The command ``render``: draws pictures and films of animations, without a display."""

import argparse
import time
from contextlib import closing
from pathlib import Path

from ..base.limits import shown_bytes
from ..base.outputs import check_apart
from ..base.quiet import find_device
from ..base.texts import json_text
from .analyze import add_measuring, measuring_of
from .options import add_shared, values_of
from .terminal import Counter, check_writable, own_output

SIZE = (1280, 720)
TEXT = "Draw a picture or a film of an animation."
EPILOG = """\
FILE is a USD stage, a mesh file, a folder or pattern of mesh files, or arrays in .npz or .npy. All meshes and linear curves of
a stage are drawn. Several FILEs are drawn side by side. The extension of -o selects the format: .png for one frame, .gif, .webp
or .mp4 for a film in real time (.mp4 needs PyAV: pip install -e '.[video]' in the checkout). --colour needs matplotlib.

  warpcloth render hanging.usdc -o hanging.mp4
  warpcloth render hanging.usdc -o last.png --size 1920x1080 --samples 16
  warpcloth render hanging.usdc -o strain.gif --colour stretch_1 --range 0.9 1.1 --time --size 640x360 --every 2
  warpcloth render coarse.usdc fine.usdc -o both.mp4 --frames 10:60 --speed 0.5 --azimuth 20
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="the animation or mesh to draw")
    add("beside", metavar="FILE", nargs="*", help="others to draw beside it")
    text = "the file to write: .png, .gif, .webp or .mp4 (default: a .png named after FILE; no file is then replaced)"
    add("-o", "--output", metavar="FILE", help=text)
    add("--frame", type=float, metavar="N", help="the frame of a .png, as FILE numbers them (default: the last)")
    add("--frames", type=frames, metavar="A:B", help="the first and the last frame of a film (default: all)")
    add("--every", type=int, default=1, metavar="K", help="draw only every K-th frame")
    add("--speed", type=float, default=1.0, metavar="FACTOR", help="0.5 plays at half speed (default: 1, real time)")
    add("--size", type=size, default=SIZE, metavar="WxH", help="width and height in pixels (default: 1280x720)")
    add("--samples", type=int, default=4, metavar="N", help="rays through each pixel (default: 4)")
    add("--colour", metavar="NAME", help="show a measured value as colour, such as stretch_1 (default: plain cloth)")
    add_camera(parser)
    add("--camera", metavar="PRIM", help="look from this Camera of the stage, a path or a name (default: the whole motion)")
    add("--time", action="store_true", help="write the time into a corner")
    add_measuring(parser)
    add_shared(parser, "device", "json")


def add_camera(parser):
    """Adds the options of the camera and the ground."""
    add = parser.add_argument
    add("--azimuth", type=float, default=-38.0, metavar="DEGREES", help="angle of the camera about the vertical (default: -38)")
    text = "angle of the camera above the horizontal (default: 24)"
    add("--elevation", type=float, default=24.0, metavar="DEGREES", help=text)
    add("--zoom", type=float, default=1.0, metavar="FACTOR", help="zoom in by this factor (default: 1, the whole motion)")
    add("--ground", type=float, metavar="HEIGHT", help="height of the ground [m] (default: the lowest point of the motion)")
    add("--no-ground", action="store_true", help="draw no ground")


def drawing_of(arguments):
    """Returns the ground, a height or whether there is one, and the options of what is measured for colours.

    Raises:
        ValueError: Two options exclude one another, or one needs another.
    """
    if arguments.no_ground and arguments.ground is not None:
        raise ValueError("--ground and --no-ground are given; give one of them")
    measuring = {name: value for name, value in measuring_of(arguments).items() if value not in (None, "midpoint")}
    if arguments.colour is None:
        for name in (*measuring, *(["range"] if arguments.colour_range else []), *(["colormap"] if arguments.colormap else [])):
            raise ValueError(f"--{name} is given without --colour, the name of what is measured")
    return not arguments.no_ground if arguments.ground is None else arguments.ground, measuring


def size(text):
    """Returns width and height from a text such as 640x360."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; it must be a width and a height, such as 1280x720")
    return tuple(map(int, parts))


def frames(text):
    """Returns the two ends of a text such as 10:50, None for one that is left out."""
    parts = text.split(":")
    try:
        first, last = (float(part) if part else None for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no range; it must be the first and the last frame, such as 10:50"
        ) from None
    return first, last


def render(arguments):
    from ..mesh.mesh import Surface

    files = [arguments.file, *arguments.beside]
    arguments.output = own_output(Path(arguments.file).stem, ".png") if arguments.output is None else arguments.output
    ground, measuring = drawing_of(arguments)
    check_drawing(arguments.output, files, arguments.size)
    device = find_device(arguments.device)
    rest = None if arguments.rest is None else Surface.load(arguments.rest, arguments.rest_prim)
    started = time.perf_counter()
    pictures = draw_film(
        files,
        arguments.output,
        mesh=rest,
        measuring=measuring,
        ground=ground,
        device=device.alias,
        **values_of(arguments, "prim", "fps", "up_axis", "frame", "frames", "every", "speed", "size", "samples", "time"),
        **values_of(arguments, "colour", "colour_range", "colormap", "azimuth", "elevation", "zoom", "camera"),
    )
    facts = {
        "input": files,
        "file": arguments.output,
        "pictures": pictures,
        "width": arguments.size[0],
        "height": arguments.size[1],
        "bytes": Path(arguments.output).stat().st_size,
        "seconds": time.perf_counter() - started,
        "device": device.alias,
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def check_drawing(path, others=(), size=SIZE):
    """Checks that a picture or film can be written, before anything is read or runs; does nothing for None."""
    from ..picture.films import check_film

    if path is not None:
        check_film(path, size)
        check_apart([path], others)
        check_writable(path)


def draw_film(source, output, **options):
    """Draws by :func:`warpcloth.render` with a progress bar on a terminal; returns the number of pictures."""
    from ..picture.render import render

    with closing(Counter("drawing", "pictures")) as progress:
        render(source, output, progress=progress, **options)
    return progress.done


def _summary(facts):
    count, seconds = facts["pictures"], facts["seconds"]
    each = f"{count} picture{'s' if count > 1 else ''} of {facts['width']} x {facts['height']} in {seconds:.3g} s"
    return f"{facts['file']}: {each}, {shown_bytes(facts['bytes'])}"
