"""SIFT features of a reduced grey image and their matching (Lowe 2004)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def reduced_grey(rgb: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Grey image (h, w) uint8 of a colour image (H, W, 3), at most ``width`` wide."""
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if width >= grey.shape[1]:
        return grey
    height = max(1, round(grey.shape[0] * width / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """SIFT features of one image.

    Attributes:
        pixels: (n, 2) float64, u and v; pixel centres at integers.
        responses: (n,) float64, strength.
        descriptors: (n, 128) float32.
        image_shape: (height, width).
    """

    pixels: NDArray[np.float64]
    responses: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    image_shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.pixels)


class SiftExtractor:
    """Extracts the strongest SIFT features. Not thread-safe."""

    def __init__(self, max_features: int) -> None:
        self.max_features = max_features
        self._detector: Any = None

    def extract(self, grey: NDArray[np.uint8]) -> ImageFeatures:
        """Features of a grey image (h, w) uint8."""
        import cv2

        if self._detector is None:
            self._detector = cv2.SIFT.create(nfeatures=self.max_features)
        keypoints, descriptors = self._detector.detectAndCompute(grey, None)
        if descriptors is None:
            keypoints, descriptors = (), np.empty((0, 128), np.float32)
        return ImageFeatures(
            np.array([point.pt for point in keypoints], dtype=np.float64).reshape(-1, 2),
            np.array([point.response for point in keypoints], dtype=np.float64),
            descriptors,
            (grey.shape[0], grey.shape[1]),
        )


def match_descriptors(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of rows that are mutually nearest and pass the ratio test from ``a`` to ``b``. None if ``b`` has
    fewer than two rows."""
    if len(a) == 0 or len(b) < 2:
        return np.empty((0, 2), dtype=np.int64)
    squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T)
    nearest = np.argmin(squared, axis=1)
    rows = np.arange(len(a))
    first = squared[rows, nearest]
    passed = np.argmin(squared, axis=0)[nearest] == rows
    squared[rows, nearest] = np.inf
    passed &= first < ratio**2 * squared.min(axis=1)
    return np.stack([rows[passed], nearest[passed]], axis=1)
