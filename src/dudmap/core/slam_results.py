"""What a system has found so far: maps, trajectories and calibration."""

from dataclasses import dataclass, replace

from dudmap.config import Config
from dudmap.core.color_calibration import ColorCalibration
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.objects.moving_objects import MovingObjects
from dudmap.core.objects.object_map import RigidObject
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.saved_map import PriorMap, SavedMap
from dudmap.core.tracking.quality_monitor import QualityMonitor


@dataclass(frozen=True, eq=False)
class SlamArguments:
    """Arguments of ``Slam``, except a first pass and a saved map, of which the state holds what is used."""

    camera: Camera
    config: Config
    calibration: Calibration | None
    live: bool
    localize: bool
    max_blocks: int | MemoryLimit | None
    timed: bool


class SlamResults:
    """The read-only side of ``Slam``; a map that is being rebuilt after a correction is completed before it is given.

    Attributes:
        config, camera: Of the system; the camera is that of the images without lens distortion.
        atlas: Submaps, keyframes, stored frames and poses.
        monitor: How well frames fit the map.
        color_calibration: Calibration of the colour camera.
        objects: The moving objects.
        detector: Knows what has moved.
        prior_map: In a second pass the map of the first, else None.
    """

    config: Config
    camera: Camera
    atlas: Atlas
    monitor: QualityMonitor
    color_calibration: ColorCalibration
    objects: MovingObjects
    detector: DynamicDetector
    prior_map: PriorMap | None

    @property
    def reference(self) -> TsdfVolume:
        """Map that frames are registered to: the current one, or in a second pass that of the first."""
        return self.atlas.volume if self.prior_map is None else self.prior_map.volume

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

    def as_prior_map(self) -> PriorMap:
        """The largest submap and what else a second pass over the same recording needs."""
        self.atlas.complete()
        self.atlas.keyframes.settle()
        main = self.atlas.by_size()[0]
        poses = {pose.timestamp: pose.T_world_camera for pose in self.atlas.poses if pose.submap == main}
        return PriorMap(self.atlas.volumes[main], main, poses, self.atlas.keyframes, self.detector)
