"""Requests to end: Ctrl-C, SIGTERM (docker stop, systemd, Slurm) and SIGHUP (a closed terminal).

The command line turns each into a ``KeyboardInterrupt`` in the main thread, after the frame or file in progress
(``postponed``). As a library, dudmap leaves handlers alone.
"""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
SECOND = 1.0
"""Seconds after which a request is a second one; sooner it is a repetition by ``timeout``, shell or kernel."""


class _Request:
    signal: int = 0
    time: float = 0.0
    postponed: int = 0
    terminals: tuple[int, ...] = ()


def listen() -> None:
    """Handle SIGTERM and SIGHUP like Ctrl-C, unless they are ignored (nohup)."""
    _Request.terminals = tuple(handle for handle in (1, 2) if os.isatty(handle))
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _take)


def name() -> str:
    """Name of the request; Ctrl-C if ``listen`` has not received it."""
    return signal.Signals(_Request.signal).name if must_end() else "Ctrl-C"


def must_end() -> bool:
    """Whether the process must end, not only its work."""
    return _Request.signal not in (0, signal.SIGINT)


def exit_code(code: int) -> int:
    """128 plus the signal that ended the process, else ``code``."""
    return 128 + _Request.signal if must_end() else code


def check() -> None:
    """Repeat a request whose exception was lost in a library's callback.

    Raises:
        KeyboardInterrupt: There was a request.
    """
    if _Request.signal:
        raise KeyboardInterrupt


@contextmanager
def postponed() -> Iterator[None]:
    """Delay a first request until the end of a block.

    Raises:
        KeyboardInterrupt: At the end, if a request came.
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
    """Replace the ``SystemError`` that a request during a Numba kernel causes.

    Raises:
        KeyboardInterrupt: Instead of that error.
    """
    try:
        yield
    except SystemError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise


def _take(number: int, frame: FrameType | None) -> None:
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
    if _Request.terminals:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for handle in _Request.terminals:
            os.dup2(nowhere, handle)
        os.close(nowhere)


def _interrupt_children() -> None:
    import multiprocessing

    for child in multiprocessing.active_children():
        if child.pid is not None and hasattr(signal, "SIGHUP"):
            os.kill(child.pid, signal.SIGINT)
