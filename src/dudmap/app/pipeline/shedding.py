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
    Shed.LABELS: "without moving objects, half of the labels",
    Shed.FUSION: "without moving objects, half of labels and fusion",
}
"""Omitted work by step, for the status line."""


class Shedding:
    """Chooses the omitted work by the times of frames.

    Attributes:
        step: Omitted work.
    """

    def __init__(self) -> None:
        self.step = Shed.NOTHING
        self._busy = self._period = 0.0
        self._count = self._periods = self._calm = 0
        self._last: tuple[int, float] | None = None

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
        if self._count >= SPAN and self._busy > HIGH * self._period and self.step < max(Shed):
            self._change(1)
        elif self._calm >= CALM and self.step > Shed.NOTHING:
            self._change(-1)

    def _change(self, by: int) -> None:
        self.step, self._count, self._calm = Shed(self.step + by), 0, 0
