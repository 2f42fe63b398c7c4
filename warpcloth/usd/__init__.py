"""USD stages: a cloth read from one, an animation written as one. Nothing else in the package imports pxr."""

from .frames import FrameSequence
from .stage import StageMesh, read_mesh, read_stage_mesh
from .writer import AnimationWriter

__all__ = ["AnimationWriter", "FrameSequence", "StageMesh", "read_mesh", "read_stage_mesh"]
