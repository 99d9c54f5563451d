"""The redundant-view test: similarity of views, motion gate and back-off."""

import numpy as np
import pytest

from dudmap.config import SimilarityConfig
from dudmap.geometry import se3
from dudmap.places.redundancy import RedundantViews, SimilarityTest

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def scene():
    """A wide picture of random shapes (480, 1280, 3)."""
    rng = np.random.default_rng(4)
    picture = np.full((480, 1280, 3), 120, np.uint8)
    for _ in range(700):
        center = tuple(int(x) for x in rng.integers(0, (1280, 480)))
        color = tuple(int(x) for x in rng.integers(0, 256, 3))
        axes = tuple(int(x) for x in rng.integers(4, 40, 2))
        cv2.ellipse(picture, center, axes, float(rng.uniform(0, 180)), 0, 360, color, -1, cv2.LINE_AA)
    return picture


def view(scene, left, noise=0.0, seed=0):
    part = scene[:, left : left + 640].astype(float)
    return np.clip(part + np.random.default_rng(seed).normal(0, noise, part.shape), 0, 255).astype(np.uint8)


def accepted(image, **config):
    test = SimilarityTest(SimilarityConfig(**config))
    test.set_reference(image)
    return test


def test_nothing_is_redundant_at_first(scene):
    assert not SimilarityTest().is_redundant(view(scene, 0))


def test_same_view_is_redundant(scene):
    test = accepted(view(scene, 0, 1, seed=1))
    assert test.is_redundant(view(scene, 0, 1, seed=2))
    assert test.similarity(view(scene, 0, 1, seed=1)) > 0.97


def test_other_views_are_not(scene):
    test = accepted(view(scene, 0))
    assert not test.is_redundant(view(scene, 640))
    assert not test.is_redundant(view(scene, 200))
    shares = [test.similarity(view(scene, left)) for left in (0, 40, 160, 400, 640)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < 0.1


def test_the_reference_can_be_replaced(scene):
    test = accepted(view(scene, 0))
    test.set_reference(view(scene, 640))
    assert not test.is_redundant(view(scene, 0))
    assert test.is_redundant(view(scene, 640))


def test_reduced_image_gives_about_the_share_of_the_full_one(scene):
    for left, noise in ((3, 3), (20, 2), (150, 2)):
        first, second = view(scene, 0, noise, 1), view(scene, left, noise, 2)
        full = accepted(first, image_width=640, max_features=5000)
        share = full.similarity(second) ** (1 / 1.4)  # the exponent at full width makes up for the 500 features only
        assert accepted(first).similarity(second) == pytest.approx(share, abs=0.15)


def test_threshold_counts(scene):
    first, second = view(scene, 0, 2, 1), view(scene, 60, 2, 2)
    share = accepted(first).similarity(second)
    assert 0.1 < share < 0.95
    assert accepted(first, threshold=share - 0.01).is_redundant(second)
    assert not accepted(first, threshold=share + 0.01).is_redundant(second)


def test_blank_images_are_never_redundant():
    blank = np.full((480, 640, 3), 90, np.uint8)
    assert not accepted(blank).is_redundant(blank)


def test_small_images(scene):
    small = cv2.resize(view(scene, 0), (160, 120), interpolation=cv2.INTER_AREA)
    assert accepted(small).is_redundant(small)


def test_features_are_computed_once(scene, monkeypatch):
    test = accepted(view(scene, 0))
    extract = test._sift.extract
    calls = []

    def counted(grey):
        calls.append(1)
        return extract(grey)

    monkeypatch.setattr(test._sift, "extract", counted)
    test.is_redundant(view(scene, 5))
    assert len(calls) == 2
    test.is_redundant(view(scene, 5))
    assert len(calls) == 2  # the reference and the latest image are known
    test.set_reference(view(scene, 5))
    test.is_redundant(view(scene, 9))
    assert len(calls) == 3  # the features of the new reference are known


def test_only_a_camera_that_has_hardly_moved_is_asked(scene):
    views = RedundantViews(SimilarityConfig(patience=2))
    here, aside = np.eye(4), se3.exp(np.array([0.02, 0, 0, 0, 0, 0]))
    image = view(scene, 0, 1, seed=1)
    assert not views.compare(image, here)(here)  # nothing has been fused
    views.set_reference(image, here)
    assert views.compare(image, here)(here)
    assert not views.compare(image, aside)(here)
    assert not views.compare(image, here)(aside)
    assert [views.compare(image, here)(here) for _ in range(3)] == [False, False, True]  # patience after a no
    for patience in (2, 4, 8, 16, 16):
        assert not views.compare(image, here)(aside)
        assert [views.compare(image, here)(here) for _ in range(patience)] == [False] * patience
    assert views.compare(image, here)(here)
    views.apply_correction(aside)
    assert views.compare(image, aside)(aside)
    views.reset()
    assert not views.compare(image, aside)(aside)
