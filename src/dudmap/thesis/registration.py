"""Pose estimation (thesis section 4.4, algorithm 2): Levenberg-Marquardt on distances and intensities."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.map.volume import FREE, TsdfVolume
from dudmap.thesis_config import ThesisConfig

Array = NDArray[np.float64]

FACTOR = 10.0
"""Factor of the damping with steps (Marquardt 1963)."""
SMALLEST_DAMPING = 1e-6
"""Damping below which it does not shrink."""
MIN_PIXELS = 50
"""Fewest pixels with a distance for a pose."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Terms of the joint error (eq. 4.40) of all pixels.

    Attributes:
        psi: (h, w) distance to the surface, metres; NaN off the map.
        e_c: (h, w) intensity error V_I - I in [0, 1]; NaN without intensity in the map.
    """

    psi: NDArray[np.float32]
    e_c: NDArray[np.float32]


def residuals(volume: TsdfVolume, level: Level, T: Array, d_max: float) -> Residuals:
    """Distances (eq. 4.29) and intensity errors (eq. 4.31) at the pose T (4, 4), camera to world.

    Points in known free space get algorithm 1's initial distance d_max. Reading: never seen space is unknown; otherwise
    all new surfaces would be dynamic.
    """
    volume.look_at(T)
    sample = volume.sample(level.depth, level.intensity, level.camera, T)
    psi = np.where(sample.occupancy == FREE, np.float32(d_max), sample.distance)
    return Residuals(psi, sample.difference)


def gradient(volume: TsdfVolume, level: Level, T: Array) -> NDArray[np.float32]:
    """Gradient of psi (h, w, 3) at the points of an image, world axes, by central differences (eq. 4.33)."""
    h, out = volume.voxel_size, []
    for axis in range(3):
        step = np.zeros((4, 4))
        step[axis, 3] = h
        ahead, behind = (volume.sample(level.depth, level.intensity, level.camera, T + s * step) for s in (1, -1))
        out.append((ahead.distance - behind.distance) / np.float32(2 * h))
    return np.stack(out, axis=-1)


def sobel(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Image gradients (h, w) along x and y, per pixel, by the Sobel-Feldman operator (eq. 4.36, 4.37).

    Reading: eq. 4.37 repeats the matrix of eq. 4.36; its product is the transposed one. Both are divided by 8, to be
    derivatives.
    """
    x, y = (cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0))
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def chain(gradient: Array, X: Array) -> Array:
    """Derivative (n, 6) by xi = (omega, upsilon) of a function with gradient (n, 3) at X (n, 3):

    (X x gradient, gradient) (eq. 4.34, 4.35). Reading: the matrix of eq. 4.35 holds the coordinates of the point, not
    of the twist.
    """
    (x, y, z), (a, b, c) = X.T, gradient.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)


def robust_weight(psi: Array, estimator: str, rho: float) -> Array:
    """Weight rho(psi) of Huber (eq. 4.44) or Tukey (eq. 4.45)."""
    size = np.abs(psi)
    if estimator == "huber":
        return np.where(size <= rho, 1.0, rho / np.maximum(size, rho))
    return np.where(size <= rho, (1 - (psi / rho) ** 2) ** 2, 0.0)


def exponential(xi: Array) -> Array:
    """Rigid motion (4, 4) of a twist xi = (omega, upsilon) (eq. 4.30)."""
    return se3.exp(np.concatenate([xi[3:], xi[:3]]))


