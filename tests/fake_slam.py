"""Fake of ``dudmap.core.slam.Slam`` with scripted results, for tests of the pipeline and the command line."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.verdict import ACCEPTED, Verdict
from recordings import HEIGHT, WIDTH

TRIANGLE = Mesh(
    np.eye(3, dtype=np.float32),
    np.array([[0, 1, 2]], np.int32),
    np.full((3, 3), 9, np.uint8),
    np.eye(3, dtype=np.float32),
)


@dataclass
class FakeResult:
    timestamp: float
    state: str = "tracked"
    lost_reason: str = ""
    T_world_camera: np.ndarray | None = None
    fused: bool = True
    skipped_similar: bool = False
    relocalized: bool = False
    corrected: bool = False
    blind: bool = False
    colorless: bool = False
    submap: int = 0
    uncertain: str = ""
    calibrated: bool = False
    rejected: str = ""
    repeats: str = ""
    verdict: Verdict = ACCEPTED
    unobservable: np.ndarray = field(default_factory=lambda: np.empty((0, 6)))
    dynamic_mask: np.ndarray = field(default_factory=lambda: np.zeros((HEIGHT, WIDTH), bool))
    dynamic_share: float = 0.0
    residuals: np.ndarray = field(default_factory=lambda: np.full((HEIGHT // 2, WIDTH // 2), 0.01, np.float32))
    labels: None = None
    tracking: None = None
    movers: tuple = ()
    timings: dict = field(default_factory=lambda: {"track": 2.0})


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
            return FakeResult(frame.timestamp, "lost", "too few inliers", fused=False)
        T = np.eye(4)
        T[0, 3] = 0.01 * index
        self.poses.append((frame.timestamp, T))
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[:24, :32] = True
        return FakeResult(
            frame.timestamp, T_world_camera=T, fused=event != "similar", skipped_similar=event == "similar",
            dynamic_mask=mask, dynamic_share=0.25,
        )  # fmt: skip
