"""Discount of the intensity residual while the camera moves."""

import numpy as np
import pytest

from dudmap.frames.observation import Level
from dudmap.geometry.camera import Camera
from dudmap.tracking.color_noise import motion_discount

CAMERA = Camera(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240)


def level(z):
    return Level(CAMERA, np.full(CAMERA.shape, z, np.float32), np.zeros(CAMERA.shape, np.float32))


def twist(speed=0.0, turn=0.0):
    return np.array([speed, 0, 0, 0, turn, 0])


def test_a_camera_at_rest_and_one_without_readings_are_not_discounted():
    assert motion_discount(level(2.0), twist(), 0.009, 0.01) == 1.0
    assert motion_discount(level(0.0), twist(1.0), 0.009, 0.01) == 1.0
    assert motion_discount(level(2.0), twist(1.0), 0.0, 0.01) == 1.0


def test_a_displacement_by_half_a_pixel_halves_the_weight():
    # far away, where a pixel is coarser than a voxel: 0.5 px = 0.5 / 250 rad within 10 ms
    assert motion_discount(level(5.0), twist(turn=0.2), 0.01, 0.01) == pytest.approx(0.5)
    assert motion_discount(level(5.0), twist(speed=1.0), 0.01, 0.01) == pytest.approx(0.5)


def test_near_the_camera_half_a_voxel_counts():
    # at 1 m a voxel of 1 cm covers 2.5 pixels
    assert motion_discount(level(1.0), twist(speed=0.5), 0.01, 0.01) == pytest.approx(0.5)
