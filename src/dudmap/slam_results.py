"""What a system has found so far: maps, trajectories, calibration, and its whole state as a file."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from dudmap.calibration.depth_model import DepthModel
from dudmap.color_calibration import ColorCalibration
from dudmap.config import Config
from dudmap.dynamics.detector import DynamicDetector
from dudmap.errors import ConfigError
from dudmap.geometry.calibration import Calibration
from dudmap.geometry.camera import Camera
from dudmap.geometry.trajectory import Trajectory
from dudmap.mapping.volume import TsdfVolume
from dudmap.objects.moving_objects import MovingObjects
from dudmap.objects.object_map import RigidObject
from dudmap.places.atlas import Atlas
from dudmap.places.prior_map import PriorMap
from dudmap.places.saved_map import SavedMap
from dudmap.tracking.quality_monitor import QualityMonitor

if TYPE_CHECKING:
    from dudmap.slam import Slam


class SlamResults:
    """The read-only side of ``Slam``; a map that is being rebuilt after a correction is completed before it is given.

    Attributes:
        config, camera: Of the system; the camera is that of the images without lens distortion.
        atlas: Submaps, keyframes, stored frames and poses.
        monitor: How well frames fit the map.
        color_calibration: Calibration of the colour camera.
        objects: The moving objects.
        detector: Knows what has moved.
    """

    config: Config
    camera: Camera
    atlas: Atlas
    monitor: QualityMonitor
    color_calibration: ColorCalibration
    objects: MovingObjects
    detector: DynamicDetector

    @property
    def volume(self) -> TsdfVolume:
        """Map of the current submap, complete: where it is being rebuilt after a correction, that is done first.

        Another object after a new submap was started or two were joined. ``atlas.volume`` is the map as it is.
        """
        self.atlas.complete()
        return self.atlas.volume

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames tracked so far in the submap with the most frames, after all corrections."""
        return self.atlas.trajectory(self.atlas.by_size()[0])

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and complete map of each submap, that with the most frames first; each has its own world."""
        self.atlas.complete()
        return [(self.atlas.trajectory(number), self.atlas.volumes[number]) for number in self.atlas.by_size()]

    @property
    def saved_map(self) -> SavedMap:
        """The main map as a later run goes on in it."""
        return replace(self.atlas.as_saved_map(), registrations=self.monitor.history)

    @property
    def calibration(self) -> Calibration:
        """Calibration of the colour camera in use."""
        return self.color_calibration.current

    @property
    def rigid_objects(self) -> list[RigidObject]:
        """The moving objects so far, where ``movers.meshes`` is set: shape and trajectory of those that are rigid."""
        return self.objects.rigid_objects({pose.timestamp: pose.T_world_camera for pose in self.atlas.poses})

    def learnt_depth_model(self) -> DepthModel:
        """Distortion of the depth, beyond the given model, that the frames kept for the rebuilding of the map show.

        Raises:
            ConfigError: No frames are kept, since ``relocalization``, or both ``loops`` and ``submaps`` are off.
        """
        from dudmap.calibration.depth_estimator import DepthView, estimate_distortion

        store = self.atlas.history
        if store is None:
            raise ConfigError("the depth model is learnt from kept frames; enable relocalization, and loops or submaps")
        main = self.atlas.by_size()[0]
        views = [
            DepthView.of(np.where(kept.static, kept.frame.depth, np.float32(0)), self.camera, kept.T_world_camera)
            for kept, submap in zip(store, store.submaps, strict=True) if submap == main
        ]  # fmt: skip
        return estimate_distortion(views, self.camera, self.config.sensor)

    def as_prior_map(self) -> PriorMap:
        """The largest submap and what else a second pass over the same recording needs."""
        self.atlas.complete()
        main = self.atlas.by_size()[0]
        poses = {pose.timestamp: pose.T_world_camera for pose in self.atlas.poses if pose.submap == main}
        return PriorMap(self.atlas.volumes[main], main, poses, self.atlas.keyframes, self.detector)

    def save(self, path: str | Path) -> None:
        """Write the whole state, from which ``resume`` goes on, replacing an older file at the end.

        Raises:
            StateError: The file cannot be written.
        """
        from dudmap.state.system import save_system

        save_system(cast("Slam", self), Path(path))

    @classmethod
    def resume(cls, path: str | Path, device: str | None = None) -> "Slam":
        """A system in the state that ``save`` wrote: the frames that follow give the same results, bit for bit.

        With another ``device`` than that of the run the results differ by roundings. The file stays open and must stay
        as it is while the system lives: stored frames are read from it.

        Raises:
            StateError: The file is missing, damaged, or was written by another version.
        """
        from dudmap.state.system import resume_system

        return resume_system(Path(path), device)
