"""Images of a rolling shutter, rectified to the time of their middle row, against rays cast row by row."""

import cv2
import numpy as np
import pytest

from dudmap.config import PreprocessConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.frames.rolling_shutter import recorded_mask, rectified, rectified_images
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
NORMAL, REACH = np.array([0.25, -0.2, 0.947]), 2.0
"""A slanted wall: the points X with NORMAL X = REACH, metres, camera frame in the middle of the readout."""
VELOCITIES = [(0.6, -0.3, 0.4, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.2, -1.5, 0.8), (0.3, 0.2, -0.2, -0.8, 1.0, 0.5)]
READOUT = 0.03


def cast(velocity: np.ndarray, readout: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of the wall, and the brightness of its pattern, every row at its own time."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    taus = readout * ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5)
    Ts = se3.exp_all(taus[:, None] * velocity)  # camera of the row into that of the middle
    turned = rays @ Ts[:, :3, :3].swapaxes(1, 2)
    depth = (REACH - Ts[:, None, :3, 3] @ NORMAL) / (turned @ NORMAL)
    X = Ts[:, None, :3, 3] + turned * depth[..., None]
    shade = 128 + 50 * np.sin(4 * X[..., 0] + 1) * np.cos(5 * X[..., 1])
    return depth.astype(np.float32), np.repeat(np.round(shade)[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("velocity", VELOCITIES)
@pytest.mark.parametrize("readout", [READOUT, -READOUT])
def test_a_rolling_shutter_is_rectified_to_what_a_global_one_sees(velocity, readout):
    velocity = np.array(velocity)
    (depth, color), (wanted, pattern) = cast(velocity, readout), cast(velocity, 0.0)
    found, shown, _ = rectified_images(depth, CAMERA, readout, velocity, color)
    inner = np.s_[30:-30, 30:-30]
    skew, left = np.abs(depth - wanted)[inner], np.abs(found - wanted)[inner]
    assert left.max() < 0.1 * skew.max()
    before, after = (np.abs(image.astype(float) - pattern)[inner] for image in (color, shown))
    assert after.max() <= 2
    assert after.mean() < 0.6 * before.mean()


def test_a_camera_at_rest_changes_nothing_and_holes_stay_holes():
    depth, color = cast(np.zeros(6), READOUT)
    depth[40:60, 50:70] = 0
    found, shown, sources = rectified_images(depth, CAMERA, READOUT, np.zeros(6), color)
    np.testing.assert_allclose(found, depth, rtol=1e-6)
    np.testing.assert_array_equal(shown, color)
    inner = sources[1:-1, 1:-1]
    np.testing.assert_array_equal(inner, np.arange(depth.size, dtype=np.int32).reshape(depth.shape)[1:-1, 1:-1])
    moving = rectified_images(depth, CAMERA, READOUT, np.array(VELOCITIES[1]))[0]
    assert 0 < np.count_nonzero(moving == 0) < 700


def test_the_mask_of_a_rectified_frame_lies_where_its_pixels_were_recorded():
    velocity = np.array(VELOCITIES[1])
    depth, color = cast(velocity, READOUT)
    observation = Preprocessor(CAMERA, PreprocessConfig(filter="none", fill_holes=False))(Frame(0.0, depth, color))
    straight = rectified(observation, READOUT, velocity, with_color=True)
    mask = np.zeros(depth.shape, bool)
    mask[:, 100:200] = True
    mask[150:] = False
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    X = np.stack([(u - CAMERA.cx) / CAMERA.fx * depth, (v - CAMERA.cy) / CAMERA.fy * depth, depth], -1)
    Ts = se3.exp_all((READOUT * ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5))[:, None] * velocity)
    X = X @ Ts[:, :3, :3].swapaxes(1, 2) + Ts[:, None, :3, 3]
    to_u, to_v = X[..., 0] / X[..., 2] * CAMERA.fx + CAMERA.cx, X[..., 1] / X[..., 2] * CAMERA.fy + CAMERA.cy
    wanted = (to_u >= 100) & (to_u < 200) & (to_v < 150)
    found = recorded_mask(mask, straight)
    edge = cv2.dilate(wanted.astype(np.uint8), np.ones((5, 5))) != cv2.erode(wanted.astype(np.uint8), np.ones((5, 5)))
    assert not np.any((found != wanted) & ~edge)
    assert np.any((mask != wanted) & ~edge)
    assert recorded_mask(mask, observation) is mask
