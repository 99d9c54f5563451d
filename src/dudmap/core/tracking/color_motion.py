"""Registration of colour to depth under camera motion, and the remaining intensity noise."""

from dataclasses import replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import median
from dudmap.core.backends.parameters import ColorProjection
from dudmap.core.backends.threads import submit
from dudmap.core.dynamics.segments import Segmentation, intensity_gradient
from dudmap.core.frames.color_registration import color_projection, recorded_intensity, register_color
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, Observation, Pyramid
from dudmap.core.frames.rolling_shutter import rectified
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView
from dudmap.core.tracking.motion_model import VELOCITY_LIFETIME, MotionModel


class RegisteredLevel(Level):
    """A level that registers its intensities on demand. They follow from the other attributes and are no state.

    Attributes:
        observation: The frame.
        calibration: Calibration of the colour camera.
        velocity: (6,) twist of the camera per second.
    """

    observation: Observation
    calibration: Calibration
    velocity: NDArray[np.float64]

    def __init__(self, level: Level, **attributes: object) -> None:
        self.__dict__.update(camera=level.camera, depth=level.depth, ceiling=level.ceiling, **attributes)

    @cached_property
    def intensity(self) -> NDArray[np.float32]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Registered intensities (h, w)."""
        halvings = round(np.log2(self.observation.camera.width / self.camera.width))
        projection = color_projection(self.calibration, self.velocity, self.observation.color_offset)
        camera = self.calibration.camera.scaled(halvings)
        projection = projection._replace(intrinsics=camera.intrinsics, height=camera.height)
        recorded = recorded_intensity(self.observation, halvings)
        return register_color(recorded, self.depth, self.camera, projection)


class ColorMotion(Stateful):
    """Registers colour to depth with the present calibration, which may change while the camera moves.

    Stability: the colour image is taken tau after the depth, at y = x + tau v. Registered with the velocity v + d, it
    pulls the pose to x - tau d. With the share k of colour in the registration and the frame interval dt, the found
    pose implies the velocity v - k (tau / dt) d, which diverges for tau > dt / 2 and k = 1. The velocity therefore
    moves by the part a = 1 / (1 + tau / dt) only, which leaves d (1 - a (1 + k tau / dt)).

    The velocity of the first frame of a map is unknown. Colours of the first two frames are not moved; with the motion
    between them, the first frame is fused again.

    Args:
        motion: Velocity of the camera.
        given: Calibration for preparing frames; None for registered colour.

    Attributes:
        calibration: Calibration in use; None for images without correction.
    """

    given: Remembered[Calibration | None]
    calibration: Remembered[Calibration | None]
    _is_first: Remembered[bool] = False  # the last frame began a map, with unknown velocity
    _rectified_from: Remembered[float] = -np.inf  # time stamp of the first frame with known rolling shutter

    def __init__(self, motion: MotionModel, given: Calibration | None) -> None:
        self.motion = motion
        self.given = given
        self.calibration = given

    def time_sigma(self, assumed: float) -> float:
        """See ``Calibration.time_sigma``; ``assumed`` without a calibration."""
        return assumed if self.calibration is None else self.calibration.time_sigma(assumed)

    def start(self, view: FrameView) -> None:
        """Begin with the first frame of a map."""
        self._is_first = not self.is_prepared(view.observation) or self.rectifies

    def first_frame(
        self, first: FrameView | None, timestamp: float, T_world_camera: NDArray[np.float64]
    ) -> FrameView | None:
        """The first frame of a map, rectified and with registered colours, given the pose (4, 4) of the next.

        None if the map is already correct, its first frame is forgotten, or the velocity is outdated.
        """
        is_first, self._is_first = self._is_first, False
        if first is None or not is_first or self.motion.elapsed(timestamp) > VELOCITY_LIFETIME:
            return None
        velocity = self.motion.velocity_to(timestamp, T_world_camera)
        return self._with_colors(replace(first, observation=self.rectified(first.observation, velocity)), velocity)

    def predicted(self, view: FrameView) -> FrameView:
        """The frame with intensities registered by the last velocity."""
        return self._with_levels(view, self.motion.velocity)

    def refined(self, view: FrameView, T_world_camera: NDArray[np.float64]) -> FrameView:
        """The frame with intensities registered by the velocity to a first estimate of its pose (4, 4)."""
        if self._is_first:
            return view
        return self._with_levels(view, self._velocity(view, T_world_camera))

    def registered(self, view: FrameView, T_world_camera: NDArray[np.float64]) -> FrameView:
        """The frame at its pose (4, 4); another thread registers its colours (``FrameView.colored``)."""
        velocity = self._velocity(view, T_world_camera)
        if self._is_first:  # the next frames are compared with its intensities
            view = self._with_levels(view, velocity)
        return self._with_colors(view, velocity)

    def frame_with_colors(
        self, frame: Frame, camera: Camera, velocity: NDArray[np.float64], calibration: Calibration | None
    ) -> Frame:
        """A frame with its recorded colour registered to the preprocessed depth.

        ``camera``: depth camera without distortion. ``velocity``: (6,) twist per second, camera axes. ``calibration``:
        of the colour camera; None for registered colour.
        """
        if calibration is None:
            return frame
        projection = self._projection(calibration, frame, velocity)
        return replace(frame, color=register_color(frame.rgb, frame.depth, camera, projection))

    def is_prepared(self, observation: Observation) -> bool:
        """Whether the colours need no further registration."""
        calibration = self.calibration
        if calibration is None or calibration.is_registered(observation.camera) or not observation.has_color:
            return True
        return calibration is self.given and calibration.is_instant(observation.color_offset)

    @property
    def rectifies(self) -> bool:
        """Whether depth images have a rolling shutter to correct."""
        return self._depth_readout != 0

    def rectified(self, observation: Observation, velocity: NDArray[np.float64] | None = None) -> Observation:
        """A frame rectified to the time of its middle row. ``velocity``: (6,) twist per second; None for the last
        one."""
        velocity = self.motion.velocity if velocity is None else velocity
        if not (self.rectifies and velocity.any()):
            return observation
        return rectified(observation, self._depth_readout, velocity, with_color=self.is_prepared(observation))

    def use(self, calibration: Calibration, timestamp: float) -> None:
        """Use a calibration after this time stamp."""
        if calibration.depth_readout != self._depth_readout:
            self._rectified_from = timestamp
        self.calibration = calibration

    @property
    def _depth_readout(self) -> float:
        return 0.0 if self.calibration is None else self.calibration.depth_readout

    def _projection(self, calibration: Calibration, frame: Frame, velocity: NDArray[np.float64]) -> ColorProjection:
        offset = 0.0 if frame.color_timestamp is None else frame.color_timestamp - frame.timestamp
        readout = calibration.depth_readout
        if frame.timestamp <= self._rectified_from or readout != self._depth_readout:  # its depth is not rectified
            calibration = replace(calibration, depth_readout=0.0)
        return color_projection(calibration, velocity, offset)

    def _with_colors(self, view: FrameView, velocity: NDArray[np.float64]) -> FrameView:
        observation, calibration = view.observation, self.calibration
        if calibration is None or self.is_prepared(observation):
            return view
        recorded = observation.as_recorded
        projection = self._projection(calibration, recorded, velocity)

        def colored() -> Observation:
            rgb = register_color(recorded.rgb, recorded.depth, observation.camera, projection)
            return replace(observation, rgb=rgb, recorded_rgb=recorded.color)

        return replace(view, colors=submit(colored))

    def _velocity(self, view: FrameView, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Twist per second after registration of a frame."""
        if self.calibration is None:
            return view.color_velocity
        assumed, found = view.color_velocity, self.motion.velocity_to(view.timestamp, T_world_camera)
        if self._is_first:
            return found
        ratio = (self.calibration.delay + view.observation.color_offset) / self.motion.elapsed(view.timestamp)
        return assumed + 1 / (1 + max(ratio, 0.0)) * (found - assumed)

    def _with_levels(self, view: FrameView, velocity: NDArray[np.float64]) -> FrameView:
        calibration = self.calibration
        if calibration is None or self.is_prepared(view.observation):
            return view
        pyramid = view.pyramid
        given = {"observation": view.observation, "calibration": calibration, "velocity": velocity}
        levels = {level: RegisteredLevel(level, **given) for level in (*pyramid.tracked, pyramid.labelled)}
        pyramid = Pyramid([levels[level] for level in pyramid.tracked], levels[pyramid.labelled])

        @cache
        def segmentation() -> Segmentation:
            return replace(view.segmentation(), gradient=intensity_gradient(pyramid.labelled))

        return replace(view, levels=lambda: pyramid, segmentation=segmentation, color_velocity=velocity)


