"""Connected regions of moving pixels: the candidates for moving objects in one frame."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import labeling
from dudmap.core.frames.observation import Level

SAMPLES = 60
"""Number of points per region for the distance to another region."""
MAX_REGIONS = 24
"""Largest number of regions per frame; the largest regions are used."""
MIN_SHARE = 12 / (160 * 120)
"""Smallest region as a share of the image; smaller ones are noise: 12 pixels of a default label image."""
OCCLUSION_GAP = 0.1
"""Depth step at an object's border beyond which a nearer surface occludes the object, reference depths."""


@dataclass(frozen=True, eq=False)
class MovingPixels:
    """Moving pixels of a frame, sorted by connected region.

    Attributes:
        flat: (n,) int, index of each pixel in the flattened image.
        points: (n, 3) float32, metres, world frame.
        area: (n,) float32, surface of each pixel across the line of sight, square metres.
        predicted_id: (n,) int32, number of the predicted object, 0 = none.
        shape: Height and width of the image.
    """

    flat: NDArray[np.int64]
    points: NDArray[np.float32]
    area: NDArray[np.float32]
    predicted_id: NDArray[np.int32]
    ranges: list[tuple[int, int]]
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Region:
    """Summary of a connected set of moving pixels.

    Attributes:
        indices: (k,) int, into ``MovingPixels``.
        area: Visible surface, square metres.
        predicted_id: Most frequent predicted number, 0 = none.
        sample: (m, 3) float32, some of its points, metres, world frame; ``box``: their extreme coordinates.
    """

    indices: NDArray[np.int64]
    area: float
    predicted_id: int
    sample: NDArray[np.float32]
    box: list[list[float]]

    @classmethod
    def of(cls, pixels: MovingPixels, indices: NDArray[np.int64]) -> "Region":
        """Summary of the given pixels (k,)."""
        predicted_id = int(np.argmax(np.bincount(pixels.predicted_id[indices])))
        sample = pixels.points[indices[:: max(1, len(indices) // SAMPLES)]]
        box = [sample.min(axis=0).tolist(), sample.max(axis=0).tolist()]
        return cls(indices, float(pixels.area[indices].sum()), predicted_id, sample, box)

    def is_near(self, other: "Region", distance: float) -> bool:
        """Whether sampled points of the two regions are closer than ``distance``, metres."""
        for low, high, other_low, other_high in zip(*self.box, *other.box, strict=True):
            if low - other_high > distance or other_low - high > distance:
                return False
        corner = np.array(self.box[0], np.float32)
        p, q = self.sample - corner, other.sample - corner
        squared = np.einsum("ij,ij->i", p, p)[:, None] + np.einsum("ij,ij->i", q, q) - 2 * p @ q.T
        return float(squared.min()) < distance**2


def connected_regions(
    dynamic: NDArray[np.bool_], level: Level, T_world_camera: NDArray[np.float64], predicted_ids: NDArray[np.int32]
) -> MovingPixels | None:
    """Moving pixels (h, w) grouped into regions connected in the image and in depth; None if all regions are too small.

    ``predicted_ids``: object predicted in each 2x2 block, 0 = none.
    """
    moving = dynamic & (level.depth > 0)
    if not moving.any():
        return None
    tolerance = np.float32(0.02) + np.float32(0.02) * level.depth
    regions, count = labeling.grow_regions(moving, moving, level.depth, tolerance)
    flat = np.flatnonzero(moving)
    number, depth = regions.reshape(-1)[flat], level.depth.reshape(-1)[flat]
    sizes = np.bincount(number, minlength=count + 1)
    area = np.square(depth) / np.float32(level.camera.fx * level.camera.fy)
    areas = np.bincount(number, area, minlength=count + 1)
    areas[sizes < MIN_SHARE * moving.size] = 0
    kept = np.argsort(-areas, kind="stable")[:MAX_REGIONS]
    kept = kept[areas[kept] > 0]
    if len(kept) == 0:
        return None
    rank = np.full(count + 1, len(kept), dtype=np.int64)
    rank[kept] = np.arange(len(kept))
    order = np.argsort(rank[number], kind="stable")[: sizes[kept].sum()]
    flat = flat[order]
    stops = np.cumsum(sizes[kept])
    ranges = [(int(stop - size), int(stop)) for stop, size in zip(stops, sizes[kept], strict=True)]
    v, u = np.divmod(flat, moving.shape[1])
    T = T_world_camera.astype(np.float32)
    points = level.camera.points(u, v, depth[order]) @ T[:3, :3].T + T[:3, 3]
    return MovingPixels(
        flat,
        np.asarray(points, np.float32),
        np.asarray(area[order], np.float32),
        predicted_ids[v // 2, u // 2],
        ranges,
        level.camera.shape,
    )


def split_between(pixels: MovingPixels, indices: NDArray[np.int64], ids: Collection[int]) -> list[NDArray[np.int64]]:
    """Pixels (k,) of a region per object of ``ids``, each predicted in it: a pixel belongs to the object of the
    nearest predicted pixel."""
    import cv2

    predicted = pixels.predicted_id[indices]
    certain = np.isin(predicted, list(ids))
    seeds = np.ones(pixels.shape, dtype=np.uint8)
    seeds.reshape(-1)[pixels.flat[indices[certain]]] = 0
    _, nearest = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(nearest, dtype=np.int64).reshape(-1)
    owner_of_seed = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
    owner_of_seed[nearest[pixels.flat[indices[certain]]]] = predicted[certain]
    owner = owner_of_seed[nearest[pixels.flat[indices]]]
    return [indices[owner == number] for number in ids]


def trimmed_box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Extent (2, 3) of points (n, 3) without the outermost 1 % on each side, which mix measurements of two surfaces."""
    cut = len(points) // 100
    order = np.partition(points, (cut, len(points) - 1 - cut), axis=0)
    return np.stack([order[cut], order[-1 - cut]]).astype(np.float64)


def is_fully_visible(mask: NDArray[np.bool_], depth: NDArray[np.float32], reference_depth: float = 1.0) -> bool:
    """Whether an object (h, w) is cut off neither by the image border nor by an occluding surface."""
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
