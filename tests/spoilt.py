"""Recordings that are spoilt in one way, of which ``dudmap info`` must say something."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from dudmap.core.frames.frame import Frame
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.suites import Excerpt
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
