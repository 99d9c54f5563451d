"""Times of stages by the events of a GPU."""

import time
from typing import Any

import warp as wp  # pyright: ignore[reportMissingImports]

from dudmap.gpu import faults
from dudmap.gpu.streams import main_queue


class DeviceClock:
    """``stage_timer.Clock`` of a GPU: a stage lasts from the end of the work that was given before it to the end of its
    own, whichever stage waits for the results. The program's clock answers where the device is lost.

    Args:
        device: Name of the device in Warp.
    """

    def __init__(self, device: str) -> None:
        self.device = device

    def mark(self) -> tuple[float, Any]:
        """See ``stage_timer.Clock``; an event of the main queue, and the time of the program."""
        event = None
        if not faults.is_lost(self.device):
            try:
                event = main_queue(self.device).record(wp.Event(self.device, enable_timing=True))
            except RuntimeError as error:
                faults.handle(error, self.device, "the times of the stages")
        return time.perf_counter(), event

    def elapsed(self, start: tuple[float, Any], end: tuple[float, Any]) -> float:
        """See ``stage_timer.Clock``."""
        if not (start[1] is None or end[1] is None or faults.is_lost(self.device)):
            try:
                return float(wp.get_event_elapsed_time(start[1], end[1]))
            except RuntimeError as error:
                faults.handle(error, self.device, "the times of the stages")
        return 1000 * (end[0] - start[0])
