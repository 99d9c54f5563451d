"""A frame of an RGB-D camera."""

from dataclasses import dataclass, replace
from typing import TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError, FrameError


class FrameArrays(TypedDict, total=False):
    """A frame as plain arrays, see ``Frame.from_arrays``."""

    depth: NDArray[np.float32] | NDArray[np.uint16]
    rgb: NDArray[np.uint8] | None
    timestamp: float


NO_COLOR = (
    "{} has the shape {} and the type {}; expected (H, W, 3) uint8, red green blue; 16-bit values are depth, which "
    "needs no colour"
)
FARTHEST = 65.535
"""Largest depth of a 16-bit image of millimetres, metres. A floating-point image beyond it is of another unit."""
GREY = 192
"""Grey value of frames without colour: light, so that shading is visible."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Depth and colour image of about one instant. The constructor copies nothing; ``Slam`` does.

    Attributes:
        timestamp: Seconds, of the depth image.
        depth: (H, W) float32, metres along the optical axis, 0 = no measurement.
        color: (H, W, 3) uint8, red green blue; a separate camera may have another size. None: registered by distances
            alone.
        color_timestamp: Seconds; None if unknown. Used with a colour calibration.
    """

    timestamp: float
    depth: NDArray[np.float32]
    color: NDArray[np.uint8] | None = None
    color_timestamp: float | None = None

    def __repr__(self) -> str:
        color = "no colour" if self.color is None else f"colour {self.color.shape}"
        return f"Frame({self.timestamp:.6f} s, depth {self.depth.shape}, {color})"

    def copy(self) -> "Frame":
        """Copy with copied images."""
        return replace(self, depth=np.array(self.depth), color=None if self.color is None else np.array(self.color))

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """Colours (H, W, 3) uint8; ``GREY`` in the size of ``depth`` without colour."""
        return np.full((*self.depth.shape, 3), GREY, np.uint8) if self.color is None else self.color

    @classmethod
    def from_arrays(
        cls,
        depth: NDArray[np.float32] | NDArray[np.uint16],
        rgb: NDArray[np.uint8] | None = None,
        timestamp: float = np.nan,
        depth_scale: float = 1000.0,
    ) -> "Frame":
        """Frame of copies of two images.

        Args:
            depth: (H, W) along the optical axis, registered to colour. Floating point: metres, 0 and non-finite = none.
                uint16: ``depth_scale``, 0 = none.
            rgb: (H, W, 3) uint8, red green blue; None for none.
            timestamp: Seconds.
            depth_scale: uint16 units per metre; 1000 = millimetres.

        Raises:
            FrameError: An argument is not an array or has the wrong shape or type, or the time is not finite.
        """
        for name, image in (("depth", depth), ("rgb", rgb)):
            if not (hasattr(image, "__array__") or (name == "rgb" and image is None)):
                raise FrameError(f"{name} is a {type(image).__name__}; expected a NumPy array", "type")
        readings = np.asarray(depth)
        integers = readings.dtype.kind == "u" and readings.dtype.itemsize == 2  # of either byte order
        if readings.ndim != 2 or not (readings.dtype.kind == "f" or integers):
            raise FrameError(
                f"depth has the shape {readings.shape} and the type {readings.dtype}; expected (H, W), floating point "
                "in metres or uint16 in units of the camera's depth_scale",
                "type",
            )
        color = None if rgb is None else np.array(rgb, order="C")
        if color is not None and (color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8):
            raise FrameError(NO_COLOR.format("rgb", color.shape, color.dtype), "type")
        if not np.isfinite(timestamp):
            raise FrameError(f"the timestamp is {timestamp}; expected a finite number of seconds")
        if integers:
            metres = readings.astype(np.float32) / np.float32(depth_scale)
        else:
            metres = np.where(np.isfinite(readings), readings, 0).astype(np.float32)
            sample = metres[::8, ::8]
            if (sample > FARTHEST).sum() > (sample > 0).sum() / 2:
                raise FrameError(
                    f"most depths are above {FARTHEST:g} (the largest is {sample.max():g}); floating point is metres: "
                    "divide millimetres by 1000"
                )
        return cls(float(timestamp), metres, color)


_Prepared = TypeVar("_Prepared")


def given_frame(frame: _Prepared | None, arrays: FrameArrays, depth_scale: float) -> "_Prepared | Frame":
    """The frame, or a frame made of ``arrays`` (see ``Frame.from_arrays``).

    Raises:
        ConfigError: Neither a frame nor both ``depth`` and ``timestamp`` are given, or both kinds.
        FrameError: The frame is something else, or as for ``Frame.from_arrays``.
    """
    if (frame is None) != (set(arrays) | {"rgb"} == {"depth", "rgb", "timestamp"}) or (frame is not None and arrays):
        raise ConfigError("Slam.process takes either a frame, or depth=, timestamp= and, if there is colour, rgb=")
    if frame is not None and not hasattr(frame, "timestamp"):
        raise FrameError(f"the frame is a {type(frame).__name__}; expected a Frame, or depth= and rgb=", "type")
    return Frame.from_arrays(**arrays, depth_scale=depth_scale) if frame is None else frame  # pyright: ignore
