"""Checkpoints: all that an interrupted run needs to go on, to the bit of one that was not interrupted.

A run that writes a file leaves one beside its frames with each finished chunk, instead of the one before, and none when it has
ended.
"""

import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ..base.digest import digest_of, scene_digest, source_digest
from ..base.interrupts import deferred

NAME = "checkpoint.npz"
# What two runs must have in common, and how a sentence calls it; of a digest without its value.
_CALLED = {
    "code": "another version of warpcloth or of Warp",
    "scene": "another scene",
    "vary": "other values of vary",
    "solver": "the solver {}",
    "device": "the device {}",
    "dtype": "dtype {}",
    "threads": "threads {}",
    "record": "record {}",
}


def facts_of(scene, solver, device, dtype, vary, threads, record=()):
    """All that the bits of a run depend on, by name.

    Raises:
        ValueError: If something in the scene is no data.
    """
    device = wp.get_device(device)
    return {
        "code": f"{source_digest()} {wp.__version__}",
        "scene": digest_of([scene_digest(scene), float(scene.duration)]),
        "vary": digest_of([[name, np.asarray(values)] for name, values in sorted((vary or {}).items())]),
        "solver": repr(solver.without_limits()),  # which its steps do not depend on
        "device": device.name if device.is_cuda else "cpu",
        "dtype": dtype,
        "threads": int(threads),
        "record": ", ".join(record) or "nothing",
    }


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A run after a frame that is the last of a chunk.

    Attributes:
        frame: Number of the frame.
        facts: As :func:`facts_of` gives them.
        chunks: Time code of the first frame and name of the file of each chunk until then.
        span: Time codes of the first and of the last frame.
        state, watch: What :class:`warpcloth.core.state.State` and :class:`warpcloth.run.watch.Watch` give for a file.
    """

    frame: int
    facts: dict
    chunks: list
    span: list
    state: dict
    watch: dict

    def write(self, folder):
        """Writes it into a folder, over one that is there.

        Raises:
            OSError: If it cannot be written; the one that is there stays.
        """
        about = json.dumps({"frame": self.frame, "facts": self.facts, "chunks": self.chunks, "span": self.span})
        arrays = {f"state {name}": values for name, values in self.state.items()}
        arrays |= {f"watch {name}": values for name, values in self.watch.items()}
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
        """The checkpoint of a file.

        Raises:
            ValueError: If it is none.
        """
        try:
            with np.load(path) as file:
                about, parts = json.loads(str(file["about"])), {"state": {}, "watch": {}}
                for key in file.files:
                    part, _, name = key.partition(" ")
                    if part in parts:
                        parts[part][name] = file[key]
                return cls(**about, **parts)
        except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile):
            raise ValueError(f"{path}: is no checkpoint that can be read; run without resume to begin anew") from None

    def refuse_other(self, output, facts):
        """Refuses to go on with another run.

        Raises:
            ValueError: Naming the first thing that differs.
        """
        for name, called in _CALLED.items():
            if self.facts.get(name) != facts[name]:
                theirs, mine = called.format(self.facts.get(name)), called.format(facts[name])
                now = "" if "{}" not in called else f", and this one has {mine}"
                raise ValueError(
                    f"{output}: cannot be resumed, because the run that was interrupted had {theirs}{now}; run as then, or "
                    "without resume to begin anew"
                )
