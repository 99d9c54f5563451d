"""Estimation of a colour camera's vignetting from the brightness of pairs of frames."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.calibration.adjustment import Fit, PairSet
from dudmap.core.calibration.keyframes import SAME_SURFACE
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

Values = NDArray[np.float64]
EXPOSED = 0.06, 0.94
"""Compared intensities: darker ones have an unknown black level, brighter are saturated."""
SCALE = 0.02
ITERATIONS = 8
"""Iterations after which the result changes by less than a thousandth."""


@dataclass(frozen=True, eq=False)
class Brightness:
    """Brightness of common surfaces in both frames of P pairs.

    The log ratio is the log ratio of the exposures minus the vignetting times the difference of the squared distances
    to the centre. On a wall this holds even for wrong poses.

    Attributes:
        numbers: (P, 2) int64, the frames of every pair.
        pair: (n,) int64, the pair of every point.
        ratio: (n,) logarithm of the brightness in the second frame over the first.
        outwards: (n,) squared distance to the centre, second minus first; 1 at the corners.
    """

    numbers: NDArray[np.int64]
    pair: NDArray[np.int64]
    ratio: NDArray[np.float64]
    outwards: NDArray[np.float64]

    @classmethod
    def of(cls, pairs: PairSet, fit: Fit) -> "Brightness":
        """Brightness of pairs with poses and calibration of a fit."""
        calibration = fit.calibration
        places = se3.inverse(fit.Ts_camera_world)
        camera = calibration.camera.resized(*pairs.brightness.shape[:0:-1])
        parts: list[tuple[Values, Values, Values]] = []
        for n, (first, second) in enumerate(pairs.numbers.tolist()):
            points = pairs.points[pairs.starts[first] : pairs.starts[first + 1]].astype(np.float64)
            moved = _moved(fit.Ts_camera_world[second] @ places[first], points)
            there = _sampled(pairs.depths[second], pairs.camera.project(moved))
            (one, inside), (other, outside) = (
                _seen(pairs.brightness[number], camera, _moved(calibration.T_color_depth, of))
                for number, of in ((first, points), (second, moved))
            )
            with np.errstate(invalid="ignore"):
                known = np.abs(there - moved[:, 2]) < SAME_SURFACE * moved[:, 2]
                known &= (np.minimum(one, other) > EXPOSED[0]) & (np.maximum(one, other) < EXPOSED[1])
            ratio = np.log(other[known] / one[known])
            parts.append((np.full(len(ratio), n), ratio, outside[known] - inside[known]))
        return cls(pairs.numbers, *(np.concatenate(part) for part in zip(*parts, strict=True)))

    def fitted(self) -> tuple[float, float]:
        """Vignetting and its standard deviation with correlated errors per frame; NaN without data."""
        weights, residual, outwards, found = np.ones(len(self.ratio)), self.ratio, self.outwards, 0.0
        for _ in range(ITERATIONS):
            outwards, ratio = self._centred(self.outwards, weights), self._centred(self.ratio, weights)
            found = -float(np.sum(weights * outwards * ratio) / max(np.sum(weights * outwards**2), 1e-12))
            residual = ratio + found * outwards
            weights = _weights(residual)
        of_pair = np.bincount(self.pair, weights * outwards * residual, len(self.numbers))
        of_frame = np.bincount(self.numbers.reshape(-1), np.repeat(of_pair, 2))
        information = np.sum(weights * outwards**2)
        return found, float(np.linalg.norm(of_frame) / information) if information > 0 else float("nan")

    def costs(self, vignetting: float) -> NDArray[np.float64]:
        """Mean robust cost (P,) of every pair with this vignetting."""
        weights = np.ones(len(self.ratio))
        for _ in range(ITERATIONS):
            weights = _weights(self._centred(self.ratio + vignetting * self.outwards, weights))
        count = np.maximum(np.bincount(self.pair, minlength=len(self.numbers)), 1)
        return np.bincount(self.pair, -np.log(weights), len(self.numbers)) / count

    def _centred(self, values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.maximum(np.bincount(self.pair, weights, len(self.numbers)), 1e-12)
        return values - (np.bincount(self.pair, weights * values, len(self.numbers)) / total)[self.pair]


def _weights(residual: Values) -> Values:
    return 1 / (1 + (residual / SCALE) ** 2)


def _moved(T: Values, points: Values) -> Values:
    return points @ T[:3, :3].T + T[:3, 3]


def _seen(brightness: NDArray[np.float32], camera: Camera, points: Values) -> tuple[Values, Values]:
    """Brightness at points of a colour camera (NaN outside), and squared distance to the centre (1 at the corners)."""
    pixels = camera.project(points)
    middle = (np.array(camera.shape[::-1]) - 1) / 2
    return _sampled(brightness, pixels), np.sum((pixels - middle) ** 2, axis=1) / np.sum(middle**2)


def _sampled(image: NDArray[np.float32], pixels: Values) -> Values:
    import cv2

    u, v = np.nan_to_num(pixels, nan=-1e3).astype(np.float32).T.copy()
    sampled = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    return np.asarray(sampled, np.float64).reshape(-1)
