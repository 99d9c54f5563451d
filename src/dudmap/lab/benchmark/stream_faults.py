"""Measure the reaction of a run to stream faults. Unknown faults, or no true poses, raise a ``ConfigError``."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError, FrameError
from dudmap.evaluation.tables import grid
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.suites import Excerpt
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA
from dudmap.lab.synthetic.stream_faults import FAULTS, FaultyStream

SILENT_ERROR = 0.03
"""Smallest error of a wrong pose, metres, and ``SILENT_RATIO`` times the largest one without fault."""
SILENT_RATIO = 3.0
LAST_FRAMES = 5
"""Last frames without a pose of a lost stream."""


@dataclass(frozen=True, eq=False)
class FaultRun:
    """Result of a stream with a fault.

    Attributes:
        lost, maps: Lost frames, submaps.
        errors: (N,) position error per frame, metres; NaN without a pose.
        flagged: (N,) bool, doubtful poses: ``FrameResult.blind``, ``uncertain`` or repeated.
    """

    fault: str
    rejected: dict[str, int]
    lost: int
    maps: int
    errors: NDArray[np.float64]
    flagged: NDArray[np.bool_]

    def wrong(self, clean: "FaultRun") -> tuple[int, int]:
        """Numbers of wrong poses: unflagged, and flagged."""
        wrong = self.errors > max(SILENT_ERROR, SILENT_RATIO * float(np.nanmax(clean.errors)))
        return int(np.count_nonzero(wrong & ~self.flagged)), int(np.count_nonzero(wrong & self.flagged))

    def frames_to_recovery(self) -> int | None:
        """Longest run of frames without a pose; None if the last LAST_FRAMES lack one."""
        without, longest = 0, 0
        for missing in np.isnan(self.errors):
            without = without + 1 if missing else 0
            longest = max(longest, without)
        return None if without >= LAST_FRAMES else longest

    def outcome(self, clean: "FaultRun") -> str:
        """Outcome; FAILED for unflagged wrong poses or a lost stream."""
        if self.wrong(clean)[0]:
            return "FAILED: wrong poses are called tracked"
        if self.frames_to_recovery() is None:
            return "FAILED: lost to the end"
        if self.lost:
            return "lost and recovered" if self.maps == 1 else "lost, went on in a new map"
        return "skipped and counted" if self.rejected else "handled"


def default_room(frames: int, width: int, seed: int) -> Sequence:
    """A room with a person, 4:3 images of 62 degrees, a Kinect's noise."""
    from dudmap.lab import synthetic

    camera = replace(DEFAULT_CAMERA.resized(width, width * 3 // 4), depth_scale=1000.0)
    return synthetic.sequence(frames=frames, seed=seed, camera=camera)


def measure_stream_faults(
    recording: Sequence, config: Config, faults: list[str] | None = None, frames: int | None = None
) -> Iterator[tuple[FaultRun, FaultRun]]:
    """Run the system without a fault and with each named fault (none: all).

    Yields:
        A run, and the faultless one, which is the first.
    """
    if recording.ground_truth is None:
        raise ConfigError(f"{recording.name} has no true poses; expected a recording with groundtruth.txt")
    kept = cast("Sequence", Excerpt(recording, frames))
    streams = {name: FaultyStream(kept, name) for name in ["none", *(n for n in faults or FAULTS if n != "none")]}
    clean: FaultRun | None = None
    for name, stream in streams.items():
        run = run_stream(stream, name, config)
        clean = clean or run
        yield run, clean


def run_stream(stream: FaultyStream, fault: str, config: Config) -> FaultRun:
    """Process a stream and compare every pose with the true one.

    Submaps are aligned by their first poses.
    """
    slam = Slam(stream.camera, config, calibration=stream.calibration)
    truth = _true_poses(stream)
    rejected: dict[str, int] = {}
    errors, flagged, anchors, lost = [], [], {}, 0
    for number, delivery in enumerate(stream.deliveries):
        errors.append(np.nan)
        flagged.append(False)
        try:
            result = slam.process(stream[number])
        except FrameError as error:
            rejected[error.kind] = rejected.get(error.kind, 0) + 1
            continue
        if result.status == "rejected":
            kind = result.verdict.failed[0].name
            rejected[kind] = rejected.get(kind, 0) + 1
        elif result.T_world_camera is None:
            lost += 1
        else:
            flagged[-1] = result.blind or bool(result.uncertain) or result.status == "repeated"
            T_true = truth[delivery.number]
            anchor = anchors.setdefault(result.submap, T_true @ se3.inverse(result.T_world_camera))
            errors[-1] = float(np.linalg.norm((anchor @ result.T_world_camera - T_true)[:3, 3]))
    return FaultRun(fault, rejected, lost, len(slam.maps), np.array(errors), np.array(flagged))


def _true_poses(stream: FaultyStream) -> list[NDArray[np.float64]]:
    truth: Trajectory | None = stream.ground_truth
    assert truth is not None
    first, last = float(truth.timestamps[0]), float(truth.timestamps[-1])
    return [truth.interpolate(min(max(float(t), first), last)) for t in stream.recording.timestamps]


def table_head(name: str, frames: int) -> str:
    """Caption and head of the Markdown table."""
    head = ["fault", "what happens", "outcome", "frames", "rejected", "lost", "RMSE, mm", "largest, mm",
            "wrong: silent, flagged", "frames to recovery"]  # fmt: skip
    return f"{name}, {frames} frames:\n\n{grid(head, [], words=10).rstrip()}"


def fault_row(run: FaultRun, clean: FaultRun) -> str:
    """Table line; errors of tracked poses."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(run.rejected.items())) or "0"
    errors, recovery = 1000 * run.errors[np.isfinite(run.errors)], run.frames_to_recovery()
    cells = [run.fault, FAULTS[run.fault].description, run.outcome(clean), len(run.errors), kinds, run.lost,
             f"{np.sqrt(np.mean(errors**2)):.1f}", f"{errors.max():.1f}", "{}, {}".format(*run.wrong(clean)),
             "never" if recovery is None else recovery]  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"
