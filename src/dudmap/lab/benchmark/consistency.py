"""Score trajectories without ground truth by how well they explain a recording's images.

A frame rendered from another's pose must show its depth and intensities; all trajectories are compared on the same
pixels. Points are projected with pose, velocity, row times and each trajectory's calibration.

Too few common frames raise a ``DatasetError``.
"""

from collections.abc import Callable, Mapping
from collections.abc import Sequence as List
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.calibration.keyframes import MAX_GAP, central_velocity, halvings_to
from dudmap.core.frames.color_registration import recorded_intensity
from dudmap.core.frames.observation import Pyramid, reduced
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.association import LARGEST_GAP
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.evaluation.tables import grid
from dudmap.io.sequences import Sequence

GAPS = 5, 15, 30
"""Frames between the two of a pair."""
PAIRS = 100
"""Compared pairs per gap, about."""
TERMS = {"depth": "mm at 1 m", "intensity": "of 255"}
"""Compared quantities and their units."""
WORST_DEPTH, WORST_INTENSITY = 0.05, 0.2
"""Largest counted differences of depth over squared depth (1/m), and of intensity (0..1); pixels beyond for all are
excluded."""
SMOOTH = 0.05
"""Largest relative depth step of an interpolated surface."""
TEXTURED = 0.02
"""Smallest intensity gradient (0..1) per pixel."""
BLUR = 1.0
"""Smoothing of intensities, pixels; else interpolation reduces noise of calibrated colours only."""
ROW_STEPS = 3
FEWEST = 200
"""Fewest common pixels of a pair, or of its intensities."""
ROUNDING = 1e-4
"""Relative misfit difference of rounding."""
SAMPLES, LEAST_BLOCKS = 2000, 3
"""Bootstrap samples, and fewest stretches."""


class Consistency(NamedTuple):
    """Misfits of k trajectories.

    Attributes:
        misfits: (2, gaps, blocks, k) sums of depth (mm at 1 m) and intensity (of 255); a block is a stretch as long as
            the longest gap.
        counts: (2, gaps, blocks) pairs.
    """

    names: list[str]
    gaps: tuple[int, ...]
    misfits: NDArray[np.float64]
    counts: NDArray[np.float64]

    def means(self) -> NDArray[np.float64]:
        """Mean misfits (2, gaps, k)."""
        return self.misfits.sum(axis=2) / np.maximum(self.counts.sum(axis=2), 1)[..., None]

    def samples(self) -> NDArray[np.float64]:
        """Bootstrap samples (SAMPLES, 2, gaps, k) of the means, drawn by independent stretches."""
        blocks = self.misfits.shape[2]
        times = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), SAMPLES)
        sums = np.einsum("sb,tgbk->stgk", times, self.misfits)
        return sums / np.maximum(np.einsum("sb,tgb->stg", times, self.counts), 1)[..., None]

    def intervals(self) -> NDArray[np.float64]:
        """95 % intervals (2, 2, gaps, k) of the means."""
        return np.percentile(self.samples(), (2.5, 97.5), axis=0)

    def excess(self, term: int, one: int, other: int) -> tuple[float, float, float]:
        """Relative excess of one trajectory's misfit over another's, mean over gaps, and its 95 % interval; NaN without
        pairs."""
        seen = self.counts[term].any(axis=1)
        if not seen.any():
            return np.nan, np.nan, np.nan
        misfits = (np.maximum(found[..., term, seen, :], 1e-9) for found in (self.means(), self.samples()))
        share, drawn = (np.expm1(np.log(each[..., one] / each[..., other]).mean(axis=-1)) for each in misfits)
        return (float(share), *np.percentile(drawn, (2.5, 97.5)).tolist())

    def verdicts(self) -> list[str]:
        """A sentence per term on every trajectory but the best."""
        sentences = []
        for term, name in enumerate(TERMS):
            best = int(np.argmin(np.log(np.maximum(self.means()[term], 1e-9)).sum(axis=0)))
            for other in (k for k in range(len(self.names)) if k != best):
                share, low, high = self.excess(term, other, best)
                outcome = "{} is worse than {} by" if low > ROUNDING else "{} and {} are undecided:"
                named = outcome.format(self.names[other], self.names[best])
                sentences.append(f"{name}: {named} {share:.1%} ({low:.1%} to {high:.1%})")
        return sentences

    def table(self) -> str:
        """Markdown table of misfits with half their 95 % intervals, and verdicts."""
        low, high = self.intervals()
        head = ["", *(f"{term} ({unit}), {gap}" for term, unit in TERMS.items() for gap in self.gaps)]
        cells = np.stack([self.means(), (high - low) / 2], axis=-1).reshape(-1, len(self.names), 2)
        texts = ([f"{mean:.2f} ± {half:.2f}" for mean, half in cells[:, k]] for k in range(len(self.names)))
        rows = [[name, *text] for name, text in zip(self.names, texts, strict=True)]
        return grid(head, rows, words=1) + "\n" + "\n".join(f"- {sentence}" for sentence in self.verdicts())


