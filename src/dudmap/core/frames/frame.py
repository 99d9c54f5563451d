"""A frame of an RGB-D camera."""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError


class FrameArrays(TypedDict, total=False):
    """A frame as plain arrays, see ``Frame.from_arrays``."""

    depth: NDArray[np.float32] | NDArray[np.uint16]
    rgb: NDArray[np.uint8]
    timestamp: float


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

    def __repr__(self) -> str:
        """The sizes without the images."""
        return f"Frame({self.timestamp:.6f} s, depth {self.depth.shape}, colour {self.color.shape})"

    @classmethod
    def from_arrays(
        cls,
        depth: NDArray[np.float32] | NDArray[np.uint16],
        rgb: NDArray[np.uint8],
        timestamp: float,
        depth_scale: float = 1000.0,
    ) -> "Frame":
        """Frame of two images as a sensor, a file or another program gives them.

        Args:
            depth: (H, W), along the optical axis, registered to colour: floating point in metres, where 0 and values
                that are not finite mean no reading, or uint16 in units of ``depth_scale``, where 0 means no reading.
            rgb: (H, W, 3) uint8, red green blue.
            timestamp: Seconds.
            depth_scale: Units of uint16 depth per metre; 1000 = millimetres. Not used for floating point.

        Raises:
            FrameError: An array has another shape or type, or the time is not a finite number.
        """
        if depth.ndim != 2 or not (depth.dtype.kind == "f" or depth.dtype == np.uint16):
            raise FrameError(
                f"depth has the shape {depth.shape} and the type {depth.dtype}; expected (H, W), floating point in "
                "metres or uint16 in units of the camera's depth_scale",
                "type",
            )
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise FrameError(
                f"rgb has the shape {rgb.shape} and the type {rgb.dtype}; expected (H, W, 3) uint8, red green blue",
                "type",
            )
        if not np.isfinite(timestamp):
            raise FrameError(f"the timestamp is {timestamp}; expected a finite number of seconds")
        if depth.dtype.kind == "f":
            metres = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        else:
            metres = depth.astype(np.float32) / np.float32(depth_scale)
        return cls(float(timestamp), metres, np.ascontiguousarray(rgb))
