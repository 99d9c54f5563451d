"""Bags of both ROS versions in three storages, written by the format's own library."""

import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from bags import START, BagWriter, K, millimetres, write_bag, write_frames
from dudmap.core.geometry import se3
from dudmap.errors import DatasetError, FrameError, MissingExtraError
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.bag import RosBag
from recordings import HEIGHT, WIDTH, color_image, cut

KINDS = {"ros1": "a.bag", "sqlite": "folder", "mcap": "folder"}


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def check_frames(sequence, frames=5):
    assert len(sequence) == frames
    np.testing.assert_allclose(sequence.timestamps, START + 0.1 * np.arange(frames), atol=1e-6)
    for index in (0, 1, frames - 1, 2, 0):  # in order, ahead and back
        frame = sequence[index]
        np.testing.assert_array_equal(frame.depth, millimetres(index).astype(np.float32) / np.float32(1000))
        np.testing.assert_array_equal(frame.color, color_image(index))
        assert frame.timestamp == pytest.approx(sequence.timestamps[index], abs=1e-6)
        assert frame.color_timestamp == pytest.approx(frame.timestamp + 0.004, abs=1e-6)


def test_registered_frames_of_every_kind(tmp_path, kind):
    sequence = open_sequence(write_bag(tmp_path / KINDS[kind], kind))
    assert (sequence.format, sequence.name) == ("ROS bag", "a" if kind == "ros1" else "folder")
    assert sequence.calibration is None
    assert (sequence.camera.fx, sequence.camera.fy, sequence.camera.cx, sequence.camera.cy) == (60, 61, 31.5, 23.5)
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    assert sequence.sources["intrinsics"] == "/camera/aligned_depth_to_color/camera_info"
    assert sequence.ground_truth is None
    check_frames(sequence)


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_single_file_of_a_ros2_bag(tmp_path, suffix):
    folder = write_bag(tmp_path / "folder", {".db3": "sqlite", ".mcap": "mcap"}[suffix])
    check_frames(open_sequence(folder / f"folder{suffix}"))


def test_a_bag_compressed_by_chunks_or_messages(tmp_path, kind):
    compression = {
        "ros1": (Writer1.CompressionFormat.LZ4,),
        "sqlite": (CompressionMode.MESSAGE, CompressionFormat.ZSTD),
        "mcap": (CompressionMode.STORAGE, CompressionFormat.ZSTD),
    }[kind]
    check_frames(open_sequence(write_bag(tmp_path / KINDS[kind], kind, set_compression=compression)))


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_a_bag_compressed_by_files(tmp_path, kind, monkeypatch):
    compression = (CompressionMode.FILE, CompressionFormat.ZSTD)
    path = write_bag(tmp_path / "folder", kind, set_compression=compression)
    check_frames(open_sequence(path))
    monkeypatch.setattr("dudmap.io.sequences.bag_file.RATIO_FREE_BYTES", 10_000)
    monkeypatch.setattr("dudmap.io.sequences.bag_file.LARGEST_RATIO", 1)
    with pytest.raises(DatasetError, match="one of its files unpacks to more than 1 times its size"):
        open_sequence(path)


def test_topics_that_cannot_be_parsed_do_not_matter(tmp_path, kind):
    """Definitions that would take for ever (brackets in IDL), cannot be parsed, or are in an unknown language."""
    bag = BagWriter(tmp_path / KINDS[kind], kind)
    definitions = {
        "pkg/srv/Tell_Event": "service_msgs/ServiceEventInfo info\npkg/srv/Tell_Request[<=1] request\n",
        "pkg/msg/Deep": "module pkg { module msg { struct Deep { int8 a[((((1))))]; }; }; };",
        "sensor_msgs/msg/PointCloud3": "?",
    }
    for number, (name, text) in enumerate(definitions.items()):
        given = {"md5sum": 32 * "0"} if kind == "ros1" else {"rihs01": f"RIHS01_{64 * '0'}"}
        name = name.replace("/srv/", "/msg/") if kind == "ros1" else name
        topic = bag.writer.add_connection(f"/camera/other{number}", name, msgdef=text, **given)
        bag.writer.write(topic, START * 10**9 + number, b"\0\1\0\0abcd")
    write_frames(bag, 5)
    if kind == "mcap":
        (file,) = (tmp_path / KINDS[kind]).glob("*.mcap")
        data = file.read_bytes()
        assert data.count(b"ros2msg") > 3
        file.write_bytes(re.sub(rb"(Tell_Event.{4})ros2msg", rb"\1unknown", data, flags=re.DOTALL))
    check_frames(open_sequence(tmp_path / KINDS[kind]))


