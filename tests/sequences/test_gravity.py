"""Gravity from recordings: poses of phones, whose worlds stand upright, and accelerations in bags."""

import numpy as np
import pytest

from bags import START, BagWriter, write_frames
from device_layouts import arkit_scenes, polycam, stray_scanner
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence
from layouts import quaternion, write


def tilted(forward, roll=0.0):
    """Rotation (3, 3) of a camera (x right, y down, z forward) into a world with z up, rolled by degrees."""
    forward = np.asarray(forward, float) / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    return R @ se3.exp_rotation(np.radians(roll) * np.array([0, 0, 1.0]))


def still(sequence, gravity):
    """The mean direction in the world of a run with a camera at rest is the direction in its axes."""
    poses = Trajectory(sequence.timestamps, np.tile(np.eye(4), (len(sequence), 1, 1)))
    return gravity.in_world(poses)


@pytest.mark.parametrize("roll", [0, 90, 180])
def test_the_odometry_of_stray_scanner_has_y_up(tmp_path, roll):
    folder, _ = write(stray_scanner, tmp_path / "a")
    R = tilted((1, 0.3, -0.4), roll)
    z_to_y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    numbers = ", ".join(f"{number:.9f}" for number in quaternion(z_to_y @ R))
    lines = (folder / "odometry.csv").read_text().replace("0.0, 0.0, 0.0, 1.0", numbers)
    (folder / "odometry.csv").write_text(lines)
    sequence = open_sequence(folder)
    found = still(sequence, sequence.gravity)
    np.testing.assert_allclose(found.direction, R.T @ [0, 0, 1], atol=1e-6)
    assert (found.source, found.readings) == ("odometry.csv", 3)
    assert found.sigma_deg < 0.01


def test_an_odometry_without_rotations_brings_no_gravity(tmp_path):
    folder, _ = write(stray_scanner, tmp_path / "a")
    lines = (folder / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join(",".join(line.split(",")[:5]) for line in lines))
    assert open_sequence(folder).gravity is None
    (folder / "odometry.csv").write_text("\n".join(lines).replace("0.0, 1.0", "x, 1.0"))
    with pytest.raises(DatasetError, match=r"odometry\.csv"):
        _ = open_sequence(folder).gravity


def test_worlds_of_arkit_scenes_and_polycam(tmp_path):
    """In ARKitScenes z is up, in Polycam y is; the camera axes agree with the ground truth."""
    for layout, up in ((arkit_scenes, (0, 0, 1)), (polycam, (0, 1, 0))):
        folder, _ = write(layout, tmp_path / layout.__name__)
        sequence = open_sequence(folder)
        for stamp, T in zip(sequence.ground_truth.timestamps, sequence.ground_truth.Ts_world_camera, strict=True):
            number = int(np.argmin(np.abs(sequence.gravity.timestamps - stamp)))
            np.testing.assert_allclose(sequence.gravity.ups[number], T[:3, :3].T @ up, atol=1e-6)


def write_imu(path, kind, acceleration, *, frame="imu", mounted=None, depth_frame="rgb"):
    """Bag of frames with an IMU at 100 Hz that is shaken now and then, and its rotation into the camera's frame."""
    bag, random = BagWriter(path, kind), np.random.default_rng(0)
    if mounted is not None:
        q = quaternion(mounted)
        bag.write("/tf_static", bag.transform(START, depth_frame, frame, (0.1, 0, 0), q), START)
    for k in range(50):
        shaken = random.normal(size=3) * (5.0 if k % 5 == 0 else 0.02)
        stamp = START + 0.01 * k
        bag.write("/gyro", bag.imu(stamp, frame, (0, 0, 0)), stamp)
        bag.write("/imu", bag.imu(stamp, frame, acceleration + shaken), stamp)
    write_frames(bag, 5, depth_frame=depth_frame, color_frame=depth_frame)
    return open_sequence(path)


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_accelerations_are_turned_by_tf_static(tmp_path, kind):
    """At rest the specific force points against gravity: a camera that looks ahead and down, an IMU mounted askew."""
    R = tilted((1, 0, -0.5), 90)
    true = R.T @ [0, 0, 1]  # in the camera
    mounted = tilted((0.3, -1, 0.2), 40)  # of the IMU into the camera
    path = tmp_path / ("bag.bag" if kind == "ros1" else "bag")
    sequence = write_imu(path, kind, 9.78 * mounted.T @ true, mounted=mounted)
    found = still(sequence, sequence.gravity)
    assert np.degrees(np.arccos(found.direction @ true)) < 1
    assert 36 <= found.readings <= 38  # of 45 near a pose, not the 9 shaken ones, of which one may look still
    assert found.source == "/imu"
    assert found.sigma_deg < 4


def test_frames_of_a_realsense_camera_need_no_tf(tmp_path):
    up = np.array([0.1, -0.9, -0.4]) / np.linalg.norm([0.1, -0.9, -0.4])
    frames = {"frame": "camera_imu_optical_frame", "depth_frame": "camera_color_optical_frame"}
    sequence = write_imu(tmp_path / "bag", "mcap", 9.7 * up, **frames)
    assert np.degrees(np.arccos(still(sequence, sequence.gravity).direction @ up)) < 1


@pytest.mark.parametrize(
    ("acceleration", "sentence"),
    [((0, 9.81, 0), "/tf_static holds no transform from 'imu'"), ((0, 1.0, 0), r"/imu is 1.0\d m/s\^2, not 9\.81")],
)
def test_an_imu_that_cannot_be_used_is_named(tmp_path, acceleration, sentence):
    sequence = write_imu(tmp_path / "bag", "mcap", np.array(acceleration))
    assert len(sequence) == 5  # the recording is read
    with pytest.raises(DatasetError, match=sentence):
        _ = sequence.gravity


def test_a_bag_without_imu_has_no_gravity(tmp_path):
    write_frames(BagWriter(tmp_path / "bag", "mcap"), 3)
    assert open_sequence(tmp_path / "bag").gravity is None
