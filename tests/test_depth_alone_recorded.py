"""Depth without colour from a live camera into a bag and out of it; views of its map are shaded."""

import time

import numpy as np
import pytest

from dudmap import Camera, Config, Frame, open_sequence, run, synthetic
from dudmap.app.views.rendering import render_run
from dudmap.io.cameras import CameraFrame, LiveCamera
from dudmap.io.exporting.run_content import RunContent

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
CONFIG = Config().override(["volume.voxel_size=0.03"])


class DepthCamera(LiveCamera):
    """A depth camera without a colour camera."""

    name, camera = "depth", CAMERA

    def __init__(self, frames):
        self.frames, self.number = frames, -1

    def read(self):
        self.number += 1
        if self.number >= len(self.frames):
            return None
        time.sleep(0.2)
        frame = self.frames[self.number]
        return CameraFrame(self.number, Frame(frame.timestamp, frame.depth), time.perf_counter())

    def preview(self, count):
        return []

    def close(self):
        """Nothing is open."""


def test_depth_alone_is_recorded_read_and_shaded(tmp_path):
    pytest.importorskip("rosbags")
    import cv2

    sequence = synthetic.sequence("desk", movers=(), frames=6, camera=CAMERA, camera_path="handheld")
    frames = [sequence[index] for index in range(6)]
    run(DepthCamera(frames), CONFIG, tmp_path / "live", progress=False, record=tmp_path / "live.mcap")
    recorded = open_sequence(tmp_path / "live.mcap")
    assert not recorded.has_color
    assert len(recorded) == 6
    for index, frame in enumerate(frames):
        assert recorded[index].color is None
        np.testing.assert_allclose(recorded[index].depth, frame.depth, atol=1e-3)
    assert recorded.camera.fx == CAMERA.fx
    report = run(recorded, CONFIG, tmp_path / "run", progress=False)
    assert report.metrics["colorless"] == report.metrics["tracked"] == 6
    content = RunContent.load(tmp_path / "run")
    render_run(content, content.trajectory, tmp_path / "view.png")
    view = cv2.imread(str(tmp_path / "view.png"))
    assert np.ptp(view, axis=2).max() == 0
    assert len(np.unique(view)) > 20
