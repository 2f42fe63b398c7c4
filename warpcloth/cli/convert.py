"""The command ``convert``: writes an animation in another format."""

from contextlib import closing

from ..base.texts import json_text
from .options import add_shared
from .terminal import Counter, check_writable

TEXT = "Write an animation in another format."
EPILOG = """\
FILE is a USD stage, a folder or pattern of .obj, .ply or .off files, or arrays in .npz, .npy, .pc2 or .mdd. It must have
triangles, the same in all frames. The ending of OUTPUT sets the format:
  .obj .ply                a file for each frame, such as cloth_0012.obj for cloth.obj, cloth.0012.obj for cloth.####.obj
  .pc2 .mdd                points of all frames; the first frame is written beside them as .obj
  .npz                     points, triangles and times, and the velocities of a stage
  .usd .usda .usdc .usdz   a stage
Vertices keep their order, and coordinates their axes; lengths are metres.

  warpcloth convert hanging.usdc hanging.pc2
  warpcloth convert hanging.usdc frames/hanging.obj
  warpcloth convert frames hanging.npz --fps 24
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    parser.add_argument("file", metavar="FILE", help="the animation to convert")
    parser.add_argument("output", metavar="OUTPUT", help="the file to write; its ending sets the format")
    parser.add_argument("--prim", help="path or name of the prim, or name of the geometry in each file, if there are several")
    parser.add_argument("--fps", type=float, help="frames per second (default: those of FILE, if it has them)")
    parser.add_argument("--rest", metavar="FILE", help="mesh with the triangles of an .npy, .pc2 or .mdd file")
    add_shared(parser, "json")


def convert(arguments):
    from ..mesh.mesh import Surface
    from ..usd.conversion import convert as write

    check_writable(arguments.output)
    rest = None if arguments.rest is None else Surface.load(arguments.rest)
    with closing(Counter("writing", "frames")) as progress:
        sequence, paths = write(arguments.file, arguments.output, arguments.prim, arguments.fps, rest, progress)
    facts = {
        "input": arguments.file,
        "frames": len(sequence),
        "vertices": len(sequence.mesh.points),
        "triangles": len(sequence.mesh.triangles),
        "files": [str(path) for path in paths],
        "missing": sequence.missing,
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def _summary(facts):
    first, *more = facts["files"]
    names = f"{first} and {more[-1]}" if len(more) == 1 else f"{first} to {more[-1]}" if more else first
    count, missing = facts["frames"], facts["missing"]
    text = f"{names}: {count} frame{'s' if count > 1 else ''} of {facts['vertices']} vertices"
    return text + (f"; {len(missing)} frames are missing, the first is {missing[0]}" if missing else "")
