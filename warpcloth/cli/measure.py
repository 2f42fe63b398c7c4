"""The command ``measure``: lets a sample of a textile laboratory come to rest, and prints what the device reads."""

import time

import numpy as np

from ..base.outputs import OutputSet, check_apart, check_replaceable
from ..base.quiet import find_device
from ..base.texts import json_text
from .options import add_fabric, add_scene, add_shared
from .setup import named_scene
from .terminal import aligned, check_writable, say

TEXT = "Read what a device of a textile laboratory measures."
EPILOG = """\
SCENE is cantilever, loop, cusick, strip or picture_frame, all of them with --fabric NAME. The sample is at rest: there is no
motion. With -o the shape is written as .npz, which 'warpcloth render' draws.

  warpcloth measure cantilever --fabric denim -p gamma=8 angle=45
  warpcloth measure cusick --fabric silk -o drape.npz
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add_scene(parser)
    add_fabric(parser)
    parser.add_argument("-o", "--output", metavar="FILE", help="also write the shape, as .npz")
    add_shared(parser, "device", "json")


def measure(arguments):
    from ..lab.laboratory import DEVICES, check_sample, laboratory_readings, recorded
    from ..run.equilibrium import equilibrium
    from ..scene.measured_fabrics import fabrics

    source, values, scene = named_scene(arguments)
    if scene.name not in DEVICES:
        raise ValueError(f"{arguments.scene} is no test of a laboratory; it must be one of {', '.join(DEVICES)}")
    check_sample(scene)
    if arguments.output is not None and not arguments.output.endswith(".npz"):
        raise ValueError(f"--output is {arguments.output}; it must end with .npz")
    check_apart([arguments.output] if arguments.output else [], [str(source.path)])
    check_writable(arguments.output)
    if arguments.output:
        check_replaceable(arguments.output)
    device = find_device(arguments.device)
    began = time.perf_counter()
    rest = equilibrium(scene, device=device, record="reactions")
    seconds = time.perf_counter() - began
    if not rest.status.ok:
        return say(f"{scene.name}: {rest.status.message}", 1)
    readings = laboratory_readings(scene, rest)
    record, why = {}, None
    if values.get("fabric") is not None:
        record, why = recorded(scene.name, fabrics.find(values["fabric"]), np.radians(values.get("angle", 0.0)))
    if arguments.output:
        with OutputSet() as outputs, outputs.writing(arguments.output) as file:
            np.savez(file, points=rest.points[None], triangles=scene.mesh.triangles, times=np.zeros(1))
    facts = {
        "scene": scene.name,
        "source": str(source.path),
        "parameters": values,
        "message": rest.status.message,
        "stable": rest.stable,
        "readings": {
            quantity: {"value": value, "unit": unit, "record": record.get(quantity)}
            for quantity, (value, unit) in readings.items()
        },
        "why": why if record else None,
        "iterations": rest.iterations,
        "seconds": seconds,
        "device": str(device),
        "file": arguments.output,
    }
    print(json_text(facts) if arguments.json else _summary(facts))
    return 0


def _summary(facts):
    rows, differ = [], False
    for quantity, each in facts["readings"].items():
        value, record = (None if number is None else f"{number:.4g}" for number in (each["value"], each["record"]))
        differ |= record not in (None, value)
        rows.append((quantity, f"{value} {each['unit']}".rstrip(), f"(record of the fabric: {record})" if record else ""))
    lines = [*aligned(rows), *([f"they differ because {facts['why']}"] if differ else [])]
    lines.append(f"{facts['iterations']} iterations, {facts['seconds']:.3g} s")
    return "\n".join([f"{facts['scene']}: {facts['message']}", *(f"  {line}" for line in lines)])
