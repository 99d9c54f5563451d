"""Evidence of motion at pixels: residual statistics, and moving pixels; the formulas come first."""

from typing import Any, NamedTuple

import numpy as np

from dudmap.config import reading_sigma
from dudmap.core.backends.cpu.labeling import fit_mixture, grow_regions, mean_field, opened
from dudmap.core.backends.parameters import FREE, SURFACE, UNKNOWN
from dudmap.core.backends.threads import exact, exact_scalar, written_out

BINS = 128
MAX_RESIDUAL = 16.0
"""Upper edge of the histogram, standard deviations of the depth."""
EDGES = np.linspace(0, MAX_RESIDUAL, BINS + 1)
CENTERS = (EDGES[:-1] + EDGES[1:]) / 2
LARGEST = np.float32(MAX_RESIDUAL - 1e-3)
"""Clip of larger residuals."""
BINS_PER_SIGMA = np.float32(BINS / MAX_RESIDUAL)
"""Bins per standard deviation."""
ZERO, ONE = np.float32(0), np.float32(1)


class NoiseParameters(NamedTuple):
    """Parameters of the noise model of a pixel.

    Attributes:
        base, scale: Sensor noise, sigma(z) = base + scale z^2 (thesis eq. 3.91), metres and 1/m.
        map_variance: Of the map's surface, m^2.
        edge_sigmas, edge_slope: Largest depth step within a surface: standard deviations, share of the depth.
        floor, sigmas: See ``noise_limit``.
    """

    base: float
    scale: float
    map_variance: float
    edge_sigmas: float
    edge_slope: float
    floor: float
    sigmas: float


class MixtureRules(NamedTuple):
    """Arguments of ``labeling.fit_mixture``."""

    iterations: int
    start: tuple[float, float, float]
    prior_bounds: tuple[float, float]
    static_bounds: tuple[float, float]
    separation: float


class RegionRules(NamedTuple):
    """Rules for regions of moving pixels.

    Attributes:
        limit: Log odds of a certain pixel.
        coupling, sweeps: See ``labeling.mean_field``.
        half_seam: Half width of seams, which are no seeds, pixels.
        min_area: Smallest region, pixels.
        seeded_share: Smallest share of seeds.
    """

    limit: float
    coupling: float
    sweeps: int
    half_seam: int
    min_area: float
    seeded_share: float


exact_sigma = written_out(reading_sigma)
"""``reading_sigma``, rounded like the surrounding kernel."""


@exact_scalar
def static_sigma(sigma: Any, map_variance: Any) -> Any:
    """Standard deviation of a static point's distance, metres."""
    return np.sqrt(sigma * sigma + map_variance)


@exact_scalar
def edge_tolerance(sigma: Any, z: Any, edge_sigmas: Any, edge_slope: Any) -> Any:
    """Largest depth step within a surface, metres."""
    return edge_sigmas * sigma + edge_slope * z


@exact_scalar
def mixture_log_odds(square: Any, offset: Any, slope: Any) -> Any:
    """Log odds static : dynamic of a squared normalised residual (thesis eq. 4.56)."""
    return np.float32(offset + square * slope)


@exact_scalar
def noise_limit(sigma: Any, floor: Any, sigmas: Any) -> Any:
    """Smallest distance that counts as motion (theta in eq. 4.57), metres."""
    return np.maximum(floor, sigmas * sigma)


@exact_scalar
def surface_log_odds(distance, sigma, noise, offset, slope, limit):
    """Log odds static : dynamic at a map surface, at least 1 within the noise (eq. 4.57).

    Args:
        distance, sigma: Metres.
        noise: Smallest distance of motion, metres.
        offset, slope: See ``mixture_log_odds``.
        limit: Log odds of a certain pixel.
    """
    residual = abs(distance) / sigma
    odds = min(max(mixture_log_odds(residual * residual, offset, slope), -limit), limit)
    return max(odds, ONE) if abs(distance) < noise else odds


