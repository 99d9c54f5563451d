"""Choice of the compute device: CPU, or NVIDIA GPU with Warp (extra ``gpu``).

Warp is imported only if needed, after a check of the driver.
"""

import ctypes
import importlib.util
import os
import sys
import warnings
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.spec import Backend
from dudmap.core.backends.warp import faults
from dudmap.errors import ConfigError
from dudmap.extras import install, need

if TYPE_CHECKING:
    from collections.abc import Iterator

OLDEST_DRIVER = (13, 0)
"""CUDA version for wheels of Warp from 1.19."""
OLDEST_RELEASE = 580
"""First driver for it."""
OLDEST_GPU = 75
"""Oldest compute capability, times ten, of CUDA 13."""


class DeviceWarning(RuntimeWarning):
    """The CPU replaces an unusable GPU."""


def make_backend(device: str) -> Backend:
    """A new back end on a device, or on the CPU after a failure in this process.

    Args:
        device: As for ``resolve``.

    Raises:
        ConfigError: No such device, or it does not work.
    """
    name = resolve(device)
    if name == "cpu":
        return CpuBackend()
    if failure := start_failure(name):
        raise ConfigError(f"device {device} cannot be used: {failure}; take --device cpu, or fix this")
    from dudmap.core.backends.warp.backend import WarpBackend

    return WarpBackend(name)


def resolve(device: str, *, adaptive: bool = False) -> str:
    """Selected device, "cpu", "warp-cpu" or "cuda:N"; "cpu" after a failure in this process.

    Args:
        device: "cpu"; "cuda" or "cuda:1"; "auto" for a working GPU, else the CPU; "warp-cpu" for GPU kernels on the
            CPU, for tests.
        adaptive: Several voxel sizes, which only the CPU supports.

    Raises:
        ConfigError: No such device, a failure, or no support for the map.
    """
    if adaptive and device not in ("cpu", "auto"):
        raise ConfigError(
            f"found device {device} and volume.adaptive=true; smaller voxels are computed on the CPU only: take "
            "--device cpu, or volume.adaptive=false"
        )
    name = "cpu" if adaptive else _resolved(device)
    return "cpu" if faults.is_lost(name) else name


@cache
def _resolved(device: str) -> str:
    if device == "cpu":
        return device
    if device == "warp-cpu":
        _need_warp(device)
        return device
    found = obstacle()
    if device == "auto":
        return "cpu" if found else _first_that_starts()
    if device.partition(":")[0] != "cuda":
        raise ConfigError(f"the device is {device!r}; expected auto, cpu, cuda or cuda:N, N counted from 0")
    _need_warp(device)
    if found:
        raise ConfigError(f"device {device} cannot be used: {found}; take --device cpu, or fix this")
    number = int(device.partition(":")[2] or supported_gpus()[0])
    if number not in supported_gpus():
        known = ", ".join(f"cuda:{n}" for n in supported_gpus())
        raise ConfigError(f"there is no device {device} that Warp supports; this machine has {known}")
    return f"cuda:{number}"


def _first_that_starts() -> str:
    name = f"cuda:{supported_gpus()[0]}"
    if failure := start_failure(name):
        warnings.warn(f"{name} cannot be used ({failure}); the CPU is used", DeviceWarning, stacklevel=5)
        return "cpu"
    return name


def obstacle() -> str:
    """Why no GPU can be used, as part of a sentence; empty if one can."""
    version = driver_version()
    if version is None:
        return "no NVIDIA driver was found"
    if version < OLDEST_DRIVER:
        return (
            f"the NVIDIA driver supports CUDA {version[0]}.{version[1]}, but Warp needs {OLDEST_DRIVER[0]}."
            f"{OLDEST_DRIVER[1]}, that is driver {OLDEST_RELEASE} or later"
        )
    if not _has_warp():
        return f"Warp is not installed ({install('gpu')})"
    if failure := warp_failure():
        return failure
    if not supported_gpus():
        return (
            f"Warp finds no GPU that it supports; expected compute capability {OLDEST_GPU / 10} or later and a working "
            "driver (check with nvidia-smi)"
        )
    return ""


@cache
def start_failure(device: str) -> str:
    """Why a device does not start; empty if it does."""
    _load_warp()
    import warp as wp  # pyright: ignore[reportMissingImports]

    try:
        wp.zeros(1, dtype=wp.int32, device="cpu" if device == "warp-cpu" else device).numpy()
    except (RuntimeError, OSError) as error:
        return " ".join(str(error).split())
    return ""


def _driver() -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return None


@cache
def driver_version() -> tuple[int, int] | None:
    """Newest CUDA version of the driver; None without a driver."""
    library, version = _driver(), ctypes.c_int(0)
    if library is None or library.cuDriverGetVersion(ctypes.byref(version)) != 0:
        return None
    return version.value // 1000, version.value % 1000 // 10


@cache
def warp_failure() -> str:
    """Why Warp does not start; empty if it does."""
    try:
        _load_warp()
    except (ImportError, OSError, RuntimeError) as error:
        return f"Warp does not start ({' '.join(str(error).split())})"
    return ""


@cache
def supported_gpus() -> list[int]:
    """Numbers of the GPUs that Warp supports."""
    _load_warp()
    import warp as wp  # pyright: ignore[reportMissingImports]

    return [gpu.ordinal for gpu in wp.get_cuda_devices() if gpu.arch >= OLDEST_GPU]


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def _need_warp(device: str) -> None:
    need("gpu", f"device {device}", ("warp",))


@cache
def _load_warp() -> None:
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.config.log_level = wp.LOG_WARNING
    with _silent_stderr(driver_version() is None):
        wp.init()


@contextmanager
def _silent_stderr(silent: bool) -> "Iterator[None]":
    if not silent:
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
