"""Uncertainty of a pose, and how it is shared between the distances and the intensities of the registration."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.frames.exposure import exposed
from dudmap.frames.observation import Level
from dudmap.frames.pyramid import Pyramid
from dudmap.kernels.parameters import NormalEquations, RegistrationParameters
from dudmap.kernels.residual import residual_weights
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.estimate import PoseEstimate
from dudmap.tracking.tracker import Tracker

INTERVAL = 10
"""Every so many tracked frames are compared."""
SAMPLES = 30
"""Number of comparisons from which the variance components are estimated, the latest ones."""
DEPTH_ERROR, COLOR_SHIFT = 0.005, 0.5
"""Assumed standard deviations of the smooth errors before anything is seen: relative error of the depth, and
displacement of the colours in pixels of an image 640 wide, as a careful calibration leaves them."""
PRIOR_SAMPLES = 1.0
"""Weight of the prior, comparisons."""
ITERATIONS = 5
"""Iterations of the variance components per comparison, each of which starts from the result of the last."""
COSINES = 4, 3
"""Number of cosines across and down whose sum is the smooth error of the depth."""
EDGE = 0.03
"""Neighbours further apart than this share of the depth do not lie on one surface."""
RANK = 1e-4
"""Smallest eigenvalue of a scaled information matrix that counts as constrained; smaller ones are raised by it."""


@dataclass(frozen=True, eq=False)
class TermBalance:
    """Uncertainty of the pose of a frame relative to the map, and what it rests on.

    Vectors are in camera axes: translation along x, y, z (m), rotation about x, y, z (rad).

    Attributes:
        sigma: (6,) standard deviation of the pose.
        color_share: (6,) how far the pose follows the intensities: 0 it rests on the distances, 1 on the intensities.
        disagreement: (6,) pose that the intensities alone ask for minus that of the distances alone.
        disagreement_ratio: Its squared Mahalanobis length over its expectation; well above 1 the two terms differ by
            more than the estimated errors of both explain.
        depth_error: Estimated standard deviation of the smooth relative error of the depth.
        color_shift: Estimated standard deviation of the displacement of the colours against the depth, pixels of an
            image 640 wide.
    """

    sigma: NDArray[np.float64]
    color_share: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    disagreement_ratio: float
    depth_error: float
    color_shift: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Poses that the two terms ask for alone, and their errors, camera axes.

    Attributes:
        disagreement: (6,) intensities minus distances.
        depth_covariance, color_covariance: (6, 6) of the two poses if the smooth errors have their prior size.
        noise: (6, 6) covariance of the disagreement by the independent errors of the pixels.
    """

    disagreement: NDArray[np.float64]
    depth_covariance: NDArray[np.float64]
    color_covariance: NDArray[np.float64]
    noise: NDArray[np.float64]


