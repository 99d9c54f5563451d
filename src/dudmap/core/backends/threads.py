"""Bands of rows in a thread pool, and the decorator that compiles all kernels.

Kernels are serial and release the GIL; a call is cut into bands that do not depend on the number of threads, and
sums are added in band order, so that the result is the same, bit for bit, on one core and on sixteen.
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
    """Import what Numba needs before its first kernel, without SciPy's linear algebra.

    Numba imports it only to learn whether there is a BLAS, for products of vectors, which no kernel has. That takes as
    long as loading all kernels of the first frames.
    """
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # pyright: ignore[reportArgumentType] - so that its import fails
        try:
            vars(import_module("numba.np.arraymath"))["_HAVE_BLAS"] = True  # as others find it
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
    """Decorator that compiles a kernel and stores it until its text or that of a function it inlines changes."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = njit(**(_OPTIONS | options))(function)
        if isinstance(kernel, Dispatcher):  # and not the function itself, with NUMBA_DISABLE_JIT
            store(kernel)
        return kernel

    return decorate


class Scalar:
    """What kernels call: it is inlined there, and becomes a kernel of its own only where Python calls it.

    Numba would make each callable from Python and C, and store it, which can take longer than to compile it.

    Attributes:
        py_func: The function as it was written.
        inlined: What Numba compiles for kernels.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        update_wrapper(self, function)
        self.py_func, self._options = function, options
        inlined: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True}
        self.inlined = njit(**(_OPTIONS | options | inlined))(function)

    @property
    def _numba_type_(self) -> Any:
        """What Numba takes this for in a kernel."""
        return self.inlined._numba_type_

    @cached_property
    def _alone(self) -> Callable[..., Any]:
        return compiled(**self._options)(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel of its own."""
        return self._alone(*arguments)


kernel = compiled()
exact = compiled(fastmath=False)
"""Compiles loops over small images whose arithmetic rounds as NumPy's does, operation by operation."""
exact_scalar = partial(Scalar, fastmath=False)
"""Compiles what such loops call; ``py_func`` is the same formula for whole images."""
scalar = Scalar
"""Compiles what kernels call: always inlined, since a call ends the vectorisation of the loop around it, and since a
function that is not would exist twice, optimised on its own and with its caller, which differ in their roundings: which
of the two is called depends on whether the caller was compiled in this process or loaded from the cache."""
written_out = compiled(inline="always")
"""Compiles scalar mathematics as if it were written out where it is called, so that the compiler orders its sums and
products together with those around it; takes longer to compile than ``scalar``."""

Result = TypeVar("Result")


@cache
def num_threads() -> int:
    """Cores this process may use; the environment variable DUDMAP_THREADS overrides. It is read once, since a frame
    asks twenty times."""
    override = os.environ.get("DUDMAP_THREADS", "")
    return int(override) if override.isdigit() and int(override) > 0 else _num_cores()


@cache
def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _tasks() -> SimpleQueue[Callable[[], object] | None]:
    """Tasks of the other threads, one for each core but one. An executor would take ten times as long to wake one.

    The threads end when the interpreter does. One that was still in compiled code then would be ended there, which C++
    answers by ending the process with an error.
    """
    tasks: SimpleQueue[Callable[[], object] | None] = SimpleQueue()

    def work() -> None:
        while (task := tasks.get()) is not None:
            task()

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
    os.register_at_fork(after_in_child=num_threads.cache_clear)  # and may be given fewer


def submit(function: Callable[[], Result]) -> Callable[[], Result]:
    """Start ``function`` in another thread if there is a core for it.

    Returns:
        A function that waits for the result; where no thread has come to it yet, it is computed by who asks first.
    """
    if num_threads() <= 1:
        result = function()
        return lambda: result
    future: Future[Result] = Future()
    waiting = deque([function])  # it is let go with all that it holds as soon as it is called

    def fulfil() -> None:
        try:
            task = waiting.pop()
        except IndexError:  # another thread has come to it
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
    """Have ``count`` other threads call a function that may be called late, when nothing is left to do."""
    for _ in range(count):
        _tasks().put(function)


def bands(n: int, size: int) -> list[tuple[int, int]]:
    """Ranges (start, stop) of ``size`` that cover 0 to ``n``; they do not depend on the number of threads."""
    return [(start, min(start + size, n)) for start in range(0, n, size)]


def run_bands(function: Callable[..., Any], ranges: Sequence[tuple[int, int]], *each: Sequence[Any]) -> list[Any]:
    """Results, in order, of ``function(start, stop, *items)`` over all ranges; ``each`` holds one item per range."""
    calls = list(zip(ranges, *each, strict=True))
    threads = min(num_threads(), len(calls)) if len(calls) > 1 else 1
    if threads <= 1:
        return [function(*range_, *items) for range_, *items in calls]
    results: list[Any] = [None] * len(calls)
    order = iter(range(len(calls)))  # shared by all threads; next() is atomic, so no band runs twice
    finished: SimpleQueue[int] = SimpleQueue()  # number of bands that another thread has finished
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

    # the calling thread works too, and each other one is woken once, not once per band; one that comes late finds none
    also_in_other_threads(lambda: finished.put(work()), threads - 1)
    count = work()
    while count < len(calls):
        count += finished.get()
    if errors:
        raise errors[0]
    return results
