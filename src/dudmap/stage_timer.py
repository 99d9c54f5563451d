"""Milliseconds per processing stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimer:
    """Milliseconds per stage; a stage that runs twice adds up."""

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a block of code."""
        start = time.perf_counter()
        yield
        self.timings[stage] = self.timings.get(stage, 0.0) + 1000 * (time.perf_counter() - start)
