"""Check an installation; each check has a finding and a remedy."""

import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from dudmap.errors import DudmapError
from dudmap.extras import install
from dudmap.version import __version__

COMPILING = "compiling the kernels (once, one to two minutes; dudmap warmup does it in advance)"

PYTHON = ((3, 11), (3, 14))
"""First supported and first unsupported version of Python."""
PORT = 8080
"""Port of the page of --view."""
FEATURES = ("avx2", "fma")
"""Instruction sets that speed up the kernels, in x86-64 processors since 2013."""
FREE_BYTES = 2**31
"""Smallest free space of a folder, bytes: a map and the results of a long run."""
State = Literal["good", "note", "bad"]


@dataclass(frozen=True)
class Check:
    """Result of a check.

    Attributes:
        state: "good"; "note" limits a part; "bad" stops the program.
    """

    name: str
    state: State
    found: str
    mend: str = ""


def checks() -> Iterator[Check]:
    """Run all checks, without compiling and network."""
    yield _python()
    yield from _packages()
    yield _processor()
    yield _threads()
    yield _gpu()
    yield from _caches()
    yield from _extras()
    yield _port()


def _python() -> Check:
    found = f"Python {platform.python_version()}, dudmap {__version__}, {platform.platform()}"
    if PYTHON[0] <= sys.version_info[:2] < PYTHON[1]:
        return Check("versions", "good", found)
    return Check("versions", "bad", found, "install Python 3.11, 3.12 or 3.13 and dudmap in it")


def _packages() -> Iterator[Check]:
    for name, lowest, extra in requirements():
        found = installed(name)
        if extra:
            continue
        if found is None:
            yield Check(name, "bad", "not installed", f"pip install '{name}>={lowest}'")
        elif numbers(found) < numbers(lowest):
            mend = f"pip install --upgrade '{name}>={lowest}'"
            yield Check(name, "bad", f"{found}; {lowest} or newer is needed", mend)
        else:
            yield Check(name, "good", found)


def _processor() -> Check:
    from dudmap.app.pipeline.environment import machine

    name = f"{machine()['cpu']} ({platform.machine()})"
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return Check("processor", "good", name)
    try:
        from llvmlite.binding import get_host_cpu_features

        features = get_host_cpu_features()
    except (ImportError, RuntimeError) as error:
        return Check("processor", "note", f"{name}; its features are not known: {error}", "see the packages above")
    missing = [feature for feature in FEATURES if not features.get(feature)]
    if missing:
        mend = "expect several times the time per frame; if it is a virtual machine, pass on the host's processor"
        return Check("processor", "note", f"{name} without {' and '.join(missing)}", mend)
    return Check("processor", "good", f"{name} with {', '.join(FEATURES)}")


def _threads() -> Check:
    try:
        from dudmap.core.backends.threads import num_threads
    except ImportError as error:
        return Check("threads", "bad", f"Numba cannot be loaded: {error}", "pip install --force-reinstall numba")
    count, given = num_threads(), os.environ.get("DUDMAP_THREADS")
    found = f"{count} of {os.cpu_count()} cores" + (f", as DUDMAP_THREADS={given} says" if given else "")
    if given and not (given.isdigit() and int(given) > 0):
        return Check("threads", "note", found, "DUDMAP_THREADS is no positive whole number and has no effect: unset it")
    return Check("threads", "good" if count > 1 else "note", found, "" if count > 1 else "more cores make it faster")


def _gpu() -> Check:
    from dudmap.core.backends.device import driver_version, obstacle

    found = obstacle()
    if not found:
        return Check("GPU", "good", "works, and is used unless --device cpu is given")
    if driver_version() is None:
        return Check("GPU", "good", "none of NVIDIA found; none is needed")
    return Check("GPU", "note", f"cannot be used: {found}", "none is needed; to use it, correct this")


