"""What looks wrong in the images of a recording: mirrored pairs, colour without texture, depth of one resting plane."""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.tracking.frame_view import TEXTURELESS

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame

WIDTH = 160
"""Width of the images whose edges are compared, pixels."""
STEP, STEEPEST = 0.08, 4.0
"""Smallest depth edge, as a share of the depth, and largest colour edge, as a multiple of the mean gradient."""
NEIGHBOURHOOD = 41
"""Width of the neighbourhood whose mean is taken off both edge images, pixels, so that only places count."""
TURNED = {"mirrored left-right": (1, -1), "upside down (mirrored up-down)": (-1, 1), "rotated by 180 degrees": (-1, -1)}
"""Ways in which one of the two images may be turned: steps through its rows and columns."""
GAIN, SIGNIFICANT = 0.04, 4.0
"""Smallest gain in the correlation of depth and colour edges by which a turn is believed, and how many standard errors
over the frames it must exceed zero by."""
FEWEST = 4
"""Frames that a judgement needs."""
FLAT = 0.01
"""Largest deviation from one plane, standard deviation as a share of the depth, of a depth image without relief."""
STILL = 0.2
"""Largest spread over the frames of the distance of a plane that does not move, in standard deviations of a reading:
the planes of moving cameras differ by more, and those of thousands of independent readings by less."""
CHANGED = 0.05
"""Mean difference of intensities, as a share of their mean, from which images differ by more than exposure."""


def image_warnings(frames: "Sequence[Frame]") -> list[str]:
    """Sentences on what looks wrong in some frames spread over a recording; none for fewer than four frames."""
    if len(frames) < FEWEST:
        return []
    grays = [_gray(frame.color) for frame in frames]
    if all(gray.std() < TEXTURELESS for gray in grays):
        plane = "" if _planes(frames) is None else ", which show one plane and not how the camera moves along it"
        what = "the colour images have no texture (black or of one colour)"
        return [f"{what}: the camera is tracked by distances alone{plane}"]
    return [*_plane_warnings(frames, grays), *_turn_warnings(frames, grays)]


def _gray(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Intensity (h, WIDTH) in 0..1 of a colour image."""
    size = WIDTH, round(WIDTH * color.shape[0] / color.shape[1])
    small = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)


def _turn_warnings(frames: "Sequence[Frame]", grays: list[NDArray[np.float32]]) -> list[str]:
    """Whether the edges of depth lie on those of colour only after one of the images is turned."""
    gains = []
    for frame, gray in zip(frames, grays, strict=True):
        if frame.depth.shape == frame.color.shape[:2]:
            gradient = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
            edges = np.minimum(gradient / (gradient.mean() + 1e-5), STEEPEST)
            steps = _depth_edges(frame.depth, gray.shape)
            given = _correlation(steps, edges)
            gains.append([_correlation(steps[::rows, ::columns], edges) - given for rows, columns in TURNED.values()])
    if len(gains) < FEWEST:
        return []
    mean = np.mean(gains, axis=0)
    error = np.std(gains, axis=0, ddof=1) / np.sqrt(len(gains))
    best = int(np.argmax(mean))
    if mean[best] < GAIN or mean[best] < SIGNIFICANT * error[best]:
        return []
    return [
        f"one of colour and depth seems to be {list(TURNED)[best]} against the other: then their edges agree better "
        f"(correlation higher by {mean[best]:.2f}) than as they are; turn the images of one of them"
    ]


def _depth_edges(depth: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """1 beside a step between two readings, else 0."""
    small = cv2.resize(depth, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    window = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(small > 0, small, 1e6).astype(np.float32), window)  # no reading is far away
    far = cv2.dilate(small, window)
    step = cv2.dilate(((far > (1 + STEP) * near) & (far > 0)).astype(np.uint8), window)
    return step.astype(np.float32)


def _correlation(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Correlation of two images after the mean of the neighbourhood is taken off each; 0 where one is constant."""
    a, b = (image - cv2.blur(np.ascontiguousarray(image), (NEIGHBOURHOOD, NEIGHBOURHOOD)) for image in (first, second))
    spread = float(a.std() * b.std())
    return float((a * b).mean()) / spread if spread > 1e-9 else 0.0


def _plane_warnings(frames: "Sequence[Frame]", grays: list[NDArray[np.float32]]) -> list[str]:
    """Whether the depth is that of one plane that rests against the camera while the colours change."""
    planes = _planes(frames)
    exposed = [gray / (gray.mean() + np.float32(1e-3)) for gray in grays]
    changes = [np.abs(b - a).mean() for a, b in pairwise(exposed) if a.shape == b.shape]
    if planes is None or np.mean(changes or [0]) < CHANGED:
        return []
    distances, sigma = planes
    if np.std(distances, axis=0).max() > STILL * sigma:
        return []
    return [
        f"all sampled depth images show the same plane at {distances.mean():.3g} m, with {1000 * sigma:.1f} mm of "
        "noise and no relief, while the colour images change: depth does not show how the camera moves; expected depth "
        "images of what the colour images show (look at dudmap info --sheet)"
    ]


def _planes(frames: "Sequence[Frame]") -> tuple[NDArray[np.float64], float] | None:
    """Distances (N, 5) of the plane of every depth image, metres, in its middle and corners, and the standard deviation
    of the readings about it; None if an image shows something else.

    In the image of a plane the inverse distance is linear in the pixel's row and column.
    """
    distances, sigmas = [], []
    places = np.array([[0, 0, 1], [-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, 1]], np.float64)
    for frame in frames:
        stride = max(1, frame.depth.shape[1] // WIDTH)
        depth = frame.depth[::stride, ::stride].astype(np.float64)
        rows, columns = (np.linspace(-1, 1, size) for size in depth.shape)
        valid = depth > 0
        if np.count_nonzero(valid) < 0.5 * valid.size:
            return None
        pixels = np.stack([*(axis[valid] for axis in np.meshgrid(rows, columns, indexing="ij")), np.ones(valid.sum())])
        plane = np.linalg.lstsq(pixels.T, 1 / depth[valid])[0]
        off = depth[valid] * (1 - depth[valid] * (plane @ pixels))
        if not np.all(places @ plane > 0) or np.std(off / depth[valid]) > FLAT:
            return None
        distances.append(1 / (places @ plane))
        sigmas.append(np.std(off))
    return np.array(distances), float(np.median(sigmas))
