"""Evidence of motion at single pixels: normalised residuals, log odds, and free space that single frames have seen.

The formulas stand first: arithmetic on numbers or images.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import reading_sigma
from dudmap.core.backends.cpu import labeling
from dudmap.core.backends.cpu.reprojection import ReprojectionTarget, reproject
from dudmap.core.backends.cpu.segmentation import SegmentImage, SegmentSums, segment_sums
from dudmap.core.backends.parameters import FREE, SURFACE, UNKNOWN, MapSample, single

BINS = 128
"""Bins of the histogram of normalised residuals."""
MAX_RESIDUAL = 16.0
"""Upper edge of the histogram, standard deviations of a reading; larger residuals count in the last bin."""
EDGES = np.linspace(0, MAX_RESIDUAL, BINS + 1)
"""Edges of the bins."""
LARGEST = np.float32(MAX_RESIDUAL - 1e-3)
"""Residual that larger ones are counted as."""
BINS_PER_SIGMA = np.float32(BINS / MAX_RESIDUAL)
"""Bins per standard deviation of a reading."""
LEAST_SHARE = np.float32(1e-3)
"""Least share of the pixels of a window that are compared: keeps a quotient finite."""


class ResidualCounts(NamedTuple):
    """Statistics of an image compared with the map.

    Attributes:
        histogram: (BINS,) int64 counts of the normalised residuals at the surfaces of the map.
        unknown: Share of the readings that lie in space unknown to the map.
    """

    histogram: NDArray[np.int64]
    unknown: float


class EvidenceParameters(NamedTuple):
    """Log odds static : dynamic of a normalised residual r are offset + slope r^2, bounded.

    Attributes:
        offset, slope: Coefficients, as of ``Mixture.coefficients``.
        limit: Log odds of a pixel that is certain.
        noise_floor: Least distance to the map that can be motion, metres.
        noise_sigmas: The same, standard deviations of the distance.
    """

    offset: float
    slope: float
    limit: float
    noise_floor: float
    noise_sigmas: float


class NoiseParameters(NamedTuple):
    """What the noise of a reading follows from.

    Attributes:
        base, scale: Of the sensor, sigma(z) = base + scale z^2 (thesis eq. 3.91), metres and 1/m.
        map_variance: Of the surface of the map, m^2.
        edge_sigmas, edge_slope: Largest depth step to a neighbour of the same surface: standard deviations, and a share
            of the depth.
        floor, sigmas: As of ``noise_limit``.
        gap: Largest depth difference of two readings of one point, as a multiple of ``noise_limit``.
        least_sigma: Least standard deviation in comparisons by segment, metres.
    """

    base: float
    scale: float
    map_variance: float
    edge_sigmas: float
    edge_slope: float
    floor: float
    sigmas: float
    gap: float
    least_sigma: float


class ReadingNoise(NamedTuple):
    """Noise of the readings of an image, metres.

    Attributes:
        sigma: (h, w) float32, standard deviation of the distance of a static point.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface.
        gap: (h, w) float32, largest depth difference of two readings of one point.
        bounded_sigma: (h, w) float32, ``sigma`` where it is at least ``least_sigma``, else that.
    """

    sigma: NDArray[np.float32]
    tolerance: NDArray[np.float32]
    gap: NDArray[np.float32]
    bounded_sigma: NDArray[np.float32]


def static_sigma(z: Any, base: Any, scale: Any, map_variance: Any) -> Any:
    """Standard deviation of the distance of a static point at depth z, metres: of the reading and of the map."""
    sigma = reading_sigma(z, base, scale)
    return np.sqrt(sigma * sigma + map_variance)


def edge_tolerance(sigma: Any, z: Any, edge_sigmas: Any, edge_slope: Any) -> Any:
    """Largest depth step to a neighbour of the same surface, metres."""
    return edge_sigmas * sigma + edge_slope * z


def residual_bin(distance: Any, sigma: Any) -> Any:
    """Bin of the histogram for a distance to the map with this standard deviation, both in metres."""
    return np.int64(np.minimum(abs(distance) / sigma, LARGEST) * BINS_PER_SIGMA)


def mixture_log_odds(square: Any, offset: Any, slope: Any) -> Any:
    """Log odds static : dynamic of a squared normalised residual: of two half-normal densities (thesis eq. 4.56)."""
    return np.float32(offset + square * slope)


def noise_limit(sigma: Any, floor: Any, sigmas: Any) -> Any:
    """Distance to the map below which nothing is called motion (theta in eq. 4.57), metres."""
    return np.maximum(floor, sigmas * sigma)


def surface_log_odds(
    distance: Any,
    sigma: Any,
    noise: Any,
    offset: Any,
    slope: Any,
    limit: Any,
) -> Any:
    """Log odds static : dynamic at a surface of the map, at least 1 within the noise (eq. 4.57).

    Args:
        distance, sigma: Distance to the map and its standard deviation, metres.
        noise: Distance below which nothing is called motion, metres.
        offset, slope, limit: As of ``EvidenceParameters``.
    """
    residual = abs(distance) / sigma
    odds = mixture_log_odds(residual * residual, offset, slope)
    odds = np.minimum(np.maximum(odds, -limit), limit)
    return np.where(abs(distance) < noise, np.maximum(odds, np.float32(1)), odds)


def reading_noise(depth: NDArray[np.float32], parameters: NoiseParameters) -> ReadingNoise:
    """Noise of the readings of an image (h, w), metres, 0 = none."""
    p = single(parameters)
    sigma = static_sigma(depth, p.base, p.scale, p.map_variance)
    gap = p.gap * noise_limit(sigma, p.floor, p.sigmas)
    tolerance = edge_tolerance(sigma, depth, p.edge_sigmas, p.edge_slope)
    return ReadingNoise(sigma, tolerance, gap, np.maximum(p.least_sigma, sigma))


def residual_counts(sample: MapSample, depth: NDArray[np.float32], sigma: NDArray[np.float32]) -> ResidualCounts:
    """Histogram of the normalised residuals of an image at the surfaces of the map; arguments as of ``log_odds``,
    and the depth (h, w) in metres, 0 = none."""
    surface, valid = sample.occupancy == SURFACE, depth > 0
    histogram = np.bincount(residual_bin(sample.distance[surface], sigma[surface]), minlength=BINS)
    unknown = np.count_nonzero((sample.occupancy == UNKNOWN) & valid) / max(np.count_nonzero(valid), 1)
    return ResidualCounts(histogram, unknown)


def log_odds(
    sample: MapSample,
    sigma: NDArray[np.float32],
    parameters: EvidenceParameters,
    free_space: bool,
    seen_free: NDArray[np.bool_] | None,
) -> NDArray[np.float32]:
    """Log odds static : dynamic (h, w) float32 of each pixel alone, 0 = unknown (eq. 4.56, 4.57).

    Args:
        sample: The map at the points of the image.
        sigma: (h, w) float32, standard deviation of the distance of a static point, metres.
        parameters: Of the log odds at surfaces of the map.
        free_space: Whether a pixel in space that the map knows to be free is certain to move.
        seen_free: (h, w) bool, other pixels that then are, as of ``free_space``; None = none.
    """
    p = parameters
    noise = noise_limit(sigma, np.float32(p.noise_floor), np.float32(p.noise_sigmas))
    limit = np.float32(p.limit)
    odds = surface_log_odds(sample.distance, sigma, noise, np.float64(p.offset), np.float32(p.slope), limit)
    odds[sample.occupancy != SURFACE] = 0  # NaN before
    if free_space:
        free = sample.occupancy == FREE
        odds[free if seen_free is None else free | seen_free] = -limit
    return odds


def free_space(
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    noise: NDArray[np.float32],
    targets: Sequence[ReprojectionTarget],
    side: int,
) -> NDArray[np.bool_]:
    """Pixels (h, w) bool that at least half as many older frames have seen through as have a reading there, opened.

    Args:
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        noise: (h, w) float32, largest depth difference of two readings of one point, metres.
        targets: The older frames.
        side: Of the square that the mask is opened with, pixels, odd.
    """
    import cv2

    num_free, num_surface = (np.zeros(depth.shape, dtype=np.float32) for _ in range(2))
    for gap, _, _ in reproject(depth, intensity, intrinsics, targets):
        num_free += gap > noise
        num_surface += np.abs(gap) <= noise
    free = ((num_free > 0) & (2 * num_free >= num_surface)).astype(np.uint8)
    return cv2.morphologyEx(free, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def moving_regions(
    seeds: NDArray[np.bool_],
    log_odds: NDArray[np.float32],
    depth: NDArray[np.float32],
    tolerance: NDArray[np.float32],
    min_area: float,
    seeded_share: float,
) -> NDArray[np.bool_]:
    """Pixels (h, w) bool of regions that grow from seeds over the surface, up to depth edges and static pixels.

    Args:
        seeds: (h, w) bool, pixels with a reading.
        log_odds: (h, w) float32 of each pixel alone; a pixel is static from 1 on.
        depth, tolerance: As of ``labeling.mean_field``.
        min_area: Fewest pixels of a region.
        seeded_share: Least share of seeds in a region.
    """
    labels, count = labeling.grow_regions(seeds, log_odds < 1, depth, tolerance)
    areas = np.bincount(labels.reshape(-1), minlength=count + 1)
    seeded = np.bincount(labels[seeds], minlength=count + 1)
    dynamic = (areas >= min_area) & (seeded >= seeded_share * areas)
    dynamic[0] = False
    return dynamic[labels]


def seen_marked(
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    target: ReprojectionTarget,
    max_gap: float,
) -> NDArray[np.bool_]:
    """Pixels (h, w) bool whose points a marked reading of an older frame shows, within ``max_gap`` metres.

    Args:
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        target: The older frame.
        max_gap: Metres.
    """
    ((gap, _, marks),) = reproject(depth, intensity, intrinsics, [target])
    return (marks > 0) & (np.abs(gap) < max_gap)


def segment_counts(
    labels: NDArray[np.int32], count: int, masks: Sequence[NDArray[np.bool_]]
) -> list[NDArray[np.int64]]:
    """Pixels (count + 1,) of each segment, and for each mask (h, w) those that lie in it.

    Args:
        labels: (h, w) int32 numbers of the segments from 1, 0 = none.
        count: Number of segments.
        masks: Any number.
    """
    members = labels.reshape(-1), *(labels[mask] for mask in masks)
    return [np.bincount(found, minlength=count + 1) for found in members]


def compare_segments(
    sample: MapSample,
    segments: SegmentImage,
    started: NDArray[np.bool_],
    dynamic: NDArray[np.bool_],
    intensity: NDArray[np.float32],
    exposure: tuple[float, float],
) -> tuple[NDArray[np.bool_], SegmentSums]:
    """Dynamic pixels (h, w) bool, without those in unknown space whose segment has not started to move, and sums
    over the segments, of a frame compared with the map.

    Args:
        sample: The map at the points of the image.
        segments: The segments of the image.
        started: (count + 1,) bool, segments that have started.
        dynamic: (h, w) bool.
        intensity: (h, w) float32.
        exposure: Gain and offset that make the image's intensities those of the map.
    """
    surface, known = sample.occupancy == SURFACE, sample.occupancy != UNKNOWN
    dynamic = dynamic & (known | started[segments.labels])
    gain, offset = exposure
    correction = np.float32(1 - gain) * intensity - np.float32(offset)
    difference = np.asarray(sample.difference + correction, np.float32)
    difference[np.isnan(difference)] = 0  # in the air
    return dynamic, smoothed_segment_sums(segments, surface, dynamic, sample.distance, difference)


def compare_with_frame(
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    target: ReprojectionTarget,
    segments: SegmentImage,
    max_sigmas: float,
) -> SegmentSums:
    """Sums over the segments of a frame compared with an older one, in which points move that are off by more than
    ``max_sigmas``; other arguments as of ``seen_marked`` and ``compare_segments``."""
    ((gap, difference, _),) = reproject(depth, intensity, intrinsics, [target])
    compared = ~np.isnan(gap)
    displaced = np.abs(gap) > max_sigmas * segments.sigma  # not where it is NaN
    return smoothed_segment_sums(segments, compared, displaced, gap, difference)


def smoothed_segment_sums(
    segments: SegmentImage,
    compared: NDArray[np.bool_],
    moving: NDArray[np.bool_],
    distance: NDArray[np.float32],
    difference: NDArray[np.float32],
) -> SegmentSums:
    """Sums over segments, as of ``segment_sums``, with the mean difference over the pixels of a window that are
    compared."""
    import cv2

    size = segments.window, segments.window
    ones = cv2.blur(compared.astype(np.float32), size)
    mean = cv2.blur(np.where(compared, difference, np.float32(0)), size) / np.maximum(ones, LEAST_SHARE)
    return segment_sums(segments, compared, moving, distance, np.asarray(mean, np.float32))
