"""Which pixels move: mixture of residual densities, known free space, regions (thesis section 4.6, algorithm 3)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig, SensorConfig
from dudmap.dynamics import segments as surfaces
from dudmap.dynamics.background_model import Background
from dudmap.kernels import labeling
from dudmap.kernels.threads import bands, begun, run_bands
from dudmap.mapping.volume import FREE, NOTHING, SURFACE, MapSample, TsdfVolume
from dudmap.tracking.tracker import Level, exposed

BINS = 128
LARGEST = 16.0
"""Normalised residuals are counted in BINS bins from 0 to LARGEST standard deviations."""
REACH = 0.1
"""Farthest that a point may be from its reading in the last frame to be what that was, metres."""


@dataclass(frozen=True)
class Mixture:
    """Two half-normal densities of the normalised residual (eq. 4.52, 4.56): static and dynamic."""

    prior: tuple[float, float]
    sigma: tuple[float, float]

    def log_odds(self, residual: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log odds static : dynamic of normalised residuals >= 0."""
        (p_static, p_dynamic), (s, d) = self.prior, self.sigma
        r2 = np.square(residual, dtype=np.float32)
        return (np.log(p_static / p_dynamic * d / s) + r2 * np.float32(0.5 / d**2 - 0.5 / s**2)).astype(np.float32)

    def density(self, residual: NDArray[np.floating]) -> NDArray[np.float64]:
        """Densities (2, ...) of both components, priors included."""
        r = np.asarray(residual, dtype=np.float64)
        return np.stack(
            [
                p * np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (r / s) ** 2)
                for p, s in zip(self.prior, self.sigma, strict=True)
            ]
        )


def fit_mixture(histogram: NDArray[np.integer], edges: NDArray[np.float64], iterations: int = 30) -> Mixture:
    """Expectation maximisation on a histogram of normalised residuals (eq. 4.52-4.56; Dempster et al. 1977).

    The static density is kept at one to two standard deviations of the sensor and the dynamic one at no less than
    three times the static one, so that the names of the components cannot swap.
    """
    centers = (edges[:-1] + edges[1:]) / 2
    prior, static, dynamic = labeling.fit_mixture(histogram.astype(np.float64), centers, iterations, LARGEST)
    return Mixture((1 - prior, prior), (static, dynamic))


@dataclass(frozen=True, eq=False)
class Labels:
    """Outcome for one frame, at the resolution of the label level.

    Attributes:
        static_probability: (h, w) float32 in [0, 1]; the weight of the second registration.
        dynamic: (h, w) bool.
        mixture: The fitted densities, None for methods that fit none.
        histogram: (BINS,) normalised residuals.
        sample: What the map says at the points.
        surface: Pieces of surface, None where they are not asked.
        hidden: (h, w) bool, pixels without a reading that hide something static; None where they are not asked for.
    """

    static_probability: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    mixture: Mixture | None
    histogram: NDArray[np.int64]
    sample: MapSample
    surface: surfaces.Pieces | None = None
    hidden: NDArray[np.bool_] | None = None


