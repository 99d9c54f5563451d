"""EPFL RGB-D Pedestrian data set (Bagautdinov et al. 2015): a Kinect v2 at rest, rgb000000.png and depth000000.png."""

from pathlib import Path

from dudmap.io.sequences.image_folder import ImageFolder

CAMERA = {
    "fx": 365.8046307762528, "fy": 365.80463336811664, "cx": 254.31510758228475, "cy": 206.98513348550657,
    "width": 512, "height": 424, "depth_scale": 1000.0,
}  # fmt: skip
"""Published camera of both rooms, colour mapped to depth."""


class EpflSequence(ImageFolder):
    """Folder such as ``epfl_lab/20140804_160621_00`` with ``rgb000033.png`` and ``depth000033.png`` in millimetres."""

    format = "EPFL RGB-D Pedestrian"
    published = "EPFL", CAMERA
    color_files, depth_files = ("", r"rgb(\d{6})\.png"), ("", r"depth(\d{6})\.png")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return path.is_dir() and all(any(path.glob(kind + "[0-9]" * 6 + ".png")) for kind in ("rgb", "depth"))
