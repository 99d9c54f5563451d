"""Requests to end: Ctrl-C, SIGTERM (docker stop, systemd, Slurm) and SIGHUP (a closed terminal), which the command line
takes alike.

A request is a ``KeyboardInterrupt`` in the main thread. It waits for the end of a frame, and for results that are
written (``postponed``). Programs that use dudmap as a library keep their own handlers.
"""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
SECOND = 1.0
"""Seconds after a first request from which another one is meant as a second: ``timeout`` sends SIGTERM twice, and shell
and kernel a SIGHUP each."""


class _Request:
    """The first request of the process."""

    signal: int = 0
    time: float = 0.0
    postponed: int = 0
    terminals: tuple[int, ...] = ()


def listen() -> None:
    """Take SIGTERM and SIGHUP as Ctrl-C, unless they are ignored, as by nohup."""
    _Request.terminals = tuple(handle for handle in (1, 2) if os.isatty(handle))
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _take)


def name() -> str:
    """Name of the request, Ctrl-C if it was none of the command line."""
    return signal.Signals(_Request.signal).name if must_end() else "Ctrl-C"


def must_end() -> bool:
    """Whether the process is to end, and not only the work that it does."""
    return _Request.signal not in (0, signal.SIGINT)


def exit_code(code: int) -> int:
    """Exit code of the process: 128 and the number of the signal that ended it, else ``code``."""
    return 128 + _Request.signal if must_end() else code


def check() -> None:
    """Repeat a request whose exception was lost, since it came while a library called Python.

    Raises:
        KeyboardInterrupt: There was a request.
    """
    if _Request.signal:
        raise KeyboardInterrupt


@contextmanager
def postponed() -> Iterator[None]:
    """Have a first request wait for the end of a block, which processes a frame or writes results.

    Raises:
        KeyboardInterrupt: At the end of the block, if a request came in it.
    """
    before = _Request.signal
    _Request.postponed += 1
    try:
        yield
    finally:
        _Request.postponed -= 1
    if not before:
        check()


@contextmanager
def recognised() -> Iterator[None]:
    """Take what a kernel makes of a request for the request: Numba calls it a result with an exception set.

    Raises:
        KeyboardInterrupt: In place of that error.
    """
    try:
        yield
    except SystemError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise


def _take(number: int, frame: FrameType | None) -> None:
    """Handler of a signal."""
    if number == getattr(signal, "SIGHUP", None):
        _leave_terminal()
    if not _Request.signal:
        _Request.signal, _Request.time = number, time.monotonic()
        if number != signal.SIGINT:
            _interrupt_children()
        if not _Request.postponed:
            raise KeyboardInterrupt
    elif number != getattr(signal, "SIGHUP", None) and time.monotonic() - _Request.time > SECOND:
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)


def _leave_terminal() -> None:
    """Write nothing more to a terminal that is closed."""
    if _Request.terminals:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for handle in _Request.terminals:
            os.dup2(nowhere, handle)
        os.close(nowhere)


def _interrupt_children() -> None:
    """Interrupt the processes of this one, which a terminal would interrupt by itself."""
    import multiprocessing

    for child in multiprocessing.active_children():
        if child.pid is not None and hasattr(signal, "SIGHUP"):
            os.kill(child.pid, signal.SIGINT)
