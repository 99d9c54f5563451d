"""Drift of the disparity of a sensor that warms up, estimated while the camera is at rest."""

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.depth_correction import DepthCorrection
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.kernels.median import median
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.tracker import MIN_READINGS, LinearSystem, Tracker

RATE = 3e-3
"""Random walk of offset and stretch, 1/m per square root of a second: a disparity step of a Kinect in one second (1/8
pixel; f b = 43 pixels metre)."""
MAX_GAP = 0.2
"""Longest time between two frames in which the sensor is taken to drift, seconds."""
SIGNIFICANT = 11.8
"""Chi-square of two degrees of freedom below which an estimate is not applied at all: three standard deviations."""
MAX_CHANGE = 0.03
"""Largest offset and stretch, 1/m: ten disparity steps of a Kinect."""
AT_REST = 0.02
"""Largest displacement of the image (rotation in radians plus translation over median depth) from where the map was
begun. An unknown static distortion k x^2 of the inverse depth looks like a stretch 2 k times this: 2e-3 / m, less than
a disparity step, for k = 0.05 / m, which is 1.5 % at 1 m at the edge of the image."""
CORRELATED_READINGS = 64.0
"""Neighbouring readings of a level 80 pixels wide whose errors are correlated and which together count as one: a tenth
of the width, the width of a band of equal disparity, squared."""
STEP = 1e-3
"""Step of the numerical derivatives, 1/m: a third of a disparity step of a Kinect."""


