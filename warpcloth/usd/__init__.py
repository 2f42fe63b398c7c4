"""Reads cloths and scenes from USD stages, and writes animations and measures to them.

No other package imports pxr, and this one loads it when a stage is first used.
"""

from typing import TYPE_CHECKING

from ..base.catalogue import imported_on_use
from ..base.outputs import STAGE_ENDINGS
from ..mesh.mesh import READERS
from ..mesh.sequences import OPENERS

if TYPE_CHECKING:  # the table below, for type checkers
    from .frames import FrameSequence as FrameSequence
    from .frames import JoinedFrames as JoinedFrames
    from .measures import MeasureWriter as MeasureWriter
    from .scene import read_scene as read_scene
    from .scene import write_scene as write_scene
    from .stage import StageMesh as StageMesh
    from .stage import read_mesh as read_mesh
    from .stage import read_stage_mesh as read_stage_mesh
    from .writer import AnimationWriter as AnimationWriter

_MODULES = {
    "FrameSequence": "frames",
    "JoinedFrames": "frames",
    "MeasureWriter": "measures",
    "read_scene": "scene",
    "write_scene": "scene",
    "StageMesh": "stage",
    "read_mesh": "stage",
    "read_stage_mesh": "stage",
    "AnimationWriter": "writer",
}
__all__ = list(_MODULES)

if not TYPE_CHECKING:
    __getattr__ = imported_on_use(__name__, _MODULES | {"open_sequence": "frames"})

READERS.update(dict.fromkeys(STAGE_ENDINGS, lambda *given: __getattr__("read_mesh")(*given)))
OPENERS.update(dict.fromkeys(STAGE_ENDINGS, lambda *given: __getattr__("open_sequence")(*given)))
