"""Compiled kernels of a wheel by processor level.

The wheel holds one file per kernel and argument types, in ``compiled/VERSIONS/LEVEL/``. Its name contains the kernel's
digest.
"""

import hashlib
import multiprocessing
import os
import pickle
import sys
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba.core import config
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

from dudmap.core.kernel_digest import digest, layout
from dudmap.errors import ConfigError

_V3 = {
    *("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"),
    *("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"),
}  # fmt: skip
LEVELS = {
    "x86-64-v4": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3": _V3,
    "generic": set[str](),
}
"""Instructions of each level of the x86-64 ABI in LLVM's words, highest first."""
VERSIONS = (
    f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
    f"-numba-{numba.__version__}-llvmlite-{llvmlite.__version__}-numpy-{np.lib.NumpyVersion(np.__version__).major}"
)
"""Folder of the kernels that this interpreter can load."""
_settings: Any = config
FOLDER = Path(__file__).parent / "compiled"
DIGEST_BYTES = hashlib.sha256().digest_size


class KernelCacheWarning(UserWarning):
    """Compiled kernels cannot be used, or do not last."""


def force_level(name: str) -> None:
    """Compile all kernels of this process for a level, and use the kernels of this level.

    Numba's target is per process, so that other code is compiled for this level, too.

    Raises:
        ConfigError: There is no such level, the processor does not have it, or Numba has compiled for another one.
    """
    if name not in LEVELS:
        raise ConfigError(f"DUDMAP_CPU={name} is no level; set it to {', '.join(reversed(LEVELS))}")
    if lacking := sorted(LEVELS[name] - available()):
        raise ConfigError(f"DUDMAP_CPU={name}: this processor has no {', '.join(lacking)}; set DUDMAP_CPU=generic")
    _settings.CPU_NAME, _settings.CPU_FEATURES = name, ""
    context: Any = cpu_target.target_context
    if context.codegen().magic_tuple()[2]:  # features that were named when Numba's target was made
        raise ConfigError(
            f"DUDMAP_CPU={name} comes too late, since another package used Numba first; import dudmap.Slam before it"
        )


def available() -> set[str]:
    """Usable instructions of this processor, in LLVM's words."""
    return {name for name, present in get_host_cpu_features().items() if present}


@cache
def folder() -> Path | None:
    """Folder of shipped kernels in use; None for none, with a warning if a wheel brought some."""
    if not FOLDER.is_dir():
        return None
    given = _settings.CPU_NAME or _settings.CPU_FEATURES  # of the user, or of ``force_level``
    levels = [name for name, needs in LEVELS.items() if given in (None, name) and needs <= available()]
    found = next((place for name in levels if (place := FOLDER / VERSIONS / name).is_dir()), None)
    if found is None:
        brought = ", ".join(sorted(place.relative_to(FOLDER).as_posix() for place in FOLDER.glob("*/*")))
        wanted = f"{VERSIONS}/{levels[0] if given is None else given}"
        say_once(f"the kernels of this installation are for {brought}, not for {wanted}; they are compiled here, once")
    return found


def load(kernel: Dispatcher, sig: Any, target_context: Any) -> Any:  # noqa: ANN401 - types of Numba
    """Compiled form of a kernel for argument types; None if missing or damaged."""
    place = folder()
    if place is None:
        return None
    path = place / file_name(kernel, sig)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        say_once(
            f"{kernel.__name__} was edited, or is called with other types than the kernels of this installation; "
            "it is compiled here, like others of this kind",
            "edited",
        )
        return None
    except OSError as error:
        say_once(f"{path} cannot be read ({error.strerror}); the kernel is compiled here; reinstall dudmap", "damaged")
        return None
    content = data[DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != data[:DIGEST_BYTES]:
        say_once(f"{path} is damaged; the kernel is compiled here; reinstall dudmap", "damaged")
        return None
    target_context.refresh()
    return CompileResult._rebuild(target_context, *pickle.loads(content))


def file_name(kernel: Dispatcher, sig: Any) -> str:  # noqa: ANN401
    """File name of a kernel for argument types."""
    types = hashlib.sha256(layout(sig).encode()).hexdigest()
    return f"{kernel.__module__}.{kernel.__qualname__}-{digest(kernel)[:16]}-{types[:16]}.nbc"


_said = set[str]()


def say_once(sentence: str, subject: str = "") -> None:
    """Warn of the first sentence about a subject, once for all child processes."""
    if multiprocessing.parent_process() is None and (subject or sentence) not in _said:
        _said.add(subject or sentence)
        warnings.warn(sentence, KernelCacheWarning, stacklevel=2)


if _given := os.environ.get("DUDMAP_CPU"):
    force_level(_given)
