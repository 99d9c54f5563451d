"""Overview images: of one processed frame with mask, residuals and map, or of the frames of a recording."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file
from dudmap.core.frames.frame import Frame
from dudmap.errors import DudmapError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from dudmap.core.map.volume import RaycastResult

RESIDUAL_RANGE = 0.05
"""Residual at the end of the colour scale, metres."""
LIGHT = np.array([-0.3, -0.6, -0.75]) / np.linalg.norm([-0.3, -0.6, -0.75])
"""Unit vector towards the light of the shaded view, camera frame."""


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
    figure, axes, far = _figure((15, 8), 2, 3, [frame])
    _show(axes[0, 0], "colour", frame.color)
    depth = _show(axes[0, 1], "depth", np.ma.masked_equal(frame.depth, 0), cmap="viridis", limits=(0, far))
    figure.colorbar(depth, ax=axes[0, 1], label="m", shrink=0.7)
    overlaid = np.where(dynamic_mask[..., None], frame.color // 2 + np.array([127, 0, 0], np.uint8), frame.color)
    _show(axes[0, 2], "dynamic mask: estimated (red)", overlaid)
    if true_mask is not None and true_mask.any():
        axes[0, 2].contour(true_mask, levels=[0.5], colors="lime", linewidths=1)
        axes[0, 2].set_title("dynamic mask: estimated (red), true (green outline)")
    shown = np.ma.masked_invalid(residuals)
    limit = RESIDUAL_RANGE
    distance = _show(axes[1, 0], "residuals: signed distance to the map", shown, cmap="RdBu", limits=(-limit, limit))
    figure.colorbar(distance, ax=axes[1, 0], label="m", shrink=0.7)
    _show(axes[1, 1], "rendered map: colour", np.where(view.depth[..., None] > 0, view.color, 255))
    _show(axes[1, 2], "rendered map: shape", _shaded(view, T_world_camera))
    _save(figure, path)


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
    columns, rows = min(6, len(frames)), -(-len(frames) // 6)
    figure, axes, far = _figure((3 * columns, 4.8 * rows), 2 * rows, columns, [frame for _, frame in frames])
    for axis in axes.ravel():
        axis.set_axis_off()
    drawn = []
    for place, (number, frame) in enumerate(frames):
        row, column = divmod(place, columns)
        _show(axes[2 * row, column], f"{number}: {frame.timestamp:.2f} s", frame.color)
        shown = np.ma.masked_equal(frame.depth, 0)
        drawn.append(_show(axes[2 * row + 1, column], "", shown, cmap="viridis", limits=(0, far)))
    figure.colorbar(drawn[0], ax=axes.ravel().tolist(), label="m", shrink=0.5)
    _save(figure, path)


def _figure(
    size: tuple[float, float], rows: int, columns: int, frames: list[Frame]
) -> "tuple[Figure, NDArray[np.object_], float]":
    """Figure of a size in inches with its axes (rows, columns), and the depth at the end of the colour scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    readings = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    far = float(np.percentile(readings, 99)) if len(readings) else 1.0
    return figure, figure.subplots(rows, columns, squeeze=False), far


def _save(figure: "Figure", path: str | Path) -> None:
    try:
        with atomic_file(path) as file:
            figure.savefig(file, dpi=80, format="png")
    except OSError as error:
        raise DudmapError(f"cannot write the image {path}: {error.strerror or error}") from error


def _shaded(view: "RaycastResult", T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey image (H, W, 3) of the surface of a view, lit from beside the camera; white where there is no surface."""
    light = T_world_camera[:3, :3] @ LIGHT
    brightness = 0.25 + 0.7 * np.clip(view.normals @ light, 0, 1)
    grey = np.where(view.depth > 0, 255 * brightness, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def _show(
    axes: "Axes", title: str, image: NDArray, cmap: str | None = None, limits: tuple[float, float] | None = None
) -> "AxesImage":
    axes.set_title(title)
    axes.set_axis_off()
    low, high = limits or (None, None)
    return axes.imshow(image, interpolation="nearest", cmap=cmap, vmin=low, vmax=high)
