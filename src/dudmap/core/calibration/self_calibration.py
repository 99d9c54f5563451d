"""Calibration of the colour camera while it moves."""

import os
import sys
from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread, get_native_id

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.core.calibration.keyframes import KeyframeCollector
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.state import Remembered, Stateful

ATTEMPTS = (120, 240, 480, 960)
"""Numbers of tracked frames after which the calibration is estimated from the keyframes so far: after the four seconds
of hand-held motion that show every fault, and each time after twice as long, as more was seen."""
DELAY = 60
"""Frames between the beginning of an estimation and the use of its result: the time that it takes beside the tracking,
so that a recording, whose result must not depend on the machine, rarely has to wait for it."""

PRIORITY = 10
"""Priority of the thread of an estimation, as of ``nice``: a tenth of the share of the tracking on a busy core."""


class SelfCalibration(Stateful):
    """Estimates the calibration in a thread of its own while frames are tracked.

    Each estimate starts from the calibration as given and takes all keyframes of the current submap, whose colours are
    kept as they were recorded, so that it does not matter with which calibration they were tracked.

    ``live``: The result is used as soon as it is there, and not after a fixed number of frames. ``estimate`` is the
    last one that was finished; None before.
    """

    estimate: Remembered[Estimate | None] = None
    _collector: Remembered[KeyframeCollector]
    _attempts: Remembered[list[int]]
    _frames: Remembered[int] = 0
    _submap: Remembered[int] = 0
    _running: Remembered[Future[Estimate] | None] = None
    _due: Remembered[int] = 0

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
            self._due = self._frames + DELAY
            estimator, keyframes = CalibrationEstimator(self.given, self.sensor), list(self._collector.keyframes)
            self._running = _in_background(lambda: estimator.estimate(keyframes))
            if not self._attempts:
                self._collector.clear()

    def interrupt(self, *, moved: bool = False) -> None:
        """A frame was not tracked; or ``moved``, the poses so far were corrected and those to come do not fit them."""
        if moved:
            self._collector.clear()
        self._collector.interrupt()

    def found(self) -> Calibration | None:
        """A calibration that is to be used from the next frame on; None if the one in use stays."""
        if self._running is None or not (self._running.done() if self.live else self._frames >= self._due):
            return None
        self.estimate, self._running = self._running.result(), None
        return self.estimate.calibration if self.estimate.calibration.estimated else None


def _in_background(function: Callable[[], Estimate]) -> "Future[Estimate]":
    """Result of a function that runs in a thread which does not keep the process alive."""
    future: Future[Estimate] = Future()

    def work() -> None:
        if sys.platform == "linux":  # where threads have priorities
            os.setpriority(os.PRIO_PROCESS, get_native_id(), PRIORITY)
        try:
            future.set_result(function())
        except BaseException as error:  # raised where the result is asked for
            future.set_exception(error)

    Thread(target=work, name="dudmap-calibration", daemon=True).start()
    return future
