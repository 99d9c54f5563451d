"""Refine the relative pose of two maps by the surface of each in the distances of the other.

Points are aligned to a signed distance field (Canelhas, Stoyanov and Lilienthal, SDF Tracker, 2013), intensities as in
the tracker (thesis eq. 4.32).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import TrackerConfig
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.tracker import COLOR_HUBER
from dudmap.fleet.map_samples import IN_BAND, OBSERVED, SurfacePoints, sample_map, transformed

MAX_ITERATIONS = 40
STOP = 1e-5
"""Final twist (m, rad)."""
MAD, LEAST_SHADE, LEAST_NOISE = 1.4826, 0.005, 0.05
"""Standard deviation over median absolute value; smallest ones of intensity (0..1) and distance (voxels), also the last
step's."""
COLOR_SHARE = 0.1
"""Factor of the standardised intensities of visits, correlated over some hundred points."""
SCALE = 0.5
"""Residual of Geman-McClure weight a quarter, voxels."""
SHRINKING = 0.5
"""Factor per step of the residual ``SCALE``, from the truncation distance."""
MIN_POINTS = 500
"""Fewest points on the other surface."""
MIN_STIFFNESS = 0.02
"""Smallest over largest eigenvalue of a determined pose, angles scaled by extent; a plain wall has 0."""


@dataclass(frozen=True, eq=False)
class SdfAlignment:
    """Result of a refinement.

    Attributes:
        T_a_b: (4, 4) world of b to world of a.
        converged: Whether the last step was short, with enough points on the other surface.
        residual: Weighted root mean square distance, metres.
        stiffness: See ``MIN_STIFFNESS``.
        center: (3,) middle of the common surface, world of a, metres.
    """

    T_a_b: NDArray[np.float64]
    converged: bool
    residual: float
    stiffness: float
    center: NDArray[np.float64]


def align_maps(
    a: TsdfVolume,
    b: TsdfVolume,
    of_a: SurfacePoints,
    of_b: SurfacePoints,
    T_a_b: NDArray[np.float64],
    changed: bool = False,
) -> SdfAlignment:
    """Refine ``T_a_b`` (4, 4), in error by less than the truncation, by Gauss-Newton steps on distances and
    intensities. Distances have Geman-McClure weights ``(1 + (r / c)^2)^-2`` with shrinking ``c`` (graduated
    non-convexity, Yang et al. 2020); intensities the tracker's, if ``changed`` also Geman-McClure's."""
    tracker, exposure, stiffness, residual, converged = TrackerConfig(), (1.0, 0.0), 0.0, np.inf, False
    center, at_points, scale, spread, noise = np.zeros(3), np.inf, a.truncation, 1.0, a.truncation
    for _ in range(MAX_ITERATIONS):
        in_a = _rows(a, np.eye(4), of_b, transformed(T_a_b, of_b.points), exposure, of_a=False)
        in_b = _rows(b, se3.inverse(T_a_b), of_a, of_a.points, exposure, of_a=True)
        rows = _Rows(*(np.concatenate(both) for both in zip(in_a, in_b, strict=True)))
        if len(rows.distance) < MIN_POINTS:
            return SdfAlignment(T_a_b, False, residual, 0.0, center)
        scale = max(SCALE * a.voxel_size, SHRINKING * scale)
        weights = 1 / np.square(1 + np.square(rows.distance / scale))
        H, g = _normal_equations(rows.J_distance, rows.distance, weights)
        lit = tracker.color_weight * np.minimum(1.0, COLOR_HUBER / np.maximum(np.abs(rows.shade), 1e-12))
        if changed and len(rows.shade):
            close = np.abs(rows.distance[np.abs(rows.distance) <= 2 * scale])
            spread = min(spread, max(MAD * float(np.median(np.abs(rows.shade))), LEAST_SHADE))
            noise = min(noise, max(MAD * float(np.median(close)), LEAST_NOISE * a.voxel_size) if len(close) else noise)
            lit = np.square(COLOR_SHARE * noise / spread / (1 + np.square(rows.shade / (3 * spread))))
        H_c, g_c = _normal_equations(rows.J_shade, rows.shade, lit)
        center = rows.points.mean(axis=0)
        stiffness = _stiffness(H + H_c, center, rows.points)
        residual = float(np.sqrt(np.average(np.square(rows.distance), weights=weights)))
        H += H_c + 1e-9 * np.trace(H) * np.eye(6)
        step = -np.linalg.solve(H, g + g_c)
        T_a_b = se3.exp(step) @ T_a_b
        T_a_b[:3, :3] = se3.nearest_rotation(T_a_b[:3, :3])
        exposure = _exposure(rows.shade_a, rows.shade_b)
        at_points = np.linalg.norm(step[:3] + np.cross(step[3:], center))
        if scale <= SCALE * a.voxel_size and at_points < STOP and np.linalg.norm(step[3:]) < STOP:
            converged = True
            break
    converged |= changed and at_points < LEAST_NOISE * a.voxel_size
    return SdfAlignment(T_a_b, bool(converged), residual, stiffness, center)


