"""The redundant-view test: similarity of views, what the map knows of a view, and what is news in it."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config, SimilarityConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.redundancy import RedundantViews, SimilarityTest
from wavy_wall import CAMERA, wall

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


class Camera:
    """Frames at the origin, fused as the algorithm does: unless they are redundant."""

    def __init__(self, *overrides, seed=1):
        self.config = Config().override(["volume.voxel_size=0.02", *overrides])
        self.volume = TsdfVolume(CAMERA, self.config.volume, self.config.sensor, depth_max=4.0)
        self.views = RedundantViews(self.config)
        self.rng = np.random.default_rng(seed)

    def see(self, exact, dynamic=None, T=None):
        """Process a depth image with the noise of the sensor; returns whether it was redundant."""
        T = np.eye(4) if T is None else T
        noise = self.rng.normal(0, 1, exact.shape) * self.config.sensor.sigma(exact)
        depth = np.where(exact > 0, exact + noise, 0).astype(np.float32)
        color = np.full((*CAMERA.shape, 3), 90, np.uint8)
        level = Level(CAMERA, depth, color[..., 0].astype(np.float32) / 255)
        dynamic = np.zeros(CAMERA.shape, bool) if dynamic is None else dynamic
        view = SimpleNamespace(labelled=level)
        estimate = SimpleNamespace(T_world_camera=T, labels=SimpleNamespace(dynamic=dynamic))
        redundant = self.views.is_redundant(self.volume, view, estimate)
        if not redundant:
            self.volume.integrate(Frame(0.0, depth, color), T, ~dynamic)
            self.views.update(self.volume, view, estimate)
        return redundant

    def rest(self, exact, frames=40):
        return [self.see(exact) for _ in range(frames)]


@pytest.fixture
def wavy():
    return wall(1.5).depth


@pytest.fixture
def box(wavy):
    """A box of 12x10 pixels, 40 cm in front of the wall, and its pixels."""
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[20:30, 25:37] = True
    return np.where(pixels, np.float32(1.1), wavy), pixels


def test_a_camera_at_rest_fuses_until_free_space_is_known(wavy):
    camera = Camera()
    redundant = camera.rest(wavy)
    first = redundant.index(True)
    assert first >= 2 * camera.config.volume.free_after
    assert sum(redundant[first:]) > 0.9 * len(redundant[first:])
    assert not any(Camera("similarity.enabled=false").rest(wavy))


def test_another_pose_is_never_redundant(wavy):
    camera = Camera()
    camera.rest(wavy)
    aside = se3.exp(np.array([0.006, 0, 0, 0, 0, 0]))
    assert not camera.see(wavy, T=aside)
    assert not camera.see(wavy, T=np.eye(4))  # now far from the last place
    camera = Camera()
    camera.rest(wavy)
    camera.views.apply_correction(aside)
    assert not camera.see(wavy)
    camera = Camera()
    camera.rest(wavy)
    camera.views.reset()
    assert not camera.see(wavy)


def test_a_place_moves_with_the_world():
    """The camera looks sideways, so that the order of the two motions matters."""
    views, volume = RedundantViews(Config()), SimpleNamespace(voxel_size=0.01)
    T = se3.exp(np.array([1.0, 2.0, 0, 0, 1.5, 0]))
    level = Level(CAMERA, np.ones(CAMERA.shape, np.float32), np.ones(CAMERA.shape, np.float32))
    views.update(volume, SimpleNamespace(labelled=level), SimpleNamespace(T_world_camera=T, labels=None))
    correction = se3.exp(np.array([0.2, -0.1, 0.3, 0.4, 0, 0]))
    views.apply_correction(correction)
    np.testing.assert_allclose(views._place.T_world_camera, correction @ T)


def test_uncovered_background_is_fused(wavy, box):
    in_front, pixels = box
    camera = Camera()
    for _ in range(40):
        camera.see(in_front, dynamic=pixels)
    assert camera.see(in_front, dynamic=pixels)
    redundant = camera.rest(wavy, 20)  # the box has gone: what it hid has never been seen
    assert not any(redundant[: 2 * camera.config.volume.free_after - 1])
    assert redundant[-1]


def test_what_is_put_down_is_fused(wavy, box):
    camera = Camera()
    assert camera.rest(wavy)[-1]
    redundant = camera.rest(box[0], 30)
    assert not any(redundant[: 2 * camera.config.volume.free_after - 1])
    assert redundant[-1]


def test_what_is_taken_away_is_carved(wavy, box):
    in_front, pixels = box
    camera = Camera("volume.free_after=2")
    camera.rest(wavy, 20)
    camera.rest(in_front, 30)  # the wall behind the box is known
    assert np.median(camera.volume.raycast(np.eye(4)).depth[pixels]) < 1.2
    redundant = camera.rest(wavy, 30)
    assert not any(redundant[: 2 * camera.config.volume.free_after])
    assert redundant[-1]
    assert np.median(camera.volume.raycast(np.eye(4)).depth[pixels]) > 1.3


def test_the_features_of_the_last_fused_frame_can_decide(scene):
    views = RedundantViews(Config().override(["similarity.measure=features"]))

    def at(image):
        level = Level(CAMERA, np.ones(CAMERA.shape, np.float32), np.ones(CAMERA.shape, np.float32))
        return SimpleNamespace(labelled=level, colored=lambda: SimpleNamespace(rgb=image))

    estimate = SimpleNamespace(T_world_camera=np.eye(4), labels=None)
    volume = SimpleNamespace(voxel_size=0.01)
    assert not views.is_redundant(volume, at(view(scene, 0)), estimate)
    views.update(volume, at(view(scene, 0)), estimate)
    assert views.is_redundant(volume, at(view(scene, 0, 1, seed=1)), estimate)
    assert not views.is_redundant(volume, at(view(scene, 640)), estimate)
