"""What is shown of one frame: reduced images, pose, moving objects and figures."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.result import FrameResult

WIDTH = 320
"""Largest width of the shown images, pixels."""
DEPTH_RANGE = 5.0
"""Depth at the end of the colour scale, metres: about the range of structured-light sensors."""
RESIDUAL_RANGE = 0.05
"""Residual at the ends of the colour scale, metres."""
KINDS = ("color", "depth", "mask", "residuals")
"""The images of a frame."""
_NO_READING = np.array([40, 40, 40], dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class MoverBox:
    """A moving object in one frame.

    Attributes:
        id: Number of the object.
        box: (2, 3) metres, world frame, smallest and largest coordinates.
        speed: m/s.
    """

    id: int
    box: NDArray[np.float64]
    speed: float


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """Pose, moving objects and figures of one frame.

    Attributes:
        timestamp: Seconds.
        T_world_camera: (4, 4), None if lost.
        lost_reason: Empty for a tracked frame.
        movers: The moving objects.
        ms: Processing time, milliseconds.
        residual: Root mean square of the distance residuals at 1 m depth, metres; NaN where nothing was registered.
        dynamic_share: Share of the readings that move.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64] | None
    lost_reason: str
    movers: tuple[MoverBox, ...]
    ms: float
    residual: float
    dynamic_share: float

    @classmethod
    def of(cls, result: "FrameResult", ms: float) -> "FrameFigures":
        """Figures of a processed frame."""
        movers = tuple(MoverBox(mover.id, mover.box, mover.speed) for mover in result.movers)
        residual = np.nan if result.tracking is None else result.tracking.residual
        return cls(
            result.timestamp, result.T_world_camera, result.lost_reason, movers, ms, float(residual),
            result.dynamic_share,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FrameImages:
    """Reduced copies of the images of one frame.

    Attributes:
        color: (h, w, 3) uint8.
        depth: (h, w) metres, 0 = no reading.
        mask: (h, w) bool, dynamic pixels.
        residuals: (h', w') metres, NaN off the map.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.floating]
    mask: NDArray[np.bool_]
    residuals: NDArray[np.float32]

    @classmethod
    def of(cls, frame: "Frame", result: "FrameResult", width: int = WIDTH) -> "FrameImages":
        """Every n-th pixel of the images of a frame, at most ``width`` columns of them."""
        parts = (frame.color, frame.depth, result.dynamic_mask, result.residuals)
        return cls(*(_reduced(part, width) for part in parts))

    def pictures(self) -> dict[str, NDArray[np.uint8]]:
        """Images (h, w, 3) uint8 by the names of ``KINDS``: colour, depth in colours, mask over colour, residuals."""
        return {
            "color": self.color,
            "depth": depth_colors(self.depth),
            "mask": mask_overlay(self.color, self.mask),
            "residuals": residual_colors(self.residuals),
        }

    def files(self) -> dict[str, bytes]:
        """JPEG files of the ``pictures``."""
        return {kind: jpeg(picture) for kind, picture in self.pictures().items()}


def depth_colors(depth: NDArray[np.floating], far: float = DEPTH_RANGE) -> NDArray[np.uint8]:
    """Depth (h, w) in the colours of the turbo scale (h, w, 3) up to ``far``, dark where there is no reading."""
    import cv2

    scaled = np.clip(255 * depth / far, 0, 255).astype(np.uint8)
    colors = np.array(cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1], dtype=np.uint8)
    colors[depth <= 0] = _NO_READING
    return colors


def mask_overlay(color: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colour image (h, w, 3), dimmed, with the masked pixels tinted red."""
    dim = np.right_shift(color, 1)
    if mask.shape != color.shape[:2]:  # a colour camera of another size, whose image has no mask
        return dim
    tint = np.array([127, 0, 0], dtype=np.uint8)
    return np.where(mask[..., None], dim + tint, dim).astype(np.uint8)


def residual_colors(residuals: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Signed residuals (h, w) from blue (-) over white to red (+) (h, w, 3), dark off the map."""
    known = np.isfinite(residuals)
    share = np.clip(np.where(known, residuals, 0) / RESIDUAL_RANGE, -1, 1)[..., None]
    red, blue = np.array([178.0, 24, 43]), np.array([33.0, 102, 172])
    colors = 255 - np.abs(share) * (255 - np.where(share > 0, red, blue))
    return np.where(known[..., None], colors, _NO_READING).astype(np.uint8)


def jpeg(image: NDArray[np.uint8], quality: int = 80) -> bytes:
    """An RGB image (h, w, 3) as a JPEG file."""
    import cv2

    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _reduced(image: NDArray, width: int) -> NDArray:
    step = max(1, -(-image.shape[1] // width))
    return image[::step, ::step].copy()
