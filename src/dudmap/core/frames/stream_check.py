"""Detection of faulty frames in a stream: wrong stamps, repeated images, a changed depth unit."""

import statistics
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.observation import Observation
from dudmap.core.state import Remembered, Stateful
from dudmap.core.verdict import ACCEPTED, Outcome, Verdict

INTERVALS = 30
"""Recent intervals between stamps; their median is the usual one."""
BURST_SHARE = 0.1
"""Share of the usual interval below which frames were delayed; real sensors leave more than a third."""
FURTHEST_STEP = 60.0
"""Largest step of the stamps that is accepted at once, seconds."""
AGREEING = 5
"""Consecutive consistent frames that reset the clock."""
STRIDE = 4
"""Stride of pixels compared for a change of the unit."""
MIN_PIXELS = 100
"""Fewest pixels with depth in both images."""
SMALLEST_FACTOR = 1.5
"""Smallest change of the unit (0.2 mm, 1/4 mm, 1 mm, 1 m)."""
SAME_FACTOR, AGREEING_SHARE = 0.1, 0.8
"""Tolerance of a factor of the depth, and share of pixels, for a change of the unit."""
LONGEST_MEMORY = 1.0
"""Longest time between two compared depth images, seconds."""

Images = tuple[NDArray[np.float32], NDArray[np.uint8] | None]
"""Depth (H, W) and colour (h, w, 3) of a frame; None without colour."""
Repeats = Literal["", "frame", "depth", "color"]
"""The part equal to the previous frame bit for bit."""


class StreamCheck(Stateful):
    """Checks the stamp and the images of every frame before registration.

    The clock is reset if ``AGREEING`` consecutive frames increase only among themselves; they are shifted to follow. An
    image equal to the previous one is a repetition. A change of the depth unit multiplies all depths by one factor;
    frames are rejected until it is reversed.

    Attributes:
        max_speed: Largest speed of the camera, m/s.
        clock_offset: Time added to the stamps since the clock was reset, s.
        repeats: Part of the last frame that repeats the previous frame.
    """

    clock_offset: Remembered[float] = 0.0
    repeats: Remembered[Repeats] = ""
    _last_stamp: Remembered[float | None] = None  # of the last frame with a valid stamp
    _contradicting: Remembered[list[float]]
    _intervals: Remembered[deque[float]]
    _arrived: Remembered[float | None] = None  # stamp of the last frame, valid or not
    _before: Remembered[Images | None] = None  # of the last frame
    _compared: Remembered[tuple[float, NDArray[np.float32]] | None] = None  # stamp and depth of the last with depth
    _unit: Remembered[float] = 0.0  # logarithm of the factor by which the unit has changed

    def __init__(self, max_speed: float) -> None:
        self.max_speed = max_speed
        self._contradicting = []  # stamps of the frames since then
        self._intervals = deque(maxlen=INTERVALS)

    def restamped(self, observation: Observation) -> Observation:
        """The frame with its stamp on the clock of the first frames."""
        if self.clock_offset == 0:
            return observation
        return replace(observation, timestamp=observation.timestamp + self.clock_offset)

    def judge(self, observation: Observation) -> Verdict:
        """Whether a frame can be used; each is checked once, in order of arrival.

        The checks are ``clock``, ``duplicate``, ``order``, ``burst`` and ``unit``. A frame that proves a clock reset
        changes ``clock_offset``; the caller then calls ``restamped``.
        """
        before, self._before = self._before, (observation.depth, observation.as_recorded.color)
        self.repeats = "" if before is None else repeated(before, self._before)
        verdict = self._stamp_verdict(observation.timestamp)
        return verdict + Verdict((self._unit_outcome(observation),)) if verdict.accepted else verdict

    # -- stamps --------------------------------------------------------------------------------------------------------

    def _stamp_verdict(self, raw: float) -> Verdict:
        if not np.isfinite(raw):
            return Verdict((Outcome("clock", raw, np.nan, f"the frame has the stamp {raw}; expected seconds"),))
        arrived, self._arrived = self._arrived, raw
        interval = None if arrived is None else raw - arrived
        stamp = raw + self.clock_offset
        verdict = Verdict.of(self._stamp_outcomes(stamp))
        if not verdict.accepted:
            agree = not self._contradicting or 0 <= raw - self._contradicting[-1] <= FURTHEST_STEP
            self._contradicting = [*self._contradicting, raw] if agree else [raw]
            [failure] = verdict.failed
            if len(self._contradicting) < AGREEING or failure.name in ("duplicate", "burst"):
                return verdict
            if failure.name == "order":
                assert self._last_stamp is not None
                self.clock_offset += self._last_stamp + self._usual_interval - stamp
                stamp = raw + self.clock_offset
        self._contradicting = []
        if interval is not None and 0 < interval <= FURTHEST_STEP:
            self._intervals.append(interval)
        self._last_stamp = stamp
        return ACCEPTED

    def _stamp_outcomes(self, stamp: float) -> Iterator[Outcome]:
        if self._last_stamp is None:
            return
        step, usual = stamp - self._last_stamp, self._usual_interval
        known = f"a frame with the stamp {stamp:.6f} s has arrived before"
        yield Outcome.of("duplicate", step == 0, 0, known)
        yield Outcome.of("order", -step, 0, "the frame was taken {figure:.3f} s before the last one that was used")
        if len(self._intervals) >= AGREEING:
            early = f"the frame is {1000 * step:.1f} ms after the last; expected {1000 * usual:.0f} ms"
            yield Outcome.of("burst", step, BURST_SHARE * usual, early, at_least=True)
        late = "the frame is {figure:.0f} s after the last; later frames must confirm this step"
        yield Outcome.of("clock", step, FURTHEST_STEP, late)

    @property
    def _usual_interval(self) -> float:
        return statistics.median(self._intervals) if self._intervals else 0.0

    # -- images --------------------------------------------------------------------------------------------------------

    def _unit_outcome(self, observation: Observation) -> Outcome:
        depth, stamp = observation.depth[::STRIDE, ::STRIDE].copy(), observation.timestamp
        compared = self._compared
        if np.count_nonzero(depth) >= MIN_PIXELS:
            self._compared = stamp, depth
        if compared is not None and 0 < stamp - compared[0] <= LONGEST_MEMORY:
            factor = sudden_factor(compared[1], depth, self.max_speed * (stamp - compared[0]))
            self._unit += np.log(factor)
        elif compared is not None and np.count_nonzero(depth) >= MIN_PIXELS:
            self._unit = 0.0  # after a pause the unit is unknown
        change, smallest = abs(self._unit), float(np.log(SMALLEST_FACTOR))
        if change < smallest:
            self._unit = 0.0
        reason = f"the depth unit changed: all depths changed by the factor {np.exp(self._unit):.3g}"
        return Outcome.of("unit", change, smallest, reason)


