"""Compiled kernels: of the wheel, of a folder, or of this process.

Numba refuses to define a kernel if none of its folders is writable. Kernels are then stored in a private temporary
folder, or compiled in memory.
"""

import os
import stat
import tempfile
from collections import Counter
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from numba.core import caching
from numba.core.dispatcher import Dispatcher

from dudmap.core import shipped_kernels
from dudmap.core.faster_compiling import change_numba
from dudmap.core.kernel_digest import digest, layout
from dudmap.core.shipped_kernels import KernelCacheWarning as KernelCacheWarning

_KINDS: dict[str, Any] = {
    kind.__name__.lstrip("_").removesuffix("CacheLocator"): kind for kind in caching.CacheImpl._locator_classes
}


_DAMAGED: type[Exception] = vars(caching)["pickle"].UnpicklingError


counts = Counter[str]()
"""Kernels of this process: ``shipped`` in the wheel, ``stored`` in the folder, or ``compiled``."""


def folder() -> Path | None:
    """Folder of the compiled kernels; None if compiled in memory."""
    place = _Locator.from_function(folder, str(Path(__file__).parent / "backends" / "cpu" / "__init__.py"))
    return None if place is None else Path(place.get_cache_path())


def count() -> int:
    """Number of kernels in the folder."""
    place = folder()
    return 0 if place is None else sum(1 for _ in place.glob("*.nbi"))


def is_cold() -> bool:
    """Whether all kernels have to be compiled."""
    return shipped_kernels.folder() is None and count() == 0


def is_temporary() -> bool:
    """Whether the kernels are stored in the temporary folder."""
    place, private = folder(), _private()
    return place is not None and private is not None and private in place.parents


def environment() -> dict[str, str]:
    """Environment variables that make a child process use the same folder."""
    return {"NUMBA_CACHE_DIR": str(_private())} if is_temporary() else {}


def store(kernel: Dispatcher) -> None:
    """Load and store the compiled forms of a kernel in the folder, by its ``digest``."""
    vars(kernel)["_cache"] = _Store(kernel)


class _Store(caching.NullCache):
    """Compiled forms of one kernel. The folder is only opened for forms that the wheel lacks."""

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel = kernel

    @cached_property
    def _folder(self) -> caching._Cache:
        try:
            return _Cache(self._kernel.py_func, digest(self._kernel))
        except RuntimeError:  # Numba found no folder
            _say_once("in memory, at each start, for one to two minutes")
            return caching.NullCache()

    @property
    def cache_path(self) -> Any:  # noqa: ANN401 - as Numba has it
        return self._folder.cache_path

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        if found := shipped_kernels.load(self._kernel, sig, target_context):
            counts["shipped"] += 1
        elif found := self._folder.load_overload(sig, target_context):
            counts["stored"] += 1
        else:
            change_numba()
        return found

    def save_overload(self, sig: Any, cres: Any) -> None:  # noqa: ANN401
        counts["compiled"] += 1
        self._folder.save_overload(sig, cres)

    def flush(self) -> None:
        self._folder.flush()


class _Cache(caching.FunctionCache):
    """Numba's cache of one kernel. A full disk or a damaged file disables the cache, not the kernel."""

    def __init__(self, function: Any, stamp: str) -> None:  # noqa: ANN401 - any function
        super().__init__(function)
        self._cache_file._source_stamp = stamp
        # processes that compile different types at the same time write different files
        self._cache_file._data_name_pattern = self._cache_file._data_name_pattern.replace(
            "{number", f"{os.getpid()}.{{number"
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        try:
            return super().load_overload(sig, target_context)
        except (OSError, EOFError, _DAMAGED):
            return None

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        try:
            try:
                super().save_overload(sig, data)
            except (EOFError, _DAMAGED):  # the index of stored forms is damaged
                self.flush()
                super().save_overload(sig, data)
        except OSError as error:
            _say_once(f"in memory, since {self.cache_path} cannot be written ({error.strerror})")

    def _index_key(self, sig: Any, codegen: Any) -> Any:  # noqa: ANN401
        return layout(sig), codegen.magic_tuple()


class _Locator:
    """Chooses the folder: NUMBA_CACHE_DIR, the package's, the user's, or the temporary one."""

    @classmethod
    def from_function(cls, function: Any, file: str) -> Any:  # noqa: ANN401 - a locator of Numba
        kinds = [_KINDS["UserProvided"], _KINDS["InTree"]]
        if os.path.isabs(os.path.expanduser("~")):  # otherwise Numba would make a folder named ~
            kinds.append(_KINDS["UserWide"])
        found = (kind.from_function(function, file) for kind in (*kinds, _PrivateLocator))
        return next((locator for locator in found if locator is not None), None)


class _PrivateLocator(_KINDS["InTree"]):
    def __init__(self, py_func: Any, py_file: str) -> None:  # noqa: ANN401
        super().__init__(py_func, py_file)
        self._cache_path = os.path.join(str(_private()), self.get_suitable_cache_subpath(py_file))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:  # noqa: ANN401
        found = None if _private() is None else super().from_function(py_func, py_file)
        if found is not None:
            _say_once(f"in {_private()}, which may not last")
        return found


class _Impl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 - as Numba has it


_Cache._impl_class = _Impl


@cache
def _private() -> Path | None:
    """Temporary folder that no other user can change."""
    try:
        base = Path(tempfile.gettempdir())
        temporary = {"/tmp", "/var/tmp", *(os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))}
        if os.name != "posix" or str(base) not in temporary:  # not the current folder, Python's fallback
            return None
        if base.stat().st_mode & (stat.S_IWOTH | stat.S_ISVTX) == stat.S_IWOTH:  # other users may rename its content
            return None
        path = base / f"dudmap-{os.getuid()}"
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError:
        return None
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return path if own else None


def _say_once(where: str) -> None:
    advice = "set NUMBA_CACHE_DIR to a folder that you can write and that lasts"
    shipped_kernels.say_once(f"kernels are compiled {where}; {advice}", "folder")
