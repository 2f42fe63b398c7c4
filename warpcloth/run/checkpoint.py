"""Checkpoints, from which an interrupted run continues with the same bits as an uninterrupted one.

A run with a file replaces its checkpoint after each chunk of frames, and deletes it at the end.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ..base.digest import digest_of, scene_digest, source_digest
from ..base.interrupts import deferred

NAME = "checkpoint.npz"
# Facts that two runs must have in common, with words for the error message; {} stands for the value.
_CALLED = {
    "code": "another version of warpcloth or of Warp",
    "scene": "another scene",
    "vary": "other values of vary",
    "solver": "the solver {}",
    "device": "the device {}",
    "dtype": "dtype {}",
    "record": "record {}",
}


def facts_of(scene, solver, device, dtype, vary, record=()):
    """Returns everything that the bits of a run depend on, by name.

    Raises:
        ValueError: The scene cannot be hashed.
    """
    device = wp.get_device(device)
    return {
        "code": f"{source_digest()} {wp.__version__}",
        "scene": digest_of([scene_digest(scene), float(scene.duration)]),
        "vary": digest_of([[name, np.asarray(values)] for name, values in sorted((vary or {}).items())]),
        "solver": repr(solver.without_limits()),  # steps do not depend on the check of limits
        "device": device.name if device.is_cuda else "cpu",
        "dtype": dtype,
        "record": ", ".join(record) or "nothing",
    }


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of a run after the last frame of a chunk.

    Attributes:
        chunks: Time code of the first frame, and name of the file, of each chunk so far.
        span: Time codes of the first and of the last frame.
        state, watch: Values of :class:`warpcloth.core.state.State` and :class:`warpcloth.run.watch.Watch` on the host.
    """

    frame: int
    facts: dict
    chunks: list
    span: list
    state: dict
    watch: dict

    def write(self, folder):
        """Writes it into a folder, in place of an older one, which an OSError leaves."""
        arrays = {f"state {name}": values for name, values in self.state.items()}
        arrays |= {f"watch {name}": values for name, values in self.watch.items()}
        facts = {"frame": self.frame, "facts": self.facts, "chunks": self.chunks, "span": self.span}
        about = json.dumps([facts, list(arrays)])
        path = Path(folder) / NAME
        unfinished = path.with_suffix(".unfinished")
        try:
            with deferred():
                with open(unfinished, "wb") as file:
                    np.savez(file, about=np.array(about), **arrays)
                os.replace(unfinished, path)
        except OSError as error:
            raise OSError(f"{path}: could not be written: {error.strerror or error}") from None

    @classmethod
    def read(cls, path):
        """Reads the checkpoint in a file; refuses files without."""
        try:
            with np.load(path) as file:
                (facts, keys), parts = json.loads(str(file["about"])), {"state": {}, "watch": {}}
                for key in keys:
                    part, _, name = key.partition(" ")
                    parts[part][name] = file[key]
                return cls(**facts, **parts)
        except Exception:  # zipfile and NumPy raise errors of many types for a damaged file
            raise ValueError(f"{path}: is no checkpoint that can be read; run without resume to begin anew") from None

    def refuse_other(self, output, facts):
        """Raises ValueError with the first fact in which a run differs."""
        for name, called in _CALLED.items():
            if self.facts.get(name) != facts[name]:
                theirs, mine = called.format(self.facts.get(name)), called.format(facts[name])
                now = "" if "{}" not in called else f", and this one has {mine}"
                raise ValueError(
                    f"{output}: cannot be resumed, because the run that was interrupted had {theirs}{now}; run as then, or "
                    "without resume to begin anew"
                )