class BalanceEstimator:
    """Estimates what the poses of the two terms are worth from how far they differ.

    Distances and intensities come from the same pixels but fail in different ways. The independent noise of the pixels
    averages out (a fraction of a millimetre); what remains are errors that are smooth over the image: distortion of the
    depth, and colours that are displaced against it by calibration, shutter or delay. Each is a sum of few functions
    phi_k over the image with independent coefficients of a common variance, e = s sum_k a_k phi_k. With weights w_i and
    Jacobians J_i the pose of a term takes up

        xi = H^-1 G a,   H = sum w_i J_i J_i',   G = sum w_i J_i d_i phi_k,   hence   P = H^-1 G G' H^-1,

    with d_i the derivative of the residual by the error: n . ray for the depth, the image gradient for the colour. The
    disagreement of the two poses has the covariance s_d^2 P_d + s_c^2 P_c + N; since P_d and P_c have different shapes,
    a few disagreements reveal both s (variance components, Foerstner 1979).

    Args:
        sensor: Standard deviation of the time between colour and depth of a pixel.
    """

    def __init__(self, sensor: SensorConfig) -> None:
        self.sensor = sensor
        self._comparisons: deque[Comparison] = deque(maxlen=SAMPLES)
        self._frames = 0
        self._components = 1.0, 1.0

    def update(
        self,
        tracker: Tracker,
        volume: TsdfVolume,
        pyramid: Pyramid,
        estimate: PoseEstimate,
        velocity: NDArray[np.float64],
    ) -> TermBalance | None:
        """Compare the two terms at the pose of a frame that is not yet part of the map.

        Args:
            tracker: The registration.
            volume: The map that the frame was registered to.
            pyramid: Image pyramid of the frame.
            estimate: Pose and labels of the frame.
            velocity: (6,) twist per second, camera axes.

        Returns:
            None between the frames that are compared, and where one of the terms has no readings.
        """
        self._frames += 1
        if self._frames % INTERVAL:
            return None
        levels = [exposed(level, estimate.exposure) for level in (pyramid.coarse, pyramid.fine)]
        coarse, fine = levels
        T_world_camera = estimate.T_world_camera
        weights = estimate.static_weights(levels) or [np.ones_like(level.depth) for level in levels]
        volume.look_at(T_world_camera)
        distances = tracker.linearize(volume, fine, T_world_camera, weights[1], color_weight=0.0)
        both = tracker.linearize(volume, fine, T_world_camera, weights[1])
        R = np.kron(np.eye(2), T_world_camera[:3, :3].T)
        H_d, b_d = R @ distances.H @ R.T, R @ distances.b
        H, b = R @ both.H @ R.T, R @ both.b
        H_c, b_c = H - H_d, b - b_d
        if min(np.trace(H_d), np.trace(H_c)) <= 0:
            return None
        inverse_d, inverse_c = _inverse(H_d), _inverse(H_c)
        noise_d, noise_c = self._noise(distances, both, weights[1], tracker, fine.camera.width / volume.camera.width)
        noise_d, noise_c = noise_d * inverse_d, noise_c * inverse_c
        parameters = tracker.parameters(volume.band)
        P_d, P_c = smooth_covariances(coarse, weights[0], parameters, velocity, self.sensor.color_time_sigma)
        comparison = Comparison(inverse_d @ b_d - inverse_c @ b_c, P_d, P_c, noise_d + noise_c)
        self._comparisons.append(comparison)
        self._components = s_d, s_c = variance_components(list(self._comparisons), self._components)
        C_d, C_c = s_d * P_d + noise_d, s_c * P_c + noise_c
        K_c = _inverse(H) @ H_c
        K_d = np.eye(6) - K_c
        delta = comparison.disagreement
        return TermBalance(
            sigma=np.sqrt(np.diag(K_d @ C_d @ K_d.T + K_c @ C_c @ K_c.T)),
            color_share=np.clip(np.diag(K_c), 0, 1),
            disagreement=delta,
            disagreement_ratio=float(delta @ np.linalg.solve(C_d + C_c, delta)) / 6,
            depth_error=DEPTH_ERROR * float(np.sqrt(s_d)),
            color_shift=COLOR_SHIFT * float(np.sqrt(s_c)),
        )

    def _noise(
        self,
        distances: NormalEquations,
        both: NormalEquations,
        weights: NDArray[np.float32],
        tracker: Tracker,
        scale: float,
    ) -> tuple[float, float]:
        """Variances of a distance and of an intensity in the units of the two information matrices.

        The filter makes the depth noise of the pixels within its area 4 pi sigma^2 one; ``scale`` is the width of the
        image over that of the filtered one.
        """
        area = 4 * np.pi * (tracker.filter_px * scale) ** 2
        differences = both.residuals[1][weights > 0.5]
        differences = np.minimum(np.abs(differences[np.isfinite(differences)]), 2 * tracker.config.color_huber)
        color = float(np.mean(differences**2)) if len(differences) else 0.0
        chi_square = distances.chi_square / max(distances.weight, 1e-9)
        return max(area, 1.0) * chi_square, tracker.config.color_weight * color


