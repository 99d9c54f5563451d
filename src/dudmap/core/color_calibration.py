"""The calibration of the colour camera in use, and what changes when a better one is found."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.calibration.self_calibration import SelfCalibration
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.frame_view import FrameView


class ColorCalibration(Stateful):
    """Calibrates the colour camera while frames are tracked, and repaints the maps with what is found.

    Args:
        config: Whether to calibrate, and the noise of the sensor.
        camera: Of the depth images, without lens distortion.
        start: The calibration to begin with; None for colour that is registered to depth. One that was estimated, whose
            standard deviations are known, is kept.
        atlas: The maps and the stored frames.
        color_motion: Registers the colours of the frames.
        live: A calibration is used as soon as it is found, and not at a fixed frame.
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
            if corrected or view.blind:
                self._estimation.interrupt(moved=corrected)
            else:
                self._estimation.add(view.observation, T_world_camera, dynamic_mask, self._atlas.current)
            found = self._estimation.found()
            if found is None:
                return False
            self._color_motion.calibration = found
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
