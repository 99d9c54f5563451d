"""A run finds the upward direction: a short scan with the camera upright, rolled by 90 degrees, and hung upside down.
Each is tried with and without measured gravity."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap import Camera, Config
from dudmap.app.pipeline.run import run
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.io.exporting.exporters import export_run
from dudmap.io.sequences.gravity import Gravity
from dudmap.lab.synthetic import sequence
from rendered import Rendered

CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
COARSE = Config().override(["volume.voxel_size=0.04", "sensor.self_calibration=false"])
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def room():
    return Rendered(sequence("room", (), frames=12, fps=6, seed=3, camera=CAMERA, camera_path="orbit"))


class Rolled(Rendered):
    """The recording of a camera that is rolled by quarters of a turn about its optical axis."""

    def __init__(self, recording, quarters, *, gravity):
        super().__init__(recording)
        self.quarters, self.recording = quarters, recording
        if quarters % 2:
            c = recording.camera
            self.camera = Camera(fx=c.fy, fy=c.fx, cx=c.cy, cy=c.width - 1 - c.cx, width=c.height, height=c.width)
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        truth = recording.ground_truth
        self.ground_truth = Trajectory(truth.timestamps, truth.Ts_world_camera @ T)
        if gravity:
            self.gravity = Gravity(truth.timestamps, UP @ self.ground_truth.Ts_world_camera[:, :3, :3], "/imu")

    def __getitem__(self, index):
        frame = self.recording[index]
        color, depth = (np.ascontiguousarray(np.rot90(image, self.quarters)) for image in (frame.color, frame.depth))
        return replace(frame, color=color, depth=depth)


def up_of(room, out, quarters, *, gravity):
    recording = Rolled(room, quarters, gravity=gravity)
    report = run(recording, COARSE, out, progress=False)
    true = recording.ground_truth.Ts_world_camera[0][:3, :3].T @ UP
    up = report.metrics["up"]
    return up, np.degrees(np.arccos(np.clip(np.dot(up["direction"], true), -1, 1)))


def test_upright(room, tmp_path, caplog):
    up, error = up_of(room, tmp_path, 0, gravity=False)
    assert (up["source"], up["contradiction"], up["gravity"]) == ("floor", None, None)
    assert error < 2
    assert up["sigma_deg"] < 5
    assert "upside" not in caplog.text


def test_upside_down_is_said(room, tmp_path, caplog):
    up, error = up_of(room, tmp_path, 2, gravity=False)
    assert error > 90
    assert "upside down" in up["contradiction"]
    assert up["contradiction"] in caplog.messages


@pytest.mark.parametrize("quarters", [0, 1, 2])
def test_gravity_decides(room, tmp_path, quarters):
    up, error = up_of(room, tmp_path / "run", quarters, gravity=True)
    assert up["source"] == "gravity"
    assert error < 2
    assert up["gravity"]["sigma_deg"] < 2
    export_run(tmp_path / "run", tmp_path / "map.yaml")
    assert "# up: gravity (gravity of /imu, 12 readings" in (tmp_path / "map.yaml").read_text()


def test_gravity_that_cannot_be_read_costs_no_run(room, tmp_path):
    class Damaged(Rendered):
        @property
        def gravity(self):
            raise DatasetError("odometry.csv is damaged")

    report = run(Damaged(room), COARSE, tmp_path, progress=False)
    assert report.metrics["up"]["source"] == "floor"
    assert report.metrics["up"]["contradiction"] == "gravity is not used: odometry.csv is damaged"
