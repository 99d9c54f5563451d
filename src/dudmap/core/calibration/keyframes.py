"""Frames for the estimation of the calibration."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import median
from dudmap.core.backends.threads import submit
from dudmap.core.frames.color_registration import recorded_intensity
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.state import Remembered, Stateful

GEOMETRY_WIDTH = 160
COLOR_WIDTHS = (80, 160, 320)
POINT_STRIDE = 3
"""Step between the compared points, across and down, pixels."""
SAME_SURFACE = 0.03
"""Largest depth difference on one surface, as a share of the depth."""


BAND = 1.0, 4.0
"""Standard deviations of the difference of Gaussians that filters intensities, pixels: without shading and single-pixel
detail."""
BESIDE = 2
"""Dilation of moving pixels, pixels."""
INTERVAL = 0.1
"""Initial time between two keyframes, seconds."""
MAX_KEYFRAMES = 60
"""Keyframes; beyond it every second one is dropped."""
MAX_GAP = 0.45
"""Largest time between the neighbours of a keyframe, seconds: two intervals at 5 Hz."""


@dataclass(frozen=True, eq=False)
class ColorKeyframe:
    """A frame for the calibration.

    Attributes:
        timestamp: Of the depth image, s.
        color_offset: Time stamp of the colour image minus time stamp of the depth image, s.
        camera: Camera of ``depth``.
        depth: (h, w) float32, metres, 0 = moving or no measurement.
        points: (n, 3) float32 in the camera frame, away from depth edges.
        tangents: (n, 6) float32, two directions of the surface at each point.
        intensities: (h, w) float32 recorded, filtered with ``BAND``, coarse to fine; NaN at moving pixels.
        brightness: (h, w) float32, unfiltered intensities of the smallest size.
        T_world_camera: (4, 4).
        velocity: (6,) twist per second, camera axes.
        depth_readout: Removed rolling-shutter readout, seconds.
        interval: Mean interval of the three frames of the velocity, seconds.
    """

    timestamp: float
    color_offset: float
    camera: Camera
    depth: NDArray[np.float32]
    points: NDArray[np.float32]
    tangents: NDArray[np.float32]
    intensities: list[NDArray[np.float32]]
    brightness: NDArray[np.float32]
    T_world_camera: NDArray[np.float64]
    velocity: NDArray[np.float64]
    depth_readout: float = 0.0
    interval: float = MAX_GAP / 2


def halvings_to(width: int, camera: Camera) -> int:
    """Number of halvings that give about this width."""
    return max(0, round(np.log2(camera.width / width)))


def color_levels(camera: Camera) -> list[int]:
    """Halvings of the compared colour images, coarse to fine; fewer for small images."""
    return sorted({halvings_to(width, camera) for width in COLOR_WIDTHS}, reverse=True)


def levels_of(observation: Observation, given: Calibration) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
    """Depth (h, w) and recorded intensities (h, w), coarse to fine.

    ``given``: calibration of the colour images.
    """
    depth, _ = observation.halved(halvings_to(GEOMETRY_WIDTH, observation.camera))
    return depth, [recorded_intensity(observation, number) for number in color_levels(given.camera)]


def keyframe(
    observation: Observation,
    given: Calibration,
    T_world_camera: NDArray[np.float64],
    velocity: NDArray[np.float64],
    dynamic_mask: NDArray[np.bool_],
    interval: float = MAX_GAP / 2,
) -> ColorKeyframe:
    """Keyframe of a preprocessed frame, without moving pixels.

    ``T_world_camera``: (4, 4). ``velocity``: (6,) twist per second, camera axes. ``dynamic_mask``: (H, W). ``given``:
    calibration of the recorded colour images. ``interval``: see ``ColorKeyframe``.
    """
    import cv2

    camera = observation.camera.scaled(halvings_to(GEOMETRY_WIDTH, observation.camera))
    depth, recorded = levels_of(observation, given)
    moving = cv2.resize(dynamic_mask.astype(np.float32), depth.shape[::-1], interpolation=cv2.INTER_AREA) > 0
    readings = depth[moving & (depth > 0)]
    distance = float(median(readings)) if len(readings) else 1.0
    depth = np.where(moving, np.float32(0), depth)
    seen_moving = [
        _seen_moving(moving, distance, camera, given.camera.scaled(number), given.T_color_depth)
        for number in color_levels(given.camera)
    ]
    intensities = [_filtered(image, mask) for image, mask in zip(recorded, seen_moving, strict=True)]
    brightness = np.where(seen_moving[0], np.float32(np.nan), recorded[0])
    smooth = _off_edges(depth)[::POINT_STRIDE, ::POINT_STRIDE]
    points = camera.backproject(depth)
    tangents = np.zeros((*depth.shape, 6), np.float32)
    tangents[:, 1:-1, :3] = points[:, 2:] - points[:, :-2]
    tangents[1:-1, :, 3:] = points[2:] - points[:-2]
    points, tangents = (image[::POINT_STRIDE, ::POINT_STRIDE][smooth] for image in (points, tangents))
    return ColorKeyframe(
        observation.timestamp, observation.color_offset, camera, depth, points, tangents, intensities, brightness,
        T_world_camera, velocity, observation.depth_readout, interval,
    )  # fmt: skip


def _seen_moving(
    moving: NDArray[np.bool_], distance: float, camera: Camera, color_camera: Camera, T_color_depth: NDArray[np.float64]
) -> NDArray[np.bool_]:
    import cv2

    plane = T_color_depth[:3, :3] + np.outer(T_color_depth[:3, 3], (0, 0, 1 / distance))
    homography = color_camera.K @ plane @ np.linalg.inv(camera.K)
    seen = cv2.warpPerspective(moving.astype(np.uint8), homography, color_camera.shape[::-1])
    return cv2.dilate(seen, np.ones((2 * BESIDE + 1,) * 2, np.uint8)) > 0


def _filtered(image: NDArray[np.float32], moving: NDArray[np.bool_]) -> NDArray[np.float32]:
    import cv2

    still = (~moving).astype(np.float32)
    shares = [np.maximum(cv2.GaussianBlur(still, (0, 0), sigma), np.float32(1e-3)) for sigma in BAND]
    fine, coarse = (
        cv2.GaussianBlur(image * still, (0, 0), sigma) / share for sigma, share in zip(BAND, shares, strict=True)
    )
    return np.where(moving, np.float32(np.nan), fine - coarse)


def _off_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    import cv2

    window = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth, window), cv2.dilate(depth, window)
    out = np.asarray((near > 0) & (far - near < SAME_SURFACE * depth))
    out[[0, -1]] = out[:, [0, -1]] = False
    return out


def central_velocity(
    before: tuple[float, NDArray[np.float64]], after: tuple[float, NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Twist per second (6,), camera axes, between two (time, pose) around a frame."""
    return se3.log(se3.inverse(before[1]) @ after[1]) / max(after[0] - before[0], 1e-3)


