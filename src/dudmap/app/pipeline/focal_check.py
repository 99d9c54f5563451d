"""Whether pairs of frames are consistent with the focal length that a recording is said to have."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.io.sequences import Sequence

PAIRS, GAP = 12, 10
"""Pairs of frames that are compared, and how many frames apart: a third of a second, in which a hand turns 5 to 20
degrees."""
NEAR = 0.015
"""Largest distance of a matched point from the common affine motion, as a share of its depth: 3 sigma of a Kinect."""
POINTS = 500
"""Features of an image of half the size."""
LEAST_POINTS, LEAST_PAIRS = 20, 6
"""Fewest matches of a pair, and fewest pairs that agree."""
AGREEMENT, SHARE = 0.15, 0.6
"""Pairs agree within this share of their median, and so many of all must, before the median says anything."""
WRONG = 0.2
"""Smallest error of a focal length that is said: that of right ones was up to 0.12 on five real recordings, and one
that was 20 % too short on purpose was found 25 % too short."""
TRIALS, DISTANCES = 300, 4000
"""Random samples of four matches, and random pairs of points whose distances are compared."""


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
        first, second = _matched(frames, sequence, rng)
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


def _matched(
    frames: "list[Frame]", sequence: "Sequence", rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) of two frames with the same appearance that fit one affine motion, each in its camera."""
    import cv2

    camera, sift = sequence.camera, cv2.SIFT.create(POINTS)  # pyright: ignore[reportAttributeAccessIssue]
    half = [cv2.resize(frame.color, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for frame in frames]
    seen = [sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None) for image in half]
    if any(descriptors is None for _, descriptors in seen):
        return np.empty((0, 3)), np.empty((0, 3))
    matches = cv2.BFMatcher(crossCheck=True).match(seen[0][1], seen[1][1])
    points = []
    for (keypoints, _), frame, side in zip(seen, frames, ("queryIdx", "trainIdx"), strict=True):
        u, v = 2 * np.array([keypoints[getattr(match, side)].pt for match in matches]).reshape(-1, 2).T + 0.5
        row, column = (
            np.clip(np.rint(x).astype(int), 0, size - 1) for x, size in zip((v, u), frame.depth.shape, strict=True)
        )
        z = frame.depth[row, column].astype(np.float64)
        points.append(np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1))
    valid = (points[0][:, 2] > 0) & (points[1][:, 2] > 0)
    first, second = points[0][valid], points[1][valid]
    best = np.zeros(len(first), bool)
    homogeneous = np.column_stack([first, np.ones(len(first))])
    for _ in range(TRIALS if len(first) >= LEAST_POINTS else 0):
        four = rng.choice(len(first), 4, replace=False)
        motion = np.linalg.lstsq(homogeneous[four], second[four])[0]
        near = np.linalg.norm(homogeneous @ motion - second, axis=1) < NEAR * second[:, 2]
        best = near if near.sum() > best.sum() else best
    return first[best], second[best]
