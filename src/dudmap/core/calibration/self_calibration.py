"""Calibration of the colour camera while it moves, and what changes when a better one is found."""

from concurrent.futures import Future

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config, SensorConfig
from dudmap.core.backends.threads import num_threads
from dudmap.core.calibration.estimation_process import estimate_beside
from dudmap.core.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.core.calibration.keyframes import ColorKeyframe, KeyframeCollector
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.frame_view import FrameView

ATTEMPTS = (120, 240, 480, 960)
"""Numbers of tracked frames after which the calibration is estimated from the keyframes so far: after the four seconds
of hand-held motion that show every fault, and each time after twice as long, as more was seen."""


class SelfCalibration(Stateful):
    """Estimates the calibration from time to time while frames are tracked.

    Each estimate starts from the calibration as given and takes all keyframes of the current submap, whose colours are
    kept as they were recorded, so that it does not matter with which calibration they were tracked.

    ``live``: It is estimated beside the frames and used as soon as it is there. A recording, whose result must not
    depend on the machine, waits for it. ``estimate`` is the last one that was finished; None before.
    """

    estimate: Remembered[Estimate | None] = None
    _collector: Remembered[KeyframeCollector]
    _attempts: Remembered[list[int]]
    _frames: Remembered[int] = 0
    _submap: Remembered[int] = 0
    _running: Remembered[Future[Estimate] | None] = None

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
        """Take note of a tracked frame at a pose (4, 4) in the world of a submap, of which the pixels ``dynamic_mask``
        (H, W) move, and begin an estimation if it is time."""
        self._frames += 1
        if not self._attempts:
            return
        if submap != self._submap:
            self._submap = submap
            self._collector.clear()
        self._collector.add(observation, T_world_camera, dynamic_mask)
        if self._frames >= self._attempts[0] and self._running is None:
            self._attempts.pop(0)
            estimator = CalibrationEstimator(self.given, self.sensor, 1 if self.live else num_threads())
            start = estimate_beside if self.live else _estimated
            self._running = start(estimator, self._collector.keyframes)
            if not self._attempts:
                self._collector.clear()

    def interrupt(self, *, moved: bool = False) -> None:
        """A frame was not tracked; or ``moved``, the poses so far were corrected and those to come do not fit them."""
        if moved:
            self._collector.clear()
        self._collector.interrupt()

    def found(self) -> Calibration | None:
        """A calibration that is to be used from the next frame on; None if the one in use stays."""
        if self._running is None or not self._running.done():
            return None
        self.estimate, self._running = self._running.result(), None
        return self.estimate.calibration if self.estimate.calibration.estimated else None


def _estimated(estimator: CalibrationEstimator, keyframes: list[ColorKeyframe]) -> "Future[Estimate]":
    """Result of an estimation that is waited for."""
    future: Future[Estimate] = Future()
    future.set_result(estimator.estimate(keyframes))
    return future


class ColorCalibration(Stateful):
    """Calibrates the colour camera while frames are tracked, and repaints the maps with what is found.

    Args:
        config: Whether to calibrate, and the noise of the sensor.
        camera: Of the depth images, without lens distortion.
        start: The calibration to begin with; None for colour that is registered to depth. One that was estimated, whose
            standard deviations are known, is kept.
        atlas: The maps and the stored frames.
        color_motion: Registers the colours of the frames.
        live: Frames do not wait for a calibration.
    """

    _estimation: Remembered[SelfCalibration | None]

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
        self._camera, self._live = camera, live
        self._start = start or Calibration.registered(camera)
        self._atlas = atlas
        self._color_motion = color_motion
        self._estimation = None
        atlas.depth_late = self._start.depth_late
        if atlas.history is None:  # nothing to repaint with
            return
        atlas.history.registered = self._registered
        if config.sensor.self_calibration and not np.isfinite(self._start.sigma).any():
            self._estimation = SelfCalibration(self._start, config.sensor, live=live)

    @property
    def current(self) -> Calibration:
        """The calibration in use."""
        return self._color_motion.calibration or self._start

    def update(
        self, view: FrameView, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_], *, corrected: bool
    ) -> bool:
        """Learn from a tracked frame.

        Args:
            view: The frame.
            T_world_camera: (4, 4) its pose.
            dynamic_mask: (H, W) bool.
            corrected: A loop was closed with the frame.

        Returns:
            Whether a new calibration is in use from the next frame on, with which the maps were repainted.
        """
        if self._estimation is None or self._estimation.finished:
            return False
        with view.timer("calibrate"):
            if corrected or view.without_image:
                self._estimation.interrupt(moved=corrected)
            else:
                self._estimation.add(view.observation, T_world_camera, dynamic_mask, self._atlas.current)
            found = self._estimation.found()
            if found is None:
                return False
            self._color_motion.use(found, view.timestamp)
            self._atlas.depth_late = found.depth_late
            self._atlas.recolor(gradually=self._live)
            return True

    def interrupt(self) -> None:
        """A frame was not tracked."""
        if self._estimation is not None:
            self._estimation.interrupt()

    def _registered(self, stored: Frame) -> Frame:
        """A stored frame with its colours registered with the calibration in use."""
        velocity = self._atlas.velocity_at(stored.timestamp)
        return self._color_motion.frame_with_colors(stored, self._camera, velocity)