class Registration:
    """Pose that minimises the joint error of image and map (algorithm 2)."""

    def __init__(self, config: ThesisConfig) -> None:
        self.config = config

    def align(
        self, volume: TsdfVolume, levels: list[Level], T: Array, labels: NDArray[np.bool_] | None = None
    ) -> tuple[Array, Residuals]:
        """Pose (4, 4), coarse to fine, and the finest residuals there.

        Args:
            T: Initial pose (4, 4), camera to world.
            labels: (h, w) bool, dynamic pixels of the finest level, not counted; None for none.
        """
        for level in levels[::-1]:
            T = self._align_level(volume, level, T, None if labels is None else _resized(labels, level))
        return T, residuals(volume, levels[0], T, self.config.d_max)

    def _align_level(self, volume: TsdfVolume, level: Level, T: Array, labels: NDArray[np.bool_] | None) -> Array:
        """Pose after the iterations of one level.

        Reading: algorithm 2 iterates "while (pose difference) > 0.001 or iteration # < 5", which would not end. As in
        the text after it, both conditions must hold. A step that does not reduce the error is rejected.
        """
        found = residuals(volume, level, T, self.config.d_max)
        damping, error = self.config.lambda_0, self.error(found, labels)
        H, g = self.normal_equations(volume, level, T, found, labels)
        for _ in range(self.config.iterations):
            if not np.isfinite(error):
                break
            delta = self.step(H, g, damping)
            trial = exponential(delta) @ T
            found = residuals(volume, level, trial, self.config.d_max)
            trial_error = self.error(found, labels)
            if trial_error < error:
                T, error, damping = trial, trial_error, max(damping / FACTOR, SMALLEST_DAMPING)
                if np.linalg.norm(delta) > self.config.stop:
                    H, g = self.normal_equations(volume, level, T, found, labels)
            else:
                damping *= FACTOR
            if np.linalg.norm(delta) <= self.config.stop:
                break
        return T

    def step(self, H: Array, g: Array, damping: float) -> Array:
        """Increment delta (6,) of the damped normal equations, eq. 4.41 or 4.42.

        Reading: eq. 4.42 lacks the minus sign of eq. 4.41. Its damping lambda J^T J shortens the step by 1 / (1 +
        lambda).
        """
        A = H + damping * (np.eye(6) if self.config.damping == "identity" else H)
        return np.asarray(np.linalg.lstsq(A, -g, rcond=None)[0], np.float64)

    def error(self, found: Residuals, labels: NDArray[np.bool_] | None) -> float:
        """Joint error (eq. 4.40, weights of 4.46) per pixel, because the pixels change with the pose. Infinity below
        ``MIN_PIXELS``."""
        used = _used(found, labels)
        psi, e_c = found.psi[used].astype(np.float64), np.nan_to_num(found.e_c[used].astype(np.float64))
        if len(psi) < MIN_PIXELS:
            return np.inf
        rho = robust_weight(psi, self.config.estimator, self.config.rho)
        return float(rho @ (psi**2 + self.config.upsilon * e_c**2)) / len(psi)

    def normal_equations(
        self, volume: TsdfVolume, level: Level, T: Array, found: Residuals, labels: NDArray[np.bool_] | None
    ) -> tuple[Array, Array]:
        """J^T J (6, 6) and J^T f (6,) of both terms (eq. 4.43, 4.46, 4.47) from the residuals ``found`` at T.

        Readings: eq. 4.46 and 4.47 have rho(psi) before the sums; it weighs each pixel. Eq. 4.38 differentiates a sum
        of squares; J_c is the derivative of V_I - I, by the image gradient, equal after registration (eq. 4.36, 4.37
        differentiate images).
        """
        eta = gradient(volume, level, T)
        used = _used(found, labels) & np.isfinite(eta).all(axis=-1)
        p, eta = level.camera.backproject(level.depth)[used].astype(np.float64), eta[used].astype(np.float64)
        if len(p) < MIN_PIXELS:
            return np.zeros((6, 6)), np.zeros(6)
        psi, e_c = found.psi[used].astype(np.float64), found.e_c[used].astype(np.float64)
        X = p @ T[:3, :3].T + T[:3, 3]
        J_p, J_c = chain(eta, X), chain(self._color_gradient(level, p, used) @ T[:3, :3].T, X)
        has_color = np.isfinite(e_c)
        J_c[~has_color], e_c[~has_color] = 0, 0
        rho = robust_weight(psi, self.config.estimator, self.config.rho)[:, None]
        upsilon = self.config.upsilon
        return (
            J_p.T @ (rho * J_p) + upsilon * J_c.T @ (rho * J_c),
            (rho * J_p).T @ psi + upsilon * (rho * J_c).T @ e_c,
        )

    @staticmethod
    def _color_gradient(level: Level, p: Array, used: NDArray[np.bool_]) -> Array:
        I_x, I_y = (image[used].astype(np.float64) for image in sobel(level.intensity))
        (fx, fy), Z = level.camera.focal, p[:, 2]
        return np.stack([I_x * fx / Z, I_y * fy / Z, -(I_x * fx * p[:, 0] + I_y * fy * p[:, 1]) / Z**2], axis=-1)


def _used(found: Residuals, labels: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    known = np.isfinite(found.psi)
    return known if labels is None else known & ~labels


def _resized(labels: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    height, width = level.depth.shape
    share = cv2.resize(labels.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(share) > 0
