"""Dense RGB-D SLAM for places where things move: trajectory and static mesh on a CPU."""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOMES = {
    "Camera": "geometry.camera",
    "Config": "config",
    "DudmapError": "errors",
    "Frame": "frames.frame",
    "FrameResult": "result",
    "Mesh": "geometry.mesh",
    "Slam": "slam",
    "Trajectory": "geometry.trajectory",
    "TsdfVolume": "mapping.volume",
    "open_sequence": "sequences",
}

__all__ = [
    "Camera",
    "Config",
    "DudmapError",
    "Frame",
    "FrameResult",
    "Mesh",
    "Slam",
    "Trajectory",
    "TsdfVolume",
    "__version__",
    "open_sequence",
]

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.errors import DudmapError
    from dudmap.frames.frame import Frame
    from dudmap.geometry.camera import Camera
    from dudmap.geometry.mesh import Mesh
    from dudmap.geometry.trajectory import Trajectory
    from dudmap.mapping.volume import TsdfVolume
    from dudmap.result import FrameResult
    from dudmap.sequences import open_sequence
    from dudmap.slam import Slam


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that importing dudmap loads neither numba nor cv2."""
    if name not in __all__ or name not in _HOMES:
        raise AttributeError(f"module 'dudmap' has no attribute {name!r}")
    value = getattr(import_module(f"dudmap.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
