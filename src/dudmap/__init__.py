"""Dense RGB-D SLAM for places where things move: trajectory and static mesh on a CPU."""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "geometry.calibration",
    "Camera": "geometry.camera",
    "CameraError": "errors",
    "Config": "config",
    "ConfigError": "errors",
    "DatasetError": "errors",
    "DudmapError": "errors",
    "Frame": "frames.frame",
    "FrameError": "errors",
    "FrameResult": "result",
    "MapError": "errors",
    "Mesh": "geometry.mesh",
    "MissingExtraError": "errors",
    "Mover": "objects.object_tracker",
    "RunObserver": "pipeline.observer",
    "Sequence": "sequences",
    "Slam": "slam",
    "Trajectory": "geometry.trajectory",
    "TsdfVolume": "mapping.volume",
    "export_run": "exporting.exporters",
    "open_sequence": "sequences",
    "run": "pipeline.run",
}

__all__ = [
    "Calibration",
    "Camera",
    "CameraError",
    "Config",
    "ConfigError",
    "DatasetError",
    "DudmapError",
    "Frame",
    "FrameError",
    "FrameResult",
    "MapError",
    "Mesh",
    "MissingExtraError",
    "Mover",
    "RunObserver",
    "Sequence",
    "Slam",
    "Trajectory",
    "TsdfVolume",
    "__version__",
    "export_run",
    "open_sequence",
    "run",
]

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.errors import (
        CameraError,
        ConfigError,
        DatasetError,
        DudmapError,
        FrameError,
        MapError,
        MissingExtraError,
    )
    from dudmap.exporting.exporters import export_run
    from dudmap.frames.frame import Frame
    from dudmap.geometry.calibration import Calibration
    from dudmap.geometry.camera import Camera
    from dudmap.geometry.mesh import Mesh
    from dudmap.geometry.trajectory import Trajectory
    from dudmap.mapping.volume import TsdfVolume
    from dudmap.objects.object_tracker import Mover
    from dudmap.pipeline.observer import RunObserver
    from dudmap.pipeline.run import run
    from dudmap.result import FrameResult
    from dudmap.sequences import Sequence, open_sequence
    from dudmap.slam import Slam


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that importing dudmap loads neither numba nor cv2."""
    if name not in __all__ or name not in _HOMES:
        raise AttributeError(f"module 'dudmap' has no attribute {name!r}")
    value = getattr(import_module(f"dudmap.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