@exact
def weigh_readings(depth, distance, occupancy, noise, rules, centers, sigma, tolerance, histogram):
    """Noise of an image's pixels, and the mixture of their residuals.

    Args:
        distance, occupancy: (h, w), see ``MapSample``.
        noise: NoiseParameters, all float32.
        rules: MixtureRules.
        centers: (BINS,) float64.
        sigma: (h, w) float32 out, standard deviation of a static distance, metres.
        tolerance: (h, w) float32 out, largest depth step within a surface, metres.
        histogram: (BINS,) int64 out, residuals at surfaces; initially 0.

    Returns:
        Share of depth in unknown space; prior of the dynamic density, standard deviations, static and dynamic.
    """
    h, w = depth.shape
    readings, unknown = 0, 0
    for v in range(h):
        for u in range(w):
            z = depth[v, u]
            s = static_sigma(exact_sigma(z, noise.base, noise.scale), noise.map_variance)
            sigma[v, u], tolerance[v, u] = s, edge_tolerance(s, z, noise.edge_sigmas, noise.edge_slope)
            readings += z > ZERO
            unknown += (z > ZERO) & (occupancy[v, u] == UNKNOWN)
            if occupancy[v, u] == SURFACE:
                histogram[np.int64(min(abs(distance[v, u]) / s, LARGEST) * BINS_PER_SIGMA)] += 1
    mixture = fit_mixture(
        histogram.astype(np.float64), centers, rules.iterations, rules.start, rules.prior_bounds, rules.static_bounds,
        rules.separation, MAX_RESIDUAL,
    )  # fmt: skip
    return unknown / max(readings, 1), mixture


@exact
def moving_pixels(
    depth, distance, occupancy, sigma, tolerance, added, offset, slope, noise, rules, dynamic, seeds, probability
):  # fmt: skip
    """Pixels that move, alone or in regions.

    1. Log odds static : dynamic of each pixel, 0 = unknown (eq. 4.56, 4.57), and mean field.
    2. Seeds: dynamic pixels in free space, or outside thin seams along depth edges.
    3. Regions grow from seeds up to depth edges and log odds of 1; small ones and ones with few seeds are static.

    Args:
        depth, distance, occupancy, sigma, tolerance: As for ``weigh_readings``.
        added: (h, w) float32, further log odds moving : static; size 0 for none.
        offset, slope: Float64 and float32, see ``Mixture.coefficients``.
        noise: NoiseParameters, all float32.
        rules: RegionRules.
        dynamic, seeds: (h, w) bool out.
        probability: (h, w) float32 out, static.
    """
    h, w = depth.shape
    limit = np.float32(rules.limit)
    odds = np.zeros((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            if occupancy[v, u] == SURFACE:
                s = sigma[v, u]
                least = noise_limit(s, noise.floor, noise.sigmas)
                odds[v, u] = surface_log_odds(distance[v, u], s, least, offset, slope, limit)
            if occupancy[v, u] == FREE:
                odds[v, u] = -limit
            if added.size > 0:
                odds[v, u] = min(max(odds[v, u] - added[v, u], -limit), limit)
    smoothed = mean_field(odds, depth, tolerance, rules.coupling, rules.sweeps)
    for v in range(h):
        for u in range(w):
            probability[v, u] = smoothed[v, u]
            dynamic[v, u] = probability[v, u] < np.float32(0.5) and depth[v, u] > ZERO
    wide = opened(dynamic, rules.half_seam)
    open_pixels = np.empty((h, w), np.bool_)
    for v in range(h):
        for u in range(w):
            seeds[v, u] = wide[v, u] or (dynamic[v, u] and occupancy[v, u] == FREE)
            open_pixels[v, u] = odds[v, u] < ONE
    regions, count = grow_regions(seeds, open_pixels, depth, tolerance)
    area, seeded = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    for v in range(h):
        for u in range(w):
            area[regions[v, u]] += 1
            seeded[regions[v, u]] += seeds[v, u]
    for v in range(h):
        for u in range(w):
            n = regions[v, u]
            dynamic[v, u] = n > 0 and area[n] >= rules.min_area and seeded[n] >= rules.seeded_share * area[n]
