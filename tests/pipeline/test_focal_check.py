"""The focal length that frames are consistent with, on exact views of a patterned corner."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.image_checks import focal_error
from dudmap.app.pipeline.inspection import inspect
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
NORMALS = np.array([[0.75, 0.1, 0.65], [-0.65, 0.15, 0.75], [0.05, 0.8, 0.6]])
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
SHADES = np.random.default_rng(3).integers(30, 220, size=4096)


class Corner:
    """Views of three walls, patterned with tiles of 8 cm, from a camera that turns 1.2 degrees and moves per frame."""

    name, format, calibration, ground_truth = "corner", "rendered", None, None
    timestamps = np.arange(40) / 30.0

    def __init__(self, camera, source="K.txt"):
        self.camera, self.sources = camera, {"intrinsics": source}

    def __len__(self):
        return len(self.timestamps)

    def __getitem__(self, index):
        return self.view(index)

    @staticmethod
    @cache
    def view(index):
        R = cv2.Rodrigues(np.radians([0.5, 1.1, 0.0]) * (index - 20))[0]
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
        rays, t = rays @ R.T, np.array([0.008, 0.004, -0.01]) * (index - 20)
        away = (np.array([1.8, 1.9, 1.7]) - NORMALS @ t) / np.where(rays @ NORMALS.T > 1e-6, rays @ NORMALS.T, 1e-6)
        depth, wall = away.min(axis=-1), away.argmin(axis=-1)
        cells = np.floor((rays * depth[..., None] + t) / 0.08 + 0.01).astype(int)
        gray = SHADES[(cells @ [73, 179, 283] + 997 * wall) % len(SHADES)].astype(np.uint8)
        return Frame(index / 30, depth.astype(np.float32), np.repeat(gray[..., None], 3, axis=2))


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_the_factor_is_found(factor):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    assert focal_error(Corner(camera)) == pytest.approx(factor, rel=0.06)


def test_nothing_is_said_of_a_camera_that_does_not_turn():
    views = Corner(replace(CAMERA, fx=420, fy=420))
    still = views[20]
    views.__class__ = type("Still", (Corner,), {"__getitem__": lambda self, index: still})
    assert focal_error(views) is None


def test_a_camera_that_is_known_by_name_only_is_checked():
    wrong = replace(CAMERA, fx=420.0, fy=420.0)
    (warning,) = inspect(Corner(wrong, "the TUM freiburg1 camera, by name")).warnings
    assert warning.startswith("the focal length 420 is that of the TUM freiburg1 camera, by name, but pairs of frames")
    assert abs(float(warning.split("about ")[1].split(";")[0]) - 300) < 20
    assert inspect(Corner(CAMERA, "the TUM freiburg1 camera, by name")).warnings == []
    assert inspect(Corner(wrong)).warnings == []
