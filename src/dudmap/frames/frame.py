"""A frame of an RGB-D camera."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """Depth and colour image of one instant, registered to one camera.

    Attributes:
        timestamp: Seconds, of the depth image.
        depth: (H, W) float32, metres along the optical axis, 0 where there is no reading.
        color: (H, W, 3) uint8, red green blue.
    """

    timestamp: float
    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
