"""Depth without colour is tracked by its distances, fused and marked. Arrays that are no colour image are refused."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dudmap import Camera, Config, Frame, Slam, open_sequence, run, synthetic
from dudmap.app.pipeline.calibration import known_calibration
from dudmap.app.pipeline.inspection import inspect
from dudmap.core.frames.frame import GREY
from dudmap.core.frames.stream_check import repeated
from dudmap.errors import DatasetError, FrameError
from dudmap.evaluation.trajectory import ate
from dudmap.lab.synthetic.folder import write_folder

SMALL = ["volume.voxel_size=0.03", "similarity.max_translation=0"]
CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)


@pytest.fixture(scope="module")
def recording():
    """A camera in the hand in front of a desk, where all directions of motion show."""
    return synthetic.sequence("desk", movers=(), frames=24, camera=CAMERA, camera_path="handheld", noise="none")


@pytest.fixture(scope="module")
def folder(recording, tmp_path_factory):
    """The recording in TUM layout, of which rgb.txt and the colour images are gone."""
    path = tmp_path_factory.mktemp("depth") / "alone"
    write_folder(recording, path)
    for file in (path / "rgb").iterdir():
        file.unlink()
    (path / "rgb").rmdir()
    for name in ("rgb.txt", "associations.txt"):
        (path / name).unlink(missing_ok=True)
    return path


def test_depth_alone_gives_the_true_trajectory_and_a_grey_mesh(recording):
    slam = Slam(CAMERA, Config().override(SMALL))
    results = [
        slam.process(depth=frame.depth, timestamp=frame.timestamp) for frame in map(recording.__getitem__, range(24))
    ]
    assert [result.status for result in results] == ["tracked"] * 24
    assert not any(result.blind for result in results)
    assert sum(result.fused for result in results) >= 20
    assert ate(slam.trajectory, recording.ground_truth).rmse < 0.01
    mesh = slam.volume.extract_mesh()
    assert len(mesh.faces) > 1000
    assert np.mean(mesh.colors == GREY) > 0.95  # at rims a vertex lies beside a voxel without a colour
    assert np.all(mesh.colors == mesh.colors[:, :1])


def test_a_missing_image_in_a_map_with_colours_is_not_fused(recording):
    slam = Slam(CAMERA, Config().override(SMALL))
    for index in range(5):
        frame = recording[index]
        result = slam.process(frame if index < 4 else replace(frame, color=None))
    assert (result.status, result.blind, result.fused) == ("tracked", True, False)


def test_a_recording_of_depth_alone_is_run_and_marked(folder, tmp_path):
    recording = open_sequence(folder)
    assert not recording.has_color
    assert recording[3].color is None
    found = inspect(recording)
    assert not found.has_color
    assert found.color_rate is None
    assert [warning for warning in found.warnings if "colour" in warning] == [
        "there are no colour images: the camera is tracked by distances alone, and the mesh has no colours"
    ]
    config = Config().override(SMALL)
    report = run(recording, config, tmp_path / "run", progress=False, save_masks=True, calibrate=True)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["colorless"], metrics["blind"], metrics["tracked"]) == (24, 0, 24)
    assert report.metrics["ate_rmse_m"] < 0.01


def test_a_list_of_depth_beside_colour_images_is_not_read_as_depth_alone(folder, tmp_path):
    (tmp_path / "depth.txt").write_text((folder / "depth.txt").read_text())
    (tmp_path / "rgb").mkdir()
    with pytest.raises(Exception, match=r"rgb\.txt not found"):
        open_sequence(tmp_path)


def test_depth_that_repeats_without_colour_is_a_frame_that_repeats():
    depth = np.ones((4, 4), np.float32)
    assert repeated((depth, None), (depth.copy(), None)) == "frame"
    assert repeated((depth, None), (2 * depth, None)) == ""


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({"rgb": np.zeros((120, 160, 3), np.uint16)}, "16-bit values are depth, which needs no colour"),
        ({"rgb": np.zeros((120, 160), np.uint16)}, r"\(120, 160\) and the type uint16"),
        ({"rgb": [[0]]}, "rgb is a list; expected a NumPy array"),
        ({"depth": None}, "depth is a NoneType; expected a NumPy array"),
        ({"depth": [[1.0]]}, "depth is a list; expected a NumPy array"),
        ({"timestamp": np.nan}, "finite number of seconds"),
    ],
)
def test_what_is_no_image_is_refused_in_a_sentence(arrays, sentence):
    given = {"depth": np.ones((120, 160), np.float32), "timestamp": 0.0} | arrays
    with pytest.raises(FrameError, match=sentence):
        Slam(CAMERA).process(**given)
    with pytest.raises(FrameError, match=sentence):
        Frame.from_arrays(**given)


def test_frames_of_other_types_are_refused_in_a_sentence():
    for color in (np.zeros((120, 160, 3), np.uint16), [[0]]):
        with pytest.raises(FrameError, match=r"16-bit values are depth|list; expected a NumPy array"):
            Slam(CAMERA).process(Frame(0.0, np.ones((120, 160), np.float32), color))


def test_depth_of_either_byte_order_is_the_same():
    depth = np.arange(6, dtype=np.uint16).reshape(2, 3)
    for kind in (">u2", "<u2"):
        found = Frame.from_arrays(depth.astype(kind), timestamp=0)
        np.testing.assert_array_equal(found.depth, depth / np.float32(1000))
    found = Frame.from_arrays(np.ones((2, 3), ">f4"), timestamp=0).depth
    assert found.dtype == np.float32
    assert found.dtype.isnative


def test_a_depth_image_listed_as_colour_is_refused(recording, tmp_path):
    write_folder(recording, tmp_path / "wrong")
    lines = (tmp_path / "wrong" / "depth.txt").read_text().splitlines()
    (tmp_path / "wrong" / "rgb.txt").write_text("\n".join(lines))
    (tmp_path / "wrong" / "associations.txt").unlink(missing_ok=True)
    with pytest.raises(Exception, match="as depth images do; expected 8-bit"):
        open_sequence(tmp_path / "wrong")
    assert cv2.imread(str(next((tmp_path / "wrong" / "depth").iterdir())), cv2.IMREAD_UNCHANGED).dtype == np.uint16


def test_depth_alone_has_no_colour_camera_to_calibrate(folder):
    with pytest.raises(DatasetError, match="has no colour images: there is no colour camera to calibrate"):
        known_calibration(open_sequence(folder))
