"""Calibrate a whole recording."""

import logging
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from dudmap.app.pipeline.frame_source import read_ahead
from dudmap.app.pipeline.image_checks import color_magnification, unregistered
from dudmap.config import Config
from dudmap.core.backends.cpu.filtering import halve
from dudmap.core.backends.threads import num_threads
from dudmap.core.calibration.estimator import CalibrationEstimator, Estimate, mask_of
from dudmap.core.calibration.findings import ASSUMED, findings, outcome
from dudmap.core.calibration.keyframes import ColorKeyframe, KeyframeCollector, halvings_to
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import HALVING_BAND
from dudmap.core.geometry.calibration import NUM_PARAMETERS, PARAMETERS, Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import has_color, is_timed

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from dudmap.io.sequences import Sequence

log = logging.getLogger(__name__)

START_FRAMES, MIN_FRAMES = 300, 90
"""Frames that calibrate a run at its start, and fewest such frames."""
WIDTH, INTERVAL = 320, 1 / 30
"""Width (pixels) and largest interval (s) of the tracked images. A keyframe's velocity is the mean over two
intervals."""
SPACING, SHORT = 0.2, 5.0
"""Seconds between keyframes in recordings longer than ``SHORT``; only keyframes and neighbours are read."""
GAP = 2.5
"""Largest time between the neighbours of a keyframe, usual intervals."""
VOXEL_SIZE = 0.02
"""Smallest voxel size of the tracking map, reference depths."""


def calibrate_start(
    sequence: "Sequence",
    config: Config,
    max_frames: int,
    progress: "Callable[[int, int], None]",
    ignore: "NDArray[np.bool_] | None" = None,
) -> Calibration | None:
    """Calibration from the first frames of a recording; None without one, with the reason in the log, and for short
    recordings.

    ``progress`` receives the numbers of tracked and of all frames. Pixels ``ignore`` (H, W) are never used.
    """
    count = min(len(sequence), START_FRAMES, max_frames)
    if not has_color(sequence):
        return None
    given = known_calibration(sequence)
    if count < MIN_FRAMES:
        log.info("colour: %s: that takes %d frames", ASSUMED, MIN_FRAMES)
        return given if given.estimated else None
    log.debug("calibrating the colour camera from the first %d frames (--calibration given leaves this out)", count)
    try:
        estimate = calibrate_sequence(sequence, config, given, count, progress, ignore)
    except DatasetError as error:
        log.warning("colour: %s: %s", ASSUMED, error)
        return None
    found = replace(estimate.calibration, notes=tuple(findings(estimate)))
    log.info(outcome(found, sequence.camera))
    for finding in found.notes:
        log.debug(finding)
    return found


def known_calibration(sequence: "Sequence") -> Calibration:
    """Calibration of a recording, else of registered colours.

    The focal length is corrected, with a warning, if edges of depth and colour clearly contradict it.
    """
    if not has_color(sequence):
        raise DatasetError(f"{sequence.name} has no colour images: there is no colour camera to calibrate")
    given = sequence.calibration or Calibration.registered(sequence.camera)
    magnification = color_magnification(sequence)
    if magnification is None:
        return given
    log.warning("colour camera: %s; the calibration begins there", unregistered(magnification))
    found = given.retract(np.log(magnification) * (np.arange(NUM_PARAMETERS) == PARAMETERS.index("log_focal")))
    return replace(found, estimated=(*given.estimated, "log_focal"))


