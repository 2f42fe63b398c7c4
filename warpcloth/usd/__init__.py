"""USD stages: a cloth or a scene read from one, an animation or measures written as one.

Nothing else here imports pxr, and that is loaded when a stage is first touched.
"""

from ..mesh.mesh import READERS
from ..mesh.sequences import OPENERS
from .frames import FrameSequence, open_sequence
from .measures import MeasureWriter
from .scene import read_scene, write_scene
from .stage import ENDINGS, StageMesh, flattened, read_mesh, read_stage_mesh
from .writer import AnimationWriter

READERS.update(dict.fromkeys(ENDINGS, read_mesh))
OPENERS.update(dict.fromkeys(ENDINGS, open_sequence))

__all__ = [
    "ENDINGS",
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
