"""Similarity of consecutive images (thesis section 4.3): SIFT, FLANN and Lowe's ratio test."""

import cv2
import numpy as np
from numpy.typing import NDArray

TREES, CHECKS = 5, 50
"""KD-trees and visited leaves of FLANN (Muja and Lowe 2009), OpenCV's examples."""
KD_TREE = 1
"""FLANN's number of KD-trees."""


class Similarity:
    """Compares each image with the one before.

    Reading: "the consecutive images" means the image before, skipped or not. The ratio is good matches over the smaller
    number of features.

    Args:
        lowe_ratio: Nearest over second nearest distance of a good match.
    """

    def __init__(self, lowe_ratio: float) -> None:
        self._ratio = lowe_ratio
        self._sift = cv2.SIFT_create()  # pyright: ignore[reportAttributeAccessIssue]
        self._flann = cv2.FlannBasedMatcher({"algorithm": KD_TREE, "trees": TREES}, {"checks": CHECKS})
        self._before: NDArray[np.float32] | None = None

    def ratio(self, intensity: NDArray[np.float32]) -> float:
        """Similarity in [0, 1] of an image (H, W), [0, 1], to the image before; 0 without."""
        cv2.setRNGSeed(0)  # FLANN builds random trees
        _, features = self._sift.detectAndCompute((255 * intensity).astype(np.uint8), None)
        before, self._before = self._before, features
        if before is None or features is None or min(len(before), len(features)) < 2:
            return 0.0
        pairs = self._flann.knnMatch(features, before, k=2)
        good = sum(pair[0].distance < self._ratio * pair[1].distance for pair in pairs if len(pair) == 2)
        return good / min(len(before), len(features))
