"""Faults of the frame stream, injected into any recording."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import FrameError
from dudmap.io.sequences import Sequence
from dudmap.lab.data import find

Alteration = Callable[[Frame], Frame]
SPAN = 0.4, 0.6
"""Altered part of the recording, shares of its frames."""
LONG_GAP, CLOCK_STEP = 10.0, 3600.0
"""Gap, and clock step, seconds."""
BURST, BURST_SPACING = 5, 0.001
"""Frames that arrive together, and time between their stamps, seconds."""
INVALID_SHARE = 0.3
"""Share of the pixels with invalid depth."""


class Delivery(NamedTuple):
    """One arriving frame: number, stamp (s), alteration."""

    number: int
    timestamp: float
    alter: Alteration | None = None


Schedule = Callable[[NDArray[np.float64]], list[Delivery]]


class StreamFault(NamedTuple):
    """A fault: description, and deliveries by stamps."""

    description: str
    schedule: Schedule


class FaultyStream:
    """A recording with one of ``FAULTS``; stamps need not increase."""

    def __init__(self, recording: Sequence, fault: str) -> None:
        self.recording = recording
        self.name = f"{recording.name}-{fault.replace(' ', '-')}"
        self.camera, self.calibration = recording.camera, recording.calibration
        self.ground_truth: Trajectory | None = recording.ground_truth
        self.deliveries = find(fault, FAULTS, "fault").schedule(recording.timestamps)
        self.timestamps = np.array([delivery.timestamp for delivery in self.deliveries])

    def __len__(self) -> int:
        return len(self.deliveries)

    def __getitem__(self, index: int) -> Frame:
        delivery = self.deliveries[index]
        frame = self.recording[delivery.number]
        color = frame.color_timestamp
        color = None if color is None else delivery.timestamp + (color - frame.timestamp)
        frame = replace(frame, timestamp=delivery.timestamp, color_timestamp=color)
        return frame if delivery.alter is None else delivery.alter(frame)

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame if known."""
        return self.recording.mask(self.deliveries[index].number)


def _span(times: NDArray[np.float64]) -> tuple[int, int]:
    return round(SPAN[0] * len(times)), round(SPAN[1] * len(times))


def _plain(times: NDArray[np.float64]) -> list[Delivery]:
    return [Delivery(index, float(t)) for index, t in enumerate(times)]


def _altered(times: NDArray[np.float64], alter: Alteration) -> list[Delivery]:
    first, stop = _span(times)
    return [item._replace(alter=alter) if first <= item.number < stop else item for item in _plain(times)]


def _dropped(times: NDArray[np.float64]) -> list[Delivery]:
    missing = np.random.default_rng(0).random(len(times)) < 0.3
    missing[0] = False
    return [item for item in _plain(times) if not missing[item.number]]


def _duplicated(times: NDArray[np.float64]) -> list[Delivery]:
    return [item for item in _plain(times) for _ in range(2 if item.number % 3 == 2 else 1)]


def _out_of_order(times: NDArray[np.float64]) -> list[Delivery]:
    items = _plain(times)
    for late in range(10, len(items), 10):
        items[late - 2 : late + 1] = [items[late], items[late - 2], items[late - 1]]
    return items


def _bursts(times: NDArray[np.float64]) -> list[Delivery]:
    items = _plain(times)
    first, stop = _span(times)
    for start in range(first, stop - BURST + 1, BURST):
        for place in range(BURST):
            stamp = times[start + BURST - 1] - (BURST - 1 - place) * BURST_SPACING
            items[start + place] = items[start + place]._replace(timestamp=float(stamp))
    return items


def _missing(times: NDArray[np.float64], gap: float) -> list[Delivery]:
    first, stop = _span(times)
    kept = [item for item in _plain(times) if not first <= item.number < stop]
    return [item._replace(timestamp=item.timestamp + gap * (item.number >= stop)) for item in kept]


def _later(times: NDArray[np.float64], step: float, frames: int | None = None) -> list[Delivery]:
    items, (first, _) = _plain(times), _span(times)
    stop = len(items) if frames is None else first + frames
    return [item._replace(timestamp=item.timestamp + step * (first <= item.number < stop)) for item in items]


def _frozen(times: NDArray[np.float64], *, depth: bool, color: bool) -> list[Delivery]:
    first, _ = _span(times)
    kept: list[Frame] = []

    def remember(frame: Frame) -> Frame:
        kept[:] = [frame]
        return frame

    def freeze(frame: Frame) -> Frame:
        last = kept[0]
        return replace(frame, depth=last.depth if depth else frame.depth, color=last.color if color else frame.color)

    items = _altered(times, freeze)
    items[first - 1] = items[first - 1]._replace(alter=remember)
    return items


