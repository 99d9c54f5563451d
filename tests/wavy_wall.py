"""Frames of a wavy wall with random colours, with a small camera and a map configuration."""

import numpy as np

from dudmap.config import VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
CONSTANT = VolumeConfig(voxel_size=0.05, truncation_noise=0, weighting="constant", carve_rate=1)


def wall(distance: float, seed: int = 0, bump: float = 0.1) -> Frame:
    """Frame of a wavy wall at ``distance`` metres, with random colours."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = distance + bump * np.sin(u / 9.0) * np.cos(v / 7.0)
    return Frame(float(seed), depth.astype(np.float32), rng.integers(0, 256, (*CAMERA.shape, 3), dtype=np.uint8))


def box_before_wall() -> Frame:
    frame = wall(3.0, bump=0.0)
    frame.depth[15:35, 20:45] = 1.2
    return frame
