"""The RealSense camera on a recording of the driver's software device, and its models of lenses."""

import time

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import open_camera
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.intrinsics import Lens
from recordings import HEIGHT, WIDTH
from software_device import COLOR_WIDTH, T_COLOR_DEPTH, color, millimetres, record


def test_a_recording_played_through_the_driver(tmp_path):
    camera = open_camera(f"realsense:{record(tmp_path / 'walk.db3', frames=15)}")
    assert (camera.camera.fx, camera.camera.shape) == (60, (HEIGHT, WIDTH))
    assert (camera.calibration.camera.fx, camera.calibration.camera.shape) == (70, (HEIGHT, COLOR_WIDTH))
    np.testing.assert_allclose(camera.calibration.T_color_depth, T_COLOR_DEPTH, atol=1e-6)
    frames = list(iter(camera.read, None))
    camera.close()
    assert camera.read() is None
    assert len(frames) >= 5, "the driver leaves out frames without a partner, and may drop some"
    for arrived in frames:
        number = round((arrived.frame.timestamp - 10) * 30)
        assert arrived.number == number
        np.testing.assert_allclose(arrived.frame.depth, millimetres(number) / 1000, atol=1e-6)
        shown = round((arrived.frame.color_timestamp - 10.005) * 30)
        np.testing.assert_array_equal(arrived.frame.color, color(shown))
    assert np.all(np.diff([arrived.number for arrived in frames]) > 0), "no depth image comes twice"


def test_a_live_run_on_it(slam, tmp_path):
    camera = open_camera(f"realsense:{record(tmp_path / 'walk.db3', frames=20)}")
    file = tmp_path / "walk.mcap"
    start = slam.process

    def loading(self, frame):
        time.sleep(0.4 if len(self.frames) < 3 else 0)  # a recording does not go on while the kernels are loaded
        return start(self, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slam, "process", loading)
        metrics = run(camera, Config(), tmp_path / "out", record=file, progress=False).metrics
    assert metrics["sequence"] == "realsense"
    assert metrics["frames"] >= 2
    assert metrics["frames"] + metrics["dropped"] >= 8
    recorded, own = open_sequence(file), open_sequence(tmp_path / "walk.db3")
    assert len(recorded) >= 8
    assert set(np.round(recorded.timestamps, 5)) <= set(np.round(own.timestamps, 5))
    assert recorded.camera == own.camera
    np.testing.assert_allclose(recorded.calibration.T_color_depth, own.calibration.T_color_depth, atol=1e-6)


def test_a_file_that_is_none_is_one_sentence(tmp_path):
    pytest.importorskip("pyrealsense2", exc_type=ImportError)
    (tmp_path / "a.db3").write_bytes(b"nothing")
    with pytest.raises(CameraError, match="cannot be started"):
        open_camera(f"realsense:{tmp_path / 'a.db3'}")


@pytest.mark.parametrize("model", ["Inverse Brown Conrady", "inverse_brown_conrady"])
def test_the_inverse_lens_of_realsense(model):
    """librealsense: undistorted = distorted (1 + k1 r2 + k2 r4 + k3 r6) + tangential terms, all of the distorted."""
    camera = Camera(382, 381, 322, 239, 640, 480)
    inverse = (-0.055, 0.066, 0.0004, -0.0006, -0.021)  # the order of magnitude of a D455
    lens = Lens.of(camera, model, inverse)
    us, vs = np.meshgrid(np.arange(0, 640, 20.0), np.arange(0, 480, 20.0))
    x, y = (us.ravel() - camera.cx) / camera.fx, (vs.ravel() - camera.cy) / camera.fy
    k1, k2, p1, p2, k3 = inverse
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    ux = x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    uy = y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    points = np.stack([ux, uy, np.ones_like(ux)], 1)
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array(lens.camera.distortion))
    off = np.linalg.norm(seen[:, 0] - np.stack([us.ravel(), vs.ravel()], 1), axis=1)
    assert off.max() < 0.1
    assert np.abs(np.stack([ux - x, uy - y])).max() * 382 > 4, "without the model it is pixels off"


def test_a_fisheye_is_rectified():
    camera = Camera(150, 150, 159.5, 119.5, 320, 240)
    D = (0.05, -0.02, 0.01, -0.002)
    lens = Lens.of(camera, "kannala_brandt4", D)
    v, u = np.mgrid[:240, :320]
    image = np.stack([u / 2, v, (u + v) / 4], 2).astype(np.uint8)
    expected = cv2.fisheye.undistortImage(image, camera.K, np.array(D), Knew=camera.K)
    assert np.abs(lens.rectify(image, depth=False).astype(int) - expected).max() <= 1
    depth = np.where(np.indices((240, 320)).sum(0) % 2, 1, 3).astype(np.float32)
    assert set(np.unique(lens.rectify(depth, depth=True))) <= {0, 1, 3}, "depth is not mixed"
