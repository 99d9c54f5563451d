"""The compiled calls that label a frame against NumPy on whole images."""

import cv2
import numpy as np
import pytest

import label_oracle
from dudmap.core.backends.cpu.evidence import (
    BINS,
    CENTERS,
    NoiseParameters,
    RegionRules,
    moving_pixels,
    weigh_readings,
)
from dudmap.core.backends.cpu.labeling import opened
from dudmap.core.backends.cpu.reprojection import compare_images
from dudmap.core.backends.cpu.segment_motion import SegmentImage, moving_segments, stand_still
from dudmap.core.backends.median import nth
from dudmap.core.backends.parameters import SURFACE, MapSample, single
from dudmap.core.dynamics.masks import RULES, fit_mixture

NOISE = single(NoiseParameters(0.001, 0.0019, 1.6e-5, 3, 0.02, 0.03, 4.0))
SHAPE = 60, 80


def smooth(rng, sigma):
    """Random image (h, w) float32 of standard deviation 1, smoothed."""
    image = cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), sigma)
    return (image / image.std()).astype(np.float32)


@pytest.fixture(params=range(6))
def scene(request):
    """Depth and intensity of an image, and a map of it in which some regions have moved."""
    rng = np.random.default_rng(request.param)
    depth = np.where(smooth(rng, 6) > 0.8, 1.5, 2.5).astype(np.float32) + 0.1 * smooth(rng, 8)
    depth[smooth(rng, 3) > 2] = 0
    occupancy = np.where(depth > 0, rng.choice(3, SHAPE, p=[0.1, 0.8, 0.1]), 0).astype(np.uint8)
    distance = (0.006 * rng.normal(size=SHAPE) + 0.06 * (smooth(rng, 6) > 1)).astype(np.float32)
    difference = 0.03 * smooth(rng, 1)
    distance[occupancy != SURFACE] = difference[occupancy != SURFACE] = np.nan
    difference[rng.random(SHAPE) < 0.02] = np.nan
    return rng, depth, 0.5 + 0.1 * smooth(rng, 2), MapSample(distance, difference, occupancy)


def test_the_noise_and_the_residuals_of_readings(scene):
    _, depth, _, sample = scene
    sigma, tolerance, histogram = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32), np.zeros(BINS, np.int64)
    unknown, mixture = weigh_readings(
        depth, sample.distance, sample.occupancy, NOISE, RULES, CENTERS, sigma, tolerance, histogram
    )
    expected = label_oracle.weighed(depth, sample, NOISE)
    assert np.array_equal(sigma, expected[0])
    assert np.array_equal(tolerance, expected[1])
    assert np.array_equal(histogram, expected[2])
    assert unknown == expected[3]
    fitted = fit_mixture(histogram, np.linspace(0, 16, BINS + 1))
    assert np.allclose(mixture, (fitted.prior[1], *fitted.sigma), rtol=1e-12)


@pytest.mark.parametrize("free", [False, True])
def test_regions_of_moving_pixels(scene, free):
    rng, depth, _, sample = scene
    sigma, tolerance, *_ = label_oracle.weighed(depth, sample, NOISE)
    seen_free = (smooth(rng, 4) > 1.5) & (depth > 0)
    rules = RegionRules(6, 4, 4, 1, 15, 0.25)
    dynamic, seeds, probability = np.empty(SHAPE, bool), np.empty(SHAPE, bool), np.empty(SHAPE, np.float32)
    given = np.float32(12) * seen_free if free else np.empty((0, 0), np.float32)
    fit = np.float64(3.5), np.float32(-0.4)
    moving_pixels(
        depth, sample.distance, sample.occupancy, sigma, tolerance, given, *fit, NOISE, rules, dynamic, seeds,
        probability,
    )  # fmt: skip
    expected = label_oracle.moving(depth, sample, sigma, tolerance, seen_free & free, *fit, NOISE, rules)
    assert np.array_equal(dynamic, expected[0])
    assert np.array_equal(seeds, expected[1])
    assert 0 < dynamic.mean() < 0.7


