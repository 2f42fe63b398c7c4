"""USD stages: a cloth read from one, an animation written as one. Nothing else in the package imports pxr."""

from .frames import FrameSequence
from .stage import StageMesh, read_mesh, read_stage_mesh

__all__ = ["FrameSequence", "StageMesh", "read_mesh", "read_stage_mesh"]
