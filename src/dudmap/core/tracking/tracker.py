"""Direct registration of a frame to distances and intensities of the map (thesis section 4.4, algorithm 2)."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import PreprocessConfig, SensorConfig, TrackerConfig
from dudmap.core.backends.cpu.exposure import LARGE_GAIN, fit_exposure
from dudmap.core.backends.descent import Descent, DescentRules
from dudmap.core.backends.median import median
from dudmap.core.backends.parameters import (
    LevelImage,
    NormalEquations,
    RegistrationParameters,
    TruncationBand,
)
from dudmap.core.formulas.residual import residual_weights
from dudmap.core.frames.observation import Level, chained, exposed
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.checks import REGISTRATION, RULES, Limits, RegistrationRules, judged
from dudmap.core.tracking.observability import COMPLETE, MIN_AGREEMENT, GradientAgreement, Observability, gradient_noise
from dudmap.core.verdict import ACCEPTED, Verdict

FINEST_DAMPING = 1e-4
"""Largest initial damping of the finest level, relative to the diagonal of J^T J. More damping shortens steps along
weak directions until they seem converged."""
NO_STEP = DescentRules(np.eye(6), damping=0.0, max_steps=0, stop=0.0, stop_gain=0.0)
"""Evaluates the normal equations at the initial pose."""
COLOR_HUBER = 0.07
"""Huber threshold of the intensity residual, 0..1."""
STOP, STOP_COARSE = 5e-4, 1e-3
"""Twist updates (m, rad) below which the finest and the coarser levels have converged (thesis algorithm 2: 1e-3). They
shrink with scenes smaller than a room."""
STOP_GAIN = 3e-3
"""Relative change of the cost below which a short step ends a coarse level."""
EXPOSURE_NOISE = 0.01
"""Largest summed change of gain and offset that is noise and not applied."""
NEAREST_STEPS = 3
"""Steps to a nearby minimum."""
BLOCKS_ACROSS = 20
"""Blocks across the image whose summed residuals give their variance: 16 of 320 pixels, several widths of filter and
voxel. The covariance of rendered sequences is then correct within a factor of 4."""
UNKNOWN = np.full((6, 6), np.nan)
"""Covariance of a rejected registration."""
MEDIAN_STRIDE = 4
"""Step between sampled pixels, across and down."""


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Result of one registration.

    Attributes:
        T_world_camera: (4, 4).
        exposure: Gain and offset from the frame's intensities to the map's.
        verdict: Outcomes of the checks of the registration.
        inlier_share: Share of the static measurements on the map.
        residual: Root mean square of the distance residuals scaled by sigma(1 m) / sigma(z), metres at 1 m depth.
        condition: Smallest over largest eigenvalue of the scaled H; near 0 a direction of motion is unconstrained.
        iterations: Linearisations over all levels.
        color_residual: Median absolute intensity difference (0..1) at the static measurements, after the best gain and
            offset; NaN for a textureless image.
        converged: Whether the last level ended before its iteration limit.
        unobservable: (k, 6) twists, camera axes, that the view does not determine; the initial pose is kept along them.
        readings: Weighted number of static measurements on the map.
        covariance: (6, 6) of the pose error, a twist (v, omega) about the camera's centre in world axes, m and rad; 0
            along unobservable directions. NaN unless accepted.
    """

    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    verdict: Verdict
    inlier_share: float
    residual: float
    condition: float
    iterations: int
    color_residual: float = 0.0
    converged: bool = True
    unobservable: NDArray[np.float64] = field(default_factory=lambda: COMPLETE.unobservable)
    readings: float = np.inf
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))

    def covariance_with(self, drift: float) -> NDArray[np.float64]:
        """Covariance (6, 6) with the standard deviation ``drift`` (m, rad) along the unobservable directions."""
        basis, _ = np.linalg.qr(np.kron(np.eye(2), self.T_world_camera[:3, :3]) @ self.unobservable.T)
        return self.covariance + drift**2 * basis @ basis.T

    @property
    def accepted(self) -> bool:
        """Whether all checks of the registration passed."""
        return self.verdict.accepted

    @property
    def figures(self) -> dict[str, float]:
        """Metrics of ``checks.REGISTRATION`` and ``checks.RELATIVE``. The condition counts only if no direction or
        every direction is unobservable."""
        missing = len(self.unobservable)
        return {
            "readings": self.readings,
            "overlap": self.inlier_share,
            "residual_mm": 1000 * self.residual,
            "condition": self.condition if missing == 0 else np.nan if missing < 6 else 0.0,
            "color_residual": self.color_residual,
        }


