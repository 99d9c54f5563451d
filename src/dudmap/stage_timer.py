"""Wall-clock time per processing stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimer:
    """Milliseconds per stage of the processing of a frame; the times of a stage that runs twice are added.

    Args:
        timings: Milliseconds per stage that were measured before.
    """

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that measures a block of code; a block left by an exception is not counted."""
        start = time.perf_counter()
        yield
        self.timings[stage] = self.timings.get(stage, 0.0) + 1000 * (time.perf_counter() - start)