def test_stamps_of_compressed_bags_are_those_of_recording_less_the_delay(tmp_path):
    """The frames themselves have the exact stamps."""
    bag = BagWriter(tmp_path / "a.bag", "ros1", set_compression=(Writer1.CompressionFormat.BZ2,))
    late = [0.010, 0.012, 0.010, 0.009, 0.010]
    for index, delay in enumerate(late):
        stamp = START + 0.1 * index
        bag.write("/depth/image_raw", bag.image(millimetres(index), "16UC1", stamp, "c"), stamp + delay)
        bag.write("/rgb/image_raw", bag.image(color_image(index), "rgb8", stamp, "c"), stamp + delay)
    bag.close()
    sequence = open_sequence(tmp_path / "a.bag", "60,60,31.5,23.5")
    np.testing.assert_allclose(sequence.timestamps - START - 0.1 * np.arange(5), np.array(late) - 0.010, atol=1e-5)
    assert sequence[1].timestamp == pytest.approx(START + 0.1, abs=1e-6)


def test_opening_reads_the_index_and_not_the_images(tmp_path, kind):
    if not Path("/proc/self/io").exists():
        pytest.skip("counts of bytes read are known on Linux only")
    bag = BagWriter(tmp_path / KINDS[kind], kind)
    large = np.full((480, 640), 1500, np.uint16), np.zeros((480, 640, 3), np.uint8)
    for index in range(40):
        stamp = START + index / 30
        bag.write("/depth/image_raw", bag.image(large[0], "16UC1", stamp, "c"), stamp)
        bag.write("/rgb/image_raw", bag.image(large[1], "rgb8", stamp, "c"), stamp)
    bag.close()
    open_sequence(tmp_path / KINDS[kind], "525,525,319.5,239.5")  # loads what Python itself reads
    before = bytes_read()
    sequence = open_sequence(tmp_path / KINDS[kind], "525,525,319.5,239.5")
    assert len(sequence) == 40
    frame = 480 * 640 * 5
    assert bytes_read() - before < 4 * frame, "the index and one frame, in chunks"


def bytes_read():
    return int(Path("/proc/self/io").read_text().split()[1])


def test_sequential_reading_is_one_pass(tmp_path, kind):
    sequence = open_sequence(write_bag(tmp_path / KINDS[kind], kind, frames=30))
    opened = []
    messages = sequence._bag._reader.messages
    sequence._bag._reader.messages = lambda *args, **kwargs: opened.append(kwargs) or messages(*args, **kwargs)
    for index in range(30):
        assert sequence[index].color[0, 0, 1] == index
        assert len(sequence._bag._stream._kept) <= 4, "only neighbours wait"
    assert len(opened) <= 1


def two_cameras(path, kind, *, static=True, d=(0.0,) * 5, model="plumb_bob"):
    """Depth of another frame, size and lens than colour, 2.5 cm to the left and turned a little."""
    bag = BagWriter(path, kind)
    T_base_depth = np.eye(4)
    T_base_depth[:3, 3] = 0, 0.1, 0.2
    if static:
        bag.write("/tf_static", bag.transform(START, "base", "depth", (0, 0.1, 0.2)), START)
        q = np.array([0, np.sin(0.05), 0, np.cos(0.05)])
        bag.write("/tf_static", bag.transform(START, "base", "color", (0.025, 0.1, 0.2), q), START)
    wide = np.repeat(np.repeat(color_image(0), 2, 0), 2, 1)
    info = dict(k=[110.0, 0, 63.0, 0, 110, 47, 0, 0, 1], size=(2 * WIDTH, 2 * HEIGHT))
    for index in range(3):
        stamp = START + 0.1 * index
        bag.write("/camera/depth/camera_info", bag.info(stamp, "depth"), stamp)
        bag.write("/camera/color/camera_info", bag.info(stamp, "color", **info, d=d, model=model), stamp)
        bag.write("/camera/depth/image_rect_raw", bag.image(millimetres(index), "16UC1", stamp, "depth"), stamp)
        bag.write("/camera/color/image_raw", bag.image(wide, "rgb8", stamp, "color"), stamp)
    bag.close()
    return path


def test_unregistered_depth_is_calibrated_by_tf_static(tmp_path, kind):
    sequence = open_sequence(two_cameras(tmp_path / KINDS[kind], kind, d=(0.1, -0.2, 0.001, 0.002, 0)))
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    assert sequence.calibration.camera.shape == (2 * HEIGHT, 2 * WIDTH)
    assert sequence.calibration.camera.fx == 110
    np.testing.assert_allclose(sequence.calibration.lens, (0.1, -0.2, 0.001, 0.002, 0))
    T_depth_color = np.eye(4)
    T_depth_color[:3, :3] = se3.exp_rotation(np.array([0, 0.1, 0]))
    T_depth_color[0, 3] = 0.025
    np.testing.assert_allclose(sequence.calibration.T_color_depth, np.linalg.inv(T_depth_color), atol=1e-9)
    assert sequence[0].color.shape == (2 * HEIGHT, 2 * WIDTH, 3)