def calibrate_sequence(
    sequence: "Sequence",
    config: Config,
    given: Calibration,
    max_frames: int | None = None,
    progress: "Callable[[int, int], None]" = lambda done, total: None,
    ignore: "NDArray[np.bool_] | None" = None,
) -> Estimate:
    """Track a recording quickly, and estimate a better calibration; images at an ``INTERVAL``, about ``WIDTH`` wide,
    suffice.

    For ``progress`` and ``ignore`` see ``calibrate_start``.

    Raises:
        DatasetError: Hardly any frame could be read and tracked.
    """
    from dudmap.core.slam import Slam

    halvings = halvings_to(WIDTH, sequence.camera)
    count = len(sequence) if max_frames is None else min(max_frames, len(sequence))
    small = _Excerpt(sequence, given, halvings, count, config.sensor.reference_depth)
    slam = Slam(
        small.camera, _quick(config, halvings), calibration=small.calibration, timed=is_timed(sequence),
        ignore=None if ignore is None else _halved(ignore, halvings),
    )  # fmt: skip
    log.debug("calibration: tracking %d images of %dx%d", len(small), small.camera.width, small.camera.height)
    collector, submap, keyframes = KeyframeCollector(small.calibration, GAP * small.interval), 0, list[ColorKeyframe]()
    with closing(read_ahead(small, len(small), slam=slam)) as frames:
        for number, (_, read, *_) in enumerate(frames, start=1):
            progress(number, len(small))
            if isinstance(read.frame, FrameError) or read.prepared is None:
                continue
            result = slam.process(read.prepared)
            if result.submap != submap:
                submap, keyframes = result.submap, max(keyframes, collector.keyframes, key=len)
                collector.clear()
            if result.status == "repeated":
                continue
            if result.T_world_camera is None or result.blind:
                collector.interrupt()
            else:
                mask = slam.preprocess.mask(result.dynamic_mask)
                collector.add(read.prepared.observation, result.T_world_camera, mask)
    # of the longest map, because poses of different maps cannot be compared
    keyframes = max(keyframes, collector.keyframes, key=len)
    if len(keyframes) < 2:
        raise DatasetError(f"{sequence.name} has no two tracked frames to compare")
    log.debug("calibration: comparing %d of them with each other", len(keyframes))
    estimate = CalibrationEstimator(small.calibration, config.sensor, num_threads()).estimate(keyframes)
    found = _enlarged(estimate.calibration, given.camera, halvings)
    before = tuple(name for name in given.estimated if name not in found.estimated)
    return replace(estimate, calibration=replace(found, estimated=(*before, *found.estimated)))


def _quick(config: Config, halvings: int) -> Config:
    preprocess = config.preprocess
    return config.override([
        "sensor.self_calibration=false", "movers.enabled=false", "loops.enabled=false",
        f"volume.voxel_size={max(config.volume.voxel_size, VOXEL_SIZE * config.sensor.reference_depth)}",
        f"preprocess.filter_sigma_px={preprocess.filter_sigma_px / (1 << halvings)}",
        f"preprocess.filter_radius={max(1, preprocess.filter_radius >> halvings)}",
    ])  # fmt: skip


def _halved(mask: "NDArray[np.bool_]", halvings: int) -> "NDArray[np.bool_]":
    for _ in range(halvings):
        height, width = (size // 2 for size in mask.shape)
        mask = np.asarray(mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2).any(axis=(1, 3)), np.bool_)
    return mask


class _Excerpt:
    """Keyframes of a recording and their neighbours, halved by 2x2 blocks."""

    def __init__(
        self, sequence: "Sequence", given: Calibration, halvings: int, count: int, reference_depth: float
    ) -> None:
        usual = float(np.median(np.diff(sequence.timestamps[:count]))) if count > 1 else INTERVAL
        self._sequence, self._halvings, self._reference_depth = sequence, halvings, reference_depth
        self.name, self.ground_truth = sequence.name, None
        step = max(1, int(1.01 * INTERVAL / max(usual, 1e-3)))
        self.interval = step * usual
        self._numbers = _around_keyframes(sequence.timestamps, range(0, count, step))
        self.timestamps = np.asarray(sequence.timestamps)[self._numbers]
        self.camera = sequence.camera.scaled(halvings)
        self.calibration = replace(given, camera=given.camera.scaled(halvings))

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        frame = self._sequence[self._numbers[index]]
        depth, color = np.ascontiguousarray(frame.depth, np.float32), frame.rgb
        for _ in range(self._halvings):
            depth, _ = halve(depth, np.zeros_like(depth), HALVING_BAND, self._reference_depth)
            height, width = (size // 2 for size in color.shape[:2])
            color = cv2.resize(color[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        return replace(frame, depth=depth, color=np.asarray(color, np.uint8))

    def mask(self, index: int) -> None:
        """None: no mask is scored here."""


def _around_keyframes(timestamps: "NDArray[np.float64]", numbers: range) -> list[int]:
    if not len(numbers) or timestamps[numbers[-1]] - timestamps[numbers[0]] <= SHORT:
        return list(numbers)
    chosen, due = set[int](), -np.inf
    for first, middle, last in zip(numbers, numbers[1:], numbers[2:], strict=False):
        if timestamps[middle] >= due:
            chosen |= {first, middle, last}
            due = timestamps[middle] + SPACING - 1e-3
    return sorted(chosen)


def _enlarged(found: Calibration, camera: Camera, halvings: int) -> Calibration:
    factor, sigma = 1 << halvings, found.sigma.copy()
    sigma[mask_of(("center_x", "center_y"))] *= factor
    whole = found.camera.resized(found.camera.width * factor, found.camera.height * factor)
    return replace(found, camera=replace(whole, width=camera.width, height=camera.height), sigma=sigma)
