"""Display data of one frame, and overview images."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_image, writing
from dudmap.core.frames.frame import Frame
from dudmap.errors import DudmapError

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.map.volume import RaycastResult
    from dudmap.core.result import FrameResult

WIDTH = 320
"""Width of shown images, pixels."""
DEPTH_RANGE = 5.0
"""End of the depth's colour scale, metres: structured light's range."""
RESIDUAL_RANGE = 0.05
"""Ends of the residuals' colour scale, metres."""
KINDS = ("color", "depth", "mask", "residuals")
_NO_READING = np.array([40, 40, 40], dtype=np.uint8)

LIGHT = np.array([-0.3, -0.6, -0.75]) / np.linalg.norm([-0.3, -0.6, -0.75])
"""Unit vector towards the light, camera frame."""
TITLE = 28


@dataclass(frozen=True, eq=False)
class MoverBox:
    """A moving object in one frame.

    Attributes:
        box: (2, 3) metres, world frame, extreme coordinates.
        speed: m/s.
    """

    id: int
    box: NDArray[np.float64]
    speed: float


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """Pose, moving objects and metrics of one frame.

    Attributes:
        timestamp: Seconds.
        T_world_camera: (4, 4), None if lost.
        ms: Processing time, milliseconds.
        residual: Root mean square distance residual at 1 m, metres; NaN without registration.
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
        """Metrics of a processed frame."""
        movers = tuple(MoverBox(mover.id, mover.box, mover.speed) for mover in result.movers)
        lost = "" if result.T_world_camera is not None else result.verdict.reason
        return cls(
            result.timestamp, result.T_world_camera, lost, movers, ms, result.verdict.figure("residual_mm") / 1000,
            result.dynamic_share,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FrameImages:
    """Reduced copies of the images of one frame.

    Attributes:
        color: (h, w, 3) uint8.
        depth: (h, w) metres, 0 = missing.
        mask: (h, w) bool, dynamic pixels.
        residuals: (h', w') metres, NaN off the map.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.floating]
    mask: NDArray[np.bool_]
    residuals: NDArray[np.float32]

    @classmethod
    def of(cls, frame: "Frame", result: "FrameResult", width: int = WIDTH) -> "FrameImages":
        """Every n-th pixel, at most ``width`` columns."""
        parts = (frame.rgb, frame.depth, result.dynamic_mask, result.residuals)
        return cls(*(_reduced(part, width) for part in parts))

    def pictures(self) -> dict[str, NDArray[np.uint8]]:
        """Images (h, w, 3) uint8 by ``KINDS``; no residuals in the first frame of a map."""
        pictures = {
            "color": self.color,
            "depth": depth_colors(self.depth),
            "mask": mask_overlay(self.color, self.mask),
        }
        return pictures | ({"residuals": residual_colors(self.residuals)} if np.isfinite(self.residuals).any() else {})

    def files(self) -> dict[str, bytes]:
        """JPEG files of the ``pictures``."""
        return {kind: jpeg(picture) for kind, picture in self.pictures().items()}


def shading(normals: NDArray[np.float32], T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
    """Brightness (H, W), 0..1, of normals (H, W, 3), world frame, lit near the camera."""
    return (0.25 + 0.7 * np.clip(normals @ (T_world_camera[:3, :3] @ LIGHT), 0, 1)).astype(np.float32)


def depth_colors(depth: NDArray[np.floating], far: float = DEPTH_RANGE) -> NDArray[np.uint8]:
    """Depth (h, w) in the turbo scale (h, w, 3) up to ``far``; missing is dark."""
    import cv2

    scaled = np.clip(255 * depth / far, 0, 255).astype(np.uint8)
    colors = np.array(cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1], dtype=np.uint8)
    colors[depth <= 0] = _NO_READING
    return colors


