"""Reads cloths and scenes from USD stages, and writes animations and measures to them.

No other package imports pxr, and this one loads it when a stage is first used.
"""

from ..base.outputs import STAGE_ENDINGS
from ..mesh.mesh import READERS
from ..mesh.sequences import OPENERS
from .frames import FrameSequence, JoinedFrames, open_sequence
from .measures import MeasureWriter
from .scene import read_scene, write_scene
from .stage import StageMesh, read_mesh, read_stage_mesh
from .writer import AnimationWriter

READERS.update(dict.fromkeys(STAGE_ENDINGS, read_mesh))
OPENERS.update(dict.fromkeys(STAGE_ENDINGS, open_sequence))

__all__ = [
    "AnimationWriter",
    "FrameSequence",
    "JoinedFrames",
    "MeasureWriter",
    "StageMesh",
    "read_mesh",
    "read_scene",
    "read_stage_mesh",
    "write_scene",
]
