"""Overview images: of one processed frame with mask, residuals and map, or of the frames of a recording."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.snapshot import RESIDUAL_RANGE, depth_colors, mask_overlay, residual_colors
from dudmap.atomic_file import write_bytes
from dudmap.core.frames.frame import Frame
from dudmap.errors import DudmapError

if TYPE_CHECKING:
    from dudmap.core.map.volume import RaycastResult

LIGHT = np.array([-0.3, -0.6, -0.75]) / np.linalg.norm([-0.3, -0.6, -0.75])
"""Unit vector towards the light of the shaded view, camera frame."""
TITLE = 28
"""Height of the text above a picture, pixels."""


def save_sheet(
    path: str | Path,
    frame: Frame,
    dynamic_mask: NDArray[np.bool_],
    residuals: NDArray[np.floating],
    view: "RaycastResult",
    T_world_camera: NDArray[np.float64],
    true_mask: NDArray[np.bool_] | None = None,
) -> None:
    """Write a PNG file with colour, depth, dynamic mask, residuals and the map rendered from the same pose.

    Args:
        path: The PNG file.
        frame: The unprocessed frame.
        dynamic_mask: (H, W) estimated dynamic mask.
        residuals: (h, w) signed distance of the readings to the map in metres, NaN where there is none.
        view: The map rendered from the pose of the frame.
        T_world_camera: (4, 4) pose of the frame.
        true_mask: (H, W) true dynamic mask, drawn as an outline.

    Raises:
        DudmapError: The file cannot be written.
    """
    far, title = _far([frame]), "dynamic mask: estimated (red)"
    overlay = mask_overlay(frame.color, dynamic_mask)
    if true_mask is not None and true_mask.any():
        outline, _ = cv2.findContours(true_mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(overlay, outline, -1, (0, 255, 0), 1)
        title += ", true (green outline)"
    brightness = 0.25 + 0.7 * np.clip(view.normals @ (T_world_camera[:3, :3] @ LIGHT), 0, 1)
    known, limit = view.depth[..., None] > 0, f"{100 * RESIDUAL_RANGE:.0f} cm"
    pictures = [
        ("colour", frame.color),
        (f"depth, blue 0 to red {far:.1f} m", depth_colors(frame.depth, far)),
        (title, overlay),
        (f"residuals, blue -{limit} to red {limit}", residual_colors(residuals)),
        ("rendered map: colour", np.where(known, view.color, 255)),
        ("rendered map: shape", np.where(known, 255 * brightness[..., None], 255).repeat(3, axis=2)),
    ]
    _save(path, np.vstack([_row(pictures[:3], 480, 3), _row(pictures[3:], 480, 3)]))


def save_overview(path: str | Path, frames: "list[tuple[int, Frame]]") -> None:
    """Write a PNG file with colour and depth of frames of a recording, one frame a column, six in a row.

    Args:
        path: The PNG file.
        frames: Numbers and frames, at least one.

    Raises:
        DudmapError: There is no frame, or the file cannot be written.
    """
    if not frames:
        raise DudmapError(f"no frame can be read, so there is nothing to draw in {path}")
    columns, far, rows = min(6, len(frames)), _far([frame for _, frame in frames]), []
    for start in range(0, len(frames), columns):
        part = frames[start : start + columns]
        rows.append(_row(((f"{n}: {frame.timestamp:.2f} s", frame.color) for n, frame in part), 240, columns))
        label = f"blue 0 to red {far:.1f} m"
        rows.append(_row(((label, depth_colors(frame.depth, far)) for _, frame in part), 240, columns))
    _save(path, np.vstack(rows))


def _far(frames: list[Frame]) -> float:
    """Depth at the end of the colour scale, metres."""
    readings = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    return float(np.percentile(readings, 99)) if len(readings) else 1.0


def _row(pictures: Iterable[tuple[str, NDArray]], width: int, columns: int) -> NDArray[np.uint8]:
    """Pictures (h, w, 3) of one width side by side, each below its title, on a white row of a number of columns."""
    scaled = [(title, cv2.resize(np.asarray(image, np.uint8), (width, width * image.shape[0] // image.shape[1])))
              for title, image in pictures]  # fmt: skip
    row = np.full((TITLE + max(len(image) for _, image in scaled), columns * width, 3), 255, np.uint8)
    for column, (title, image) in enumerate(scaled):
        left = column * width
        row[TITLE : TITLE + len(image), left : left + width] = image
        cv2.putText(row, title, (left + 4, TITLE - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return row


def _save(path: str | Path, image: NDArray[np.uint8]) -> None:
    try:
        write_bytes(Path(path), cv2.imencode(".png", image[..., ::-1])[1].tobytes())
    except OSError as error:
        raise DudmapError(f"cannot write the image {path}: {error.strerror or error}") from error
