"""The algorithm: register a frame to the map, label moving pixels, fuse static ones (thesis algorithm 4)."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.arrays import copied
from dudmap.core.backends.device import make_backend, resolve
from dudmap.core.calibration.self_calibration import ColorCalibration
from dudmap.core.dynamics.cue import Cue
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.frame_log import log_changes
from dudmap.core.frames.frame import Frame, FrameArrays, given_frame
from dudmap.core.frames.observation import reduced
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.frames.rolling_shutter import recorded_mask
from dudmap.core.frames.stream_check import StreamCheck
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.adaptive_volume import make_volume
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.mapper import Mapper
from dudmap.core.objects.moving_objects import MovingObjects
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.loop_closing import LoopCloser
from dudmap.core.places.loop_verification import LoopQuery
from dudmap.core.places.redundancy import RedundantViews
from dudmap.core.places.relocalizer import Relocalization, Relocalizer
from dudmap.core.places.saved_map import SavedMap
from dudmap.core.result import Event, FrameResult, SlamArguments, SlamResults, Status
from dudmap.core.shed import Shed
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.checks import MAX_DRIFT
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, StageTimer
from dudmap.core.tracking.front_end import FrontEnd
from dudmap.core.tracking.motion_model import GivenRole, MotionModel
from dudmap.core.tracking.pose_prediction import PosePrediction, PosePredictor
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import Tracker
from dudmap.core.verdict import Outcome, Verdict
from dudmap.core.young_map import StartFrame, YoungMap
from dudmap.errors import ConfigError


class Slam(SlamResults, Stateful):
    """Dense RGB-D SLAM in dynamic scenes.

    Args:
        camera: Camera of the frames.
        config: All parameters; None for the defaults.
        first_pass: A system that has processed the recording. Frames are registered and labelled with its map and fused
            into a new one, without objects that moved later.
        calibration: Calibration of the colour camera; None for registered colour. With ``sensor.self_calibration``, one
            that is not estimated starts the estimation.
        live: No frame waits for a calibration, and the first poses are not refined.
        saved_map: Map of an earlier run to continue, taken over with its world frame. Frames are lost until one is
            recognised in it, or a new submap starts.
        localize: Only find the camera in ``saved_map``; the map does not change.
        max_blocks: Largest number of blocks in memory, or memory limit of the process; None for none. Results do not
            change.
        timed: Whether the times of the frames are measured; False for assumed times.
        poses: Role of the poses passed with frames: the result (``given``), or the start of registration (``refined``).
        ignore: (H, W) bool, pixels of the depth or colour image that are never used.
        cues: Further evidence of motion, not stored with the state.

    Raises:
        ConfigError: An argument is of another kind.

    Attributes:
        shed: Work to omit from the next frames, to save time. Labels and fusion are omitted from every second frame
            (with ``MOST``, two of three), but not after a frame without pose. Labels are computed if the map is young,
            if most of the last view moved, or if most moving pixels have left their place. It is not stored with the
            state.
    """

    stream: Remembered[StreamCheck]
    motion: Remembered[MotionModel]
    color_motion: Remembered[ColorMotion]
    detector: Remembered[DynamicDetector]
    monitor: Remembered[QualityMonitor]
    front_end: Remembered[FrontEnd]
    predictor: Remembered[PosePredictor]
    atlas: Remembered[Atlas]
    color_calibration: Remembered[ColorCalibration]
    young_map: Remembered[YoungMap]
    relocalizer: Remembered[Relocalizer]
    redundancy: Remembered[RedundantViews]
    loops: Remembered[LoopCloser]
    objects: Remembered[MovingObjects]
    shed: Shed = Shed.NOTHING
    _last: Remembered[FrameResult | None] = None  # result of the last frame, for a frame that repeats it
    _omissions: Remembered[int] = 0  # frames in a row whose labels and fusion could be omitted

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        first_pass: "Slam | None" = None,
        calibration: Calibration | None = None,
        live: bool = False,
        saved_map: SavedMap | None = None,
        localize: bool = False,
        max_blocks: int | MemoryLimit | None = None,
        *,
        timed: bool = True,
        ignore: NDArray[np.bool_] | None = None,
        poses: GivenRole = "estimated",
        cues: Sequence[Cue] = (),
    ) -> None:
        if not isinstance(saved_map, SavedMap | None):
            raise ConfigError(f"saved_map is a {type(saved_map).__name__}, expected a SavedMap: SavedMap.load(folder)")
        self.config = config = Config() if config is None else config
        ignore = None if ignore is None else copied(ignore, "mask of ignored pixels", dtype=None)
        self.arguments = SlamArguments(camera, config, calibration, live, localize, max_blocks, timed, ignore, poses)
        self.first_pass = first_pass
        start = calibration if first_pass is None else first_pass.calibration
        registered = start is None or start.is_registered(replace(camera, distortion=()))
        given = None if start is None or (registered and start.depth_readout == 0) else start
        adaptive = config.volume.adaptive or (saved_map is not None and saved_map.volume.config.adaptive)
        self.device = resolve(config.device, adaptive=adaptive)
        color = None if registered else given
        self.preprocess = Preprocessor(camera, config.preprocess, color, ignore, config.sensor)
        self.camera = self.preprocess.camera
        self.prior_map = prior = None if first_pass is None else first_pass.as_prior_map()
        self.stream = StreamCheck(config.tracker.max_speed)
        self.tracker = Tracker(config.tracker, config.sensor, config.preprocess.smoothing_px)
        self.motion = MotionModel(config.tracker, timed=timed, poses=poses)
        self.color_motion = ColorMotion(self.motion, given)
        self.detector = DynamicDetector(config.dynamics, config.sensor)
        self.monitor = QualityMonitor(config, self.motion)
        self.front_end = FrontEnd(
            config, self.tracker, self.detector, self.motion, self.monitor, self.color_motion, cues
        )
        self.predictor = PosePredictor(config, self.motion, self.tracker, prior.Ts_world_camera if prior else {})
        self.atlas = Atlas.of(config, self.camera, self._volume, prior, keep_frames=not localize)
        self.color_calibration = ColorCalibration(config, self.camera, start, self.atlas, self.color_motion, live=live)
        refines = prior is None and not live and poses != "given"
        decides = prior is None and config.dynamics.enabled and config.dynamics.start_seconds > 0
        self.young_map = YoungMap(refines=refines, decides=decides, reference_depth=config.sensor.reference_depth)
        self.relocalizer = Relocalizer(config, self.atlas, None if prior is None else prior.volume)
        self.redundancy = RedundantViews(config)
        self.loops = LoopCloser(config, self.atlas, self.tracker)
        self.objects = MovingObjects(config)
        self.localize, self.live = localize, live
        parts = self.atlas, self.young_map, self.color_motion, self.redundancy
        self.mapper = Mapper(config, self.camera, *parts, localize=localize)
        if prior is not None:
            self.detector.import_from(prior.detector, prior.Ts_world_camera)
        if saved_map is not None:
            self.atlas.continue_in(saved_map, self.camera, max_blocks)
            self.monitor.continue_from(saved_map.registrations)
            self.relocalizer.start_in_saved_map()

    def prepare(self, frame: Frame | FrameView, dynamic_mask: NDArray[np.bool_] | None = None) -> FrameView:
        """The part of ``process`` that needs no other frame; returns its input.

        May run in another thread while an earlier frame is processed; one frame at a time.

        Args:
            frame: Depth and colour; a prepared frame only receives the mask.
            dynamic_mask: As for ``process``.

        Raises:
            DatasetError: The images do not fit the camera or each other.
        """
        if isinstance(frame, Frame):
            start, now = time.perf_counter(), not self.color_motion.rectifies
            frame = FrameView.of(self.preprocess(frame), self.config, self.detector, now=now)
            if now and self.predictor.image_motion.active and self.color_motion.is_prepared(frame.observation):
                _ = frame.pyramid.corners  # cached for the comparison with other images
            frame.timer.timings["preprocess"] = 1000 * (time.perf_counter() - start)
        if dynamic_mask is not None:
            frame = replace(frame, known_dynamic=self.preprocess.mask(dynamic_mask))
        return frame

    def process(
        self,
        frame: Frame | FrameView | None = None,
        dynamic_mask: NDArray[np.bool_] | None = None,
        T_world_camera: NDArray[np.float64] | None = None,
        **arrays: Unpack[FrameArrays],
    ) -> FrameResult:
        """Register a frame to the map, label its dynamic pixels, fuse the static ones.

        Args:
            frame: Depth and colour, in order of arrival, prepared or not. A frame with an impossible time stamp or
                image is rejected and changes nothing.
            dynamic_mask: (H, W) bool, known dynamic pixels, excluded from registration and map.
            T_world_camera: (4, 4) given pose of the depth camera, metres, see ``poses``.
            arrays: ``depth``, ``timestamp`` and ``rgb`` instead of a frame. ``depth`` (H, W) is float32 in metres or
                uint16 with ``camera.depth_scale`` units per metre (default 1000), 0 = no measurement. ``timestamp`` is
                in seconds. ``rgb`` (H, W, 3) is uint8, optional. The arrays may be changed afterwards.

        Raises:
            ConfigError: Neither a frame nor both ``depth`` and ``timestamp`` are given, or both kinds.
            FrameError: The arrays have another shape or type, or do not fit the camera or each other; nothing changed.
        """
        view = self.prepare(given_frame(frame, arrays, self.camera.depth_scale), dynamic_mask)
        self.motion.give(T_world_camera)
        before, result = self._last, self._processed(view)
        log_changes(before, result)
        return result.detached()

    # -- steps of process ---------------------------------------------------------------------------------------------

    def _processed(self, view: FrameView) -> FrameResult:
        """``process`` for a prepared frame; the result shares memory with the state."""
        with view.timer("check"):
            arrival = self.stream.judge(view.observation)
            arrival = self.motion.verdict if arrival.accepted else arrival
        if not arrival.accepted:
            return self._result(view, None, np.zeros_like(view.observation.readings), arrival, Status.REJECTED)
        view = self._resumed(view)
        if self.stream.repeats in ("frame", "depth") and self._last is not None:
            return self._repeat(view, self._last)
        view = self.color_motion.predicted(self._rectified(view))
        if self.reference.is_empty:
            return self._start_map(view)
        blind = view.textureless or self.stream.repeats == "color"  # the colours carry no information
        view = replace(view, blind=blind and not self.young_map.textureless)
        with view.timer("rebuild"):
            self.atlas.continue_rebuilding()
            if (correction := self.mapper.refine_first_poses(self.tracker)) is not None:
                self.motion.apply_correction(correction)
        prediction = self.predictor.predict(self.reference, view)
        restarted = self._decide_start(view, prediction)
        if restarted:
            prediction = self.predictor.predict(self.reference, view)
        view, last = replace(view, shed=self._omitted(view, prediction)), self.predictor.image_motion.last
        view, estimate, verdict = self.front_end.judged(self.reference, view, prediction, last)
        registered = self.color_motion.registered(estimate.view or view, estimate.T_world_camera)
        verdict = self.relocalizer.verdict + verdict
        relocalized = None if verdict.accepted else self._relocalize(view, prediction)
        if relocalized is not None:
            estimate, verdict = relocalized.estimate, relocalized.verdict
        if not verdict.accepted:
            return self._lose(view, estimate, verdict)
        view = registered if relocalized is None else self.color_motion.registered(view, estimate.T_world_camera)
        self.mapper.recolor_first_frame(view, estimate)
        covariance = estimate.tracking.covariance_with(self.motion.drift(view.timestamp))
        self._accept(view, estimate)
        verdict += self._fusion_verdict(view, estimate)
        mask = estimate.dynamic_mask(view)
        self.mapper.extend(view, estimate, mask, fuse=verdict.accepted)
        correction = self._close_loop(view, estimate, mask)
        T_world_camera = estimate.T_world_camera
        if correction is not None:
            T_world_camera, turn = correction @ T_world_camera, np.kron(np.eye(2), correction[:3, :3])
            covariance = turn @ covariance @ turn.T
        corrected = restarted or correction is not None
        calibrated = self._calibrate(view, T_world_camera, mask, corrected=corrected)
        happened: dict[Event, bool] = {
            "relocalized": relocalized is not None, "corrected": corrected, "calibrated": calibrated,
        }  # fmt: skip
        return self._result(
            view, estimate, mask, verdict, T_world_camera=T_world_camera,
            covariance=None if self.motion.is_given else covariance,
            events=tuple(event for event, has in happened.items() if has),
            _find_movers=None if view.shed else self.objects.update(view, estimate),
        )  # fmt: skip

    def _omitted(self, view: FrameView, prediction: PosePrediction) -> Shed:
        tracked = self._last is not None and self._last.status is Status.TRACKED
        self._omissions = 0 if not tracked or self._omissions >= 1 + (Shed.MOST in self.shed) else self._omissions + 1
        if self._omissions == 0:
            return self.shed & Shed.MOVERS
        young = self.young_map.first is not None or self.predictor.image_motion.active
        carried = not young and self.detector.memory.can_carry(view.labelled, prediction.T_world_camera)
        return self.shed if carried and not self.predictor.mostly_dynamic else self.shed & ~Shed.LABELS

    def _rectified(self, view: FrameView) -> FrameView:
        with view.timer("rectify"):
            observation = self.color_motion.rectified(view.observation)
            if observation is view.observation:
                return view
            known = None if view.known_dynamic is None else view.known_dynamic.reshape(-1)[observation.sources]
            return replace(FrameView.of(observation, self.config, self.detector), timer=view.timer, known_dynamic=known)

    def _repeat(self, view: FrameView, last: FrameResult) -> FrameResult:
        """Result of a frame that repeats the frame before, or its depth.

        It has the repeated pose, or with new colours the predicted pose until the next frame is tracked, while
        predictions are valid.
        """
        depth_only, time, drift = self.stream.repeats == "depth", view.timestamp, self.motion.drift(view.timestamp)
        images = "the depth image" if depth_only else "both images"
        repeated = Outcome.of(f"{self.stream.repeats}_repeats", 1, 0, f"the frame has {images} of the frame before")
        reasons, status, T_world_camera, covariance = (), Status.REPEATED, last.T_world_camera, last.covariance
        if T_world_camera is None:
            reasons, status = last.verdict.failed[:1], last.status
        elif drift > MAX_DRIFT:
            hangs = f"{images} repeat for {time - self.motion.timestamp:.2f} s: the sensor hangs"
            reasons, status = (Outcome.of("repeated_drift_m", drift, MAX_DRIFT, hangs),), Status.LOST
            T_world_camera = covariance = None
        else:
            T_world_camera = self.motion.repeated(time, T_world_camera, depth_only=depth_only)
            if covariance is not None and depth_only:
                covariance = covariance + np.diag(np.repeat((drift, drift / self.atlas.unit), 3) ** 2)
            depth_only = depth_only or "depth_repeats" in last.verdict
            self.atlas.add_pose(time, T_world_camera, "depth" if depth_only else "frame")
        self._last = replace(
            last, timestamp=time, status=status, T_world_camera=T_world_camera, covariance=covariance,
            verdict=Verdict((*reasons, repeated)), timings=view.timer.timings,
        )  # fmt: skip
        return self._last

    def _resumed(self, view: FrameView) -> FrameView:
        """The frame on the clock of the first frames; a long pause invalidates velocity and place."""
        if self.stream.clock_offset != 0:
            view = replace(view, observation=self.stream.restamped(view.observation))
        if not self.reference.is_empty and self.motion.has_paused(view.timestamp):
            self.front_end.lose(view.timestamp)
        return view

    def _start_map(self, view: FrameView) -> FrameResult:
        T_start = self.motion.start
        estimate = PoseEstimate.at_origin(view.first_gain if self.config.tracker.exposure else 1.0, T_start)
        mask = estimate.dynamic_mask(view)
        self.young_map.textureless = view.textureless
        verdict = self.young_map.verdict(view, mask)
        if not verdict.accepted:
            return self._result(view, None, mask, verdict, Status.LOST)
        self.motion.restart(view.timestamp, estimate.T_world_camera)
        view = self.color_motion.registered(view, estimate.T_world_camera)
        self.atlas.add_pose(view.timestamp, estimate.T_world_camera)
        self.young_map.start(view, estimate)
        self.mapper.extend(view, estimate, mask, fuse=True)
        self.color_motion.start(view)
        if self.config.dynamics.enabled:
            self.predictor.start(view.timestamp)
            self.detector.start(view.timestamp, view.labelled, estimate.T_world_camera)
        self.predictor.update(view, estimate)
        return self._result(
            view, None, mask, verdict, T_world_camera=estimate.T_world_camera, covariance=np.zeros((6, 6)),
            events=("started",),
        )  # fmt: skip

    def _relocalize(self, view: FrameView, prediction: PosePrediction) -> Relocalization | None:
        """Pose of a frame from keyframes; atlas and motion model follow it."""
        self.monitor.lose()
        view = self.color_motion.registered(view, prediction.T_world_camera)
        found = self.relocalizer.recover(
            view,
            lambda volume, T_init: self.front_end.register_from(volume, view, prediction, T_init),
            self.monitor.misfit,
        )
        if found is None:
            return None
        self.atlas.switch_to(found.submap)
        self.young_map.abandon()
        self.motion.restart(view.timestamp, found.estimate.T_world_camera)
        return found

    def _lose(self, view: FrameView, estimate: PoseEstimate, verdict: Verdict) -> FrameResult:
        self.relocalizer.lost(view.timestamp, mostly_dynamic=self.predictor.mostly_dynamic)
        self.front_end.lose(view.timestamp)
        self.color_calibration.interrupt()
        if self.relocalizer.start_verdict(view).accepted:
            return self._start_submap(replace(view, blind=False))
        return self._result(view, estimate, estimate.dynamic_mask(view), verdict, Status.LOST)

    def _start_submap(self, view: FrameView) -> FrameResult:
        self.atlas.start_submap()
        self._forget_map()
        return self._start_map(view)

    def _decide_start(self, view: FrameView, prediction: PosePrediction) -> bool:
        """Register and fuse the first frames of a map again, if visible slow motion contradicts the map."""
        if self.young_map.first is None:
            return False
        with view.timer("parallax"):
            moving = prediction.moving
            if view.known_dynamic is not None:
                known = reduced(view.known_dynamic, view.labelled)
                moving = known if moving is None else moving | known
            frames = self.young_map.decide(view.tracked_at(prediction.T_world_camera, moving=moving))
        return bool(frames) and self._replay(frames, view.timer)

    def _replay(self, frames: list[StartFrame], timer: StageTimer) -> bool:
        """Process the first frames again with revised poses and moving pixels; returns whether poses changed."""
        first, replayed = frames[0], [frames[0]]
        corrections = [first.T_world_camera @ se3.inverse(first.estimate.T_world_camera)]
        for remembered in (self.detector, self.redundancy):
            remembered.reset()
        self.mapper.begin_anew(first, timer)
        self.detector.start(first.view.timestamp, first.view.labelled, first.T_world_camera)
        self.motion.restart(first.view.timestamp, first.T_world_camera)
        for frame in frames[1:]:
            view = replace(frame.view, timer=timer)
            prediction = PosePrediction.known(frame.T_world_camera, frame.moving, frame.undecided)
            estimate = self.front_end.register_from(self.reference, view, prediction, frame.T_world_camera)
            if not estimate.tracking.accepted:
                estimate = self.front_end.at_given(self.reference, view, prediction)
            self.front_end.update(view, estimate)
            self.predictor.update(view, estimate)
            self.mapper.integrate(view, estimate, estimate.dynamic_mask(view) | frame.undecided_mask)
            replayed.append(frame.registered(estimate))
            corrections.append(estimate.T_world_camera @ se3.inverse(frame.estimate.T_world_camera))
        self.monitor.reset()  # frames fit a map of few frames better than later ones
        self.young_map.replace_frames(replayed)
        self.atlas.move(np.array([frame.view.timestamp for frame in frames]), np.stack(corrections))
        self.color_calibration.repaint()
        return len(frames) > 1

    def _forget_map(self) -> None:
        self.color_calibration.interrupt()
        for remembered in (self.monitor, self.detector, self.predictor.image_motion, self.redundancy):
            remembered.reset()
        self.relocalizer.found()

    def _accept(self, view: FrameView, estimate: PoseEstimate) -> None:
        self.front_end.update(view, estimate)
        self.relocalizer.found()
        self.atlas.add_pose(view.timestamp, estimate.T_world_camera)
        self.predictor.update(view, estimate)

    def _fusion_verdict(self, view: FrameView, estimate: PoseEstimate) -> Verdict:
        repeats, unused = self.stream.repeats == "color", "map without texture" if self.young_map.textureless else ""
        crowd = self.predictor.mostly_dynamic and self.predictor.image_motion.map_is_young(view.timestamp)
        certain = Verdict((
            Outcome.of("color_repeats", repeats, 0, "the colour image equals the one before", overruled_by=unused),
            Outcome.of("blind", view.blind and not repeats, 0, "the image has no contrast, or the light has changed"),
            *estimate.doubts(view),
            Outcome.of("crowd", crowd, 0, "most of the view moves, and the map is young", overruled_by="static part"),
            Outcome.of("localize", self.localize, 0, "the map is not changed"),
            *((Outcome.of("shed", 1, 0, "no time to fuse the frame"),) if Shed.FUSION in view.shed else ()),
        ))  # fmt: skip
        with view.timer("similarity"):
            redundant = certain.accepted and self.redundancy.is_redundant(self.atlas.volume, view, estimate)
        return certain + Verdict((Outcome.of("redundant", redundant, 0, "the map has the content of the frame"),))

    def _close_loop(
        self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """Correction of the world by a loop closure; None if none was closed."""
        if self.atlas.history is None or view.without_image or self.motion.is_given:
            return None
        with view.timer("loops"):
            levels = view.pyramid.tracked
            query = LoopQuery(view.colored(), levels, estimate.tracking, dynamic_mask, estimate.labels)
            correction = self.loops.close(query, self.monitor)
        if correction is not None:
            self.young_map.abandon()  # the poses of held-back frames are outdated
            for moved in (self.motion, self.redundancy, self.detector):
                moved.apply_correction(correction)
        return correction

    def _calibrate(
        self, view: FrameView, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_], *, corrected: bool
    ) -> bool:
        """Update the colour calibration; returns whether the next frame uses a new one."""
        calibrated = self.color_calibration.update(view, T_world_camera, dynamic_mask, corrected=corrected)
        if calibrated:  # earlier images have colours registered with another calibration
            self.predictor.image_motion.reset()
            self.young_map.abandon()
        return calibrated

    def _result(
        self,
        view: FrameView,
        estimate: PoseEstimate | None,
        dynamic_mask: NDArray[np.bool_],
        verdict: Verdict,
        status: Status = Status.TRACKED,
        *,
        T_world_camera: NDArray[np.float64] | None = None,
        covariance: NDArray[np.float64] | None = None,
        **details: Any,  # noqa: ANN401 - further attributes of the result
    ) -> FrameResult:
        """The result of a frame, with the mask in the recorded (distorted) image."""
        labels, tracking = (None, None) if estimate is None else (estimate.labels, estimate.tracking)
        readings, count = view.observation.readings, view.observation.num_readings
        result = FrameResult(
            view.timestamp, status, T_world_camera, covariance, verdict,
            dynamic_mask=self.preprocess.distorted(recorded_mask(dynamic_mask, view.observation)),
            dynamic_share=np.count_nonzero(dynamic_mask & readings) / max(count, 1),
            residuals=np.full((1, 1), np.nan, np.float32) if labels is None else labels.sample.distance,
            timings=view.timer.timings, submap=self.atlas.current, shed=view.shed,
            _labels=labels, _tracking=tracking, **details,
        )  # fmt: skip
        if status is not Status.REJECTED:
            self._last = result.without_details()
        return result

    def _volume(self) -> TsdfVolume:
        config, backend, size = self.config, make_backend(self.device), self.arguments.max_blocks
        return make_volume(self.camera, config.volume, config.sensor, config.preprocess.depth_max, backend, size)