RESOLUTION = 0.5
"""Displacement that intensities cannot resolve: half a voxel or pixel."""
STRIDE = 8
"""Step between sampled pixels, across and down."""


def motion_discount(level: Level, velocity: NDArray[np.float64], time_sigma: float, voxel_size: float) -> float:
    """Factor in (0, 1] for the weight of the intensity residual while the camera moves.

    Rolling shutter, exposure and unsynchronised cameras separate colour and depth of a pixel by a time of standard
    deviation ``s``. At an image speed ``u`` (px/s) the residual has the variance

        sigma^2 + |grad I|^2 (s u)^2 = sigma^2 (1 + (s u / r)^2),   r = sigma / |grad I|.

    The resolved displacement r is half a pixel, or half a voxel. The weight is divided by the bracket with the median
    of u / r over the image. The motion field of a twist (v, omega) is, per unit of the image at depth 1
    (Longuet-Higgins and Prazdny 1980),

        (-v_x + x v_z) / z - omega_y + y omega_z + x (y omega_x - x omega_y),
        (-v_y + y v_z) / z + omega_x - x omega_z + y (y omega_x - x omega_y).

    Args:
        level: Finest level of the registration.
        velocity: (6,) twist per second, camera axes.
        time_sigma: ``s``, seconds.
        voxel_size: Metres.
    """
    camera, part = level.camera, np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    v, u = np.nonzero(level.depth[part] > 0)
    if len(u) == 0:
        return 1.0
    z = level.depth[part][v, u].astype(np.float64)
    x = (STRIDE * u + STRIDE // 2 - camera.cx) / camera.fx
    y = (STRIDE * v + STRIDE // 2 - camera.cy) / camera.fy
    (vx, vy, vz), (wx, wy, wz) = velocity[:3], velocity[3:]
    tilt = y * wx - x * wy
    across, down = (x * vz - vx) / z - wy + y * wz + x * tilt, (y * vz - vy) / z + wx - x * wz + y * tilt
    resolved = RESOLUTION * np.maximum(1 / camera.fx, voxel_size / z)
    return 1 / (1 + (time_sigma * float(median(np.hypot(across, down) / resolved))) ** 2)


def gain_discount(gain: float, sigma: float, color_weight: float) -> float:
    """Factor in (0, 1] for the weight of the intensity residual of an image darker than the map.

    A weight w against distances with standard deviation ``sigma`` corresponds to the variance sigma^2 / w. The rounding
    of grey levels spread by a gain g adds (g^2 - 1) / 12.
    """
    rounding = max(gain * gain - 1, 0.0) / (12 * 255**2)
    return 1 / (1 + rounding * color_weight / sigma**2)
