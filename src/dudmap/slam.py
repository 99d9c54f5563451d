"""The algorithm: track a frame against the map, find what moves, fuse what does not (thesis algorithm 4)."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.dynamics.detector import DynamicDetector
from dudmap.dynamics.masks import Labels, full_mask, full_size, grown_mask
from dudmap.dynamics.segments import Segmentation
from dudmap.frames.exposure import exposed_color
from dudmap.frames.frame import Frame
from dudmap.frames.observation import Level, Observation
from dudmap.frames.preprocess import Preprocessor
from dudmap.frames.pyramid import Pyramid, is_majority_dynamic
from dudmap.geometry.alignment import agree
from dudmap.geometry.camera import Camera
from dudmap.geometry.trajectory import Trajectory
from dudmap.mapping.volume import TsdfVolume
from dudmap.objects.object_fusion import ObjectFusion
from dudmap.objects.object_map import RigidObject
from dudmap.objects.object_tracker import Mover, ObjectTracker
from dudmap.places.atlas import Atlas
from dudmap.places.frame_store import FrameStore
from dudmap.places.loop_closing import LoopCloser
from dudmap.places.loop_verification import LoopQuery
from dudmap.places.place_recognition import KeyframeDatabase
from dudmap.places.redundancy import RedundantViews
from dudmap.result import FrameResult
from dudmap.stage_timer import StageTimer
from dudmap.tracking.front_end import FrontEnd, RegistrationInput, static_weights
from dudmap.tracking.motion_model import MotionModel
from dudmap.tracking.pose_prediction import CLEARLY, PosePredictor
from dudmap.tracking.quality_monitor import QualityMonitor
from dudmap.tracking.tracker import Tracker, TrackingResult

FLAT = 0.01
"""An image whose intensities (0..1) have a smaller standard deviation shows nothing: black, or blinded."""
SAME_START = 0.01, 0.25
"""Poses nearer to each other than this (m, deg) lead to the same registration."""
LEAST_KNOWN = 0.09
"""Share of the readings that must rest on a surface of the map where most of the others move."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame made ready by ``Slam.prepare``.

    Attributes:
        observation: Its images, filtered.
        pyramid: They, reduced.
        surface: Gives its pieces of surface, None where they are not asked; waits until they are cut.
        ms: How long that took.
    """

    observation: Observation
    pyramid: Pyramid
    surface: Callable[[], Segmentation] | None
    ms: float


class Slam:
    """Dense RGB-D SLAM in scenes where things move.

    Args:
        camera: Camera of the frames that will come.
        config: All parameters; None = defaults.
        first_pass: A system that has seen the whole recording. The frames, given once more from the first on, are
            then registered and labelled with its map, which knows the end, and make a map of their own: what was
            taken for static before it moved, or before it was seen through, is left out.
    """

    def __init__(self, camera: Camera, config: Config | None = None, first_pass: "Slam | None" = None) -> None:
        self.config = config or Config()
        self.preprocess = Preprocessor(camera, self.config.preprocess)
        self.camera = self.preprocess.camera
        self.tracker = Tracker(self.config.tracker, self.config.sensor)
        self.detector = DynamicDetector(self.config.dynamics, self.config.sensor)
        self.redundant = RedundantViews(self.config.similarity)
        self.motion = MotionModel(self.config.tracker)
        self.registration = FrontEnd(self.config, self.tracker, self.detector, self.motion)
        self.health = QualityMonitor()
        self.keyframes = KeyframeDatabase(self.config.relocalization, self.camera, self.config.sensor)
        self.atlas = Atlas(self._empty_volume, self.keyframes, self._history())
        self._prior_map: TsdfVolume | None = None  # the map of a first pass, and where it saw the frames
        seen: dict[float, NDArray[np.float64]] = {}
        if first_pass is not None:
            main = first_pass.atlas.by_size()[0]
            self.keyframes = first_pass.keyframes
            self.atlas = Atlas(self._empty_volume, self.keyframes, None, main)
            self._prior_map = first_pass.atlas.volumes[main]
            seen = {p.timestamp: p.T_world_camera for p in first_pass.atlas.poses if p.submap == main}
            self.detector.memory.import_from(first_pass.detector.memory, seen)
        self.loops = LoopCloser(self.config, self.atlas, self.tracker)
        self.movers = ObjectTracker(self.config.movers)
        self.fusion = ObjectFusion(self.config) if self.config.movers.enabled and self.config.movers.meshes else None
        self.first_guess = PosePredictor(self.config, self.registration, seen)
        # the first frame and what is known to move in it, until a second one shows what moves besides
        self._first: tuple[Observation, Pyramid, NDArray[np.bool_]] | None = None
        self._lost_since: float | None = None
        self._map_blind = False  # the image of the map's first frame is flat

    @property
    def volume(self) -> TsdfVolume:
        """The map that is tracked; another one after a new submap was started or two were joined."""
        return self.atlas.volume

    @property
    def reference(self) -> TsdfVolume:
        """The map that frames are compared with: the own one, or in a second pass that of the first."""
        return self._prior_map or self.volume

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames tracked so far in the submap with the most frames, as they are known now."""
        return self.atlas.trajectory(self.atlas.by_size()[0])

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and map of each submap, that with the most frames first; each has a world of its own."""
        return [(self.atlas.trajectory(number), self.atlas.volumes[number]) for number in self.atlas.by_size()]

    @property
    def bodies(self) -> list[RigidObject]:
        """The moving bodies so far, where ``movers.meshes`` is set: shape and trajectory of those that are rigid."""
        if self.fusion is None:
            return []
        return self.fusion.bodies({pose.timestamp: pose.T_world_camera for pose in self.atlas.poses})

    def prepare(self, frame: Frame) -> Prepared:
        """The part of a frame's work that needs no other frame, for ``process`` to go on with.

        Another thread may do it while an earlier frame is processed; one frame at a time.

        Raises:
            DatasetError: The images do not fit the camera or each other.
        """
        start = time.perf_counter()
        observation = self.preprocess(frame)
        pyramid = Pyramid.of(observation, self.camera, self.config)
        if self.first_guess.parallax.active:
            _ = pyramid.corners  # kept there for the comparison with other images
        surface = None
        if self.config.dynamics.method == "em":
            surface = self.detector.cut(pyramid.labelled, self.config.volume.voxel_size)
        return Prepared(observation, pyramid, surface, 1000 * (time.perf_counter() - start))

    def process(self, frame: Frame | Prepared, dynamic_mask: NDArray[np.bool_] | None = None) -> FrameResult:
        """Track one frame against the map, find what moves, fuse what does not.

        Args:
            frame: Depth and colour with a timestamp later than all before; prepared or not, the result is the same.
            dynamic_mask: (H, W) bool, pixels of the frame that are known to move, e.g. of a segmentation network;
                they count as moving from the first registration on, whatever is found besides.

        Raises:
            DatasetError: The images do not fit the camera or each other.
        """
        prepared = frame if isinstance(frame, Prepared) else self.prepare(frame)
        observation, pyramid, clock = prepared.observation, prepared.pyramid, StageTimer({"preprocess": prepared.ms})
        known = None if dynamic_mask is None else self.preprocess.mask(dynamic_mask)
        flat = bool(pyramid.coarse.intensity.std() < FLAT)
        if self.reference.is_empty:
            self._map_blind = flat
            return self._to_raw_image(self._start(observation, pyramid, known, clock))
        if prepared.surface is not None:
            self.detector.set_segmentation(pyramid.labelled, prepared.surface)
        guess = self.first_guess.predict(observation.timestamp, pyramid, self.reference, clock)
        if guess.moving_before is not None:
            self._start_again(guess.moving_before)
        self.detector.begin(observation.timestamp, guess.moving)
        blind = flat and not self._map_blind
        task = RegistrationInput(observation.timestamp, pyramid, known, self.first_guess.unverified_mask, blind, clock)
        similar = self.redundant.ask(observation.rgb, guess.T_world_camera)
        tracked, labels = self._register(task, guess.T_world_camera)
        reason = self._rejection_reason(task, tracked, labels)
        recognised = self._recognise(observation, task) if reason else None
        if recognised is not None:
            (tracked, labels), reason = recognised, ""
            self.motion.restart(observation.timestamp, tracked.T_world_camera)
        with clock("similarity"):
            fused = not (similar(tracked.T_world_camera) or blind)
        if reason:
            self._lose(observation.timestamp)
            if self._start_submap(observation):
                return self._to_raw_image(self._start(observation, pyramid, known, clock))
            return self._to_raw_image(self._result(observation, task, labels, tracked, reason, fused=False))
        self._keep(task, tracked, labels)
        result = self._result(observation, task, labels, tracked, "", fused=fused, relocalized=bool(recognised))
        self._remember(observation, result, clock)
        if fused:
            with clock("integrate"):
                self._integrate(observation, tracked.T_world_camera, result.dynamic_mask, tracked.exposure)
        return self._to_raw_image(self._close_loop(observation, task, result))

    def _keep(self, task: RegistrationInput, tracked: TrackingResult, labels: Labels | None) -> None:
        """Take over a frame whose pose is believed: what the next one is predicted and judged from."""
        self.registration.keep(self.reference, task, tracked, labels)
        self.health.tracked(tracked)
        self._lost_since = None
        self.atlas.add_pose(task.timestamp, tracked.T_world_camera)
        if task.blind:
            self.first_guess.parallax.forget()
        else:
            self.first_guess.keep(task.timestamp, task.pyramid, tracked.T_world_camera, self.volume)

    def _to_raw_image(self, result: FrameResult) -> FrameResult:
        """The mask back in the image that came in, where the lens bends straight lines."""
        return replace(result, dynamic_mask=self.preprocess.distorted(result.dynamic_mask))

    def _start(
        self, observation: Observation, pyramid: Pyramid, known: NDArray[np.bool_] | None, clock: StageTimer
    ) -> FrameResult:
        """The first frame with readings is the world: identity pose, what is not known to move is taken as static."""
        nothing = np.zeros(observation.depth.shape, dtype=bool) if known is None else known
        readings = np.count_nonzero(observation.depth[~nothing])
        reason = "" if readings >= 0.02 * observation.depth.size else "the depth image holds hardly any readings"
        T = np.eye(4)
        result = FrameResult(
            observation.timestamp, "lost" if reason else "tracked", reason, None if reason else T, not reason, False,
            nothing, _share(nothing, observation), np.full((1, 1), np.nan, np.float32), None, None, clock.timings,
            submap=self.atlas.current,
        )  # fmt: skip
        if reason:
            return result
        self.motion.restart(observation.timestamp, T)
        self.atlas.add_pose(observation.timestamp, T)
        self._remember(observation, result, clock)
        with clock("integrate"):
            self._integrate(observation, T, nothing)
        if self.config.dynamics.method == "em":
            self._first = observation, pyramid, nothing
            self.first_guess.begin(observation.timestamp)
            self.detector.begin(observation.timestamp)
            self.detector.memory.start()
            small = pyramid.labelled
            self.detector.memory.remember(small, T, np.zeros(small.depth.shape, dtype=bool), None)
        self.first_guess.keep(observation.timestamp, pyramid, T, self.volume)
        return result

    def _start_again(self, moving: NDArray[np.bool_]) -> None:
        """Make the map of the first frame anew without what the second shows to move in it (h, w)."""
        if self._first is None:
            return
        (first, pyramid, known), self._first = self._first, None
        if not moving.any():
            return
        self.volume.clear()
        if self.atlas.history is not None:
            self.atlas.history.drop_last()
        self._integrate(first, np.eye(4), known | full_size(moving, pyramid.labelled.depth, first.depth))

    def _register(self, task: RegistrationInput, T_init: NDArray[np.float64]) -> tuple[TrackingResult, Labels | None]:
        """Register and label a frame; if it fits unusually badly, or the registration was still on its way, once more
        from where the last image puts the camera.

        A hand that turns back, or frames that are missing, leave a first guess beyond the reach of the registration.
        What fits the map better is taken.
        """
        tracked, labels = self.registration.register(self.reference, task, T_init)
        arrived = tracked.settled or agree(T_init, tracked.T_world_camera, *SAME_START)
        if arrived and not self.health.unusual(tracked):
            return tracked, labels
        with task.clock("parallax"):
            seen = self.first_guess.see(task.timestamp, task.pyramid, self.volume)
        if seen is None or agree(seen[1], tracked.T_world_camera, *SAME_START):
            return tracked, labels
        again, labels_again = self.registration.register(self.reference, task, seen[1])
        misfit, misfit_again = sum(self.health.misfit(tracked)), sum(self.health.misfit(again))
        better = again.converged and (not tracked.converged or misfit_again < CLEARLY * misfit)
        return (again, labels_again) if better else (tracked, labels)

    def _rejection_reason(self, task: RegistrationInput, tracked: TrackingResult, labels: Labels | None) -> str:
        """Sentence on why a registration is not to be believed, empty if it is."""
        crowded = labels is not None and is_majority_dynamic(labels.dynamic, task.pyramid.labelled)
        return (
            tracked.reason
            or self.motion.implausible(task.timestamp, tracked.T_world_camera)
            or self.health.rejection_reason(tracked, crowded=crowded)
            or self._undecided(task.pyramid.labelled, labels, tracked)
        )

    def _undecided(self, level: Level, labels: Labels | None, tracked: TrackingResult) -> str:
        """Sentence if so much seems to move, or so little of the rest is known, that nothing is certain."""
        if labels is None:
            return ""
        readings = level.depth > 0
        share = np.count_nonzero(labels.dynamic & readings) / max(np.count_nonzero(readings), 1)
        if share > self.config.dynamics.max_share:
            return f"{share:.0%} of the readings seem to move: the static world cannot be told"
        known = (1 - share) * tracked.inlier_share
        if share > 0.5 and known < LEAST_KNOWN:
            return f"{share:.0%} of the readings seem to move, and only {known:.0%} rest where the map has a surface"
        return ""

    def _remember(self, observation: Observation, result: FrameResult, clock: StageTimer) -> None:
        """Keep a tracked frame as a keyframe if the camera has been nowhere near and the image shows something."""
        if self.config.relocalization.enabled and not result.blind and result.T_world_camera is not None:
            with clock("keyframe"):
                self.keyframes.add(observation, result.T_world_camera, ~result.dynamic_mask, self.atlas.current)

    def _recognise(
        self, observation: Observation, task: RegistrationInput
    ) -> tuple[TrackingResult, Labels | None] | None:
        """Registration of a lost frame from the pose of a place it shows; None where nothing is beyond doubt.

        Features and map must agree: the registration passes all checks at the stricter limits that hold after a loss,
        enough of the frame lies on the map, and the pose stays where the features put it.
        """
        config = self.config.relocalization
        if not config.enabled:
            return None
        self.health.lost()
        readings = max(np.count_nonzero(task.pyramid.labelled.depth), 1)
        with task.clock("recognise"):
            found = self.keyframes.extract(observation, None if task.known is None else ~task.known)
            candidates = self.keyframes.match(found)
        lost_in = self.atlas.current
        candidates.sort(key=lambda place: place.keyframe.submap != lost_in)  # rather stay than change the map
        for place in candidates:
            T_world_camera, self.atlas.current = place.T_world_camera, place.keyframe.submap
            tracked, labels = self.registration.register(self.reference, task, T_world_camera)
            static = 1.0 if labels is None else 1 - np.count_nonzero(labels.dynamic) / readings
            if (
                tracked.converged
                and not self.health.rejection_reason(tracked, recognised=True)
                and static * tracked.inlier_share >= config.min_on_map
                and agree(tracked.T_world_camera, T_world_camera, config.max_distance, config.max_angle_deg)
            ):
                return tracked, labels
        self.atlas.current = lost_in
        return None

    def _lose(self, timestamp: float) -> None:
        self.health.lost()
        if self.motion.lost(timestamp):
            self.registration.forget()
        self._lost_since = timestamp if self._lost_since is None else self._lost_since

    def _start_submap(self, observation: Observation) -> bool:
        """Go on in a new, empty map if nothing has been recognised for a while and this frame shows enough."""
        config = self.config.submaps
        if not config.enabled or self.atlas.history is None or self._lost_since is None:
            return False
        if observation.timestamp - self._lost_since < config.patience:
            return False
        if np.count_nonzero(observation.depth) < config.min_readings * observation.depth.size:
            return False
        if len(self.keyframes.extract(observation)) < self.config.relocalization.min_inliers:
            return False
        self.atlas.start_submap()
        self.health, self._lost_since = QualityMonitor(), None
        self.redundant.reset()
        return True

    def _close_loop(self, observation: Observation, task: RegistrationInput, result: FrameResult) -> FrameResult:
        """Look for a place seen before; where the tracking has drifted since, everything moves."""
        tracked = result.tracking
        if self.atlas.history is None or tracked is None or task.blind:
            return result
        with task.clock("loops"):
            levels, labels = task.pyramid.tracked, result.labels
            weights = None if labels is None else static_weights(labels, levels, task.unverified_mask)
            view = LoopQuery(observation, levels, weights, ~result.dynamic_mask, tracked)
            correction = self.loops.close(view, self.health)
        if correction is None:
            return result
        self.motion.moved(correction)
        self.redundant.apply_correction(correction)
        T = correction @ tracked.T_world_camera
        return replace(result, T_world_camera=T, submap=self.atlas.current, corrected=True)

    def _empty_volume(self) -> TsdfVolume:
        return TsdfVolume(self.camera, self.config.volume, self.config.sensor, self.config.preprocess.depth_max)

    def _history(self) -> FrameStore | None:
        loops = self.config.loops
        if not self.config.relocalization.enabled or not (loops.enabled or self.config.submaps.enabled):
            return None
        return FrameStore(self.camera, loops.keep_distance, loops.keep_angle_deg, loops.keep_gap)

    def _integrate(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_],
        exposure: tuple[float, float] = (1.0, 0.0),
    ) -> None:
        static = ~grown_mask(dynamic_mask, self.config.dynamics.margin_px * self.camera.width // 640)
        fused = Frame(observation.timestamp, observation.depth, exposed_color(observation.rgb, exposure))
        self.volume.integrate(fused, T_world_camera, static)
        if self.atlas.history is not None:
            self.atlas.history.add(fused, static, T_world_camera, self.atlas.current)
        self.redundant.set_reference(observation.rgb, T_world_camera)

    def _result(
        self,
        observation: Observation,
        task: RegistrationInput,
        labels: Labels | None,
        tracked: TrackingResult,
        reason: str,
        *,
        fused: bool,
        relocalized: bool = False,
    ) -> FrameResult:
        level, pose = task.pyramid.labelled, tracked.T_world_camera
        with task.clock("label"):
            if labels is None:
                mask = np.zeros(observation.depth.shape, dtype=bool)
                residuals = np.full((1, 1), np.nan, np.float32)
            else:
                mask = full_mask(labels, level, observation.depth)
                residuals = labels.sample.distance
            if task.known is not None:
                mask = mask | task.known
        movers: tuple[Mover, ...] = ()
        if self.config.movers.enabled and labels is not None and not reason:
            with task.clock("movers"):
                movers = tuple(self.movers.update(task.timestamp, labels.dynamic, level, pose))
            if self.fusion is not None:
                with task.clock("bodies"):
                    movers = tuple(self.fusion.update(observation, movers, level, pose, tracked.exposure))
        return FrameResult(
            task.timestamp, "lost" if reason else "tracked", reason, None if reason else pose,
            fused, not (fused or reason or task.blind), mask, _share(mask, observation), residuals, labels, tracked,
            task.clock.timings, relocalized, movers, self.atlas.current, blind=task.blind,
        )  # fmt: skip


def _share(mask: NDArray[np.bool_], observation: Observation) -> float:
    """Share of the readings that lie in a mask."""
    readings = observation.depth > 0
    return float(np.count_nonzero(mask & readings) / max(np.count_nonzero(readings), 1))
