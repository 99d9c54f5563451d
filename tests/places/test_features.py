"""SIFT extraction and matching."""

import numpy as np

from dudmap.core.places.features import SiftExtractor, match_descriptors, reduced_grey


def unit_vectors(count, seed=3):
    vectors = np.random.default_rng(seed).normal(size=(count, 128)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_matches_are_mutual_and_distinct():
    rng = np.random.default_rng(3)
    b = unit_vectors(50)
    order = rng.permutation(50)[:20]
    a = b[order] + 0.02 * rng.normal(size=(20, 128)).astype(np.float32)
    pairs = match_descriptors(a, b, 0.8)
    np.testing.assert_array_equal(pairs, np.stack([np.arange(20), order], axis=1))
    twins = np.concatenate([b, b])  # no feature is distinct
    assert len(match_descriptors(a, twins, 0.8)) == 0
    assert len(match_descriptors(a[:0], b, 0.8)) == len(match_descriptors(a, b[:1], 0.8)) == 0


def test_the_ratio_test_against_brute_force():
    rng = np.random.default_rng(5)
    a, b = (rng.integers(0, 200, (count, 128)).astype(np.float32) for count in (40, 60))
    a[:20] = b[:20] + rng.integers(0, 60, (20, 128))
    expected = []
    for i, row in enumerate(a):
        distances = np.linalg.norm(b.astype(float) - row, axis=1)
        first, second = np.argsort(distances)[:2]
        nearest = np.argmin(np.linalg.norm(a.astype(float) - b[first], axis=1)) == i
        if nearest and distances[first] < 0.7 * distances[second]:
            expected.append([i, first])
    assert 0 < len(expected) < 40
    np.testing.assert_array_equal(match_descriptors(a, b, 0.7), expected)


def test_extraction():
    rng = np.random.default_rng(1)
    rgb = np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    grey = reduced_grey(rgb, 320)
    assert grey.shape == (240, 320)
    assert reduced_grey(rgb, 9999).shape == (480, 640)
    features = SiftExtractor(100).extract(grey)
    assert 90 <= len(features) <= 110
    assert features.descriptors.shape == (len(features), 128)
    assert features.pixels.max() < 320
    assert features.image_shape == (240, 320)
    assert len(SiftExtractor(100).extract(np.full((240, 320), 90, np.uint8))) == 0
