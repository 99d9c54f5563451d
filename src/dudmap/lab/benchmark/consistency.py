"""How well trajectories explain the images of a recording: no truth is needed, and a wrong one is found out.

A frame seen from the pose of another one must show the depth and the intensities measured there. Trajectories are
compared on the same pixels of the same pairs of frames, so that what no pose explains, such as noise, movers and
occlusion, concerns them all alike.

Trajectories with too few frames of the recording in common are a ``DatasetError``.
"""

from collections.abc import Mapping
from collections.abc import Sequence as List
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.frames.observation import Level, Pyramid, reduced
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.association import LARGEST_GAP
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.measure import grid

GAPS = 5, 15, 30
"""Frames between the two of a pair."""
PAIRS = 100
"""Approximate number of pairs of each gap that are compared."""
TERMS = {"depth": "mm at 1 m", "intensity": "of 255"}
"""What is compared, and its unit."""
WORST_DEPTH, WORST_INTENSITY = 0.05, 0.2
"""Differences count up to these: depth over the squared depth (1/m), and intensity (0..1). A pixel whose depth differs
by more with every trajectory is occluded or moves, and is left out."""
SMOOTH = 0.05
"""Largest step of the depth to a neighbour, as a share of it, of a surface that is interpolated."""
TEXTURED = 0.02
"""Smallest gradient of the intensity (0..1) per pixel."""
FEWEST = 200
"""Pixels that a pair must have in common; else it is left out, or its intensities are."""
SAMPLES, LEAST_BLOCKS = 2000, 3
"""Samples of the bootstrap, and stretches of the recording that it needs."""


class Consistency(NamedTuple):
    """Misfits of k trajectories.

    Attributes:
        names, gaps: Of the trajectories; frames between the two of a pair.
        misfits, counts: (2, gaps, blocks, k) sums of the misfits of depth (mm at 1 m) and intensity (of 255), and (2,
            gaps, blocks) pairs, that begin in one stretch of the recording, as long as the longest gap.
    """

    names: list[str]
    gaps: tuple[int, ...]
    misfits: NDArray[np.float64]
    counts: NDArray[np.float64]

    def means(self) -> NDArray[np.float64]:
        """Mean misfits (2, gaps, k)."""
        return self.misfits.sum(axis=2) / np.maximum(self.counts.sum(axis=2), 1)[..., None]

    def samples(self) -> NDArray[np.float64]:
        """Mean misfits (SAMPLES, 2, gaps, k) of stretches drawn with replacement: pairs that overlap are not
        independent, but stretches nearly are."""
        blocks = self.misfits.shape[2]
        times = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), SAMPLES)
        sums = np.einsum("sb,tgbk->stgk", times, self.misfits)
        return sums / np.maximum(np.einsum("sb,tgb->stg", times, self.counts), 1)[..., None]

    def intervals(self) -> NDArray[np.float64]:
        """Ends (2, 2, gaps, k) of the intervals of 95 % of the means."""
        return np.percentile(self.samples(), (2.5, 97.5), axis=0)

    def excess(self, term: int, one: int, other: int) -> tuple[float, float, float]:
        """By which share the misfit of one trajectory is above that of another, in the mean over the gaps, and the ends
        of its interval of 95 %; NaN where no pair could be compared."""
        seen = self.counts[term].any(axis=1)
        if not seen.any():
            return np.nan, np.nan, np.nan
        misfits = (np.maximum(found[..., term, seen, :], 1e-9) for found in (self.means(), self.samples()))
        share, drawn = (np.expm1(np.log(each[..., one] / each[..., other]).mean(axis=-1)) for each in misfits)
        return (float(share), *np.percentile(drawn, (2.5, 97.5)).tolist())

    def verdicts(self) -> list[str]:
        """For each term one sentence on every trajectory that is not the best one."""
        sentences = []
        for term, name in enumerate(TERMS):
            best = int(np.argmin(np.log(np.maximum(self.means()[term], 1e-9)).sum(axis=0)))
            for other in (k for k in range(len(self.names)) if k != best):
                share, low, high = self.excess(term, other, best)
                outcome = "{} is worse than {} by" if low > 0 else "{} and {} are undecided:"
                named = outcome.format(self.names[other], self.names[best])
                sentences.append(f"{name}: {named} {share:.1%} ({low:.1%} to {high:.1%})")
        return sentences

    def table(self) -> str:
        """Markdown table of the misfits with half the width of their interval of 95 %, and the verdicts."""
        low, high = self.intervals()
        head = ["", *(f"{term} ({unit}), {gap}" for term, unit in TERMS.items() for gap in self.gaps)]
        cells = np.stack([self.means(), (high - low) / 2], axis=-1).reshape(-1, len(self.names), 2)
        texts = ([f"{mean:.2f} ± {half:.2f}" for mean, half in cells[:, k]] for k in range(len(self.names)))
        rows = [[name, *text] for name, text in zip(self.names, texts, strict=True)]
        return grid(head, rows, words=1) + "\n" + "\n".join(f"- {sentence}" for sentence in self.verdicts())