def smooth_covariances(
    level: Level,
    weights: NDArray[np.float32],
    parameters: RegistrationParameters,
    velocity: NDArray[np.float64],
    time_sigma: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Covariances (6, 6) of the distance pose and of the intensity pose, camera axes, by smooth errors of prior size.

    Args:
        level: The image.
        weights: (h, w) static weights in [0, 1].
        parameters: Of the registration, whose weights apart from the robust ones, which depend on the residuals, are
            taken.
        velocity: (6,) twist of the camera per second, camera axes.
        time_sigma: Standard deviation of the time between colour and depth of a pixel, seconds.
    """
    inside, points, normals, gradient = _geometry(level, weights)
    z, camera = points[:, 2], level.camera
    rays = points / z[:, None]
    v, u = np.nonzero(inside)
    shares = residual_weights(level.depth, np.zeros((2, *level.depth.shape), np.float32), weights, parameters)
    of_distances, of_intensities = shares[:2, inside, None].astype(np.float64)
    # distances: residual n . p
    J = np.hstack([normals, np.cross(points, normals)])
    weighted = J * of_distances
    error = DEPTH_ERROR * z * np.einsum("ij,ij->i", normals, rays)
    across, down = np.pi * (u + 0.5) / camera.width, np.pi * (v + 0.5) / camera.height
    cosines = [_cosine(i, across) * _cosine(j, down) for i in range(COSINES[0]) for j in range(COSINES[1])]
    G = weighted.T @ (error[:, None] * np.stack(cosines, axis=1)) / np.sqrt(len(cosines))
    A = _inverse(weighted.T @ J) @ G
    # intensities: residual I(project(p))
    gx, gy = gradient.T
    lever = np.stack([gx * camera.fx / z, gy * camera.fy / z], axis=1)
    lever = np.column_stack([lever, -(lever * rays[:, :2]).sum(axis=1)])
    J = np.hstack([lever, np.cross(points, lever)])
    shift = COLOR_SHIFT * camera.width / 640
    x, y = 2 * (u + 0.5) / camera.width - 1, 2 * (v + 0.5) / camera.height - 1
    motion = -np.einsum("ij,ij->i", J, np.broadcast_to(velocity, J.shape)) * time_sigma
    one = np.ones(len(z))
    errors = [shift * g * field for field in (one, x, y) for g in (gx, gy)] + [motion, motion * y]
    weighted = J * of_intensities
    B = _inverse(weighted.T @ J) @ (weighted.T @ np.stack(errors, axis=1))
    return A @ A.T, B @ B.T


def variance_components(
    comparisons: list[Comparison], start: tuple[float, float] = (1.0, 1.0), iterations: int = ITERATIONS
) -> tuple[float, float]:
    """Factors of the variances of the smooth errors of depth and colour, in units of the prior.

    Iterates s <- s sum(q) / sum(r) for each component, with r = s tr(C^-1 P) its share of the redundancy and
    q = s d' C^-1 P C^-1 d its share of the weighted square of the disagreement d (Foerstner 1979); its fixed point is
    the maximum of the likelihood. The prior counts as PRIOR_SAMPLES disagreements that agree with it.

    Args:
        comparisons: The disagreements.
        start: Initial factors.
        iterations: Number of iterations.
    """
    delta = np.array([c.disagreement for c in comparisons])
    scale = 1 / np.sqrt(np.mean([np.diag(c.depth_covariance + c.color_covariance + c.noise) for c in comparisons], 0))
    outer = np.outer(scale, scale)
    P_d = np.array([c.depth_covariance for c in comparisons]) * outer
    P_c = np.array([c.color_covariance for c in comparisons]) * outer
    N = np.array([c.noise for c in comparisons]) * outer + RANK * np.eye(6)
    s_d, s_c = start
    for _ in range(iterations):
        inverse = np.linalg.inv(s_d * P_d + s_c * P_c + N)
        y = np.einsum("nij,nj->ni", inverse, delta * scale)
        ratios = []
        for s, P in ((s_d, P_d), (s_c, P_c)):
            q = s * np.einsum("ni,nij,nj->", y, P, y)
            r = s * np.einsum("nij,nji->", inverse, P)
            prior = PRIOR_SAMPLES * 3
            ratios.append((q + prior / s) / (r + prior))
        s_d, s_c = s_d * ratios[0], s_c * ratios[1]
    return s_d, s_c


def _geometry(
    level: Level, weights: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Static pixels on smooth surface (h, w), and there points, normals (n, 3) in camera axes and the intensity
    gradient (n, 2) per pixel."""
    z, camera = level.depth.astype(np.float64), level.camera
    v, u = np.mgrid[: z.shape[0], : z.shape[1]]
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    inside = np.zeros(z.shape, bool)
    inside[1:-1, 1:-1] = (z[1:-1, 1:-1] > 0) & (weights[1:-1, 1:-1] > 0.5)
    for axis in (0, 1):
        for side in (1, -1):
            beside = np.roll(z, side, axis)
            inside &= (beside > 0) & (np.abs(beside - z) < EDGE * z)
    across, down = (np.roll(points, -1, axis) - np.roll(points, 1, axis) for axis in (1, 0))
    normals = np.cross(across[inside], down[inside])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    intensity = level.intensity.astype(np.float64)
    slopes = [(np.roll(intensity, -1, axis) - np.roll(intensity, 1, axis))[inside] / 2 for axis in (1, 0)]
    return inside, points[inside], normals, np.stack(slopes, axis=1)


def _cosine(order: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cosine of unit mean square."""
    return np.cos(order * angle) * (np.sqrt(2) if order else 1.0)


def _inverse(H: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of an information matrix, scaled by its diagonal, with directions that it hardly constrains bounded."""
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    outer = np.outer(scale, scale)
    return np.linalg.inv(H * outer + RANK * np.eye(6)) * outer
