"""A frame of an RGB-D camera."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """Depth and colour image of about one instant.

    Attributes:
        timestamp: Seconds, of the depth image.
        depth: (H, W) float32, metres along the optical axis, 0 where there is no reading.
        color: (H, W, 3) uint8, red green blue; of another size where the colour camera is another one.
        color_timestamp: Seconds, of the colour image; None if that is not known. It is used where a calibration of the
            colour camera is.
    """

    timestamp: float
    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    color_timestamp: float | None = None
