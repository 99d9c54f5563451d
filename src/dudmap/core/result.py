"""Results: of each frame, and the maps, trajectories and calibration so far."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property, partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.calibration.self_calibration import ColorCalibration
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.masks import Labels
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.mapper import Mapper
from dudmap.core.objects.moving_objects import MovingObjects
from dudmap.core.objects.object_map import RigidObject
from dudmap.core.objects.object_tracker import Mover
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.saved_map import PriorMap, SavedMap
from dudmap.core.shed import Shed
from dudmap.core.state import CACHE
from dudmap.core.tracking.motion_model import GivenRole
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import Verdict
from dudmap.errors import ConfigError


class Status(StrEnum):
    """Outcome of a frame.

    * TRACKED: it has a pose.
    * REPEATED: its images, or its depth, equal the frame before. It has the same pose; if only the depth repeats, the
      predicted pose, which the trajectory interpolates once the next frame is tracked.
    * LOST: its pose cannot be trusted.
    * REJECTED: it is ignored for a fault of the stream, such as a wrong time stamp.
    """

    TRACKED = "tracked"
    REPEATED = "repeated"
    LOST = "lost"
    REJECTED = "rejected"


Event = Literal["started", "relocalized", "corrected", "calibrated"]
"""Event of a frame.

* started: A map starts.
* relocalized: The pose comes from a recognised place.
* corrected: Earlier poses changed: a loop was closed, or a young map started again.
* calibrated: ``Slam.calibration`` is new after this frame.
"""


UNCERTAIN = "unobservable", "saturated"
"""Checks that doubt pose and labels of a tracked frame."""


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of processing one frame.

    The covariance is the variance of a residual, from sums over blocks of pixels because neighbours are correlated,
    times the inverse Hessian of the registration. Unobserved directions have the variance of the predicted motion.
    Errors of the map (drift) and of the calibration are not included. The frame that starts a map has a covariance of
    0.

    Attributes:
        timestamp: Time of the depth image, seconds; after a change of the clock, on the first clock.
        status: Outcome of the frame.
        T_world_camera: Camera pose (4, 4); None unless tracked or repeated.
        covariance: (6, 6) of the pose error: displacement of the camera's centre (m), then rotation about it (rad), in
            world axes, as in a ROS ``PoseWithCovariance``. None without a pose or with a given one.
        verdict: Outcomes of the checks.
        dynamic_mask: (H, W) bool, dynamic pixels of the recorded image.
        dynamic_share: Share of the depth measurements in the mask.
        residuals: (h, w) float32 signed distances to the map, metres, label resolution; NaN off the map.
        timings: Milliseconds per stage.
        submap: Number of the submap, 0 the first.
        events: Events of the frame.
        shed: Omitted work, see ``Slam.shed``.
    """

    timestamp: float
    status: Status
    T_world_camera: NDArray[np.float64] | None
    covariance: NDArray[np.float64] | None
    verdict: Verdict
    dynamic_mask: NDArray[np.bool_]
    dynamic_share: float
    residuals: NDArray[np.float32]
    timings: dict[str, float] = field(default_factory=dict)
    submap: int = 0
    events: tuple[Event, ...] = ()
    shed: Shed = field(default=Shed.NOTHING, metadata=CACHE)
    _labels: Labels | None = None
    _tracking: TrackingResult | None = None
    _find_movers: Callable[[], tuple[Mover, ...]] | None = None

    def __repr__(self) -> str:
        """The status without the images."""
        reason = f": {self.verdict.reason}" if self.verdict.reason else ", fused" if self.fused else ""
        return f"FrameResult({self.timestamp:.6f} s, {self.status}{reason}, {self.dynamic_share:.1%} dynamic)"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the frame is lost, rejected, repeated or not fused; the first reason decided."""
        return tuple(outcome.reason for outcome in self.verdict.failed)

    @property
    def fused(self) -> bool:
        """Whether the map takes the static pixels; a map younger than 0.4 s may hold them back."""
        return self.status is Status.TRACKED and self.verdict.accepted

    @property
    def blind(self) -> bool:
        """Whether only distances determine the pose, because the image carries no information."""
        return "blind" in self.verdict or "color_repeats" in self.verdict

    @property
    def uncertain(self) -> str:
        """Why pose and labels of a tracked frame may be wrong; empty if certain. In a crowd the frame is fused."""
        failed, outcomes = self.verdict.failed, self.verdict.outcomes
        doubts = (one for one in outcomes if one.name == "crowd" or (one.name in UNCERTAIN and one in failed))
        return next((one.reason for one in doubts if one.reason), "")

    @property
    def histogram(self) -> NDArray[np.int64] | None:
        """(BINS,) counts of the residuals in standard deviations; None if no pixel was labelled."""
        return None if self._labels is None else self._labels.histogram

    @cached_property
    def movers(self) -> tuple[Mover, ...]:
        """Moving objects by id, computed at the first access; none in a lost frame."""
        return () if self._find_movers is None else deepcopy(self._find_movers())

    def without_details(self) -> "FrameResult":
        """Pose and mask alone, for a frame that repeats this one."""
        return replace(self, events=(), shed=Shed.NOTHING, _labels=None, _tracking=None, _find_movers=None)

    def detached(self) -> "FrameResult":
        """Copy with copies of all arrays."""
        return replace(deepcopy(replace(self, _find_movers=None)), _find_movers=self._find_movers)

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling and copying, with the moving objects."""
        return vars(self) | {"_find_movers": partial(tuple, self.movers)}


