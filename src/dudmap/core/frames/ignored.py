"""Ignored pixels, which show parts fixed to the camera: a robot arm, a bonnet, a vignette."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError

DISTANCES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
"""Distances of projection into the other image, metres: each doubling halves the shift."""


@dataclass(frozen=True, eq=False)
class IgnoredRegion:
    """The ignored pixels of both recorded images.

    Attributes:
        depth: (H, W) bool, of the depth image.
        color: (h, w) bool, of the colour image.
        nearest: (n,) int, nearest unmasked pixel of each ignored colour pixel.
    """

    depth: NDArray[np.bool_]
    color: NDArray[np.bool_]
    nearest: NDArray[np.int64]

    @classmethod
    def of(cls, mask: NDArray[np.bool_], camera: Camera, calibration: Calibration | None) -> "IgnoredRegion":
        """Region of a mask of the depth or colour image, projected into the other at all ``DISTANCES``.

        Raises:
            ConfigError: The mask has the size of neither image or the wrong type, or covers a whole image.
        """
        mask = np.asarray(mask)
        sizes = [camera.shape] if calibration is None else [camera.shape, calibration.camera.shape]
        if mask.dtype != np.bool_ or mask.shape not in sizes:
            expected = " or ".join(f"({h}, {w})" for h, w in dict.fromkeys(sizes))
            raise ConfigError(
                f"the mask of ignored pixels has the shape {mask.shape} and the type {mask.dtype}; expected {expected} "
                "bool, the size of the depth or colour image"
            )
        depth = color = mask
        if calibration is not None:
            places = [_places(camera, calibration, distance) for distance in DISTANCES]
            if mask.shape == camera.shape:
                color = _shown(mask, places, calibration.camera.shape)
            else:
                depth = _showing(mask, places, camera.shape)
        if depth.all() or color.all():
            raise ConfigError(
                "the mask of ignored pixels covers the whole image; expected white only at pixels that never count"
            )
        return cls(depth.copy(), color, _nearest(color))

    def filled(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colour image (h, w, 3) with ignored pixels filled from their border."""
        out = color.copy()
        out[self.color] = color.reshape(-1, 3)[self.nearest]
        return out


def _nearest(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    import cv2

    _, labels = cv2.distanceTransformWithLabels(
        mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels, np.int64)
    number_of_label = np.zeros(int(labels.max()) + 1, np.int64)
    number_of_label[labels[~mask]] = np.flatnonzero(~mask)
    return number_of_label[labels[mask]]


def _places(camera: Camera, calibration: Calibration, distance: float) -> NDArray[np.int64]:
    import cv2

    points = camera.backproject(np.full(camera.shape, distance, np.float32)).reshape(-1, 3).astype(np.float64)
    T, color = calibration.T_color_depth, calibration.camera
    pixels, _ = cv2.projectPoints(points, T[:3, :3], T[:3, 3], color.K, np.array(calibration.lens))
    largest = max(color.shape) + 1
    return np.rint(np.clip(np.nan_to_num(pixels, nan=-1), -1, largest)).astype(np.int64).reshape(*camera.shape, 2)


def _within(places: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    u, v = places[..., 0], places[..., 1]
    return (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])


def _shown(mask: NDArray[np.bool_], places: list[NDArray[np.int64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    import cv2

    out = np.zeros(shape, np.uint8)
    for found in places:
        u, v = found[mask & _within(found, shape)].T
        out[v, u] = 1
    side = 2 * -(-shape[1] // mask.shape[1]) + 1  # the colour image may have several pixels per depth pixel
    return np.asarray(cv2.morphologyEx(out, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))) > 0


def _showing(mask: NDArray[np.bool_], places: list[NDArray[np.int64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    out = np.zeros(shape, bool)
    for found in places:
        within = _within(found, mask.shape)
        u, v = found[within].T
        out[within] |= mask[v, u]
    return out
