"""Faults in the images of a recording: focal length, mirrored, no texture, resting plane."""

from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.places.features import SiftExtractor, match_descriptors, reduced_grey
from dudmap.core.tracking.frame_view import TEXTURELESS
from dudmap.errors import FrameError
from dudmap.io.sequences import has_color, read_frame

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.io.sequences import Sequence

PAIRS, GAP = 12, 10
"""Compared frame pairs, and frames between both: 5 to 20 degrees by hand."""
NEAR = 0.015
"""Distance of a matched point from the affine motion, share of the depth: 3 sigma of a Kinect."""
POINTS = 500
LEAST_POINTS, LEAST_PAIRS = 20, 6
AGREEMENT, SHARE = 0.15, 0.6
"""Deviation of agreeing pairs from the median, share of it; smallest share of agreeing pairs."""
WRONG = 0.2
"""Smallest reported relative error of a focal length; correct ones erred by up to 0.12."""
DISTANCES = 4000

WIDTH = 160
STEP, STEEPEST = 0.08, 4.0
"""Smallest depth edge, share of the depth; largest colour edge, multiple of the mean gradient."""
NEIGHBOURHOOD = 41
"""Width of the subtracted mean, pixels."""
TURNED = {"mirrored left-right": (1, -1), "upside down (mirrored up-down)": (-1, 1), "rotated by 180 degrees": (-1, -1)}
"""Ways in which an image may be turned: steps through rows and columns."""
GAIN, MAYBE, SIGNIFICANT = 0.04, 3.5, 5.0
"""Limits for a turn of depth against colour: gain in edge correlation; correlations of a possible and a certain turn,
standard deviations of accidental ones (3 and 0 of 360 unrelated pairs, 257 and 243 of 261 turned ones)."""
APART = 12
"""Shift of accidental coincidence, pixels of ``WIDTH``."""
FEWEST = 4
MAGNIFICATIONS = np.exp(np.arange(-12, 13) / 20)
"""Compared ratios of focal lengths, colour to given."""
REGISTERED = np.abs(np.log(MAGNIFICATIONS)) < 0.16
"""Magnifications that a calibration finds."""
SHIFT = 3
"""Largest shift by the cameras' baseline, pixels of ``WIDTH``: 20 mm at 1 m."""
LOOKS = 12, 48
"""Frames that search another magnification, and that prove it."""
PROVEN = 4.0
"""Smallest gain of another magnification, standard errors."""
MAGNIFIED_GAIN = 0.01
"""Smallest gain in correlation of another magnification; registered images stay below -0.02."""
FLAT = 0.01
"""Largest standard deviation from a plane of depth without relief, share of the depth."""
STILL = 0.2
"""Largest spread of a resting plane's distance, standard deviations of a measurement."""
CHANGED = 0.05
"""Smallest relative intensity difference that exposure does not explain."""


def focal_error(sequence: "Sequence") -> float | None:
    """Given focal length over the one that preserves point distances between frames; None if unknown. With the factor s
    of x and y, s^2 (dx^2 + dy^2) + dz^2 of two points is equal in both frames."""
    found, rng = [], np.random.default_rng(0)
    for index in np.unique(np.linspace(0, max(len(sequence) - 1 - GAP, 0), PAIRS).astype(int)):
        try:
            later = min(int(index) + GAP, len(sequence) - 1)
            frames = [read_frame(sequence, int(index)), read_frame(sequence, later)]
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
            found.append(axes[1, 1] / axes[0, 1])  # both sides have errors: total least squares
    factors = np.sqrt(np.clip(found, 0, None))
    if len(factors) < LEAST_PAIRS:
        return None
    median = float(np.median(factors))
    agreeing = np.sum(np.abs(factors - median) < AGREEMENT * median)
    return median if agreeing >= max(LEAST_PAIRS, SHARE * len(factors)) else None