class DisparityDrift:
    """Kalman filter of the sensor's disparity error against its state in the first frame of the map.

    A cold Xtion stretches its disparity by five steps within seconds, which it shows as vertical bands that move over
    the image. No rigid motion explains that: with distances and intensities the pose ends up between the two. The state
    s = (offset, stretch) follows a random walk. Each frame gives normal equations in the pose xi and s; with xi
    eliminated (Schur complement),

        S = H_ss - H_sx H_xx^-1 H_xs,   e = b_s - H_sx H_xx^-1 b_x,
        P^-1 = (P_before + Q)^-1 + S,   s = s_before - P (e + S (s_before - c)),

    where c is the correction under which the frame was registered. Both terms of the registration take part in H, so
    that intensities hold the pose while distances show the drift. The correction is s max(0, 1 - 11.8 / (s' P^-1 s))
    (the positive-part estimator of James and Stein): nothing below three standard deviations.

    A moving camera sees each surface in another part of the image than the map did, so that the static distortion of
    the sensor would pass for drift. The filter therefore learns only close to the pose of the map's first frame, which
    is the origin of the world, and otherwise keeps what it knows.

    Attributes:
        state: (2,) offset and stretch, 1/m.
        covariance: (2, 2) of them.
        correction: What is applied to the next frame.
    """

    def __init__(self) -> None:
        self.state, self.covariance = np.zeros(2), np.zeros((2, 2))
        self.correction = DepthCorrection()
        self._timestamp: float | None = None
        self._map_id: int | None = None

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (2,) of the state, 1/m."""
        return np.sqrt(np.diag(self.covariance))

    def update(
        self,
        tracker: Tracker,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        timestamp: float,
    ) -> None:
        """Update the estimate with a frame whose pose is accepted.

        Args:
            tracker: Computes the normal equations.
            volume: The map; its window must cover the view.
            level: A coarse level of the image, corrected by ``correction``, in the exposure of the map.
            T_world_camera: (4, 4).
            weights: (h, w) float32 static weights in [0, 1].
            timestamp: Seconds.
        """
        applied = self.correction.coefficients[:2, 0]
        if volume.map_id != self._map_id:  # the map was made of readings corrected in this way, which it now defines
            self._map_id, self.state, self.covariance = volume.map_id, applied, np.zeros((2, 2))
        elapsed = min(timestamp - self._timestamp, MAX_GAP) if self._timestamp is not None else 0.0
        self._timestamp = timestamp
        if elapsed <= 0 or not _at_rest(level, T_world_camera):
            return
        system = tracker.linearize(volume, level, T_world_camera, weights)
        if system.weight < MIN_READINGS:
            return
        S, e = _without_pose(tracker, volume, level, T_world_camera, weights, system)
        predicted = self.covariance + RATE**2 * elapsed * np.eye(2)
        self.covariance = np.asarray(np.linalg.inv(np.linalg.inv(predicted) + S), np.float64)
        self.state = np.clip(
            self.state - self.covariance @ (e + S @ (self.state - applied)), -MAX_CHANGE, MAX_CHANGE
        )  # fmt: skip
        self.correction = DepthCorrection.linear(*_significant(self.state, self.covariance).tolist())


def _at_rest(level: Level, T_world_camera: NDArray[np.float64]) -> bool:
    """Whether the camera is so near to the origin of the world that the map was seen in the same part of the image."""
    readings = level.depth[level.depth > 0]
    if len(readings) == 0:
        return False
    shift = float(np.linalg.norm(T_world_camera[:3, 3])) / float(median(readings))
    return se3.rotation_angle(T_world_camera) + shift < AT_REST


def _without_pose(
    tracker: Tracker,
    volume: TsdfVolume,
    level: Level,
    T_world_camera: NDArray[np.float64],
    weights: NDArray[np.float32],
    system: LinearSystem,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Information (2, 2) and gradient (2,) of offset and stretch, the pose eliminated, in inverse variances.

    The map holds distances along the rays of the camera at rest, so that a reading moved by dz changes its residual by
    -dz and J = z^2 (1, x). The cross terms are differences of the gradients of two linearisations. Intensities
    constrain only the pose: at rest they do not depend on the depth of a reading.
    """
    config, sensor, camera = tracker.config, tracker.sensor, level.camera
    geometric = tracker.linearize(volume, level, T_world_camera, weights, color_weight=0.0)
    cross = []
    for unit in ((STEP, 0.0), (0.0, STEP)):
        moved = Level(camera, DepthCorrection.linear(*unit).depth(level.depth, camera), level.intensity)
        cross.append(
            (tracker.linearize(volume, moved, T_world_camera, weights, color_weight=0.0).b - geometric.b) / STEP
        )
    r = geometric.residuals[0]
    valid = np.isfinite(geometric.residuals[1])
    x = np.broadcast_to((np.arange(camera.width) - camera.cx) / camera.fx, r.shape)
    J = (level.depth.astype(np.float64) ** 2)[..., None] * np.stack([np.ones_like(x), x], axis=-1)
    noise = np.minimum(sensor.sigma(1.0) / np.maximum(sensor.sigma(level.depth), 1e-6), 1)
    scale = noise if config.noise_weighting else np.ones_like(noise)
    robust = config.huber / np.maximum(np.abs(r * scale), config.huber)  # eq. 4.44
    J, r, w = J[valid], r[valid], (weights * scale**2 * robust)[valid]
    H_ss, b_s = (J * w[:, None]).T @ J, (J * w[:, None]).T @ r
    H_xs = np.stack(cross, axis=1)
    damped = system.H + 1e-6 * np.diag(np.diag(system.H)) + 1e-12 * np.trace(system.H) * np.eye(6)
    eliminated = np.linalg.solve(damped, np.column_stack([H_xs, system.b]))
    S = H_ss - H_xs.T @ eliminated[:, :2]
    values, vectors = np.linalg.eigh((S + S.T) / 2)
    S = (vectors * np.maximum(values, 0)) @ vectors.T  # differences of rounded numbers can be slightly negative
    variance = CORRELATED_READINGS * sensor.sigma(1.0) ** 2
    return S / variance, (b_s - H_xs.T @ eliminated[:, 2]) / variance


def _significant(state: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The state (2,), shrunk to 0 where it is insignificant."""
    chi_square = float(state @ np.linalg.solve(covariance, state))
    return state * max(0.0, 1 - SIGNIFICANT / max(chi_square, 1e-12))
