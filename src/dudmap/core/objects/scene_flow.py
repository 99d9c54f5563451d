"""Displacement of moving objects between two images, by optical flow and depth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import median
from dudmap.core.frames.observation import Level, scaled_window
from dudmap.core.frames.optical_flow import track_forward_backward

PAIRED_PIXELS = 40
"""Pixels of an object tracked into the last frame."""
FEWEST_PIXELS = 12
"""Matched pixels that determine a displacement."""
WINDOW = 9
"""Edge of the matching window, pixels of an image WINDOW_WIDTH wide."""
RETURN_PX = 0.5
"""Largest forward-backward error of a tracked pixel, pixels of an image WINDOW_WIDTH wide."""
WINDOW_WIDTH = 160
"""Default width of the label image."""


@dataclass(frozen=True, eq=False)
class InstanceFrame:
    """A frame with the number of the moving object in each pixel: ``ids`` (h, w), 0 = none."""

    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    ids: NDArray[np.int32]

    def points(self, pixels: NDArray[np.number], nearest: NDArray[np.int64]) -> NDArray[np.float64]:
        """Points (n, 3), metres, world frame, at pixels (n, 2) u, v, with the depth of their ``nearest`` pixel."""
        depth = self.level.depth[nearest[:, 1], nearest[:, 0]].astype(np.float64)
        points = self.level.camera.points(pixels[:, 0], pixels[:, 1], depth)
        return points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def displacements(
    last: InstanceFrame, now: InstanceFrame, objects: Mapping[int, NDArray[np.intp]], max_jump: float
) -> dict[int, NDArray[np.float64]]:
    """Median displacement (3,) of each object's pixels, matched by forward-backward optical flow: metres, world frame.

    ``objects``: pixels (n,) in ``now``, as flat indices. Displacements longer than ``max_jump`` metres are mismatches.
    """
    import cv2

    ids, (h, w) = now.ids.astype(np.float32), now.ids.shape
    kernel = np.ones((3, 3), np.uint8)
    inner = (cv2.erode(ids, kernel) == cv2.dilate(ids, kernel)).reshape(-1)
    candidates = [flat[inner[flat]] for flat in objects.values()]
    chosen = [flat[:: 1 + len(flat) // PAIRED_PIXELS] for flat in candidates]
    pixels = np.stack(np.divmod(np.concatenate(chosen), w)[::-1], axis=1)
    window, limit = scaled_window(WINDOW, w, WINDOW_WIDTH), RETURN_PX * w / WINDOW_WIDTH
    matches, _, good = track_forward_backward(now.level.grey, last.level.grey, pixels, pixels, window, 2, limit)
    nearest = np.rint(matches).astype(np.int64)
    good &= np.all((nearest >= 0) & (nearest < (w, h)), axis=1)
    pixels, matches, nearest = pixels[good], matches[good], nearest[good]
    number = now.ids[pixels[:, 1], pixels[:, 0]]
    displacement = now.points(pixels, pixels) - last.points(matches, nearest)
    same = (last.ids[nearest[:, 1], nearest[:, 0]] == number) & (np.linalg.norm(displacement, axis=1) < max_jump)
    found = {i: displacement[same & (number == i)] for i in objects}
    return {i: median(of) for i, of in found.items() if len(of) >= FEWEST_PIXELS}
