"""Omit work in a live run of slow frames."""

from dudmap.core.shed import Shed

SPAN = 5
"""Time constant of the mean processing time, and fewest frames between steps: frames of 1.6 periods fill the queue
(``MAX_WAIT``)."""
PERIOD_SPAN = 30
"""Time constant of the mean period, frames."""
HIGH, LOW = 1.0, 0.7
"""Mean processing time, periods, above which more work is omitted, and below which less is."""
CALM = 15
"""Frames below ``LOW`` before less work is omitted."""
SAID = {
    Shed.NOTHING: "",
    Shed.MOVERS: "without moving objects",
    Shed.MOVERS | Shed.FUSION: "without moving objects, half of the fusion",
    Shed.MOVERS | Shed.FUSION | Shed.LABELS: "without moving objects, half of fusion and labels",
    Shed.MOVERS | Shed.FUSION | Shed.LABELS | Shed.MOST: "without moving objects, a third of fusion and labels",
}
"""Omitted work in the order of omission, for the status line. Fusion is before labels: it saves as much time and costs
less accuracy."""
STEPS = list(SAID)


class Shedding:
    """Chooses the omitted work from the times of the frames."""

    def __init__(self) -> None:
        self._step = 0
        self._busy = self._period = 0.0
        self._count = self._periods = self._calm = 0
        self._last: tuple[int, float] | None = None

    @property
    def omitted(self) -> Shed:
        """Omitted work."""
        return STEPS[self._step]

    def add(self, number: int, arrival: float, busy: float) -> None:
        """Add a frame: number in the stream, arrival and processing time, seconds."""
        last, self._last = self._last, (number, arrival)
        if last is not None:
            self._periods += 1
            period = (arrival - last[1]) / (number - last[0])
            self._period += (period - self._period) / min(self._periods, PERIOD_SPAN)
        self._count += 1
        self._busy += (busy - self._busy) / min(self._count, SPAN)
        self._calm = self._calm + 1 if self._busy < LOW * self._period else 0
        if self._count >= SPAN and self._busy > HIGH * self._period and self._step < len(STEPS) - 1:
            self._change(1)
        elif self._calm >= CALM and self._step > 0:
            self._change(-1)

    def _change(self, by: int) -> None:
        self._step, self._count, self._calm = self._step + by, 0, 0
