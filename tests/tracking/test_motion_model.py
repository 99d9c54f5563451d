"""The constant-velocity model against a camera on a screw, and what it forgets."""

import numpy as np

from dudmap.config import TrackerConfig
from dudmap.core.geometry import se3
from dudmap.core.tracking.motion_model import MotionModel

VELOCITY = np.array([0.3, -0.1, 0.2, 0.1, 0.4, -0.2])


def pose(timestamp):
    return se3.exp(np.array([0.4, 0.1, 0, 0, 0.5, 0])) @ se3.exp(timestamp * VELOCITY)


def test_a_camera_on_a_screw_is_predicted_after_two_poses():
    motion = MotionModel(TrackerConfig())
    motion.update(0.0, pose(0.0))
    np.testing.assert_allclose(motion.predict(0.1), pose(0.0))  # nothing is known of its velocity yet
    motion.update(0.1, pose(0.1))
    np.testing.assert_allclose(motion.velocity, VELOCITY)
    np.testing.assert_allclose(motion.predict(0.2), pose(0.2))


def test_the_way_to_the_place_of_a_relocalisation_is_no_velocity():
    motion = MotionModel(TrackerConfig())
    for timestamp in (0.0, 0.1):
        motion.update(timestamp, pose(timestamp))
    elsewhere = se3.exp(np.array([5.0, 0, 0, 0, 1, 0])) @ pose(0.2)
    motion.restart(0.2, elsewhere)
    np.testing.assert_array_equal(motion.velocity, np.zeros(6))
    np.testing.assert_allclose(motion.predict(0.3), elsewhere)
