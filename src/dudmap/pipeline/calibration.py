"""Calibration of a whole recording."""

from typing import TYPE_CHECKING

from dudmap.calibration.collector import KeyframeCollector
from dudmap.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.config import Config
from dudmap.errors import DatasetError, FrameError
from dudmap.geometry.calibration import Calibration

if TYPE_CHECKING:
    from dudmap.sequences import Sequence


def calibrate_sequence(
    sequence: "Sequence", config: Config, given: Calibration, max_frames: int | None = None
) -> Estimate:
    """Track a recording with the calibration as given, and estimate a better one.

    Args:
        sequence: The recording.
        config: All parameters.
        given: The calibration to start from.
        max_frames: Use only so many frames.

    Raises:
        DatasetError: Hardly any frame could be read and tracked.
    """
    from dudmap.slam import Slam

    slam = Slam(sequence.camera, config, calibration=given)
    collector, submap = KeyframeCollector(given.camera), 0
    for index in range(len(sequence) if max_frames is None else min(max_frames, len(sequence))):
        try:
            view = slam.prepare(sequence[index])
        except FrameError:
            continue
        result = slam.process(view)
        if result.submap != submap:
            submap = result.submap
            collector.clear()
        if result.T_world_camera is None or result.blind:
            collector.interrupt()
        else:
            collector.add(view.observation, result.T_world_camera, slam.preprocess.mask(result.dynamic_mask))
    if len(collector.keyframes) < 2:
        raise DatasetError(f"{sequence.name} has no two tracked frames to compare")
    return CalibrationEstimator(given, config.sensor).estimate(collector.keyframes)
