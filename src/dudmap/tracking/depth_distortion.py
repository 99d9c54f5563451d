"""Static distortion of the depth images of a camera, learnt against the map while the camera moves."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.frames.depth_correction import ORDER, DepthCorrection
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.kernels.median import median
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.tracker import MIN_READINGS, Tracker

CORRELATED_READINGS = 64.0
"""Neighbouring readings of a level 80 pixels wide whose errors are correlated and which together count as one: a tenth
of the width, the width of a band of equal disparity, squared."""
TERMS = [(i, order - i) for order in range(2, ORDER + 1) for i in range(order + 1)]
"""Exponents (i, j) of the terms x^i y^j. Without those below the second order: 1, x and y turn planes into planes, and
a rigid motion imitates them."""
HALF_WIDTH = 0.5
"""Image direction at which the prior holds: 27 degrees off the axis, the edge of the image of a Kinect."""
PRIOR_SIGMA = 5e-3
"""Standard deviation of each term at HALF_WIDTH before anything is known, 1/m: 1 % at 2 m (1 to 2 % was measured by
Teichman, Miller and Thrun 2013)."""
SIGNIFICANT = 3.0
"""Standard deviations below which a term is not applied at all."""
NEW_VIEW = 0.05
"""Displacement of the image (rotation in radians plus translation over median depth) after which a frame is used:
nearer frames repeat the errors of the last one."""
SLANTED = 0.3
"""Cosine of the angle of incidence below which a reading is not used."""
MAX_VIEWS = 48
"""Number of views over which the map averages, as ``volume.max_readings``."""
EDGE = 0.05
"""Depth step to a neighbouring pixel, as a share of the depth, across which no normal is computed."""


class DepthDistortion:
    """Kalman filter of the distortion ``1 / z_true = 1 / z + sum_k s_k phi_k(x, y)`` (idea: Teichman, Miller, Thrun,
    Unsupervised intrinsic calibration of depth sensors via SLAM, RSS 2013).

    A surface is seen in different parts of the image, where the distortion differs, so that readings and map disagree.
    The map itself is the average of distorted readings: a reading with terms phi lies off the map by

        r = (z^2 phi - mean_v[ z_v^2 phi_v ])' (a - s) + J_xi xi,

    where a is the correction that all readings of the run were given and the mean is over the views v that made the map
    there, remembered per block. It is given before the run and constant: a map made of readings corrected in
    different ways is bent. The equation is linear in s.
    The pose xi of each view is free, and only distances are used, so that a disagreement of colour and depth is not
    learnt as distortion. With the pose eliminated each view gives information S and gradient e, and

        P^-1 = P_before^-1 + S,   s = s_before - P (e + S s_before).

    Where a surface is seen only in one part of the image, both terms cancel and S is zero: a camera that never moves
    learns nothing. A view counts if the image moved by NEW_VIEW since the last one, and CORRELATED_READINGS neighbours
    count as one reading.

    Attributes:
        state: (K,) coefficients of TERMS, 1/m at HALF_WIDTH.
        covariance: (K, K).
        correction: The significant part of the state: each term is shrunk by max(0, 1 - (3 sigma / s)^2).
        views: Number of views used.
    """

    def __init__(self) -> None:
        count = len(TERMS)
        self.state, self.covariance = np.zeros(count), PRIOR_SIGMA**2 * np.eye(count)
        self.correction, self.views = DepthCorrection(), 0
        self._last_pose: NDArray[np.float64] | None = None
        self._forget_map(None)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (K,) of the state, 1/m."""
        return np.sqrt(np.diag(self.covariance))

    def update(
        self,
        tracker: Tracker,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        applied: DepthCorrection,
    ) -> None:
        """Learn from a frame whose pose is accepted, if the camera moved since the last one used.

        Args:
            tracker: Its configuration of the distance residual is used.
            volume: The map; its window must cover the view.
            level: A coarse level of the image.
            T_world_camera: (4, 4).
            weights: (h, w) float32 static weights in [0, 1].
            applied: The correction of this image and of those in the map.
        """
        readings = level.depth[level.depth > 0]
        if len(readings) < MIN_READINGS or not self._is_new_view(T_world_camera, float(median(readings))):
            return
        if volume.map_id != self._map_id:
            self._forget_map(volume.map_id)
        self._last_pose, self.views = T_world_camera, self.views + 1
        distance = volume.sample(level.depth, level.intensity, level.camera, T_world_camera).distance
        points, normals, cosine = _surface(level)
        sensor, config = tracker.sensor, tracker.config
        scale = np.minimum(sensor.sigma(1.0) / np.maximum(sensor.sigma(level.depth), 1e-6), 1)
        valid = (cosine > SLANTED) & np.isfinite(distance) & (weights > 0.5)
        r, z, scale = distance[valid].astype(np.float64), points[valid][:, 2], scale[valid]
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        gradient, lever = normals[valid] @ R.T / cosine[valid][:, None], points[valid] @ R.T
        J_pose = np.hstack([gradient, np.cross(lever, gradient)])
        J = (z**2)[:, None] * _terms(points[valid][:, :2] / z[:, None])
        a = _coefficients(applied)
        cells, J_map, views = self._map_share(lever + t, J, volume.block_size)
        robust = config.huber / np.maximum(np.abs(r * scale), config.huber)  # eq. 4.44
        w = scale**2 * robust * (views[cells] > 0)
        if np.count_nonzero(w) < MIN_READINGS:
            return
        difference = np.hstack([J_pose, J - J_map[cells]])
        residual = r - difference[:, 6:] @ a
        H = (difference * w[:, None]).T @ difference / (CORRELATED_READINGS * sensor.sigma(1.0) ** 2)
        b = (difference * w[:, None]).T @ residual / (CORRELATED_READINGS * sensor.sigma(1.0) ** 2)
        pose = H[:6, :6] + 1e-6 * np.diag(np.diag(H[:6, :6]))
        eliminated = np.linalg.solve(pose, np.column_stack([H[:6, 6:], b[:6]]))
        S, e = H[6:, 6:] - H[6:, :6] @ eliminated[:, :-1], b[6:] - H[6:, :6] @ eliminated[:, -1]
        P = np.linalg.inv(np.linalg.inv(self.covariance) + (S + S.T) / 2)
        self.covariance = np.asarray((P + P.T) / 2, np.float64)
        self.state = self.state - self.covariance @ (e + S @ self.state)
        self._apply()

    def largest(self, camera: Camera) -> float:
        """Largest significant error of the inverse depth in the image of a camera, 1/m; times z the relative error."""
        return float(np.abs(self.correction.change(camera)).max())

    def save(self, path: Path) -> None:
        """Write what is known as NumPy archive: ``terms`` (K, 2), ``state`` (K,), ``covariance`` (K, K), ``views``.

        Raises:
            OSError: The file cannot be written.
        """
        np.savez(path, terms=TERMS, state=self.state, covariance=self.covariance, views=self.views)

    @classmethod
    def load(cls, path: Path) -> "DepthDistortion":
        """What ``save`` wrote; learning goes on from there.

        Raises:
            DatasetError: The file is missing or not such a file.
        """
        found = cls()
        try:
            with np.load(path, allow_pickle=False) as data:
                if not np.array_equal(data["terms"], TERMS):
                    raise DatasetError(f"{path} holds a depth model of other terms than this version")
                state, covariance = (np.asarray(data[key], np.float64) for key in ("state", "covariance"))
                views = int(data["views"])
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise DatasetError(f"{path} is not a readable depth model: {error}") from error
        if state.shape != found.state.shape or covariance.shape != found.covariance.shape:
            raise DatasetError(f"{path} is not a readable depth model: its arrays have other shapes than its terms")
        if not (np.isfinite(state).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
            raise DatasetError(f"{path} is not a readable depth model: its covariance is not positive definite")
        found.state, found.covariance, found.views = state, covariance, views
        found._apply()
        return found

    def _apply(self) -> None:
        """Update the correction."""
        ratio = SIGNIFICANT * self.sigma / np.maximum(np.abs(self.state), 1e-12)
        coefficients = np.zeros((ORDER + 1, ORDER + 1))
        for (i, j), value in zip(TERMS, self.state * np.maximum(0, 1 - ratio**2), strict=True):
            coefficients[i, j] = value / HALF_WIDTH ** (i + j)
        self.correction = DepthCorrection(coefficients)

    def _is_new_view(self, T_world_camera: NDArray[np.float64], depth: float) -> bool:
        """Whether the image moved by NEW_VIEW since the last view, for a surface at a depth in metres."""
        if self._last_pose is None:
            return True
        motion = se3.inverse(self._last_pose) @ T_world_camera
        return se3.rotation_angle(motion) + float(np.linalg.norm(motion[:3, 3])) / depth > NEW_VIEW

    def _forget_map(self, map_id: int | None) -> None:
        self._map_id, self._cells = map_id, {}
        self._sums = np.zeros((1024, len(TERMS) + 1))  # means of z^2 phi, number of views

    def _map_share(
        self, points: NDArray[np.float64], J: NDArray[np.float64], size: float
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """What made the map so far at points (n, 3), to which this view is added.

        Returns:
            Per point the index of its block among those of the view; per block the mean of ``J`` (m, K) and the number
            of views (m,), both before this view.
        """
        keys = np.floor(points / size).astype(np.int64) + (1 << 20)
        unique, cells = np.unique((keys[:, 0] << 42) | (keys[:, 1] << 21) | keys[:, 2], return_inverse=True)
        cells = cells.reshape(-1)
        rows = np.array([self._cells.setdefault(key, len(self._cells)) for key in unique.tolist()])
        if len(self._cells) > len(self._sums):
            self._sums = np.vstack([self._sums, np.zeros((len(self._cells), self._sums.shape[1]))])
        before = self._sums[rows]
        order = np.argsort(cells, kind="stable")
        starts = np.searchsorted(cells[order], np.arange(len(unique)))
        means = np.add.reduceat(J[order], starts, axis=0) / np.bincount(cells)[:, None]
        share = 1 / (np.minimum(before[:, -1:], MAX_VIEWS) + 1)
        self._sums[rows, :-1] += share * (means - before[:, :-1])
        self._sums[rows, -1] += 1
        return cells, before[:, :-1], before[:, -1]


def _terms(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terms (n, K) at image directions (n, 2), of unit size at HALF_WIDTH."""
    x, y = (xy / HALF_WIDTH).T
    return np.stack([x**i * y**j for i, j in TERMS], axis=1)


def _coefficients(correction: DepthCorrection) -> NDArray[np.float64]:
    """Coefficients (K,) of TERMS of a correction, 1/m at HALF_WIDTH."""
    return np.array([correction.coefficients[i, j] * HALF_WIDTH ** (i + j) for i, j in TERMS])


def _surface(level: Level) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points (h, w, 3) in camera axes, their normals (h, w, 3) towards the camera, and |normal . ray| of rays (x, y, 1)
    (h, w), which is 0 where no normal is known."""
    depth = level.depth
    points = np.asarray(level.camera.backproject(depth), np.float64)
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normals = np.cross(down, across)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    smooth = np.zeros(depth.shape, dtype=bool)
    z, neighbours = depth[1:-1, 1:-1], (depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1])
    smooth[1:-1, 1:-1] = (z > 0) & np.all([np.abs(other - z) < EDGE * z for other in neighbours], axis=0)
    cosine = np.abs(np.sum(normals * points, axis=-1)) / np.maximum(depth, 1e-6)
    return points, normals, np.where(smooth, cosine, 0.0)
