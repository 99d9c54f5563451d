"""Masks at the size of a level of the image pyramid."""

import numpy as np

from dudmap.core.frames.observation import Level, is_majority_dynamic, reduced
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)


def level(halvings):
    camera = CAMERA.scaled(halvings)
    return Level(camera, np.ones(camera.shape, np.float32), np.zeros(camera.shape, np.float32))


def test_a_pixel_is_in_a_reduced_mask_if_any_part_of_it_is():
    mask = np.random.default_rng(1).random(CAMERA.shape) < 0.02
    for halvings in (0, 1, 2):
        side = 1 << halvings
        blocks = mask.reshape(CAMERA.height // side, side, CAMERA.width // side, side)
        np.testing.assert_array_equal(reduced(mask, level(halvings)), blocks.any(axis=(1, 3)))


def test_the_majority_is_one_of_the_readings():
    view, moving = level(2), np.zeros((30, 40), bool)
    moving[:, :12] = True
    assert not is_majority_dynamic(moving, view)
    view.depth[:, 20:] = 0
    assert is_majority_dynamic(moving, Level(view.camera, view.depth, view.intensity))
