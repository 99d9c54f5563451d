"""Conditions of the limit of dynamics and their synthetic recordings."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.evaluation.segmentation import SCORED_COVERAGE

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.lab.synthetic.recording import SyntheticSequence

SIZE = (320, 240)
"""Image size, pixels."""
FPS = 30.0
"""Frame rate, Hz."""
FRAMES = 90
"""Number of frames of a recording."""


@dataclass(frozen=True)
class Condition:
    """One experimental condition.

    Attributes:
        coverage: Mean share of the image that the crowd covers once all of it is in view.
        speed: Speed of the people, m/s.
        camera_path: Name of the built-in camera path.
        start_share: Share of the frames, from the first on, in which the crowd exists; None if it enters later.
        frames: Number of frames.
    """

    coverage: float
    speed: float = 1.0
    camera_path: str = "handheld"
    start_share: float | None = None
    frames: int = FRAMES

    def sequence(self) -> "SyntheticSequence | DepartingMovers":
        """Recording of this condition."""
        from dudmap.lab.synthetic import sequence
        from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

        recording = sequence(
            camera_path=self.camera_path,
            frames=self.frames,
            fps=FPS,
            speed=self.speed,
            coverage=self.coverage,
            start_dynamic=self.start_share is not None,
            camera=DEFAULT_CAMERA.resized(*SIZE),
        )
        if self.start_share is None:
            return recording
        return DepartingMovers(recording, round(self.start_share * self.frames))


class DepartingMovers:
    """Recording whose movers exist in the first frames only.

    Args:
        recording: Recording with movers from the first frame on.
        until: Number of the first frame without movers.
    """

    calibration = None

    def __init__(self, recording: "SyntheticSequence", until: int) -> None:
        self._parts, self._until = (recording, recording.static_twin()), until
        self.name, self.camera, self.timestamps = f"{recording.name}-leaving", recording.camera, recording.timestamps

    @property
    def ground_truth(self) -> "Trajectory":
        """True poses."""
        return self._parts[0].ground_truth

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> "Frame":
        return self._parts[index >= self._until][index]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """True dynamic mask (H, W)."""
        return self._parts[index >= self._until].mask(index)


class CachedRecording:
    """Recording rendered into memory once, for several systems."""

    calibration = None

    def __init__(self, recording: "SyntheticSequence | DepartingMovers") -> None:
        self.name, self.camera, self.timestamps = recording.name, recording.camera, recording.timestamps
        self.ground_truth = recording.ground_truth
        self._frames = [recording[index] for index in range(len(recording))]
        self._masks = [recording.mask(index) for index in range(len(recording))]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> "Frame":
        return self._frames[index]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """True dynamic mask (H, W)."""
        return self._masks[index]

    def coverage(self) -> float:
        """Mean true dynamic share of the image over the frames above ``SCORED_COVERAGE``."""
        shares = np.array([mask.mean() for mask in self._masks])
        return float(shares[shares > SCORED_COVERAGE].mean()) if (shares > SCORED_COVERAGE).any() else 0.0

    def camera_speed(self) -> float:
        """Mean speed of the camera, m/s."""
        steps = np.linalg.norm(np.diff(self.ground_truth.Ts_world_camera[:, :3, 3], axis=0), axis=1)
        return float(steps.sum() / (self.timestamps[-1] - self.timestamps[0]))
