"""Which pixels move: mixture of residual densities, known free space, regions (thesis section 4.6, algorithm 3)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig, SensorConfig
from dudmap.dynamics.background_model import BackgroundModel
from dudmap.dynamics.masks import Labels, elliptical_kernel, opened
from dudmap.dynamics.mixture import BINS, LARGEST, fit_mixture
from dudmap.dynamics.segments import Segmentation, classify_segments, judge, segment, split
from dudmap.dynamics.temporal_memory import BODY, MOVED, TemporalMemory
from dudmap.frames.exposure import exposed
from dudmap.frames.observation import Level
from dudmap.kernels import labeling
from dudmap.kernels.threads import submit
from dudmap.mapping.volume import FREE, SURFACE, UNKNOWN, MapSample, TsdfVolume

REACH = 0.1
"""Farthest that a point may be from its reading in the last frame to be what that was, metres."""


class DynamicDetector:
    """Labels the pixels of a registered frame as static or moving, from how badly they fit the map."""

    def __init__(self, config: DynamicsConfig, sensor: SensorConfig) -> None:
        self.config = config
        self.sensor = sensor
        self.memory = TemporalMemory(config)
        self.background = BackgroundModel(config)
        self.moving: NDArray[np.bool_] | None = None
        self.now = 0.0
        self._cut: tuple[Level, Callable[[], Segmentation]] | None = None

    def begin(self, timestamp: float, moving: NDArray[np.bool_] | None = None) -> None:
        """A new frame, of this time in seconds, and what moves in it (h, w) as far as two images tell."""
        self.now = timestamp
        self.memory.begin(timestamp)
        self.background.begin(timestamp)
        self.moving = moving

    def cut(self, level: Level, voxel_size: float) -> Callable[[], Segmentation]:
        """Begin to cut an image into pieces of surface, which needs no map; what is returned waits for them."""
        tolerance = self._tolerance(self._sigma(level.depth, voxel_size), level.depth)
        return submit(lambda: segment(level, tolerance))

    def set_segmentation(self, level: Level, surface: Callable[[], Segmentation]) -> None:
        """Take over the pieces of the image that comes next, as ``cut`` gives them."""
        self._cut = level, surface

    def pieces(self, level: Level, volume: TsdfVolume) -> Segmentation:
        """Segmentation of surface of an image; cut only once for the image that was asked for last."""
        if self._cut is None or self._cut[0] is not level:
            self._cut = level, self.cut(level, volume.voxel_size)
        return self._cut[1]()

    def detect(
        self,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float] = (1.0, 0.0),
    ) -> Labels:
        """Labels of a frame that has been registered to ``volume`` at a pose.

        Args:
            volume: The map.
            level: The image.
            T_world_camera: (4, 4).
            exposure: Gain and offset that make the image's intensities those of the map.
        """
        sample = volume.sample(level.depth, level.intensity, level.camera, T_world_camera)
        sigma = self._sigma(level.depth, volume.voxel_size)
        tolerance = self._tolerance(sigma, level.depth)
        residual = np.abs(sample.distance) / sigma
        counted = residual[sample.occupancy == SURFACE]
        edges = np.linspace(0, LARGEST, BINS + 1)
        cells = np.minimum(counted, np.float32(LARGEST - 1e-3)) * np.float32(BINS / LARGEST)
        histogram = np.bincount(cells.astype(np.int64), minlength=BINS)
        noise = np.maximum(np.float32(self.config.noise_threshold), self.config.noise_sigmas * sigma)
        if self.config.method == "threshold":
            dynamic = self._threshold_and_flood(volume, level, sample, noise)
            return Labels(np.where(dynamic, np.float32(0), np.float32(1)), dynamic, None, histogram, sample)
        mixture = fit_mixture(histogram, edges)
        rested = np.zeros(level.depth.shape, dtype=bool)
        evidence = np.zeros(level.depth.shape, dtype=np.float32)
        near = sample.occupancy == SURFACE
        evidence[near] = np.clip(mixture.log_odds(residual[near]), -6, 6)
        fits = near & (np.abs(sample.distance) < noise)  # eq. 4.57: below the noise nothing is called motion
        evidence[fits] = np.maximum(evidence[fits], 1)
        behind = near & (sample.distance < 0)  # what the map holds is gone: the map errs, not the reading
        evidence[behind] = np.maximum(evidence[behind], 0)
        if self.config.free_space:
            unknown = float(np.mean(sample.occupancy[level.depth > 0] == UNKNOWN)) if level.depth.any() else 0.0
            reach = np.float32(1.5) * noise.astype(np.float32)
            seen_free, rested = self.memory.views(level, T_world_camera, reach, unknown)
            evidence[(sample.occupancy == FREE) | seen_free] = -6
        probability = labeling.smooth(evidence, level.depth, tolerance, np.float32(4), 4)
        dynamic = (probability < 0.5) & (level.depth > 0)
        surface = None
        if self.config.regions:
            seeds = opened(dynamic) | (dynamic & (sample.occupancy == FREE))
            dynamic = self._regions(seeds, evidence, level, tolerance)
            if self.config.pieces:
                dynamic, surface = self._whole(
                    dynamic, seeds, sample, sigma, self.pieces(level, volume), level, T_world_camera, exposure
                )
            if self.moving is not None:
                dynamic = dynamic | (self.moving & ~rested)
            # what is no region fits the map badly for another reason: the robust weights deal with it
            probability = np.where(dynamic, np.float32(0), np.float32(1))
        hidden = self.background.hidden(exposed(level, exposure), T_world_camera) if self.config.free_space else None
        return Labels(probability, dynamic, mixture, histogram, sample, surface, hidden)

    def remember(
        self, level: Level, T_world_camera: NDArray[np.float64], exposure: tuple[float, float], labels: Labels
    ) -> None:
        """Take over a frame that was tracked: what the next one is compared with."""
        self.memory.remember(level, T_world_camera, labels.dynamic, labels.surface)
        if self.config.free_space:
            self.background.update(exposed(level, exposure), T_world_camera, labels.dynamic)

    def forget(self) -> None:
        """Tracking was lost: what was seen before says nothing of what stood still meanwhile."""
        self.memory.forget()
        self.background.forget()

    def _sigma(self, depth: NDArray[np.float32], voxel_size: float) -> NDArray[np.float32]:
        """Standard deviation (h, w) of the distance of a static point: sensor noise and the map's own roughness."""
        sensor = self.sensor.sigma_base + self.sensor.sigma_scale * depth**2
        return np.hypot(sensor, 0.4 * voxel_size).astype(np.float32)

    @staticmethod
    def _tolerance(sigma: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Largest depth step (h, w) to a neighbour of the same surface, metres."""
        return np.asarray(3 * sigma + np.float32(0.02) * depth, np.float32)

    def _regions(
        self, seeds: NDArray[np.bool_], evidence: NDArray[np.float32], level: Level, tolerance: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Grow each moving spot over the surface it belongs to, up to what fits the map or a depth edge."""
        labels = np.empty(seeds.shape, dtype=np.int32)
        count = labeling.grow(seeds, evidence < 1, level.depth, tolerance, labels)
        areas = np.bincount(labels.reshape(-1), minlength=count + 1)
        seeded = np.bincount(labels[seeds], minlength=count + 1)
        smallest = 0.0008 * seeds.size
        whole = (areas >= smallest) & (seeded >= 0.25 * areas)
        some = (areas >= smallest) & ~whole
        whole[0] = some[0] = False
        return whole[labels] | (some[labels] & seeds)

    def _whole(
        self,
        dynamic: NDArray[np.bool_],
        seeds: NDArray[np.bool_],
        sample: MapSample,
        sigma: NDArray[np.float32],
        surface: Segmentation,
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
    ) -> tuple[NDArray[np.bool_], Segmentation]:
        """Decide piece by piece: all of a thing moves, or it has stood still for some time and none of it does."""
        marks = self.memory.marks(level, T_world_camera, REACH)
        moved = (marks & MOVED) > 0
        surface = split(surface, (marks & BODY) > 0)
        # what the map does not know begins to move with the piece it belongs to, not with what is beside it
        known = sample.occupancy != UNKNOWN
        begun = surface.share(seeds) >= 0.1
        at_rest = surface.share(known & ~dynamic) > np.maximum(0.5, 9 * surface.share(known & dynamic))
        dynamic = dynamic & (known | begun[surface.labels] | (moved & ~at_rest[surface.labels]))
        gain, offset = exposure
        exposed = np.float32(1 - gain) * level.intensity - np.float32(offset)
        difference = np.asarray(sample.difference + exposed, np.float32)
        noise = np.maximum(np.float32(self.config.noise_threshold / 3), sigma)
        verdict = judge(surface, sample.occupancy == SURFACE, dynamic, sample.distance, noise, difference)
        moving = dynamic | classify_segments(verdict, surface.share(moved))[surface.labels]
        return moving & ~self.memory.standing(level, T_world_camera, surface, noise, moving), surface

    def _threshold_and_flood(
        self, volume: TsdfVolume, level: Level, sample: MapSample, noise: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """The simple rule: far from the surface, eroded, flooded over depth, dilated (Palazzolo et al. 2019).

        The flood stops at what fits the map: over depth alone it runs from a foot over the floor through the room.
        """
        import cv2

        distance = np.abs(np.nan_to_num(sample.distance))
        free = sample.occupancy == FREE
        marked = (distance > min(self.config.threshold, 0.95 * volume.truncation)) | free
        scale = level.camera.width / 640
        core = cv2.erode(marked.astype(np.uint8), elliptical_kernel(15 * scale)) > 0
        labels = np.empty(marked.shape, dtype=np.int32)
        tolerance = np.float32(0.007 / scale) * level.depth
        labeling.grow(core & (level.depth > 0), (distance > noise) | free, level.depth, tolerance, labels)
        return cv2.dilate((labels > 0).astype(np.uint8), elliptical_kernel(10 * scale)) > 0
