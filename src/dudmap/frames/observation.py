"""A preprocessed frame and the levels of its image pyramid."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class Observation:
    """A frame made ready.

    Attributes:
        timestamp: Seconds, of the depth image.
        camera: Camera of all images here; without distortion.
        depth: (H, W) float32, metres, holes filled and smoothed, 0 = none.
        raw_depth: (H, W) float32, metres, limited and undistorted only, 0 = none.
        intensity: (H, W) float32, 0..1.
        rgb: (H, W, 3) uint8.
    """

    timestamp: float
    camera: Camera
    depth: NDArray[np.float32]
    raw_depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    _halvings: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=list, repr=False)


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the image pyramid: camera, depth (h, w) m, intensity (h, w) 0..1."""

    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
