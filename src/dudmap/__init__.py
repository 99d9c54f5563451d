"""Dense RGB-D SLAM for places where things move: trajectory and static mesh on a CPU."""

from importlib import import_module
from typing import TYPE_CHECKING

from dudmap.version import __version__

_HOMES = {
    "Calibration": "core.geometry.calibration",
    "Camera": "core.geometry.camera",
    "CameraError": "errors",
    "CameraFrame": "io.cameras",
    "Config": "config",
    "ConfigError": "errors",
    "Cue": "core.dynamics.cue",
    "DatasetError": "errors",
    "DeviceError": "errors",
    "DudmapError": "errors",
    "DynamicsConfig": "config",
    "ExportOptions": "io.exporting.run_content",
    "Frame": "core.frames.frame",
    "FrameArrays": "core.frames.frame",
    "FrameError": "errors",
    "FrameRead": "app.pipeline.frame_source",
    "FrameResult": "core.result",
    "FrameView": "core.tracking.frame_view",
    "GivenPoses": "app.pipeline.given_poses",
    "InternalError": "errors",
    "LiveCamera": "io.cameras",
    "LoopsConfig": "config",
    "MapError": "errors",
    "MapSample": "core.backends.parameters",
    "MemoryLimit": "core.map.memory_limit",
    "Mesh": "core.geometry.mesh",
    "MissingExtraError": "errors",
    "Mover": "core.objects.object_tracker",
    "MoversConfig": "config",
    "Outcome": "core.verdict",
    "PreprocessConfig": "config",
    "RaycastResult": "core.backends.parameters",
    "Recording": "io.sequences",
    "RelocalizationConfig": "config",
    "RigidObject": "core.objects.object_map",
    "RunObserver": "app.pipeline.observer",
    "RunReport": "app.pipeline.run_folder",
    "SavedMap": "core.places.saved_map",
    "SensorConfig": "config",
    "Sequence": "io.sequences",
    "SimilarityConfig": "config",
    "Slam": "core.slam",
    "StateError": "errors",
    "Status": "core.result",
    "Shed": "core.shed",
    "Storing": "app.pipeline.storing",
    "SubmapsConfig": "config",
    "ThesisConfig": "thesis_config",
    "TrackerConfig": "config",
    "Trajectory": "core.geometry.trajectory",
    "TsdfVolume": "core.map.volume",
    "Verdict": "core.verdict",
    "VolumeConfig": "config",
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
    "CameraFrame",
    "Config",
    "ConfigError",
    "Cue",
    "DatasetError",
    "DeviceError",
    "DudmapError",
    "DynamicsConfig",
    "ExportOptions",
    "Frame",
    "FrameArrays",
    "FrameError",
    "FrameRead",
    "FrameResult",
    "FrameView",
    "GivenPoses",
    "InternalError",
    "LiveCamera",
    "LoopsConfig",
    "MapError",
    "MapSample",
    "MemoryLimit",
    "Mesh",
    "MissingExtraError",
    "Mover",
    "MoversConfig",
    "Outcome",
    "PreprocessConfig",
    "RaycastResult",
    "Recording",
    "RelocalizationConfig",
    "RigidObject",
    "RunObserver",
    "RunReport",
    "SavedMap",
    "SensorConfig",
    "Sequence",
    "Shed",
    "SimilarityConfig",
    "Slam",
    "StateError",
    "Status",
    "Storing",
    "SubmapsConfig",
    "ThesisConfig",
    "TrackerConfig",
    "Trajectory",
    "TsdfVolume",
    "Verdict",
    "VolumeConfig",
    "__version__",
    "export_run",
    "open_sequence",
    "resume_system",
    "run",
    "save_system",
    "synthetic",
]

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.app.pipeline.given_poses import GivenPoses
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.app.pipeline.run import run
    from dudmap.app.pipeline.run_folder import RunReport
    from dudmap.app.pipeline.storing import Storing
    from dudmap.app.state.system import resume_system, save_system
    from dudmap.config import (
        Config,
        DynamicsConfig,
        LoopsConfig,
        MoversConfig,
        PreprocessConfig,
        RelocalizationConfig,
        SensorConfig,
        SimilarityConfig,
        SubmapsConfig,
        TrackerConfig,
        VolumeConfig,
    )
    from dudmap.core.backends.parameters import MapSample, RaycastResult
    from dudmap.core.dynamics.cue import Cue
    from dudmap.core.frames.frame import Frame, FrameArrays
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.core.map.memory_limit import MemoryLimit
    from dudmap.core.map.volume import TsdfVolume
    from dudmap.core.objects.object_map import RigidObject
    from dudmap.core.objects.object_tracker import Mover
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.core.result import FrameResult, Status
    from dudmap.core.shed import Shed
    from dudmap.core.slam import Slam
    from dudmap.core.tracking.frame_view import FrameView
    from dudmap.core.verdict import Outcome, Verdict
    from dudmap.errors import (
        CameraError,
        ConfigError,
        DatasetError,
        DeviceError,
        DudmapError,
        FrameError,
        InternalError,
        MapError,
        MissingExtraError,
        StateError,
    )
    from dudmap.io.cameras import CameraFrame, LiveCamera
    from dudmap.io.exporting.exporters import export_run
    from dudmap.io.exporting.run_content import ExportOptions
    from dudmap.io.sequences import Recording, Sequence, open_sequence
    from dudmap.lab import synthetic
    from dudmap.thesis_config import ThesisConfig


def __getattr__(name: str) -> object:
    """Import a public name at first use, so that importing dudmap loads neither numba nor cv2."""
    if name not in __all__ or name not in _HOMES:
        raise AttributeError(f"module 'dudmap' has no attribute {name!r}")
    home = f"dudmap.{_HOMES[name]}"
    value = import_module(f"{home}.{name}") if name == "synthetic" else getattr(import_module(home), name)
    globals()[name] = value
    return value