@pytest.mark.parametrize("half", [1, 2, 5])
def test_a_mask_is_opened(half):
    mask = smooth(np.random.default_rng(half), 2) > -0.5
    square = np.ones((2 * half + 1,) * 2, np.uint8)
    expected = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    assert np.array_equal(opened(mask, half), expected)
    assert 0 < expected.mean() < mask.mean()


def segments_of(rng, depth):
    labels = np.where(depth > 0, 1 + np.arange(SHAPE[1]) // 10 + 8 * (np.arange(SHAPE[0])[:, None] // 15), 0)
    sigma = label_oracle.weighed(depth, MapSample(depth, depth, (depth > 9).astype(np.uint8)), NOISE)[0]
    gradient = np.abs(0.05 * smooth(rng, 3))
    return SegmentImage(labels.astype(np.int32), 32, 60.0, gradient, 3, sigma, np.float32(0.012))


def test_segments_that_move(scene):
    rng, depth, intensity, sample = scene
    segments = segments_of(rng, depth)
    blocks = np.kron(rng.random((4, 8)) < 0.3, np.ones((15, 10))) > 0  # whole segments: none is split
    before, seeds, dynamic = blocks & (depth > 0), rng.random(SHAPE) < 0.1, (smooth(rng, 4) > 0.8) & (depth > 0)
    arguments = before, seeds, sample, intensity, np.float32(-0.05), np.float32(0.01)
    expected = label_oracle.moved(segments, *arguments, dynamic)
    found = dynamic.copy()
    labels, count = moving_segments(segments, *arguments, found)
    assert (np.array_equal(labels, segments.labels), count) == (True, 32)
    assert np.array_equal(found, expected)
    assert (found != dynamic).any()


def test_segments_that_stand_still(scene):
    rng, depth, _, _ = scene
    segments = segments_of(rng, depth)
    gaps = np.array([(0.01 * smooth(rng, 4)).astype(np.float32) for _ in range(2)])
    gaps[:, (depth <= 0) | (rng.random(SHAPE) < 0.1)] = np.nan
    differences = np.where(np.isnan(gaps), np.float32(np.nan), 0.01 * smooth(rng, 1))
    dynamic, settled = depth > 0, np.ones(33, bool)
    first, second = (label_oracle.still(segments, dynamic, *older) for older in zip(gaps, differences, strict=True))
    stand_still(segments, dynamic, gaps[0], differences[0], settled)
    assert np.array_equal(settled[1:], first)
    stand_still(segments, dynamic, gaps[1], differences[1], settled)
    expected = first & second
    assert np.array_equal(settled[1:], expected)
    assert 0 < expected.sum() < first.sum() < 32


def test_an_older_image_is_compared(scene):
    rng, depth, intensity, _ = scene
    gap = (0.01 * smooth(rng, 4)).astype(np.float32)
    gap[(depth <= 0) | (rng.random(SHAPE) < 0.1)] = np.nan
    difference = np.where(np.isnan(gap), np.float32(np.nan), 0.1 * intensity + 0.02 * smooth(rng, 1))
    images = depth, intensity, smooth(rng, 4) > 1, gap, difference, (smooth(rng, 4) > 1).astype(np.uint8)
    expected = label_oracle.compared(*images, NOISE)
    assert compare_images(*images, NOISE, 100, (1.0, 1.0)) == expected
    assert np.isnan(compare_images(*images, NOISE, depth.size, (1.0, 1.0))[0])
    assert 0 < expected[0] < 2


@pytest.mark.parametrize("count", [1, 2, 9, 400])
def test_the_nth_value_is_that_of_the_sorted_ones(count):
    rng = np.random.default_rng(count)
    values = rng.integers(0, max(count // 2, 1), count).astype(float)
    before = values.copy()
    assert [nth(values, k) for k in range(count)] == sorted(values)
    assert np.array_equal(values, before)
