"""Replica as rendered for NICE-SLAM (Zhu et al. 2022): results/frame000000.jpg, depth000000.png, traj.txt."""

from pathlib import Path

from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder
from dudmap.io.sequences.poses import read_matrices, rigid_trajectory

CAMERA = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "width": 1200, "height": 680, "depth_scale": 6553.5}
"""Camera of these renders, for folders without cam_params.json."""


class ReplicaSequence(ImageFolder):
    """Folder with ``results/`` and ``traj.txt``: one pose per line, 16 numbers, camera to world, x right, y down.

    cam_params.json lies in the folder or, as downloaded, in the one above that holds all rooms.
    """

    format = "Replica (NICE-SLAM)"
    depth_scale = CAMERA["depth_scale"]
    published = "NICE-SLAM's Replica", CAMERA
    color_files, depth_files = ("results", r"frame(\d+)\.(?:jpe?g|png)"), ("results", r"depth(\d+)\.png")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return (path / "results").is_dir() and any((path / "results").glob("depth*.png"))

    def _find_ground_truth(self) -> Trajectory | None:
        file = self.path / "traj.txt"
        if not file.is_file():
            return None
        return rigid_trajectory((n / FRAME_RATE, T) for n, T in enumerate(read_matrices(file)))