def scaled(frame: Frame, factor: float) -> Frame:
    """Scale the depth, as in another unit."""
    return replace(frame, depth=frame.depth * np.float32(factor))


def _exposed(frame: Frame, gain: float) -> Frame:
    return replace(frame, color=np.clip(frame.rgb * gain, 0, 255).astype(np.uint8))


def black(frame: Frame) -> Frame:
    """Set the colour to black."""
    return replace(frame, color=np.zeros_like(frame.rgb))


def _half_size(frame: Frame) -> Frame:
    depth, color = frame.depth[::2, ::2], frame.rgb[::2, ::2]
    return replace(frame, depth=np.ascontiguousarray(depth), color=np.ascontiguousarray(color))


def _invalid(frame: Frame) -> Frame:
    rng = np.random.default_rng(round(1000 * frame.timestamp))
    values = rng.choice(np.array([np.nan, np.inf, -np.inf, -1.0], np.float32), frame.depth.shape)
    return replace(frame, depth=np.where(rng.random(frame.depth.shape) < INVALID_SHARE, values, frame.depth))


def _absent(frame: Frame, what: str) -> Frame:
    raise FrameError(f"{what} of the frame at {frame.timestamp:.3f} s is missing")


FAULTS: dict[str, StreamFault] = {
    "none": StreamFault("as recorded", _plain),
    "dropped": StreamFault("30 % of the frames never arrive", _dropped),
    "duplicated": StreamFault("every third frame arrives twice", _duplicated),
    "out of order": StreamFault("every tenth frame arrives before the two that precede it", _out_of_order),
    "bursts": StreamFault("five frames arrive at once, stamped on arrival", _bursts),
    "gap": StreamFault("no frame for 10 s, the camera rests", partial(_later, step=LONG_GAP)),
    "gap in motion": StreamFault("no frame for 10 s, the camera moves on", partial(_missing, gap=LONG_GAP)),
    "sensor gone": StreamFault("the sensor does not answer", partial(_altered, alter=partial(_absent, what="all"))),
    "no frames": StreamFault("no frame arrives in the span, the clock goes on", partial(_missing, gap=0.0)),
    "clock forwards": StreamFault("the clock is set forwards by 1 h", partial(_later, step=CLOCK_STEP)),
    "clock backwards": StreamFault("the clock is set back by 1 h", partial(_later, step=-CLOCK_STEP)),
    "clock slightly back": StreamFault("the clock is set back by 0.5 s", partial(_later, step=-0.5)),
    "wrong stamp": StreamFault("one stamp is 1 h late", partial(_later, step=CLOCK_STEP, frames=1)),
    "frozen": StreamFault("depth and colour repeat", partial(_frozen, depth=True, color=True)),
    "frozen depth": StreamFault("the depth image repeats", partial(_frozen, depth=True, color=False)),
    "frozen colour": StreamFault("the colour image repeats", partial(_frozen, depth=False, color=True)),
    "no depth": StreamFault("all depths are 0", partial(_altered, alter=partial(scaled, factor=0.0))),
    "depth missing": StreamFault("no depth image", partial(_altered, alter=partial(_absent, what="the depth"))),
    "colour missing": StreamFault("no colour image", partial(_altered, alter=partial(_absent, what="the colour"))),
    "black": StreamFault("the colour image is black", partial(_altered, alter=black)),
    "darker": StreamFault("the exposure falls to 35 %", partial(_altered, alter=partial(_exposed, gain=0.35))),
    "brighter": StreamFault("the exposure rises to 250 %", partial(_altered, alter=partial(_exposed, gain=2.5))),
    "invalid depth": StreamFault("NaN, inf, negative depth in 30 % of the pixels", partial(_altered, alter=_invalid)),
    "resolution": StreamFault("images of half the size", partial(_altered, alter=_half_size)),
    "depth x 1000": StreamFault("millimetres for metres", partial(_altered, alter=partial(scaled, factor=1000.0))),
    "depth / 1000": StreamFault("metres for millimetres", partial(_altered, alter=partial(scaled, factor=0.001))),
    "depth x 5": StreamFault("unit of 1 mm for 0.2 mm", partial(_altered, alter=partial(scaled, factor=5.0))),
    "depth / 5": StreamFault("unit of 0.2 mm for 1 mm", partial(_altered, alter=partial(scaled, factor=0.2))),
}  # fmt: skip
