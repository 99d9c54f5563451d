"""Changes of Numba that shorten its compilations, for all code of the process; made when the first kernel is compiled.

Together they save a quarter of the time of a compilation. A process that loads all its kernels changes nothing.
"""

import gc
from functools import cache

from numba import version_info
from numba.core import event
from numba.core.codegen import CPUCodeLibrary
from numba.core.targetconfig import ConfigStack, TargetConfig


@cache
def change_numba() -> None:
    """Make the changes, unless they are made."""
    event.register("numba:compile", _Uncollected())  # sent under the lock of the compiler
    if version_info.short == (0, 68):  # whose private parts these are; others compile as they do
        _optimize_callers()
        _compare_flags_at_once()


class _Uncollected(event.Listener):
    """Suspends the collection of garbage while a kernel is compiled: of the objects that a compilation makes nearly all
    live until its end, and to look through them again and again takes a tenth of the time."""

    def __init__(self) -> None:
        self._nested, self._collects = 0, True

    def on_start(self, event: event.Event) -> None:
        if self._nested == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._nested += 1

    def on_end(self, event: event.Event) -> None:
        self._nested -= 1
        if self._nested == 0 and self._collects:
            gc.enable()


def _optimize_callers() -> None:
    """Optimise what is always inlined, a ``Scalar``, only as far as inlining asks: all else is done in its callers, and
    to do it before as well takes a tenth of the time of all compilations."""
    optimize = CPUCodeLibrary._optimize_final_module

    def optimize_less(self: CPUCodeLibrary) -> None:
        flags, codegen = ConfigStack.top_or_none(), self._codegen
        if flags is None or not (flags.forceinline and flags.no_cpython_wrapper):
            optimize(self)
            return
        passes, builder = codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=codegen._opt_level, cost="cheap"
        )
        passes.run(self._final_module, builder)

    CPUCodeLibrary._optimize_final_module = optimize_less


def _compare_flags_at_once() -> None:
    """Compare the flags of compilations, which is done a hundred thousand times, by those that are set before all, and
    hash them by their kind: Numba's own hash is that of their names, which all have."""
    compare = TargetConfig.__eq__
    TargetConfig.__hash__ = lambda self: hash(type(self))
    TargetConfig.__eq__ = lambda self, other: (
        (type(self) is type(other) and self._values == other._values) or compare(self, other)
    )
