"""Wrong input that still runs: what is said of a recording that is spoilt in one way, and what a run makes of it."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dudmap.app.pipeline.inspection import inspect
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError
from dudmap.evaluation.trajectory import accuracy
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.entries import Excerpt
from dudmap.lab.benchmark.table import grid
from dudmap.lab.synthetic.stream_faults import black, scaled


def _turned(frame: Frame, rows: int, columns: int) -> Frame:
    return replace(frame, color=np.ascontiguousarray(frame.color[::rows, ::columns]))


def _wall(frame: Frame) -> Frame:
    """A wall without relief at 2 m, whose readings have a standard deviation of 4 mm."""
    rng = np.random.default_rng(round(1000 * frame.timestamp))
    return replace(frame, depth=rng.normal(2.0, 0.004, frame.depth.shape).astype(np.float32))


RIGHT = "as recorded"
"""The recording itself, of which nothing may be said."""
LARGE = "depth five times too large"
FACTORS = {LARGE: 5.0, "depth five times too small": 0.2}
"""True depth scale over the given one."""
SPOILT: dict[str, Callable[[Frame], Frame]] = {
    RIGHT: lambda frame: frame,
    **{name: partial(scaled, factor=factor) for name, factor in FACTORS.items()},
    "colour mirrored left-right": partial(_turned, rows=1, columns=-1),
    "colour upside down": partial(_turned, rows=-1, columns=1),
    "colour rotated by 180 degrees": partial(_turned, rows=-1, columns=-1),
    "colour black": black,
    "depth a flat wall of noise": _wall,
    "the same, colour black": lambda frame: black(_wall(frame)),
}
"""What is done to every frame, by name."""


class SpoiltSequence(Excerpt):
    """The first frames of a recording, each of them spoilt in the same way, a key of ``SPOILT``."""

    def __init__(self, recording: Sequence, name: str, frames: int) -> None:
        super().__init__(recording, frames)
        self.name = name
        self.camera = replace(recording.camera, depth_scale=recording.camera.depth_scale / FACTORS.get(name, 1.0))

    def __getitem__(self, index: int) -> Frame:
        return SPOILT[self.name](super().__getitem__(index))


class SpoiltRun(NamedTuple):
    """What is said of a spoilt recording, and what a run makes of it.

    Attributes:
        name: Key of ``SPOILT``.
        warnings: Sentences of ``inspect``.
        frames, tracked, doubtful: Number of frames, of those with a pose, and of those called ``uncertain`` or
            ``blind``.
        ate: RMSE of the ATE, metres; None with too few poses.
    """

    name: str
    warnings: list[str]
    frames: int
    tracked: int
    doubtful: int
    ate: float | str | None

    @property
    def fails(self) -> bool:
        """Whether nothing is said of wrong input, or something of right input."""
        return bool(self.warnings) == (self.name == RIGHT)


def measure_wrong_input(recording: Sequence, config: Config, names: Iterable[str], frames: int) -> Iterator[SpoiltRun]:
    """Inspect and process a recording spoilt in the ways that are named, keys of ``SPOILT``.

    Raises:
        ConfigError: The recording has no true poses.
    """
    if recording.ground_truth is None:
        raise ConfigError(f"{recording.name} has no true poses; expected a recording with groundtruth.txt")
    for name in names:
        sequence = SpoiltSequence(recording, name, frames)
        slam = Slam(sequence.camera, config, calibration=sequence.calibration)
        results = [slam.process(sequence[index]) for index in range(len(sequence))]
        tracked = sum(result.T_world_camera is not None for result in results)
        doubtful = sum(bool(result.uncertain) or result.blind for result in results)
        ate = accuracy(slam.trajectory, recording.ground_truth, ("ate_rmse_m",))["ate_rmse_m"]
        yield SpoiltRun(name, inspect(sequence).warnings, len(results), tracked, doubtful, ate)


def spoilt_table(runs: list[SpoiltRun]) -> str:
    """Markdown table, one line per run."""
    rows = []
    for run in runs:
        figures = [f"{run.tracked} of {run.frames}", str(run.doubtful)]
        ate = f"{1000 * run.ate:.1f}" if isinstance(run.ate, float) else "-"
        rows.append([run.name, "; ".join(run.warnings) or "nothing", *figures, ate])
    return grid(["spoilt", "what is said", "tracked", "doubtful", "ATE RMSE, mm"], rows, words=2)
