"""Labels of a frame, and the masks derived from them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import labeling
from dudmap.core.dynamics.label_scale import pixel_scale, scaled_side
from dudmap.core.dynamics.mixture import Mixture
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Level
from dudmap.core.map.volume import MapSample


@dataclass(frozen=True, eq=False)
class Labels:
    """Static and dynamic pixels of one frame, at the resolution of the label level.

    Attributes:
        static_probability: (h, w) float32 in [0, 1]; the weights of the second registration.
        dynamic: (h, w) bool.
        mixture: The fitted densities; None for methods that fit none.
        histogram: (BINS,) counts of the normalised residuals.
        sample: Distance, intensity difference and occupancy of the map at the points of the frame.
        segmentation: Surface segments of the frame; None where motion is not decided by segment.
        hidden: (h, w) bool, pixels without a reading in front of known background; None where that is not examined.
    """

    static_probability: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    mixture: Mixture | None
    histogram: NDArray[np.int64]
    sample: MapSample
    segmentation: Segmentation | None = None
    hidden: NDArray[np.bool_] | None = None


SEAM = 1
"""Half width of the seams along depth edges where readings fit no map, pixels at REFERENCE_WIDTH."""
CLOSING_RADIUS = 2
"""Half width of the holes in the depth that belong to the dynamic region around them, pixels at REFERENCE_WIDTH."""


def opened_mask(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (h, w) of an image without parts as thin as the seams along its depth edges."""
    import cv2

    side = scaled_side(SEAM, level)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def full_mask(labels: Labels, level: Level, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Dynamic pixels (H, W) bool at full resolution, with the holes of the depth inside of a dynamic region.

    Args:
        labels: Labels of the frame.
        level: The image they belong to.
        depth: (H, W) float32, metres, 0 = none.
    """
    import cv2

    hidden = labels.hidden is not None and labels.hidden.any()
    if not (hidden or labels.dynamic.any()):
        return np.zeros(depth.shape, dtype=bool)
    element = elliptical_kernel(CLOSING_RADIUS * pixel_scale(level))
    low = cv2.morphologyEx(labels.dynamic.view(np.uint8), cv2.MORPH_CLOSE, element)
    low[(level.depth > 0) & ~labels.dynamic] = 0
    if hidden:
        low[labels.hidden] = 1
    return full_size(low.view(np.bool_), level.depth, depth)


def full_size(low: NDArray[np.bool_], low_depth: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (h, w) of a pyramid level at the resolution (H, W) of its depth image; see ``labeling.upsample_labels``.

    Args:
        low: (h, w) bool; a level is made by halvings, which round odd sizes down.
        low_depth: (h, w) float32, metres, 0 = none.
        depth: (H, W) float32, metres, 0 = none.
    """
    halvings = round(math.log2(depth.shape[1] / low.shape[1]))
    return labeling.upsample_labels(low, low_depth, depth, 1 << halvings)


def outside(mask: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    """Pixels (H, W) that lie farther than so many pixels from those of a mask."""
    import cv2

    marks, out = mask.view(np.uint8), np.full(mask.shape, 1, np.uint8)
    x, y, width, height = cv2.boundingRect(marks)
    if width:
        rows, columns = slice(max(y - margin, 0), y + height + margin), slice(max(x - margin, 0), x + width + margin)
        grown = cv2.dilate(marks[rows, columns], elliptical_kernel(margin)) if margin else marks[rows, columns]
        out[rows, columns] = 1 - grown
    return out.view(np.bool_)


@lru_cache(maxsize=16)
def elliptical_kernel(radius: float) -> NDArray[np.uint8]:
    """Elliptical structuring element of at least 3x3 pixels."""
    import cv2

    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)
