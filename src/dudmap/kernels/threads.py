"""Bands of rows in a thread pool, and the decorator that compiles all kernels.

Kernels are serial and release the GIL; a call is cut into bands that do not depend on the number of threads, and
sums are added in band order, so that the result is the same, bit for bit, on one core and on sixteen.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

from numba import njit

# The part of fast-math that keeps NaN tests: no "nnan", no "ninf".
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
    "error_model": "numpy",
}
kernel = njit(**_OPTIONS)
scalar = njit(**_OPTIONS, forceinline=True)
"""Compiles scalar mathematics: always inlined, since a call ends the vectorisation of the loop around it."""
written_out = njit(**_OPTIONS, inline="always")
"""Compiles scalar mathematics as if it were written out where it is called, so that the compiler orders its sums and
products together with those around it; takes longer to compile than ``scalar``."""

Result = TypeVar("Result")


def num_threads() -> int:
    """Cores this process may use; the environment variable DUDMAP_THREADS overrides."""
    override = os.environ.get("DUDMAP_THREADS", "")
    if override.isdigit() and int(override) > 0:
        return int(override)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, num_threads() - 1), thread_name_prefix="dudmap")


def submit(function: Callable[[], Result]) -> Callable[[], Result]:
    """Start ``function`` in the thread pool if there is a core for it; the returned function waits for its result."""
    if num_threads() > 1:
        return _pool().submit(function).result
    result = function()
    return lambda: result


def bands(n: int, size: int) -> list[tuple[int, int]]:
    """Ranges (start, stop) of ``size`` that cover 0 to ``n``; they do not depend on the number of threads."""
    return [(start, min(start + size, n)) for start in range(0, n, size)]


def run_bands(function: Callable[..., Any], ranges: Sequence[tuple[int, int]], *each: Sequence[Any]) -> list[Any]:
    """Results, in order, of ``function(start, stop, *items)`` over all ranges; ``each`` holds one item per range."""
    calls = list(zip(ranges, *each, strict=True))
    threads = min(num_threads(), len(calls))
    if threads <= 1:
        return [function(*range_, *items) for range_, *items in calls]
    results: list[Any] = [None] * len(calls)
    order = iter(range(len(calls)))  # shared by all threads; next() is atomic, so no band runs twice

    def work() -> None:
        for n in order:
            range_, *items = calls[n]
            results[n] = function(*range_, *items)

    # the calling thread works too, and each worker is woken once, not once per band
    others = [_pool().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for other in others:
            if not other.cancel():  # do not wait for a worker that never started
                other.result()
    return results