def _caches() -> Iterator[Check]:
    from dudmap.io.sequences.archive import cache_folder

    try:
        yield _kernel_cache()
    except ImportError:  # the check of the threads reports a missing Numba
        pass
    try:
        archives = cache_folder()
        problem = not_writable(archives)
    except DudmapError as error:
        yield Check("archive cache", "note", *str(error).split("; "))
        return
    if problem:
        mend = "set DUDMAP_CACHE to a folder that you can write"
        yield Check("archive cache", "note", f"{archives}: {problem}", mend)
    else:
        yield Check("archive cache", "good", str(archives))


def _kernel_cache() -> Check:
    from dudmap.core import kernel_cache, shipped_kernels

    if shipped := shipped_kernels.folder():
        return Check("kernels", "good", f"of the installation, for {shipped.name}")
    name, folder, count = "kernel cache", kernel_cache.folder(), kernel_cache.count()
    given = os.environ.get("NUMBA_CACHE_DIR")
    mend = "set NUMBA_CACHE_DIR to a folder that you can write and that lasts"
    if folder is None:
        return Check(name, "note", "no folder can be written: every start compiles for one to two minutes", mend)
    if kernel_cache.is_temporary():
        return Check(
            name, "note", f"{folder}, {count} kernels, which may not last: no other folder can be written", mend
        )
    if given and Path(given).resolve() not in folder.resolve().parents:
        return Check(name, "note", f"{folder}, since NUMBA_CACHE_DIR={given} cannot be written", mend)
    if problem := not_writable(folder):
        return Check(name, "note", f"{folder}: {problem}", mend)
    if not count:
        return Check(name, "note", f"{folder} is empty", "dudmap warmup compiles all kernels in advance")
    return Check(name, "good", f"{folder}, {count} kernels")


def _extras() -> Iterator[Check]:
    by_extra: dict[str, list[tuple[str, str]]] = {}
    for name, lowest, extra in requirements():
        if extra and extra != "dev":
            by_extra.setdefault(extra, []).append((name, lowest))
    for extra, packages in sorted(by_extra.items()):
        missing = [
            name for name, lowest in packages
            if (found := installed(name)) is None or numbers(found) < numbers(lowest)
        ]  # fmt: skip
        if missing:
            mend = f"only if you need it: {install(extra)}"
            yield Check(f"extra {extra}", "note", f"without {', '.join(missing)}", mend)
        else:
            yield Check(f"extra {extra}", "good", ", ".join(f"{name} {installed(name)}" for name, _ in packages))


def _port() -> Check:
    from dudmap.app.viewing.page_access import port_problem

    problem = port_problem("127.0.0.1", PORT)
    if problem:
        return Check("viewer port", "note", f"{PORT}: {problem}", "name another one with --port")
    return Check("viewer port", "good", f"{PORT} is free on this machine")


def not_writable(folder: Path) -> str:
    """Why a folder, or its nearest existing parent, is not writable; empty if it is."""
    place = next((parent for parent in (folder, *folder.parents) if parent.exists()), Path("/"))
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        return f"it cannot be written ({error.strerror})"
    free = shutil.disk_usage(place).free
    return f"only {free / 1e9:.1f} GB are free" if free < FREE_BYTES else ""


def requirements() -> list[tuple[str, str, str]]:
    """Name, lowest version and extra (empty: required) of needed packages."""
    found: dict[tuple[str, str], str] = {}
    for line in requires("dudmap") or []:
        name = re.match(r"[A-Za-z0-9._-]+", line)
        lowest, extra = re.search(r">=\s*([\d.]+)", line), re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name is not None and ("sys_platform" not in line or f"'{sys.platform}'" in line):
            found[name[0], extra[1] if extra else ""] = lowest[1] if lowest else "0"
    return [(name, lowest, extra) for (name, extra), lowest in found.items()]


def installed(name: str) -> str | None:
    """Version of an installed package; None if it is missing."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def numbers(text: str) -> tuple[int, ...]:
    """Leading numbers of a version, for comparison."""
    release = re.match(r"\d+(?:\.\d+)*", text)
    return tuple(int(part) for part in release[0].split(".")) if release else ()
