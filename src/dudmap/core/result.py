"""Results of a system: the result of each frame, and the maps, trajectories and calibration so far."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.calibration.self_calibration import ColorCalibration
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.masks import Labels
from dudmap.core.frames.stream_check import Repeats
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
from dudmap.core.tracking.motion_model import GivenRole
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import ACCEPTED, Verdict


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of processing one frame.

    Attributes:
        timestamp: Time of the depth image, seconds; after a change of the clock, on the clock of the first frames.
        state: "tracked", "lost", or "repeated" if the images, or the depth image, equal the frame before.
        lost_reason: Names the check that failed; empty for a tracked frame.
        rejected: Kind of stream error for which a lost frame was ignored (``frames/stream_check.py``); else empty.
        T_world_camera: Camera pose (4, 4); None if lost. A repeated frame has the pose of the frame before. If only the
            depth repeats, the pose is predicted; the trajectory interpolates it once the next frame is tracked.
        fused: Whether the frame changed the map.
        skipped_similar: Whether the frame was not fused because it is a redundant view.
        dynamic_mask: (H, W) bool, dynamic pixels of the recorded image.
        dynamic_share: Share of the depth measurements in the mask.
        residuals: (h, w) float32 signed distances of the measurements to the map, metres, at label resolution; NaN off
            the map.
        labels: Full result of the labelling; None if it did not run.
        tracking: Full result of the registration; None for the first frame of a map.
        timings: Milliseconds per stage.
        relocalized: Whether the pose comes from a recognised place after tracking was lost.
        find_movers: Computes the moving objects; None if there are none.
        submap: Number of the submap of the pose, 0 the first.
        corrected: Whether this frame closed a loop, which changed all earlier poses of the submap.
        blind: Whether only the distances determine the pose, and the frame is not fused: the image is textureless,
            missing in a map with colours, or rejected after a change of the light.
        colorless: Whether the frame has no colour image, so that only the distances determine the pose.
        calibrated: Whether a new calibration of the colour camera, ``Slam.calibration``, is used after this frame.
        uncertain: Reason why pose and labels of a tracked frame may be wrong, else empty. Such a frame is not fused.
        unobservable: (k, 6) twists, camera axes, that the view does not observe and along which the pose follows the
            prediction (``core/tracking/observability.py``). Such a frame is ``uncertain``.
        repeats: Part that equals the frame before bit for bit: the whole ``frame``, its ``depth`` or its ``color``. A
            frame with repeated colour is tracked by its distances alone (``blind``).
        verdict: Outcomes of the checks that decided on the frame (``tracking/checks.py``); empty without registration.
    """

    timestamp: float
    state: Literal["tracked", "lost", "repeated"]
    lost_reason: str
    T_world_camera: NDArray[np.float64] | None
    fused: bool
    skipped_similar: bool
    dynamic_mask: NDArray[np.bool_]
    dynamic_share: float
    residuals: NDArray[np.float32]
    labels: Labels | None
    tracking: TrackingResult | None
    timings: dict[str, float] = field(default_factory=dict)
    relocalized: bool = False
    find_movers: Callable[[], tuple[Mover, ...]] | None = None
    submap: int = 0
    corrected: bool = False
    blind: bool = False
    colorless: bool = False
    uncertain: str = ""
    calibrated: bool = False
    rejected: str = ""
    repeats: Repeats = ""
    verdict: Verdict = ACCEPTED
    unobservable: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 6)))

    def __repr__(self) -> str:
        """The state without the images."""
        reason = f": {self.lost_reason}" if self.lost_reason else ", fused" if self.fused else ""
        return f"FrameResult({self.timestamp:.6f} s, {self.state}{reason}, {self.dynamic_share:.1%} dynamic)"

    def without_details(self) -> "FrameResult":
        """Pose and mask alone, for a frame that repeats this one."""
        return FrameResult(
            self.timestamp, self.state, self.lost_reason, self.T_world_camera, fused=False, skipped_similar=False,
            dynamic_mask=self.dynamic_mask, dynamic_share=self.dynamic_share, residuals=self.residuals, labels=None,
            tracking=None, timings=self.timings, submap=self.submap, rejected=self.rejected, repeats=self.repeats,
            unobservable=self.unobservable,
        )  # fmt: skip

    @cached_property
    def movers(self) -> tuple[Mover, ...]:
        """Moving objects, by id; none in a lost frame. They are computed at the first access."""
        return () if self.find_movers is None else deepcopy(self.find_movers())

    def detached(self) -> "FrameResult":
        """Copy with copies of all arrays, which the caller may keep and change."""
        return replace(deepcopy(replace(self, find_movers=None)), find_movers=self.find_movers)

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling and copying, with the moving objects."""
        return vars(self) | {"find_movers": partial(tuple, self.movers)}


@dataclass(frozen=True, eq=False)
class SlamArguments:
    """Arguments of ``Slam``, except a first pass and a saved map, whose used parts belong to the state."""

    camera: Camera
    config: Config
    calibration: Calibration | None
    live: bool
    localize: bool
    max_blocks: int | MemoryLimit | None
    timed: bool
    ignore: NDArray[np.bool_] | None
    poses: GivenRole


class SlamResults:
    """The read-only side of ``Slam``; a map in rebuilding after a correction is completed first.

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
        """Map for registration: the current one, or in a second pass the map of the first pass."""
        return self.atlas.volume if self.prior_map is None else self.prior_map.volume

    @property
    def volume(self) -> TsdfVolume:
        """Complete map of the current submap; a rebuilding after a correction is finished first.

        A new or joined submap is another object. ``atlas.volume`` is the map in its current state.
        """
        self.atlas.complete()
        return self.atlas.volume

    @property
    def live_volume(self) -> TsdfVolume:
        """Map of the current submap in its current state, for viewers."""
        return self.atlas.volume

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all tracked frames of the largest submap, at their time stamps, after all corrections."""
        return self._trajectory(self.atlas.by_size()[0])

    def _trajectory(self, number: int) -> Trajectory:
        """Trajectory of a submap. Given poses belong to the time stamps, even if the images were captured at other
        times."""
        given = self.arguments.poses == "given"
        return self.atlas.image_poses(number) if given else self.atlas.trajectory(number)

    @property
    def image_poses(self) -> Trajectory:
        """The trajectory at the capture times, if a calibration finds the stamps of the depth images late."""
        return self.atlas.image_poses(self.atlas.by_size()[0])

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and complete map of each submap, largest first; each has its own world frame."""
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
        """Number of frames that waited for a calibration from another process."""
        return self.color_calibration.waits

    @property
    def rigid_objects(self) -> list[RigidObject]:
        """The moving objects so far, if ``movers.meshes`` is set: shape and trajectory of rigid objects."""
        return self.objects.rigid_objects({pose.timestamp: pose.T_world_camera for pose in self.atlas.poses})

    def as_prior_map(self) -> PriorMap:
        """The largest submap and the state that a second pass over the same recording needs."""
        self.atlas.complete()
        self.atlas.keyframes.settle()
        main = self.atlas.by_size()[0]
        poses = {pose.timestamp: pose.T_world_camera for pose in self.atlas.poses if pose.submap == main}
        return PriorMap(self.atlas.volumes[main], main, poses, self.atlas.keyframes, self.detector)
