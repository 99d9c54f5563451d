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
        self._within = 0.0  # milliseconds of the stages that ran within the one that is running

    def __call__(self, stage: str) -> "_Block":
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        return _Block(self, stage)


class _Block:
    """A block of code that is measured; a generator with ``contextmanager`` would take three times as many calls."""

    __slots__ = ("_before", "_stage", "_start", "_timer")

    def __init__(self, timer: StageTimer, stage: str) -> None:
        self._timer, self._stage = timer, stage

    def __enter__(self) -> None:
        timer = self._timer
        self._start, self._before, timer._within = time.perf_counter(), timer._within, 0.0

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            timer, ms = self._timer, 1000 * (time.perf_counter() - self._start)
            timer.timings[self._stage] = timer.timings.get(self._stage, 0.0) + ms - timer._within
            timer._within = self._before + ms
