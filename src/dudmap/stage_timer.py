"""Time per processing stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

Span = tuple[Any, Any]
"""Marks of a clock at the beginning and at the end of something."""


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

    A stage that runs within another one counts for itself alone, so that no time is counted twice.

    Args:
        timings: Milliseconds per stage that were measured before.
        clock: What measures; None for the time of the program.
    """

    _clock: Clock | None = None
    _marks: tuple[tuple[str, Span, tuple[Span, ...]], ...] = ()
    """Stages of which the time has not been asked for: marks around them, and around the stages within them."""
    _inner: tuple[Span, ...] = ()
    """Marks around the stages that ran within the one that is running."""

    def __init__(self, timings: dict[str, float] | None = None, clock: Clock | None = None) -> None:
        self.timings = timings or {}
        self._within = 0.0  # milliseconds of the stages that ran within the one that is running
        if clock is not None:
            self._clock = clock

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        if self._clock is not None:
            with self._marked(stage, self._clock):
                yield
            return
        start, before, self._within = time.perf_counter(), self._within, 0.0
        yield
        ms = 1000 * (time.perf_counter() - start)
        self._add(stage, ms - self._within)
        self._within = before + ms

    def times(self) -> dict[str, float]:
        """Milliseconds per stage, after waiting for what the device still does."""
        marks, self._marks = self._marks, ()
        for stage, span, inner in marks:
            assert self._clock is not None
            whole, *parts = (self._clock.elapsed(*one) for one in (span, *inner))
            self._add(stage, whole - sum(parts))
        return self.timings

    @contextmanager
    def _marked(self, stage: str, clock: Clock) -> Iterator[None]:
        before, self._inner = self._inner, ()
        start, inner = clock.mark(), ()
        try:
            yield
        finally:
            inner, self._inner = self._inner, before
        span = start, clock.mark()
        self._marks, self._inner = (*self._marks, (stage, span, inner)), (*before, span)

    def _add(self, stage: str, ms: float) -> None:
        self.timings[stage] = self.timings.get(stage, 0.0) + ms
