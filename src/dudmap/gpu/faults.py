"""Failures of a device during a run: what they are, and who is told of them.

Warp raises RuntimeError, and Exception itself where a module cannot be loaded. After most failures of a GPU its context
can do nothing more in the process, so that a device that has failed once is not used again.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dudmap.errors import MapError

Listener = Callable[[str], None]
_lost: dict[str, str] = {}


class DeviceFullError(MapError):
    """The map does not fit the memory of a device."""


class DeviceWarning(RuntimeWarning):
    """The CPU does what a device cannot do."""


def is_lost(device: str) -> bool:
    """Whether a device, by its name in Warp, has failed."""
    return device in _lost


def lost_devices() -> frozenset[str]:
    """Devices that have failed in this process."""
    return frozenset(_lost)


def handle(error: Exception, device: str, what: str) -> None:
    """Take note of an error that Warp raised, and tell it once; the caller then does the work on the CPU.

    Args:
        error: The error.
        device: Name of the device in Warp.
        what: What was being done.

    Raises:
        Exception: ``error``, where it is none of the device.
    """
    if isinstance(error, DeviceFullError):
        tell(str(error))
    elif type(error) not in (RuntimeError, Exception):
        raise error
    elif "failed to allocate" in str(error).lower() or "out of memory" in str(error).lower():
        tell(f"{device} has too little free memory for {what}, which is done on the CPU")
    else:
        lose(error, device)


def lose(error: Exception, device: str) -> None:
    """Take note of an error after which a device is not used again in this process.

    Raises:
        Exception: As of ``handle``.
    """
    if type(error) not in (RuntimeError, Exception):
        raise error
    if device not in _lost:
        _lost[device] = str(error)
        tell(f"{device} failed ({_first_line(error)}); the run goes on on the CPU")


@contextmanager
def told_to(listener: Listener) -> Iterator[None]:
    """Within the block, sentences on failures go to ``listener``, each once, instead of the warnings of Python."""
    _listeners.append((listener, set()))
    try:
        yield
    finally:
        _listeners.pop()


def forget() -> None:
    """Use failed devices again: for tests, which let devices fail that are sound."""
    _lost.clear()
    _listeners[0][1].clear()


def tell(sentence: str) -> None:
    """Tell a sentence, unless it was told before."""
    listener, told = _listeners[-1]
    if sentence not in told:
        told.add(sentence)
        listener(sentence)


def tell_lack(device: str) -> None:
    """Tell that a device is lost with a part of the map."""
    tell(f"the map lacks what {device} had written since it was last read")


def _warn(sentence: str) -> None:
    warnings.warn(sentence, DeviceWarning, stacklevel=5)


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


_listeners: list[tuple[Listener, set[str]]] = [(_warn, set())]
"""Who is told, the last one only, and what was told so far."""