class KeyframeCollector(Stateful):
    """Collects keyframes in order of time, evenly since tracking began.

    ``max_gap``: limit of the time between a keyframe's neighbours, seconds, below ``MAX_GAP``.
    """

    _taken: Remembered[list[Callable[[], ColorKeyframe]]]
    _interval: Remembered[float]
    _latest: Remembered[float] = -np.inf  # time stamp of the last keyframe
    _before: Remembered[tuple[float, NDArray[np.float64]] | None] = None
    _pending: Remembered[tuple[Observation, NDArray[np.float64], NDArray[np.bool_]] | None] = None

    def __init__(self, given: Calibration, max_gap: float = MAX_GAP) -> None:
        self.given = given
        self.max_gap = min(max_gap, MAX_GAP)
        self._taken = []
        self._interval = INTERVAL

    @property
    def keyframes(self) -> list[ColorKeyframe]:
        """The keyframes so far; waits for another thread."""
        return [taken() for taken in self._taken]

    def add(
        self, observation: Observation, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_]
    ) -> None:
        """Add a tracked frame with its pose (4, 4) and moving pixels (H, W). The previous one may become a keyframe."""
        now = observation.timestamp
        if observation.ignored is not None:
            dynamic_mask = dynamic_mask | observation.ignored
        if self._pending is not None:
            middle, T, mask = self._pending
            before, due = self._before, self._latest + self._interval - 1e-3
            if before is not None and now - before[0] <= self.max_gap and middle.timestamp >= due:
                velocity, interval = central_velocity(before, (now, T_world_camera)), (now - before[0]) / 2
                levels_of(middle, self.given)  # fill the observation's cache in this thread, which may use it meanwhile
                self._taken.append(submit(partial(keyframe, middle, self.given, T, velocity, mask, interval)))
                self._latest = middle.timestamp
                if len(self._taken) > MAX_KEYFRAMES:
                    del self._taken[1::2]
                    self._interval *= 2
            self._before = middle.timestamp, T
        self._pending = observation, T_world_camera, dynamic_mask

    def interrupt(self) -> None:
        """Forget the neighbours after a lost frame or a jump of the pose."""
        self._before = self._pending = None

    def clear(self) -> None:
        """Forget all keyframes for another map."""
        self.interrupt()
        self._taken.clear()
        self._interval, self._latest = INTERVAL, -np.inf
