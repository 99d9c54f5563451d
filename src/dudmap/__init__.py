"""Dense RGB-D SLAM for places where things move: trajectory and static mesh on a CPU."""

from importlib import import_module
from typing import TYPE_CHECKING

from dudmap.version import __version__

_HOMES = {
    "Calibration": "core.geometry.calibration",
    "Camera": "core.geometry.camera",
    "CameraError": "errors",
    "Config": "config",
    "ConfigError": "errors",
    "DatasetError": "errors",
    "DudmapError": "errors",
    "Frame": "core.frames.frame",
    "FrameError": "errors",
    "FrameResult": "core.result",
    "MapError": "errors",
    "Mesh": "core.geometry.mesh",
    "MissingExtraError": "errors",
    "Mover": "core.objects.object_tracker",
    "RunObserver": "app.pipeline.observer",
    "SavedMap": "core.places.saved_map",
    "Sequence": "io.sequences",
    "Slam": "core.slam",
    "Trajectory": "core.geometry.trajectory",
    "TsdfVolume": "core.map.volume",
    "export_run": "io.exporting.exporters",
    "open_sequence": "io.sequences",
    "resume_system": "app.state.system",
    "run": "app.pipeline.run",
    "save_system": "app.state.system",
    "synthetic": "lab",
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
    "SavedMap",
    "Sequence",
    "Slam",
    "Trajectory",
    "TsdfVolume",
    "__version__",
    "export_run",
    "open_sequence",
    "resume_system",
    "run",
    "save_system",
    "synthetic",
]

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.app.pipeline.run import run
    from dudmap.app.state.system import resume_system, save_system
    from dudmap.config import Config
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.core.map.volume import TsdfVolume
    from dudmap.core.objects.object_tracker import Mover
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam
    from dudmap.errors import (
        CameraError,
        ConfigError,
        DatasetError,
        DudmapError,
        FrameError,
        MapError,
        MissingExtraError,
    )
    from dudmap.io.exporting.exporters import export_run
    from dudmap.io.sequences import Sequence, open_sequence
    from dudmap.lab import synthetic


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that importing dudmap loads neither numba nor cv2."""
    if name not in __all__ or name not in _HOMES:
        raise AttributeError(f"module 'dudmap' has no attribute {name!r}")
    home = f"dudmap.{_HOMES[name]}"
    value = import_module(f"{home}.{name}") if name == "synthetic" else getattr(import_module(home), name)
    globals()[name] = value
    return value
