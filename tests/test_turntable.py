"""An object that turns before a still camera at 0.25 m: with nothing else in view it is the world, else it moves."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.result import FrameResult
from dudmap.core.slam import Slam
from dudmap.lab.synthetic.movers import rigid
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.scene import Material, Scene, box, cylinder, ellipsoid, look_at, pose

SIZE = 0.2
"""The world is rendered five times as large, with the noise of a camera for rooms."""
RATE = 30.0
"""Degrees per second."""
COUNT = 45
CAMERA = Camera(fx=131.0, fy=131.0, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)
THING = [
    box((0, 0, 0.15), (0.36, 0.22, 0.3), Material("books", (3, 3)), yaw=20),
    cylinder((0.05, 0.03, 0.3), (0.05, 0.03, 0.48), 0.09, Material("plaid", (5, 5))),
    ellipsoid((-0.1, 0.02, 0.36), (0.07, 0.06, 0.08), Material("poster", (1.6, 1.6))),
    cylinder((0, 0, -0.03), (0, 0, 0), 0.4, Material("checks", (2, 2))),
]
AROUND = [
    box((0, 0, -0.08), (3, 3, 0.1), Material("wood", (1.5, 1.5))),
    box((0, 1.6, 0.6), (4, 0.1, 2), Material("wallpaper", (1, 1))),
]
FAR_AWAY = [box((0, 0, -60), (0.1, 0.1, 0.1), Material("wood"))]


def turning(static) -> list[FrameResult]:
    """Results of the frames of the thing that turns in a static scene."""
    times, T = np.arange(COUNT) / 30, look_at((0, -1.25, 0.6), (0, 0, 0.18))
    corners = ((-3.0, -3.0, -1.0), (3.0, 3.0, 3.0))
    scene = Scene("table", static, T, (0, 0, 0.18), corners, corners, ((-1, 0), (1, 0)), pose(), pose())
    thing = rigid("thing", THING, lambda t: pose(yaw=RATE * t))
    truth = Trajectory(times, np.stack([T] * COUNT))
    sequence = SyntheticSequence(scene, [thing], truth, CAMERA, noise="kinect", seed=3, fps=30)
    slam = Slam(CAMERA, Config.for_range("near"))
    frames = [sequence[number] for number in range(COUNT)]
    return [slam.process(replace(frame, depth=frame.depth * np.float32(SIZE))) for frame in frames]


@pytest.mark.parametrize(("static", "turned"), [(FAR_AWAY, RATE * (COUNT - 1) / 30), (AROUND, 0.0)])
def test_the_camera_moves_relative_to_what_else_is_in_view(static, turned):
    results = turning(static)
    assert [result.status for result in results] == ["tracked"] * COUNT
    first, last = results[0].T_world_camera, results[-1].T_world_camera
    assert first is not None
    assert last is not None
    assert np.degrees(se3.rotation_angle(se3.inverse(first) @ last)) == pytest.approx(turned, abs=1.5)
