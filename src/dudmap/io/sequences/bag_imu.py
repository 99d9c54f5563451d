"""Gravity from the accelerations in a bag of an IMU at rest."""

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.io.exporting.ros_messages import seconds_of
from dudmap.io.sequences.gravity import Gravity

if TYPE_CHECKING:
    from collections.abc import Callable

    from dudmap.io.sequences.bag_file import BagFile

IMU = "sensor_msgs/msg/Imu"
FIRST = 4000
"""First messages that are read: 10 s at 400 Hz."""
STANDARD = 9.80665
"""Standard acceleration of gravity, m/s^2 (ISO 80000-3)."""
SCALE = 0.1
"""Largest relative deviation of the median from gravity: more than a scale error, less than a wrong unit."""
STILL = 0.02
"""Largest relative deviation of a steady IMU."""


def gravity_of(bag: "BagFile", rotation_of: "Callable[[str], NDArray[np.float64] | None]") -> Gravity | None:
    """Gravity measured by the first usable IMU of a bag; None without an IMU.

    Args:
        rotation_of: Rotation (3, 3) from a named frame to the depth camera, or None.

    Raises:
        DatasetError: No IMU can be used; the message says why.
    """
    problems = []
    for connection in bag.connections:
        if connection.msgtype != IMU or not connection.msgcount:
            continue
        messages = [message for _, message in bag.messages([connection], FIRST)]
        messages = [message for message in messages if message.linear_acceleration_covariance[0] != -1]
        values = np.array([_vector(message.linear_acceleration) for message in messages]).reshape(-1, 3)
        sizes = np.linalg.norm(values, axis=1)
        if not np.any(sizes > 0):  # of a gyroscope
            continue
        size = float(np.median(sizes))
        frame = messages[0].header.frame_id
        R = rotation_of(frame)
        if not abs(size / STANDARD - 1) <= SCALE:
            problems.append(f"the median acceleration of {connection.topic} is {size:.3g} m/s^2, not 9.81")
        elif R is None:
            problems.append(f"/tf_static holds no transform from {frame!r}, the frame of {connection.topic}, to depth")
        else:
            still = np.abs(sizes / size - 1) <= STILL
            stamps = np.array([seconds_of(message) for message in messages])
            return Gravity(stamps[still], values[still] / sizes[still, None] @ R.T, connection.topic)
    if problems:
        raise DatasetError("; ".join(problems))
    return None


def is_realsense_optical(imu: str, depth: str) -> bool:
    """Whether both are frames of one RealSense camera."""
    found = re.fullmatch(r"/?(.*)(?:imu|accel|gyro)_optical_frame", imu)
    return found is not None and depth.lstrip("/").startswith(found[1]) and depth.endswith("_optical_frame")


def _vector(message: Any) -> tuple[float, float, float]:  # noqa: ANN401 - the type is made from the bag
    return message.x, message.y, message.z
