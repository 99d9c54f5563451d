"""Bonn RGB-D Dynamic Dataset (Palazzolo et al. 2019): TUM layout, truth of the markers on the camera."""

import re
from pathlib import Path

import numpy as np

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences.tum import TumSequence

T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Axes of the motion capture system against those of the cloud; its own inverse. From the data set's page."""
T_MARKER_CAMERA = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
"""T_m of the data set's page: camera to markers. Its rotation is scaled by 1.0593, which is removed for poses."""


class BonnSequence(TumSequence):
    """Folder ``rgbd_bonn_*``: TUM layout with the camera of that data set.

    groundtruth.txt holds poses T of the markers. The true camera poses are ``T_ROS^-1 T T_ROS T_m``, in the frame of
    the point cloud ``rgbd_bonn_groundtruth_1mm_section.ply``.
    """

    format = "Bonn RGB-D Dynamic"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has the layout and the name of this data set."""
        return TumSequence.recognises(path) and re.search("rgbd_bonn", path.resolve().name, re.IGNORECASE) is not None

    def _find_ground_truth(self) -> Trajectory | None:
        truth = super()._find_ground_truth()
        if truth is None:
            return None
        T_marker_camera = T_MARKER_CAMERA.copy()
        T_marker_camera[:3, :3] = se3.nearest_rotation(T_MARKER_CAMERA[:3, :3])
        return Trajectory(truth.timestamps, T_ROS @ truth.Ts_world_camera @ T_ROS @ T_marker_camera)
