"""The redundant-view test: what the map knows of a view, and what is news in it."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.redundancy import RedundantViews
from wavy_wall import CAMERA, wall


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