def test_unregistered_depth_without_transform_is_refused(tmp_path):
    path = two_cameras(tmp_path / "a.bag", "ros1", static=False)
    with pytest.raises(DatasetError, match=r"seen from 'depth' and colour from 'color'.*--topics depth="):
        open_sequence(path)


def test_a_rational_lens_is_rectified_when_read(tmp_path):
    d = (0.4, -0.2, 0.0005, -0.0003, 0.05, 0.7, -0.15, 0.02)
    sequence = open_sequence(two_cameras(tmp_path / "a.bag", "ros1", d=d, model="rational_polynomial"))
    assert sequence.calibration.camera.distortion == ()
    wide = np.repeat(np.repeat(color_image(0), 2, 0), 2, 1)
    expected = cv2.undistort(wide, sequence.calibration.camera.K, np.array(d))
    assert np.abs(sequence[0].color.astype(int) - expected).max() <= 1
    assert not np.array_equal(expected, wide)


def test_ground_truth_follows_the_world_frame(tmp_path, kind):
    """A moving base and a camera fixed to it: truth is interpolated at the times of the frames."""
    path = tmp_path / KINDS[kind]
    bag = BagWriter(path, kind)
    slash = "/" if kind == "ros1" else ""
    bag.write("/tf_static", bag.transform(START, "base", f"{slash}camera", (0, 0, 0.5)), START)
    for index in range(5):
        stamp = START + 0.1 * index
        tf = bag.transform(stamp - 0.05, f"{slash}world", f"{slash}base", (0.2 * index, 0, 0))
        bag.write("/tf", tf, stamp - 0.04)
        bag.write("/depth/camera_info", bag.info(stamp, "camera"), stamp)
        bag.write("/depth/image_raw", bag.image(millimetres(index), "16UC1", stamp, "camera"), stamp)
        bag.write("/rgb/image_raw", bag.image(color_image(index), "rgb8", stamp, "camera"), stamp)
    bag.close()
    truth = open_sequence(path).ground_truth
    np.testing.assert_allclose(truth.timestamps, START + 0.1 * np.arange(4), atol=1e-6)  # the last is not covered
    np.testing.assert_allclose(truth.Ts_world_camera[:, 0, 3], [0.1, 0.3, 0.5, 0.7], atol=1e-6)
    np.testing.assert_allclose(truth.Ts_world_camera[:, 2, 3], 0.5)
    assert open_sequence(path, topics="world=map").ground_truth is None
    assert len(open_sequence(path, topics="world=base").ground_truth) == 5


def test_topics_are_listed_where_one_is_missing(tmp_path):
    path = write_bag(tmp_path / "a.bag", "ros1")
    listed = r"/camera/aligned_depth_to_color/image_raw \(5 sensor_msgs/msg/Image\)"
    with pytest.raises(DatasetError, match=rf"no such topic /nothing .*{listed}"):
        open_sequence(path, topics="depth=/nothing")
    bag = BagWriter(tmp_path / "b.bag", "ros1")
    bag.write("/odom/tf", bag.transform(START, "a", "b"), START)
    bag.close()
    with pytest.raises(
        DatasetError, match=r"recognised as depth images; it holds /odom/tf \(1 tf2_msgs/msg/TFMessage\)"
    ):
        open_sequence(tmp_path / "b.bag")
    with pytest.raises(DatasetError, match=r"cannot understand --topics 'rgb=/a'; expected color=..., depth=..."):
        open_sequence(path, topics="rgb=/a")


def test_topics_can_be_chosen(tmp_path):
    path = write_bag(tmp_path / "a.bag", "ros1", depth_topic="/other/thing")
    sequence = open_sequence(path, topics="depth=/other/thing,color=/camera/color/image_raw")
    assert sequence.sources["intrinsics"] == "/other/camera_info"
    check_frames(sequence)


def test_missing_intrinsics_are_asked_for(tmp_path):
    bag = BagWriter(tmp_path / "a.bag", "ros1")
    bag.write("/depth/image", bag.image(millimetres(0), "16UC1", START, "c"), START)
    bag.write("/rgb/image", bag.image(color_image(0), "rgb8", START, "c"), START)
    bag.close()
    with pytest.raises(DatasetError, match=r"no camera_info for /depth/image; .* --camera fx,fy,cx,cy"):
        open_sequence(tmp_path / "a.bag")
    sequence = open_sequence(tmp_path / "a.bag", "60,60,31.5,23.5,64,48,500")
    assert sequence[0].depth.max() == pytest.approx(millimetres(0).max() / 500)


