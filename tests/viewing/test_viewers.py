"""The viewers show what the run gives, never hold it up for long, and say in one sentence why they cannot start."""

import socket
import sys
import threading
import types

import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.viewing.live_view import LiveView
from dudmap.app.viewing.mesh_feed import MeshFeed
from dudmap.app.viewing.snapshot import RESIDUAL_RANGE, FrameImages, depth_colors, mask_overlay, residual_colors
from dudmap.app.viewing.window import Window
from dudmap.cli import app
from dudmap.core.frames.frame import Frame
from dudmap.errors import DudmapError
from fake_slam import fake_result
from growing_map import GrowingMap, read
from recordings import write_recording
from run_folders import write_run


class Recorder:
    """A window that notes what it is told."""

    def __init__(self):
        self.frames, self.images, self.parts, self.poses, self.cleared = [], [], {}, None, 0
        self.show_change = lambda change: self.changes.append(change)
        self.changes = []
        self.gate = threading.Event()
        self.gate.set()

    def set_camera(self, camera):
        self.camera = camera

    def clear(self):
        self.frames.clear()
        self.cleared += 1

    def show_mesh(self, changes):
        self.gate.wait()
        if changes.reset:
            self.parts.clear()
        self.parts |= changes.chunks

    def add_frames(self, frames, poses=None):
        self.frames += frames
        self.poses = poses or self.poses

    def add_images(self, timestamp, pictures):
        self.images.append((timestamp, pictures))


def test_a_live_view_shows_every_frame_and_the_whole_map(tmp_path):
    window, slam = Recorder(), GrowingMap()
    view = LiveView(window)
    view.start(slam, tmp_path, 20)
    for k in range(20):
        view.frame(k, read(k), slam.step(k), 12.0)
    change = {"id": 1, "kind": "appeared", "box": [[0, 0, 1], [0.2, 0.2, 1.2]]}
    view.event("change", **change)
    view.event("calibration", estimated=[])
    view.finish(tmp_path)
    view.close()
    assert window.changes == [change]
    assert [frame.timestamp for frame in window.frames] == list(range(20))
    assert window.cleared == 1
    area = sum(mesh.area() for mesh in window.parts.values() if mesh is not None)
    assert area == pytest.approx(slam.volume.extract_mesh().area(), rel=1e-6)
    assert set(window.poses) == {0.0}
    assert len(view.costs) == 20


def test_a_page_that_is_slow_does_not_hold_up_the_run(tmp_path):
    window, slam = Recorder(), GrowingMap()
    view = LiveView(window)
    view.start(slam, tmp_path, 50)
    window.gate.clear()  # the page hangs
    for k in range(50):
        view.frame(k, read(k), slam.step(k), 12.0)
    assert len(window.frames) < 50
    window.gate.set()
    view.close()
    assert len(window.frames) == 50
    assert window.images[-1][0] == 49
    assert len(window.images) < 50  # images that nobody looked at were replaced


def test_an_error_of_the_page_is_raised_at_the_end(tmp_path):
    window, slam = Recorder(), GrowingMap()
    window.add_frames = lambda *_: 1 / 0
    view = LiveView(window)
    view.start(slam, tmp_path, 3)
    for k in range(3):
        view.frame(k, read(k), slam.step(k), 12.0)
    view._thread.join()
    view.finish(tmp_path)
    with pytest.raises(ZeroDivisionError):
        view.close()


def test_the_feed_hands_over_no_more_often_than_its_budget_allows():
    slam, feed = GrowingMap(), MeshFeed(1.0)
    copies = 0
    for k in range(30):
        slam.step(k)
        feed.offer(slam.volume)
        feed._cost = 10.0  # as if every copy had taken 10 ms
        copies += feed.has_copy
        if feed.has_copy:
            assert feed.take().reset == (copies == 1)
    assert copies == 3
    assert not feed.take().chunks


def test_a_new_map_replaces_the_old_one():
    first, second, feed = GrowingMap(), GrowingMap(), MeshFeed()
    first.step(0)
    assert feed.changes(first.volume, now=True).reset
    second.step(0)
    changes = feed.changes(second.volume, now=True)
    assert changes.reset
    assert any(mesh is not None for mesh in changes.chunks.values())


def test_the_colours_of_the_images():
    assert (depth_colors(np.zeros((2, 2))) == 40).all()
    near, far = depth_colors(np.array([[0.5, 4.5]]))[0]
    assert near[2] > near[0]  # turbo: blue is near, red is far
    assert far[0] > far[2]
    red, white, blue, off = residual_colors(np.array([[RESIDUAL_RANGE, 0, -RESIDUAL_RANGE, np.nan]]))[0].astype(int)
    assert red[0] > 2 * red[2]
    assert (white == 255).all()
    assert blue[2] > 2 * blue[0]
    assert (off == 40).all()
    color = np.full((1, 2, 3), 255, np.uint8)
    np.testing.assert_array_equal(mask_overlay(color, np.array([[True, False]])), [[[254, 127, 127], [127, 127, 127]]])


def test_images_are_reduced_to_a_width():
    frame = Frame(0.0, np.ones((480, 640), np.float32), np.zeros((480, 640, 3), np.uint8))
    images = FrameImages.of(frame, fake_result(0.0, mask=np.zeros((480, 640), bool)))
    assert images.color.shape == (240, 320, 3)
    assert images.mask.shape == images.depth.shape == (240, 320)


# -- what is missing ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("package", "arguments", "extra"),
    [("viser", ["--view"], ".[view]"), ("rerun", ["--rerun", "log.rrd"], ".[rerun]")],
)
def test_a_missing_extra_is_named(slam, tmp_path, monkeypatch, package, arguments, extra):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    done = CliRunner().invoke(app, ["run", str(write_recording(tmp_path / "desk", 3)), *arguments])
    assert done.exit_code == 1
    assert f'pip install "{extra}" in the folder' in done.stderr
    assert not (tmp_path / "runs").exists()


def test_a_port_in_use_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", types.ModuleType("viser"))
    folder = write_run(tmp_path / "run")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DudmapError, match=f"cannot show a page at 127.0.0.1:{port} .*; name another --port"):
            Window("127.0.0.1", port, "test")
        done = CliRunner().invoke(app, ["view", str(folder), "--port", str(port)])
    assert done.exit_code == 1
    assert len(done.stderr.strip().splitlines()) == 1
