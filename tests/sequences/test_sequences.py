"""TUM-style recordings: what is read, and one sentence for everything that cannot be."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from dudmap.core.geometry.association import associate
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import Sequence, open_sequence
from dudmap.io.sequences.tum import TumSequence
from recordings import HEIGHT, WIDTH, color_image, cut, depth_image, write_recording

EXCERPT = Path(__file__).parents[1] / "fixtures" / "freiburg1_xyz"


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "desk")


def replace_line(path, number, text):
    lines = path.read_text().splitlines()
    lines[number] = text
    path.write_text("\n".join(lines) + "\n")


# -- what is read -----------------------------------------------------------------------------------------------------


def test_frames_come_in_metres_and_rgb_at_the_depth_time(recording):
    sequence = open_sequence(recording)
    assert isinstance(sequence, Sequence)
    assert sequence.name == "desk"
    assert len(sequence) == 5
    np.testing.assert_allclose(sequence.timestamps, 100 + 0.1 * np.arange(5))
    frame = sequence[3]
    assert frame.timestamp == sequence.timestamps[3]
    assert frame.depth.dtype == np.float32
    assert frame.color.dtype == np.uint8
    np.testing.assert_allclose(frame.depth, depth_image(3) / 5000, rtol=1e-6)
    np.testing.assert_array_equal(frame.color, color_image(3))
    assert sequence.ground_truth is None
    assert sequence.mask(0) is None


def test_the_excerpt_of_a_real_recording():
    sequence = open_sequence(EXCERPT)
    assert sequence.camera == Camera(517.3, 516.5, 318.6, 255.3, 640, 480, 5000.0)
    assert len(sequence) == 12
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.timestamps[0] < sequence.timestamps[0]
    assert sequence.ground_truth.timestamps[-1] > sequence.timestamps[-1]
    for index in range(12):
        frame = sequence[index]
        readings = frame.depth[frame.depth > 0]
        assert 0.5 < np.median(readings) < 2.5
        assert len(readings) > 0.5 * frame.depth.size
        assert frame.color.mean() > 40


def test_depth_scale_and_size_of_the_file_are_used(tmp_path):
    keys = f"fx 60\nfy 61\ncx 31.5\ncy 23.5\nwidth {WIDTH}\nheight {HEIGHT}\ndepth_scale 1000 # mm\n# note\nk1 0.1\n"
    sequence = open_sequence(write_recording(tmp_path / "a", 2, intrinsics=keys))
    assert sequence.camera == Camera(60, 61, 31.5, 23.5, WIDTH, HEIGHT, 1000.0, (0.1, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(sequence[0].depth, depth_image(0) / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    "text", ["60 0 31.5\n0 61 23.5\n0 0 1\n", "60, 61, 31.5, 23.5\n", "fx: 60\nfy: 61\ncx=31.5\ncy=23.5"]
)
def test_other_forms_of_intrinsics(tmp_path, text):
    sequence = open_sequence(write_recording(tmp_path / "a", 1, intrinsics=text))
    assert sequence.camera == Camera(60, 61, 31.5, 23.5, WIDTH, HEIGHT, 5000.0)


def test_known_cameras_by_folder_name(tmp_path):
    for name, fx in [("rgbd_dataset_freiburg2_desk", 520.9), ("fr3_walking", 535.4), ("rgbd_bonn_crowd", 542.822841)]:
        folder = write_recording(tmp_path / name, 1, intrinsics=None)
        cv2.imwrite(str(folder / "rgb/0.png"), np.full((480, 640, 3), 90, np.uint8))
        cv2.imwrite(str(folder / "depth/0.png"), np.full((480, 640), 5000, np.uint16))
        assert open_sequence(folder).camera.fx == fx


def test_a_renamed_folder_keeps_its_camera_by_the_header_of_its_list(tmp_path):
    folder = write_recording(tmp_path / "data", 1, intrinsics=None)
    for images, value in (("rgb", np.full((480, 640, 3), 90, np.uint8)), ("depth", np.full((480, 640), 1, np.uint16))):
        cv2.imwrite(str(folder / images / "0.png"), value)
    header = "# color images\n# file: 'rgbd_dataset_freiburg3_sitting_xyz.bag'\n# timestamp filename\n"
    lines = (folder / "rgb.txt").read_text()
    (folder / "rgb.txt").write_text(header + lines)
    assert open_sequence(folder).camera.fx == 535.4
    (folder / "rgb.txt").write_text(lines + header)
    with pytest.raises(DatasetError, match="is not known"):
        open_sequence(folder)


def test_a_known_camera_does_not_fit_images_of_another_size(tmp_path):
    folder = write_recording(tmp_path / "fr1_small", 1, intrinsics=None)
    with pytest.raises(DatasetError, match=r"TUM freiburg1 camera.* is for images of 640x480 pixels.*64x48.*--camera"):
        open_sequence(folder)
    with pytest.raises(DatasetError, match=r"of 128x96 .*--camera 50,51,31.5,23.5,64,48,1000 if they show the same"):
        open_sequence(folder, "100,102,63.5,47.5,128,96,1000")
    with pytest.raises(DatasetError, match=r"of 128x72 .*--camera fx,fy,cx,cy,w,h,depth_scale$"):
        open_sequence(folder, "100,102,63.5,35.5,128,72,1000")
    with pytest.raises(DatasetError, match=r"0x0; at least 16x16 pixels"):
        open_sequence(folder, "100,102,63.5,35.5,0,0")


def test_camera_argument_wins(recording):
    assert open_sequence(recording, "70,71,30,20").camera == Camera(70, 71, 30, 20, WIDTH, HEIGHT, 5000.0)
    assert open_sequence(recording, "70,71,30,20,64,48,1000").camera.depth_scale == 1000
    camera = Camera(70, 71, 30, 20, WIDTH, HEIGHT, 2000.0, (0.1, 0.2, 0.0, 0.0, 0.3))
    assert open_sequence(recording, camera).camera == camera
    for wrong in ("70,71,30", "a,b,c,d", ""):
        with pytest.raises(DatasetError, match="expected fx,fy,cx,cy"):
            open_sequence(recording, wrong)


def test_associations_are_used_where_given(recording):
    (recording / "associations.txt").write_text(
        "100.3 rgb/3.png 100.1 depth/1.png\n100.4 rgb/4.png 100.2 depth/2.png\n"
    )
    sequence = open_sequence(recording)
    np.testing.assert_allclose(sequence.timestamps, [100.1, 100.2])
    np.testing.assert_array_equal(sequence[0].color, color_image(3))
    np.testing.assert_allclose(sequence[0].depth, depth_image(1) / 5000, rtol=1e-6)


def test_associations_alone_and_depth_first(recording):
    (recording / "associations.txt").write_text("100.1 depth/1.png 100.3 rgb/3.png\n")
    (recording / "rgb.txt").unlink()
    (recording / "depth.txt").unlink()
    sequence = open_sequence(recording)
    np.testing.assert_allclose(sequence.timestamps, [100.1])
    np.testing.assert_array_equal(sequence[0].color, color_image(3))


def test_masks_go_by_the_colour_time(recording):
    (recording / "mask").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20] = 255
    cv2.imwrite(str(recording / "mask/2.png"), mask)
    (recording / "mask.txt").write_text("100.204 mask/2.png\n")
    sequence = open_sequence(recording)
    assert sequence.mask(1) is None
    np.testing.assert_array_equal(sequence.mask(2), mask > 0)


def test_ground_truth_is_read(recording):
    (recording / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 1\n100.2 1 2 3 0 0 0 1\n")
    np.testing.assert_allclose(open_sequence(recording).ground_truth.Ts_world_camera[1, :3, 3], [1, 2, 3])


def test_float_depth_is_in_metres(recording):
    metres = (depth_image() / 5000).astype(np.float32)
    metres[0, 0], metres[0, 1] = np.nan, np.inf
    for index in range(5):
        cv2.imwrite(str(recording / f"depth/{index}.tiff"), metres)
    (recording / "depth.txt").write_text("".join(f"{100 + 0.1 * k} depth/{k}.tiff\n" for k in range(5)))
    depth = open_sequence(recording)[1].depth
    assert depth[0, 0] == depth[0, 1] == 0
    np.testing.assert_array_equal(depth[1:], metres[1:])


def test_association_is_one_to_one_nearest_first():
    first = np.array([0.0, 0.010, 0.100, 0.500])
    second = np.array([0.004, 0.011, 0.119, 0.530])
    # 0.010-0.011 is the closest pair, then 0.000-0.004, then 0.100-0.119; 0.5 and 0.53 are too far apart.
    assert associate(first, second) == [(0, 0), (1, 1), (2, 2)]
    assert associate(np.array([0.0, 0.01]), np.array([0.009])) == [(1, 0)]


def test_association_agrees_with_all_pairs():
    rng = np.random.default_rng(3)
    for _ in range(20):
        first, second = (np.sort(rng.uniform(0, 2, rng.integers(1, 60))) for _ in range(2))
        pairs = sorted(
            (abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) <= 0.02
        )
        expected, left, right = [], set(range(len(first))), set(range(len(second)))
        for _, i, j in pairs:
            if i in left and j in right:
                left.remove(i)
                right.remove(j)
                expected.append((i, j))
        assert associate(first, second) == sorted(expected, key=lambda pair: pair[1])


# -- what cannot be read ----------------------------------------------------------------------------------------------


def test_missing_empty_or_other_folders(tmp_path):
    with pytest.raises(DatasetError, match="there is no folder or file"):
        open_sequence(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="is empty"):
        open_sequence(tmp_path)
    (tmp_path / "rgb.txt").write_text("0 a.png\n")
    with pytest.raises(DatasetError, match=r"not a recording in TUM layout: depth\.txt not found"):
        open_sequence(tmp_path)
    with pytest.raises(DatasetError, match=r"is a file in no known format; dudmap reads .*TUM RGB-D"):
        open_sequence(tmp_path / "rgb.txt")


def test_an_option_of_another_format(recording):
    with pytest.raises(DatasetError, match="in the format TUM RGB-D, which has no --topics"):
        open_sequence(recording, topics=["/camera"])
    assert len(open_sequence(recording, topics=None)) == 5


def test_unknown_camera(tmp_path):
    with pytest.raises(
        DatasetError, match=r"neither intrinsics\.txt.* only depth/, depth\.txt, rgb/, rgb\.txt; give --"
    ):
        open_sequence(write_recording(tmp_path / "desk", intrinsics=None))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fx 60\nfy 60\ncx 31.5\n", "lacks cy"),
        ("fx 60\nfz 60\n", "cannot understand the line 'fz 60'"),
        ("fx 60\nfy abc\n", "cannot understand the line 'fy abc'"),
        ("60 60 31\n", r"intrinsics\.txt, line 1: 3 numbers, of 3 in the file; expected the 9"),
        ("", "expected the 9 of a 3x3 matrix K"),
        ("fx 60\nfy -60\ncx 31.5\ncy 23.5\n", "positive finite"),
        ("fx 60\nfy nan\ncx 31.5\ncy 23.5\n", "cannot understand the line 'fy nan'"),
        (
            "fx 60\nfy 60\ncx 31.5\ncy 23.5\nwidth 640\nheight 480\n",
            "640x480 pixels, but the recording's depth images are 64x48",
        ),
    ],
)
def test_intrinsics_that_cannot_be_used(tmp_path, text, sentence):
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(write_recording(tmp_path / "a", intrinsics=text))


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("nan depth/2.png", r"depth\.txt, line 4: the timestamp 'nan' is not a finite number"),
        ("inf depth/2.png", "not a finite number"),
        ("abc depth/2.png", "not a finite number"),
        ("100.05 depth/2.png", r"line 4: the timestamp 100\.050000 comes after 100\.100000"),
        ("100.1 depth/2.png", "comes after"),
        ("100.2", "expected 'timestamp file', found '100.2'"),
    ],
)
def test_bad_lines_in_a_list(recording, line, sentence):
    replace_line(recording / "depth.txt", 3, line)
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(recording)


def test_bad_associations(recording):
    (recording / "associations.txt").write_text(
        "100.1 rgb/1.png 100.1 depth/1.png\n100.0 rgb/0.png 100.0 depth/0.png\n"
    )
    with pytest.raises(DatasetError, match=r"associations\.txt, line 2: the timestamp 100\.000000 comes after"):
        open_sequence(recording)
    (recording / "associations.txt").write_text("100.1 rgb/1.png\n")
    with pytest.raises(DatasetError, match="expected 't_rgb rgb_file t_depth depth_file'"):
        open_sequence(recording)


def test_an_empty_list(recording):
    (recording / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(DatasetError, match=r"rgb\.txt lists nothing"):
        open_sequence(recording)


def test_no_matching_times(tmp_path):
    with pytest.raises(DatasetError, match=r"no colour image lies within 20 ms.*100\.050 to 100\.450.*100\.000 to"):
        open_sequence(write_recording(tmp_path / "a", rgb_shift=0.05))


def test_a_single_bad_frame_is_the_frames_matter(recording):
    cut(recording / "depth/1.png")
    cut(recording / "rgb/2.png")
    (recording / "depth/3.png").unlink()
    cv2.imwrite(str(recording / "depth/4.png"), np.full((HEIGHT * 2, WIDTH * 2), 5000, np.uint16))
    sequence = open_sequence(recording)
    assert sequence[0].depth.any()
    with pytest.raises(FrameError, match=r"frame 1: .*depth/1\.png is cut off"):
        sequence[1]
    with pytest.raises(FrameError, match=r"frame 2: .*rgb/2\.png is cut off"):
        sequence[2]
    with pytest.raises(FrameError, match=r"frame 3: .*depth/3\.png does not exist"):
        sequence[3]
    with pytest.raises(FrameError, match=r"frame 4: .* is 64x48 pixels but the depth image .* is 128x96"):
        sequence[4]


def test_a_cut_or_damaged_file_never_reaches_the_decoder(recording, capfd):
    jpeg = cv2.imencode(".jpg", color_image())[1].tobytes()
    (recording / "rgb/0.png").write_bytes(jpeg[:-40])
    data = bytearray((recording / "depth/1.png").read_bytes())
    data[60] ^= 0xFF
    (recording / "depth/1.png").write_bytes(bytes(data))
    (recording / "depth/2.png").write_bytes(b"")
    (recording / "depth/3.png").write_bytes(b"hello")
    sequence = open_sequence(recording)
    for index, sentence in enumerate(["JPEG end marker", "checksum", "empty file", "not an image"]):
        with pytest.raises(FrameError, match=sentence):
            sequence[index]
    assert sequence[4].depth.any()
    assert capfd.readouterr().err == ""


def test_a_smaller_frame_in_the_middle(recording):
    for kind, image in (("rgb", color_image()), ("depth", depth_image())):
        cv2.imwrite(str(recording / f"{kind}/2.png"), image[::2, ::2])
    with pytest.raises(FrameError, match=r"frame 2: .* is 32x24 pixels, but the recording's camera is 64x48"):
        open_sequence(recording)[2]


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        (np.full((HEIGHT, WIDTH), 200, np.uint8), "holds uint8 values; expected 16 bit or float"),
        (np.full((HEIGHT, WIDTH, 3), 200, np.uint16), "has 3 channels"),
        (np.full((HEIGHT // 2, WIDTH // 2), 5000, np.uint16), "64x48 pixels but the depth image .* is 32x24"),
        (np.zeros((HEIGHT, WIDTH), np.uint16), "holds no reading, all its pixels are zero"),
    ],
)
def test_a_recording_without_any_usable_frame(recording, image, sentence):
    for index in range(5):
        cv2.imwrite(str(recording / f"depth/{index}.png"), image)
    with pytest.raises(DatasetError, match=f"no frame of .* is usable; frame 0.*{sentence}"):
        open_sequence(recording)


def test_a_covered_lens_at_the_start_is_no_error(recording):
    cv2.imwrite(str(recording / "depth/0.png"), np.zeros((HEIGHT, WIDTH), np.uint16))
    sequence = TumSequence(recording)
    assert not sequence[0].depth.any()
    assert sequence[1].depth.any()


def test_a_bad_mask_and_a_bad_ground_truth(recording):
    (recording / "mask.txt").write_text("100.004 mask/0.png\n")
    with pytest.raises(FrameError, match=r"mask/0\.png does not exist"):
        open_sequence(recording).mask(0)
    (recording / "groundtruth.txt").write_text("100 1 2 3\n")
    sequence = open_sequence(recording)
    assert sequence.ground_truth is None
    assert "'timestamp tx ty tz qx qy qz qw'" in sequence.remarks[0]


SECOND = "fx 60\nfy 60\ncx 31.5\ncy 23.5\ncolor_fx 80\ncolor_fy 81\ncolor_cx 39.5\ncolor_cy 29.5\ncolor_width 80\n"
SECOND += "color_height 60\ncolor_k1 0.1\nT_depth_color 1 0 0 0.025 0 1 0 0 0 0 1 -0.01\n"


def test_a_second_camera_for_colour(tmp_path):
    folder = write_recording(tmp_path / "two", rgb_shift=0.004, intrinsics=SECOND)
    for file in (folder / "rgb").glob("*.png"):
        cv2.imwrite(str(file), np.zeros((60, 80, 3), np.uint8))
    sequence = open_sequence(folder)
    calibration, frame = sequence.calibration, sequence[1]
    assert calibration is not None
    assert calibration.camera == Camera(80, 81, 39.5, 29.5, 80, 60, distortion=(0.1, 0, 0, 0, 0))
    assert np.allclose(calibration.T_color_depth[:3, 3], [-0.025, 0, 0.01])
    assert (frame.depth.shape, frame.color.shape) == ((HEIGHT, WIDTH), (60, 80, 3))
    assert frame.color_timestamp == pytest.approx(frame.timestamp + 0.004)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (SECOND.replace("color_cx 39.5\n", ""), "lacks color_cx"),
        (SECOND.replace("1 -0.01", "1"), "not a rigid motion"),
        (SECOND.replace("T_depth_color 1", "T_depth_color 2"), "not a rigid motion"),
    ],
)
def test_a_second_camera_that_cannot_be_used(tmp_path, text, sentence):
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(write_recording(tmp_path / "two", intrinsics=text))


def test_colour_that_does_not_have_the_size_of_its_camera(tmp_path):
    with pytest.raises(DatasetError, match="colour camera is 80x60"):
        open_sequence(write_recording(tmp_path / "two", intrinsics=SECOND))