def _matched(frames: "list[Frame]", camera: "Camera") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sift, points = SiftExtractor(POINTS), []
    seen = [sift.extract(reduced_grey(frame.rgb, frame.rgb.shape[1] // 2)) for frame in frames]
    pairs = match_descriptors(seen[0].descriptors, seen[1].descriptors, 1.0)
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


def image_warnings(frames: "list[Frame]") -> list[str]:
    """Warnings about frames of a recording; none for fewer than four."""
    frames = [frame for frame in frames if frame.color is not None]
    if len(frames) < FEWEST:
        return []
    grays = [_gray(frame.rgb) for frame in frames]
    if all(gray.std() < TEXTURELESS for gray in grays):
        plane = "" if _planes(frames) is None else ", which show one plane and not how the camera moves along it"
        what = "the colour images have no texture (black or of one colour)"
        return [f"{what}: the camera is tracked by distances alone{plane}"]
    return [*_plane_warnings(frames, grays), *_turn_warnings(frames)]


def _gray(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    size = WIDTH, round(WIDTH * color.shape[0] / color.shape[1])
    small = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)


def _turn_warnings(frames: "list[Frame]") -> list[str]:
    pairs = [_edges(frame) for frame in frames if frame.depth.shape == frame.rgb.shape[:2]]
    if len(pairs) < FEWEST or len({edges.shape for edges, _ in pairs}) > 1:
        return []
    edges, steps = (np.stack([_flattened(pair[n], np.ones_like(pair[n])) for pair in pairs]) for n in (0, 1))
    given, spread, largest = _agreement(edges, steps)
    turned = [_agreement(edges, steps[:, ::rows, ::columns])[0] for rows, columns in TURNED.values()]
    best = int(np.argmax(turned))
    if turned[best] < max(given + GAIN, MAYBE * spread, largest):
        return []
    sure = turned[best] >= SIGNIFICANT * spread
    seems, advice = ("seems to", "turn the images of one of them") if sure else ("may", "compare them (info --sheet)")
    return [
        f"one of colour and depth {seems} be {list(TURNED)[best]} against the other: then their edges agree better "
        f"(correlation {turned[best]:.2f}) than as they are ({given:.2f}); {advice}"
    ]


def _agreement(edges: NDArray[np.float32], steps: NDArray[np.float32]) -> tuple[float, float, float]:
    power = np.sqrt(np.mean(edges**2, axis=(1, 2)) * np.mean(steps**2, axis=(1, 2)))
    products = np.fft.irfft2(np.fft.rfft2(edges) * np.conj(np.fft.rfft2(steps)), s=edges.shape[1:]) / edges[0].size
    mean = np.mean(products / np.maximum(power, 1e-9)[:, None, None], axis=0)
    rows, columns = (np.minimum(np.arange(size), size - np.arange(size)) for size in mean.shape)
    accidental = mean[np.maximum(rows[:, None], columns) >= APART]
    return float(mean[0, 0]), float(accidental.std()), float(accidental.max())


def color_magnification(sequence: "Sequence") -> float | None:
    """Ratio of colour's focal length to the given one at which edges coincide; None if unproven or near 1."""
    given = sequence.calibration or Calibration.registered(sequence.camera)
    agreement: dict[int, NDArray[np.float32]] = {}
    found = None
    if not has_color(sequence):
        return None
    for count in LOOKS:
        for index in np.unique(np.linspace(0, len(sequence) - 1, count).astype(int)).tolist():
            try:
                if index not in agreement:
                    agreement[index] = _magnified_agreement(sequence[index], sequence.camera, given)
            except FrameError:
                continue
        found = _best_magnification(np.stack(list(agreement.values()))) if len(agreement) >= FEWEST else None
        if found is None:
            return None
    return found[0] if found is not None and found[1] >= PROVEN else None


def _best_magnification(agreement: NDArray[np.float32]) -> tuple[float, float] | None:
    """Best magnification in ``agreement`` (frames, magnifications, shifts), and its gain in standard errors, or
    None."""
    mean = agreement.mean(axis=0)
    best, shift = (int(n) for n in np.unravel_index(np.argmax(mean), mean.shape))
    near = np.unravel_index(np.argmax(np.where(REGISTERED[:, None], mean, -1)), mean.shape)
    gains = agreement[:, best, shift] - agreement[:, near[0], near[1]]
    if gains.mean() < MAGNIFIED_GAIN or not 0 < best < len(MAGNIFICATIONS) - 1:
        return None
    before, here, after = mean[best - 1 : best + 2, shift].tolist()
    step = (before - after) / (2 * (before - 2 * here + after))  # to the maximum of the parabola
    ratio = MAGNIFICATIONS[best] ** (1 - step) * MAGNIFICATIONS[best + 1] ** step
    return float(ratio), float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-9))


def unregistered(magnification: float) -> str:
    """Sentence on a magnification of the colours."""
    return f"the edges of both images agree where its focal length is {magnification:.2f} times that given or assumed"


def _magnified_agreement(frame: "Frame", camera: "Camera", given: Calibration) -> NDArray[np.float32]:
    edges, steps = _edges(frame)
    steps, out = _flattened(steps, np.ones_like(steps)), []
    size, border = steps.shape[::-1], (SHIFT, SHIFT, SHIFT, SHIFT, cv2.BORDER_CONSTANT)
    K_color, K_depth = given.camera.resized(WIDTH, len(edges)).K, camera.resized(WIDTH, len(steps)).K
    rays = given.T_color_depth[:3, :3] @ np.linalg.inv(K_depth)  # rays of distant points
    for magnification in MAGNIFICATIONS.tolist():
        to_color = K_color @ np.diag([magnification, magnification, 1]) @ rays
        sampled, inside = (
            np.asarray(cv2.warpPerspective(image, to_color, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))
            for image in (edges, np.ones_like(edges))
        )
        seen = (inside > 0.999).astype(np.float32)
        sampled = _flattened(sampled.astype(np.float32), seen)
        products, squares = (
            cv2.matchTemplate(cv2.copyMakeBorder(image, *border), templ, cv2.TM_CCORR).reshape(-1)
            for image, templ in ((sampled, steps), (seen, steps * steps))
        )
        out.append(products / np.sqrt(np.maximum(squares * np.square(sampled).sum(), np.float32(1e-9))))
    return np.stack(out)


def _flattened(image: NDArray[np.float32], seen: NDArray[np.float32]) -> NDArray[np.float32]:
    size = NEIGHBOURHOOD, NEIGHBOURHOOD
    share = np.maximum(cv2.blur(seen, size), np.float32(1e-3))
    return np.asarray((image - cv2.blur(image * seen, size) / share) * seen, np.float32)


def _edges(frame: "Frame") -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    gray, (height, width) = _gray(frame.rgb), frame.depth.shape
    gradient = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    edges = np.minimum(gradient / (gradient.mean() + np.float32(1e-5)), np.float32(STEEPEST))
    return edges.astype(np.float32), _depth_edges(frame.depth, (round(WIDTH * height / width), WIDTH))


def _depth_edges(depth: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    small = cv2.resize(depth, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    window = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(small > 0, small, 1e6).astype(np.float32), window)  # a missing measurement counts as far
    far = cv2.dilate(small, window)
    step = cv2.dilate(((far > (1 + STEP) * near) & (far > 0)).astype(np.uint8), window)
    return step.astype(np.float32)


def _plane_warnings(frames: "list[Frame]", grays: list[NDArray[np.float32]]) -> list[str]:
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
        "noise, while the colour images change; the depth images do not belong to them: compare both with "
        "dudmap info --sheet"
    ]


def _planes(frames: "list[Frame]") -> tuple[NDArray[np.float64], float] | None:
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
