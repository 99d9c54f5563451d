"""Conversion from and to ROS 2 messages: through the message types, serialisation and reader of rosbags."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import DatasetError
from dudmap.io.exporting import ros_messages as ros

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = ros.MessageTypes(STORE.types.__getitem__)
T = se3.exp(np.array([0.3, -1.0, 0.5, 0.4, -0.2, 0.9]))


def there_and_back(message):
    """The message after serialisation, which checks all fields and their types."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def matrix(position, quaternion):
    out = np.eye(4)
    out[:3, :3] = se3.quat_xyzw_to_rotation(np.array([getattr(quaternion, axis) for axis in "xyzw"]))
    out[:3, 3] = [getattr(position, axis) for axis in "xyz"]
    return out


def test_transform_odometry_and_path():
    (tf,) = there_and_back(ros.transforms(TYPES, [ros.transform(TYPES, 12.25, T, "map", "camera")])).transforms
    assert (tf.header.frame_id, tf.child_frame_id) == ("map", "camera")
    assert ros.seconds_of(tf) == 12.25
    np.testing.assert_allclose(matrix(tf.transform.translation, tf.transform.rotation), T, atol=1e-12)
    found = there_and_back(ros.odometry(TYPES, 1.5, T, np.arange(36.0).reshape(6, 6), np.arange(6.0), "map", "camera"))
    np.testing.assert_allclose(matrix(found.pose.pose.position, found.pose.pose.orientation), T, atol=1e-12)
    np.testing.assert_array_equal(found.pose.covariance, np.arange(36))
    assert (found.twist.twist.linear.y, found.twist.twist.angular.z) == (1, 5)
    track = there_and_back(ros.path(TYPES, 2.0, [0.5, 1.5], np.stack([np.eye(4), T]), "map"))
    assert [ros.seconds_of(pose) for pose in track.poses] == [0.5, 1.5]
    np.testing.assert_allclose(matrix(track.poses[1].pose.position, track.poses[1].pose.orientation), T, atol=1e-12)


def test_the_cloud_holds_points_and_colours():
    points, colors = np.random.default_rng(0).random((7, 3)).astype(np.float32), np.arange(21, dtype=np.uint8)
    found = there_and_back(ros.cloud(TYPES, 0.0, points, colors.reshape(7, 3), "map"))
    assert [(field.name, field.offset) for field in found.fields] == [("x", 0), ("y", 4), ("z", 8), ("rgb", 12)]
    assert (found.width, found.row_step) == (7, 7 * found.point_step)
    rows = np.frombuffer(found.data.tobytes(), ros.POINT)
    np.testing.assert_array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), points)
    assert rows["rgb"][2] == (6 << 16) | (7 << 8) | 8


def test_markers_of_mesh_and_movers():
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 51, np.uint8), np.eye(3))
    marker = there_and_back(ros.mesh_marker(TYPES, 0.0, mesh, "map"))
    assert (marker.type, len(marker.points), len(marker.colors)) == (marker.TRIANGLE_LIST, 3, 3)
    assert (marker.points[1].y, marker.colors[0].g) == (1, pytest.approx(0.2))
    movers = [{"id": 4, "box": [[0, 0, 1], [1, 0.5, 3]]}]
    clear, box = there_and_back(ros.mover_markers(TYPES, 0.0, movers, "map")).markers
    assert clear.action == clear.DELETEALL
    assert (box.type, box.id, box.pose.position.z, box.scale.z) == (box.CUBE, 4, 2, 2)


def camera_info(**changes):
    message = ros.camera_info(TYPES, 0.0, Camera(500.0, 510.0, 320.0, 240.0, 640, 480), "camera")
    for name, value in changes.items():
        setattr(message, name, value)
    return there_and_back(message)


def test_the_camera_of_a_camera_info():
    assert ros.camera_of(camera_info()) == Camera(500.0, 510.0, 320.0, 240.0, 640, 480)
    bent = np.array([0.1, -0.2, 0.001, 0.002, 0.05])
    assert ros.camera_of(camera_info(d=bent)).distortion == tuple(bent)
    with pytest.raises(DatasetError, match="distortion model 'equidistant' is not supported"):
        ros.camera_of(camera_info(d=bent[:4], distortion_model="equidistant"))
    with pytest.raises(DatasetError, match="has no focal length"):
        ros.camera_of(camera_info(k=np.zeros(9)))
