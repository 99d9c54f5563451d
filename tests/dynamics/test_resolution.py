"""Labels and poses do not depend on the resolution of the labels or of the images.

One world, a room with a person in view from the first frame on, is rendered by cameras of several sizes that share the
vertical field of view, and compared in the part of the image they all show.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.dynamics.masks import full_size
from dudmap.core.dynamics.segments import MIN_PIXELS, REFERENCE_WIDTH
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from off_course import LIMIT, off_course

FRAMES = 14
FIRST = 5
"""First frame compared: the silhouette of a mover is complete once the map has seen the space around it."""
WIDTH, HEIGHT = 320, 240
"""Size of the images in which masks are compared."""
REFERENCE = 320, 240, 160
"""Image width and height, and label width, that the others are compared with."""


class Run(NamedTuple):
    """Masks (n, HEIGHT, WIDTH) bool, poses (n, 4, 4) and the size of a label pixel in an image of WIDTH."""

    masks: np.ndarray
    Ts_world_camera: np.ndarray
    label_pixel: float


@cache
def run(width: int, height: int, label_width: int) -> Run:
    f = 525 * height / 480
    camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
    sequence = synthetic.sequence(
        "room", movers=("person",), start_dynamic=True, frames=FRAMES, camera=camera, noise="none", seed=3
    )
    slam = Slam(camera, Config().override([f"dynamics.width={label_width}"]))
    results = [slam.process(sequence[index]) for index in range(FRAMES)]
    assert all(result.status == "tracked" for result in results)
    assert off_course(sequence.ground_truth.Ts_world_camera, [result.T_world_camera for result in results]) < LIMIT
    view = slice((width - height * 4 // 3) // 2, (width + height * 4 // 3) // 2)
    masks = [
        cv2.resize(result.dynamic_mask[:, view].astype(np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST) > 0
        for result in results
    ]
    assert results[-1]._labels is not None
    label_pixel = HEIGHT / results[-1]._labels.dynamic.shape[0]
    return Run(np.array(masks), np.array([result.T_world_camera for result in results]), label_pixel)


def away_from_contours(a: np.ndarray, b: np.ndarray, pixels: float) -> np.ndarray:
    """Pixels (h, w) that lie in one of two masks only, and farther than ``pixels`` from the contour of either."""
    near = np.zeros(a.shape, dtype=bool)
    for mask in (a, b):
        inside, outside = (cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 5) for m in (mask, ~mask))
        near |= np.maximum(inside, outside) <= pixels + 0.5  # distances are to pixel centres on the other side
    return (a ^ b) & ~near


def assert_agreement(width: int, height: int, label_width: int) -> None:
    """The masks differ by a pixel of the coarser labels along the contour, and by one segment too small for a decision
    of its own; the poses, each of which a young map gives to about a voxel, by two voxels, and by the angle of a pixel
    of the finest level that is registered."""
    reference, other = run(*REFERENCE), run(width, height, label_width)
    label_pixel = max(reference.label_pixel, other.label_pixel)
    too_small = MIN_PIXELS * (WIDTH / REFERENCE_WIDTH) ** 2
    for index in range(FIRST, FRAMES):
        a, b = reference.masks[index], other.masks[index]
        assert min(a.mean(), b.mean()) > 0.02  # the person is in view
        assert away_from_contours(a, b, label_pixel).sum() <= too_small, f"frame {index}"
    for T, T_other in zip(reference.Ts_world_camera, other.Ts_world_camera, strict=True):
        between = se3.inverse(T) @ T_other
        angle = np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))
        assert np.linalg.norm(between[:3, 3]) < 2 * Config().volume.voxel_size
        assert angle < 1 / 262.5


LATER = "346 pixels are decided a frame later; at seeds 4 to 6 at most 86"


@pytest.mark.parametrize("label_width", [pytest.param(80, marks=pytest.mark.xfail(strict=True, reason=LATER)), 320])
def test_results_do_not_depend_on_the_label_width(label_width):
    assert_agreement(320, 240, label_width)


@pytest.mark.parametrize(("width", "height"), [(848, 480), pytest.param(1280, 720, marks=pytest.mark.slow)])
def test_results_do_not_depend_on_the_image_size(width, height):
    assert_agreement(width, height, 160)


@pytest.mark.parametrize("shape", [(480, 848), (135, 241), (67, 120)])
def test_full_resolution_masks_of_odd_sizes_stay_in_place(shape):
    """A vertical edge: halvings round the width down, and the last columns take the label of the last label pixel."""
    halvings = 2
    depth = np.ones(shape, np.float32)
    low = np.zeros((shape[0] >> halvings, shape[1] >> halvings), bool)
    low[:, low.shape[1] // 2 :] = True
    full = full_size(low, np.ones(low.shape, np.float32), depth)
    assert full.shape == shape
    assert np.array_equal(full, np.broadcast_to(np.arange(shape[1]) >= low.shape[1] // 2 << halvings, shape))