def measure_consistency(
    sequence: Sequence,
    trajectories: Mapping[str, Trajectory],
    gaps: tuple[int, ...] = GAPS,
    max_frames: int | None = None,
) -> Consistency:
    """Compare pairs of frames of a recording, as trajectories relate them; known dynamic pixels and gaps too long for
    the recording are left out.
    """
    stamps = sequence.timestamps[:max_frames]
    found = (((n, _pose(each, t)) for n, t in enumerate(stamps)) for each in trajectories.values())
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
    views: dict[int, Level] = {}

    def view(n: int) -> Level:
        if n not in views:
            level = Pyramid.of(preprocess(sequence[n]), preprocess.camera, config).fine
            mask = sequence.mask(n)
            depth = level.depth if mask is None else np.where(reduced(preprocess.mask(mask), level), 0, level.depth)
            views[n] = Level(level.camera, depth.astype(np.float32), level.intensity)
        return views[n]

    shared = set(known)
    for n in known[::every]:
        views = {number: level for number, level in views.items() if number >= n}
        for g, gap in enumerate(gaps):
            if n + gap in shared:
                motions = [se3.inverse(each[n + gap]) @ each[n] for each in poses]
                pair, block = pair_misfits(view(n), view(n + gap), motions), min((n - known[0]) // length, blocks - 1)
                usable = np.isfinite(pair[:, 0])
                misfits[usable, g, block] += pair[usable]
                counts[usable, g, block] += 1
    return Consistency(list(trajectories), gaps, misfits, counts)


def pair_misfits(first: Level, second: Level, motions: List[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Mean misfits (2, k) of the depth (mm at 1 m) and the intensity (of 255) of two images on the same pixels, for k
    motions (4, 4) from the first camera to the second; NaN where the images have too little in common."""
    import cv2

    camera, near, z = first.camera, np.ones((3, 3), np.uint8), first.depth
    height, width = z.shape
    rays = np.meshgrid((np.arange(width) - camera.cx) / camera.fx, (np.arange(height) - camera.cy) / camera.fy)
    points = np.stack([*rays, np.ones_like(rays[0])]).astype(np.float32) * z
    step = cv2.dilate(second.depth, near) - cv2.erode(second.depth, near)
    smooth = ((cv2.erode(second.depth, near) > 0) & (step < SMOOTH * second.depth)).astype(np.float32)
    gaps, differences, valid = [], [], z > 0
    for T in motions:
        x, y, depth = np.tensordot(T[:3, :3].astype(np.float32), points, 1) + T[:3, 3, None, None].astype(np.float32)
        ahead = np.maximum(depth, np.float32(1e-3))
        us = (x / ahead * camera.fx + camera.cx).astype(np.float32)
        vs = (y / ahead * camera.fy + camera.cy).astype(np.float32)
        images = second.depth, second.intensity, smooth
        seen, grey, surface = (np.asarray(cv2.remap(image, us, vs, cv2.INTER_LINEAR)) for image in images)
        valid &= (surface > 0.999) & (depth > 0)
        gaps.append(np.minimum(np.abs(seen - depth) / ahead**2, WORST_DEPTH))
        differences.append(grey - first.intensity)
    static = valid & (np.min(gaps, axis=0) < WORST_DEPTH)
    textured = static & (np.linalg.norm(np.gradient(first.intensity), axis=0) > TEXTURED)
    out = np.full((2, len(motions)), np.nan)
    if np.count_nonzero(static) >= FEWEST:
        out[0] = [1000 * gap[static].mean() for gap in gaps]
    if np.count_nonzero(textured) >= FEWEST:
        for k, difference in enumerate(differences):
            gain, offset = fit_exposure(first.intensity, difference, textured.astype(np.float32))
            error = difference + np.float32(1 - gain) * first.intensity - np.float32(offset)
            out[1, k] = 255 * np.minimum(np.abs(error[textured]), WORST_INTENSITY).mean()
    return out


def _pose(trajectory: Trajectory, timestamp: float) -> NDArray[np.float64] | None:
    """Pose (4, 4) at a time within the trajectory; None where it has no row near it."""
    stamps = trajectory.timestamps
    if not stamps[0] - 1e-6 <= timestamp <= stamps[-1] + 1e-6 or np.abs(stamps - timestamp).min() > LARGEST_GAP:
        return None
    return trajectory.interpolate(float(np.clip(timestamp, stamps[0], stamps[-1])))