class Images(NamedTuple):
    """A frame as recorded.

    Attributes:
        camera: Of the depth.
        depth: (h, w) float32, metres, 0 = missing or dynamic.
        intensity: (hc, wc) float32, 0..1, colour image.
        color_offset: Time stamp of colour minus depth, seconds.
    """

    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    color_offset: float = 0.0


class Motion(NamedTuple):
    """Relation of two frames by a trajectory and its calibration.

    Attributes:
        T_second_first: (4, 4), depth cameras at the middle rows.
        velocities: (6,) twists per second, camera axes.
    """

    T_second_first: NDArray[np.float64]
    velocities: tuple[NDArray[np.float64], NDArray[np.float64]]
    calibration: Calibration


def measure_consistency(
    sequence: Sequence,
    trajectories: Mapping[str, Trajectory],
    gaps: tuple[int, ...] = GAPS,
    max_frames: int | None = None,
    calibrations: Mapping[str, Calibration] | None = None,
) -> Consistency:
    """Compare pairs of frames under several trajectories, without known dynamic pixels.

    ``calibrations`` default to the recording's. Poses are at the depth stamps, ``depth_late``.
    """
    stamps, given = sequence.timestamps[:max_frames], sequence.calibration or Calibration.registered(sequence.camera)
    cameras = [(calibrations or {}).get(name, given) for name in trajectories]
    late = [calibration.depth_late for calibration in cameras]
    found = (
        ((n, _pose(each, t - seconds)) for n, t in enumerate(stamps))
        for each, seconds in zip(trajectories.values(), late, strict=True)
    )
    poses = [{n: T for n, T in each if T is not None} for each in found]
    known = [n for n in range(len(stamps)) if all(n in each for each in poses)]
    least = min(gaps)
    gaps = tuple(gap for gap in gaps if LEAST_BLOCKS * gap + least <= len(known))
    if not gaps:
        raise DatasetError(
            f"{', '.join(trajectories)} and {sequence.name} have {len(known)} frames in common; expected at least "
            f"{(LEAST_BLOCKS + 1) * least} of one recording, with its time stamps"
        )
    length = max(gaps)
    blocks = (known[-1] - known[0] + 1 - least) // length
    config, every = Config(), max(1, len(stamps) // PAIRS)
    preprocess = Preprocessor(sequence.camera, config.preprocess, calibration=sequence.calibration)
    misfits, counts = np.zeros((2, len(gaps), blocks, len(poses))), np.zeros((2, len(gaps), blocks))
    views: dict[int, Images] = {}

    def view(n: int) -> Images:
        if n not in views:
            observation = preprocess(sequence[n])
            level = Pyramid.of(observation, preprocess.camera, config).fine
            mask = sequence.mask(n)
            depth = level.depth if mask is None else np.where(reduced(preprocess.mask(mask), level), 0, level.depth)
            grey = recorded_intensity(observation, halvings_to(level.camera.width, given.camera))
            views[n] = Images(level.camera, depth.astype(np.float32), _smoothed(grey), observation.color_offset)
        return views[n]

    def motion(k: int, n: int, m: int) -> Motion:
        first, second = (_velocity(poses[k], stamps, number) for number in (n, m))
        return Motion(se3.inverse(poses[k][m]) @ poses[k][n], (first, second), cameras[k])

    shared = set(known)
    for n in known[::every]:
        views = {number: images for number, images in views.items() if number >= n}
        for g, gap in enumerate(gaps):
            if n + gap in shared:
                motions = [motion(k, n, n + gap) for k in range(len(poses))]
                pair, block = pair_misfits(view(n), view(n + gap), motions), min((n - known[0]) // length, blocks - 1)
                usable = np.isfinite(pair[:, 0])
                misfits[usable, g, block] += pair[usable]
                counts[usable, g, block] += 1
    return Consistency(list(trajectories), gaps, misfits, counts)


def pair_misfits(first: Images, second: Images, motions: List[Motion]) -> NDArray[np.float64]:
    """Mean misfits (2, k) of depth (mm at 1 m) and intensity (of 255) of two frames, for k motions;

    NaN with too little in common.
    """
    import cv2

    shape, near = first.depth.shape, np.ones((3, 3), np.uint8)
    recorded = first.camera.backproject(first.depth).reshape(-1, 3).T
    row_times = np.repeat((np.arange(shape[0]) + 0.5) / shape[0] - 0.5, shape[1]).astype(np.float32)
    step = cv2.dilate(second.depth, near) - cv2.erode(second.depth, near)
    smooth = ((cv2.erode(second.depth, near) > 0) & (step < SMOOTH * second.depth)).astype(np.float32)
    gaps, greys, differences = [], [], []
    valid, colored = first.depth > 0, np.ones(shape, dtype=bool)
    for T, velocities, calibration in motions:
        points = _moving(recorded, velocities[0])(np.float32(calibration.depth_readout) * row_times)
        there = _moved(T, points)
        shutter = Calibration(second.camera, depth_readout=calibration.depth_readout)
        pixels, depth = _seen(there, shutter, velocities[1], 0.0)
        seen, surface = (_sampled(image, pixels, shape) for image in (second.depth, smooth))
        depth = depth.reshape(shape)
        valid &= (surface > 0.999) & (depth > 0)
        gaps.append(np.minimum(np.abs(seen - depth) / np.maximum(depth, 1e-3) ** 2, WORST_DEPTH))
        grey, brightness = _shades(first, points, calibration, velocities[0])
        other, other_brightness = _shades(second, there, calibration, velocities[1])
        colored &= np.isfinite(grey + other)
        greys.append(grey * other_brightness / brightness)
        differences.append(other - greys[-1])
    static = valid & (np.min(gaps, axis=0) < WORST_DEPTH)
    slopes = np.linalg.norm(np.gradient(np.mean(greys, axis=0)), axis=0)
    textured = static & colored & (slopes > TEXTURED)  # slopes next to the image border are NaN
    out = np.full((2, len(motions)), np.nan)
    if np.count_nonzero(static) >= FEWEST:
        out[0] = [1000 * gap[static].mean() for gap in gaps]
    if np.count_nonzero(textured) >= FEWEST:
        for k, (grey, difference) in enumerate(zip(greys, differences, strict=True)):
            gain, offset = fit_exposure(grey, difference, textured.astype(np.float32))
            error = difference + np.float32(1 - gain) * grey - np.float32(offset)
            out[1, k] = 255 * np.minimum(np.abs(error[textured]), WORST_INTENSITY).mean()
    return out


def _moved(T: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.floating]:
    R, t = T[:3, :3].astype(np.float32), T[:3, 3:].astype(np.float32)
    return R @ points + t


def _moving(
    points: NDArray[np.floating], velocity: NDArray[np.float64]
) -> Callable[[NDArray[np.float32]], NDArray[np.floating]]:
    turn, shift = se3.hat(velocity[3:]).astype(np.float32), velocity[:3, None].astype(np.float32)
    speed = turn @ points + shift
    bend = np.float32(0.5) * turn @ speed
    return lambda tau: points + tau * (speed + tau * bend)


def _seen(
    points: NDArray[np.floating], calibration: Calibration, velocity: NDArray[np.float64], offset: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    camera, at = calibration.camera, _moving(points, velocity)
    readout, delay = calibration.depth_readout + calibration.readout, np.float32(offset + calibration.delay)
    seen = _moved(calibration.T_color_depth, at(np.full(points.shape[1], -delay)))
    for _ in range(ROW_STEPS if readout else 0):
        rows = np.clip(camera.fy * seen[1] / np.maximum(seen[2], np.float32(1e-3)) + camera.cy, 0, camera.height)
        tau = delay + readout * ((rows + 0.5) / camera.height - 0.5)
        seen = _moved(calibration.T_color_depth, at(-tau.astype(np.float32)))
    return Lens(camera).project(seen.T.astype(np.float64))


def _shades(
    images: Images, points: NDArray[np.floating], calibration: Calibration, velocity: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    height, width = images.intensity.shape
    camera = calibration.camera.resized(width, height)
    pixels, _ = _seen(points, replace(calibration, camera=camera), velocity, images.color_offset)
    corner = np.array([width - 1, height - 1]) / 2
    squares = np.sum((pixels - corner) ** 2, axis=1) / np.sum(corner**2)
    brightness = np.exp(-calibration.vignetting * squares).astype(np.float32)
    return _sampled(images.intensity, pixels, images.depth.shape), brightness.reshape(images.depth.shape)


def _sampled(image: NDArray[np.float32], pixels: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    import cv2

    us, vs = pixels.T.reshape(2, *shape)
    return np.asarray(cv2.remap(image, us, vs, cv2.INTER_LINEAR, borderValue=np.nan), np.float32)


def _smoothed(intensity: NDArray[np.float32]) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.GaussianBlur(intensity, (0, 0), BLUR), np.float32)


def _velocity(poses: Mapping[int, NDArray[np.float64]], stamps: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    first, last = (m if m in poses and abs(stamps[m] - stamps[n]) <= MAX_GAP / 2 else n for m in (n - 1, n + 1))
    return central_velocity((stamps[first], poses[first]), (stamps[last], poses[last]))


def _pose(trajectory: Trajectory, timestamp: float) -> NDArray[np.float64] | None:
    stamps = trajectory.timestamps
    if not stamps[0] - 1e-6 <= timestamp <= stamps[-1] + 1e-6 or np.abs(stamps - timestamp).min() > LARGEST_GAP:
        return None
    return trajectory.interpolate(float(np.clip(timestamp, stamps[0], stamps[-1])))
