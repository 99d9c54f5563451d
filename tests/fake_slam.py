"""Fake of ``dudmap.core.slam.Slam`` with scripted results, for tests of the pipeline and the command line."""

from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.result import FrameResult, Status
from dudmap.core.shed import Shed
from dudmap.core.verdict import Outcome, Verdict
from recordings import HEIGHT, WIDTH

TRIANGLE = Mesh(
    np.eye(3, dtype=np.float32),
    np.array([[0, 1, 2]], np.int32),
    np.full((3, 3), 9, np.uint8),
    np.eye(3, dtype=np.float32),
)


def fake_result(timestamp, T_world_camera=None, reason="", name="", mask=None, share=0.0):
    """A frame tracked at a pose (4, 4) or lost, with a failed check."""
    return FrameResult(
        timestamp,
        Status.LOST if T_world_camera is None else Status.TRACKED,
        T_world_camera,
        None,
        Verdict((Outcome(name, 1.0, 0.0, reason),) if reason else ()),
        dynamic_mask=np.zeros((HEIGHT, WIDTH), bool) if mask is None else mask,
        dynamic_share=share,
        residuals=np.full((HEIGHT // 2, WIDTH // 2), 0.01, np.float32),
        timings={"track": 2.0},
    )


class FakeVolume:
    num_blocks, num_bytes, is_empty, pager = 3, 12345, False, None

    def save(self, path):
        path.write_bytes(b"map")

    def extract_mesh(self):
        return TRIANGLE


SECOND = 1000
"""Offset of the frame numbers of a second pass in the script."""


class FakeSlam:
    """Camera that moves 1 cm per frame along x; ``script`` maps frame numbers to events.

    An event is an exception to raise, ``"lost"`` or ``"similar"``.
    """

    script: ClassVar[dict] = {}
    shed = Shed.NOTHING

    saved_map = SimpleNamespace(save_keyframes=lambda path: path.write_bytes(b"keyframes"))

    def __init__(
        self,
        camera,
        config,
        first_pass=None,
        calibration=None,
        live=False,
        saved_map=None,
        localize=False,
        max_blocks=None,
        timed=True,
        ignore=None,
        poses="estimated",
    ):
        type(self).timed = timed
        self.localize = localize
        self.calibration = calibration or Calibration.registered(camera)
        self.volume, self.poses, self.frames, self.first_pass = FakeVolume(), [], [], first_pass
        self.device, self.calibration_waits = "cpu", 0

    @property
    def image_poses(self):
        return Trajectory.from_poses(self.poses)

    @property
    def trajectory(self):
        return self.image_poses.after(self.calibration.depth_late)

    @property
    def maps(self):
        return [(self.trajectory, self.volume)]

    def prepare(self, frame):
        return frame

    def finish(self):
        return 0

    def process(self, frame):
        index = len(self.frames)
        self.frames.append(frame)
        event = self.script.get(index if self.first_pass is None else index + SECOND)
        if isinstance(event, BaseException):
            raise event
        if event == "lost":
            return fake_result(frame.timestamp, reason="too few inliers", name="overlap")
        T = np.eye(4)
        T[0, 3] = 0.01 * index
        self.poses.append((frame.timestamp, T))
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[:24, :32] = True
        similar = ("the map has the content of the frame", "redundant") if event == "similar" else ("", "")
        return replace(fake_result(frame.timestamp, T, *similar, mask, 0.25), shed=self.shed)
