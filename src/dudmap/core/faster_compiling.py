"""Changes of Numba that shorten compilation, for all code of the process; made when the first kernel is compiled.

35 kernels take 69.7 s, 80.2 s without ``_optimize_callers``, 81.9 s without ``_compare_flags_at_once``.
"""

import gc
from functools import cache

from numba import version_info
from numba.core import event
from numba.core.codegen import CPUCodeLibrary
from numba.core.targetconfig import ConfigStack, TargetConfig


@cache
def change_numba() -> None:
    """Make the changes once."""
    event.register("numba:compile", _Uncollected())  # sent under the lock of the compiler
    if version_info.short == (0, 68):  # these are its private parts; other versions compile unchanged
        _optimize_callers()
        _compare_flags_at_once()


class _Uncollected(event.Listener):
    """Suspends garbage collection during a compilation, whose objects nearly all live until its end."""

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
    """Optimise always inlined functions only as far as inlining needs."""
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
    """Compare compilation flags by their set values, and hash them by type."""
    compare = TargetConfig.__eq__
    TargetConfig.__hash__ = lambda self: hash(type(self))
    TargetConfig.__eq__ = lambda self, other: (
        (type(self) is type(other) and self._values == other._values) or compare(self, other)
    )
