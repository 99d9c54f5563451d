"""Labelling of dynamic pixels: mixture of residual densities, known free space, segments (thesis section 4.6)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig, SensorConfig
from dudmap.core.backends.cpu import evidence, labeling
from dudmap.core.backends.cpu.evidence import (
    EDGES,
    EvidenceParameters,
    NoiseParameters,
    ReadingNoise,
    edge_tolerance,
    noise_limit,
    static_sigma,
)
from dudmap.core.backends.threads import submit
from dudmap.core.dynamics.background_model import BackgroundModel
from dudmap.core.dynamics.label_scale import pixel_scale
from dudmap.core.dynamics.masks import Labels, elliptical_kernel, opened_mask
from dudmap.core.dynamics.mixture import Mixture, fit_mixture
from dudmap.core.dynamics.segments import (
    Segmentation,
    classify_segments,
    evidence_of,
    segment,
    split_mixed_segments,
)
from dudmap.core.dynamics.temporal_memory import TemporalMemory
from dudmap.core.frames.exposure import exposed
from dudmap.core.frames.observation import Level
from dudmap.core.map.volume import FREE, MapSample, TsdfVolume

MAX_GAP = 1.5
"""Largest depth difference of two readings of one point, in units of the distance below which nothing is motion."""
MAP_ROUGHNESS = 0.4
"""Standard deviation of the map's surface, voxels."""
DEPTH_EDGE_SIGMAS, DEPTH_EDGE_SLOPE = 3, 0.02
"""Largest depth step to a neighbour of the same surface: standard deviations of a reading, plus a share of the depth
per pixel at REFERENCE_WIDTH (a surface inclined by 69 degrees, with a focal length of 131 pixels)."""
MAX_LOG_ODDS = 6
"""Log odds static : dynamic of a pixel that is certain: an error probability of 0.25 %."""
COUPLING = 4
"""Log odds that the eight neighbours together can add to those of a pixel: less than certainty, so that they cannot
outvote it; the sum of both is the range of the mean field's hyperbolic tangent."""
SWEEPS = 4
"""Sweeps of the mean field over the image."""
MIN_REGION = 0.0008
"""Smallest region that moves, as a share of the image: 15 pixels of an image of 160x120."""
SEEDED_SHARE = 0.25
"""Share of a grown region that must be seeds for it to move."""
STARTED_SHARE = 0.1
"""Share of a segment that must be seeds for its pixels in unknown space to move."""
EROSION, DILATION, FLOOD_STEP = 15 / 640, 10 / 640, 0.007
"""Radii of the threshold rule's structuring elements, as shares of the image width, and the largest depth step to a
neighbouring pixel in its flood, as a share of the depth, in an image 640 pixels wide (Palazzolo et al. 2019, code)."""


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A frame compared with the map.

    Attributes:
        timestamp: Seconds.
        level: The image.
        T_world_camera: (4, 4).
        exposure: Gain and offset that make the image's intensities those of the map.
        sample: The map at the points of the image.
        noise: Of the readings.
    """

    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    sample: MapSample
    noise: ReadingNoise

    @property
    def free(self) -> NDArray[np.bool_]:
        """(h, w) bool, pixels in space the map knows to be free."""
        return self.sample.occupancy == FREE


class DynamicDetector:
    """Labels the pixels of registered frames as static or dynamic.

    Args:
        config: Method and thresholds.
        sensor: Noise of the depth readings.

    Attributes:
        memory: Remembered frames.
        background: The static background behind pixels without a reading.
    """

    def __init__(self, config: DynamicsConfig, sensor: SensorConfig) -> None:
        self.config = config
        self.sensor = sensor
        self.memory = TemporalMemory(config)
        self.background = BackgroundModel(config)

    def segment(self, level: Level, voxel_size: float) -> Callable[[], Segmentation]:
        """Begin to segment the surface an image shows; needs no map.

        Args:
            level: The image, at the resolution of the labels.
            voxel_size: Edge of the map's voxels, metres.

        Returns:
            A function that waits for the segmentation. It is computed in another thread, or, where the configuration
            does not need it, when the function is first called.
        """

        def compute() -> Segmentation:
            return segment(level, depth_tolerance(distance_sigma(self.sensor, level.depth, voxel_size), level))

        config = self.config
        needed = config.method == "em" and ((config.regions and config.pieces) or config.start_seconds > 0)
        return submit(compute) if needed else cache(compute)

    def start(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> None:
        """Begin with the first frame of a map, of which no pixel is known to move.

        Args:
            timestamp: Seconds.
            level: The image.
            T_world_camera: (4, 4).
        """
        self.memory.start(timestamp)
        self.memory.update(timestamp, level, T_world_camera, np.zeros(level.depth.shape, dtype=bool), None)

    def import_from(self, other: "DynamicDetector", Ts_world_camera: dict[float, NDArray[np.float64]]) -> None:
        """Import the remembered frames of a first pass over the same recording; see ``TemporalMemory.import_from``."""
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
    ) -> Labels:
        """Labels of a frame that has been registered to a map.

        Args:
            volume: The map.
            level: The image, at the resolution of the labels.
            T_world_camera: (4, 4) pose of the registration.
            timestamp: Seconds.
            segmentation: Waits for the segments of the image, as ``segment`` returns it.
            moving: (h, w) bool, pixels that two consecutive images show to move; None where they were not compared.
            exposure: Gain and offset that make the image's intensities those of the map.
        """
        sample = volume.sample(level.depth, level.intensity, level.camera, T_world_camera)
        noise = evidence.reading_noise(level.depth, self._noise_parameters(level, volume.voxel_size))
        frame = _Comparison(timestamp, level, T_world_camera, exposure, sample, noise)
        histogram, unknown = evidence.residual_counts(sample, level.depth, noise.sigma)
        if self.config.method == "threshold":
            dynamic = self._threshold_and_flood(frame, volume.truncation)
            return Labels(np.where(dynamic, np.float32(0), np.float32(1)), dynamic, None, histogram, sample)
        mixture = fit_mixture(histogram, EDGES)
        log_odds = self._log_odds(frame, mixture, unknown)
        probability = labeling.mean_field(log_odds, level.depth, noise.tolerance, COUPLING, SWEEPS)
        dynamic = (probability < 0.5) & (level.depth > 0)
        segments = None
        if self.config.regions:
            seeds = opened_mask(dynamic, level) | (dynamic & frame.free)
            least = MIN_REGION * seeds.size
            dynamic = evidence.moving_regions(seeds, log_odds, level.depth, noise.tolerance, least, SEEDED_SHARE)
            if self.config.pieces:
                dynamic, segments = self._segments(frame, dynamic, seeds, segmentation())
            if moving is not None and moving.any():
                image = timestamp, level, T_world_camera, segmentation(), noise.bounded_sigma
                dynamic = dynamic | (moving & ~self.memory.stayed(*image, moving))
            # what belongs to no moving region fits badly for another reason, which the robust weights deal with
            probability = np.where(dynamic, np.float32(0), np.float32(1))
        hidden = None
        if self.config.free_space:
            hidden = self.background.hidden(timestamp, exposed(level, exposure), T_world_camera)
        return Labels(probability, dynamic, mixture, histogram, sample, segments, hidden)

    def update(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
        labels: Labels,
    ) -> None:
        """Remember a tracked frame, which the next ones are compared with.

        Args:
            timestamp: Seconds.
            level: The image, at the resolution of the labels.
            T_world_camera: (4, 4).
            exposure: Gain and offset that make the image's intensities those of the map.
            labels: Labels of the frame.
        """
        self.memory.update(timestamp, level, T_world_camera, labels.dynamic, labels.segmentation)
        if self.config.free_space:
            self.background.update(timestamp, exposed(level, exposure), T_world_camera, labels.dynamic)

    def reset(self) -> None:
        """Forget the remembered frames after a loss of tracking."""
        self.memory.reset()
        self.background.reset()

    def _noise_parameters(self, level: Level, voxel_size: float) -> NoiseParameters:
        """What the noise of the readings of an image follows from, with a map whose voxels have that edge, metres."""
        config, sensor = self.config, self.sensor
        return NoiseParameters(
            sensor.sigma_base, sensor.sigma_scale, (MAP_ROUGHNESS * voxel_size) ** 2, DEPTH_EDGE_SIGMAS,
            DEPTH_EDGE_SLOPE / pixel_scale(level), config.noise_threshold, config.noise_sigmas, MAX_GAP,
            config.noise_threshold / 3,
        )  # fmt: skip

    def _log_odds(self, frame: _Comparison, mixture: Mixture, unknown: float) -> NDArray[np.float32]:
        """Log odds (h, w) static : dynamic of each pixel alone, 0 = unknown.

        Near a surface of the map they are those of the mixture, but at least 1 within the noise (eq. 4.57). In known
        free space they are -MAX_LOG_ODDS; ``unknown`` is the share of the readings in space unknown to the map.
        """
        config, level, seen_free = self.config, frame.level, None
        if config.free_space and (older := self.memory.free_space_frames(frame.timestamp, unknown)):
            seen_free = self.memory.seen_free(level, frame.T_world_camera, frame.noise.gap, older)
        parameters = EvidenceParameters(
            *mixture.coefficients, MAX_LOG_ODDS, config.noise_threshold, config.noise_sigmas
        )
        return evidence.log_odds(frame.sample, frame.noise.sigma, parameters, config.free_space, seen_free)

    def _segments(
        self,
        frame: _Comparison,
        dynamic: NDArray[np.bool_],
        seeds: NDArray[np.bool_],
        segmentation: Segmentation,
    ) -> tuple[NDArray[np.bool_], Segmentation]:
        """Dynamic pixels (h, w) decided by segment, and the segments.

        1. Pixels in unknown space are dynamic only in a segment at least STARTED_SHARE of which are seeds.
        2. Segments that ``classify_segments`` finds to move are dynamic as a whole.
        3. Segments that have settled are static.
        """
        level, T_world_camera = frame.level, frame.T_world_camera
        before = self.memory.last_dynamic(level, T_world_camera)
        counts = evidence.segment_counts(segmentation.labels, segmentation.count, (before, seeds))
        split = split_mixed_segments(segmentation, before, *counts[:2])
        if split is not segmentation:
            segmentation, counts = split, evidence.segment_counts(split.labels, split.count, (before, seeds))
        size, labels = np.maximum(counts[0], 1), segmentation.labels
        sigma = frame.noise.bounded_sigma
        dynamic, sums = evidence.compare_segments(
            frame.sample, segmentation.with_noise(sigma), counts[2] / size >= STARTED_SHARE, dynamic, level.intensity,
            frame.exposure,
        )  # fmt: skip
        moving = classify_segments(evidence_of(sums, segmentation.min_pixels), counts[1] / size)
        dynamic = dynamic | moving[labels]
        settled = self.memory.settled(frame.timestamp, level, T_world_camera, segmentation, sigma, dynamic)
        return dynamic & ~settled, segmentation

    def _threshold_and_flood(self, frame: _Comparison, truncation: float) -> NDArray[np.bool_]:
        """Pixels (h, w) far from the surface, eroded, flooded over depth, dilated (Palazzolo et al. 2019).

        The flood stops at what fits the map: over depth alone it runs from a foot over the floor through the room.
        """
        import cv2

        level = frame.level
        distance = np.abs(np.nan_to_num(frame.sample.distance))
        noise = noise_threshold(self.config, frame.noise.sigma)
        rim = 0.95 * truncation  # a stored distance never exceeds the truncation
        marked = (distance > min(self.config.threshold, rim)) | frame.free
        width = level.camera.width
        core = cv2.erode(marked.astype(np.uint8), elliptical_kernel(EROSION * width)) > 0
        tolerance = np.float32(FLOOD_STEP * 640 / width) * level.depth
        open_pixels = (distance > noise) | frame.free
        labels, _ = labeling.grow_regions(core & (level.depth > 0), open_pixels, level.depth, tolerance)
        return cv2.dilate((labels > 0).astype(np.uint8), elliptical_kernel(DILATION * width)) > 0


def distance_sigma(sensor: SensorConfig, depth: NDArray[np.float32], voxel_size: float) -> NDArray[np.float32]:
    """Standard deviation (h, w) of the distance of a static point, metres: of the reading and of the map."""
    map_variance = (MAP_ROUGHNESS * voxel_size) ** 2
    return np.asarray(static_sigma(depth, sensor.sigma_base, sensor.sigma_scale, map_variance), np.float32)


def depth_tolerance(sigma: NDArray[np.float32], level: Level) -> NDArray[np.float32]:
    """Largest depth step (h, w) to a neighbour of the same surface, metres; ``sigma`` (h, w) is that of the depth."""
    slope = np.float32(DEPTH_EDGE_SLOPE / pixel_scale(level))
    return np.asarray(edge_tolerance(sigma, level.depth, DEPTH_EDGE_SIGMAS, slope), np.float32)


def noise_threshold(config: DynamicsConfig, sigma: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distance (h, w) to the map below which nothing is called motion (theta in eq. 4.57), metres."""
    return noise_limit(sigma, np.float32(config.noise_threshold), np.float32(config.noise_sigmas))
