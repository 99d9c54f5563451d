"""Labelling of dynamic pixels by residual densities, known free space and segments (thesis section 4.6)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig, SensorConfig
from dudmap.core.backends.cpu.evidence import (
    BINS,
    CENTERS,
    NoiseParameters,
    RegionRules,
    edge_tolerance,
    moving_pixels,
    noise_limit,
    static_sigma,
    weigh_readings,
)
from dudmap.core.backends.cpu.segment_motion import STARTED_SHARE, moving_segments, stand_still
from dudmap.core.backends.parameters import single
from dudmap.core.backends.threads import submit
from dudmap.core.dynamics.masks import RULES, SEAM, Labels, Mixture, opened_mask
from dudmap.core.dynamics.segments import Segmentation, pixel_scale, scaled_length, segment
from dudmap.core.dynamics.temporal_memory import BackgroundModel, TemporalMemory, dynamic_segments
from dudmap.core.frames.observation import Level, Pyramid, saturated, unsaturated
from dudmap.core.map.volume import FREE, SURFACE, MapSample, TsdfVolume
from dudmap.core.state import Remembered, Stateful

MAX_GAP = 1.5
"""Largest depth difference of measurements of one point, in noise thresholds of distances."""
SMALLEST_MOTION, MOTION_SIGMAS = 0.03, 3.0
"""Smallest distance to the map of a dynamic measurement (theta, thesis eq. 4.57): reference depths, standard
deviations; the larger applies."""
MAP_ROUGHNESS = 0.4
"""Standard deviation of the map surface, voxels."""
DEPTH_EDGE_SIGMAS, DEPTH_EDGE_SLOPE = 3, 0.02
"""Largest depth step within a surface: standard deviations, plus a share of the depth per pixel at REFERENCE_WIDTH (69
degrees of inclination at a focal length of 131 pixels)."""
MAX_LOG_ODDS = 6
"""Log odds static : dynamic of a certain pixel: 0.25 % errors."""
COUPLING = 4
"""Largest log odds that eight neighbours add, so that they cannot overrule a certain pixel. The sum of both limits is
the range of the mean field's tanh."""
SWEEPS = 4
"""Mean-field sweeps."""
MAPPED_SHARE = 0.3
"""Smallest share of a segment's moving pixels on the map that decides about the rest."""
MIN_REGION = 0.0008
"""Smallest moving region, share of the image: 15 pixels at 160x120."""
NONE = np.empty((0, 0), np.float32)
"""No further evidence."""


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A frame compared with the map; ``sigma`` (h, w): standard deviation of a static distance, metres."""

    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    sample: MapSample
    sigma: NDArray[np.float32]
    noise: NoiseParameters

    @property
    def free(self) -> NDArray[np.bool_]:
        return self.sample.occupancy == FREE


class DynamicDetector(Stateful):
    """Labels the pixels of registered frames as static or dynamic.

    Args:
        config: Thresholds and times.
        sensor: Noise of the depth measurements.

    Attributes:
        memory: Remembered frames.
        background: Static background behind pixels without depth.
    """

    memory: Remembered[TemporalMemory]
    background: Remembered[BackgroundModel]

    def __init__(self, config: DynamicsConfig, sensor: SensorConfig) -> None:
        self.config = config
        self.sensor = sensor
        self._least_sigma = SMALLEST_MOTION * sensor.reference_depth / MOTION_SIGMAS
        self.memory = TemporalMemory(config, sensor.reference_depth)
        self.background = BackgroundModel(config)

    def segment(self, levels: Callable[[], Pyramid], voxel_size: float, *, now: bool) -> Callable[[], Segmentation]:
        """Function that returns the surface segments of an image.

        Args:
            levels: Returns the pyramid of the image.
            voxel_size: Metres.
            now: Start the computation in another thread, if dynamics are enabled.
        """

        def compute() -> Segmentation:
            level = levels().labelled
            return segment(level, depth_tolerance(distance_sigma(self.sensor, level.depth, voxel_size), level))

        return cache(submit(compute) if now and self.config.enabled else compute)

    def start(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> None:
        """Begin with the first frame of a map, at a pose (4, 4)."""
        self.memory.start(timestamp)
        self.memory.update(timestamp, level, T_world_camera, np.zeros(level.depth.shape, dtype=bool), None)

    def import_from(self, other: "DynamicDetector", Ts_world_camera: dict[float, NDArray[np.float64]]) -> None:
        """See ``TemporalMemory.import_from``."""
        self.memory.import_from(other.memory, Ts_world_camera)

    def detect(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        timestamp: float,
        segmentation: Callable[[], Segmentation],
        moving: NDArray[np.bool_] | None = None,
        exposure: tuple[float, float] = (1.0, 0.0),
        added: NDArray[np.float32] = NONE,
    ) -> Labels:
        """Labels of a registered frame.

        Args:
            volume: The map.
            level: The image, label resolution.
            T_world_camera: (4, 4).
            timestamp: Seconds.
            segmentation: See ``segment``.
            moving: (h, w) bool, moving pixels by comparison of images; None without comparison.
            exposure: Gain and offset from the image's intensities to the map's.
            added: (h, w) float32, log odds moving : static of further cues; size 0 for none.
        """
        depth = level.depth
        noise = noise_parameters(self.sensor, level, volume.voxel_size)
        sample = _sample(volume, level, T_world_camera, exposure)
        sigma, tolerance, probability = (np.empty(depth.shape, np.float32) for _ in range(3))
        histogram = np.zeros(BINS, np.int64)
        unknown, (prior, static, moves) = weigh_readings(
            depth, sample.distance, sample.occupancy, noise, RULES, CENTERS, sigma, tolerance, histogram
        )
        frame = _Comparison(timestamp, level, T_world_camera, exposure, sample, sigma, noise)
        mixture = Mixture((1 - prior, prior), (static, moves))
        offset, slope = mixture.coefficients
        dynamic, seeds = (np.empty(depth.shape, np.bool_) for _ in range(2))
        rules = RegionRules(
            MAX_LOG_ODDS, COUPLING, SWEEPS, scaled_length(SEAM, level), MIN_REGION * depth.size, STARTED_SHARE
        )  # fmt: skip
        moving_pixels(
            depth, sample.distance, sample.occupancy, sigma, tolerance, self._evidence(frame, unknown, added), offset,
            np.float32(slope), noise, rules, dynamic, seeds, probability,
        )  # fmt: skip
        dynamic, segments = self._segments(frame, dynamic, seeds, segmentation())
        if moving is not None and moving.any():
            dynamic = dynamic | (moving & ~self._stands_on_map(frame, moving, segmentation()))
        # pixels outside moving regions fit badly for another reason, which the robust weights handle
        probability = np.where(dynamic, np.float32(0), np.float32(1))
        hidden = self.background.hidden(timestamp, unsaturated(level, exposure), T_world_camera)
        return Labels(probability, dynamic, mixture, histogram, sample, segments, hidden)

    def carried(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        segmentation: Callable[[], Segmentation],
        exposure: tuple[float, float],
    ) -> Labels:
        """Labels carried from the last frame, for the arguments of ``detect``.

        Dynamic are the points of its dynamic segments, connected points in free space, and the segments of both.
        """
        import cv2

        segments, carried = segmentation(), self.memory.last_dynamic(level, T_world_camera)
        sample = _sample(volume, level, T_world_camera, exposure)
        free = opened_mask(sample.occupancy == FREE, level)
        count, numbers = cv2.connectedComponents((carried | free).view(np.uint8), connectivity=4)
        components = np.asarray(numbers, np.int32)
        moving = np.bincount(components[carried], minlength=count) > 0
        moving[0] = False
        dynamic = moving[components]
        dynamic |= dynamic_segments(segments, dynamic)
        probability = np.where(dynamic, np.float32(0), np.float32(1))
        return Labels(probability, dynamic, None, np.zeros(BINS, np.int64), sample, segments)

    def update(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
        labels: Labels,
    ) -> None:
        """Remember a tracked frame (pose (4, 4), seconds); ``exposure``: gain and offset to the map's intensities."""
        self.memory.update(timestamp, level, T_world_camera, labels.dynamic, labels.segmentation)
        self.background.update(timestamp, unsaturated(level, exposure), T_world_camera, labels.dynamic)

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Move the state with a correction (4, 4) of the world."""
        self.memory.apply_correction(T_new_old)
        self.background.apply_correction(T_new_old)

    def reset(self) -> None:
        """Forget the remembered frames."""
        self.memory.reset()
        self.background.reset()

    def _evidence(self, frame: _Comparison, unknown: float, added: NDArray[np.float32]) -> NDArray[np.float32]:
        """Log odds moving : static of space that single frames have seen to be free, and of further cues.

        ``unknown``: share of the measurements in unknown space.
        """
        if not (older := self.memory.free_space_frames(frame.timestamp, unknown)):
            return added
        gap = np.float32(MAX_GAP) * noise_threshold(self.sensor, frame.sigma)
        free = self.memory.seen_free(frame.level, frame.T_world_camera, gap, older)
        seen = np.float32(2 * MAX_LOG_ODDS) * free  # overrules the map
        return seen if added.size == 0 else seen + added

    def _segments(
        self,
        frame: _Comparison,
        dynamic: NDArray[np.bool_],
        seeds: NDArray[np.bool_],
        segmentation: Segmentation,
    ) -> tuple[NDArray[np.bool_], Segmentation]:
        """Dynamic pixels decided by segment (``moving_segments``) without settled segments, and the segments."""
        level, T_world_camera, sigma = frame.level, frame.T_world_camera, frame.sigma
        before = self.memory.last_dynamic(level, T_world_camera)
        least, (gain, offset) = self._least_sigma, frame.exposure
        labels, count = moving_segments(
            segmentation.with_noise(sigma, least), before, seeds, frame.sample, level.intensity,
            np.float32(1 - gain), np.float32(offset), dynamic,
        )  # fmt: skip
        if count > segmentation.count:
            segmentation = replace(segmentation, labels=labels, count=count)
        settled = self.memory.settled(frame.timestamp, level, T_world_camera, segmentation, sigma, dynamic, least)
        return dynamic & ~settled, segmentation

    def _stands_on_map(
        self, frame: _Comparison, moving: NDArray[np.bool_], segmentation: Segmentation
    ) -> NDArray[np.bool_]:
        """Moving pixels whose segment is static in the map (``stand_still``), because corners are mismatched on
        silhouettes, in blur and on repetitive patterns. The part on the map decides for the segment if at least
        MAPPED_SHARE."""
        sample, (gain, offset) = frame.sample, frame.exposure
        distance = np.where(sample.occupancy == SURFACE, sample.distance, np.float32(np.nan))
        difference = sample.difference + (np.float32(1 - gain) * frame.level.intensity - np.float32(offset))
        difference[np.isnan(difference)] = 0  # a surface without a colour
        segments = segmentation.with_noise(frame.sigma, self._least_sigma)
        mapped = moving & (sample.occupancy == SURFACE)
        known, asked = (np.bincount(segments.labels[mask], minlength=segments.count + 1) for mask in (mapped, moving))
        still = (np.arange(segments.count + 1) > 0) & (known > MAPPED_SHARE * asked)
        stand_still(segments, mapped, distance, difference, still)
        return moving & still[segments.labels]


def _sample(
    volume: TsdfVolume, level: Level, T_world_camera: NDArray[np.float64], exposure: tuple[float, float]
) -> MapSample:
    """The map at the pixels; saturated pixels have no intensity difference."""
    sample = volume.sample(level.depth, level.intensity, level.camera, T_world_camera)
    if (dark := saturated(level, exposure, sample.difference)) is not None:
        sample.difference[dark] = np.nan
    return sample


def noise_parameters(sensor: SensorConfig, level: Level, voxel_size: float) -> NoiseParameters:
    """Measurement noise of an image, for a voxel size in metres."""
    parameters = NoiseParameters(
        sensor.sigma_base, sensor.sigma_scale, (MAP_ROUGHNESS * voxel_size) ** 2, DEPTH_EDGE_SIGMAS,
        DEPTH_EDGE_SLOPE / pixel_scale(level), SMALLEST_MOTION * sensor.reference_depth, MOTION_SIGMAS,
    )  # fmt: skip
    return single(parameters)


def distance_sigma(sensor: SensorConfig, depth: NDArray[np.float32], voxel_size: float) -> NDArray[np.float32]:
    """Standard deviation (h, w) of the distance of a static point, metres: measurement and map."""
    map_variance = (MAP_ROUGHNESS * voxel_size) ** 2
    return np.asarray(static_sigma.py_func(sensor.sigma(depth), map_variance), np.float32)


def depth_tolerance(sigma: NDArray[np.float32], level: Level) -> NDArray[np.float32]:
    """Largest depth step (h, w) within a surface, metres; ``sigma`` (h, w): standard deviation of the depth."""
    slope = np.float32(DEPTH_EDGE_SLOPE / pixel_scale(level))
    return np.asarray(edge_tolerance.py_func(sigma, level.depth, DEPTH_EDGE_SIGMAS, slope), np.float32)


def noise_threshold(sensor: SensorConfig, sigma: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distance (h, w) to the map below which nothing is motion (theta in eq. 4.57), metres."""
    return noise_limit.py_func(sigma, np.float32(SMALLEST_MOTION * sensor.reference_depth), np.float32(MOTION_SIGMAS))
