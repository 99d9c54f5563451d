"""Gradients of a map and of an image, compared: faint texture is told from noise."""

import numpy as np
import pytest
from test_observability import CONFIG, grey, registered, tunnel, wall

from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking import tracker as tracker_module
from dudmap.core.tracking.observability import GradientAgreement
from dudmap.core.tracking.tracker import Tracker
from textured_corner import SENSOR, corner, corner_map, level_of, ones

TILTED = np.array([0.3, -0.2, -0.933])
"""Normal of a plane through (0, 0, 2)."""
SHADE = np.array([0.05, 0.08, 0.0])
"""Gradient of the intensities along it, per metre: that of the part across the normal is what is seen."""


def wallpaper(points):
    """One grey level up and down."""
    return 120 + np.sin(20 * points[..., 0]) + np.sin(17 * points[..., 1] + 1)


@pytest.mark.parametrize("seed", range(4))
def test_faint_wallpaper_shows_the_motion_along_a_wall(seed, monkeypatch):
    assert registered(wall, wallpaper, (0, 0, 0.01), seed).unobservable.shape == (0, 6)
    monkeypatch.setattr(tracker_module, "MIN_AGREEMENT", 2.0)
    assert len(registered(wall, wallpaper, (0, 0, 0.01), seed).unobservable) > 0  # H alone does not tell it from noise


@pytest.mark.parametrize("seed", range(2, 6))
@pytest.mark.parametrize("offset", [(0.01, 0.01, 0.02), (-0.013, 0.007, 0.03)])
@pytest.mark.parametrize(("scene", "free"), [(wall, 3), (tunnel, 1)])
def test_noise_shows_nothing(scene, free, offset, seed):
    assert len(registered(scene, grey, offset, seed).unobservable) == free


def test_the_sums_over_the_map_are_its_normal_equations():
    """g_map^2 is twist' H twist, which the kernel computes."""
    tracker, volume, level = Tracker(CONFIG.tracker, SENSOR), corner_map(), level_of(corner())
    assert level.camera.width <= 80, "else not every pixel is sampled"
    T, step, weights = np.eye(4), 1e-4, ones(level)
    weights[[0, -1]] = weights[:, [0, -1]] = 0
    system = tracker.linearize(volume, level, T, weights)
    parameters = tracker.parameters(volume.band)
    for twist in np.random.default_rng(1).normal(size=(3, 6)):
        forth, back = (
            tracker.linearize(volume, level, se3.retract(T, way * twist), weights).residuals for way in (step, -step)
        )
        agreement = GradientAgreement(level, system.residuals, weights, np.eye(3), parameters)
        seen = (weights * agreement_mask(agreement, level)).astype(np.float32)
        H = tracker.linearize(volume, level, T, seen).H
        assert agreement.sums(twist, forth, back, step)[:, 0].sum() == pytest.approx(twist @ H @ twist, rel=0.02)


def agreement_mask(agreement, level):
    """Pixels (h, w) that are compared."""
    mask = np.zeros(level.depth.shape, bool)
    mask[1:-1, 1:-1] = agreement._valid
    return mask


def test_the_gradients_of_an_image_are_those_of_its_scene():
    """A tilted plane with linear intensities: distance and intensity change as the plane says."""
    camera = Camera(70.0, 72.0, 39.5, 29.5, 80, 60)
    rows, columns = np.mgrid[:60, :80]
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones((60, 80))], axis=-1)
    depth = 2 * TILTED[2] / (rays @ TILTED)
    points = rays * depth[..., None]
    level = Level(camera, depth.astype(np.float32), (0.5 + points @ SHADE).astype(np.float32))
    R = se3.exp_rotation(np.array([0.2, -0.4, 0.3]))
    parameters = Tracker(CONFIG.tracker, CONFIG.sensor).parameters(corner_map().band)
    agreement = GradientAgreement(level, np.zeros((2, 60, 80)), ones(level), R, parameters)
    # the intensity of a point is that of the plane where its ray meets it
    along_ray = SHADE - TILTED * np.sum(rays * SHADE, axis=-1, keepdims=True) / (rays @ TILTED)[..., None]
    for twist in np.random.default_rng(2).normal(size=(3, 6)):
        motion = twist[:3] + np.cross(twist[3:], points @ R.T)
        change = np.stack([motion @ R @ TILTED, np.sum((motion @ R) * along_ray, axis=-1)])
        sums = agreement.sums(twist, change, -change, 1.0)
        np.testing.assert_allclose(sums, np.repeat(sums[:, :1], 3, axis=1), rtol=0.01)
        assert agreement.along(twist, change, -change, 1.0) == pytest.approx(sums[1, 0] / sums[:, 0].sum(), rel=0.01)
