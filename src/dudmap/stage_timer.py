"""Time per processing stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol


class Clock(Protocol):
    """Measures times on a compute device, which may work later than the program."""

    def mark(self) -> Any:  # noqa: ANN401
        """A mark at the present place in the device's work."""
        ...

    def elapsed(self, start: Any, end: Any) -> float:  # noqa: ANN401
        """Milliseconds between two marks; waits until the device has reached the second one."""
        ...


class StageTimer:
    """Milliseconds per stage of the processing of a frame; the times of a stage that runs twice are added.

    Args:
        timings: Milliseconds per stage that were measured before.
        clock: What measures; None for the time of the program.
    """

    _clock: Clock | None = None
    _marks: tuple[tuple[str, Any, Any], ...] = ()
    """Stages with the marks around them, of which the time has not been asked for."""

    def __init__(self, timings: dict[str, float] | None = None, clock: Clock | None = None) -> None:
        self.timings = timings or {}
        if clock is not None:
            self._clock = clock

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        if self._clock is not None:
            mark = self._clock.mark()
            yield
            self._marks = (*self._marks, (stage, mark, self._clock.mark()))
            return
        start = time.perf_counter()
        yield
        self._add(stage, 1000 * (time.perf_counter() - start))

    def times(self) -> dict[str, float]:
        """Milliseconds per stage, after waiting for what the device still does."""
        marks, self._marks = self._marks, ()
        for stage, start, end in marks:
            assert self._clock is not None
            self._add(stage, self._clock.elapsed(start, end))
        return self.timings

    def _add(self, stage: str, ms: float) -> None:
        self.timings[stage] = self.timings.get(stage, 0.0) + ms
