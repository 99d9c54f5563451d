"""Calibration of a whole recording."""

from typing import TYPE_CHECKING

from dudmap.calibration.collector import KeyframeCollector
from dudmap.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.config import Config
from dudmap.errors import DatasetError, FrameError
from dudmap.geometry.calibration import Calibration
from dudmap.sequences import is_timed

if TYPE_CHECKING:
    from collections.abc import Callable

    from dudmap.sequences import Sequence


START_FRAMES, MIN_FRAMES = 300, 90
"""Frames at the start of a recording from which a run calibrates itself, and the fewest that can show a fault: the
estimator compares pairs of keyframes from both halves of the time."""


def calibrate_start(
    sequence: "Sequence", config: Config, max_frames: int | None = None, notice: "Callable[[str], None] | None" = None
) -> Calibration | None:
    """Calibration estimated from the start of a recording; None where none was made.

    Preset ``thesis``, which takes the images as they are, and short recordings are not calibrated.

    Args:
        sequence: The recording.
        config: All parameters.
        max_frames: Number of frames that will be processed; None for all.
        notice: Receives one sentence before and one after the estimation.
    """
    notice = notice or (lambda text: None)
    count = min(len(sequence), START_FRAMES, max_frames or len(sequence))
    if config.preset == "thesis" or count < MIN_FRAMES:
        return None
    notice(f"calibrating the colour camera from the first {count} frames (--calibration given leaves this out)")
    given = sequence.calibration or Calibration.registered(sequence.camera)
    try:
        found = calibrate_sequence(sequence, config, given, count).calibration
    except DatasetError as error:
        notice(f"the colour camera is taken as given: {error}")
        return None
    names = ", ".join(found.estimated)
    notice(f"colour camera: estimated {names}" if names else "colour camera: as given, the images show no fault")
    return found


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

    tracking = config.override(["sensor.self_calibration=false"])
    slam = Slam(sequence.camera, tracking, calibration=given, timed=is_timed(sequence))
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
