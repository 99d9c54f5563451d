"""Whether pairs of frames are consistent with the focal length that a recording is said to have."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.core.places.features import SiftExtractor, match_descriptors, reduced_grey
from dudmap.errors import FrameError

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.io.sequences import Sequence

PAIRS, GAP = 12, 10
"""Pairs of frames that are compared, and how many frames apart: a third of a second, in which a hand turns 5 to 20
degrees."""
NEAR = 0.015
"""Largest distance of a matched point from the common affine motion, as a share of the depth: 3 sigma of a Kinect."""
POINTS = 500
"""Features of an image of half the size."""
LEAST_POINTS, LEAST_PAIRS = 20, 6
"""Fewest matches of a pair, and fewest pairs that agree."""
AGREEMENT, SHARE = 0.15, 0.6
"""Pairs agree within this share of their median, and so many of all must, before the median says anything."""
WRONG = 0.2
"""Smallest error of a focal length that is said: that of right ones was up to 0.12 on five real recordings, and one
that was 20 % too short on purpose was found 25 % too short."""
DISTANCES = 4000
"""Random pairs of points whose distances are compared."""


def focal_error(sequence: "Sequence") -> float | None:
    """Given focal length over the one that keeps distances between the same points in two frames; None if unknown.

    With the factor s of x and y, the squared distance s^2 (dx^2 + dy^2) + dz^2 of two points is the same in both
    frames, which is linear in s^2. Matches are those of one affine motion, which a wrong focal length leaves affine.
    """
    found, rng = [], np.random.default_rng(0)
    for index in np.unique(np.linspace(0, max(len(sequence) - 1 - GAP, 0), PAIRS).astype(int)):
        try:
            frames = [sequence[int(index)], sequence[min(int(index) + GAP, len(sequence) - 1)]]
        except FrameError:
            continue
        first, second = _matched(frames, sequence.camera)
        if len(first) < LEAST_POINTS:
            continue
        a, b = rng.integers(len(first), size=(2, DISTANCES))
        p, q = ((points[a] - points[b]) ** 2 for points in (first, second))
        flat, deep = (p - q)[:, :2].sum(axis=1), (q - p)[:, 2]
        _, axes = np.linalg.eigh(np.array([[flat @ flat, flat @ deep], [flat @ deep, deep @ deep]]))
        if flat @ flat > 0 and abs(axes[0, 1]) > 1e-6:  # else the camera did not turn
            found.append(axes[1, 1] / axes[0, 1])  # both have errors: total least squares
    factors = np.sqrt(np.clip(found, 0, None))
    if len(factors) < LEAST_PAIRS:
        return None
    median = float(np.median(factors))
    agreeing = np.sum(np.abs(factors - median) < AGREEMENT * median)
    return median if agreeing >= max(LEAST_PAIRS, SHARE * len(factors)) else None


def _matched(frames: "list[Frame]", camera: "Camera") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) of two frames with the same appearance that fit one affine motion, each in its camera."""
    import cv2

    sift, points = SiftExtractor(POINTS), []
    seen = [sift.extract(reduced_grey(frame.color, frame.color.shape[1] // 2)) for frame in frames]
    pairs = match_descriptors(seen[0].descriptors, seen[1].descriptors, 1.0, mutual=True)
    for frame, features, rows in zip(frames, seen, pairs.T, strict=True):
        u, v = 2 * features.pixels[rows].T + 0.5
        row, column = (
            np.clip(np.rint(x).astype(int), 0, size - 1) for x, size in zip((v, u), frame.depth.shape, strict=True)
        )
        z = frame.depth[row, column].astype(np.float64)
        points.append(np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1))
    valid = (points[0][:, 2] > 0) & (points[1][:, 2] > 0)
    first, second = points[0][valid], points[1][valid]
    if len(first) < LEAST_POINTS:
        return first[:0], second[:0]
    _, _, fits = cv2.estimateAffine3D(first, second, ransacThreshold=NEAR * float(np.median(second[:, 2])))
    return first[fits[:, 0] > 0], second[fits[:, 0] > 0]
