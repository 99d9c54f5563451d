"""Wrong input that still runs: what is said of a recording that is spoilt in one way, and what a run makes of it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dudmap.benchmark.table import grid
from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.evaluation.trajectory import accuracy
from dudmap.frames.frame import Frame
from dudmap.pipeline.inspection import inspect
from dudmap.sequences import Sequence
from dudmap.slam import Slam

RIGHT = "as recorded"
"""The recording itself, of which nothing may be said."""
WALL, WALL_NOISE = 2.0, 0.004
"""Distance of a wall without relief, and the standard deviation of its readings, metres."""


def _scaled(frame: Frame, factor: float) -> Frame:
    return replace(frame, depth=frame.depth * np.float32(factor))


def _turned(frame: Frame, rows: int, columns: int) -> Frame:
    return replace(frame, color=np.ascontiguousarray(frame.color[::rows, ::columns]))


def _black(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color))


def _wall(frame: Frame) -> Frame:
    rng = np.random.default_rng(round(1000 * frame.timestamp))
    return replace(frame, depth=rng.normal(WALL, WALL_NOISE, frame.depth.shape).astype(np.float32))


FACTORS = {"depth five times too large": 5.0, "depth five times too small": 0.2}
"""True depth scale over the given one."""
SPOILT: dict[str, Callable[[Frame], Frame]] = {
    RIGHT: lambda frame: frame,
    **{name: partial(_scaled, factor=factor) for name, factor in FACTORS.items()},
    "colour mirrored left-right": lambda frame: _turned(frame, 1, -1),
    "colour upside down": lambda frame: _turned(frame, -1, 1),
    "colour rotated by 180 degrees": lambda frame: _turned(frame, -1, -1),
    "colour black": _black,
    "depth a flat wall of noise": _wall,
    "the same, colour black": lambda frame: _black(_wall(frame)),
}
"""What is done to every frame, by name."""


class SpoiltSequence:
    """The first frames of a recording, each of them spoilt in the same way.

    Args:
        recording: The recording.
        name: Key of ``SPOILT``.
        frames: Number of frames.

    Raises:
        ConfigError: The name is unknown.
    """

    def __init__(self, recording: Sequence, name: str, frames: int) -> None:
        if name not in SPOILT:
            raise ConfigError(f"unknown kind of wrong input {name!r}; expected one of {', '.join(SPOILT)}")
        self.recording, self.name, self._spoil = recording, name, SPOILT[name]
        scale = recording.camera.depth_scale / FACTORS.get(name, 1.0)
        self.camera, self.calibration = replace(recording.camera, depth_scale=scale), recording.calibration
        self.timestamps, self.ground_truth = recording.timestamps[:frames], recording.ground_truth

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        return self._spoil(self.recording[index])

    def mask(self, index: int) -> None:
        """No true mask is known."""


class SpoiltRun(NamedTuple):
    """What is said of a spoilt recording, and what a run makes of it.

    Attributes:
        name: Key of ``SPOILT``.
        warnings: Sentences of ``inspect``.
        frames: Number of frames.
        tracked: Number of frames that get a pose.
        doubtful: How many of these poses are called ``uncertain`` or ``blind``.
        ate: RMSE of the ATE, metres; None with fewer than three poses.
    """

    name: str
    warnings: list[str]
    frames: int
    tracked: int
    doubtful: int
    ate: float | None

    @property
    def fails(self) -> bool:
        """Whether nothing is said of wrong input, or something of right input."""
        return bool(self.warnings) == (self.name == RIGHT)


def measure_wrong_input(
    recording: Sequence, config: Config, names: list[str] | None = None, frames: int = 40
) -> Iterator[SpoiltRun]:
    """Inspect and process a recording spoilt in every way, or in those that are named.

    Raises:
        ConfigError: The recording has no true poses, or a name is unknown.
    """
    if recording.ground_truth is None:
        raise ConfigError(f"{recording.name} has no true poses; expected a recording with groundtruth.txt")
    for sequence in [SpoiltSequence(recording, name, frames) for name in names or SPOILT]:
        slam = Slam(sequence.camera, config, calibration=sequence.calibration)
        tracked = doubtful = 0
        for index in range(len(sequence)):
            result = slam.process(sequence[index])
            tracked += result.T_world_camera is not None
            doubtful += bool(result.uncertain) or result.blind
        ate = accuracy(slam.trajectory, recording.ground_truth, ("ate_rmse_m",))["ate_rmse_m"]
        yield SpoiltRun(
            sequence.name, inspect(sequence).warnings, len(sequence), tracked, doubtful,
            ate if isinstance(ate, float) else None,
        )  # fmt: skip


def spoilt_table(runs: list[SpoiltRun]) -> str:
    """Markdown table, one line per run."""
    rows = [
        [
            run.name, "; ".join(run.warnings) or "nothing", f"{run.tracked} of {run.frames}", str(run.doubtful),
            "-" if run.ate is None else f"{100 * run.ate:.1f}",
        ]
        for run in runs
    ]  # fmt: skip
    return grid(["spoilt", "what is said", "tracked", "of them doubtful", "ATE RMSE, cm"], rows, words=2)
