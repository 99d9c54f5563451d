"""Thread pool for bands of rows, and decorators that compile kernels.

Kernels are serial and release the GIL; bands and their order are fixed, so that results do not depend on the cores.
"""

import atexit
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cache, cached_property, partial, update_wrapper
from importlib import import_module
from queue import SimpleQueue
from typing import Any, TypeVar

from numba import njit
from numba.core.dispatcher import Dispatcher

from dudmap.core.kernel_cache import store


def _import_numba() -> None:
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # pyright: ignore[reportArgumentType] - so that its import fails
        try:
            vars(import_module("numba.np.arraymath"))["_HAVE_BLAS"] = True  # the value that other users of Numba expect
        finally:
            del sys.modules[blas]


_import_numba()

# The part of fast-math that keeps NaN tests: no "nnan", no "ninf".
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compiles a kernel and caches it until its code or inlined code changes."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = njit(**(_OPTIONS | options))(function)
        if isinstance(kernel, Dispatcher):  # not the plain function of NUMBA_DISABLE_JIT
            store(kernel)
        return kernel

    return decorate


class Scalar:
    """Device function: inlined into kernels; compiled on its own only when Python calls it.

    Numba would make it callable from Python and C, which can take longer than compiling.

    Attributes:
        py_func: The Python function.
        inlined: The dispatcher for kernels.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        update_wrapper(self, function)
        self.py_func, self._options = function, options
        inlined: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True}
        self.inlined = njit(**(_OPTIONS | options | inlined))(function)

    @property
    def _numba_type_(self) -> Any:
        """Numba type of this object inside kernels."""
        return self.inlined._numba_type_

    @cached_property
    def _alone(self) -> Callable[..., Any]:
        return compiled(**self._options)(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        """Call the separately compiled kernel."""
        return self._alone(*arguments)


kernel = compiled()
exact = compiled(fastmath=False)
"""Decorator for small loops that round like NumPy."""
exact_scalar = partial(Scalar, fastmath=False)
"""Decorator for device functions of such loops; ``py_func`` is the same formula for whole images."""
scalar = Scalar
"""Decorator for device functions that are always inlined, for vectorisation and one rounding."""
written_out = compiled(inline="always")
"""Decorator for formulas inlined as source, whose sums join the surrounding ones; slower to compile."""

Result = TypeVar("Result")


@cache
def num_threads() -> int:
    """Cores of this process; DUDMAP_THREADS overrides it. Read once."""
    override = os.environ.get("DUDMAP_THREADS", "")
    return int(override) if override.isdigit() and int(override) > 0 else _num_cores()


@cache
def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _tasks() -> SimpleQueue[Callable[[], object] | None]:
    """Task queue of the other threads, one per core but one, faster than an executor.

    They end before the interpreter, which a thread in compiled code would abort.
    """
    tasks: SimpleQueue[Callable[[], object] | None] = SimpleQueue()

    def work() -> None:
        while (task := tasks.get()) is not None:
            task()
            del task  # with its data, while the thread waits for the next

    def stop() -> None:
        for _ in threads:
            tasks.put(None)
        for thread in threads:
            thread.join()

    threads = [threading.Thread(target=work, name=f"dudmap-{n}", daemon=True) for n in range(max(1, num_threads() - 1))]
    for thread in threads:
        thread.start()
    atexit.register(stop)
    return tasks


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_tasks.cache_clear)  # a forked process has none of the threads
    os.register_at_fork(after_in_child=num_threads.cache_clear)  # and may have fewer cores


def submit(function: Callable[[], Result]) -> Callable[[], Result]:
    """Start ``function`` in another thread if a core is available.

    Returns:
        A function that waits for the result, or computes it if no thread has started.
    """
    if num_threads() <= 1:
        result = function()
        return lambda: result
    future: Future[Result] = Future()
    waiting = deque([function])  # releases the function and its data as soon as it is called

    def fulfil() -> None:
        try:
            task = waiting.pop()
        except IndexError:  # another thread has taken it
            return
        try:
            future.set_result(task())
        except BaseException as error:
            future.set_exception(error)

    def computed() -> Result:
        fulfil()
        return future.result()

    _tasks().put(fulfil)
    return computed


def also_in_other_threads(function: Callable[[], object], count: int) -> None:
    """Make ``count`` other threads call a function, perhaps late."""
    for _ in range(count):
        _tasks().put(function)


def bands(n: int, size: int) -> list[tuple[int, int]]:
    """Ranges (start, stop) of ``size`` from 0 to ``n``."""
    return [(start, min(start + size, n)) for start in range(0, n, size)]


def run_bands(function: Callable[..., Any], ranges: Sequence[tuple[int, int]], *each: Sequence[Any]) -> list[Any]:
    """Results, in order, of ``function(start, stop, *items)`` over all ranges; ``each`` holds one item per range."""
    calls = list(zip(ranges, *each, strict=True))
    threads = min(num_threads(), len(calls)) if len(calls) > 1 else 1
    if threads <= 1:
        return [function(*range_, *items) for range_, *items in calls]
    results: list[Any] = [None] * len(calls)
    order = iter(range(len(calls)))  # shared by all threads; next() is atomic, so no band runs twice
    finished: SimpleQueue[int] = SimpleQueue()  # number of bands finished by another thread
    errors: list[BaseException] = []

    def work() -> int:
        count = 0
        for n in order:
            range_, *items = calls[n]
            try:
                results[n] = function(*range_, *items)
            except BaseException as error:
                errors.append(error)
            count += 1
        return count

    # the calling thread works too; each other thread is woken once, not once per band
    also_in_other_threads(lambda: finished.put(work()), threads - 1)
    count = work()
    while count < len(calls):
        count += finished.get()
    if errors:
        raise errors[0]
    return results