def mask_overlay(color: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Dimmed image (h, w, 3) with masked pixels red."""
    dim = np.right_shift(color, 1)
    if mask.shape != color.shape[:2]:  # a colour camera of another size has no mask
        return dim
    tint = np.array([127, 0, 0], dtype=np.uint8)
    return np.where(mask[..., None], dim + tint, dim).astype(np.uint8)


def residual_colors(residuals: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Residuals (h, w) from blue (-) over white to red (+) (h, w, 3), dark off the map."""
    known = np.isfinite(residuals)
    share = np.clip(np.where(known, residuals, 0) / RESIDUAL_RANGE, -1, 1)[..., None]
    red, blue = np.array([178.0, 24, 43]), np.array([33.0, 102, 172])
    colors = 255 - np.abs(share) * (255 - np.where(share > 0, red, blue))
    return np.where(known[..., None], colors, _NO_READING).astype(np.uint8)


def jpeg(image: NDArray[np.uint8], quality: int = 80) -> bytes:
    """Encode an RGB image (h, w, 3) as JPEG."""
    import cv2

    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _reduced(image: NDArray, width: int) -> NDArray:
    step = max(1, -(-image.shape[1] // width))
    return image[::step, ::step].copy()


def save_sheet(
    path: str | Path,
    frame: Frame,
    dynamic_mask: NDArray[np.bool_],
    residuals: NDArray[np.floating],
    view: "RaycastResult",
    T_world_camera: NDArray[np.float64],
    true_mask: NDArray[np.bool_] | None = None,
) -> None:
    """Write a PNG file with colour, depth, mask, residuals and the map from the frame's pose (4, 4).

    ``residuals``: (h, w) signed, metres, NaN = unknown; ``true_mask`` (H, W): outline.

    Raises:
        DudmapError: The file cannot be written.
    """
    far, title = _far([frame]), "dynamic mask: estimated (red)"
    overlay = mask_overlay(frame.rgb, dynamic_mask)
    if true_mask is not None and true_mask.any():
        outline, _ = cv2.findContours(true_mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(overlay, outline, -1, (0, 255, 0), 1)
        title += ", true (green outline)"
    brightness = shading(view.normals, T_world_camera)
    known, limit = view.depth[..., None] > 0, f"{100 * RESIDUAL_RANGE:.0f} cm"
    pictures = [
        ("colour", frame.rgb),
        (f"depth, blue 0 to red {far:.1f} m", depth_colors(frame.depth, far)),
        (title, overlay),
        (f"residuals, blue -{limit} to red {limit}", residual_colors(residuals)),
        ("rendered map: colour", np.where(known, view.color, 255)),
        ("rendered map: shape", np.where(known, 255 * brightness[..., None], 255).repeat(3, axis=2)),
    ]
    _save(path, np.vstack([_row(pictures[:3], 480, 3), _row(pictures[3:], 480, 3)]))


def save_overview(path: str | Path, frames: "list[tuple[int, Frame]]") -> None:
    """Write a PNG file with colour and depth of numbered frames, six in a row.

    Raises:
        DudmapError: There is no frame, or the file cannot be written.
    """
    if not frames:
        raise DudmapError(f"no frame can be read, so there is nothing to draw in {path}")
    columns, far, rows = min(6, len(frames)), _far([frame for _, frame in frames]), []
    for start in range(0, len(frames), columns):
        part = frames[start : start + columns]
        rows.append(_row(((f"{n}: {frame.timestamp:.2f} s", frame.rgb) for n, frame in part), 240, columns))
        label = f"blue 0 to red {far:.1f} m"
        rows.append(_row(((label, depth_colors(frame.depth, far)) for _, frame in part), 240, columns))
    _save(path, np.vstack(rows))


def _far(frames: list[Frame]) -> float:
    readings = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    return float(np.percentile(readings, 99)) if len(readings) else 1.0


def _row(pictures: Iterable[tuple[str, NDArray]], width: int, columns: int) -> NDArray[np.uint8]:
    scaled = [(title, cv2.resize(np.asarray(image, np.uint8), (width, width * image.shape[0] // image.shape[1])))
              for title, image in pictures]  # fmt: skip
    row = np.full((TITLE + max(len(image) for _, image in scaled), columns * width, 3), 255, np.uint8)
    for column, (title, image) in enumerate(scaled):
        left = column * width
        row[TITLE : TITLE + len(image), left : left + width] = image
        cv2.putText(row, title, (left + 4, TITLE - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return row


def _save(path: str | Path, image: NDArray[np.uint8]) -> None:
    with writing(f"the image {path}"):
        write_image(path, image)
