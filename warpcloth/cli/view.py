"""The command ``view``: writes a page that shows an animation in a browser."""

import time
from contextlib import closing
from pathlib import Path

from ..base.limits import shown_bytes
from ..base.outputs import check_apart
from ..base.quiet import find_device
from ..base.texts import json_text
from .analyze import add_measuring
from .options import add_shared, values_of
from .render import add_camera, drawing_of, frames
from .terminal import Counter, check_writable, own_output

TEXT = "Write a page that shows an animation in a browser."
EPILOG = """\
FILE is a USD stage, a mesh file, a folder or pattern of mesh files, or arrays in .npz or .npy. The page is one file of HTML
that loads nothing else: open it in a browser. It plays in real time and turns by the mouse. Positions are stored with 16 bits,
values with 8: the page is for looking, not for measuring. Colours need matplotlib.

  warpcloth view hanging.usdc -o hanging.html
  warpcloth view hanging.usdc -o strain.html --colour stretch_1 --range 0.9 1.1 --frames 10:60
  warpcloth view walk.usdc -o walk.html --colour area_ratio --colour rotation_angle --every 2
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add("file", metavar="FILE", help="the animation or mesh to show")
    text = "the .html file to write (default: named after FILE; no file is then replaced)"
    add("-o", "--output", metavar="FILE", help=text)
    add("--frames", type=frames, metavar="A:B", help="the first and the last frame (default: all)")
    add("--every", type=int, default=1, metavar="K", help="show only every K-th frame")
    text = (
        "a measured value that the page can show as colour, such as area_ratio; may be given more than once "
        "(default: stretch_1 and stretch_2, and the page opens with plain cloth)"
    )
    add("--colour", metavar="NAME", action="append", help=text)
    add("--plain", action="store_true", help="measure nothing, so that the page is smaller")
    add_camera(parser)
    add_measuring(parser)
    add_shared(parser, "device", "json")


def view(arguments):
    from ..mesh.mesh import Surface
    from ..picture.pages import check_page
    from ..picture.pages import view as write_page

    if arguments.plain and arguments.colour:
        raise ValueError("--plain and --colour are given; give one of them")
    ground, measuring = drawing_of(arguments)
    arguments.output = own_output(Path(arguments.file).stem, ".html") if arguments.output is None else arguments.output
    check_page(arguments.output)
    check_apart([arguments.output], [arguments.file, arguments.rest])
    check_writable(arguments.output)
    device = find_device(arguments.device)
    rest = None if arguments.rest is None else Surface.load(arguments.rest, arguments.rest_prim)
    started = time.perf_counter()
    with closing(Counter("coding", "frames")) as progress:
        write_page(
            arguments.file,
            arguments.output,
            mesh=rest,
            colours=() if arguments.plain else arguments.colour,
            measuring=measuring or None,
            ground=ground,
            device=device.alias,
            progress=progress,
            **values_of(arguments, "prim", "fps", "up_axis", "frames", "every", "colour_range", "colormap"),
            **values_of(arguments, "azimuth", "elevation", "zoom"),
        )
    facts = {
        "input": arguments.file,
        "file": arguments.output,
        "frames": progress.done,
        "bytes": Path(arguments.output).stat().st_size,
        "seconds": time.perf_counter() - started,
        "device": device.alias,
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def _summary(facts):
    count = facts["frames"]
    frames = f"{count} frame{'s' if count > 1 else ''} in {facts['seconds']:.3g} s"
    return f"{facts['file']}: {frames}, {shown_bytes(facts['bytes'])}; open it in a browser"
