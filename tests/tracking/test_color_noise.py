"""Discount of the intensity residual while the camera moves."""

import numpy as np
import pytest

from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking.color_motion import motion_discount

CAMERA = Camera(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240)


def level(z):
    return Level(CAMERA, np.full(CAMERA.shape, z, np.float32), np.zeros(CAMERA.shape, np.float32))


def twist(speed=0.0):
    return np.array([speed, 0, 0, 0, 0, 0])


def test_a_camera_at_rest_and_one_without_readings_are_not_discounted():
    assert motion_discount(level(2.0), twist(), 0.009, 0.01) == 1.0
    assert motion_discount(level(0.0), twist(1.0), 0.009, 0.01) == 1.0
    assert motion_discount(level(2.0), twist(1.0), 0.0, 0.01) == 1.0


def test_a_displacement_by_half_a_pixel_halves_the_weight():
    # far away, where a pixel is coarser than a voxel: 0.5 px = 0.5 / 250 rad within 10 ms
    assert motion_discount(level(5.0), twist(speed=1.0), 0.01, 0.01) == pytest.approx(0.5)


def test_near_the_camera_half_a_voxel_counts():
    # at 1 m a voxel of 1 cm covers 2.5 pixels
    assert motion_discount(level(1.0), twist(speed=0.5), 0.01, 0.01) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "velocity",
    [(0, 0, 1, 0, 0, 0), (0.3, -0.2, 0.8, 0, 0, 0), (0, 0, 0, 0.2, 0.3, 1.5), (0.4, 0.1, 0.9, -0.1, 0.3, 0.2)],
)
def test_the_displacement_is_that_of_projected_points(velocity):
    velocity, dt = np.array(velocity, float), 1e-4
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rng = np.random.default_rng(1)
    z = rng.uniform(1, 5, CAMERA.shape)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(CAMERA.shape)], axis=-1)
    T = se3.inverse(se3.exp(velocity * dt))
    moved = (rays * z[..., None]) @ T[:3, :3].T + T[:3, 3]
    speed = np.linalg.norm(moved[..., :2] / moved[..., 2:] - rays[..., :2], axis=-1) / dt
    ratio = np.median(0.009 * speed / (0.5 * np.maximum(1 / CAMERA.fx, 0.01 / z)))
    view = Level(CAMERA, z.astype(np.float32), np.zeros(CAMERA.shape, np.float32))
    assert motion_discount(view, velocity, 0.009, 0.01) == pytest.approx(1 / (1 + ratio**2), rel=0.06)