def test_headers_without_times_fall_back_to_those_of_recording(tmp_path):
    bag = BagWriter(tmp_path / "a.bag", "ros1")
    for index in range(4):
        bag.write("/depth/image", bag.image(millimetres(index), "16UC1", 0, "c"), START + 0.1 * index)
        bag.write("/rgb/image", bag.image(color_image(index), "rgb8", 0, "c"), START + 0.1 * index + 0.003)
    bag.close()
    sequence = open_sequence(tmp_path / "a.bag", "60,60,31.5,23.5")
    np.testing.assert_allclose(sequence.timestamps, START + 0.1 * np.arange(4), atol=1e-6)
    assert sequence[3].timestamp == sequence.timestamps[3]


def test_images_that_are_never_together_are_refused(tmp_path):
    bag = BagWriter(tmp_path / "a.bag", "ros1")
    bag.write("/depth/image", bag.image(millimetres(0), "16UC1", START, "c"), START)
    bag.write("/rgb/image", bag.image(color_image(0), "rgb8", START + 1, "c"), START + 1)
    bag.close()
    with pytest.raises(DatasetError, match="no image of /rgb/image lies within 20 ms of one of /depth/image"):
        open_sequence(tmp_path / "a.bag", "60,60,31.5,23.5")


def test_one_damaged_image_is_an_error_of_its_frame(tmp_path):
    bag = BagWriter(tmp_path / "a.bag", "ros1")
    png = cv2.imencode(".png", color_image(1)[..., ::-1])[1].tobytes()
    for index, data in enumerate((png, png[:-30], png)):
        stamp = START + index
        bag.write("/depth/image", bag.image(millimetres(index), "16UC1", stamp, "c"), stamp)
        bag.write("/rgb/image/compressed", bag.compressed(data, "png", stamp, "c"), stamp)
    bag.close()
    sequence = open_sequence(tmp_path / "a.bag", "60,60,31.5,23.5")
    with pytest.raises(FrameError, match=r"the colour image of frame 1 of .* is cut off"):
        sequence[1]
    np.testing.assert_array_equal(sequence[2].color, color_image(1))


def test_a_damaged_bag_is_one_sentence(tmp_path, kind):
    path = write_bag(tmp_path / KINDS[kind], kind)
    cut(path if kind == "ros1" else next(path.glob("folder.*")))
    with pytest.raises(DatasetError, match=r"cannot open the bag|cannot be read|is usable"):
        open_sequence(path)


def test_rosbags_missing_is_one_sentence(tmp_path, monkeypatch):
    path = write_bag(tmp_path / "a.bag", "ros1")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.typesys", None)
    with pytest.raises(
        MissingExtraError, match=r'the ROS bag .* needs the extra ros-bags .*pip install "\.\[ros-bags\]"'
    ):
        open_sequence(path)


def test_files_that_only_look_like_bags_are_not_recognised(tmp_path):
    for name in ("a.bag", "a.db3", "a.mcap"):
        (tmp_path / name).write_bytes(b"something else")
        assert not RosBag.recognises(tmp_path / name)
    os.mkdir(tmp_path / "folder")
    assert not RosBag.recognises(tmp_path / "folder")


def named_otherwise(path, kind, depth_encoding="16UC1", k=K):
    """A bag of an OAK camera, whose depth topic is recognised by its encoding alone."""
    bag = BagWriter(path, kind)
    for index in range(5):
        stamp = START + 0.1 * index
        for space in ("/oak/stereo", "/oak/rgb"):
            bag.write(f"{space}/camera_info", bag.info(stamp, "oak", k=k), stamp)
        bag.write("/oak/stereo/image_raw", bag.image(millimetres(index), depth_encoding, stamp, "oak"), stamp)
        bag.write("/oak/rgb/image_raw", bag.image(color_image(index), "rgb8", stamp, "oak"), stamp)
    bag.close()
    return path


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_images_are_told_apart_by_their_encoding_where_names_do_not_tell(kind, tmp_path):
    found = open_sequence(named_otherwise(tmp_path / KINDS[kind], kind))
    assert len(found) == 5
    np.testing.assert_allclose(found[2].depth, millimetres(2) / 1000, atol=1e-6)
    np.testing.assert_array_equal(found[2].color, color_image(2))


def test_a_16_bit_image_may_be_infrared(tmp_path):
    with pytest.raises(DatasetError, match=r"no topic of .* is recognised as depth"):
        open_sequence(named_otherwise(tmp_path / "walk", "mcap", "mono16"))


def test_a_camera_that_is_not_calibrated_is_named(tmp_path):
    path = named_otherwise(tmp_path / "walk", "mcap", k=[0.0] * 9)
    zeros = r"K in /oak/rgb/camera_info and /oak/stereo/camera_info is all zeros"
    with pytest.raises(DatasetError, match=rf"{zeros}.*--camera"):
        open_sequence(path)
    assert open_sequence(path, camera="60,61,31.5,23.5").camera.fy == 61
