"""Masks at the resolution of the image, from labels of a smaller one."""

import numpy as np

from dudmap.core.dynamics.masks import Labels, full_mask, full_size
from dudmap.core.frames.observation import Level
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import MapSample

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)


def scene() -> tuple[Level, np.ndarray, np.ndarray]:
    """A box at 1 m before a wall at 3 m with a gap of three pixels without readings around it, and a screen without
    readings: label image, depth (480, 640), and the box (480, 640)."""
    depth, box = np.full((480, 640), 3.0, np.float32), np.zeros((480, 640), bool)
    box[160:320, 240:400] = True
    depth[157:323, 237:403] = 0
    depth[box] = 1
    depth[40:120, 480:600] = 0
    low = depth[::4, ::4].copy()
    return Level(CAMERA.scaled(2), low, np.zeros_like(low)), depth, box


def labels(dynamic: np.ndarray, hidden: np.ndarray | None = None) -> Labels:
    nothing = np.zeros(dynamic.shape, np.float32)
    sample = MapSample(nothing, nothing, nothing.astype(np.uint8))
    return Labels(1 - dynamic.astype(np.float32), dynamic, None, np.zeros(1, np.int64), sample, hidden=hidden)


def test_readings_keep_their_labels_at_full_size():
    level, depth, box = scene()
    dynamic = level.depth == 1
    mask = full_mask(labels(dynamic), level, depth)
    assert mask[box].all()
    gap = np.zeros_like(box)
    gap[157:323, 237:403] = True
    assert not mask[~gap].any()
    np.testing.assert_array_equal(mask & (depth > 0), full_size(dynamic, level.depth, depth) & (depth > 0))


def test_what_gives_no_reading_belongs_to_the_nearer_of_the_hidden_and_the_static():
    level, depth, _ = scene()
    level.depth[20:100, 20:60] = depth[80:400, 80:240] = 0  # someone right before the camera
    hidden = np.zeros(level.depth.shape, bool)
    hidden[50:70, 35:45] = True
    mask = full_mask(labels(np.zeros_like(hidden), hidden), level, depth)
    assert mask[240, 4 * 29 : 4 * 51].all()  # 15 of 35 and 45 lies in the middle of the edge (20) and the seeds
    assert not mask[240, : 4 * 26].any()
    assert not mask[:, 4 * 62 :].any()  # the screen gives no reading either
    beside = np.zeros_like(hidden)
    beside[20:100, 60:80] = True  # what moves has no part in it: the hidden reach up to it
    level.depth[beside] = depth[80:400, 240:320] = 1
    assert full_mask(labels(beside, hidden), level, depth)[240, 4 * 29 : 4 * 64].all()


def test_nothing_moves_where_nothing_is_dynamic_or_hidden():
    level, depth, _ = scene()
    still = np.zeros(level.depth.shape, bool)
    assert not full_mask(labels(still, still), level, depth).any()
