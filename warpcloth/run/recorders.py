"""Recorders of frames: in memory, or as a USD file."""

import numpy as np

from ..usd import AnimationWriter, FrameSequence
from .lines import lines_of


class Memory:
    """Keeps frames in memory, in the precision of the run."""

    def __init__(self, frames, copies):
        self.frames, self._most, self._copies = 0, frames + 1, copies

    def append(self, points, velocities):
        if self.frames == 0:
            self.shape = (self._copies, len(points) // self._copies, 3) if self._copies > 1 else points.shape
            self.points, self.velocities = (np.empty((self._most, *self.shape), points.dtype) for _ in range(2))
        self.points[self.frames] = points.reshape(self.shape)
        self.velocities[self.frames] = velocities.reshape(self.shape)
        self.frames += 1

    def close(self):
        pass

    def saved(self):
        return "nothing was saved"

    def read(self):
        return self.points[: self.frames], self.velocities[: self.frames]


class File:
    """Writes frames as USD and reads them back when asked."""

    def __init__(self, scene, output, single_file):
        stage, self.single_file = scene.stage, single_file
        if stage is None:
            pins = {"pins": scene.pins.vertices} if len(scene.pins.vertices) else None
            lines = lines_of(scene)
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, pins=pins, up_axis=scene.up_axis, lines=lines)
        else:
            self.writer = AnimationWriter(output, scene.mesh, scene.fps, source=stage.path, prim=stage.prim)
        self.append, self.saved = self.writer.append, self.writer.saved

    @property
    def frames(self):
        return self.writer.frames

    def close(self):
        self.writer.close(single_file=self.single_file)

    def read(self):
        path = self.writer.path
        return FrameSequence(path), FrameSequence(path, attribute="velocities")