def repeated(before: Images, after: Images) -> Repeats:
    """The part of a frame that repeats the previous frame.

    Repeated depth without colour is a repeated ``frame``.
    """
    depth = _equal(before[0], after[0]) and bool(after[0].any())
    if before[1] is None or after[1] is None:
        return "frame" if depth and before[1] is after[1] else "depth" if depth else ""
    color = _equal(before[1], after[1])
    return "frame" if depth and color else "depth" if depth else "color" if color else ""


def sudden_factor(before: NDArray[np.float32], after: NDArray[np.float32], reach: float) -> float:
    """Factor of all depths, 1 if motion may explain the change.

    Args:
        before, after: (h, w) metres, 0 = none.
        reach: Largest camera motion between the images, metres.
    """
    both = (before > 0) & (after > 0)
    count, most = np.count_nonzero(both), np.float32(SMALLEST_FACTOR)
    if count < MIN_PIXELS:
        return 1.0
    usual = np.count_nonzero(both & (after < most * before) & (before < most * after))
    if 2 * usual > count:  # then so is the median, which takes longer
        return 1.0
    before, after = before[both], after[both]
    ratios = after / before
    factor = float(np.median(ratios))
    if max(factor, 1 / factor) < SMALLEST_FACTOR:
        return 1.0
    change = float(np.median(np.abs(after - before)))
    agrees = np.abs(ratios / factor - 1) < SAME_FACTOR
    return factor if change > reach and agrees.mean() > AGREEING_SHARE else 1.0


def _equal(a: NDArray, b: NDArray) -> bool:
    middle = a.shape[0] // 2
    return a.shape == b.shape and a[middle].tobytes() == b[middle].tobytes() and np.array_equal(a, b)
