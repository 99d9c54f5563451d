"""Intrinsics lie under many names; what is not there is asked for, and nothing is taken from another data set."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence
from layout_images import exr, write_color, write_depth
from layouts import bop, record3d, scannet, seven_scenes, tsdf_fusion, tum, with_matrices, write

MATRIX = np.array([[60.0, 0, 31.0], [0, 61.0, 23.0], [0, 0, 1]])
ROS_CALIBRATION = """image_width: 64
image_height: 48
camera_name: kinect
camera_matrix:
  rows: 3
  cols: 3
  data: [60.0, 0.0, 31.0, 0.0, 61.0, 23.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.0, 0.0, 0.05]
"""
ROS2_ECHO = """header:
  stamp:
    sec: 5
    nanosec: 7
  frame_id: camera
height: 48
width: 64
distortion_model: plumb_bob
d:
- 0.0
- 0.0
- 0.0
- 0.0
- 0.0
k:
- 60.0
- 0.0
- 31.0
- 0.0
- 61.0
- 23.0
- 0.0
- 0.0
- 1.0
"""


def intrinsics_of(sequence):
    camera = sequence.camera
    return camera.fx, camera.fy, camera.cx, camera.cy


@pytest.fixture
def folder(tmp_path):
    """A recording without intrinsics, in a folder of its own."""
    place, _ = write(with_matrices, tmp_path / "above")
    (place / "K.txt").unlink()
    return place


@pytest.mark.parametrize("place", ["in it", "one folder up"])
@pytest.mark.parametrize(
    "name", ["K.txt", "intrinsics.K.txt", "cam_K.txt", "camera-intrinsics.txt", "cam_K.npy", "calibration.yaml"]
)
def test_files_of_intrinsics(folder, name, place):
    file = (folder if place == "in it" else folder.parent) / name
    if name.endswith(".npy"):
        np.save(file, MATRIX)
    elif name.endswith(".yaml"):
        file.write_text(ROS_CALIBRATION)
    else:
        np.savetxt(file, MATRIX)
    sequence = open_sequence(folder)
    assert intrinsics_of(sequence) == (60, 61, 31, 23)
    assert name in sequence.sources["intrinsics"]
    assert sequence.sources["depth unit"].startswith("assumed")


def test_yaml_of_ros(folder):
    (folder / "calibration.yaml").write_text(ROS_CALIBRATION)
    assert open_sequence(folder).camera.distortion == (0.1, -0.2, 0.0, 0.0, 0.05)
    (folder / "calibration.yaml").unlink()
    (folder / "camera_info.yaml").write_text(ROS2_ECHO)
    assert intrinsics_of(open_sequence(folder)) == (60, 61, 31, 23)


@pytest.mark.parametrize("camera", ["Camera", "Camera1"])
def test_settings_of_orb_slam(folder, camera):
    lines = [
        "%YAML:1.0",
        "",
        f'{camera}.type: "PinHole"',
        f"{camera}.fx: 60.0",
        f"{camera}.fy: 61.0",
        f"{camera}.cx: 31.0",
    ]
    lines += [f"{camera}.cy: 23.0", f"{camera}.k1: 0.1", "Camera2.fx: 99.0", "Camera2.fy: 99.0", "Viewer.ViewpointX: 0"]
    (folder / "D435i.yaml").write_text("\n".join([*lines, "RGBD.DepthMapFactor: 2000.0", ""]))
    (folder / "other.yaml").write_text("fx: 7\n")
    sequence = open_sequence(folder)
    assert intrinsics_of(sequence) == (60, 61, 31, 23)
    assert sequence.camera.distortion == (0.1, 0, 0, 0, 0)
    assert sequence.camera.depth_scale == 2000
    assert sequence.sources["intrinsics"] == "D435i.yaml"


def test_a_lens_of_another_model_is_not_ignored(folder):
    fisheye = ROS_CALIBRATION.replace("plumb_bob", "equidistant")
    (folder / "calibration.yaml").write_text(fisheye)
    with pytest.raises(DatasetError, match=r"the lens .* of the model equidistant is not read.*--camera"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("60 0 31\n0 61 23\n0 0\n", r"K\.txt, line 3: 2 numbers, of 8 in the file; expected the 9"),
        ("60 0 31\n61 0 23\n0 0 1\n", r"K\.txt holds .*; expected the rows fx 0 cx, 0 fy cy, 0 0 1"),
        ("60 0 31\n0 six 23\n0 0 1\n", r"cannot understand .*K\.txt"),
    ],
)
def test_matrices_that_are_none(folder, text, sentence):
    (folder / "K.txt").write_text(text)
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(folder)


def test_without_intrinsics_the_files_seen_are_named(folder):
    with pytest.raises(
        DatasetError, match=r"is not known: neither .*K\.txt.* only depth/, images/, poses\.txt; give --camera"
    ):
        open_sequence(folder)


# -- a layout that data sets share -------------------------------------------------------------------------------------


def test_the_cameras_of_seven_scenes_need_its_name(tmp_path):
    named, _ = write(seven_scenes, tmp_path)
    assert open_sequence(named).calibration is not None
    other = shutil.copytree(named, tmp_path / "other" / "seq-01")
    with pytest.raises(DatasetError, match=r"3DMatch and others share.* only 3 x frame-N\.color\.png, .*give --camera"):
        open_sequence(other)
    scene = shutil.copytree(named, tmp_path / "other" / "redkitchen" / "seq-01")
    known = open_sequence(scene)
    assert known.format == "7-Scenes"
    assert "by name" in known.sources["intrinsics"]


def test_depth_camera_of_seven_scenes_as_3dmatch_packs_it(tmp_path):
    named, _ = write(seven_scenes, tmp_path)
    np.savetxt(named / "camera-intrinsics.txt", [[583.0, 0, 320], [0, 583, 240], [0, 0, 1]])
    sequence = open_sequence(named)
    assert (sequence.camera.fx, sequence.calibration.camera.fx) == (583, 525)


def test_a_given_camera_replaces_all(tmp_path):
    named, _ = write(seven_scenes, tmp_path)
    sequence = open_sequence(named, "615,615,298,247")
    assert sequence.camera.fx == 615
    assert sequence.calibration is None
    assert sequence.sources["intrinsics"] == "--camera 615,615,298,247"


def test_colour_of_another_size_keeps_its_camera(tmp_path):
    folder, expected = write(scannet, tmp_path)
    sequence = open_sequence(folder, "70,70,32,24")
    assert sequence.camera.fx == 70
    assert sequence.calibration.camera.fx == expected.color[0]
    assert "intrinsic_color.txt" in sequence.sources["intrinsics"]
    sequence[0]


def test_registered_depth_has_one_camera(tmp_path):
    folder, _ = write(tsdf_fusion, tmp_path)
    assert open_sequence(folder).calibration is None
    assert np.all(open_sequence(folder)[0].depth < 60)  # 65535 is no reading


# -- truth -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["12 numbers", "four lines", "a folder"])
def test_forms_of_poses(folder, form):
    np.savetxt(folder / "K.txt", MATRIX)
    expected = open_sequence(folder).ground_truth.Ts_world_camera
    file = folder / "poses.txt"
    if form == "12 numbers":
        np.savetxt(file, expected[:, :3].reshape(3, 12))
    elif form == "four lines":
        np.savetxt(file, expected.reshape(12, 4))
    else:
        file.unlink()
        (folder / "pose").mkdir()
        for k, T in enumerate(expected):
            np.savetxt(folder / f"pose/{k}.txt", T)
    np.testing.assert_allclose(open_sequence(folder).ground_truth.Ts_world_camera, expected, atol=1e-9)


def test_times_of_the_truth_are_not_those_of_numbered_images(folder):
    np.savetxt(folder / "K.txt", MATRIX)
    truth = open_sequence(folder, fps=5).ground_truth
    np.testing.assert_allclose(truth.timestamps, [0, 0.2, 0.4])
    (folder / "poses.txt").unlink()
    truth.save(folder / "groundtruth.txt")
    np.testing.assert_allclose(open_sequence(folder, fps=5).ground_truth.timestamps, [0, 0.2, 0.4])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda lines: lines[:2], r"poses\.txt, line 2: the last pose is number 2, but there are 3 frames"),
        (lambda lines: [*lines[:1], lines[1] + " 0", lines[2]], r"poses\.txt, line 2: 17 numbers; expected the 16"),
        (lambda lines: [], r"poses\.txt, line 1: 0 numbers; expected the 16"),
    ],
)
def test_poses_that_do_not_fit(folder, change, sentence):
    np.savetxt(folder / "K.txt", MATRIX)
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(change(lines)))
    sequence = open_sequence(folder)
    assert sequence.ground_truth is None
    assert re.search(sentence, sequence.remarks[0])


# -- BOP ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda tree: tree["1"].pop("cam_K"), r"scene_camera\.json lacks cam_K or depth_scale"),
        (lambda tree: tree.pop("2"), r"scene_camera\.json does not give the camera of every image"),
        (lambda tree: tree["1"]["cam_K"].__setitem__(2, 40.0), r"changes by up to 9 from image to image"),
    ],
)
def test_cameras_of_bop_that_cannot_be_used(tmp_path, change, sentence):
    folder, _ = write(bop, tmp_path)
    tree = json.loads((folder / "scene_camera.json").read_text())
    change(tree)
    (folder / "scene_camera.json").write_text(json.dumps(tree))
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(folder)


# -- unknown layouts ---------------------------------------------------------------------------------------------------


def test_patterns_of_a_layout_that_is_not_known(tmp_path):
    for k in range(3):
        write_color(tmp_path / f"cam/frames/{k}.png", k)
        gray = cv2.imread(str(tmp_path / f"cam/frames/{k}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"cam/frames/{k}.png"), gray)  # may be anything, unlike 8-bit colours
        write_depth(tmp_path / f"cam/range/{k}.png", k)
    np.savetxt(tmp_path / "cam/K.txt", MATRIX)
    with pytest.raises(DatasetError) as found:
        open_sequence(tmp_path / "cam")
    for part in (
        "in no known layout",
        "frames/N.png (3 with 8-bit intensities)",
        "range/N.png (3 with one channel of 16 bits or floats)",
        "--color",
        "--depth",
    ):
        assert part in str(found.value)
    assert len(open_sequence(tmp_path / "cam", color="frames/*", depth="range/*.png")) == 3
    assert len(open_sequence(tmp_path / "cam", color="frames/*")) == 3
    with pytest.raises(
        DatasetError, match=r"no numbered image in .* matches --depth rage/\*; there are .*frames/N\.png"
    ):
        open_sequence(tmp_path / "cam", color="frames/*", depth="rage/*")


def test_counts_that_differ_are_said_with_the_pairing(tmp_path):
    from dudmap.app.pipeline.inspection import inspect

    folder, _ = write(with_matrices, tmp_path)
    (folder / "poses.txt").unlink()
    assert inspect(open_sequence(folder)).warnings == []
    for k in (5, 6):
        write_color(folder / f"images/{k}.jpg", k)
    sequence = open_sequence(folder)
    assert sequence.sources["frames"] == "5 colour and 3 depth images, equal numbers"
    (warning,) = inspect(sequence).warnings
    assert warning.startswith("only 3 frames come of 5 colour and 3 depth images, equal numbers")


def test_implausible_depth_is_warned_of_with_the_unit_that_fits(tmp_path):
    from dudmap.app.pipeline.inspection import inspect

    folder, _ = write(tum, tmp_path)
    for file in (folder / "depth").iterdir():
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.where(depth > 0, 45000, 0).astype(np.uint16))  # 9 m at 5000 a metre
    (warning,) = inspect(open_sequence(folder)).warnings
    assert "the median depth is 9 m; 6553.5 or 10000 would be plausible: give --depth-unit 0.0001526, which" in warning
    assert inspect(open_sequence(folder, depth_unit=1e-4)).warnings == []


@pytest.mark.parametrize(("start", "warned"), [(1305031100.0, False), (1628069033.0, True), (0.0, False)])
def test_a_recording_that_borrows_the_name_of_tum(tmp_path, start, warned):
    from dudmap.app.pipeline.inspection import inspect

    folder, pairs = tmp_path / "rgbd_dataset_freiburg1_xyz", ""
    for k in range(3):
        stamp = f"{start + k / 30:.6f}"
        write_color(folder / f"rgb/{stamp}.png", k, 640, 480)
        write_depth(folder / f"depth/{stamp}.png", k, 5000, 640, 480)
        pairs += f"{stamp} rgb/{stamp}.png {stamp} depth/{stamp}.png\n"
    (folder / "associations.txt").write_text(pairs)
    said = [text for text in inspect(open_sequence(folder)).warnings if "taken after that data set" in text]
    assert len(said) == warned


def test_no_unit_is_asked_for_where_the_format_gives_it(tmp_path):
    from dudmap.app.pipeline.inspection import inspect

    folder, _ = write(record3d, tmp_path)
    for file in (folder / "depth").iterdir():
        file.write_bytes(exr({"R": np.full((48, 64), 0.04, np.float32)}))
    (warning,) = inspect(open_sequence(folder)).warnings
    assert warning == "nine tenths of the readings lie from 0.04 to 0.04 m, which depth cameras hardly measure"
    with pytest.raises(DatasetError, match=r"Record3D images, which has no --depth-unit"):
        open_sequence(folder, depth_unit=0.001)