@dataclass(frozen=True, eq=False)
class Minimum:
    """End of a registration; further attributes as in ``TrackingResult``.

    Attributes:
        equations: Normal equations at the pose.
        level: Finest image, in the exposure of the map, with its ``weights`` (h, w).
        seen: Directions that the view determines.
    """

    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    equations: NormalEquations
    level: Level
    weights: NDArray[np.float32]
    iterations: int
    converged: bool
    seen: Observability
    parameters: RegistrationParameters


class Tracker:
    """Coarse-to-fine Levenberg-Marquardt registration of a frame to the map.

    Args:
        config: Residual weights, iterations, limits.
        sensor: Noise of the depth measurements.
        filter_px: Spatial standard deviation of the depth filter, pixels.
        rules: Damping and limits.
    """

    def __init__(
        self,
        config: TrackerConfig,
        sensor: SensorConfig,
        filter_px: float = PreprocessConfig().smoothing_px,
        rules: RegistrationRules = RULES,
    ) -> None:
        self.config = config
        self.sensor = sensor
        self.filter_px = filter_px
        self.rules = rules
        self._sigma = sensor.reference_sigma

    def align(
        self,
        volume: TsdfVolume,
        levels: list[Level],
        T_init: NDArray[np.float64],
        static_weights: list[NDArray[np.float32]] | None = None,
        first_level: int = 0,
        exposure: tuple[float, float] = (1.0, 0.0),
        color_weight: float | None = None,
    ) -> TrackingResult:
        """Pose of the frame and its checks; arguments as for ``minimize``."""
        found = self.minimize(volume, levels, T_init, static_weights, first_level, exposure, color_weight)
        T = found.T_world_camera.copy()
        T[:3, :3] = se3.nearest_rotation(T[:3, :3])
        return self._judge(found, T)

    def minimize(
        self,
        volume: TsdfVolume,
        levels: list[Level],
        T_init: NDArray[np.float64],
        static_weights: list[NDArray[np.float32]] | None = None,
        first_level: int = 0,
        exposure: tuple[float, float] = (1.0, 0.0),
        color_weight: float | None = None,
        *,
        relit: bool = True,
    ) -> Minimum:
        """Minimum of the distances and intensity differences of a frame to the map (eq. 4.32).

        Args:
            volume: The map.
            levels: Image pyramid, coarse to fine.
            T_init: (4, 4) initial T_world_camera.
            static_weights: Per level (h, w) float32 in [0, 1]; None = 1.
            first_level: Index of the first given level in the configuration.
            exposure: Initial gain and offset; fitted if ``first_level`` is 0.
            color_weight: Weight of the intensity term; None = configured.
            relit: Whether the light may differ from the map's. If not, a large gain is not applied, because it comes
                from an image of another surface.
        """
        volume.look_at(T_init)
        T, iterations, system, converged, seen = T_init, 0, None, True, None
        lit, weights = levels[-1], None
        limits, parameters = self.config.iterations[first_level:], self.parameters(volume.band, color_weight)
        for index, (level, limit) in enumerate(zip(levels, limits, strict=False)):
            if limit == 0:
                continue
            weights = np.ones(level.depth.shape, np.float32) if static_weights is None else static_weights[index]
            lit, system = exposed(level, exposure), None
            if self.config.exposure and index == 0 and first_level == 0:
                system = self._descend(volume, lit, T, weights, None, NO_STEP, parameters).equations
                change = fit_exposure(lit.intensity, system.residuals[1], weights, lit.ceiling)
                iterations += 1
                applied = relit or 1 / LARGE_GAIN < change[0] < LARGE_GAIN
                if applied and abs(change[0] - 1) + abs(change[1]) > EXPOSURE_NOISE:
                    exposure = chained(exposure, change)
                    lit, system = exposed(level, exposure), None
            rules = self._rules(limit, finest=index == len(limits) - 1)
            found = self._descend(volume, lit, T, weights, system, rules, parameters)
            if seen is None or not seen.is_complete:  # finer levels determine all directions of the coarsest level
                seen = self._observability(volume, lit, found.T_world_camera, weights, found.equations, parameters)
                if not seen.is_complete:  # noise determined its steps
                    iterations += found.iterations
                    system = self._descend(volume, lit, T, weights, None, NO_STEP, parameters).equations
                    seen = self._observability(volume, lit, T, weights, system, parameters)
                    rules = rules._replace(basis=np.ascontiguousarray(seen.observable))
                    found = self._descend(volume, lit, T, weights, system, rules, parameters)
            T, system, converged = found.T_world_camera, found.equations, found.converged
            iterations += found.iterations
        if system is None or weights is None:  # all levels are skipped: the initial pose is judged
            weights = np.ones(lit.depth.shape, np.float32)
            system = self._descend(volume, lit, T, weights, None, NO_STEP, parameters).equations
        return Minimum(T, exposure, system, lit, weights, iterations, converged, seen or COMPLETE, parameters)

    def judge(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        exposure: tuple[float, float] | None = None,
    ) -> TrackingResult:
        """Result at a fixed pose (4, 4); the exposure is fitted unless it is given."""
        volume.look_at(T_world_camera)
        parameters, fitted = self.parameters(volume.band), exposure is None and self.config.exposure
        curve = exposure or (1.0, 0.0)
        lit = exposed(level, curve)
        system = self._descend(volume, lit, T_world_camera, weights, None, NO_STEP, parameters).equations
        if fitted:
            curve = fit_exposure(lit.intensity, system.residuals[1], weights)
            lit = exposed(level, curve)
            system = self._descend(volume, lit, T_world_camera, weights, None, NO_STEP, parameters).equations
        found = Minimum(T_world_camera, curve, system, lit, weights, 1 + fitted, True, COMPLETE, parameters)
        return self._judge(found, T_world_camera)

    def nearest(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Minimum (4, 4) next to a pose, and distances (h, w) of the measurements to the map there, metres, NaN off the
        map.

        Takes at most NEAREST_STEPS steps. The window of the map must cover the view. ``weights``: (h, w) float32 static
        weights in [0, 1]; None = 1.
        """
        weights = np.ones(level.depth.shape, np.float32) if weights is None else weights
        rules, parameters = self._rules(NEAREST_STEPS, finest=True), self.parameters(volume.band)
        found = self._descend(volume, level, T_world_camera, weights, None, rules, parameters)
        return found.T_world_camera, found.equations.residuals[0]

    def _observability(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        system: NormalEquations,
        parameters: RegistrationParameters,
    ) -> Observability:
        """Directions that a level determines; all if too few measurements are on the map."""
        least, R = self.rules.min_information, T_world_camera[:3, :3]
        if least == 0:
            return COMPLETE
        noise = gradient_noise(
            level, system.residuals, weights, R, volume.voxel_size, volume.camera.width, self.filter_px,
            parameters, system.H, least,
        )  # fmt: skip
        if noise is None:
            return COMPLETE
        distances = self.linearize(volume, level, T_world_camera, weights, color_weight=0.0)
        seen = noise.observability(distances.H, system.H, R, least)
        if seen.is_complete:
            return COMPLETE
        agreement = GradientAgreement(level, system.residuals, weights, R, parameters)
        step, shown = volume.voxel_size, []
        for twist in seen.unobservable @ np.kron(np.eye(2), R).T:
            forth, back = (
                self._descend(volume, level, T, weights, None, NO_STEP, parameters).equations.residuals
                for T in (se3.retract(T_world_camera, way * twist) for way in (step, -step))
            )
            shown.append(agreement.along(twist, forth, back, step) >= MIN_AGREEMENT)
        return seen.with_shown(np.array(shown), R)

    def _descend(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        system: NormalEquations | None,
        rules: DescentRules,
        parameters: RegistrationParameters,
    ) -> Descent:
        image = LevelImage(level.depth, level.intensity, weights, level.camera.intrinsics)
        darkest, brightest = level.shown
        parameters = parameters._replace(darkest=darkest, brightest=brightest)
        return volume.backend.register(volume.grid, image, T_world_camera, system, rules, parameters)

    def _rules(self, limit: int, *, finest: bool) -> DescentRules:
        basis, damping, unit = COMPLETE.observable, self.rules.damping, min(self.sensor.reference_depth, 1.0)
        if finest:
            return DescentRules(basis, min(damping, FINEST_DAMPING), limit, STOP * unit, stop_gain=0.0)
        return DescentRules(basis, damping, limit, STOP_COARSE * unit, STOP_GAIN)

    def linearize(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        weights: NDArray[np.float32],
        color_weight: float | None = None,
    ) -> NormalEquations:
        """Normal equations (eq. 4.43, weights of 4.46) of a level at a pose (4, 4).

        The window of the map must cover the view. ``weights``: (h, w) float32 static weights in [0, 1].
        ``color_weight``: None = configured.
        """
        parameters = self.parameters(volume.band, color_weight)
        return self._descend(volume, level, T_world_camera, weights, None, NO_STEP, parameters).equations

    def parameters(self, band: TruncationBand, color_weight: float | None = None) -> RegistrationParameters:
        """Cost parameters in a map with this band; ``color_weight``: None = configured."""
        config = self.config
        return RegistrationParameters(
            band=band,
            huber=config.huber,
            color_weight=config.color_weight if color_weight is None else color_weight,
            color_huber=COLOR_HUBER,
            sigma_at_reference=self._sigma,
        )

    def _judge(self, found: Minimum, T_world_camera: NDArray[np.float64]) -> TrackingResult:
        """Checked result. Intensities are judged after the best gain and offset, applied or not."""
        config, system, level, weights = self.config, found.equations, found.level, found.weights
        share = system.weight / max(system.readings, 1.0)
        residual = math.sqrt(system.chi_square / max(system.weight, 1e-9))
        scale = 1 / np.sqrt(np.maximum(system.H.diagonal(), 1e-30))
        eigenvalues = np.linalg.eigvalsh(system.H * (scale[:, None] * scale))
        condition = float(max(eigenvalues[0], 0) / max(eigenvalues[-1], 1e-30))
        differences = system.residuals[1]
        if not config.exposure:
            gain, offset = fit_exposure(level.intensity, differences, weights)
            differences = differences + np.float32(1 - gain) * level.intensity - np.float32(offset)
        difference = differences[::MEDIAN_STRIDE, ::MEDIAN_STRIDE][weights[::MEDIAN_STRIDE, ::MEDIAN_STRIDE] > 0.5]
        difference = np.abs(difference[np.isfinite(difference)])
        if np.isfinite(level.shown[1]):  # saturated pixels have no difference
            difference = difference[difference > 0]
        color_residual = float(median(difference)) if len(difference) else 0.0
        result = TrackingResult(
            T_world_camera, found.exposure, ACCEPTED, share, residual, condition, found.iterations,
            color_residual, found.converged, found.seen.unobservable, system.weight,
        )  # fmt: skip
        verdict = judged(REGISTRATION, result.figures, Limits(config, self.sensor, self.rules))
        return replace(result, verdict=verdict, covariance=self._covariance(found) if verdict.accepted else UNKNOWN)

    def _covariance(self, found: Minimum) -> NDArray[np.float64]:
        """s^2 H^-1 along the observable directions.

        s^2 is the mean over both terms of (sum of weighted residuals)^2 over blocks, per measurement. Sums over blocks
        include the correlation between neighbours.
        """
        import cv2

        level, residuals, basis = found.level, found.equations.residuals, found.seen.observable
        weights = residual_weights(level.depth, residuals, found.weights, found.parameters)[:2]
        size = max(1, level.camera.width // BLOCKS_ACROSS)
        rows, columns = level.camera.height // size, level.camera.width // size
        scaled = (np.sqrt(weights) * np.stack([residuals[0], residuals[1]]))[
            :, : rows * size, : columns * size
        ].reshape(-1, columns * size)
        cv2.patchNaNs(scaled, 0.0)
        sums = size**2 * cv2.resize(scaled, (columns, 2 * rows), interpolation=cv2.INTER_AREA)
        variance = float(np.sum(np.square(sums)) / max(np.count_nonzero(weights), 1))
        return variance * basis @ np.linalg.inv(basis.T @ found.equations.H @ basis) @ basis.T
