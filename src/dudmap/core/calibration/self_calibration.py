"""Calibration of the colour camera during tracking, and the switch to a better one."""

import logging
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config, SensorConfig
from dudmap.core.calibration.estimation_process import estimate_beside
from dudmap.core.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.core.calibration.findings import findings, outcome
from dudmap.core.calibration.keyframes import KeyframeCollector
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.frame_view import FrameView

log = logging.getLogger(__name__)

ATTEMPTS = (120, 240, 480, 960)
"""Tracked frames after which the calibration is estimated."""
USED_AFTER = 60
"""Tracked frames between start and use of an estimate: two seconds at 30 Hz."""


class SelfCalibration(Stateful):
    """Estimates the calibration repeatedly during tracking, in another process.

    Each estimate starts from the given calibration, not from the present one, with all keyframes of the submap.

    Attributes:
        estimate: The last finished estimate; None before.
    """

    estimate: Remembered[Estimate | None] = None
    _collector: Remembered[KeyframeCollector]
    _attempts: Remembered[list[int]]
    _frames: Remembered[int] = 0
    _submap: Remembered[int] = 0
    _running: Remembered[Future[Estimate] | None] = None
    _used_from: Remembered[int] = 0
    waits: Remembered[int] = 0

    def __init__(self, given: Calibration, sensor: SensorConfig, *, live: bool = False) -> None:
        self.given = given
        self.sensor = sensor
        self.live = live
        self._collector = KeyframeCollector(given)
        self._attempts = list(ATTEMPTS)

    @property
    def finished(self) -> bool:
        """Whether no further estimate will be made."""
        return not self._attempts and self._running is None

    def add(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_],
        submap: int,
    ) -> None:
        """Add a tracked frame (pose (4, 4), moving pixels (H, W)); start an estimation if due."""
        self._frames += 1
        if not self._attempts:
            return
        if submap != self._submap:
            self._submap = submap
            self._collector.clear()
        self._collector.add(observation, T_world_camera, dynamic_mask)
        if self._frames >= self._attempts[0] and self._running is None:
            self._attempts.pop(0)
            self._used_from = self._frames + USED_AFTER
            estimator = CalibrationEstimator(self.given, self.sensor)
            self._running = estimate_beside(estimator, self._collector.keyframes, idle=self.live)
            if not self._attempts:
                self._collector.clear()

    def interrupt(self, *, moved: bool = False) -> None:
        """Handle a lost frame, or (``moved``) a correction of past poses."""
        if moved:
            self._collector.clear()
        self._collector.interrupt()

    def found(self) -> Calibration | None:
        """A calibration for all frames after this one; None to keep the present one."""
        if self._running is None or not (self._running.done() if self.live else self._frames >= self._used_from):
            return None
        self.waits += not self._running.done()
        self.estimate, self._running = self._running.result(), None
        found = replace(self.estimate.calibration, notes=tuple(findings(self.estimate)))
        for note in found.notes:
            log.debug(note)
        return found if found.estimated else None


class ColorCalibration(Stateful):
    """Calibrates the colour camera during tracking, and repaints the maps with the result.

    Args:
        camera: Camera of the depth images, without lens distortion.
        start: Initial calibration; None for registered colour. An estimated one with standard deviations is kept.
        color_motion: Registers the colours of the frames.
    """

    _estimation: Remembered[SelfCalibration | None]
    _next: Remembered[Calibration | None] = None  # used once the current map is repainted

    def __init__(
        self,
        config: Config,
        camera: Camera,
        start: Calibration | None,
        atlas: Atlas,
        color_motion: ColorMotion,
        *,
        live: bool,
    ) -> None:
        self._camera = camera
        self._start = start or Calibration.registered(camera)
        self._atlas = atlas
        self._color_motion = color_motion
        self._estimation = None
        atlas.depth_late = self._start.depth_late
        if atlas.history is None:  # no frames for repainting
            return
        atlas.history.registered = self._registered
        if config.sensor.self_calibration and not np.isfinite(self._start.sigma).any():
            self._estimation = SelfCalibration(self._start, config.sensor, live=live)

    @property
    def waits(self) -> int:
        """Frames that waited for a calibration."""
        return 0 if self._estimation is None else self._estimation.waits

    @property
    def current(self) -> Calibration:
        """The newest calibration."""
        return self._next or self._color_motion.calibration or self._start

    def repaint(self) -> None:
        """Repaint a map that was rebuilt during its repainting."""
        if self._next is not None:
            self._atlas.recolor()

    def update(
        self, view: FrameView, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_], *, corrected: bool
    ) -> bool:
        """Learn from a tracked frame (pose (4, 4), dynamic pixels (H, W) bool); ``corrected``: it closed a loop.

        Returns whether the next frame has a new calibration; the maps are then repainted.
        """
        if self._estimation is None or (self._estimation.finished and self._next is None):
            return False
        with view.timer("calibrate"):
            if corrected or view.without_image:
                self._estimation.interrupt(moved=corrected)
            else:
                self._estimation.add(view.observation, T_world_camera, dynamic_mask, self._atlas.current)
            if self._next is None and (found := self._estimation.found()) is not None:
                log.info("%.3f s: %s", view.timestamp, outcome(found, self._camera))
                self._next = found
                self._atlas.recolor()
            if self._next is None or not self._atlas.take_repainted():
                return False
            self._color_motion.use(self._next, view.timestamp)
            self._atlas.depth_late, self._next = self._next.depth_late, None
            return True

    def interrupt(self) -> None:
        """Handle a lost frame."""
        if self._estimation is not None:
            self._estimation.interrupt()

    def _registered(self, stored: Frame) -> Frame:
        velocity = self._atlas.velocity_at(stored.timestamp)
        calibration = self._next or self._color_motion.calibration
        return self._color_motion.frame_with_colors(stored, self._camera, velocity, calibration)