class DynamicDetector:
    """Labels the pixels of a registered frame as static or moving, from how badly they fit the map."""

    def __init__(self, config: DynamicsConfig, sensor: SensorConfig) -> None:
        self.config = config
        self.sensor = sensor
        self.memory = surfaces.StandStill(config)
        self.background = Background(config)
        self.moving: NDArray[np.bool_] | None = None
        self.now = 0.0
        self._cut: tuple[Level, Callable[[], surfaces.Pieces]] | None = None

    def begin(self, timestamp: float, moving: NDArray[np.bool_] | None = None) -> None:
        """A new frame, of this time in seconds, and what moves in it (h, w) as far as two images tell."""
        self.now = timestamp
        self.memory.begin(timestamp)
        self.background.begin(timestamp)
        self.moving = moving

    def cut(self, level: Level, voxel_size: float) -> Callable[[], surfaces.Pieces]:
        """Begin to cut an image into pieces of surface, which needs no map; what is returned waits for them."""
        tolerance = self._tolerance(self._sigma(level.depth, voxel_size), level.depth)
        return begun(lambda: surfaces.pieces(level, tolerance))

    def take(self, level: Level, surface: Callable[[], surfaces.Pieces]) -> None:
        """Take over the pieces of the image that comes next, as ``cut`` gives them."""
        self._cut = level, surface

    def pieces(self, level: Level, volume: TsdfVolume) -> surfaces.Pieces:
        """Pieces of surface of an image; cut only once for the image that was asked for last."""
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
        counted = residual[sample.place == SURFACE]
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
        near = sample.place == SURFACE
        evidence[near] = np.clip(mixture.log_odds(residual[near]), -6, 6)
        fits = near & (np.abs(sample.distance) < noise)  # eq. 4.57: below the noise nothing is called motion
        evidence[fits] = np.maximum(evidence[fits], 1)
        behind = near & (sample.distance < 0)  # what the map holds is gone: the map errs, not the reading
        evidence[behind] = np.maximum(evidence[behind], 0)
        if self.config.free_space:
            unknown = float(np.mean(sample.place[level.depth > 0] == NOTHING)) if level.depth.any() else 0.0
            reach = np.float32(1.5) * noise.astype(np.float32)
            seen_free, rested = self.memory.views(level, T_world_camera, reach, unknown)
            evidence[(sample.place == FREE) | seen_free] = -6
        probability = labeling.smooth(evidence, level.depth, tolerance, np.float32(4), 4)
        dynamic = (probability < 0.5) & (level.depth > 0)
        surface = None
        if self.config.regions:
            seeds = _solid(dynamic) | (dynamic & (sample.place == FREE))
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
        surface: surfaces.Pieces,
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
    ) -> tuple[NDArray[np.bool_], surfaces.Pieces]:
        """Decide piece by piece: all of a thing moves, or it has stood still for some time and none of it does."""
        marks = self.memory.marks(level, T_world_camera, REACH)
        moved = (marks & surfaces.MOVED) > 0
        surface = surfaces.split(surface, (marks & surfaces.BODY) > 0)
        # what the map does not know begins to move with the piece it belongs to, not with what is beside it
        known = sample.place != NOTHING
        begun = surface.share(seeds) >= 0.1
        at_rest = surface.share(known & ~dynamic) > np.maximum(0.5, 9 * surface.share(known & dynamic))
        dynamic = dynamic & (known | begun[surface.labels] | (moved & ~at_rest[surface.labels]))
        gain, offset = exposure
        exposed = np.float32(1 - gain) * level.intensity - np.float32(offset)
        difference = np.asarray(sample.difference + exposed, np.float32)
        noise = np.maximum(np.float32(self.config.noise_threshold / 3), sigma)
        verdict = surfaces.judge(surface, sample.place == SURFACE, dynamic, sample.distance, noise, difference)
        moving = dynamic | surfaces.moves_as_a_whole(verdict, surface.share(moved))[surface.labels]
        return moving & ~self.memory.standing(level, T_world_camera, surface, noise, moving), surface

    def _threshold_and_flood(
        self, volume: TsdfVolume, level: Level, sample: MapSample, noise: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """The simple rule: far from the surface, eroded, flooded over depth, dilated (Palazzolo et al. 2019).

        The flood stops at what fits the map: over depth alone it runs from a foot over the floor through the room.
        """
        import cv2

        distance = np.abs(np.nan_to_num(sample.distance))
        free = sample.place == FREE
        marked = (distance > min(self.config.threshold, 0.95 * volume.truncation)) | free
        scale = level.camera.width / 640
        core = cv2.erode(marked.astype(np.uint8), _ellipse(15 * scale)) > 0
        labels = np.empty(marked.shape, dtype=np.int32)
        tolerance = np.float32(0.007 / scale) * level.depth
        labeling.grow(core & (level.depth > 0), (distance > noise) | free, level.depth, tolerance, labels)
        return cv2.dilate((labels > 0).astype(np.uint8), _ellipse(10 * scale)) > 0


def _solid(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask without what is thinner than three pixels: the seams along depth edges, where readings fit no map."""
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def full_mask(labels: Labels, level: Level, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Moving pixels (H, W) bool at full size; holes in the depth inside a moving region belong to it."""
    import cv2

    low = cv2.morphologyEx(labels.dynamic.astype(np.uint8), cv2.MORPH_CLOSE, _ellipse(2))
    low[(level.depth > 0) & ~labels.dynamic] = 0
    if labels.hidden is not None:
        low[labels.hidden] = 1
    return full_size(low > 0, level.depth, depth)


def full_size(low: NDArray[np.bool_], low_depth: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (h, w) at the size (H, W) of a depth image: a pixel takes after the nearby one whose depth is most alike."""
    out = np.empty(depth.shape, dtype=np.uint8)
    stride, marks = depth.shape[1] // low.shape[1], low.astype(np.uint8)
    run_bands(
        lambda start, stop: labeling.upsample(start, stop, marks, low_depth, depth, stride, out),
        bands(depth.shape[0], 60),
    )
    return out > 0


def grown_mask(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Mask (H, W) widened by some pixels."""
    import cv2

    if pixels == 0 or not mask.any():
        return mask
    return cv2.dilate(mask.astype(np.uint8), _ellipse(pixels)) > 0


def _ellipse(radius: float) -> NDArray[np.uint8]:
    import cv2

    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)
