"""Frames from which the calibration is estimated."""

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
"""Width of the depth images that are compared, pixels."""
COLOR_WIDTHS = (80, 160, 320)
"""Widths of the colour images that are compared, coarse to fine, pixels."""
POINT_STRIDE = 3
"""Every so many pixels, across and down, are points that are compared."""
SAME_SURFACE = 0.03
"""Depth differences below this share of the depth belong to one surface."""


BAND = 1.0, 4.0
"""Standard deviations of the Gaussians whose difference filters the intensities, pixels. Vignetting, shading and
exposure change slowly over the image and stay with the camera, which would look like a displacement of the colours;
noise and detail of single pixels differ from view to view and spoil the derivatives."""
BESIDE = 2
"""Pixels beside what moves that are taken for it, since its outline is known no better."""
INTERVAL = 0.1
"""Time between two keyframes at the start, seconds."""
MAX_KEYFRAMES = 60
"""Largest number of keyframes; beyond it every second one is dropped and the interval doubles."""
MAX_GAP = 0.45
"""Largest time between the neighbours of a keyframe for its velocity to be known, seconds: two intervals at 5 Hz."""


@dataclass(frozen=True, eq=False)
class ColorKeyframe:
    """A frame for the calibration.

    Attributes:
        timestamp: Of the depth image, s.
        color_offset: Time stamp of the colour image minus that of the depth image, s.
        camera: Of ``depth``.
        depth: (h, w) float32, metres, 0 where there is no reading or something moves.
        points: (n, 3) float32 in the camera frame, away from depth edges.
        tangents: (n, 6) float32, two directions of the surface at each point.
        intensities: (h, w) float32 of the colour image as recorded, filtered with ``BAND``, coarse to fine; NaN where
            something moves.
        brightness: (h, w) float32 of the smallest of them, not filtered.
        T_world_camera: (4, 4).
        velocity: (6,) twist per second, camera axes.
        depth_readout: Readout of a rolling shutter that was taken out of the depth, seconds.
        interval: Mean time from one to the next of the three frames that give the velocity, seconds.
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
    """Number of halvings after which an image is about so wide."""
    return max(0, round(np.log2(camera.width / width)))


def color_levels(camera: Camera) -> list[int]:
    """Halvings of the colour images that are compared, coarse to fine; fewer for small images."""
    return sorted({halvings_to(width, camera) for width in COLOR_WIDTHS}, reverse=True)


def levels_of(observation: Observation, given: Calibration) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
    """Depth (h, w) of the observation that is compared, and its recorded intensities (h, w), coarse to fine; ``given``
    is the calibration of the colour images."""
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
    """Keyframe of a preprocessed frame at a pose (4, 4) with a velocity (6,), twist per second in camera axes, without
    the pixels (H, W) that move, in either image; ``given`` is the calibration of the colour images as recorded, and
    ``interval`` as of ``ColorKeyframe``."""
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
    """Pixels (h, w) of a colour image beside which, or where, it shows the ``moving`` pixels of the depth image, which
    are ``distance`` metres away."""
    import cv2

    plane = T_color_depth[:3, :3] + np.outer(T_color_depth[:3, 3], (0, 0, 1 / distance))
    homography = color_camera.K @ plane @ np.linalg.inv(camera.K)
    seen = cv2.warpPerspective(moving.astype(np.uint8), homography, color_camera.shape[::-1])
    return cv2.dilate(seen, np.ones((2 * BESIDE + 1,) * 2, np.uint8)) > 0


def _filtered(image: NDArray[np.float32], moving: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Intensities (h, w) filtered with ``BAND``, into which nothing of the ``moving`` pixels enters, which are NaN."""
    import cv2

    still = (~moving).astype(np.float32)
    shares = [np.maximum(cv2.GaussianBlur(still, (0, 0), sigma), np.float32(1e-3)) for sigma in BAND]
    fine, coarse = (
        cv2.GaussianBlur(image * still, (0, 0), sigma) / share for sigma, share in zip(BAND, shares, strict=True)
    )
    return np.where(moving, np.float32(np.nan), fine - coarse)


def _off_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels (h, w) whose eight neighbours are readings of the same surface."""
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
    """Collects keyframes, in the order of time, evenly over the time since tracking began; ``given`` is the calibration
    of the colour images. ``max_gap`` is the largest time between the two neighbours of a keyframe, seconds, if less
    than ``MAX_GAP``."""

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
        """The keyframes so far; those that another thread is making are waited for."""
        return [taken() for taken in self._taken]

    def add(
        self, observation: Observation, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_]
    ) -> None:
        """Take note of a tracked frame, its pose (4, 4) and the pixels (H, W) that move; the one before may become a
        keyframe, since its velocity is now known."""
        now = observation.timestamp
        if observation.ignored is not None:
            dynamic_mask = dynamic_mask | observation.ignored
        if self._pending is not None:
            middle, T, mask = self._pending
            before, due = self._before, self._latest + self._interval - 1e-3
            if before is not None and now - before[0] <= self.max_gap and middle.timestamp >= due:
                velocity, interval = central_velocity(before, (now, T_world_camera)), (now - before[0]) / 2
                levels_of(middle, self.given)  # cached there by this thread, which may use them in the meantime
                self._taken.append(submit(partial(keyframe, middle, self.given, T, velocity, mask, interval)))
                self._latest = middle.timestamp
                if len(self._taken) > MAX_KEYFRAMES:
                    del self._taken[1::2]
                    self._interval *= 2
            self._before = middle.timestamp, T
        self._pending = observation, T_world_camera, dynamic_mask

    def interrupt(self) -> None:
        """Tracking was lost, or the poses jumped: the velocity across is not known."""
        self._before = self._pending = None

    def clear(self) -> None:
        """Another map has begun, whose poses cannot be compared."""
        self.interrupt()
        self._taken.clear()
        self._interval, self._latest = INTERVAL, -np.inf