@dataclass(frozen=True, eq=False)
class SlamArguments:
    """Arguments of ``Slam`` that are no state: all except a first pass and a saved map."""

    camera: Camera
    config: Config
    calibration: Calibration | None
    live: bool
    localize: bool
    max_blocks: int | MemoryLimit | None
    timed: bool
    ignore: NDArray[np.bool_] | None
    poses: GivenRole

    def __post_init__(self) -> None:
        """Refuse a configuration or a role of poses that is none.

        Raises:
            ConfigError: One of them is.
        """
        if not isinstance(self.config, Config):
            found = type(self.config).__name__
            raise ConfigError(f"config is a {found}, expected a Config: Config(...), Config.load(file) or None")
        if self.poses not in (roles := get_args(GivenRole)):
            raise ConfigError(f"poses is {self.poses!r}, expected {', '.join(map(repr, roles))}")


class SlamResults:
    """The read-only side of ``Slam``.

    Attributes:
        config, camera: Configuration, and camera of the images without lens distortion.
        atlas: Submaps, keyframes, stored frames and poses.
        mapper: Fuses frames into the atlas.
        monitor: Fit of recent frames to the map.
        color_calibration: Calibration of the colour camera.
        objects: The moving objects.
        detector: Labels moving pixels.
        prior_map: Map of the first pass during a second pass, else None.
    """

    config: Config
    camera: Camera
    arguments: SlamArguments
    atlas: Atlas
    mapper: Mapper
    monitor: QualityMonitor
    color_calibration: ColorCalibration
    objects: MovingObjects
    detector: DynamicDetector
    prior_map: PriorMap | None

    @property
    def reference(self) -> TsdfVolume:
        """Map for registration: the current one, or the first pass's in a second pass."""
        return self.atlas.volume if self.prior_map is None else self.prior_map.volume

    @property
    def volume(self) -> TsdfVolume:
        """Complete map of the current submap; finishes a rebuilding after a correction.

        A new or joined submap is another object.
        """
        self.atlas.complete()
        return self.atlas.volume

    @property
    def live_volume(self) -> TsdfVolume:
        """Map of the current submap as it is, for viewers."""
        return self.atlas.volume

    @property
    def trajectory(self) -> Trajectory:
        """Corrected poses of all tracked frames of the largest submap, at their time stamps."""
        return self._trajectory(self.atlas.by_size()[0])

    def _trajectory(self, number: int) -> Trajectory:
        """Trajectory of a submap. Given poses belong to the time stamps, not to the capture times."""
        given = self.arguments.poses == "given"
        return self.atlas.image_poses(number) if given else self.atlas.trajectory(number)

    @property
    def image_poses(self) -> Trajectory:
        """The trajectory at the capture times, if a calibration finds the depth stamps late."""
        return self.atlas.image_poses(self.atlas.by_size()[0])

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and complete map of each submap, largest first, each in its own world frame."""
        self.atlas.complete()
        return [(self._trajectory(number), self.atlas.volumes[number]) for number in self.atlas.by_size()]

    @property
    def saved_map(self) -> SavedMap:
        """The main map, which a later run can continue."""
        return replace(self.atlas.as_saved_map(), registrations=self.monitor.history)

    @property
    def calibration(self) -> Calibration:
        """Calibration of the colour camera in use."""
        return replace(self.color_calibration.current)

    @property
    def calibration_waits(self) -> int:
        """Frames that waited for a calibration from another process."""
        return self.color_calibration.waits

    @property
    def rigid_objects(self) -> list[RigidObject]:
        """Shapes and trajectories of rigid objects so far, if ``movers.meshes`` is set."""
        return self.objects.rigid_objects({pose.timestamp: pose.T_world_camera for pose in self.atlas.poses})

    def as_prior_map(self) -> PriorMap:
        """The largest submap and the state that a second pass needs."""
        self.atlas.complete()
        self.atlas.keyframes.settle()
        main = self.atlas.by_size()[0]
        poses = {pose.timestamp: pose.T_world_camera for pose in self.atlas.poses if pose.submap == main}
        return PriorMap(self.atlas.volumes[main], main, poses, self.atlas.keyframes, self.detector)
