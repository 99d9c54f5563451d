"""Analytic depth and intensity of a corner of three textured walls, from any pose."""

import numpy as np

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume

CAMERA = Camera(80.0, 80.0, 39.5, 29.5, 80, 60)
SENSOR = SensorConfig()


def corner(shift: np.ndarray | None = None) -> Frame:
    """Frame of the corner from a camera moved by a twist."""
    T = np.eye(4) if shift is None else se3.exp(shift)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    normals = np.array([[0.75, 0.1, 0.65], [-0.65, 0.15, 0.75], [0.05, 0.8, 0.6]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    t = (np.array([1.3, 1.35, 1.25]) - normals @ T[:3, 3]) / (rays @ normals.T)
    t = np.where(t > 0, t, np.inf).min(axis=-1)
    points = rays * t[..., None] + T[:3, 3]
    shade = 0.5 + 0.2 * np.sin(points[..., 0] * 9) * np.cos(points[..., 1] * 8) + 0.15 * np.sin(points[..., 2] * 7)
    gray = np.clip(255 * shade, 0, 255).astype(np.uint8)
    return Frame(0.0, t.astype(np.float32), np.repeat(gray[..., None], 3, axis=2))


def level_of(frame: Frame) -> Level:
    return Level(CAMERA, frame.depth, frame.color[..., 0].astype(np.float32) / 255)


def corner_map() -> TsdfVolume:
    """Map of the corner after three frames with known pose."""
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02, truncation_noise=0), SENSOR, depth_max=4.0)
    for _ in range(3):
        volume.integrate(corner(), np.eye(4))
    return volume


def ones(level: Level) -> np.ndarray:
    return np.ones_like(level.depth)
