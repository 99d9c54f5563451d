"""One picture of what a run saw and what it made of it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DudmapError
from dudmap.frames.frame import Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from dudmap.mapping.volume import RaycastResult

RESIDUAL_RANGE = 0.05
"""Residuals beyond this have the deepest colour, metres."""
LIGHT = np.array([-0.3, -0.6, -0.75]) / np.linalg.norm([-0.3, -0.6, -0.75])
"""Direction to the light of the shaded view, camera frame."""


def save_sheet(
    path: str | Path,
    frame: Frame,
    dynamic_mask: NDArray[np.bool_],
    residuals: NDArray[np.floating],
    view: "RaycastResult",
    T_world_camera: NDArray[np.float64],
    true_mask: NDArray[np.bool_] | None = None,
) -> None:
    """Write a PNG with colour, depth, dynamic mask, residuals and the map seen from the same pose.

    Args:
        path: The PNG file.
        frame: The frame as it came from the camera.
        dynamic_mask: (H, W) what was found to move.
        residuals: (h, w) signed distance of the readings to the map in metres, NaN = none.
        view: The map seen from the frame's pose.
        T_world_camera: (4, 4) that pose.
        true_mask: (H, W) what truly moves, drawn as an outline.

    Raises:
        DudmapError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    far = float(np.percentile(frame.depth[frame.depth > 0], 99)) if np.any(frame.depth > 0) else 1.0
    _show(axes[0, 0], "colour", frame.color)
    depth = _show(axes[0, 1], "depth", np.ma.masked_equal(frame.depth, 0), cmap="viridis", limits=(0, far))
    figure.colorbar(depth, ax=axes[0, 1], label="m", shrink=0.7)
    _show(axes[0, 2], "dynamic: found (red)", _overlaid(frame.color, dynamic_mask))
    if true_mask is not None and true_mask.any():
        axes[0, 2].contour(true_mask, levels=[0.5], colors="lime", linewidths=1)
        axes[0, 2].set_title("dynamic: found (red), true (green line)")
    shown = np.ma.masked_invalid(residuals)
    limit = RESIDUAL_RANGE
    distance = _show(axes[1, 0], "residuals: distance to the map", shown, cmap="RdBu", limits=(-limit, limit))
    figure.colorbar(distance, ax=axes[1, 0], label="m", shrink=0.7)
    _show(axes[1, 1], "the map from the same pose: colour", np.where(view.depth[..., None] > 0, view.color, 255))
    _show(axes[1, 2], "the map from the same pose: shape", shaded(view, T_world_camera))
    try:
        figure.savefig(path, dpi=80, format="png")
    except OSError as error:
        raise DudmapError(f"cannot write the picture {path}: {error.strerror or error}") from error


def shaded(view: "RaycastResult", T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey image (H, W, 3) of a view's surface under one lamp beside the camera; white where there is none."""
    light = T_world_camera[:3, :3] @ LIGHT
    brightness = 0.25 + 0.7 * np.clip(view.normals @ light, 0, 1)
    grey = np.where(view.depth > 0, 255 * brightness, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def _overlaid(color: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    out = color.copy()
    out[mask] = out[mask] // 2 + np.array([127, 0, 0], dtype=np.uint8)
    return out


def _show(
    axes: "Axes", title: str, image: NDArray, cmap: str | None = None, limits: tuple[float, float] | None = None
) -> "AxesImage":
    axes.set_title(title)
    axes.set_axis_off()
    low, high = limits or (None, None)
    return axes.imshow(image, interpolation="nearest", cmap=cmap, vmin=low, vmax=high)
