"""Conditions of the limit of dynamics and their synthetic recordings."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

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
