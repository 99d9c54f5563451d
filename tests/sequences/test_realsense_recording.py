"""RealSense recordings: .db3 files written by the driver itself, and bags in the layout that it writes."""

import numpy as np
import pytest

from bags import START, BagWriter, K, millimetres
from dudmap.core.geometry import se3
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.bag import RealSenseRecording
from recordings import HEIGHT, WIDTH, color_image
from software_device import T_COLOR_DEPTH, record

D = "/device_0/sensor_0/Depth_0"
C = "/device_0/sensor_1/Color_0"


def test_a_recording_of_the_driver(tmp_path):
    sequence = open_sequence(record(tmp_path / "walk.db3", frames=6))
    assert (sequence.format, sequence.name) == ("RealSense recording", "walk")
    assert len(sequence) >= 5, "the driver may drop a frame"
    assert (sequence.camera.fx, sequence.camera.shape) == (60, (HEIGHT, WIDTH))
    assert (sequence.calibration.camera.fx, sequence.calibration.camera.shape) == (70, (HEIGHT, 80))
    np.testing.assert_allclose(sequence.calibration.T_color_depth, T_COLOR_DEPTH, atol=1e-6)
    for index in range(len(sequence)):
        frame = sequence[index]
        number = frame.color[0, 0, 1]
        assert frame.timestamp == pytest.approx(10 + number / 30, abs=1e-5), "the camera's time, not that of writing"
        assert frame.color_timestamp == pytest.approx(10 + number / 30 + 0.005, abs=1e-5)
        np.testing.assert_array_equal(frame.depth, millimetres(number).astype(np.float32) / np.float32(1000))


def write_realsense(path, kind, units=0.001):
    """As librealsense writes: text beside every stream (.db3), or messages of other types (.bag)."""
    bag = BagWriter(path, kind)
    text = bag.type("std_msgs/msg/String")
    R = se3.exp_rotation(np.array([0, 0.02, 0]))

    def tell(topic, value):
        bag.write(topic, text(value), 0)

    if kind == "ros1":
        bag.write("/device_0/sensor_0/option/Depth_Units/value", bag.type("std_msgs/msg/Float32")(units), 0)
        for stream, t, q in ((D, (0, 0, 0), (0, 0, 0, 1)), (C, (0.015, 0, 0), se3.rotation_to_quat_xyzw(R))):
            bag.write(f"{stream}/tf/0", bag.transform(0, "a", "b", t, q).transforms[0].transform, 0)
    else:
        tell("/device_0/sensor_0/option/Depth_Units/value", f"{units:.6f}")
        tell(f"{D}/tf/ref_1", "rotation=1.0,0.0,0.0,0.0,1.0,0.0,0.0,0.0,1.0;translation=0.0,-0.0,0.0")
        columns = ",".join(f"{number:.6e}" for number in R.T.reshape(-1))
        tell(f"{C}/tf/ref_1", f"rotation={columns};translation=0.015000,0.000000,0.000000")
    info = "info/camera_info" if kind == "ros1" else "image/camera_info"
    for stream, fx in ((D, 60.0), (C, 70.0)):
        bag.write(f"{stream}/{info}", bag.info(0, "0", k=[fx, *K[1:]]), 0)
    for index in range(4):
        stamp, recorded = START + index / 30, 1 + index / 30
        header = stamp if kind == "ros1" else recorded
        bag.write(f"{D}/image/data", bag.image(millimetres(index), "mono16", header, "0"), recorded)
        bag.write(f"{C}/image/data", bag.image(color_image(index), "rgb8", header, "1"), recorded + 0.002)
        if kind != "ros1":
            form = "Frame number={};timestamp_domain=Global Time;system_time=3.0;timestamp={:.6f};depth_units=0.001000;"
            bag.write(f"{D}/image/metadata", text(form.format(index, 1000 * stamp)), recorded)
            bag.write(f"{C}/image/metadata", text(form.format(index, 1000 * stamp + 1)), recorded + 0.002)
    bag.close()
    return path


@pytest.mark.parametrize("kind", ["ros1", "sqlite"])
def test_the_layouts_of_both_versions(tmp_path, kind):
    path = write_realsense(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, units=0.0005)
    path = path if kind == "ros1" else path / "a.db3"
    sequence = open_sequence(path)
    assert sequence.format == "RealSense recording"
    np.testing.assert_allclose(sequence.timestamps, START + np.arange(4) / 30, atol=1e-5)
    assert (sequence.camera.fx, sequence.camera.depth_scale) == (60, 2000)
    assert sequence[2].depth.max() == millimetres(2).max() / 2000
    np.testing.assert_array_equal(sequence[3].color, color_image(3))
    T = np.eye(4)
    T[:3, :3], T[0, 3] = se3.exp_rotation(np.array([0, 0.02, 0])), 0.015
    np.testing.assert_allclose(sequence.calibration.T_color_depth, T, atol=1e-6)
    assert sequence.calibration.camera.fx == 70
    assert sequence.calibration.camera.shape == (HEIGHT, WIDTH)


def test_other_bags_are_not_taken_for_it(tmp_path):
    bag = BagWriter(tmp_path / "a.bag", "ros1")
    bag.write("/depth/image", bag.image(millimetres(0), "16UC1", START, "c"), START)
    bag.close()
    assert not RealSenseRecording.recognises(tmp_path / "a.bag")
