"""Describes the machine of a measurement."""

import os
import platform
from functools import cache
from pathlib import Path

from ..base.digest import source_digest
from ..base.quiet import find_device
from ..base.version import installed_version
from ..others.simulators import SIMULATORS


def machine(device="cpu"):
    """Returns the names of processor and device, numbers of cores, and versions, by name."""
    import numpy
    import scipy
    import warp as wp

    found = find_device(device)
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "device": found.name if found.is_cuda else "cpu",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "warp": wp.__version__,
        **{name: installed_version(each.package) for name, each in SIMULATORS.items()},
        "warpcloth": installed_version() or "checkout",
        "source": source_digest(),
    }


@cache
def name(device="cpu"):
    """Returns host, processor and, if it is not the CPU, device in a few words."""
    facts = machine(device)
    return ", ".join([platform.node(), facts["processor"], *([] if facts["device"] == "cpu" else [facts["device"]])])


def in_words(facts, others=()):
    """Formats the versions, also those of ``others``, and the device of :func:`machine` for a chart."""
    device = facts["device"] if facts["device"] != "cpu" else f"{facts['processor']}, {facts['cores']} cores"
    own = f"warpcloth {facts['warpcloth']} ({facts['source'][:8]})"
    return ", ".join([own, f"Warp {facts['warp']}", *(f"{SIMULATORS[name].title} {facts[name]}" for name in others), device])


def processor():
    """Returns the model name of the processor, from a file on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
