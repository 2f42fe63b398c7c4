"""USD stages: a cloth or a scene read from one, an animation or measures written as one. Nothing else here imports pxr."""

from . import modules as modules  # first

# isort: split
from .frames import FrameSequence
from .measures import MeasureWriter
from .scene import read_scene, write_scene
from .stage import StageMesh, flattened, read_mesh, read_stage_mesh
from .writer import AnimationWriter

__all__ = [
    "AnimationWriter",
    "FrameSequence",
    "MeasureWriter",
    "StageMesh",
    "flattened",
    "read_mesh",
    "read_scene",
    "read_stage_mesh",
    "write_scene",
]
