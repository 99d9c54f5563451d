"""Connected regions of moving pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.labeling import grow_regions
from dudmap.core.frames.observation import Level

SAMPLES = 50
"""Points that determine the box of a region."""
MAX_REGIONS = 24
"""Regions per frame, largest first."""
MIN_SHARE = 12 / (160 * 120)
"""Smallest region, share of the image: 12 pixels of a default label image."""
OCCLUSION_GAP = 0.1
"""Depth step at an object's border that occludes it, reference depths."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of moving pixels, connected in image and depth, largest first.

    Attributes:
        pixels: Per region (n,) indices into the flattened image, ascending.
        areas: Visible surface per region, square metres.
        gaps: (R, R) distance between the boxes of two regions, metres.
    """

    pixels: list[NDArray[np.intp]]
    areas: list[float]
    gaps: NDArray[np.float32]


def connected_regions(moving: NDArray[np.bool_], level: Level) -> NDArray[np.int32]:
    """Number of the region of each moving pixel (h, w) that has a depth; from 1, 0 elsewhere."""
    tolerance = np.float32(0.02) + np.float32(0.02) * level.depth
    return grow_regions(moving, moving, level.depth, tolerance)[0]


def measured_regions(numbers: NDArray[np.int32], level: Level) -> Regions | None:
    """The regions with numbers (h, w) above 0, without specks; None if there are none."""
    flat = np.flatnonzero(numbers)
    number = numbers.reshape(-1)[flat]
    sizes = np.bincount(number, minlength=1)
    kept = np.argsort(-sizes, kind="stable")[:MAX_REGIONS]
    kept = kept[sizes[kept] >= MIN_SHARE * numbers.size]
    if len(kept) == 0:
        return None
    rank = np.full(len(sizes), len(kept))
    rank[kept] = np.arange(len(kept))
    flat = flat[np.argsort(rank[number], kind="stable")[: sizes[kept].sum()]]
    starts = np.append(0, np.cumsum(sizes[kept])[:-1])
    z = level.depth.reshape(-1)[flat]
    areas = np.add.reduceat(z * z, starts) / (level.camera.fx * level.camera.fy)
    sample = (starts[:, None] + sizes[kept][:, None] * np.arange(SAMPLES) // SAMPLES).reshape(-1)
    v, u = np.divmod(flat[sample], numbers.shape[1])
    points = np.sort(level.camera.points(u, v, z[sample]).reshape(len(kept), SAMPLES, 3), axis=1)
    low, high = points[:, 1], points[:, -2]  # without the outermost 2 %, which mix measurements of two surfaces
    gaps = np.linalg.norm(np.maximum(np.maximum(low[:, None] - high, low - high[:, None]), 0), axis=2)
    return Regions(np.split(flat, starts[1:]), areas.tolist(), gaps)


def split_between(region: NDArray[np.bool_], predicted: NDArray[np.uint8], objects: Sequence[int]) -> NDArray[np.int32]:
    """Object of each pixel of a region (h, w): of the nearest pixel predicted as one of ``objects``."""
    import cv2

    certain = region & np.isin(predicted, objects)
    _, nearest = cv2.distanceTransformWithLabels(
        (~certain).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, dtype=np.int64)
    owner_of_seed = np.zeros(int(nearest.max()) + 1, dtype=np.uint8)
    owner_of_seed[nearest[certain]] = predicted[certain]
    return owner_of_seed[nearest[region]].astype(np.int32)


def trimmed_box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Extent (2, 3) of points (n, 3) without the outermost 1 % on each side."""
    sample = np.sort(points[:: 1 + len(points) // 300], axis=0)
    cut = len(sample) // 100
    return sample[[cut, -1 - cut]].astype(np.float64)


def is_fully_visible(mask: NDArray[np.bool_], depth: NDArray[np.float32], reference_depth: float = 1.0) -> bool:
    """Whether neither the image border nor an occluder cuts an object (h, w) off."""
    import cv2

    if mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any():
        return False
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    crop = np.s_[max(rows[0] - 2, 0) : rows[-1] + 3, max(columns[0] - 2, 0) : columns[-1] + 3]
    mask, depth = mask[crop], depth[crop]
    nearest = cv2.erode(np.where(mask, depth, np.float32(100)), np.ones((5, 5), np.uint8))
    ring = (nearest < 100) & ~mask
    gap = np.float32(OCCLUSION_GAP * reference_depth)
    occluded = ring & (depth > 0) & (depth < nearest - gap - np.float32(0.03) * depth)
    return bool(np.count_nonzero(occluded) <= 0.1 * np.count_nonzero(ring))
