"""Redundant-view test: SIFT, FLANN and Lowe's ratio test against the last fused frame (thesis section 4.3)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SimilarityConfig
from dudmap.geometry import se3
from dudmap.kernels.threads import submit
from dudmap.places.features import SiftExtractor, reduced_grey

FEWEST = 20
"""With fewer features than this in a frame nothing can be said; the frame is taken as new."""
LONGEST = 3
"""Times that the patience doubles."""
EXPONENT = ((0.25, 0.5, 1.0), (2.6, 1.6, 1.4))
"""Share on the full image = share on an image reduced by this factor, with 500 features, to the power below it.

Fitted on 115 pairs of 640x480 frames (hand-held, tripod, and one view twice with noise and sub-pixel shifts), rms of
the fit 0.05, at a quarter of the width 0.10.
"""


@dataclass(frozen=True, eq=False)
class Features:
    """What the test keeps of a frame.

    Attributes:
        image: (h, w) uint8, reduced grey image.
        descriptors: (n, 128) float32.
    """

    image: NDArray[np.uint8]
    descriptors: NDArray[np.float32]


class SimilarityTest:
    """Tells views that show what the last accepted frame showed.

    The share of the last frame's SIFT features that are found again is measured on a reduced image and converted to
    what the full image would give, so that the threshold keeps the thesis' meaning. A frame's features are computed
    once, and only when a test needs them. Not for concurrent calls.
    """

    def __init__(self, config: SimilarityConfig | None = None) -> None:
        self.config = config or SimilarityConfig()
        self._sift = SiftExtractor(self.config.max_features)
        self._last_image: NDArray[np.uint8] | None = None
        self._known: list[Features] = []  # of at most the last accepted and the latest frame

    def redundant(self, rgb: NDArray[np.uint8]) -> bool:
        """Whether (H, W, 3) uint8 ``rgb`` shows what the last accepted frame showed; False before there is one."""
        return self.share(rgb) > self.config.threshold

    def accept(self, rgb: NDArray[np.uint8]) -> None:
        """Remember a frame as the last one that was fused."""
        self._last_image = reduced_grey(rgb, self.config.image_width)

    def share(self, rgb: NDArray[np.uint8]) -> float:
        """Share in [0, 1] of the last accepted frame's features found again in ``rgb``; 0 where none can be told."""
        if self._last_image is None:
            return 0.0
        last, new = self._features(self._last_image), self.features(rgb)
        self._known = [last, new]
        if min(len(last.descriptors), len(new.descriptors)) < FEWEST:
            return 0.0
        found = self._good_matches(last.descriptors, new.descriptors) / len(last.descriptors)
        return float(found ** np.interp(self._last_image.shape[1] / rgb.shape[1], *EXPONENT))

    def features(self, rgb: NDArray[np.uint8]) -> Features:
        """Features of a frame; the same frame again costs only a comparison of the reduced images."""
        return self._features(reduced_grey(rgb, self.config.image_width))

    def _features(self, image: NDArray[np.uint8]) -> Features:
        for known in self._known:
            if np.array_equal(known.image, image):
                return known
        features = Features(image, self._sift.extract(image).descriptors)
        self._known = [*self._known[-1:], features]
        return features

    def _good_matches(self, last: NDArray[np.float32], new: NDArray[np.float32]) -> int:
        """Features of ``last`` whose best match in ``new`` is clearly better than the second best (Lowe 2004).

        FLANN's randomised trees draw from OpenCV's generator of this thread; it is seeded, so that the same two
        frames always give the same number.
        """
        import cv2

        cv2.setRNGSeed(1)
        matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 32})
        pairs = matcher.knnMatch(last, new, k=2)
        return sum(len(pair) == 2 and pair[0].distance < self.config.ratio * pair[1].distance for pair in pairs)


class RedundantViews:
    """Asks the similarity test where the camera has hardly moved since a frame was fused last, beside other work."""

    def __init__(self, config: SimilarityConfig) -> None:
        self.config = config
        self.test = SimilarityTest(config)
        self._T_world_fused: NDArray[np.float64] | None = None
        self._untested = 0  # frames that are still fused without a test
        self._in_vain = 0  # tests in a row that found nothing redundant

    def ask(self, rgb: NDArray[np.uint8], T_expected: NDArray[np.float64]) -> Callable[[NDArray[np.float64]], bool]:
        """Begin to compare an image (H, W, 3) with that of the last fused frame, if the camera should be near it.

        Returns:
            Waits for the answer: whether a frame with that image and this pose (4, 4) is redundant. It is to be asked
            before the next image is.
        """
        if not self.config.enabled or not self._near(T_expected):
            return lambda T_world_camera: False
        if self._untested > 0:
            self._untested -= 1
            return lambda T_world_camera: False
        test = submit(lambda: self.test.redundant(rgb))

        def answer(T_world_camera: NDArray[np.float64]) -> bool:
            redundant = test() and self._near(T_world_camera)
            self._untested = 0 if redundant else self.config.patience << min(self._in_vain, LONGEST)
            self._in_vain = 0 if redundant else self._in_vain + 1
            return redundant

        return answer

    def accept(self, rgb: NDArray[np.uint8], T_world_camera: NDArray[np.float64]) -> None:
        """Remember a frame as the last one that was fused."""
        self._T_world_fused = T_world_camera
        if self.config.enabled:
            self.test.accept(rgb)

    def moved(self, T_new_old: NDArray[np.float64]) -> None:
        """Follow a correction of the world."""
        if self._T_world_fused is not None:
            self._T_world_fused = T_new_old @ self._T_world_fused

    def forget(self) -> None:
        """Another map begins."""
        self._T_world_fused = None

    def _near(self, T_world_camera: NDArray[np.float64]) -> bool:
        """Whether the camera has hardly moved since the last fused frame, or that does not matter."""
        if self._T_world_fused is None:
            return False
        if self.config.max_translation == 0:
            return True
        moved = se3.inverse(self._T_world_fused) @ T_world_camera
        turned = np.degrees(se3.rotation_angle(moved))
        return bool(
            np.linalg.norm(moved[:3, 3]) <= self.config.max_translation and turned <= self.config.max_rotation_deg
        )
