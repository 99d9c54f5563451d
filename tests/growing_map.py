"""Stand-in of the SLAM system whose map grows: what the viewers need of it."""

import types

import numpy as np

from dudmap.app.pipeline.frame_source import FrameRead
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from fake_slam import fake_result
from run_folders import CAMERA
from wavy_wall import CAMERA as WALL_CAMERA
from wavy_wall import CONSTANT, wall

SIZE = 48, 64


def read(k=0):
    return FrameRead(Frame(float(k), np.ones(SIZE, np.float32), np.full((*SIZE, 3), k, np.uint8)), None, 1.0)


class GrowingMap:
    """A wall, seen again and again by a camera at rest."""

    def __init__(self):
        self.camera = Camera(**CAMERA)
        self.volume = TsdfVolume(WALL_CAMERA, CONSTANT.model_copy(update={"min_weight": 1}), depth_max=4.0)
        self.live_volume = self.volume
        self.trajectory = types.SimpleNamespace(timestamps=np.array([0.0]), Ts_world_camera=np.eye(4)[None])

    def step(self, k):
        self.volume.integrate(wall(1.5, k), np.eye(4))
        return fake_result(float(k), np.eye(4), mask=np.zeros(SIZE, bool))
