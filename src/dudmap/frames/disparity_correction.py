"""Correction of depth readings whose disparity is off by an offset and a stretch along the baseline."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Observation
from dudmap.geometry.camera import Camera


@dataclass(frozen=True)
class DisparityCorrection:
    """Adds ``offset + stretch x`` to the inverse depth of a reading in image direction (x, y, 1).

    A triangulating sensor measures the disparity d = f b / z. A change of its optics by temperature shifts and
    stretches the disparity image along the baseline b, which is horizontal: by f b (offset + stretch x), whatever the
    depth.

    Attributes:
        offset: 1/m.
        stretch: 1/m.
    """

    offset: float = 0.0
    stretch: float = 0.0

    def __bool__(self) -> bool:
        return self.offset != 0 or self.stretch != 0

    def depth(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Corrected depth (h, w) in metres of ``camera``: z / (1 + z (offset + stretch x)); 0 stays 0."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        change = (self.offset + self.stretch * x).astype(np.float32)
        divisor = depth * change
        divisor += np.float32(1)
        return np.divide(depth, divisor, out=divisor)

    def observation(self, observation: Observation) -> Observation:
        """The observation with corrected depth, also where it has been halved."""
        camera = observation.camera
        halvings = [
            (self.depth(depth, camera.scaled(level)), intensity)
            for level, (depth, intensity) in enumerate(observation._halvings, start=1)
        ]
        return replace(observation, depth=self.depth(observation.depth, camera), _halvings=halvings)
