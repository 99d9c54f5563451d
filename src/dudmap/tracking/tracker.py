"""Camera pose from the signed distances and intensities of the map (thesis section 4.4, algorithm 2)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, TrackerConfig
from dudmap.frames.exposure import chained, exposed, fit_exposure
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.kernels.median import median
from dudmap.kernels.parameters import RegistrationParameters
from dudmap.mapping.volume import TsdfVolume

SHORT = 4
"""Only steps shorter than this many times that end a level by how little they gain."""
EXPOSURE_NOISE = 0.01
"""Changes of gain and offset that together stay below this are noise of the fit, not of the camera."""


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Normal equations of one linearisation: ``H step = -b``.

    Attributes:
        H: (6, 6) float64, twist (v, omega) about the camera's centre in world axes.
        b: (6,) float64, gradient of the cost.
        cost: Robust cost; readings off the map pay a constant, so that poses can be compared.
        num_inliers: Readings on the map.
        readings: Sum of the static weights of all readings.
        weight: Sum of the static weights of the readings on the map.
        chi_square: Robustly weighted sum of squared distances, m^2; at one metre if they are weighted by the noise.
        residuals: (2, h, w) float32, distance (m) and intensity difference, NaN off the map.
    """

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    cost: float
    num_inliers: int
    readings: float
    weight: float
    chi_square: float
    residuals: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Outcome of one registration.

    Attributes:
        T_world_camera: (4, 4).
        exposure: Gain and offset that make the frame's intensities those of the map.
        converged: Whether all checks passed.
        reason: The failed check, empty if none.
        inlier_share: Share of the static readings that fall on the map.
        residual: Root mean square distance residual, scaled by sigma(1 m) / sigma(z): metres at one metre depth.
        condition: Ratio of the extreme eigenvalues of the scaled H; near 0 = a direction is not constrained.
        iterations: Linearisations over all levels.
        color_residual: Median absolute intensity difference (0..1) to the map at the static readings, a change of
            exposure apart; NaN where the image shows nothing.
        settled: Whether the last level ended with a step too small to matter, not for want of iterations.
    """

    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    converged: bool
    reason: str
    inlier_share: float
    residual: float
    condition: float
    iterations: int
    color_residual: float = 0.0
    settled: bool = True


class Tracker:
    """Direct registration of a frame against the map by Levenberg-Marquardt, coarse to fine."""

    def __init__(self, config: TrackerConfig, sensor: SensorConfig) -> None:
        self.config = config
        self.sensor = sensor

    def align(
        self,
        volume: TsdfVolume,
        levels: list[Level],
        T_init: NDArray[np.float64],
        static_weights: list[NDArray[np.float32]] | None = None,
        first_level: int = 0,
        exposure: tuple[float, float] = (1.0, 0.0),
    ) -> TrackingResult:
        """Pose that minimises the distances and intensity differences of a frame to the map (eq. 4.32).

        Args:
            volume: The map.
            levels: Image pyramid, coarse to fine.
            T_init: (4, 4) first guess of T_world_camera.
            static_weights: Per level (h, w) float32 in [0, 1]; None counts every pixel.
            first_level: Number of the first of these levels in the configuration.
            exposure: Gain and offset; fitted anew if the first of these levels is the coarsest.
        """
        volume.look_at(T_init)
        T, iterations, system, settled = T_init, 0, None, True
        lit, weights = levels[-1], np.ones_like(levels[-1].depth)
        for index, level in enumerate(levels):
            limit = self.config.iterations[first_level + index]
            if limit == 0:
                continue
            weights = np.ones_like(level.depth) if static_weights is None else static_weights[index]
            lit = exposed(level, exposure)
            system = self.linearize(volume, lit, T, weights)
            iterations += 1
            if self.config.exposure and index == 0 and first_level == 0:
                change = fit_exposure(lit.intensity, system.residuals[1], weights)
                if abs(change[0] - 1) + abs(change[1]) > EXPOSURE_NOISE:
                    exposure = chained(exposure, change)
                    lit = exposed(level, exposure)
                    system = self.linearize(volume, lit, T, weights)
                    iterations += 1
            finest = first_level + index == len(self.config.iterations) - 1
            stop = self.config.stop if finest else self.config.stop_coarse
            T, system, used, settled = self._optimize(volume, lit, T, weights, system, limit, stop)
            iterations += used
        if system is None:  # every level is left out: judge the first guess
            system = self.linearize(volume, lit, T, weights)
        T = T.copy()
        T[:3, :3] = se3.nearest_rotation(T[:3, :3])
        return replace(self._judge(T, exposure, system, lit, weights, iterations), settled=settled)

    def _optimize(
        self,
        volume: TsdfVolume,
        level: Level,
        T: NDArray[np.float64],
        weights: NDArray[np.float32],
        system: LinearSystem,
        limit: int,
        stop: float,
    ) -> tuple[NDArray[np.float64], LinearSystem, int, bool]:
        """Levenberg-Marquardt on one level (Marquardt 1963: damping scaled by the diagonal, accepted on real gain)."""
        damping, used = self.config.damping, 0
        for _ in range(limit):
            diagonal = np.diag(system.H)
            if not diagonal.max() > 0:
                break
            damped = system.H + np.diag(damping * diagonal + 1e-9 * diagonal.max())
            step = np.asarray(-np.linalg.solve(damped, system.b), dtype=np.float64)
            T_trial, length = se3.retract(T, step), np.linalg.norm(step)
            if length < stop:  # known to be small before it is tried: take it and be done
                return T_trial, system, used, True
            trial = self.linearize(volume, level, T_trial, weights)
            used += 1
            gain = abs(trial.cost - system.cost)
            settled = length < SHORT * stop and gain < self.config.stop_gain * system.cost
            if trial.cost < system.cost:
                T, system, damping = T_trial, trial, max(damping / 5, 1e-6)
            else:
                damping *= 5
            if settled:
                return T, system, used, True
        return T, system, used, False

    def linearize(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        color_weight: float | None = None,
    ) -> LinearSystem:
        """Normal equations (eq. 4.43 with the weights of 4.46) of a level at a pose; the colour's weight from the
        configuration, unless another is given."""
        config, sensor = self.config, self.sensor
        color_weight = config.color_weight if color_weight is None else color_weight
        parameters = RegistrationParameters(
            band=volume.band,
            huber=config.huber,
            tukey=config.tukey if config.robust == "tukey" else 0.0,
            color_weight=color_weight,
            color_huber=config.color_huber,
            sigma_at_one_metre=sensor.sigma(1.0),
            noise_weighting=float(config.noise_weighting),
        )
        equations = volume.backend.linearize(
            volume.grid, level.depth, level.intensity, weights, level.camera.intrinsics,
            volume.window.T_grid_camera(T_world_camera), parameters,
        )  # fmt: skip
        return LinearSystem(*equations)

    def _judge(
        self,
        T: NDArray[np.float64],
        exposure: tuple[float, float],
        system: LinearSystem,
        level: Level,
        weights: NDArray[np.float32],
        iterations: int,
    ) -> TrackingResult:
        """Name the first check that a registration fails: readings on the map, residual level, degenerate H.

        The figures mean the same in every configuration: distances are judged in units of the sensor's noise also where
        the registration does not weigh by it, and intensities apart from a change of exposure also where the
        registration does not compensate it.
        """
        config = self.config
        share = system.weight / max(system.readings, 1.0)
        chi_square = system.chi_square if config.noise_weighting else self._chi_square(system, level, weights)
        residual = float(np.sqrt(chi_square / max(system.weight, 1e-9)))
        scale = 1 / np.sqrt(np.maximum(np.diag(system.H), 1e-30))
        eigenvalues = np.linalg.eigvalsh(system.H * np.outer(scale, scale))
        condition = float(max(eigenvalues[0], 0) / max(eigenvalues[-1], 1e-30))
        if system.weight < 100:
            reason = f"only {system.weight:.0f} static readings fall on the map"
        elif share < config.min_inliers:
            reason = f"only {share:.0%} of the static readings fall on the map"
        elif residual > config.max_residual * (self.sensor.sigma_base + self.sensor.sigma_scale):
            reason = f"readings lie {1000 * residual:.1f} mm off the map"
        elif condition < config.min_condition:
            reason = "the view does not constrain all directions of motion"
        else:
            reason = ""
        differences = system.residuals[1]
        if not config.exposure:
            gain, offset = fit_exposure(level.intensity, differences, weights)
            differences = differences + np.float32(1 - gain) * level.intensity - np.float32(offset)
        difference = differences[::4, ::4][weights[::4, ::4] > 0.5]
        difference = np.abs(difference[np.isfinite(difference)])
        color_residual = float(median(difference)) if len(difference) else 0.0
        return TrackingResult(T, exposure, not reason, reason, share, residual, condition, iterations, color_residual)

    def _chi_square(self, system: LinearSystem, level: Level, weights: NDArray[np.float32]) -> float:
        """Robustly weighted sum of squared distances scaled by sigma(1 m) / sigma(z), m^2: what the linearisation
        computes with ``noise_weighting``."""
        config, sensor = self.config, self.sensor
        valid = np.isfinite(system.residuals[1])
        sigma = sensor.sigma(level.depth[valid])
        scale = np.minimum(sensor.sigma(1.0) / np.maximum(sigma, 1e-6), 1)
        residual = np.abs(system.residuals[0][valid]) * scale
        if config.robust == "tukey":
            robust = (1 - np.minimum(residual / config.tukey, 1) ** 2) ** 2  # eq. 4.45
        else:
            robust = config.huber / np.maximum(residual, config.huber)  # eq. 4.44
        return float(np.sum(weights[valid] * robust * residual**2, dtype=np.float64))
