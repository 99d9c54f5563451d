"""Time per processing stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimer:
    """Milliseconds per stage of the processing of a frame; the times of a stage that runs twice are added.

    A stage that runs within another one counts for itself alone, so that no time is counted twice.

    Args:
        timings: Milliseconds per stage that were measured before.
    """

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}
        self._within = 0.0  # milliseconds of the stages that ran within the one that is running

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        start, before, self._within = time.perf_counter(), self._within, 0.0
        yield
        ms = 1000 * (time.perf_counter() - start)
        self.timings[stage] = self.timings.get(stage, 0.0) + ms - self._within
        self._within = before + ms
