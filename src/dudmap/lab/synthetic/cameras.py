"""Five RGB-D cameras as people own them: noise, faults and view; ``sensors.toml`` has the values and their sources.

Each is described as its driver delivers it: colour registered to depth, so that only what registration leaves over is a
fault of place; add ``color_translation`` and the like for unregistered streams.
"""

from dataclasses import dataclass

import numpy as np

from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError
from dudmap.lab.data import tables
from dudmap.lab.synthetic.faults import SensorFaults


@dataclass(frozen=True)
class CameraModel:
    """One camera.

    Attributes:
        noise: Name of its noise model (``sensors.SENSORS``).
        field_of_view: Horizontal field of view of a 4:3 depth image, degrees.
        motion_blur: Exposure time of the colour as a share of the frame interval.
        faults: Its faults.
    """

    noise: str
    field_of_view: float
    motion_blur: float
    faults: SensorFaults

    def camera(self, width: int, height: int) -> Camera:
        """Intrinsics of an image of this camera's view, with square pixels."""
        focal = width / 2 / np.tan(np.radians(self.field_of_view / 2))
        return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, depth_scale=5000.0)


CAMERAS: dict[str, CameraModel] = {
    name: CameraModel(**row | {"faults": SensorFaults(**row["faults"])})
    for name, row in tables("synthetic/sensors.toml")["cameras"].items()
}
"""Cameras by name."""


def find_camera(name: str) -> CameraModel:
    """Camera of the given name.

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in CAMERAS:
        raise ConfigError(f"unknown sensor {name!r}; known sensors: {', '.join(CAMERAS)}")
    return CAMERAS[name]
