"""Recorders of frames: in memory, or as a USD file."""

import re

import numpy as np

import warpcloth.usd as usd

from ..scene.lines import lines_of
from .checkpoint import NAME, Checkpoint
from .history import PAIRS, collider_names, energy_names

REACTION = "reaction"  # name of the primvar


def primvar_names(names, kind="energies"):
    """Returns names of primvars, such as energies:work_of_pins, by those of their values."""
    found = {}
    for name in names:
        key = before = f"{kind}:" + (re.sub(r"\W", "_", name, flags=re.ASCII) or "_")
        number = 1
        while key in found.values():
            number += 1
            key = f"{before}_{number}"
        found[name] = key
    return found


class Memory:
    """Keeps frames in memory, in the precision of the run."""

    def __init__(self, frames, copies):
        self.frames, self._most, self._copies = 0, frames + 1, copies

    keeps = checkpoint = None  # no state

    def append(self, points, velocities, state=None, watch=None, recorded=None):
        if self.frames == 0:
            self.shape = (self._copies, len(points) // self._copies, 3) if self._copies > 1 else points.shape
            self.points, self.velocities = (np.empty((self._most, *self.shape), points.dtype) for _ in range(2))
        self.points[self.frames] = points.reshape(self.shape)
        self.velocities[self.frames] = velocities.reshape(self.shape)
        self.frames += 1

    def finish(self):
        """Ends the recording of a run that was not interrupted."""

    def close(self):
        pass

    def saved(self):
        return "nothing was saved"

    def read(self):
        return self.points[: self.frames], self.velocities[: self.frames]


class File:
    """Writes frames as USD, with a checkpoint until the run ends, and reads them back on demand.

    Args:
        single_file: Whether to end with a single file.
        facts: Function that returns :func:`warpcloth.run.checkpoint.facts_of` of the run.
        resume: Whether to continue an interrupted run.

    Attributes:
        checkpoint: The :class:`warpcloth.run.checkpoint.Checkpoint` to continue from, or None.

    Raises:
        ValueError: There is nothing to resume, or it is another run.
    """

    def __init__(self, scene, output, single_file, facts, resume=False, record=()):
        stage, self.single_file, self._output = scene.stage, single_file, output
        self._facts, self._found, self.checkpoint, self._ended = facts, None, None, False
        self._energies = primvar_names(energy_names(scene)) if "energies" in record else {}
        self._pairs = primvar_names(PAIRS, "self_contact") if "pairs" in record else {}
        self._pins, self._vertices = scene.pins.vertices, len(scene.mesh.points)
        self._rubbing, names = scene.rubbing, collider_names(scene) if "reactions" in record else []
        self._forces = [list(primvar_names(names, kind).values()) for kind in ("collider_forces", "friction_forces")]
        numbers = *self._energies.values(), *self._pairs.values()
        history = dict.fromkeys(numbers, "double") | ({REACTION: "float3[]"} if "reactions" in record else {})
        history |= dict.fromkeys((*self._forces[0], *(self._forces[1][c] for c in self._rubbing if names)), "double3")
        self._prims = [each.prim for each in stage.cloths] if stage else [f"/World/{name}" for name in scene.cloths]
        if stage is None:
            pins = {"pins": scene.pins.vertices} if len(scene.pins.vertices) else None
            lines = lines_of(scene)
            self.writer = usd.AnimationWriter(
                output,
                scene.mesh,
                scene.fps,
                pins=pins,
                up_axis=scene.up_axis,
                lines=lines,
                history=history,
                colliders=scene.colliders,
                cloths={name: name for name in scene.cloths},
            )
        else:
            cloths = {name: each.prim for name, each in zip(scene.cloths, stage.cloths, strict=True)}
            given = {"source": stage.path, "prim": stage.prim, "history": history, "cloths": cloths}
            self.writer = usd.AnimationWriter(output, scene.mesh, scene.fps, **given)
        self.saved = self.writer.saved
        if resume:
            try:
                self._resume()
            except BaseException:
                self.writer.close()  # nothing is pending; others may write
                raise

    def _resume(self):
        found = self.writer.runs_with(NAME)
        if not found:
            raise ValueError(
                f"{self._output}: there is nothing to resume, for no run to it was interrupted after its first "
                f"{self.writer.chunk} frames; run without resume to begin"
            )
        self.checkpoint = Checkpoint.read(found[0] / NAME)
        self.checkpoint.refuse_other(self._output, self._facts())
        self.writer.resume(found[0], self.checkpoint.chunks, self.checkpoint.span, self.checkpoint.frame + 1)

    @property
    def frames(self):
        return self.writer.frames

    def keeps(self, number):
        """Returns whether a checkpoint follows the frame of this number."""
        return (number + 1) % self.writer.chunk == 0 and self._known() is not None

    def _known(self):
        if self._found is None:
            try:
                self._found = (self._facts(),)
            except ValueError:
                self._found = (None,)
        return self._found[0]

    def append(self, points, velocities, state=None, watch=None, recorded=None):
        """Adds a frame, and at the end of a chunk a checkpoint of state and watch, if given."""
        self.writer.append(points, velocities, history=self._history(recorded or {}))
        if state is not None and self.writer.kept == self.writer.frames:
            chunks, span = self.writer.written()
            frame = self.writer.frames - 1
            Checkpoint(frame, self._known(), chunks, span, state, watch.to_host()).write(self.writer.run)

    def _history(self, recorded):
        found = {}
        if "energies" in recorded:
            found |= dict(zip(self._energies.values(), recorded["energies"][0].tolist(), strict=True))
        if "pairs" in recorded:
            found |= dict(zip(self._pairs.values(), recorded["pairs"][0].tolist(), strict=True))
        if "reactions" in recorded:
            found[REACTION] = np.zeros((self._vertices, 3))
            found[REACTION][self._pins] = recorded["reactions"][0]
        if "forces" in recorded:
            of_all, of_friction = np.moveaxis(recorded["forces"][0], 1, 0)
            found |= dict(zip(self._forces[0], of_all, strict=True))
            found |= {self._forces[1][c]: of_friction[c] for c in self._rubbing}
        return found

    def finish(self):
        """Ends an uninterrupted run, which leaves nothing to resume."""
        self._ended = True
        self.close()

    def close(self):
        checkpoint = self.writer.run / NAME
        try:
            self.writer.close(single_file=self.single_file, keep=not self._ended and checkpoint.exists())
        finally:
            if self._ended and self.writer.complete:
                checkpoint.unlink(missing_ok=True)

    def read(self):
        path = self.writer.path
        if self._prims:
            return usd.JoinedFrames(path, self._prims), usd.JoinedFrames(path, self._prims, "velocities")
        return usd.FrameSequence(path), usd.FrameSequence(path, attribute="velocities")
