"""Time per processing stage."""

import time


class StageTimer:
    """Milliseconds per stage of the processing of a frame; the times of a stage that runs twice are added.

    A stage that runs within another one counts for itself alone, so that no time is counted twice.

    Args:
        timings: Milliseconds per stage that were measured before.
    """

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}
        self._running: tuple | None = None  # stage, start, milliseconds within the outer stage, the outer stage
        self._stage = ""
        self._within = 0.0  # milliseconds of the stages that ran within the one that is running

    def __call__(self, stage: str) -> "StageTimer":
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        self._stage = stage
        return self

    def __enter__(self) -> None:
        self._running = self._stage, time.perf_counter(), self._within, self._running
        self._within = 0.0

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._running is not None
        stage, start, before, self._running = self._running
        within, self._within = self._within, before
        if kind is None:
            ms, timings = 1000 * (time.perf_counter() - start), self.timings
            timings[stage] = (timings[stage] if stage in timings else 0.0) + ms - within
            self._within += ms
