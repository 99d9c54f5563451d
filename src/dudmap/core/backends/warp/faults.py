"""Device failures: an exception of Warp becomes one sentence, and the device is not used again.

Warp raises RuntimeError, or Exception for a module; most GPU failures break the process' context.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dudmap.errors import DeviceError

_lost: set[str] = set()
_locks: dict[str, threading.RLock] = {}


def is_lost(device: str) -> bool:
    """Whether a device has failed in this process."""
    return device in _lost


def forget() -> None:
    """Use failed devices again, for tests."""
    _lost.clear()


@contextmanager
def using(device: str) -> Iterator[None]:
    """Use a device within the block, by one thread at a time.

    Raises:
        DeviceError: The device fails, or has failed before.
    """
    with _locks.setdefault(device, threading.RLock()):
        if device in _lost:
            raise DeviceError(f"{device} has failed before in this process; restart the program, or take --device cpu")
        try:
            yield
        except Exception as error:
            if type(error) not in (RuntimeError, Exception):
                raise
            _lost.add(device)
            raise DeviceError(_sentence(device, error)) from error


def _sentence(device: str, error: Exception) -> str:
    reason = " ".join(str(error).split()) or type(error).__name__
    if "failed to allocate" in reason.lower() or "out of memory" in reason.lower():
        return (
            f"{device} has too little free memory for the map ({reason}); set volume.voxel_size to a larger value, or "
            "take --device cpu"
        )
    return f"{device} failed ({reason}); take --device cpu"