@dataclass(frozen=True, eq=False)
class _Rows:
    points: NDArray[np.float64]
    distance: NDArray[np.float64]
    J_distance: NDArray[np.float64]
    shade: NDArray[np.float64]
    J_shade: NDArray[np.float64]
    shade_a: NDArray[np.float64]
    shade_b: NDArray[np.float64]


def _rows(
    other: TsdfVolume,
    T_other_a: NDArray[np.float64],
    surface: SurfacePoints,
    points: NDArray[np.float64],
    exposure: tuple[float, float],
    *,
    of_a: bool,
) -> tuple[NDArray[np.float64], ...]:
    samples, (gain, offset) = sample_map(other, transformed(T_other_a, points)), exposure
    near = (samples.state == OBSERVED) & (np.abs(samples.sdf) < IN_BAND * other.truncation)
    lit = near & (samples.intensity > 0) & (surface.intensity > 0)
    sdf, there, own = (
        x.astype(np.float64) for x in (samples.sdf[near], samples.intensity[lit], surface.intensity[lit])
    )
    R_other_a = T_other_a[:3, :3]
    J = _twist_rows(points[near], samples.sdf_gradient[near].astype(np.float64) @ R_other_a)
    J_shade = _twist_rows(points[lit], samples.intensity_gradient[lit].astype(np.float64) @ R_other_a)
    if of_a:
        return points[near], -sdf, J, own - gain * there - offset, gain * J_shade, own, there
    return points[near], sdf, J, there - gain * own - offset, J_shade, there, own


def _twist_rows(points: NDArray[np.float64], gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hstack([gradients, np.cross(points, gradients)])


def _normal_equations(
    J: NDArray[np.float64], residual: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    weighted = J * weights[:, None]
    return weighted.T @ J, weighted.T @ residual


def _stiffness(H: NDArray[np.float64], center: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    extent = max(float(np.sqrt(np.mean(np.sum(np.square(points - center), axis=1)))), 1e-6)
    shift = np.eye(6)
    shift[:3, 3:] = se3.hat(center)  # converts a rotation about the centre to one about the origin and a translation
    scale = np.diag([1.0, 1.0, 1.0, 1 / extent, 1 / extent, 1 / extent])
    values = np.linalg.eigvalsh(scale @ shift.T @ H @ shift @ scale)
    return float(max(values[0], 0.0) / max(values[-1], 1e-300))


def _exposure(shade_a: NDArray[np.float64], shade_b: NDArray[np.float64]) -> tuple[float, float]:
    if len(shade_a) < MIN_POINTS:
        return 1.0, 0.0
    gain = float(np.clip(shade_a.std() / max(shade_b.std(), 1e-6), 0.5, 2.0))
    return gain, float(shade_a.mean() - gain * shade_b.mean())
